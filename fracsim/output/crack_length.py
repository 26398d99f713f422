"""How long cracks are and where their tip is: columns of history.csv where cracks say where they cut."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..fracture.edge_history import EdgeRecord
from ..fracture.initial_cracks import ends_in_order
from ..mesh.crack_planes import CrackPlane
from ..mesh.parallel import concatenate_over_ranks, sum_over_ranks
from ..meshes.text import AXES

Ints = npt.NDArray[np.integer]
Values = npt.NDArray[np.float64]
INSIDE = -1e-9  # least barycentric coordinate of a point in a cell
PAIRINGS = np.array([[0, 1, 2, 3], [0, 2, 1, 3], [0, 3, 1, 2]])  # of four corners in two diagonals


class CrackFront:
    """Length of the cracks in m (3D: area in m^2) and the place of their tip at rest, m.

    The tip is that of the crack that advanced last: where it came into a cell that holds together. Where it has run
    into a hole, out of the body or into another crack, the tip stays at the last place that it cut.

    A segment of the study ends where the study says, in a cell of which the side is cut where the crack comes in. Such
    a cell gives way as if it were cut half-way, so that cracks are as compliant as those of their length (within 0.1 h
    in the mean).

    Attributes:
        names: columns of history.csv.
    """

    def __init__(self, record: EdgeRecord, cracks: Sequence[CrackPlane] = ()) -> None:
        """`cracks`: those of the study, which were open at t = 0 (collective)."""
        graph = record.graph
        self._record, self._graph, self._domain = record, graph, graph.domain
        d = self._domain.dim
        self.names = ["crack_length" if d == 2 else "crack_area", *(f"tip_{axis}" for axis in AXES[:d])]
        self._ends = ends_in_order(graph)
        self._figures = np.array([0.0] + d * [np.nan])
        self._pattern = np.zeros_like(graph.pattern)  # at the last look
        self._size = np.zeros(len(self._pattern))  # of the cut through each cell
        self._asked: dict[int, Values] = {}  # ends of segments by the cells of this rank that they lie in
        for crack in cracks if d == 2 else ():
            for end in () if crack.corners is None else crack.corners:
                self._ask(end)
        self.look()

    def __call__(self) -> Values:
        """(1 + d,) as of the last look; nan where there has been no tip yet."""
        return self._figures

    def monitors(self) -> dict[str, list[float]]:
        """What a restart goes on from: the last tip, which stays once a crack has run through."""
        return {"tip": [float(each) for each in self._figures[1:]]}

    def restore(self, monitors: dict[str, list[float]]) -> None:
        """Go on from `monitors`."""
        self._figures[1:] = monitors["tip"]

    def look(self) -> None:
        """Edges have broken (collective)."""
        changed = np.flatnonzero(self._graph.pattern != self._pattern)
        if not sum_over_ranks(self._domain.comm, len(changed))[0]:
            return
        self._pattern = self._graph.pattern.copy()
        self._size[changed] = self._cut(changed)
        held = {cell: end for cell, end in self._asked.items() if not self._graph.split[cell]}
        size = self._size.sum() + sum(float(np.linalg.norm(end - self._entry(cell))) for cell, end in held.items())
        self._figures[0] = sum_over_ranks(self._domain.comm, float(size))[0]
        self._find_tip(held)

    def _find_tip(self, held: dict[int, Values]) -> None:
        """The tip of the crack that advanced last; `held`: ends that were asked for, by their cells (collective)."""
        comm, graph, at = self._domain.comm, self._graph, self._record.at
        newest = np.flatnonzero(at == comm.allreduce(float(np.fmax.reduce(at, initial=-np.inf)), MPI.MAX))
        cells = graph.edge_cells(newest)
        cells = cells[~graph.split[cells]]
        which, side = np.nonzero(np.isin(graph.cell_edges[cells], newest))
        leading = graph.cell_edges[cells][which, side]
        places = self._places(leading)
        for cell, end in held.items():
            places[cells[which] == cell] = end
        rows = concatenate_over_ranks(comm, np.column_stack([self._keys(leading), places]))
        away = np.zeros(len(rows))
        if not len(rows):
            rows = concatenate_over_ranks(comm, np.column_stack([self._keys(newest), self._places(newest)]))
            away = np.nan_to_num(np.linalg.norm(rows[:, 2:] - self._figures[1:], axis=1))
        if len(rows):
            self._figures[1:] = rows[np.lexsort([*rows.T[::-1], -away])[0], 2:]

    def _keys(self, edges: Ints) -> Values:
        """(n, 2) input nodes of edges."""
        return np.asarray(self._domain.node_input[self._ends[edges]], float)

    def _ask(self, end: Values) -> None:
        """A segment of the study ends there: in the cell that it comes into and that holds together (collective)."""
        graph = self._graph
        opened = self._record.at == 0
        cells = np.flatnonzero(opened[graph.cell_edges].sum(axis=1) == 1)
        corners = self._domain.nodes[graph.cell_nodes[cells]]
        sides = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
        inner = np.linalg.solve(sides, (end - corners[:, 0])[:, :, None])[:, :, 0]
        cells = cells[(inner.min(axis=1) > INSIDE) & (inner.sum(axis=1) < 1 - INSIDE)]
        found = [(float(np.linalg.norm(end - self._entry(k))), -int(self._domain.cell_input[k]), int(k)) for k in cells]
        farthest = max(found, default=(-1.0, 0, -1))
        first = max(self._domain.comm.allgather(farthest[:2]))
        if farthest[2] >= 0 and farthest[:2] == first:
            self._asked[farthest[2]] = end

    def _entry(self, cell: int) -> Values:
        """(d,) where a segment of the study comes into a cell."""
        edges = self._graph.cell_edges[cell]
        return self._places(edges[self._record.at[edges] == 0])[0]

    def _places(self, edges: Ints) -> Values:
        """(n, d) places of the cuts of broken edges, m."""
        cut = self._record.cut[edges]
        share = np.where(np.isnan(cut), 0.5, cut)[:, None]
        ends = self._domain.nodes[self._ends[edges]]
        return np.asarray(ends[:, 0] + share * (ends[:, 1] - ends[:, 0]))

    def _points(self, cells: npt.NDArray[np.integer]) -> Values:
        """(n, k, d) places of the cuts of all edges of cells, m; nan of whole ones."""
        edges = self._graph.cell_edges[cells]
        at = self._places(edges.reshape(-1)).reshape(*edges.shape, self._domain.dim)
        return np.where(self._graph.broken[edges][..., None], at, np.nan)

    def _cut(self, cells: npt.NDArray[np.integer]) -> Values:
        """(n,) length or area of the cuts through cells, 0 of those that hold together."""
        result, split = np.zeros(len(cells)), self._graph.split[cells]
        if self._domain.dim == 2:
            # to the middle of the cuts: two of them are a segment, three a branch
            points, broken = self._points(cells[split]), self._graph.broken[self._graph.cell_edges[cells[split]]]
            middle = np.where(broken[..., None], points, 0.0).sum(axis=1) / broken.sum(axis=1)[:, None]
            arms = np.sqrt(np.square(points - middle[:, None]).sum(axis=2))
            result[split] = np.where(broken, arms, 0.0).sum(axis=1)
            return result
        many = np.array([pattern.bit_count() for pattern in range(64)])[self._graph.pattern[cells]]
        for count, area in ((3, _triangles), (4, _quadrangles)):
            some = np.flatnonzero(split & (many == count))
            result[some] = area(self._corners(cells[some], count))
        return result

    def _corners(self, cells: npt.NDArray[np.integer], count: int) -> Values:
        """(n, count, d) places of the cuts of cells with so many."""
        points = self._points(cells)
        return points[~np.isnan(points[..., 0])].reshape(len(cells), count, points.shape[-1])


def _triangles(corners: Values) -> Values:
    """(n,) areas of (n, 3, 3)."""
    sides = corners[:, 1:] - corners[:, :1]
    return np.asarray(np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) / 2)


def _quadrangles(corners: Values) -> Values:
    """(n,) areas of flat convex ones (n, 4, 3) whose corners are in any order: the diagonals are the pairs that span
    most."""
    a, b, c, e = np.moveaxis(corners[:, PAIRINGS], 2, 0)
    return np.asarray(np.linalg.norm(np.cross(b - a, e - c), axis=2).max(axis=1, initial=0.0) / 2)
