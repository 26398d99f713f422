"""When the preconditioner is made anew, and of what kind.

It is kept from tangent to tangent: making multigrid's coarse spaces costs more than the rest of a Newton iteration. It
is made anew where CG takes a third more iterations than when it was fresh, or the tangent has given up entries of dead
cells (mechanics.tangent), and refreshed (new coarse operators and smoothers on the same coarse spaces) after edges
broke.

Where a body comes apart, cells hang from it by a node or an edge and turn there against nothing but their inertia.
Smoothed aggregation with Jacobi's smoother needs three times the iterations then, and a set-up that a few broken edges
spoil. Aggregates without smoothing cost a fifth of the set-up, and a sweep of SSOR deals with what hangs: 18 iterations
where the whole body took 9 and the cut one 27 (33,000 tetrahedra, 10 planes), a step in 0.85 of the time; after 100
planes 0.7.
"""

from __future__ import annotations

from enum import IntEnum

from petsc4py import PETSc

from .petsc_options import Options, OptionSet

MULTIGRID: Options = {
    "pc_type": "gamg",
    "pc_gamg_reuse_interpolation": True,
    "mg_levels_ksp_type": "chebyshev",
    "mg_levels_ksp_max_it": 2,
    "mg_levels_pc_type": "jacobi",
}
OF_PIECES: Options = {
    "pc_gamg_agg_nsmooths": 0,
    "mg_levels_ksp_type": "richardson",
    "mg_levels_ksp_max_it": 1,
    "mg_levels_pc_type": "sor",
}

REBUILD_ABOVE = 1.3  # made anew where CG takes this many times the iterations that it took when fresh, and two more
REBUILD_ABOVE_OF_PIECES = 1.1  # the same where setting up costs little
IN_PIECES = 1.5  # of another kind where even a fresh one takes this many times those of the whole body, and two more


class Due(IntEnum):
    """What has to be done before the next solve."""

    NOTHING = 0
    REFRESH = 1  # new operators on the same coarse spaces
    REBUILD = 2  # everything anew


class Preconditioner:
    """The preconditioner of one KSP.

    Attributes:
        due: what has to be done before the next solve.    keep: whether it serves more than one tangent.
        pc: that of the body alone, also where the KSP uses one that is made of it.
        its: iterations of the last solve, where the KSP does not know; 0: nothing is known; None: it does.
    """

    def __init__(self, ksp: PETSc.KSP, options: OptionSet, *, keep: bool, may_change: bool) -> None:
        """`may_change`: it is multigrid of the program's own choice, of a body that may come apart."""
        self._ksp, self.pc, self._options = ksp, ksp.getPC(), options
        self.due, self.keep = Due.REBUILD, keep
        self._may_change, self._broken, self._rebuild_above = may_change, False, REBUILD_ABOVE
        self.its: int | None = None
        self._fresh_its = self._whole_its = 0

    def damage_changed(self) -> None:
        """Some cells lost stiffness: refresh at the next tangent."""
        self.due, self._broken = max(self.due, Due.REFRESH), True

    def refresh(self, tangent: PETSc.Mat) -> None:
        """Set up what is due for a tangent that is solved with next. Done here, since SNES knows a fixed lag only."""
        self.look()
        ksp = self._ksp
        if self.due == Due.NOTHING:
            return
        if self.due == Due.REBUILD:
            self.pc.reset()
            self._fresh_its = 0
        ksp.setPC(self.pc)
        self.pc.setReusePreconditioner(False)
        ksp.setOperators(tangent)
        ksp.setUp()
        self.due = Due.NOTHING

    def look(self) -> None:
        """See from the iterations of the last solve whether a rebuild is due (more than once does no harm)."""
        its = self._ksp.its if self.its is None else self.its
        if self.due == Due.NOTHING:
            self._look_at(its)
        # also where a refresh is due: coarse spaces from before a crack carry the motion of one side to the other
        if self._fresh_its and its > self._rebuild_above * self._fresh_its + 2:
            self.due = Due.REBUILD

    def _look_at(self, its: int) -> None:
        """Iterations of a solve since it was set up."""
        if not self._fresh_its:
            self._fresh_its = its
            self._whole_its = self._whole_its or its
            if self._broken and self._may_change and its > IN_PIECES * self._whole_its + 2:
                self._change()
        if not self.keep:
            self.due = max(self.due, Due.REFRESH)

    def _change(self) -> None:
        self._may_change, self._rebuild_above, self.due = False, REBUILD_ABOVE_OF_PIECES, Due.REBUILD
        self._options.change(OF_PIECES)
        self.pc.reset()
        self.pc.setFromOptions()
