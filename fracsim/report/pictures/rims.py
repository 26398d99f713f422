"""Where a crack comes to the skin, and how far it opens there: what opens by less than a pixel is drawn as a line."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from .body import is_crack

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
GRID = 1e-7  # of the body's size: copies of a point were nearer than that


def opening(at: Values, rest: Values) -> Values:
    """(n,) how far the points that were at one place, `rest` (n, 3), are apart at `at` (n, 3), m: the diagonal of the
    box around them."""
    size = float(np.ptp(rest, axis=0).max()) or 1.0
    _, group = np.unique(np.rint(rest / (GRID * size)), axis=0, return_inverse=True)
    group = group.reshape(-1)
    count = int(group.max(initial=-1)) + 1
    least, most = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(least, group, at)
    np.maximum.at(most, group, at)
    return np.asarray(np.linalg.norm(most - least, axis=1)[group])


def rims(grid: Any) -> Ints:
    """(k, 2) points of the lines along which skin and cracks of a split surface in 3D meet."""
    crack = is_crack(grid)
    corners = np.asarray(grid.cell_connectivity).reshape(-1, 3)
    skin, inside = (_sides(corners[which]) for which in (~crack, crack))
    return skin[np.isin(_key(skin), _key(inside))]


def hairlines(grid: Any, width: float) -> Any:
    """The rims of a frame (see body.moved) that open by less than `width`, m, as lines; None: there are none."""
    import pyvista

    if "origin" not in grid.cell_data or not is_crack(grid).any():
        return None
    lines = rims(grid)
    used, lines = np.unique(lines, return_inverse=True)
    lines = lines.reshape(-1, 2)
    points = np.asarray(grid.points, float)[used]
    narrow = opening(points, np.asarray(grid.point_data["rest"])[used]) < width
    lines = lines[narrow[lines].all(axis=1)]
    return pyvista.PolyData(points, lines=np.insert(lines, 0, 2, axis=1).ravel()) if len(lines) else None


def _sides(triangles: Ints) -> Ints:
    """(3 k, 2) the lower point first."""
    return np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)


def _key(sides: Ints) -> Ints:
    return np.asarray(sides[:, 0].astype(np.int64) << 32 | sides[:, 1].astype(np.int64))
