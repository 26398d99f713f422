"""Linear systems with the tangent of a balance: one KSP, its preconditioner, and factors in their place.

Newton's method asks for the tangent at its iterates (`LinearSolver.linearise`); single solves are made here. A step of
a linear balance is one solve by CG, which starts from the combination of earlier solutions that is nearest in energy
(P. F. Fischer, Projection techniques for iterative solution of Ax = b with successive right-hand sides, 1998).

Equations: docs/theory.md#linear-systems.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from ..mechanics.balance import Balance
from .direct_solver import DirectSolver
from .forcing_terms import ContractionForcing, EisenstatWalkerForcing
from .petsc_options import PetscOptions, PetscOptionSet, call_petsc
from .plain_solver import PlainPreconditioner, plain_method
from .policy import SolverPolicy
from .preconditioner import GAMG_OPTIONS, Preconditioner, Update
from .tangent_operators import TangentOperators

Values = npt.NDArray[np.float64]

# The first guess of CG is made from 10 earlier solutions and their forces.
FISCHER_OPTIONS: PetscOptions = {"ksp_guess_type": "fischer", "ksp_guess_fischer_model": "1,10"}
# Options of a study that leave a linear step a single solve: they show nothing and choose no other method.
SINGLE_SOLVE_OPTIONS = ("snes_rtol", "ksp_rtol", "ksp_type")
DEFAULT_OPTIONS: PetscOptions = {
    "snes_type": "newtonls",
    "snes_linesearch_type": "bt",
    "snes_max_it": 50,  # near a limit the last digits would decide whether a step is halved
    "snes_rtol": 1e-6,  # 1e-4 takes the first guess for the solution where cells are slivers
    "snes_stol": 0.0,
    "snes_lag_preconditioner": -2,  # SNES never sets it up: the preconditioner decides for itself
    "snes_lag_preconditioner_persists": True,
    "ksp_type": "cg",
    "ksp_rtol": 1e-5,  # 1e-3 is no direction of descent for a badly conditioned body: a cantilever fails
    "ksp_max_it": 500,
}


class LinearStepCG:
    """CG for solves that end a step, down to a given residual.

    Attributes:
        iterations: of the last solve.    residual_norm: |r| after it, N.
    """

    def __init__(self, comm: object, max_iterations: int, policy: SolverPolicy) -> None:
        self._ksp = ksp = PETSc.KSP().create(comm)
        self._options = PetscOptionSet(FISCHER_OPTIONS)
        ksp.setOptionsPrefix(self._options.prefix)
        ksp.setType("cg")
        ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
        ksp.setFromOptions()
        ksp.setConvergenceHistory(max_iterations + 1, reset=True)
        self._max_iterations, self._policy = max_iterations, policy
        self.iterations, self.residual_norm = 0, 0.0

    def solve(self, A: PETSc.Mat, K: PETSc.Mat, pc: PETSc.PC, b: PETSc.Vec, x: PETSc.Vec, tolerance: float) -> bool:
        """Solve K x = b down to |r| = `tolerance`, N; A is K for products.

        Returns whether it is solved (collective).
        """
        ksp = self._ksp
        pc.setReusePreconditioner(True)
        ksp.setPC(pc)
        ksp.setOperators(A, K)
        ksp.setTolerances(rtol=0.0, atol=tolerance, max_it=self._max_iterations)
        ksp.solve(b, x)
        self.iterations, self.residual_norm = ksp.its, ksp.norm
        return bool(ksp.reason > 0)

    def equivalent_iterations(self, rtol: float) -> int:
        """Iterations that the last solve would have taken to reduce |r| by `rtol`; 0: too few to tell."""
        first = self._ksp.getConvergenceHistory()[:1]
        if self.iterations < self._policy.min_rate_iterations or not 0 < self.residual_norm < first[0]:
            return 0
        return round(self.iterations * math.log(rtol) / math.log(self.residual_norm / first[0]))

    def destroy(self) -> None:
        """Give back PETSc's objects, and take the options out of its database."""
        self._options.remove()
        self._ksp.destroy()


