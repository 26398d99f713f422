"""The points of the split surface: nodes that stay, and copies of edge, facet and cell points."""

from __future__ import annotations

from functools import cache

import numpy as np
import numpy.typing as npt

from ..simplices import local_edges
from .follow import Follow
from .skeleton import Skeleton
from .table import CELL, EDGE, FACET, Table

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


class SurfacePoints:
    """Points of a state of damage, numbered: nodes first, then copies of edge, facet and cell points.

    Attributes:
        positions: (n, d) reference coordinates, m.
        follow: the nodes that each point follows.
        first: number of the first copy.
        cell, kind, entity: (copies,) what is copied: of which cell, and of that which edge, facet or the whole.
        group: (copies, d + 1) nodes of the cell that each follows.
    """

    def __init__(self, skeleton: Skeleton, damaged: Ints, pattern: Ints, cut: Values | None, table: Table) -> None:
        """`pattern`: of the damaged cells; `cut`: see build.split."""
        self._skeleton, self._copies = skeleton, table.copies
        self._cut = cut if cut is not None and np.isfinite(cut).any() else None
        nodes = np.arange(len(skeleton.points)) if skeleton.dim == 2 else skeleton.boundary_nodes
        self._of_node = np.full(len(skeleton.points), -1)
        self._of_node[nodes] = np.arange(len(nodes))
        row, owner = self._copies.expand(pattern)
        self._first = np.searchsorted(owner, np.arange(len(damaged)))  # first copy of each damaged cell
        number, one = _numbered(self._keys(row, damaged[owner], owner))
        self._of_copy = np.append(number + len(nodes), -1)  # something to index where there is no copy
        row, cell = row[one], damaged[owner[one]]
        self.cell, self.kind, self.entity = cell, self._copies.kind[row], self._copies.entity[row]
        self.first, self.group = len(nodes), (group := self._copies.group[row])
        parents = np.concatenate([nodes, skeleton.cells[cell][group]])
        count = np.concatenate([np.ones(len(nodes), np.int64), group.sum(axis=1)])
        self.positions: Values = np.concatenate([skeleton.points[nodes], self._places(row, cell)])
        self.follow = Follow.of(parents, count, self.positions, skeleton.points)

    def of_nodes(self, nodes: Ints) -> Ints:
        """Points of nodes that have one: those of the boundary, in 2D all."""
        return self._of_node[nodes]

    def of_corners(self, corners: Ints, place: Ints, cell: Ints) -> Ints:
        """Points of table.Elements.corners (n, w), each row of the damaged cell `cell` (n,), the place-th of them."""
        copy = np.minimum(self._first[place][:, None] + np.maximum(corners, 0), len(self._of_copy) - 1)
        node = self._skeleton.cells[cell[:, None], np.maximum(-1 - corners, 0)]
        return np.where(corners >= 0, self._of_copy[copy], self._of_node[node])

    def _keys(self, row: Ints, cell: Ints, owner: Ints) -> Ints:
        """A number for every copy that all its cells agree on: (edge, end), (facet, group), (cell, group)."""
        skeleton, copies, d = self._skeleton, self._copies, self._skeleton.dim
        kind, entity, lead = copies.kind[row], copies.entity[row], copies.lead[row]
        keys = np.empty(len(row), np.int64)
        at = np.flatnonzero(kind == EDGE)
        edge = skeleton.cell_edges[cell[at], entity[at]]
        keys[at] = 2 * edge + (skeleton.cells[cell[at], lead[at]] == skeleton.edges[edge, 1])
        at = np.flatnonzero(kind == FACET)
        facet = skeleton.cell_facets[cell[at], entity[at]]
        group = np.where(copies.group[row[at]], skeleton.cells[cell[at]], len(skeleton.points))
        rank = np.count_nonzero(skeleton.facets[facet] < group.min(axis=1)[:, None], axis=1)
        base = 2 * len(skeleton.edges)
        keys[at] = base + d * facet + rank
        at = np.flatnonzero(kind == CELL)
        keys[at] = base + d * len(skeleton.facets) + (d + 1) * owner[at] + lead[at]
        return keys

    # --- where they are in the reference configuration ---

    def _places(self, row: Ints, cell: Ints) -> Values:
        skeleton, kind, entity = self._skeleton, self._copies.kind[row], self._copies.entity[row]
        result = np.empty((len(row), skeleton.dim))
        at = kind == EDGE
        result[at] = self._edge_points(skeleton.cell_edges[cell[at], entity[at]])
        at = kind == FACET
        if at.any():
            nodes = skeleton.facets[skeleton.cell_facets[cell[at], entity[at]]]
            # ascending, so that all copies of a point are at the same place to the last bit
            edges = np.sort(skeleton.cell_edges[cell[at][:, None], _facet_edges()[entity[at]]], axis=1)
            result[at] = self._centres(nodes, edges)
        at = kind == CELL
        result[at] = self._centres(skeleton.cells[cell[at]], skeleton.cell_edges[cell[at]])
        return result

    def _edge_points(self, edges: Ints) -> Values:
        ends = self._skeleton.points[self._skeleton.edges[edges]]
        share = 0.5 if self._cut is None else np.where(np.isnan(self._cut[edges]), 0.5, self._cut[edges])[:, None]
        cut: Values = ends[:, 0] + share * (ends[:, 1] - ends[:, 0])
        return cut

    def _centres(self, nodes: Ints, edges: Ints) -> Values:
        """Centroids, or the mean of the cuts with a place where there are two or more: a planar cut stays planar."""
        centre: Values = self._skeleton.points[nodes].mean(axis=1)
        if self._cut is not None:
            placed = ~np.isnan(self._cut[edges])
            at = np.flatnonzero(placed.sum(axis=1) >= 2)
            weight = placed[at] / placed[at].sum(axis=1, keepdims=True)
            cuts = self._edge_points(edges[at].ravel()).reshape(*edges[at].shape, self._skeleton.dim)
            centre[at] = np.einsum("ne,nei->ni", weight, cuts)
        return centre


@cache
def _facet_edges() -> Ints:
    """(4, 3) local edges of each facet of a tetrahedron."""
    return np.array([np.flatnonzero(np.all(local_edges(3) != facet, axis=1)) for facet in range(4)])


def _numbered(keys: Ints) -> tuple[Ints, Ints]:
    """Number of each key among the distinct ones, ascending; and the first place where each distinct key stands.

    Counting in place of sorting: the keys are dense.
    """
    used = np.zeros(int(keys.max(initial=-1)) + 1, bool)
    used[keys] = True
    number = np.cumsum(used)[keys] - 1
    one = np.empty(np.count_nonzero(used), np.int64)
    one[number[::-1]] = np.arange(len(keys))[::-1]
    return number, one
