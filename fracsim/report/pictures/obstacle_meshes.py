"""Obstacles in pictures: half-transparent, without the sides that face away, to hide nothing; in 2D filled."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[np.float64]

COLOUR, EDGE = "#c2b393", "#6e6350"
OPACITY = 0.5
ROOM = 0.25  # of the body's diagonal: what of an obstacle is in the picture on each side
TRIANGLE, LINE = 5, 3  # VTK's numbers


def add_obstacles(plotter: Any, files: Iterable[Path], *, flat: bool) -> None:
    """Draw those of a frame."""
    import pyvista

    for file in files:
        grid = pyvista.read(file)
        for kind in (TRIANGLE, LINE):
            part = np.flatnonzero(grid.celltypes == kind)
            if not len(part):
                continue
            how: dict[str, Any] = {"color": EDGE, "line_width": 2} if kind == LINE else {"color": COLOUR}
            if not flat:
                how |= {"opacity": OPACITY, "smooth_shading": True, "split_sharp_edges": True, "culling": "back"}
            plotter.add_mesh(grid.extract_cells(part), lighting=not flat, **how)


def corners_near(points: Values, files: Iterable[Path]) -> dict[Path, Values]:
    """(n, 3) points of each obstacle, moved into the box of the body's grown by the room around it."""
    import pyvista

    lower, upper = points.min(axis=0), points.max(axis=0)
    room = ROOM * float(np.linalg.norm(upper - lower)) * (upper > lower)  # a flat body stays flat
    return {file: np.clip(np.asarray(pyvista.read(file).points, float), lower - room, upper + room) for file in files}
