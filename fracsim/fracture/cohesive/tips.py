"""Which cells a cohesive crack cuts next: those whose stress, of the softened body, reaches the strength.

Tips go first, each by a cell. A crack begins only where nothing grows or softens any more, and one at a time: in a bar
every place is at its strength at once, and all but one of them unload.

In the plane a tip goes across the greatest principal stress of

    s_nn n n + s_nt (n t + t n),    s the mean over 3 h,

t being the crack behind it: ahead of a tip the stress along t is nearly as large as that across it, and the greatest
principal stress of s itself may be either. By the mean alone a tip that has soft cells on one side waits too long (a
bar of six cells took 1.09 G_c), so that its own cell's stress counts as well.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..brittle.principal import largest, tensors
from ..criterion import Edges
from ..energy.branching import rotated, unit
from ..energy.seen import Seen
from ..energy.tips import APART, CrackTips, Proposal

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]

DIGITS = 4  # of stress over strength, by which the place where a crack begins is chosen: the rest is a solver's


class CohesiveTips(CrackTips):
    """Cells that cohesive cracks cut next.

    Attributes:
        begins: whether a crack may begin.
    """

    begins = False

    def __call__(self, stress: Values, psi: Values) -> tuple[Edges, Values]:
        """The edges that cracks cut now, as loaded as they may be (collective)."""
        assert self._stress.chi is not None
        self._carried = self._stress.chi.x.array[: len(stress), None] * stress
        return super().__call__(self._carried, psi)

    def _grown(self, seen: Seen) -> Proposal:
        """Tips that advance."""
        tips, d = seen.tips, self._domain.dim
        mean, own = seen.means(np.arange(len(tips))), tensors(self._carried[tips.cell], d)
        sigma = np.maximum(largest(mean), largest(own))
        rows = np.flatnonzero((sigma >= self._strength_of(tips.cell)) & ~self.barred[tips.cell])
        cells, mean, ahead = tips.cell[rows], mean[rows], tips.point[rows] - tips.behind[rows]
        turns = np.zeros(len(rows), bool)
        if d == 2:
            ahead, turns = across(mean, ahead), np.any(ahead, axis=1)
        rank = self._ranked(0, sigma[rows], tips.point[rows], APART[d] * self._h[cells])
        entry = np.argmax(~self._graph.intact(cells), axis=1)
        return Proposal(rank, cells, mean, entry, ahead, turns, np.zeros_like(turns))

    def _weak(self, stress: Values) -> Ints:
        """Whole cells where a crack may begin."""
        return super()._weak(stress) if self.begins else np.empty(0, np.int64)

    def _begun(self, weak: Ints, stress: Values) -> Proposal:
        """One that does, of all ranks; of those that are loaded alike by a hash (collective)."""
        found = super()._begun(weak, stress)
        load = np.round(-found.rank[:, 1] / self._strength_of(found.cells), DIGITS)
        rank = np.column_stack([-load, found.rank[:, 2:]])
        every = np.concatenate(self._domain.comm.allgather(rank))
        first = every[np.lexsort(every[:, ::-1].T)][:1]
        return found.taken((rank == first).all(axis=1))


def across(stress: Values, behind: Values) -> Values:
    """(n, 2) unit vectors whither cracks go under stress (n, 2, 2) that come along `behind` (n, 2); 0 stays."""
    t = unit(behind)
    n = rotated(t, np.pi / 2)
    normal, shear = (np.einsum("ni,nij,nj->n", n, stress, each) for each in (n, t))
    return rotated(t, -np.arctan2(2 * shear, np.maximum(normal, 0.0)) / 2)
