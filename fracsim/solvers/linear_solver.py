"""K of a balance at the present u, and solving with it: one KSP, what it is preconditioned with, and factors.

Newton's method (newton) asks for K at its iterates; solves by themselves are made here.

Equations: docs/theory.md#linear-systems.

Where the balance is linear a step is one linear solve, with a tangent that is kept.

CG goes on until the residual is what Newton's method would stop at, and says what is left: nothing is assembled to see
it. It starts from the combination of earlier solutions that is nearest in energy (Fischer 1998): of smooth motion two
iterations are left of nine. Without inertia it goes on to a third of that, some two iterations more: loads that grow
in proportion are then extrapolated to a solution, which takes none.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from ..mechanics.balance import Balance
from ..mesh.domain import Domain
from .direct_solver import FACTORISED, DirectSolver
from .forcing_terms import ContractionForcing, EisenstatWalkerForcing
from .multigrid.block_operator import BlockOperator, blocks_pay_off
from .petsc_options import PetscOptions, PetscOptionSet, call_petsc
from .preconditioner import GAMG_OPTIONS, Due, Preconditioner, mass_stiffness_ratio
from .rigid_body_modes import rigid_body_nullspace

if TYPE_CHECKING:
    from .deflation import DeflatedPreconditioner
    from .multigrid.vcycle import SinglePrecisionVCycle

GUESS: PetscOptions = {"ksp_guess_type": "fischer", "ksp_guess_fischer_model": "1,10"}  # 10 solutions and their forces
AT_REST = 0.3  # of what Newton's method would leave: so far without inertia
ENOUGH = 3  # iterations that tell how quickly CG converges
_SILENT = ("snes_rtol", "ksp_rtol", "ksp_type")
Values = npt.NDArray[np.float64]
DEFAULTS: PetscOptions = {
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
# A smaller tangent, and with it a new preconditioner, where at most this share of its cells are alive. Where the
# preconditioner is made anew anyhow, every dead cell goes.
SHRINK_BELOW = 0.9
# Inertia of a cell, as a share of its stiffness, above which corrections are those of a tangent in single precision:
# rounding takes 6e-8 of a stiffness where neighbours move apart (fine_level), less than what hangs by a node has
ROUNDED = 1e-6


def is_linear(balance: Balance, given: PetscOptions, method: str) -> bool:
    """Whether steps are single solves: of a linear body by CG or factors, where nobody asked for another way, nor to be
    shown Newton's."""
    own = all(key in _SILENT or key.startswith(("pc_", "mg_")) for key in given)
    # without inertia a piece hangs by 1e-8 of its stiffness: a residual that is small leaves its place open
    may_hang = balance.stress.chi is not None and not balance.scheme.inertia
    held = method == "preonly" or (method == "cg" and not may_hang)
    return own and balance.linear and balance.symmetric and held


class LinearStepCG:
    """CG for solves that end a step.

    Attributes:
        its: iterations of the last solve.    left: |r| after it, N.
    """

    def __init__(self, comm: object, most: int) -> None:
        """`most`: iterations."""
        self._ksp = ksp = PETSc.KSP().create(comm)
        self._options = PetscOptionSet(GUESS)
        ksp.setOptionsPrefix(self._options.prefix)
        ksp.setType("cg")
        ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
        ksp.setFromOptions()
        ksp.setConvergenceHistory(most + 1, reset=True)
        self._most = most
        self.iterations, self.residual_norm = 0, 0.0

    def solve(self, A: PETSc.Mat, K: PETSc.Mat, pc: PETSc.PC, b: PETSc.Vec, x: PETSc.Vec, little: float) -> bool:
        """K x = b down to |r| = `little`, N, `A` being K for products; whether it is solved (collective)."""
        ksp = self._ksp
        pc.setReusePreconditioner(True)
        ksp.setPC(pc)
        ksp.setOperators(A, K)
        ksp.setTolerances(rtol=0.0, atol=little, max_it=self._most)
        ksp.solve(b, x)
        self.iterations, self.residual_norm = ksp.its, ksp.norm
        return bool(ksp.reason > 0)

    def to_share(self, rtol: float) -> int:
        """Iterations that a solve to a share of the residual would have taken; 0: too few to tell."""
        begun = self._ksp.getConvergenceHistory()[:1]
        if self.iterations < ENOUGH or not 0 < self.residual_norm < begun[0]:
            return 0
        return round(self.iterations * math.log(rtol) / math.log(self.residual_norm / begun[0]))

    def destroy(self) -> None:
        """Give back PETSc's objects, and take the options out of its database."""
        self._options.remove()
        self._ksp.destroy()


