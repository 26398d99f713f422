"""Values of a distributed body on the parts of its mesh from which the split surface is built."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ...fracture.edge_history import EdgeHistory
from ...mesh.domain import Domain
from ...mesh.ghost_exchange import with_ghosts
from ...mesh.split_surface.mesh_part import RankCells

Rows = npt.NDArray[Any]
Values = npt.NDArray[np.float64]


class RankValues:
    """Values on the entities of the cells of this rank; nothing is gathered.

    Attributes:
        part: these cells.
    """

    def __init__(self, domain: Domain) -> None:
        """Number the entities of the cells of this rank (collective)."""
        self._domain, self.part = domain, RankCells(domain)

    def of_nodes(self, values: Values) -> Values:
        """Rows (N, d) of the corners of cells, from values of the dofs that this rank owns (collective)."""
        d = self._domain.dim
        owned = np.asarray(values[: self._domain.node_count * d])
        return with_ghosts(self._domain, owned).reshape(-1, d)[self.part.nodes]

    def of_cells(self, values: Rows) -> Rows:
        """Rows (C, ...) of values (cells, ...) of the cells of this rank."""
        return np.asarray(values[self.part.cells])

    def of_drawn_cells(self, values: Rows, drawn: npt.NDArray[np.bool_]) -> Rows:
        """Rows (C, ...) as of_cells, right for cells with flags `drawn` (cells,) alone."""
        result = np.zeros_like(values)
        rows = np.flatnonzero(drawn[self.part.cells])
        result[rows] = values[self.part.cells[rows]]
        return result

    def of_broken_edges(self, history: EdgeHistory) -> tuple[Values, Values]:
        """Break times and cut positions (E,) of the edges, NaN for intact ones."""
        skeleton, broken = self.part.skeleton, np.flatnonzero(history.graph.broken)
        ends = self.part.part_node[history.graph.edge_nodes[broken]]
        # a rank may have ghost edges that none of its cells has
        in_part = np.flatnonzero((ends >= 0).all(axis=1))
        keys, rows = ends[in_part], broken[in_part]
        return (
            skeleton.edge_values(keys, history.break_times[rows]),
            skeleton.edge_values(keys, history.cut_positions[rows]),
        )
