"""From damage to a closed surface: points, elements, and the nodes that each point follows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from .follow import Follow
from .skeleton import BODY, CRACK, Skeleton
from .table import CELL, EDGE, FACET, Copies, Elements, table

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Split:
    """The surface of a state of damage, in the reference configuration.

    Attributes:
        points: (n, d) reference coordinates, m: nodes of the mesh first (3D: of its boundary), then the copies.
        follow: the nodes that each point follows.
        elements: (m, d) triangles (3D) or segments (2D), outwards normal, body to the left.
        cell: (m,) mesh cell. edge: (m,) edge whose breaking opened it, -1 on the boundary. origin: (m,) see Skeleton.
        fill: (k, 3) triangles that cover the body in 2D, empty in 3D; fill_cell: (k,).
        broken: (E,) edges.
        pieces, piece_of_node: how many, and (N,), numbered by their lowest node.
    """

    points: Values
    follow: Follow
    elements: Ints
    cell: Ints
    edge: Ints
    origin: Ints
    fill: Ints
    fill_cell: Ints
    broken: npt.NDArray[np.bool_]
    pieces: int
    piece_of_node: Ints

    @property
    def piece_of_point(self) -> Ints:
        """(n,) all parents of a point are of one piece."""
        return self.piece_of_node[self.follow.first_parent]


def split(skeleton: Skeleton, pattern: npt.NDArray[np.integer], cut: Values | None = None) -> Split:
    """The surface of damage patterns (C,). `cut`: (E,) where edges are cut, from the lower node (0) to the higher (1);
    NaN: in the middle."""
    return _Builder(skeleton, pattern, cut)()


class _Builder:
    """Work on the damaged cells only; the boundary facets of all others are as they were."""

    def __init__(self, skeleton: Skeleton, pattern: npt.NDArray[np.integer], cut: Values | None) -> None:
        self.skeleton, self.table = skeleton, table(skeleton.dim)
        self.cut = cut if cut is not None and np.isfinite(cut).any() else None
        self.damaged = np.flatnonzero(pattern)
        self.pattern = pattern[self.damaged].astype(np.int64)
        self.place = np.full(len(pattern), -1)  # of a cell among the damaged ones
        self.place[self.damaged] = np.arange(len(self.damaged))
        self.broken = skeleton.broken_edges(pattern)
        self.nodes = np.arange(len(skeleton.points)) if skeleton.dim == 2 else skeleton.boundary_nodes
        self.node_place = np.full(len(skeleton.points), -1)
        self.node_place[self.nodes] = np.arange(len(self.nodes))

    def __call__(self) -> Split:
        points, follow = self._points()
        elements, cell, edge, origin = (np.concatenate(parts) for parts in zip(*self._elements(), strict=True))
        count, piece = self.skeleton.pieces(self.broken)
        return Split(points, follow, elements, cell, edge, origin, *self._fill(), self.broken, count, piece)

    # --- points ---

    def _points(self) -> tuple[Values, Follow]:
        copies, skeleton = self.table.copies, self.skeleton
        row, owner = copies.expand(self.pattern)
        self.first = np.searchsorted(owner, np.arange(len(self.damaged)))  # first copy of each damaged cell
        number, one = _numbered(self._keys(copies, row, owner))
        self.number = number + len(self.nodes)
        row, cell = row[one], self.damaged[owner[one]]
        positions = self._positions(copies, row, cell)
        points = np.concatenate([skeleton.points[self.nodes], positions])
        group = copies.group[row]
        parents = np.concatenate([self.nodes, skeleton.cells[cell][group]])
        count = np.concatenate([np.ones(len(self.nodes), np.int64), group.sum(axis=1)])
        return points, Follow.of(parents, count, points, skeleton.points)

    def _keys(self, copies: Copies, row: Ints, owner: Ints) -> Ints:
        """A number for every copy that all cells agree on: (edge, end), (facet, lowest node of the group), (cell, ...)."""
        skeleton, d = self.skeleton, self.skeleton.dim
        cell, kind, entity, lead = self.damaged[owner], copies.kind[row], copies.entity[row], copies.lead[row]
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

    def _positions(self, copies: Copies, row: Ints, cell: Ints) -> Values:
        skeleton, kind, entity = self.skeleton, copies.kind[row], copies.entity[row]
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
        ends = self.skeleton.points[self.skeleton.edges[edges]]
        share = 0.5 if self.cut is None else np.where(np.isnan(self.cut[edges]), 0.5, self.cut[edges])[:, None]
        moved: Values = ends[:, 0] + share * (ends[:, 1] - ends[:, 0])
        return moved

    def _centres(self, nodes: Ints, edges: Ints) -> Values:
        """Centroids, or the mean of the placed cuts where there are two or more: a planar cut stays planar."""
        centre: Values = self.skeleton.points[nodes].mean(axis=1)
        if self.cut is not None:
            placed = ~np.isnan(self.cut[edges])
            at = np.flatnonzero(placed.sum(axis=1) >= 2)
            weight = placed[at] / placed[at].sum(axis=1, keepdims=True)
            cuts = self._edge_points(edges[at].ravel()).reshape(*edges[at].shape, self.skeleton.dim)
            centre[at] = np.einsum("ne,nei->ni", weight, cuts)
        return centre

    # --- elements ---

    def _elements(self) -> list[tuple[Ints, ...]]:
        """Whole boundary facets, split ones, and both sides of the cracks: (corners, cell, edge, origin) of each."""
        skeleton, d = self.skeleton, self.skeleton.dim
        cell, facet = skeleton.boundary.T
        torn = np.flatnonzero(self.place[cell] >= 0)
        key = (d + 1) * self.pattern[self.place[cell[torn]]] + facet[torn]
        corners, owner, _ = self._corners(self.table.facets, key, cell[torn])
        of = torn[owner]
        whole = np.flatnonzero(self.place[cell] < 0)
        nodes = self.node_place[facet_nodes(skeleton, whole)]
        walls, wall_owner, edge = self._corners(self.table.walls, self.pattern, self.damaged)
        wall_cell = self.damaged[wall_owner]
        none, crack = np.full(len(whole), -1), np.full(len(walls), CRACK)
        return [
            (nodes, cell[whole], none, skeleton.origin[whole]),
            (corners, cell[of], np.full(len(of), -1), skeleton.origin[of]),
            (walls, wall_cell, skeleton.cell_edges[wall_cell, edge], crack),
        ]

    def _corners(self, elements: Elements, key: Ints, cell: Ints) -> tuple[Ints, Ints, Ints]:
        """Points of the elements of each key, the place of their key, and their local edge; `cell` (keys,) is damaged."""
        row, owner = elements.expand(key)
        local, of = elements.corners[row], cell[owner]
        copy = self.first[self.place[of]][:, None] + np.maximum(local, 0)
        node = self.skeleton.cells[of[:, None], np.maximum(-1 - local, 0)]
        numbers = self.number[copy] if len(self.number) else copy
        return np.where(local >= 0, numbers, self.node_place[node]), owner, elements.edge[row]

    def _fill(self) -> tuple[Ints, Ints]:
        if self.skeleton.dim == 3:
            return np.empty((0, 3), np.int64), np.empty(0, np.int64)
        whole = np.flatnonzero(self.place < 0)
        corners, owner, _ = self._corners(self.table.fill, self.pattern, self.damaged)
        triangles = np.concatenate([self.skeleton.cells[whole], corners])
        return triangles, np.concatenate([whole, self.damaged[owner]])


def facet_nodes(skeleton: Skeleton, which: Any = slice(None)) -> Ints:
    """(n, d) nodes of boundary facets, their normals outwards."""
    cell, facet = skeleton.boundary[which].T
    return skeleton.cells[cell[:, None], _outward(skeleton.dim)[facet]]


def _outward(dim: int) -> Ints:
    """(d + 1, d) local nodes of each facet; odd ones turned round (see meshes.topology.facets_of)."""
    from ..meshes.topology import facets_of

    return facets_of(np.arange(dim + 1)[None])[0]


def _facet_edges() -> Ints:
    """(4, 3) local edges of each facet of a tetrahedron."""
    from ..graph import local_edges

    return np.array([np.flatnonzero(np.all(local_edges(3) != facet, axis=1)) for facet in range(4)])


def _numbered(keys: Ints) -> tuple[Ints, Ints]:
    """Number of each key among the distinct ones, ascending; and one place where each distinct key stands, the first.

    Counting in place of sorting: the keys are dense.
    """
    used = np.zeros(int(keys.max(initial=-1)) + 1, bool)
    used[keys] = True
    number = np.cumsum(used)[keys] - 1
    one = np.empty(np.count_nonzero(used), np.int64)
    one[number[::-1]] = np.arange(len(keys))[::-1]
    return number, one


__all__ = ["BODY", "CRACK", "Split", "facet_nodes", "split"]