class LinearSolver:
    """K, and solving with it.

    Attributes:
        ksp, preconditioner, factors: what it is solved with.
        operator: what K is multiplied with.    forcing: how exactly; None: always as exactly.
        linearly: whether a step is one solve.    iterative: whether one preconditioner serves more than one tangent.
        correction: of the last solve by itself.
        failures: solves that failed outright and were taken as no correction.
    """

    def __init__(
        self,
        balance: Balance,
        ksp: PETSc.KSP,
        options: PetscOptionSet,
        given: PetscOptions,
        chosen: PetscOptions,
        small: Callable[[], float | None],
    ) -> None:
        """`given`: of the study, `chosen`: with the defaults; `small`: how positive K is made at the present u
        (Stiffness.assemble). InputError where PETSc does not take an option (collective)."""
        self.balance, self.stiffness, self.ksp, self._smallness = balance, balance.tangent, ksp, small
        self.failures = 0
        self._small: float | None = None  # of the last tangent
        self._blocks: BlockOperator | None = None  # of the tangent
        self._products: PETSc.Mat | None = None  # a matrix of them
        self._condensed: PETSc.Mat | None = None  # of what is multiplied with, and of parts of low rank
        self.correction = balance.work_vector.duplicate()
        self._near_null = near_nullspace(balance.domain) if chosen["pc_type"] in ("gamg", "ml", "hypre") else None
        self._by_blocks = chosen["pc_type"] == "gamg"
        self._may_hasten = _is_own(given)
        self._take_tangent()
        call_petsc(ksp.setFromOptions)
        options.check(given, self._set_up_at_rest)
        self.iterative = ksp.getType() != "preonly"  # a direct solver's factors are for one tangent only
        self.preconditioner = Preconditioner(
            ksp, options, keep=self.iterative, may_change=_may_change(balance, given),
            large=self._blocks is not None, loosen=self._loosen, hasten=self._hasten,
            bring=self._bring, pattern=lambda: self.stiffness.pattern_version,
            inertia=lambda: mass_stiffness_ratio(balance),
            nodes=balance.domain.space.dofmap.index_map.size_global,
        )  # fmt: skip
        self._asked = float(given.get("ksp_rtol", 0.0))
        self.linearly = is_linear(balance, given, ksp.getType())
        self._ending = LinearStepCG(ksp.comm, int(ksp.max_it)) if self.linearly and self.iterative else None
        self.forcing = None if self._asked else _forcing(balance, chosen)
        self.factors = DirectSolver(
            self.preconditioner, symmetric=balance.symmetric, dofs=balance.work_vector.getSize(), dim=balance.domain.dim
        )

    def _set_up_at_rest(self) -> None:
        self._assemble()
        self.stiffness.update_entries()
        self.ksp.setOperators(self.stiffness.matrix)
        self.ksp.setUp()

    # --- what K is kept in ---

    def _take_tangent(self) -> None:
        """Solve with the matrix that the balance has now."""
        self._use_blocks()
        self._forget_condensed()
        self.operator = self._products or self.stiffness.matrix
        if self.stiffness.may_be_incomplete:
            from .low_rank import LowRankOperator

            stiffness = self.stiffness
            parts, springs = (lambda: stiffness.low_rank_updates), (lambda: stiffness.stiff_couplings)
            self.operator = self._condensed = LowRankOperator(self.operator, parts, springs).to_petsc()
        self._know_rigid_motions()

    def _forget_condensed(self) -> None:
        """Give back the matrix that K is multiplied with where terms keep a part of K beside its entries."""
        if self._condensed is not None:
            self._condensed.destroy()
            self._condensed = None

    def _know_rigid_motions(self) -> None:
        """Tell the matrix of them, once more where entries beyond its pattern were added: PETSc's sum is another matrix
        under the same name, which forgets them, and multigrid would know of translations alone."""
        if self._near_null is not None and not self.stiffness.matrix.getNearNullSpace():
            self.stiffness.matrix.setNearNullSpace(self._near_null)

    def _use_blocks(self) -> None:
        """Multiply with the tangent in blocks, where that is quicker."""
        if self._blocks is not None:
            self._blocks.release_copy()
            self._blocks = self._products = None
        if self._by_blocks and blocks_pay_off(self.stiffness.matrix):
            stiffness, blocks = self.stiffness, self.stiffness.switch_to_blocks()
            self._blocks = BlockOperator(stiffness.matrix, blocks, lambda: stiffness.pattern_version)
            self._products = self._blocks.to_petsc()

    def shrink(self) -> bool:
        """Where the body was damaged, see whether a smaller tangent does; whether there is a new one (collective)."""
        preconditioner = self.preconditioner
        preconditioner.look()
        everything = preconditioner.due == Due.REBUILD
        if preconditioner.due == Due.NOTHING or not self.stiffness.shrink(1.0 if everything else SHRINK_BELOW):
            return False
        self._take_tangent()
        return True

    # --- K at the present u ---

    def _assemble(self) -> None:
        if self._blocks is not None:
            self._blocks.single = None
        self._small = self._smallness()
        self.stiffness.assemble(psd_tolerance=self._small, blocks_only=True)

    def linearise(self, norm: float, little: float) -> None:
        """K at an iterate of Newton's method, and how exactly it is solved with: |r| there is `norm`, N, that of a
        solution `little` (collective)."""
        forcing = self.forcing
        if forcing is None:
            self._assemble_tangent()
            return
        self.preconditioner.its = forcing.equivalent_iterations(self.ksp.its)
        if isinstance(forcing, ContractionForcing):
            kept = forcing.record_iterate(norm, little, self._left_by_cg) and self._small == self._smallness()
            if not kept:
                self._assemble_tangent()
                self._multiply_in_single()
            self.ksp.setTolerances(rtol=forcing.tolerance_for(little, kept=kept))
            return
        self._assemble_tangent()
        self.ksp.setTolerances(
            rtol=forcing.tolerance_for(norm, little)
            if self.stiffness.has_contact_coupling
            else forcing.tight_tolerance()
        )

    def _left_by_cg(self) -> float:
        """|r| that the last solve has left of the linear system, N, which CG has at hand; 0 of other methods."""
        return float(self.ksp.buildResidual(self.correction).norm()) if self.ksp.getType() == "cg" else 0.0

    def _assemble_tangent(self) -> None:
        """K and what its preconditioner is due."""
        self._assemble()
        if self._blocks is not None:
            self._blocks.update_copy()
        if (self.stiffness.low_rank_updates or self.stiffness.stiff_couplings) and self.ksp.getType() == "preonly":
            self.ksp.setType("gmres")  # factors are of the rest
        self._know_rigid_motions()
        self.preconditioner.refresh(self.stiffness.matrix, self._products)
        self._hold()

    def _multiply_in_single(self) -> None:
        """Let CG go by the tangent that its preconditioner keeps in single precision, half the bytes, where what that
        leaves of a correction is less than what the next one is for anyhow (collective)."""
        if self._blocks is not None and self.ksp.getType() == "cg" and mass_stiffness_ratio(self.balance) > ROUNDED:
            self._blocks.single = self.preconditioner.finest

    def _hold(self) -> None:
        """Precondition with the body's springs as well, where there are any."""
        body = self.preconditioner.serving
        springs = [each for each in self.stiffness.stiff_couplings if len(each.stiffness)]
        if not springs:
            self.ksp.setPC(body)
            return
        from .low_rank import WoodburyPreconditioner

        body.setReusePreconditioner(True)
        context = WoodburyPreconditioner(body, springs, self.balance.work_vector)
        pc = PETSc.PC().createPython(context, comm=self.ksp.comm)
        self.ksp.setPC(pc)
        pc.destroy()

    def _loosen(self, body: PETSc.PC) -> DeflatedPreconditioner | None:
        from .deflation import create_deflation

        return create_deflation(self.balance, body)

    def _hasten(self, body: PETSc.PC) -> SinglePrecisionVCycle | None:
        if not self._may_hasten or self._blocks is None or (assembled := self._blocks.assembled) is None:
            return None
        from .multigrid.vcycle import create_vcycle

        return create_vcycle(body, assembled)

    def _bring(self) -> None:
        self.stiffness.update_entries()
        self._know_rigid_motions()

    @contextmanager
    def set_up_anew(self) -> Iterator[None]:
        """With a preconditioner that is made anew at every tangent."""
        self.preconditioner.due, self.preconditioner.keep = Due.REBUILD, False
        try:
            yield
        finally:
            self.preconditioner.keep = self.iterative

    # --- solves by themselves ---

    def may_factorise(self, most: int = FACTORISED) -> bool:
        """Whether a system of no more than so many dofs may be factorised."""
        dofs = self.balance.work_vector.getSize()
        return self.iterative and dofs <= most and bool(PETSc.Sys.hasExternalPackage("mumps"))

    def response(self, force: Values, *, directly: bool) -> Values:
        """(owned dofs,) displacement that a force on free dofs causes in a step at the present u, linearly, m, where
        nothing else touches the body.

        Near incompressibility tangents may be indefinite: factors where iterations fail; `directly`: these at once. 0
        where nothing helps, which is counted.
        """
        with_factors = [False, True] if self.may_factorise() else [False]
        for factors in with_factors[1:] if directly else with_factors:
            self.balance.work_vector.array_w[:] = force
            with self.stiffness.without_contact(), self.factors.of(self.ksp) if factors else nullcontext():
                solved = self.solve()
            if solved:
                return np.asarray(self.correction.array_r.copy())
        self.failures += 1
        return np.zeros_like(force)

    def extend(self, x: PETSc.Vec) -> int:
        """Carry a jump of the prescribed displacement into the body linearly; returns the Krylov iterations."""
        self.balance.assemble_extension_residual(x, self.balance.work_vector)
        if (
            not self.balance.work_vector.norm()
        ):  # nothing is free that it could go to, nor anything to set up multigrid for
            return 0
        if not self.solve():
            self.failures += 1
        x.axpy(-1.0, self.correction)
        return int(self.ksp.its)

    def solve(self) -> bool:
        """K correction = balance.work_vector at the present u; whether it was solved."""
        ksp = self.ksp
        self._assemble_tangent()
        self.preconditioner.its = None
        if self.forcing is not None:
            ksp.setTolerances(rtol=self.forcing.tight_tolerance())
        ksp.setOperators(self.operator, self.stiffness.matrix)
        ksp.solve(self.balance.work_vector, self.correction)
        return bool(ksp.reason > 0)

    def correct(self, little: float) -> tuple[float, int] | None:
        """K correction = balance.work_vector, by CG down to what is `little`, N, and to what the study asks of it, or
        as the KSP does it: |r| that is left, infinite where nothing is known, and iterations; None: not solved."""
        if self._ending is None or self.ksp.getType() != "cg":
            return (np.inf, self.ksp.its) if self.solve() else None
        ending, tangent, preconditioner = self._ending, self.stiffness.matrix, self.preconditioner
        if not self.balance.scheme.inertia:
            little *= AT_REST
        if self._asked:
            little = min(little, self._asked * self.balance.work_vector.norm())
        self._assemble_tangent()
        products = self._products or tangent
        solved = ending.solve(
            products, tangent, preconditioner.serving, self.balance.work_vector, self.correction, little
        )
        preconditioner.its = ending.to_share(float(self.ksp.rtol))
        return (ending.residual_norm, ending.iterations) if solved else None

    def destroy(self) -> None:
        """Give back PETSc's objects."""
        self.factors.forget()
        self.preconditioner.forget()
        self.correction.destroy()
        if self._ending is not None:
            self._ending.destroy()
        if self._blocks is not None:
            self._blocks.release_copy()
        self._forget_condensed()
        if self._near_null is not None:
            self._near_null.destroy()


