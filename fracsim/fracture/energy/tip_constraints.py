"""Tips that would cut a node off stay where they are: a crack that takes an energy leaves no crumb.

A node that is left without a whole cell stays joined by an edge (fracture.node_retention). Where a cut itself would
break the last edge that can join it, the cell is not cut: what it holds is that node and nothing else, so it carries
the node's inertia alone, has no energy to release, and parts no body from another. A cell is cut as its crack goes or
not at all: an edge spared of a cut would leave a tip inside the crack, where the energy released is that of its
neighbours.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ...mesh.edge_graph import EdgeGraph
from ...mesh.parallel import sum_over_ranks
from ..criterion import Edges
from ..node_retention import Joining
from .tip_criterion import CrackTips

Values = npt.NDArray[np.float64]


class JoinedTips:
    """Crack tips without those that would leave a node to itself."""

    def __init__(self, tips: CrackTips, graph: EdgeGraph, joining: Joining) -> None:
        self._tips, self._graph, self._joining = tips, graph, joining

    @property
    def cut(self) -> Values:
        """(edges,) where cracks cut local edges."""
        return self._tips.cut

    @property
    def carried(self) -> Values | None:
        """(edges, n) of tips that run."""
        return self._tips.carried

    def __call__(self, stress: Values, psi: Values) -> tuple[Edges, Values]:
        """The edges that cracks cut now, none of them one that has to join (collective)."""
        graph, barred = self._graph, self._tips.barred
        barred[:] = False  # found again each time: a restart knows as much
        while True:
            edges, load = self._tips(stress, psi)
            spared = np.zeros(len(graph.broken), bool)
            spared[edges[~self._joining(edges, stress)]] = True
            cells = self._tips.cells
            stuck = cells[spared[graph.cell_edges[cells]].any(axis=1)]
            if not sum_over_ranks(graph.domain.comm, len(stuck))[0]:
                return edges, load
            barred[stuck] = True
            self._tips.cut[edges] = np.nan

    def moving(self, v: Values, a: Values, now: float, dt: float) -> None:
        """The body moves so: (owned dofs,) in m/s and m/s^2, at the end of a step of dt, s."""
        self._tips.moving(v, a, now, dt)

    def memory(self) -> object:
        """Where cracks cut."""
        return self._tips.memory()

    def recall(self, memory: object) -> None:
        """No more cuts than that."""
        self._tips.recall(memory)
