"""One nonlinear solve: PETSc SNES with line search, CG and algebraic multigrid, options from the study."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from ..errors import InputError
from ..mechanics.balance import Balance
from ..mesh.domain import Domain
from .blocks import Blocks, worth_it
from .choice import Choice
from .factors import FACTORISED, SOONER_THAN_GMRES, Factors
from .forcing import Forcing, Sparing
from .one_solve import Ending, is_linear
from .petsc_options import Options, OptionSet, refusing
from .preconditioner import MULTIGRID, Due, Preconditioner
from .rigid_modes import rigid_modes
from .stepper import SolveResult

if TYPE_CHECKING:
    from .downhill import Downhill
    from .loose_parts import LooseParts

Values = npt.NDArray[np.float64]

DEFAULTS: Options = {
    "snes_type": "newtonls",
    "snes_linesearch_type": "bt",
    "snes_max_it": 50,  # near a limit it would be the last digits that decide whether a step is halved
    "snes_rtol": 1e-6,  # 1e-4 takes the first guess for the answer where cells are slivers
    "snes_stol": 0.0,
    "snes_lag_preconditioner": -2,  # made at the first tangent, then kept
    "snes_lag_preconditioner_persists": True,
    "ksp_type": "cg",
    "ksp_rtol": 1e-5,  # 1e-3 is no descent of the residual where a body is badly conditioned: a cantilever fails
    "ksp_max_it": 500,
}

# A jump of prescribed dofs larger than this share of an edge is carried into the body before Newton starts.
LARGE_GAP = 0.01

# Of GMRES, where CG has failed: with PETSc's 30 it stalls where a body is nearly incompressible.
RESTART = 200

LINEAR_SOLVES = 3  # of a step that is linear, before Newton's method with all that it tries takes over
LEGS, LEAST_LEGS = 20, 5  # solves of a step in which obstacles that are jammed come on, and before they are given up
ON_THE_WAY = 1e-2  # rtol of all but the last of them

# A smaller tangent, and with it a new preconditioner, where at most this share of its cells are alive. Where the
# preconditioner is made anew anyhow, every dead cell goes.
SHRINK_BELOW = 0.9

_SNES = {value: name for name, value in vars(PETSc.SNES.ConvergedReason).items() if isinstance(value, int)}
_KSP = {value: name for name, value in vars(PETSc.KSP.ConvergedReason).items() if isinstance(value, int)}


class Solver:
    """SNES on a `Balance`, set up once and kept for the whole run.

    Attributes:
        snes: that of the last attempt.
        linear_failures: linear solves that failed outright and were taken as no correction.
    """

    def __init__(self, balance: Balance, given: Options) -> None:
        """`given`: PETSc options of the study, over the defaults. InputError where PETSc does not take one."""
        self.balance = balance
        self.linear_failures = 0
        self._blocks: Blocks | None = None  # of the tangent
        self._products: PETSc.Mat | None = None  # a matrix of them
        self._down: Downhill | None = None  # what the SNES of the last attempt goes by
        chosen = _chosen(balance, given)
        self._options = OptionSet(chosen)
        snes = self.snes = PETSc.SNES().create(balance.domain.comm)
        self._made = [snes]
        snes.setOptionsPrefix(self._options.prefix)
        snes.setFunction(lambda _, x, b: balance.free_residual(x, b), balance.vector)
        self._near_null = rigid_body_modes(balance.domain) if chosen["pc_type"] in ("gamg", "ml", "hypre") else None
        self._by_blocks = chosen["pc_type"] == "gamg"
        self._take_tangent()
        self._x, self._correction = balance.vector.duplicate(), balance.vector.duplicate()
        self._configure(given)
        snes.setConvergenceTest(self._converged)
        if balance.limits_steps:
            snes.setLineSearchPreCheck(self._limit)
            if balance.conservative:
                from .downhill import Downhill

                self._down = Downhill(balance, snes)
        self._first_choice, self._downhill = (snes, self._down), self._down
        self._rtol = self._own_rtol = float(chosen["snes_rtol"])
        self._single = chosen["snes_type"] == "ksponly"
        self._iterative = snes.ksp.getType() != "preonly"  # a direct solver's factors are for one tangent only
        self._preconditioner = Preconditioner(
            snes.ksp, self._options, keep=self._iterative, may_change=_may_change(balance, given),
            loosen=self._loosen, bring=balance.bring_entries, nodes=balance.domain.space.dofmap.index_map.size_global,
        )  # fmt: skip
        self._asked = float(given.get("ksp_rtol", 0.0))
        self._linearly = is_linear(balance, given, snes.ksp.getType())
        self._ending = Ending(snes.comm, int(snes.ksp.max_it)) if self._linearly and self._iterative else None
        self._forcing = None if self._asked else _forcing(balance, chosen)
        self._small: float | None = None  # of the last tangent (Balance.assemble_tangent)
        self._first = self._last_little = 0.0
        self._factors = Factors(
            self._preconditioner, symmetric=balance.symmetric, dofs=balance.vector.getSize(), dim=balance.domain.dim
        )
        own = not any(key.startswith(("ksp_type", "pc_", "mg_")) for key in given)
        may_prefer = own and self._may_factorise(SOONER_THAN_GMRES[balance.domain.dim])
        self._choice = Choice(self._factors, may_prefer=may_prefer)

    def _loosen(self, body: PETSc.PC) -> LooseParts | None:
        from .loose_parts import loose_parts

        return loose_parts(self.balance, body)

    def _take_tangent(self) -> None:
        """Solve with the matrix that the balance has now."""
        self._use_blocks()
        tangent = self.balance.tangent
        self._operator = self._products or tangent
        if self.balance.is_incomplete:
            from .condensed import Condensed

            parts, springs = (lambda: self.balance.low_rank), (lambda: self.balance.springs)
            self._operator = Condensed(self._operator, parts, springs).matrix()
        for snes in self._made:
            snes.setJacobian(lambda _, x, A, P: self._linearise(P), self._operator, tangent)
        if self._near_null is not None:
            tangent.setNearNullSpace(self._near_null)

    def _use_blocks(self) -> None:
        """Multiply with the tangent in blocks, where that is quicker."""
        if self._blocks is not None:
            self._blocks.forget()
            self._blocks = self._products = None
        if self._by_blocks and worth_it(self.balance.tangent):
            blocks = self.balance.tangent_in_blocks()
            self._blocks = Blocks(self.balance.tangent, blocks)
            self._products = self._blocks.matrix()

    def _shrink(self) -> None:
        """Where the body was damaged, see whether a smaller tangent does (collective)."""
        preconditioner = self._preconditioner
        preconditioner.look()
        everything = preconditioner.due == Due.REBUILD
        if preconditioner.due != Due.NOTHING and self.balance.shrink_tangent(1.0 if everything else SHRINK_BELOW):
            self._take_tangent()
            preconditioner.due = Due.REBUILD

    def _configure(self, given: Options) -> None:
        try:
            refusing(self.snes.setFromOptions)
            refusing(self.snes.ksp.setFromOptions)
            self._options.check(given, self._set_up_at_rest)
        except InputError:
            self._options.remove()
            raise

    def _set_up_at_rest(self) -> None:
        self._assemble(self.balance.tangent)
        self.balance.bring_entries()
        self.snes.ksp.setOperators(self.balance.tangent)
        self.snes.ksp.setUp()

    # --- a solve, and what is tried where it fails ---

    def solve(self, guess: Values) -> SolveResult:
        """Solve r(u) = 0 from the owned values `guess`; u holds the result, also where it is no solution (choice)."""
        choice = self._choice
        if choice.begins_with_factors() and choice.trusts(result := self._attempt_directly(guess)):
            return result
        result = self._attempt_iteratively(guess)
        if choice.dear:
            return self._go_on_directly(guess)
        if self._misled(result) and self._may_factorise():
            result = self._attempt_directly(self.balance.level.u if self._sets_out_anew else guess)
            if result.converged:
                choice.take(preferred=False)
        elif choice.was_dear(result, positively=self._positively):
            choice.take(preferred=True)
        elif not self._misled(result):
            choice.iterate()
        return result

    def _go_on_directly(self, guess: Values) -> SolveResult:
        """From where iterations have become dear; all the way by them where factors find nothing that is stable."""
        choice, positively = self._choice, self._positively
        choice.dear, krylov, newton = False, self.snes.getLinearSolveIterations(), self.snes.its
        result = self._attempt_directly(None)
        if result.converged and self._factors.positive:
            if krylov > choice.worth(newton, positively=positively):
                choice.take(preferred=True)
            return result
        with self._to_the_end():
            return self._attempt_iteratively(guess)

    @property
    def _positively(self) -> bool:
        """Whether the last attempt was with moduli made positive, and without inertia."""
        return self.snes is not self._first_choice[0] and not self.balance.scheme.inertia

    @contextmanager
    def _to_the_end(self) -> Iterator[None]:
        """However dear iterations get."""
        watched, self._choice.watches = self._choice.watches, False
        yield
        self._choice.watches = watched

    def _attempt_iteratively(self, guess: Values) -> SolveResult:
        result = self._attempt(guess)
        start = None if self._down is not None and not self.balance.left() else guess  # on the way down: goes on
        if self._misled(result):
            if self._sets_out_anew:
                start = self.balance.level.u
            # Smoothers of an older tangent need not be positive for this one.
            self._preconditioner.due = Due.REBUILD
            if self.balance.conservative:
                result = self._attempt_positively(start)
            else:
                with self._set_up_anew():
                    result = self._attempt(start)
        stalled = self.snes.ksp.reason == PETSc.KSP.ConvergedReason.DIVERGED_MAX_IT and self._may_factorise()
        stalled = stalled or self._may_factorise(SOONER_THAN_GMRES[self.balance.domain.dim])
        if self._misled(result) and self.snes.ksp.getType() == "cg" and not stalled:
            # CG met negative curvature (a buckling, softening or nearly incompressible body): GMRES does not mind it.
            self.snes.ksp.setType("gmres")
            self.snes.ksp.setGMRESRestart(RESTART)
            result = self._attempt(start)
            self.snes.ksp.setType("cg")
        return result

    @cached_property
    def _sets_out_anew(self) -> bool:
        """Whether a step is tried from where it begins once its first guess has misled: what flies there may be turned
        inside out, and without a potential (a pressure has none) there is no going down from it. Where prescribed dofs
        or contact set the pace that place is no better."""
        return self.balance.scheme.inertia and not self.balance.conservative and not self.balance.limits_steps

    def _attempt_positively(self, guess: Values | None) -> SolveResult:
        """With moduli made positive, down the incremental potential. (From the start of every attempt they would cost
        more than they save.)"""
        from .downhill import POSITIVE

        down = self._downhill = self._downhill or self._another_downhill()
        for kept, how in zip((True, False), POSITIVE, strict=True):
            down.made_positive(how)
            with nullcontext() if kept else self._set_up_anew():
                result = self._attempt(guess, (down.snes, down))
            if not self._misled(result):
                break
        down.made_positive(None)
        return result

    @contextmanager
    def _set_up_anew(self) -> Iterator[None]:
        """With a preconditioner that is made anew at every tangent."""
        self._preconditioner.due, self._preconditioner.keep = Due.REBUILD, False
        yield
        self._preconditioner.keep = self._iterative

    def _another_downhill(self) -> Downhill:
        """A second SNES, with the linear solver of the first."""
        from .downhill import Downhill

        snes = PETSc.SNES().create(self.balance.domain.comm)
        snes.setOptionsPrefix(self._options.prefix)
        snes.setKSP(self.snes.ksp)
        down = Downhill(self.balance, snes)
        self._made.append(snes)
        self._take_tangent()
        snes.setLineSearchPreCheck(self._limit)
        snes.setFromOptions()
        snes.setConvergenceTest(self._converged)
        return down

    def _may_factorise(self, most: int = FACTORISED) -> bool:
        dofs = self.balance.vector.getSize()
        return self._iterative and dofs <= most and bool(PETSc.Sys.hasExternalPackage("mumps"))

    def _attempt_directly(self, guess: Values | None) -> SolveResult:
        with self._to_the_end(), self._factors.of(self.snes.ksp):
            result = self._attempt(guess)
            if result.newton and result.converged and self.snes.ksp.getType() == "preonly":
                self._factors.learn(self.snes.ksp)
        return result

    def _misled(self, result: SolveResult) -> bool:
        """Whether it was the linear solves that failed: outright, or by what they found.

        A solution of K d = -r lowers |r| for short steps along it, so a line search that fails was given none: CG may
        stop on a tangent that is not positive before it notices. Whether it does is a matter of the last digits, and
        so would be a step that is halved for it.
        """
        line_search = PETSc.SNES.ConvergedReason.DIVERGED_LINE_SEARCH
        return not result.converged and (self.snes.ksp.reason < 0 or self.snes.reason == line_search)

    def _attempt(self, guess: Values | None, other: tuple[PETSc.SNES, Downhill] | None = None) -> SolveResult:
        """From `guess`; None: from where the last attempt has come to."""
        self.snes, self._down = other or self._first_choice
        self._shrink()
        self.balance.set_out()
        extended = 0 if guess is None else self._start_from(guess)
        if self._linearly and (solved := self._solve_as_linear()) is not None:
            return replace(solved, krylov=solved.krylov + extended)
        newton, krylov, held = self._solve_in_legs()
        reason = self.snes.reason
        self.balance.displace_to(self._x)
        if reason > 0 and self._single:  # Newton's method has evaluated them for its test
            self.balance.update_reactions()
        if held:
            return SolveResult(False, newton, krylov + extended, f"Obstacles are jammed: not there in {LEGS} solves")
        return SolveResult(reason > 0, newton, krylov + extended, "" if reason > 0 else self._sentence())

    def _start_from(self, guess: Values) -> int:
        """Set x to what Newton's method may start from; returns Krylov iterations."""
        self._x.array_w[:] = guess
        extended = self._extend() if self.balance.motion.largest_gap(guess) > LARGE_GAP else 0
        if self.balance.limits_steps:
            self._x.array_w[:] = self.balance.reachable(self._x.array_r.copy())
            self.balance.displace_to(self._x)  # terms look there for what is held back
        return extended

    def _solve_in_legs(self) -> tuple[int, int, bool]:
        """Newton's method from x, once more each time that what was held back has gone on: all iterations, and whether
        something is still held back: for good, as far as the last leg tells."""
        newton = krylov = 0
        left = 1.0
        for leg in range(LEGS):
            before, left = left, self.balance.left()
            if leg >= LEAST_LEGS and left > (LEGS - leg) * (before - left):
                break
            self._rtol = ON_THE_WAY if left else self._own_rtol
            if self._down is not None:
                self._down.descent.begin()
            if self._forcing is not None:
                self._forcing.begin()
            self.snes.solve(None, self._x)
            newton, krylov = newton + self.snes.its, krylov + self.snes.getLinearSolveIterations()
            if self.snes.reason <= 0 or not left:
                return newton, krylov, False
            self.balance.go_on()
        return newton, krylov, True

    def _solve_as_linear(self) -> SolveResult | None:
        """From x, where the balance is linear; None: not in a few solves, and Newton's method takes over."""
        balance, x, krylov, left = self.balance, self._x, 0, np.inf
        for its in range(LINEAR_SOLVES + 1):
            if not (solved := np.isfinite(left) and self._is_small(left, its)):
                balance.free_residual(x, balance.vector)
                solved = self._is_small(left := balance.vector.norm(), its)
            if solved:
                return SolveResult(True, its, krylov, "")
            if its == LINEAR_SOLVES or (made := self._correct(self._little(left))) is None:
                break
            left, krylov = made[0], krylov + made[1]
            x.axpy(-1.0, self._correction)
            balance.displace_to(x)
            balance.update_reactions()
        self._preconditioner.its = None
        return None

    def _correct(self, little: float) -> tuple[float, int] | None:
        """K correction = balance.vector, by CG down to what is `little`, N, and to what the study asks of it, or as the
        KSP does it: |r| that is left, infinite where nothing is known, and iterations; None: it was not solved."""
        if self._ending is None or self.snes.ksp.getType() != "cg":
            return (np.inf, self.snes.ksp.its) if self._solve_linear() else None
        ending, tangent, preconditioner = self._ending, self.balance.tangent, self._preconditioner
        if self._asked:
            little = min(little, self._asked * self.balance.vector.norm())
        self._assemble_tangent(tangent)
        products = self._products or tangent
        solved = ending.solve(products, tangent, preconditioner.serving, self.balance.vector, self._correction, little)
        preconditioner.its = ending.to_share(float(self.snes.ksp.rtol))
        return (ending.left, ending.its) if solved else None

    # --- linear solves by themselves ---

    def linear_response(self, force: Values) -> Values:
        """(owned dofs,) displacement that a force on free dofs causes in a step at the present u, linearly, m, where
        nothing else touches the body.

        Near incompressibility tangents may be indefinite: factors where iterations fail. 0 where nothing helps, which
        is counted.
        """
        self._shrink()
        with_factors = [False, True] if self._may_factorise() else [False]
        for factors in with_factors[1:] if self._choice.left else with_factors:
            self.balance.vector.array_w[:] = force
            with self.balance.untouched(), self._factors.of(self.snes.ksp) if factors else nullcontext():
                solved = self._solve_linear()
            if solved:
                return np.asarray(self._correction.array_r.copy())
        self.linear_failures += 1
        return np.zeros_like(force)

    def _extend(self) -> int:
        """Carry a jump of the prescribed displacement into the body linearly; returns the Krylov iterations."""
        self.balance.extension_residual(self._x, self.balance.vector)
        if not self.balance.vector.norm():  # nothing is free that it could go to, nor anything to set up multigrid for
            return 0
        if not self._solve_linear():
            self.linear_failures += 1
        self._x.axpy(-1.0, self._correction)
        return int(self.snes.ksp.its)

    def _solve_linear(self) -> bool:
        """K correction = balance.vector at the present u; whether it was solved."""
        tangent, ksp = self.balance.tangent, self.snes.ksp
        self._assemble_tangent(tangent)
        self._preconditioner.its = None
        if self._forcing is not None:
            ksp.setTolerances(rtol=self._forcing.exact())
        ksp.setOperators(self._operator, tangent)
        ksp.solve(self.balance.vector, self._correction)
        return bool(ksp.reason > 0)

    def _assemble(self, tangent: PETSc.Mat) -> None:
        self._small = self._smallness
        self.balance.assemble_tangent(tangent, small=self._small, blocks_alone=True)

    @property
    def _smallness(self) -> float | None:
        return None if self._down is None else self._down.small

    def _linearise(self, tangent: PETSc.Mat) -> None:
        """K at an iterate of Newton's method, and how exactly it is solved with."""
        ksp, forcing = self.snes.ksp, self._forcing
        if forcing is None:
            self._assemble_tangent(tangent)
            return
        self._preconditioner.its = forcing.iterations(ksp.its)
        norm, little = self.snes.getFunctionNorm(), self._last_little
        if isinstance(forcing, Sparing):
            kept = forcing.reach(norm, little) and self._small == self._smallness
            if not kept:
                self._assemble_tangent(tangent)
            ksp.setTolerances(rtol=forcing.tolerance(little, kept=kept))
            return
        self._assemble_tangent(tangent)
        ksp.setTolerances(rtol=forcing.rough(norm, little) if self.balance.couples else forcing.exact())

    def _assemble_tangent(self, tangent: PETSc.Mat) -> None:
        """K and what its preconditioner is due."""
        self._assemble(tangent)
        if self._blocks is not None:
            self._blocks.follow()
        if (self.balance.low_rank or self.balance.springs) and self.snes.ksp.getType() == "preonly":
            self.snes.ksp.setType("gmres")  # factors are of the rest
        if self.balance.pattern_changed:
            self._preconditioner.due, self.balance.pattern_changed = Due.REBUILD, False
        self._preconditioner.refresh(tangent, self._products)
        self._hold()

    def _hold(self) -> None:
        """Precondition with the body's springs as well, where there are any."""
        ksp, body = self.snes.ksp, self._preconditioner.serving
        springs = [each for each in self.balance.springs if len(each.stiffness)]
        if not springs:
            ksp.setPC(body)
            return
        from .woodbury import Woodbury

        body.setReusePreconditioner(True)
        pc = PETSc.PC().createPython(Woodbury(body, springs, self.balance.vector), comm=ksp.comm)
        ksp.setPC(pc)
        pc.destroy()

    def damage_changed(self, broke: int | None = None) -> None:
        """Some cells lost stiffness as so many edges broke, on all ranks (None: nobody knows): refresh the
        preconditioner at the next tangent, where that pays."""
        self._preconditioner.damage_changed(broke)

    def _limit(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """The step x <- x - y, no longer than the terms of the balance allow (collective)."""
        if self._down is not None:
            self._down.descent.set_out()
        if not self.balance.limits_steps:
            return
        share = self.balance.longest_step(-y.array_r)
        if share < 1:
            y.scale(share)

    # --- when it is done ---

    def _sentence(self) -> str:
        why = _SNES.get(self.snes.reason, str(self.snes.reason)).lower().removeprefix("diverged_").replace("_", " ")
        if self.snes.reason == PETSc.SNES.ConvergedReason.DIVERGED_LINEAR_SOLVE:
            why += " (" + _KSP.get(self.snes.ksp.reason, "?").lower().removeprefix("diverged_").replace("_", " ") + ")"
        return f"Newton's method stopped after {self.snes.its} iterations: {why}"

    def _converged(self, snes: PETSc.SNES, its: int, norms: tuple[float, float, float]) -> int:
        """|r| <= rtol max(|r_0|, |forces|) or below round-off: forces are what r is the difference of.

        PETSc's own test against |r_0| alone asks for more and more digits as the first guess gets better.
        """
        reason = PETSc.SNES.ConvergedReason
        if not np.isfinite(norms[2]):
            return int(reason.DIVERGED_FNORM_NAN)
        if self._is_small(norms[2], its):
            return int(reason.CONVERGED_FNORM_RELATIVE)
        if self._choice.gets_dear(snes.getLinearSolveIterations(), its, positively=self._positively):
            return int(reason.DIVERGED_INNER)
        if self._down is not None and self.balance.scheme.inertia and self._down.stalls(norms[2], its):
            return int(reason.DIVERGED_MAX_IT)  # half the step is done in a few iterations
        return int(reason.ITERATING)

    def _is_small(self, norm: float, its: int) -> bool:
        """Whether that is so of |r| after so many iterations (collective)."""
        if its == 0:
            # a first guess that contact has cut is off by more than any force of the step, however stiff the body
            self._first = 0.0 if self.balance.limits_steps else norm
        return norm <= self._little(self._first if its else 0.0)

    def _little(self, first: float) -> float:
        """|r| of a solution, N, where that of the guess is `first` (collective)."""
        scale, floor = self.balance.force_scale()
        self._last_little = max(self._rtol * max(first, scale), floor)
        return self._last_little

    def destroy(self) -> None:
        """Give back PETSc's objects and take the options out of its database; nothing may be solved any more."""
        self._options.remove()
        self._factors.forget()
        self._preconditioner.forget_parts()
        for kept in (*self._made, self._x, self._correction):
            kept.destroy()
        if self._downhill is not None:
            self._downhill.destroy()
        if self._ending is not None:
            self._ending.destroy()
        if self._blocks is not None:
            self._blocks.forget()
        if self._near_null is not None:
            self._near_null.destroy()


def _chosen(balance: Balance, given: Options) -> Options:
    """The study's options over the defaults."""
    multigrid = given.get("pc_type", "gamg") == "gamg"
    chosen = DEFAULTS | (MULTIGRID if multigrid else {})
    if multigrid and balance.scheme.inertia:
        # no aggregates across edges that carry nothing; without inertia every edge keeps RESIDUAL_STIFFNESS
        chosen |= {"pc_gamg_threshold": 0.0}
    if not balance.symmetric:
        chosen |= {"ksp_type": "gmres"}
    return chosen | given


def _forcing(balance: Balance, chosen: Options) -> Forcing | Sparing | None:
    """How exactly Newton's method solves; None: always as exactly. (Without inertia a piece hangs by next to nothing: a
    residual that is small leaves its place open.)"""
    rtol = float(chosen["ksp_rtol"])
    if balance.limits_steps:
        return Forcing(rtol) if balance.conservative else None
    return Sparing(rtol) if balance.scheme.inertia and chosen["snes_type"] == "newtonls" else None


def _may_change(balance: Balance, given: Options) -> bool:
    """Whether multigrid of another kind may take over: nobody asked for this one, and inertia holds what hangs."""
    own = not any(key.startswith(("pc_", "mg_")) for key in given)
    return own and balance.scheme.inertia


def rigid_body_modes(domain: Domain) -> PETSc.NullSpace:
    """The rigid motions of the whole body, about its centre (stepping.rigid_modes)."""
    return rigid_modes(domain.comm, domain.nodes[: domain.node_count] - (domain.lower + domain.upper) / 2)
