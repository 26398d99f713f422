"""Edges of a triangle or tetrahedron, and tables of all patterns of broken edges.

The pattern of a cell is an integer whose bit k is set if local edge k is broken: 64 patterns for a tetrahedron, 8 for a
triangle. Properties of patterns are tabulated once and looked up with arrays.
"""

from __future__ import annotations

from functools import cache

import basix
import numpy as np
import numpy.typing as npt


def cell_type(dim: int) -> basix.CellType:
    """Basix's type of a simplex of dimension 1, 2 or 3."""
    return {1: basix.CellType.interval, 2: basix.CellType.triangle, 3: basix.CellType.tetrahedron}[dim]


@cache
def local_edges(dim: int) -> npt.NDArray[np.int64]:
    """(edges per cell, 2) local nodes of each local edge, in DOLFINx's order."""
    return np.array(basix.topology(cell_type(dim))[1])


@cache
def intact_edges(dim: int) -> npt.NDArray[np.bool_]:
    """(patterns, edges per cell) whether each edge is intact, for each pattern."""
    edges = len(local_edges(dim))
    return (np.arange(1 << edges)[:, None] >> np.arange(edges)) & 1 == 0


@cache
def node_groups(dim: int) -> npt.NDArray[np.int8]:
    """(patterns, d + 1) the lowest local node that intact edges connect each local node to, for each pattern."""
    edges, intact = local_edges(dim), intact_edges(dim)
    label = np.tile(np.arange(dim + 1, dtype=np.int8), (len(intact), 1))
    # a path through d + 1 nodes has at most d edges
    for _ in range(dim):
        for edge in range(len(edges)):
            i, j = int(edges[edge, 0]), int(edges[edge, 1])
            lower = np.minimum(label[:, i], label[:, j])
            label[:, i] = np.where(intact[:, edge], lower, label[:, i])
            label[:, j] = np.where(intact[:, edge], lower, label[:, j])
    return label


@cache
def is_split(dim: int) -> npt.NDArray[np.bool_]:
    """(patterns,) whether the intact edges no longer connect all nodes of the cell."""
    return np.any(node_groups(dim) != 0, axis=1)