class LinearSolver:
    """Solves systems with the tangent of a balance, and tells preconditioner and factors the facts they decide by.

    Attributes:
        operators: K as matrices.    tangent: K as the balance assembles it.
        ksp: the Krylov method of Newton's method.    preconditioner, direct: what it solves with.
        forcing: the tolerances of Newton's method; None: always the same one.
        is_iterative: whether the method of the study is a Krylov method.
        steps_are_linear: whether a step is a single solve.
        correction: solution of the last solve that SNES did not ask for.
        failures: solves that failed outright and were taken as no correction.
    """

    def __init__(
        self, balance: Balance, ksp: PETSc.KSP, options: PetscOptionSet, given: PetscOptions, chosen: PetscOptions,
        policy: SolverPolicy, *, plain: bool = False,
    ) -> None:  # fmt: skip
        """`given`: options of the study; `chosen`: with the defaults; `plain`: PETSc alone. InputError where PETSc does
        not take an option (collective)."""
        self.balance, self.tangent, self.ksp, self._policy = balance, balance.tangent, ksp, policy
        self.failures = 0
        self._equivalent: int | None = None  # of the last solve to full accuracy; None: as many as the KSP took
        self.correction = balance.work_vector.duplicate()
        self.operators = TangentOperators(
            balance, policy, for_multigrid=chosen["pc_type"] in ("gamg", "ml", "hypre"),
            may_use_blocks=chosen["pc_type"] == "gamg" and not plain,
        )  # fmt: skip
        call_petsc(ksp.setFromOptions)
        options.check(given, self._set_up_at_rest)
        self.is_iterative = ksp.getType() != "preonly"
        self.preconditioner: Preconditioner | PlainPreconditioner
        if plain:
            self.preconditioner = PlainPreconditioner(ksp)
        else:
            self.preconditioner = Preconditioner(
                ksp, options, balance, policy, is_default=_is_default_preconditioner(given), keeps=self.is_iterative,
                has_block_products=self.operators.products is not None,
            )  # fmt: skip
        self._asked_rtol = float(given.get("ksp_rtol", 0.0))
        self.steps_are_linear = steps_are_linear(balance, given, ksp.getType())
        is_single_cg = self.steps_are_linear and self.is_iterative
        self._step_cg = LinearStepCG(ksp.comm, int(ksp.max_it), policy) if is_single_cg else None
        self.forcing = None if self._asked_rtol else _forcing(balance, chosen, policy)
        dofs = balance.work_vector.getSize()
        self.direct = DirectSolver(symmetric=balance.symmetric, dofs=dofs, dim=balance.domain.dim, policy=policy)
        self.operators.tell_of_pattern(self.preconditioner, self.direct)

    def _set_up_at_rest(self) -> None:
        self.operators.assemble(None)
        self.operators.update_entries()
        self.ksp.setOperators(self.tangent.matrix)
        self.ksp.setUp()

    # --- facts ---

    def edges_broke(self, count: int | None) -> None:
        """So many edges broke on all ranks; None: an unknown number."""
        self.preconditioner.edges_broke(count)

    def _tell_of_last_solve(self) -> None:
        iterations = int(self.ksp.its)
        self.preconditioner.solved(iterations, iterations if self._equivalent is None else self._equivalent)

    def shrink(self) -> bool:
        """Take a smaller tangent where damage has made one possible and the preconditioner is due anyway; whether there
        is a new matrix (collective)."""
        self._tell_of_last_solve()
        update = self.preconditioner.next_update()
        if self.direct.serves:
            update = max(update, Update.REFRESH)  # factors are made for each tangent
        if update == Update.NONE:
            return False
        return self.operators.shrink(1.0 if update == Update.REBUILD else self._policy.shrink_below)

    # --- the tangent of Newton's method ---

    def linearise(self, norm: float, solved_norm: float, eigenvalue_floor: float | None) -> None:
        """Bring the tangent, its preconditioner and the tolerance of the KSP to an iterate of Newton's method.

        `norm`: |r| there, `solved_norm`: that of a solution, N; `eigenvalue_floor`: see TangentOperators (collective).
        """
        forcing = self.forcing
        if forcing is None:
            self._prepare(eigenvalue_floor)
            return
        self._equivalent = forcing.equivalent_iterations(self.ksp.its)
        if isinstance(forcing, EisenstatWalkerForcing):
            self._prepare(eigenvalue_floor)
            touches = self.tangent.has_contact_coupling
            rtol = forcing.tolerance_for(norm, solved_norm) if touches else forcing.tight_tolerance()
        else:
            keeps_tangent = forcing.record_iterate(norm, solved_norm, self._residual_left_by_cg)
            keeps_tangent = keeps_tangent and self.operators.eigenvalue_floor == eigenvalue_floor
            if not keeps_tangent:
                self._prepare(eigenvalue_floor)
                if self.ksp.getType() == "cg":
                    self.operators.multiply_by(self.preconditioner.fine_level)
            rtol = forcing.tolerance_for(solved_norm, kept=keeps_tangent)
        self.ksp.setTolerances(rtol=rtol)

    def _residual_left_by_cg(self) -> float:
        """|r| that the last solve of CG has left of the linear system, N; 0 of other methods (collective)."""
        return float(self.ksp.buildResidual(self.correction).norm()) if self.ksp.getType() == "cg" else 0.0

    def _prepare(self, eigenvalue_floor: float | None) -> None:
        """Assemble the tangent, and bring what solves with it to it (collective)."""
        self.operators.assemble(eigenvalue_floor)
        self.operators.update_products()
        self._tell_of_last_solve()
        tangent = self.tangent
        if (tangent.low_rank_updates or tangent.stiff_couplings) and self.ksp.getType() == "preonly":
            self.ksp.setType("gmres")  # factors are of the matrix alone
        if self.direct.serves:
            self.direct.update(self.ksp, self.operators)
        else:
            self.preconditioner.update(self.operators)
        self._add_springs(self.direct.pc if self.direct.serves else self.preconditioner.serving)

    def _add_springs(self, base: PETSc.PC) -> None:
        """Precondition with the springs of the balance as well, where it has any (collective)."""
        springs = [spring for spring in self.tangent.stiff_couplings if len(spring.stiffness)]
        if not springs:
            self.ksp.setPC(base)
            return
        from .low_rank import WoodburyPreconditioner

        base.setReusePreconditioner(True)
        context = WoodburyPreconditioner(base, springs, self.balance.work_vector)
        pc = PETSc.PC().createPython(context, comm=self.ksp.comm)
        self.ksp.setPC(pc)
        pc.destroy()

    # --- single solves ---

    def may_factorise(self, max_dofs: int | None = None) -> bool:
        """Whether a system of at most so many dofs may be factorised; None: as many as the policy allows."""
        limit = self._policy.max_direct_dofs if max_dofs is None else max_dofs
        dofs = self.balance.work_vector.getSize()
        return self.is_iterative and dofs <= limit and bool(PETSc.Sys.hasExternalPackage("mumps"))

    @contextmanager
    def factors(self) -> Iterator[None]:
        """Solve by factors within the block (collective)."""
        try:
            with self.direct.serving(self.ksp, self.preconditioner.pc):
                yield
        finally:
            self.preconditioner.bypassed()

    def response(self, force: Values, *, directly: bool) -> Values:
        """Linear displacement response of a step to a force on free dofs, (owned dofs,) m; nothing touches the body.

        Tangents of nearly incompressible bodies may be indefinite: factors are taken where iterations fail, with
        `directly` at once. The response is 0 where neither solves, which is counted (collective).
        """
        methods: list[Callable[[], AbstractContextManager[None]]] = [nullcontext]
        if self.may_factorise():
            methods.append(self.factors)
        for method in methods[1:] if directly else methods:
            self.balance.work_vector.array_w[:] = force
            with self.tangent.without_contact(), method():
                solved = self.solve()
            if solved:
                return np.asarray(self.correction.array_r.copy())
        self.failures += 1
        return np.zeros_like(force)

    def extend(self, x: PETSc.Vec, eigenvalue_floor: float | None) -> int:
        """Carry a jump of the prescribed displacement into the body linearly; returns the Krylov iterations."""
        self.balance.assemble_extension_residual(x, self.balance.work_vector)
        if not self.balance.work_vector.norm():  # nothing is free to move
            return 0
        if not self.solve(eigenvalue_floor):
            self.failures += 1
        x.axpy(-1.0, self.correction)
        return int(self.ksp.its)

    def solve(self, eigenvalue_floor: float | None = None) -> bool:
        """Solve K correction = balance.work_vector at the present displacement; returns whether it is solved
        (collective)."""
        ksp = self.ksp
        self._prepare(eigenvalue_floor)
        self._equivalent = None
        if self.forcing is not None:
            ksp.setTolerances(rtol=self.forcing.tight_tolerance())
        ksp.setOperators(self.operators.operator, self.operators.matrix)
        ksp.solve(self.balance.work_vector, self.correction)
        return bool(ksp.reason > 0)

    def solve_linear_step(self, solved_norm: float, eigenvalue_floor: float | None) -> tuple[float, int] | None:
        """Solve K correction = balance.work_vector down to a residual norm of `solved_norm`, N, or as the study asks.

        Returns |r| that is left, infinite where it is unknown, and iterations; None: it was not solved (collective).
        """
        if self._step_cg is None or self.ksp.getType() != "cg":
            return (np.inf, self.ksp.its) if self.solve(eigenvalue_floor) else None
        if not self.balance.scheme.inertia:
            solved_norm *= self._policy.static_residual
        if self._asked_rtol:
            solved_norm = min(solved_norm, self._asked_rtol * self.balance.work_vector.norm())
        self._prepare(eigenvalue_floor)
        K, pc, cg = self.operators.matrix, self.preconditioner.serving, self._step_cg
        solved = cg.solve(self.operators.products or K, K, pc, self.balance.work_vector, self.correction, solved_norm)
        self._equivalent = cg.equivalent_iterations(float(self.ksp.rtol))
        return (cg.residual_norm, cg.iterations) if solved else None

    def linear_step_failed(self) -> None:
        """Newton's method takes over: from here on the iterations of its KSP count."""
        self._equivalent = None

    def destroy(self) -> None:
        """Give back PETSc's objects."""
        self.direct.release()
        self.preconditioner.destroy()
        self.correction.destroy()
        if self._step_cg is not None:
            self._step_cg.destroy()
        self.operators.destroy()


