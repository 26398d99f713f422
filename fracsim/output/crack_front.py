"""How long cracks are and where their tip is: columns of history.csv where cracks say where they cut."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..fracture.cracks import ends_in_order
from ..fracture.record import EdgeRecord
from ..mesh.ranks import joined, total
from ..meshes.words import AXES

Values = npt.NDArray[np.float64]
PAIRINGS = np.array([[0, 1, 2, 3], [0, 2, 1, 3], [0, 3, 1, 2]])  # of four corners in two diagonals


class CrackFront:
    """Length of the cracks in m (3D: area in m^2) and the place of their tip at rest, m.

    Attributes:
        names: columns of history.csv.
    """

    def __init__(self, record: EdgeRecord) -> None:
        graph = record.graph
        self._record, self._graph, self._domain = record, graph, graph.domain
        d = self._domain.dim
        self.names = ["crack_length" if d == 2 else "crack_area", *(f"tip_{axis}" for axis in AXES[:d])]
        self._ends = ends_in_order(graph)
        self._figures = np.full(1 + d, np.nan)
        self._pattern = np.zeros_like(graph.pattern)  # at the last look
        self._size = np.zeros(len(self._pattern))  # of the cut through each cell
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
        self._pattern = self._graph.pattern.copy()
        self._size[changed] = self._cut(changed)
        self._figures[0] = total(self._domain.comm, float(self._size.sum()))[0]
        tips = joined(self._domain.comm, self._tips())
        if len(tips):  # a crack that has run through has none: its last one stays
            first = np.lexsort([tips[:, 2], tips[:, 1], -tips[:, 0]])[0]
            self._figures[1:] = tips[first, 3:]

    def _points(self, cells: npt.NDArray[np.integer]) -> Values:
        """(n, k, d) places of the cuts of all edges of cells, m; nan of whole ones."""
        edges = self._graph.cell_edges[cells]
        share = np.where(np.isnan(self._record.cut[edges]), 0.5, self._record.cut[edges])[..., None]
        ends = self._domain.nodes[self._ends[edges]]
        at = ends[:, :, 0] + share * (ends[:, :, 1] - ends[:, :, 0])
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

    def _tips(self) -> Values:
        """(n, 3 + d) of this rank's cells that cracks have come into last and not left: when, which edge (two input
        nodes), and where, m."""
        graph, at = self._graph, self._record.at
        newest = at == np.fmax.reduce(at, initial=-np.inf)  # NaN: whole ones
        cells, entry = self._entered(graph.cells_at(np.flatnonzero(newest)))
        if not newest[graph.cell_edges[cells, entry]].any():  # what broke last led nowhere
            cells, entry = self._entered(np.flatnonzero((graph.pattern > 0) & ~graph.split))
        edges = graph.cell_edges[cells, entry]
        keys = self._domain.node_input[self._ends[edges]]
        return np.column_stack([at[edges], keys, self._points(cells)[np.arange(len(cells)), entry]])

    def _entered(self, cells: npt.NDArray[np.integer]) -> tuple[npt.NDArray[np.integer], npt.NDArray[np.integer]]:
        """Of cells with broken edges those that hold together and were entered last, and by which local edge."""
        graph, at = self._graph, self._record.at
        cells = cells[~graph.split[cells]]
        entry = np.argmin(graph.intact(cells), axis=1)
        when = at[graph.cell_edges[cells, entry]]
        last = when == np.max(when, initial=-np.inf)
        return cells[last], entry[last]


def _triangles(corners: Values) -> Values:
    """(n,) areas of (n, 3, 3)."""
    sides = corners[:, 1:] - corners[:, :1]
    return np.asarray(np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) / 2)


def _quadrangles(corners: Values) -> Values:
    """(n,) areas of flat convex ones (n, 4, 3) whose corners are in any order: the diagonals are the pairs that span
    most."""
    a, b, c, e = np.moveaxis(corners[:, PAIRINGS], 2, 0)
    return np.asarray(np.linalg.norm(np.cross(b - a, e - c), axis=2).max(axis=1, initial=0.0) / 2)
