"""One pass of averaging over neighbouring cells: B07's guard against cracks that follow the mesh (sec. 7.1).

    <s>_c = sum over the nodes n of c of  sum_{k around n} V_k s_k  /  the same sum of V_k

so that a neighbour counts with its volume, once for each node that it shares with the cell, and the cell itself d + 1
times. Nothing is averaged across a gap: bodies that share no node do not know of one another.

Equations: docs/theory.md#edge-criterion.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from dolfinx import la

from ..mesh.domain import Domain

Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]


class NeighbourAverage:
    """The average of a mesh: an Average of fracture.criterion; it keeps nothing but the mesh."""

    def __init__(self, domain: Domain) -> None:
        self._domain = domain

    def __call__(self, values: Values, active: Flags | None = None) -> Values:
        """Averages (cells, n) of cell values (cells, n); cells not `active` enter none. 0 where none is left
        (collective)."""
        volume = self._domain.volumes if active is None else np.where(active, self._domain.volumes, 0.0)
        sums = self._around(np.column_stack([volume[:, None] * values, volume]))
        return np.asarray(sums[:, :-1] / np.where(sums[:, -1:] > 0, sums[:, -1:], 1.0))

    def reaching(
        self, values: Values, size: Values, bound: float, active: Flags | None = None
    ) -> tuple[npt.NDArray[np.int64], Values]:
        """Cells (m,) whose average may reach a bound, and those averages (m, n); `size` (cells,) bounds what any cell
        brings in (collective)."""
        cells = np.flatnonzero(self(size[:, None], active)[:, 0] >= bound * (1 - 1e-12))
        return cells, self(values, active)[cells]

    def reaching_among(
        self, cells: Ints, values: Values, size: Values, bound: float, active: Flags
    ) -> tuple[Ints, Values]:
        """`reaching` of some cells (k,), of which those `active` (cells,) alone enter, at their cost (one rank)."""
        corners = np.unique(self._domain.cell_nodes[cells], return_inverse=True)[1].reshape(len(cells), -1)
        volume = np.where(active[cells], self._domain.volumes[cells], 0.0)

        def around(each: Values) -> Values:
            at_nodes = np.bincount(corners.ravel(), np.repeat(volume * each, corners.shape[1]))
            return np.asarray(sum(at_nodes[column] for column in corners.T))

        whole = around(np.ones(len(cells)))
        whole[whole <= 0] = 1.0
        near = np.flatnonzero(around(size[cells]) / whole >= bound * (1 - 1e-12)) if len(cells) else cells
        if not len(near):
            return cells[near], values[cells[near]]
        means = np.stack([around(column)[near] for column in values[cells].T], axis=1)
        return cells[near], means / whole[near, None]

    def _around(self, values: Values) -> Values:
        """(cells, n) sums over the nodes of each cell of the sums over the cells around these."""
        nodes, n = self._domain.cell_nodes, values.shape[1]
        at_nodes = la.vector(self._domain.space.dofmap.index_map, n, np.float64)
        table = at_nodes.array.reshape(-1, n)
        for column, each in zip(table.T, values.T, strict=True):
            column += np.bincount(nodes.ravel(), np.repeat(each, nodes.shape[1]), minlength=len(table))
        at_nodes.scatter_reverse(la.InsertMode.add)
        at_nodes.scatter_forward()
        return np.asarray(table[nodes].sum(axis=1))
