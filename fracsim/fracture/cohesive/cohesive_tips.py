"""Which cells a cohesive crack cuts next: those whose stress, of the softened body, reaches the strength.

Tips go first, each by a cell. A crack begins only where nothing grows or softens any more, and one at a time: in a bar
every place is at its strength at once, and all but one of them unload.

A tip goes across the greatest principal stress of s - (t . s t) t t, s being the mean over 3 h and t the way that the
crack has come: ahead of a tip the stress along t is nearly as large as that across it, and the greatest principal
stress of s itself may be either (a beam's crack lay down above its middle). By the mean alone a tip that has soft cells
on one side waits too long (a bar of six cells took 1.09 G_c), and at an inner corner a crack begins too late (at 9.7 kN
in a panel of 25 mm tetrahedra), so that the cell's own stress counts as well: what it carries is bounded all the same.

In space cells beside a crack are cut as well, where they share an edge with it: those that no front is near, whose disc
the crack goes through, stay (a bar took 1.2 G_c, and takes 1.03).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ...mesh.parallel import allgather
from ..brittle.principal_stress import largest, tensors
from ..criterion import Edges
from ..energy.branching import unit
from ..energy.crack_front import LEAST
from ..energy.tip_criterion import APART, CrackTips, Proposal
from ..energy.tip_fields import Seen

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]

DIGITS = 4  # of stress over strength, by which the place where a crack begins is chosen: the rest is a solver's


class CohesiveTips(CrackTips):
    """Cells that cohesive cracks cut next.

    Attributes:
        begins: whether a crack may begin.
    """

    begins, onwards = False, False

    def __call__(self, stress: Values, psi: Values) -> tuple[Edges, Values]:
        """The edges that cracks cut now, as loaded as they may be (collective)."""
        assert self._stress.chi is not None
        self._carried = self._stress.chi.x.array[: len(stress), None] * stress
        return super().__call__(self._carried, psi)

    def _grown(self, seen: Seen) -> Proposal:
        """Tips that advance."""
        tips = seen.tips
        mean = seen.means(np.arange(len(tips)))
        sigma = self._greatest(mean, tips.cell)
        loaded = sigma >= self._strength_of(tips.cell)
        if self._domain.dim == 3:
            loaded &= ~(tips.mature & (np.linalg.norm(tips.ahead, axis=1) <= LEAST * seen.disc))
        rows = np.flatnonzero(loaded & ~self.barred[tips.cell])
        cells, ahead, no = tips.cell[rows], tips.point[rows] - tips.behind[rows], np.zeros(len(rows), bool)
        rank = self._ranked(
            0, sigma[rows], self._numbers(cells), tips.point[rows], APART[self._domain.dim] * self._h[cells]
        )
        entry = np.argmax(~self._graph.intact(cells), axis=1)
        return Proposal(rank, cells, without(mean[rows], ahead), entry, ahead, no, no)

    def _weak(self, stress: Values) -> Ints:
        """Whole cells where a crack may begin."""
        return super()._weak(stress) if self.begins else np.empty(0, np.int64)

    def _begun(self, weak: Ints, stress: Values) -> Proposal:
        """One that does, of all ranks: the one loaded most, of those that are loaded alike by a hash (collective)."""
        mean = self.sight.means_at(weak, stress)
        load = np.round(self._greatest(mean, weak) / self._strength_of(weak), DIGITS)
        centres = self.sight.centres[weak]
        rank = self._ranked(1, load, centres, centres, self._h[weak])
        every = np.concatenate(allgather(self._domain.comm, rank[load >= 1]))
        first = every[np.lexsort(every[:, 2::-1].T)][:1]
        chosen = (rank == first).all(axis=1) if len(first) else np.zeros(len(weak), bool)
        return Proposal(rank[chosen], weak[chosen], mean[chosen])

    def _greatest(self, mean: Values, cells: Ints) -> Values:
        """(n,) first principal stress of cells (n,) or of the mean (n, d, d) around them, whichever is more, Pa."""
        return np.maximum(largest(mean), largest(tensors(self._carried[cells], self._domain.dim)))


def without(stress: Values, along: Values) -> Values:
    """(n, d, d) stress (n, d, d) less what acts along vectors (n, d) of any length, none of it where they are 0."""
    t = unit(along)
    return np.asarray(stress - np.einsum("ni,nij,nj,nk,nl->nkl", t, stress, t, t, t))
