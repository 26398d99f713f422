"""Squares of triangles: a lattice, one with its diagonals in turn, one turned by 22.5 degrees, random points."""

from __future__ import annotations

import numpy as np

from fracsim.meshes import BUILDERS
from fracsim.meshes.data import Indices, MeshData, Points
from fracsim.meshes.random_points.points import Outline, delaunay
from fracsim.meshes.topology import boundary_facets, facet_groups_on_planes, orient_cells

KINDS = ("structured", "alternating", "rotated", "unstructured")


def square(kind: str, n: int, side: float = 1.0) -> MeshData:
    """A square of n by n cells of this kind, its side in m; groups as those of the builder box."""
    if kind in ("structured", "unstructured"):
        return BUILDERS["box"](size=(side, side), h=side / n, pattern=kind).build()
    points, cells = (_alternating if kind == "alternating" else _rotated)(n)
    cells, _ = orient_cells(points, cells)
    planes = {"left": (0, 0.0), "right": (0, 1.0), "bottom": (1, 0.0), "top": (1, 1.0)}
    return MeshData(points * side, cells, facet_groups_on_planes(points, boundary_facets(cells), planes))


def _alternating(n: int) -> tuple[Points, Indices]:
    i, j = (each.ravel() for each in np.indices((n + 1, n + 1)))
    points = np.column_stack([i, j]) / n
    i, j = (each.ravel() for each in np.indices((n, n)))
    a, b, c, d = (x * (n + 1) + y for x, y in ((i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)))
    even = ((i + j) % 2 == 0)[:, None]
    lower = np.where(even, np.column_stack([a, b, c]), np.column_stack([a, b, d]))
    upper = np.where(even, np.column_stack([a, c, d]), np.column_stack([b, c, d]))
    return points, np.concatenate([lower, upper]).astype(np.int64)


def _rotated(n: int) -> tuple[Points, Indices]:
    side = np.arange(n) / n
    zero = np.zeros(n)
    rim = np.concatenate(
        [np.column_stack(each) for each in ((side, zero), (zero + 1, side), (1 - side, zero + 1), (zero, 1 - side))]
    )
    number = np.arange(len(rim))
    outline = Outline(rim, np.column_stack([number, np.roll(number, -1)]))
    c, s = np.cos(np.pi / 8), np.sin(np.pi / 8)
    lattice = np.stack(np.meshgrid(*[np.arange(-2 * n, 2 * n) + 0.01] * 2, indexing="ij"), axis=-1).reshape(-1, 2) / n
    lattice[:, 0] += 1e-6 * lattice[:, 1]  # no four points on a circle: else round-off would choose the diagonals
    turned = lattice @ np.array([[c, s], [-s, c]]) + 0.5
    inner = turned[((turned > 0.6 / n) & (turned < 1 - 0.6 / n)).all(axis=1)]
    points = np.concatenate([rim, inner])
    triangles = delaunay(points).simplices.astype(np.int64)
    return points, triangles[outline.inside(points, triangles)]
