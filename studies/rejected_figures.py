"""Picture of the approaches that M22 rejects (its supplement, section 6), beside the degraded energy.

    python -m fracsim.studies.rejected_figures PICTURE.png

A row for each approach: the bar of evidence.rejected_approaches at four times after its first break.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .evidence.rejected_approaches import STEP, Values, judge, lattice_bar, simulate

if TYPE_CHECKING:
    from matplotlib.axes import Axes

TITLES = {
    "pseudo-inverse": "pseudo-inverse over intact edges",
    "projected-stress": "projected stress",
    "chi": "degraded energy",
}
STEPS_SHOWN = (10, 70, 86, 110)  # after the first break; the whole cross-section breaks at 50


def main() -> None:
    """Draw the picture."""
    from matplotlib.figure import Figure

    picture = Figure(figsize=(14, 5.4), layout="constrained")
    rows = picture.subplots(len(TITLES), len(STEPS_SHOWN), squeeze=False)
    for axes, (approach, title) in zip(rows, TITLES.items(), strict=True):
        frames: list[tuple[float, Values]] = []
        verdict = judge(simulate(approach, frames))
        draw_row(axes, approach, frames)
        axes[0].set_title(f"{title}: {verdict}", loc="left", fontsize=10)
    picture.savefig(Path(sys.argv[1]), dpi=100)


def draw_row(axes: Any, approach: str, frames: list[tuple[float, Values]]) -> None:
    """Draw the bar of one approach at the times shown, or say that there is no solution."""
    bar = lattice_bar(approach)
    for ax, step in zip(axes, STEPS_SHOWN, strict=True):
        format_axes(ax, f"{1e3 * step * STEP:.0f} ms")
        if len(frames) < step:
            ax.text(
                0.75, 0.125, f"no solution after {1e3 * frames[-1][0]:.0f} ms" if frames else "no solution", ha="center"
            )
        else:
            x = bar.points + frames[step - 1][1]
            ax.triplot(*x.T, bar.cells, color="#1f5f8b", linewidth=0.8)


def format_axes(ax: Axes, label: str) -> None:
    """Set the window, 2.4 m wide, and the time of a picture."""
    ax.set_xlim(-0.6, 1.8)
    ax.set_ylim(-0.5, 0.8)
    ax.set_aspect("equal")
    ax.set_xticks([])
    ax.set_yticks([])
    ax.set_xlabel(label, fontsize=9)


if __name__ == "__main__":
    main()
