"""Length or area of the cracks and position of their tip: columns of history.csv in studies with defined cuts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from ..fracture.edge_history import EdgeHistory
from ..fracture.initial_cracks import edge_ends_in_input_order
from ..mesh.crack_planes import CrackPlane
from ..mesh.parallel import concatenate_over_ranks, sum_over_ranks
from ..meshes.data import AXES

Ints = npt.NDArray[np.integer]
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class CrackTable:
    """Cut cells of all ranks, and the cracks that they belong to.

    Attributes:
        cell: (n,) numbers in the input mesh, ascending.
        crack: (n,) number of the crack: cut cells that share broken edges.
        size: (n,) length of that crack, m, in 3D its area, m^2.
    """

    cell: Ints
    crack: Ints
    size: Values

    def find(self, cells: Ints) -> tuple[Ints, Values]:
        """Return the crack (m,) of cells (m,), -1 for one that is not cut, and its size (m,), there 0."""
        row = np.minimum(np.searchsorted(self.cell, cells), len(self.cell) - 1)
        is_cut = self.cell[row] == cells if len(self.cell) else np.zeros(len(cells), bool)
        crack, size = np.full(len(cells), -1), np.zeros(len(cells))
        crack[is_cut], size[is_cut] = self.crack[row[is_cut]], self.size[row[is_cut]]
        return crack, size


class CrackExtent:
    """Length of all cracks in m (3D: area in m^2) and reference position of the tip, m.

    The tip is that of the crack that advanced last: the point at which the crack entered a cell that is not split. If
    that crack has reached a hole, the boundary or another crack, the tip stays at the last cut.

    A crack segment of the study ends at its given end point. The segment cuts one edge of the cell that contains that
    point. Such a cell is as compliant as if it were cut half-way, so that the compliance of cracks is that of their
    length (within 0.1 h in the mean).

    Attributes:
        columns: names of the columns of history.csv.
        values: (1 + d,) length or area and tip, as of the last update; NaN while there is no tip.
    """

    def __init__(self, record: EdgeHistory, cracks: Sequence[CrackPlane] = ()) -> None:
        """Measure the initial cracks (collective).

        Args:
            record: history of broken edges, with the positions of their cuts.
            cracks: cracks of the study, open at t = 0.
        """
        graph = record.graph
        self._record, self._graph, self._domain = record, graph, graph.domain
        d = self._domain.dim
        self.columns = ["crack_length" if d == 2 else "crack_area", *(f"tip_{axis}" for axis in AXES[:d])]
        self._edge_ends = edge_ends_in_input_order(graph)
        self.values = np.array([0.0] + d * [np.nan])
        # broken edges of each cell at the last update
        self._pattern = np.zeros_like(graph.pattern)
        # length or area of the cut through each cell
        self._cut_size = np.zeros(len(self._pattern))
        # local cell -> end point of a segment of the study in it
        self._segment_ends: dict[int, Values] = {}
        for crack in cracks if d == 2 else ():
            for end in () if crack.corners is None else crack.corners:
                self._locate_segment_end(end)
        self.update()

    @property
    def comm(self) -> MPI.Comm:
        """Ranks of the body."""
        return self._domain.comm

    @property
    def dim(self) -> int:
        """Dimension of the body, 2 or 3."""
        return self._domain.dim

    def gather_cracks(self) -> CrackTable | None:
        """Return the cut cells and their cracks on rank 0, None elsewhere (collective)."""
        graph, cells = self._graph, np.flatnonzero(self._pattern)
        size = self._cut_size.copy()
        for cell, end in self._segment_ends.items():
            if not graph.split[cell]:
                size[cell] += np.linalg.norm(end - self._segment_entry(cell))
        row, side = np.nonzero(graph.broken[graph.cell_edges[cells]])
        keys = graph.keys.of_edges(graph.cell_edges[cells][row, side].astype(np.int64))
        parts = self.comm.gather((self._domain.input_numbering.cells[cells][row], size[cells][row], keys))
        if parts is None:
            return None
        of_side, size_of_side, edges = (np.concatenate(part) for part in zip(*parts, strict=True))
        number, first, member = np.unique(of_side, return_index=True, return_inverse=True)
        edge = np.unique(edges, axis=0, return_inverse=True)[1].reshape(-1)
        # Cells and edges are the nodes of a graph, whose parts are the cracks.
        count = len(number) + len(edges)
        links = coo_array((np.ones(len(edge)), (member, len(number) + edge)), (count, count))
        crack = connected_components(links, directed=False)[1][: len(number)]
        return CrackTable(number, crack, np.bincount(crack, size_of_side[first])[crack])

    def to_checkpoint(self) -> dict[str, list[float]]:
        """Values for `from_checkpoint`: the last tip, which stays once a crack has crossed the body."""
        return {"tip": [float(coordinate) for coordinate in self.values[1:]]}

    def from_checkpoint(self, monitors: dict[str, list[float]]) -> None:
        """Restore the values of `to_checkpoint`."""
        self.values[1:] = monitors["tip"]

    def update(self) -> None:
        """Update length and tip after edges have broken (collective)."""
        changed = np.flatnonzero(self._graph.pattern != self._pattern)
        if not sum_over_ranks(self._domain.comm, len(changed))[0]:
            return
        self._pattern = self._graph.pattern.copy()
        self._cut_size[changed] = self._cut_sizes(changed)
        unsplit = {cell: end for cell, end in self._segment_ends.items() if not self._graph.split[cell]}
        lengths = (float(np.linalg.norm(end - self._segment_entry(cell))) for cell, end in unsplit.items())
        size = self._cut_size.sum() + sum(lengths)
        self.values[0] = sum_over_ranks(self._domain.comm, float(size))[0]
        self._find_tip(unsplit)

    def _find_tip(self, segment_ends: dict[int, Values]) -> None:
        """Find the tip of the crack that advanced last (collective).

        Args:
            segment_ends: local cell that is not split -> end point of a segment of the study in it, (d,) in m.
        """
        comm, graph, broken_at = self._domain.comm, self._graph, self._record.break_times
        latest = comm.allreduce(float(np.fmax.reduce(broken_at, initial=-np.inf)), MPI.MAX)
        newest = np.flatnonzero(broken_at == latest)
        cells = graph.edge_cells(newest)
        cells = cells[~graph.split[cells]]
        row, side = np.nonzero(np.isin(graph.cell_edges[cells], newest))
        leading = graph.cell_edges[cells][row, side]
        cuts = self._cut_points(leading)
        for cell, end in segment_ends.items():
            cuts[cells[row] == cell] = end
        candidates = concatenate_over_ranks(comm, np.column_stack([self._input_nodes(leading), cuts]))
        distance = np.zeros(len(candidates))
        if not len(candidates):
            # all cells at the newest cuts are split: the tip is the cut farthest from the previous tip
            candidates = concatenate_over_ranks(
                comm, np.column_stack([self._input_nodes(newest), self._cut_points(newest)])
            )
            distance = np.nan_to_num(np.linalg.norm(candidates[:, 2:] - self.values[1:], axis=1))
        if len(candidates):
            # ties go by the input nodes of the edge, so that the tip does not depend on the partition
            self.values[1:] = candidates[np.lexsort([*candidates.T[::-1], -distance])[0], 2:]

    def _input_nodes(self, edges: Ints) -> Values:
        """Input nodes (n, 2) of edges."""
        return np.asarray(self._domain.input_numbering.nodes[self._edge_ends[edges]], float)

    def _locate_segment_end(self, end: Values) -> None:
        """Find the cell, not split, in which a segment of the study ends at the point `end` (d,) in m (collective)."""
        graph = self._graph
        initially_open = self._record.break_times == 0
        cells = np.flatnonzero(initially_open[graph.cell_edges].sum(axis=1) == 1)
        corners = self._domain.nodes[graph.cell_nodes[cells]]
        sides = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
        barycentric = np.linalg.solve(sides, (end - corners[:, 0])[:, :, None])[:, :, 0]
        # points outside by round-off count as inside
        cells = cells[(barycentric.min(axis=1) > -1e-9) & (barycentric.sum(axis=1) < 1 + 1e-9)]
        candidates = [
            (
                float(np.linalg.norm(end - self._segment_entry(cell))),
                -int(self._domain.input_numbering.cells[cell]),
                int(cell),
            )
            for cell in cells
        ]
        farthest = max(candidates, default=(-1.0, 0, -1))
        farthest_of_all = max(self._domain.comm.allgather(farthest[:2]))
        if farthest[2] >= 0 and farthest[:2] == farthest_of_all:
            self._segment_ends[farthest[2]] = end

    def _segment_entry(self, cell: int) -> Values:
        """Point (d,) at which a segment of the study enters a cell, m."""
        edges = self._graph.cell_edges[cell]
        return self._cut_points(edges[self._record.break_times[edges] == 0])[0]

    def _cut_points(self, edges: Ints) -> Values:
        """Positions (n, d) of the cuts of broken edges, m; the middle if the position is unknown."""
        cut = self._record.cut_positions[edges]
        share = np.where(np.isnan(cut), 0.5, cut)[:, None]
        ends = self._domain.nodes[self._edge_ends[edges]]
        return np.asarray(ends[:, 0] + share * (ends[:, 1] - ends[:, 0]))

    def _cell_cut_points(self, cells: Ints) -> Values:
        """Positions (n, k, d) of the cuts of all edges of cells, m; NaN for intact edges."""
        edges = self._graph.cell_edges[cells]
        cuts = self._cut_points(edges.reshape(-1)).reshape(*edges.shape, self._domain.dim)
        return np.where(self._graph.broken[edges][..., None], cuts, np.nan)

    def _cut_sizes(self, cells: Ints) -> Values:
        """Lengths or areas (n,) of the cuts through cells; 0 for cells that are not split."""
        result, split = np.zeros(len(cells)), self._graph.split[cells]
        if self._domain.dim == 2:
            # arms from the centroid of the cuts: two cuts make a segment, three a branch
            points, broken = (
                self._cell_cut_points(cells[split]),
                self._graph.broken[self._graph.cell_edges[cells[split]]],
            )
            centre = np.where(broken[..., None], points, 0.0).sum(axis=1) / broken.sum(axis=1)[:, None]
            arms = np.sqrt(np.square(points - centre[:, None]).sum(axis=2))
            result[split] = np.where(broken, arms, 0.0).sum(axis=1)
            return result
        broken_edges = np.array([pattern.bit_count() for pattern in range(64)])[self._graph.pattern[cells]]
        for count, area in ((3, _triangle_areas), (4, _quadrilateral_areas)):
            chosen = np.flatnonzero(split & (broken_edges == count))
            result[chosen] = area(self._cut_corners(cells[chosen], count))
        return result

    def _cut_corners(self, cells: Ints, count: int) -> Values:
        """Positions (n, count, d) of the cuts of cells with `count` broken edges, m."""
        points = self._cell_cut_points(cells)
        return points[~np.isnan(points[..., 0])].reshape(len(cells), count, points.shape[-1])


def _triangle_areas(corners: Values) -> Values:
    """Areas (n,) of triangles with corners (n, 3, 3), m^2."""
    sides = corners[:, 1:] - corners[:, :1]
    return np.asarray(np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) / 2)


def _quadrilateral_areas(corners: Values) -> Values:
    """Areas (n,) of plane convex quadrilaterals with corners (n, 4, 3) in any order, m^2.

    The area is half the norm of the cross product of the diagonals, the pairing for which that is largest.
    """
    # the three pairings of four corners as two diagonals
    pairs = np.array([[0, 1, 2, 3], [0, 2, 1, 3], [0, 3, 1, 2]])
    a, b, c, e = np.moveaxis(corners[:, pairs], 2, 0)
    return np.asarray(np.linalg.norm(np.cross(b - a, e - c), axis=2).max(axis=1, initial=0.0) / 2)