def chosen_options(balance: Balance, given: PetscOptions) -> PetscOptions:
    """The study's options over the defaults."""
    multigrid = given.get("pc_type", "gamg") == "gamg"
    chosen = DEFAULTS | (GAMG_OPTIONS if multigrid else {})
    if multigrid and balance.scheme.inertia:
        # no aggregates across edges that carry nothing; without inertia every edge keeps RESIDUAL_STIFFNESS
        chosen |= {"pc_gamg_threshold": 0.0}
    if not balance.symmetric:
        chosen |= {"ksp_type": "gmres"}
    return chosen | given


def _forcing(balance: Balance, chosen: PetscOptions) -> EisenstatWalkerForcing | ContractionForcing | None:
    """How exactly Newton's method solves; None: always as exactly. (Without inertia a piece hangs by next to nothing: a
    residual that is small leaves its place open.)"""
    rtol = float(chosen["ksp_rtol"])
    if balance.contact.limits_newton_steps:
        return EisenstatWalkerForcing(rtol) if balance.conservative else None
    return ContractionForcing(rtol) if balance.scheme.inertia and chosen["snes_type"] == "newtonls" else None


def _may_change(balance: Balance, given: PetscOptions) -> bool:
    """Whether multigrid of another kind may take over: nobody asked for this one, and inertia holds what hangs."""
    return _is_own(given) and balance.scheme.inertia


def _is_own(given: PetscOptions) -> bool:
    """Whether multigrid is of the program's own choice."""
    return not any(key.startswith(("pc_", "mg_")) for key in given)


def near_nullspace(domain: Domain) -> PETSc.NullSpace:
    """The rigid motions of the whole body, about its centre (solvers.rigid_body_modes)."""
    return rigid_body_nullspace(domain.comm, domain.nodes[: domain.node_count] - (domain.lower + domain.upper) / 2)
