"""Values of a distributed body on the parts of its mesh from which the split surface is built."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from ...fracture.edge_history import EdgeHistory
from ...mesh.domain import Domain
from ...mesh.ghost_exchange import with_ghosts
from ...mesh.parallel import gather
from ...mesh.split_surface.entity_numbering import EntityNumbering
from ...mesh.split_surface.mesh_part import MeshPart, RankCells, WholeMesh

Rows = npt.NDArray[Any]
Values = npt.NDArray[np.float64]


class PartValues(Protocol):
    """Values of the entities of the part that a rank has; None on ranks without a part."""

    @property
    def part(self) -> MeshPart | None:
        """Part of the mesh; None on ranks without one."""

    def of_nodes(self, values: Values) -> Values | None:
        """Rows (N, d) of the corners of cells, from values of the dofs that this rank owns (collective)."""

    def of_cells(self, values: Rows) -> Rows | None:
        """Rows (C, ...) of values (cells, ...) of the cells of this rank (collective)."""

    def of_drawn_cells(self, values: Rows, drawn: npt.NDArray[np.bool_]) -> Rows | None:
        """Rows (C, ...) as of_cells, right for cells with flags `drawn` (cells,) alone (collective)."""

    def of_broken_edges(self, history: EdgeHistory) -> tuple[Values, Values] | None:
        """Break times and cut positions (E,) of the edges, NaN for intact ones (collective)."""


class RankValues:
    """Values on the cells of each rank: nothing is gathered (PartValues)."""

    def __init__(self, domain: Domain) -> None:
        """Number the entities of the cells of this rank (collective)."""
        self._domain, self.part = domain, RankCells(domain)
        self._part_edges: npt.NDArray[np.int64] | None = None

    def of_nodes(self, values: Values) -> Values:
        """See PartValues."""
        d = self._domain.dim
        owned = np.asarray(values[: self._domain.node_count * d])
        return with_ghosts(self._domain, owned).reshape(-1, d)[self.part.nodes]

    def of_cells(self, values: Rows) -> Rows:
        """See PartValues."""
        return np.asarray(values[self.part.cells])

    def of_drawn_cells(self, values: Rows, drawn: npt.NDArray[np.bool_]) -> Rows:
        """See PartValues."""
        result = np.zeros_like(values)
        rows = np.flatnonzero(drawn[self.part.cells])
        result[rows] = values[self.part.cells[rows]]
        return result

    def of_broken_edges(self, history: EdgeHistory) -> tuple[Values, Values]:
        """See PartValues."""
        skeleton, broken = self.part.skeleton, np.flatnonzero(history.graph.broken)
        ends = self.part.part_node[history.graph.edge_nodes[broken]]
        # a rank may have ghost edges that none of its cells has
        in_part = np.flatnonzero((ends >= 0).all(axis=1))
        keys, rows = ends[in_part], broken[in_part]
        return (
            skeleton.edge_values(keys, history.break_times[rows]),
            skeleton.edge_values(keys, history.cut_positions[rows]),
        )


class GatheredValues:
    """Values of the whole body on rank 0 (PartValues)."""

    def __init__(self, domain: Domain) -> None:
        """Gather the mesh, where rank 0 does not have it (collective)."""
        self._domain, mesh = domain, domain.input_mesh
        self.part = None if mesh is None else WholeMesh(EntityNumbering(mesh))

    def of_nodes(self, values: Values) -> Values | None:
        """See PartValues."""
        rows, midside_nodes = values.reshape(-1, self._domain.dim), self._domain.midside_nodes
        gathered = self._domain.input_numbering.gather_nodes(rows)
        return gathered if gathered is None or midside_nodes is None else gathered[: midside_nodes.points]

    def of_cells(self, values: Rows) -> Rows | None:
        """See PartValues."""
        return self._domain.input_numbering.gather_cells(values)

    def of_drawn_cells(self, values: Rows, drawn: npt.NDArray[np.bool_]) -> Rows | None:
        """See PartValues."""
        rows = np.flatnonzero(drawn)
        parts = gather(self._domain.comm, (self._domain.input_numbering.cells[rows], values[rows]))
        if parts is None or self.part is None:
            return None
        result = np.zeros((len(self.part.cell_numbers), *values.shape[1:]), values.dtype)
        for cells, of_rank in parts:
            result[cells] = of_rank
        return result

    def of_broken_edges(self, history: EdgeHistory) -> tuple[Values, Values] | None:
        """See PartValues."""
        broken = history.gather_broken()
        if broken is None or self.part is None:
            return None
        edges, (times, cuts) = broken[0], broken[1].T
        return self.part.skeleton.edge_values(edges, times), self.part.skeleton.edge_values(edges, cuts)
