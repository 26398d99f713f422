"""When the preconditioner is made anew, and of what kind.

It is kept from tangent to tangent: making multigrid's coarse spaces costs more than the rest of a Newton iteration. It
is made anew where CG takes a third more iterations than when it was fresh, or the tangent has given up entries of dead
cells (mechanics.matrix_assembly), and refreshed (new coarse operators and smoothers on the same coarse spaces) after
edges broke: once there were many of them, or what CG has taken longer for their sake adds up to a refresh. Where its
cycle is quick (vcycle) a set-up costs a hundred iterations and more, or sixty thorough ones, and it is made anew once
what CG has taken longer adds up to SET_UP; where no edge has broken since its coarse spaces were made these are good
still, and a refresh, a third of a set-up, is enough for REFRESHED of it.

Where a body comes apart, cells hang from it by a node or an edge and turn there against nothing but their inertia.
Smoothed aggregation with Jacobi's smoother needs three times the iterations then, and a set-up that a few broken edges
spoil. Where steps are so long that inertia is next to nothing, it is a hundred times, and what hangs is solved for by
itself (deflation), which is looked for after edges broke. In shorter ones other aggregates do: those without
smoothing cost a fifth of the set-up, and a sweep of SSOR deals with what hangs: 18 iterations where the whole body took
9 and the cut one 27 (33,000 tetrahedra, 10 planes), a step in 0.85 of the time; after 100 planes 0.7. In steps so short
that inertia has a hundredth of the stiffness of a cell, or more, SSOR alone does: a porcelain figure that shatters
(46,000 tetrahedra, a sixth) takes 2.5 times the iterations and half the time.

A whole body that is slow to solve for is thin, or all but incompressible. Aggregates are made anew of the stronger
links between its nodes there: a sheet of two cells (nu = 0.45, 234,000 tetrahedra) takes 38 iterations where it took
77, and a fresh set-up costs the same. A compact body gains nothing (9 for 9), and its set-up would cost up to half as
much again. Where it is large, too, and its levels are not copied in single precision (vcycle), its finest one is
smoothed by one step with the inverse of each node's block instead of two with the diagonal, as products with that level
are the larger part of a solve: the sheet takes as many iterations for a force at random (25), 31 to 37 for 27 to 30 in
its steps, each of three products instead of five. A compact one would take 12 or 13 for 9 or 10, in as long. On coarser
levels such blocks may be singular, of aggregates of a node or two.

How much of what holds a cell is its inertia: which preconditioner does for a body that comes apart.

c_a rho h^2 / Y,   c_a = da/du of the scheme (1 / dt^2 in backward Euler),   h: mean edge
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import TYPE_CHECKING

import numpy as np
from petsc4py import PETSc

from ..mechanics.balance import Balance
from ..mesh.parallel import sum_over_ranks
from .petsc_options import PetscOptions, PetscOptionSet

if TYPE_CHECKING:
    from .deflation import DeflatedPreconditioner
    from .multigrid.fine_level import FineLevel
    from .multigrid.vcycle import SinglePrecisionVCycle

HELD = 1e-3  # above which what hangs by a node or an edge is held by its inertia
SWEPT = 1e-2  # above which sweeps do without coarse spaces: no force gets far in a step
GAMG_OPTIONS: PetscOptions = {
    "pc_type": "gamg",
    "pc_gamg_reuse_interpolation": True,
    "mg_levels_ksp_type": "chebyshev",
    "mg_levels_ksp_max_it": 2,
    "mg_levels_pc_type": "jacobi",
}
OF_PIECES: PetscOptions = {
    "pc_gamg_agg_nsmooths": 0,
    "mg_levels_ksp_type": "richardson",
    "mg_levels_ksp_max_it": 1,
    "mg_levels_pc_type": "sor",
}
SWEEPS: PetscOptions = {"pc_type": "sor"}
LEVELS: PetscOptions = {"pc_type": "gamg"}
# on the finest level: one step, with blocks of a node's dofs, within bounds of their own spectrum
BY_NODES: PetscOptions = {"pc_type": "pbjacobi", "ksp_max_it": 1, "ksp_chebyshev_esteig": "0,0.05,0,1.1"}
STRONG_LINKS: PetscOptions = {"pc_gamg_threshold": 0.05, "pc_gamg_aggressive_square_graph": False}
# on several ranks PETSc (3.22) coarsens the square of a graph of strong links, since it does not end without (MISk)
STRONG_LINKS_ON_RANKS: PetscOptions = STRONG_LINKS | {"pc_gamg_aggressive_square_graph": True}
ALL_LINKS: PetscOptions = {"pc_gamg_threshold": 0.0, "pc_gamg_aggressive_square_graph": True}
SLOW = 25  # iterations of a whole body from which on aggregates of strong links are tried
WORTH_IT = 0.9  # of these iterations, which they may take at most
REBUILD_ABOVE = 1.3  # made anew where CG takes this many times the iterations that it took when fresh, and two more
REBUILD_ABOVE_OF_PIECES = 1.1  # the same where setting up costs little
IN_PIECES = 1.5  # of another kind where even a fresh one takes this many times those of the whole body, and two more
MANY = 0.02  # edges that broke, for each node, after which it is refreshed
REFRESH_ITS = 10  # iterations that a refresh costs
# more than it would take when fresh, after which one whose cycle is quick is made anew, or, of a body that nothing has
# broken in, refreshed
SET_UP, REFRESHED = 100, 40
THOROUGHLY = 0.6  # of them, where more is done in each iteration
PATTERN = "pattern"  # attribute of a PC: Stiffness.pattern when it was set up
# solves of which the slowest tells what it takes when fresh, where its cycle is quick (vcycle): those of a step, as one
# tangent of it may take three times the iterations of another, whichever it was made for. By two solves alone a jelly
# that flies about seemed slow in each step, and was set up for
FRESH = 5


def mass_stiffness_ratio(balance: Balance) -> float:
    """The inertia of a cell as a share of its stiffness, in the step that is solved now (collective)."""
    domain, material = balance.domain, balance.stress.material
    sums = [np.sum(each * domain.volumes) for each in (material.young, material.density)]
    stiffness, mass = sum_over_ranks(domain.comm, np.array(sums))
    return float(balance.c_a * mass * domain.mean_edge_length**2 / stiffness)


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
        serving: that, or one made of it that sees to loose parts.
        its: iterations of the last solve, where the KSP does not know; 0: nothing is known; None: it does.
    """

    def __init__(
        self,
        ksp: PETSc.KSP,
        options: PetscOptionSet,
        *,
        keep: bool,
        may_change: bool,
        large: bool,
        loosen: Callable[[PETSc.PC], DeflatedPreconditioner | None],
        hasten: Callable[[PETSc.PC], SinglePrecisionVCycle | None],
        bring: Callable[[], None],
        pattern: Callable[[], int],
        inertia: Callable[[], float],
        nodes: int,
    ) -> None:
        """`may_change`: it is multigrid of the program's own choice, of a body that may come apart; `loosen`: makes one
        that sees to loose parts out of `pc`, None: there are none; `hasten`: what does the same in less time, None
        where nothing does; `large`: whether products are the larger part of its work; `bring`: brings the entries of
        the tangent to what they are; `pattern`: Stiffness.pattern; `inertia`: of a cell, as a share of its stiffness
        (all collective); `nodes`: of the body."""
        self._ksp, self.pc, self._options = ksp, ksp.getPC(), options
        self.serving, self._loosen, self._bring, self._pattern = self.pc, loosen, bring, pattern
        self._inertia, self._nodes = inertia, nodes
        self._loose: DeflatedPreconditioner | None = None
        self._hasten = hasten
        self._cycle: SinglePrecisionVCycle | None = None
        self._looks_for_parts = False  # before the next solve
        self._sweeps: bool | None = None  # of a body in pieces: whether sweeps do for it
        self._broke, self._extra = 0, 0.0  # edges and iterations since it was set up
        self._refreshed_at, self._torn = 0.0, False  # such iterations, and whether edges broke since it was made anew
        self.due, self.keep = Due.REBUILD, keep
        self._large, self._by_nodes = large, False
        self._own = self._may_change = may_change
        self._broken, self._rebuild_above = False, REBUILD_ABOVE
        self.its: int | None = None
        # of aggregates of all links, where strong ones are on trial; 0: nothing is known; None: it is settled
        self._all_links_its: int | None = 0 if may_change else None
        self._fresh_its = self._whole_its = self._solves = 0

    def damage_changed(self, broke: int | None) -> None:
        """Some cells lost stiffness as so many edges broke, on all ranks (None: nobody knows): refresh at the next
        tangent, where that pays."""
        self._broken = self._looks_for_parts = True
        self._broke += self._nodes if broke is None else broke
        self._torn = self._torn or broke != 0
        if self._broke > MANY * self._nodes:
            self.due = max(self.due, Due.REFRESH)

    def refresh(self, tangent: PETSc.Mat, products: PETSc.Mat | None = None) -> None:
        """Set up what is due for a tangent that is solved with next; `products`: what it is multiplied with, if that is
        another matrix. Done here, since SNES knows a fixed lag only."""
        self.look()
        self._count()
        self._see_to_pieces()
        ksp = self._ksp
        if self.due == Due.NOTHING and not self._is_of_another_pattern():
            self._follow(tangent)
            return
        self._bring()
        if anew := self.due == Due.REBUILD or self._is_of_another_pattern():
            self.pc.reset()
            self._fresh_its = self._solves = 0
            self._torn = False
        self._forget_cycle()
        ksp.setPC(self.pc)
        self.pc.setReusePreconditioner(False)
        self.pc.setUseAmat(products is not None)
        ksp.setOperators(products or tangent, tangent)
        ksp.setUp()
        self.pc.setAttr(PATTERN, self._pattern())
        self._cycle = self._hasten(self.pc)
        if self._cycle is None and self._by_nodes and self.pc.getType() == "gamg":
            self._smooth_by_nodes()
        self.due, self._broke = Due.NOTHING, 0
        self._refreshed_at = self._extra = 0.0 if anew or self._cycle is None else self._extra
        self._looks_for_parts = self._broken
        self._follow(tangent)

    def _is_of_another_pattern(self) -> bool:
        """Whether `pc` was set up for an earlier pattern of the tangent: factors would be written past the end of their
        arrays."""
        return self.pc.getAttr(PATTERN) not in (None, self._pattern())

    def _smooth_by_nodes(self) -> None:
        """On the finest level alone."""
        finest = self.pc.getMGSmoother(self.pc.getMGLevels() - 1)
        options = PETSc.Options(finest.getOptionsPrefix())
        for key, value in BY_NODES.items():
            options[key] = value
        finest.setFromOptions()
        for key in BY_NODES:
            options.delValue(key)

    def _follow(self, tangent: PETSc.Mat) -> None:
        """What serves is brought to a tangent that is solved with next."""
        self.serving = self._body
        if self._cycle is not None and self.serving is self._cycle.pc:
            self._cycle.update_operator()
        if self._looks_for_parts and self._own and self.pc.getType() == "gamg":
            self.forget_parts()
            self._looks_for_parts = False
            if self._inertia() <= HELD:
                self._loose = self._loosen(self.serving)
        loose = self._loose
        if loose is None or loose.base_pc is not self.serving:
            return
        if loose.update_operator(tangent):
            self.pc.setReusePreconditioner(True)
            self.serving = loose.pc

    @property
    def _body(self) -> PETSc.PC:
        """That of the body alone, in single precision where there is such a one."""
        return self.pc if (quick := self._quick) is None else quick.pc

    @property
    def finest(self) -> FineLevel | None:
        """The tangent that is solved with next, in single precision; None: it is not kept so."""
        return None if (quick := self._quick) is None else quick.fine_level

    @property
    def _quick(self) -> SinglePrecisionVCycle | None:
        """The cycle that serves in place of `pc`."""
        cycle = self._cycle
        return None if cycle is None or cycle.gamg is not self.pc else cycle

    def forget(self) -> None:
        """Give the memory of what was made of `pc` back."""
        self.forget_parts()
        self._forget_cycle()

    def _forget_cycle(self) -> None:
        if self._cycle is not None:
            self._cycle.destroy()
            self._cycle = None

    def forget_parts(self) -> None:
        """Give the memory of loose parts back."""
        if self._loose is not None:
            self._loose.destroy()
            self._loose = None

    def look(self) -> None:
        """See from the iterations of the last solve whether a rebuild is due (more than once does no harm)."""
        its = self._last_its
        if self.due == Due.NOTHING:
            self._look_at(its)
            if self._cycle is not None and self._solves < FRESH:
                self._fresh_its = max(self._fresh_its, its)
        # also where a refresh is due: coarse spaces from before a crack carry the motion of one side to the other
        if self._cycle is None and self._fresh_its and its > self._rebuild_above * self._fresh_its + 2:
            self.due = Due.REBUILD

    @property
    def _last_its(self) -> int:
        return int(self._ksp.its) if self.its is None else self.its

    def _count(self) -> None:
        """Iterations more than when it was fresh, since edges broke: once they add up to a refresh one is due. Where
        its cycle is quick whatever they are for, and to a set-up, or to a refresh where no edge broke."""
        self._solves += 1
        its, fresh = self._last_its, self._fresh_its
        if self._cycle is not None:
            if its > fresh > 0:
                self._extra += int(self._ksp.its) * (1 - fresh / its)
            enough = THOROUGHLY if self._cycle.has_thorough_smoothing else 1.0
            if self._extra > enough * SET_UP:
                self.due = Due.REBUILD
            elif not self._torn and self._extra > self._refreshed_at + enough * REFRESHED:
                self.due = max(self.due, Due.REFRESH)
            return
        if self._broke:
            self._extra += max(its - fresh, 0)
        if self._extra > REFRESH_ITS:
            self.due = max(self.due, Due.REFRESH)

    def _look_at(self, its: int) -> None:
        """Iterations of a solve since it was set up."""
        if self._sweeps:
            self.due = Due.REFRESH
            return
        if not self._fresh_its:
            self._fresh_its = its
            if not self._broken and self._tries_links(its):
                return
            self._whole_its = self._whole_its or its
            if self._broken and self._may_change and its > IN_PIECES * self._whole_its + 2:
                self._change()
        if not self.keep:
            self.due = max(self.due, Due.REFRESH)

    def _tries_links(self, its: int) -> bool:
        """Whether it is of another kind from now on: of strong links where a fresh one took so many iterations, of all
        of them again where that was no better."""
        all_links = self._all_links_its
        if all_links is None or not its:
            return False
        worse = its > (WORTH_IT * all_links if all_links else SLOW)
        self._all_links_its = its if worse and not all_links else (None if all_links else 0)
        if worse:
            self._by_nodes = self._large
            strong = STRONG_LINKS if self._ksp.comm.size == 1 else STRONG_LINKS_ON_RANKS
            self._become(ALL_LINKS if all_links else strong)
            self._fresh_its = 0
        return worse

    def _change(self) -> None:
        if self._inertia() <= HELD:
            return
        self._may_change = self._by_nodes = self._sweeps = False
        self._rebuild_above = REBUILD_ABOVE_OF_PIECES
        self._become(OF_PIECES)

    def _see_to_pieces(self) -> None:
        """In the way that goes with how long steps are."""
        if self._sweeps is None or self._sweeps == (self._inertia() > SWEPT):
            return
        self._sweeps, self._fresh_its = not self._sweeps, 0
        self._become(SWEEPS if self._sweeps else LEVELS)

    def _become(self, kind: PetscOptions) -> None:
        self.due = Due.REBUILD
        self._options.change(kind)
        self.pc.reset()
        self.pc.setFromOptions()
