"""Position of the cracks in a diametrically compressed cylinder, when it has split and at the end."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from . import run_results
from .mesh_dependence import crack_corners
from .report_section import Claim, ReportTable, TableCell

Record = dict[str, Any]
Values = npt.NDArray[np.float64]

DIAMETER_DISTANCE = 0.1  # of the radius: limit of distance from the loaded diameter
SPLIT_LOAD = 0.9  # of the peak, after it


def measure_cracks(run: Path, time: Values, load: Values) -> Record:
    """Figures of `diametral_figures` at the frame where the load (N) has fallen to SPLIT_LOAD, and at the last."""
    fallen = np.flatnonzero((np.arange(len(load)) > load.argmax()) & (load <= SPLIT_LOAD * load.max()))
    mesh = run_results.study(run)["mesh"]
    outcome: Record = {}
    for name, at in (("split", float(time[fallen[0]]) if len(fallen) else None), ("end", None)):
        figures = diametral_figures(crack_corners(run, at), float(mesh["radius"]), float(mesh["length"]))
        outcome |= {f"{name}_{key}": value for key, value in figures.items()}
    return outcome


def diametral_figures(corners: Values, radius: float, length: float) -> Record:
    """Position of crack faces (n, 3, 3), m, both sides, in a cylinder along z from 0 that is compressed along y.

    Returns:
        `along`: share of their area near the loaded diameter. `covered`: share of the diametral section that these
        cover. `area`: their total area over that of the section.
    """
    size = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    near = np.abs(corners[:, :, 0].mean(axis=1)) < DIAMETER_DISTANCE * radius
    section = np.array([[-radius, 0.0], [radius, length]])
    return {
        "along": float(size[near].sum() / size.sum()) if len(size) else 0.0,
        "covered": covered_fraction(corners[near][:, :, 1:], section[0], section[1]),
        "area": float(size.sum() / 2 / (2 * radius * length)),
    }


def covered_fraction(triangles: Values, low: Values, high: Values, places: int = 2000) -> float:
    """Share of a rectangle covered by triangles (n, 3, 2), sampled at about `places` points."""
    step = np.sqrt((high - low).prod() / places)
    axes = [np.arange(a + step / 2, b, step) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    hit = np.zeros(len(grid), bool)
    # 500 triangles at a time take 25 MB
    for batch in np.array_split(triangles, 1 + len(triangles) // 500):
        sides, apart = np.roll(batch, -1, axis=1) - batch, grid[:, None, None] - batch
        turn = sides[..., 0] * apart[..., 1] - sides[..., 1] * apart[..., 0]
        hit |= np.any(np.all(turn >= 0, axis=2) | np.all(turn <= 0, axis=2), axis=1)
    return float(hit.mean())


# --- the page -------------------------------------------------------------------------------------------------------

COLUMNS = (
    "h, m", "along, at 0.9 of the peak", "of the section", "area over it", "along, in the end", "of the section",
    "area over it", "pieces",
)  # fmt: skip


def table(records: list[Record]) -> tuple[ReportTable, ...]:
    """Table with a row a mesh; empty if nothing was run."""
    keys = [f"{name}_{key}" for name in ("split", "end") for key in ("along", "covered", "area")]
    rows: tuple[tuple[TableCell, ...], ...] = tuple(
        (r["settings"]["h"], *(r["figures"][key] for key in (*keys, "pieces"))) for r in records
    )
    words = "Crack faces of the cylinder: share within a tenth of the radius of the loaded diameter"
    return (ReportTable("experiments-split", words, COLUMNS, rows),) if rows else ()


def claims(figures: list[Record], peak: float, within: float) -> tuple[Claim, ...]:
    """Claims on three meshes; `peak` (N) is the closed form, `within` the admissible relative error."""

    def claim(text: str, form: str, values: list[float], least: float, most: float = np.inf) -> Claim:
        words: str = ", ".join(form.format(value) for value in values) or "not run"
        return Claim(text, words, all(least <= item <= most for item in values) if len(values) == 3 else None)

    off = [figure["peak"] / peak - 1 for figure in figures]
    left = [figure["last"] / figure["peak"] for figure in figures]
    split, end = ([figure[f"{name}_along"] for figure in figures] for name in ("split", "end"))
    covered = [figure["split_covered"] for figure in figures]
    return (
        claim(f"A granite cylinder's peak is within {within:.0%} of pi D t f_t / 2", "{:+.1%}", off, -within, within),
        claim("Its load falls by half after the peak", "{:.2f} left", left, 0.0, 0.5),
        claim("At 0.9 of the peak cracks cover half of the section along the loaded diameter", "{:.0%}", covered, 0.5),
        claim("At least half of all crack faces lie there then", "{:.0%}", split, 0.5),
        claim("At least half of all crack faces lie there when the load has fallen by half", "{:.0%}", end, 0.5),
    )