def chosen_options(balance: Balance, given: PetscOptions, *, plain: bool = False, policy: SolverPolicy) -> PetscOptions:
    """Options of a study over the defaults; `plain`: over those of plain_solver."""
    if plain:
        return DEFAULT_OPTIONS | plain_method(balance, given, policy) | given
    multigrid = given.get("pc_type", "gamg") == "gamg"
    chosen = DEFAULT_OPTIONS | (GAMG_OPTIONS if multigrid else {})
    if multigrid and balance.scheme.inertia:
        # No aggregates across edges that carry nothing. Without inertia every edge keeps RESIDUAL_STIFFNESS.
        chosen |= {"pc_gamg_threshold": 0.0}
    if not balance.symmetric:
        chosen |= {"ksp_type": "gmres"}
    return chosen | given


def steps_are_linear(balance: Balance, given: PetscOptions, method: str) -> bool:
    """Whether a step is a single solve: of a linear balance by CG or factors, as the study asks for no other way."""
    allowed = all(key in SINGLE_SOLVE_OPTIONS or key.startswith(("pc_", "mg_")) for key in given)
    # Without inertia a fragment hangs by 1e-8 of its stiffness: a small residual leaves its position open.
    has_fragments = balance.stress.chi is not None and not balance.scheme.inertia
    holds = method == "preonly" or (method == "cg" and not has_fragments)
    return allowed and balance.linear and balance.symmetric and holds


def _forcing(
    balance: Balance, chosen: PetscOptions, policy: SolverPolicy
) -> EisenstatWalkerForcing | ContractionForcing | None:
    """The tolerances of Newton's method; None: `ksp_rtol` always, as without inertia fragments hang by next to nothing
    and a small residual leaves their position open."""
    rtol = float(chosen["ksp_rtol"])
    if balance.contact.limits_newton_steps:
        return EisenstatWalkerForcing(rtol, policy) if balance.conservative else None
    inexact = balance.scheme.inertia and chosen["snes_type"] == "newtonls"
    return ContractionForcing(rtol, policy) if inexact else None


def _is_default_preconditioner(given: PetscOptions) -> bool:
    """Whether the study chooses no preconditioner."""
    return not any(key.startswith(("pc_", "mg_")) for key in given)
