"""A pass of cohesive cracks: cells are cut, soften as they open, and their edges break once they carry nothing."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ...mechanics.stress import Stress
from ...mesh.edge_graph import EdgeGraph
from ...mesh.parallel import sum_over_ranks
from ..degradation import Lost
from ..fracture_pass import Breaking, PassResult
from .cohesive_tips import CohesiveTips
from .softening import Softening

Values = npt.NDArray[np.float64]

HELD = 0.5  # integrity of an edge that is cut and not broken


class CohesiveBreaking(Breaking):
    """Cuts cells, softens those that are cut, and breaks what lets go.

    Two patterns of the same edges: those that are broken part the body, and in those that are cut tips see their crack.

    Attributes:
        cuts: the edges that are cut, as if they were broken.    softening: chi of the cells that are cut.
    """

    def __init__(
        self, stress: Stress, graph: EdgeGraph, cuts: EdgeGraph, tips: CohesiveTips, softening: Softening, *,
        max_passes: int | None = None, opened: Values | None = None,
    ) -> None:  # fmt: skip
        self.cuts, self._tips, self.softening = cuts, tips, softening
        super().__init__(stress, graph, tips, max_passes=max_passes, opened=opened)
        self._follow()

    def __call__(self) -> PassResult:
        """One pass on the current displacement, until a cell softens (collective)."""
        stress, psi = self.evaluate()
        lost = self._grown(stress, psi)
        if not self._softer(lost) and self._cut(stress, psi, begins=True):
            lost = self._grown(stress, psi)
        broken = 0
        if sum_over_ranks(self.graph.domain.comm, int(lost.died))[0]:
            broken = self.graph.break_edges(self.softening.let_go())
            if broken:
                broken += self.graph.break_unloaded_edges()
        if broken or lost.loss:
            self.changed()
        return PassResult(broken, lost.loss, lost.released, lost.elastic, lost.died)

    def _grown(self, stress: Values, psi: Values) -> Lost:
        """Tips advance until one of the cells that are cut softens, or none advances (collective)."""
        while True:
            lost = self.softening(stress, psi)
            if self._softer(lost) or not self._cut(stress, psi, begins=False):
                return lost

    def _softer(self, lost: Lost) -> bool:
        """Whether cells of any rank lost anything (collective)."""
        return bool(self.graph.domain.comm.allreduce(lost.loss, op=MPI.MAX) > 0)

    def _cut(self, stress: Values, psi: Values, *, begins: bool) -> bool:
        """Cut what comes next; whether there is any (collective)."""
        self._tips.begins = begins
        edges, _ = self.criterion(stress, psi)
        flags = np.zeros(len(self.cuts.broken), bool)
        flags[edges] = True
        if not self.cuts.break_edges(flags):
            return False
        self.graph.weaken(np.where(self.cuts.broken, HELD, 1.0))
        self.changed()
        return True

    # --- what it remembers ---

    def damage_restored(self) -> None:
        """Edges and chi were read from a checkpoint: cuts follow."""
        self._follow()
        super().damage_restored()

    def restore(self, saved: object) -> bool:
        """Be damaged as `memory` says; whether that is anything else than now."""
        differs = super().restore(saved)
        if differs:
            self._follow()
        return differs

    def _follow(self) -> None:
        """Cut edges are those that tips know the place of."""
        self.cuts.set_integrity(np.where(np.isnan(self._tips.cut), 1.0, 0.0))
