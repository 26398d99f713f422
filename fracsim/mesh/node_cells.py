"""How many cells of a kind nodes have around them, whichever ranks own these."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from dolfinx import la

from .domain import Domain

Values = npt.NDArray[np.float64]


class NodeCellCount:
    """Counts the cells around each node."""

    def __init__(self, domain: Domain) -> None:
        self._cell_nodes = domain.cell_nodes
        self._sum = la.vector(domain.space.dofmap.index_map, 1, np.float64)

    def __call__(self, flags: npt.NDArray[np.bool_]) -> Values:
        """(nodes,) how many of the flagged ones among the cells (cells,) of all ranks a node has, ghosts too
        (collective)."""
        self._sum.array[:] = 0.0
        np.add.at(self._sum.array, self._cell_nodes[flags], 1.0)
        self._sum.scatter_reverse(la.InsertMode.add)
        self._sum.scatter_forward()
        return np.asarray(self._sum.array.copy())
