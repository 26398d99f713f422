"""Cells that cracks cut: the geometry of the cuts on this rank, and a table of cut cells of all ranks.

Cut cells are few beside those of the body, and change only where cracks grow, so that every rank has all of them.
"""

from __future__ import annotations

from functools import cache, cached_property

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from scipy.spatial import cKDTree

from ...mesh.domain import Domain
from ...mesh.edge_graph import EdgeGraph
from ...mesh.parallel import allgather
from ...mesh.simplices import local_edges
from ..initial_cracks import edge_ends_in_input_order

Flags = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]

# Numbers that describe the cut polygon of a cell: four corners, and which of its sides count.
POLYGON_WIDTH = 16


@cache
def corner_partitions() -> tuple[Flags, Flags]:
    """Return the partitions (7, 4) of the corners of a tetrahedron in two sets, and the edges (7, 6) they cut."""
    sides = (np.arange(1, 8)[:, None] >> np.arange(4)) & 1 == 1
    first, second = local_edges(3).T
    return sides, sides[:, first] != sides[:, second]


@cache
def cut_polygons() -> tuple[Ints, Ints]:
    """Return the cut polygon of a tetrahedron for every pattern of cut edges.

    Returns:
        Local edges (64, 4) on which the corners of the polygon lie, in order around it, and the local facets (64, 4) in
        which the side after each corner lies. A triangle has its first corner twice; -1: the cell is not split.
    """
    corners, facets = np.full((64, 4), -1), np.full((64, 4), -1)
    first, second = local_edges(3).T
    number = {frozenset((int(a), int(b))): k for k, (a, b) in enumerate(zip(first, second, strict=True))}
    sides, cut = corner_partitions()
    for pattern in range(64):
        intact = (pattern >> np.arange(6)) & 1 == 0
        # A partition fits if it cuts no intact edge; a pattern without one does not split the cell.
        fits = np.flatnonzero(~cut[:, intact].any(axis=1))
        if not len(fits):
            continue
        side = sides[fits[0]]
        # The smaller set has one corner (triangle) or two (quadrilateral).
        smaller, larger = sorted(([k for k in range(4) if side[k] == flag] for flag in (True, False)), key=len)
        ring = [
            {smaller[0], larger[0]}, {smaller[0], larger[1]}, {smaller[-1], larger[-1]}, {smaller[-1], larger[0]},
        ]  # fmt: skip
        corners[pattern] = [number[frozenset(ends)] for ends in ring]
        # A side lies in the facet of the corners of both of its ends, that is opposite to the fourth corner.
        facets[pattern] = [
            min({0, 1, 2, 3} - ends - following) for ends, following in zip(ring, ring[1:] + ring[:1], strict=True)
        ]
    return corners, facets


class CutGeometry:
    """Positions of the cuts, and the polygons that cracks cut out of the cells of this rank."""

    def __init__(self, domain: Domain, graph: EdgeGraph) -> None:
        self._domain, self._graph = domain, graph
        self._ends = edge_ends_in_input_order(graph)

    def cut_points(self, edges: npt.NDArray[np.integer], cut: Values) -> Values:
        """Return the points (..., d), m, at which local edges (...) are cut.

        `cut` are the cut positions (edges,) of local edges; NaN stands for the middle.
        """
        share = np.where(np.isnan(cut[edges]), 0.5, cut[edges])
        ends = self._domain.nodes[self._ends[edges]]
        return np.asarray(ends[..., 0, :] + share[..., None] * (ends[..., 1, :] - ends[..., 0, :]))

    def mean_cut_points(self, cells: Ints, cut: Values) -> Values:
        """Return the mean (n, d), m, of the points at which cells (n,) are cut."""
        broken = ~self._graph.intact(cells)
        points = self.cut_points(self._graph.cell_edges[cells], cut)
        return np.asarray(np.einsum("nk,nki->ni", broken, points) / broken.sum(axis=1, keepdims=True))

    def polygon_rows(self, cells: Ints, cut: Values) -> Values:
        """Return polygons (n, POLYGON_WIDTH) of split cells: four corners, m, and 1 for each side inside the body."""
        corners, facets = (table[self._graph.pattern[cells]] for table in cut_polygons())
        edges = self._graph.cell_edges[cells[:, None], corners]
        inside = ~self._domain.facets.boundary_sides[cells[:, None], facets]
        return np.concatenate([self.cut_points(edges, cut).reshape(len(cells), 12), inside], axis=1)


class CutCells:
    """Table of the cells of all ranks with a broken edge, in the order of the input mesh."""

    def __init__(self, graph: EdgeGraph, geometry: CutGeometry, centroids: Values) -> None:
        """Start without cut cells; `centroids`: (cells, d) of the cells of this rank, m."""
        self._graph, self._geometry, self._centroids = graph, geometry, centroids
        self._pattern = np.zeros_like(graph.pattern)
        self._d = d = graph.domain.dim
        self._rows = np.empty((0, 2 + 2 * d + (POLYGON_WIDTH if d == 3 else 0)))

    @property
    def number(self) -> Ints:
        """(n,) numbers of the cells in the input mesh."""
        return np.asarray(self._rows[:, 0], np.int64)

    @property
    def split(self) -> npt.NDArray[np.bool_]:
        """(n,) whether cells are split."""
        return np.asarray(self._rows[:, 1] > 0)

    @property
    def centre(self) -> Values:
        """(n, d) centroids, m."""
        return self._rows[:, 2 : 2 + self._d]

    @property
    def cut_point(self) -> Values:
        """(n, d) means of the points at which cells are cut, m."""
        return self._rows[:, 2 + self._d : 2 + 2 * self._d]

    @property
    def polygon(self) -> Values:
        """(n, POLYGON_WIDTH) cut polygons of split cells; (n, 0) in 2D."""
        return self._rows[:, 2 + 2 * self._d :]

    @cached_property
    def tree(self) -> cKDTree:
        """Search tree of the centroids."""
        return cKDTree(self.centre)

    def has_changed(self) -> bool:
        """Return whether cells of any rank are cut differently than at the last update (collective)."""
        return bool(self._graph.domain.comm.allreduce(not np.array_equal(self._pattern, self._graph.pattern), MPI.LOR))

    def update_cells(self, cut: Values) -> tuple[Ints, Values]:
        """Update the table (collective).

        Args:
            cut: (edges,) cut positions of local edges.

        Returns:
            Numbers (n,) of the cells that changed, in the input mesh, and their centroids (n, d), m.
        """
        cells = np.flatnonzero(self._pattern != self._graph.pattern)
        self._pattern[cells] = self._graph.pattern[cells]
        rows = np.concatenate(allgather(self._graph.domain.comm, self._make_rows(cells, cut)))
        number = rows[:, 0].astype(np.int64)
        unchanged = self._rows[~np.isin(self.number, number)]
        table = np.concatenate([unchanged, rows[rows[:, 1] >= 0]])
        self._rows = table[np.argsort(table[:, 0], kind="stable")]
        # The cached search tree belongs to the old rows.
        self.__dict__.pop("tree", None)
        return number, rows[:, 2 : 2 + self._d]

    def _make_rows(self, cells: Ints, cut: Values) -> Values:
        """Return the rows of cells of this rank; -1 for `split` marks a cell without a broken edge."""
        graph, d = self._graph, self._d
        split = np.where(graph.pattern[cells] > 0, graph.split[cells].astype(float), -1.0)
        rows = np.zeros((len(cells), self._rows.shape[1]))
        rows[:, 0], rows[:, 1], rows[:, 2 : 2 + d] = (
            graph.domain.input_numbering.cells[cells],
            split,
            self._centroids[cells],
        )
        is_cut = np.flatnonzero(split >= 0)
        rows[is_cut, 2 + d : 2 + 2 * d] = self._geometry.mean_cut_points(cells[is_cut], cut)
        if d == 3:
            is_split = np.flatnonzero(split > 0)
            rows[is_split, 2 + 2 * d :] = self._geometry.polygon_rows(cells[is_split], cut)
        return rows
