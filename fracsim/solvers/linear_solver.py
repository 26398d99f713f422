"""Linear systems with the tangent of a balance: one KSP, its preconditioner, and a direct solver in their place.

Newton's method asks for the tangent at its iterates (`LinearSolver.linearise`). A step of a linear balance is one solve
by CG, which starts from the combination of earlier solutions that is nearest in energy (Fischer 1998).

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
from .forcing_terms import ContractionForcing
from .petsc_options import PetscOptions, PetscOptionSet, call_petsc
from .plain_solver import PlainPreconditioner, plain_method
from .policy import SolverPolicy
from .preconditioner import GAMG_OPTIONS, Preconditioner, Update, renew_smoothers, renew_smoothers_before_solve
from .tangent_operators import TangentOperators

Values = npt.NDArray[np.float64]

# The first guess of CG is made from 10 earlier solutions and their forces.
FISCHER_OPTIONS: PetscOptions = {"ksp_guess_type": "fischer", "ksp_guess_fischer_model": "1,10"}
# Options of a study that leave a linear step a single solve: they show nothing and choose no other method.
SINGLE_SOLVE_OPTIONS = ("snes_rtol", "ksp_rtol", "ksp_type")
DEFAULT_OPTIONS: PetscOptions = {
    "snes_type": "newtonls",
    "snes_linesearch_type": "bt",
    # Far above the usual number: near a limit the last digits would decide whether a step is halved.
    "snes_max_it": 50,
    # With 1e-4 the first guess counts as a solution where cells are slivers.
    "snes_rtol": 1e-6,
    "snes_stol": 0.0,
    # SNES never sets the preconditioner up, which decides for itself.
    "snes_lag_preconditioner": -2,
    "snes_lag_preconditioner_persists": True,
    "ksp_type": "cg",
    # With 1e-3 corrections of a badly conditioned body are no directions of descent: a cantilever fails.
    "ksp_rtol": 1e-5,
    "ksp_max_it": 500,
}


class LinearStepCG:
    """CG for steps of a linear balance, down to a given residual.

    Attributes:
        iterations: of the last solve.
        residual_norm: |r| after it, N.
    """

    def __init__(self, comm: object, max_iterations: int, policy: SolverPolicy) -> None:
        self._residual: PETSc.Vec | None = None
        self._ksp = ksp = PETSc.KSP().create(comm)
        self._options = PetscOptionSet(FISCHER_OPTIONS)
        ksp.setOptionsPrefix(self._options.prefix)
        ksp.setType("cg")
        # The tolerance is on the forces r; PETSc would test the norm of M r.
        ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
        ksp.setFromOptions()
        ksp.setConvergenceHistory(max_iterations + 1, reset=True)
        ksp.setPreSolve(renew_smoothers_before_solve)
        self._max_iterations, self._policy = max_iterations, policy
        self.iterations, self.residual_norm = 0, 0.0

    def solve(self, A: PETSc.Mat, K: PETSc.Mat, pc: PETSc.PC, b: PETSc.Vec, x: PETSc.Vec, tolerance: float) -> bool:
        """Solve K x = b down to |r| = `tolerance`, N; A is K for products (collective).

        Returns:
            Whether CG says that it is solved. `residual_norm` is |b - A x|, which CG's recursion may fall below.
        """
        ksp = self._ksp
        # PETSc would set the preconditioner up again for each new tangent.
        pc.setReusePreconditioner(True)
        ksp.setPC(pc)
        ksp.setOperators(A, K)
        ksp.setTolerances(rtol=0.0, atol=tolerance, max_it=self._max_iterations)
        ksp.solve(b, x)
        # KSP.buildResidual gives that of the recursion, too
        self._residual = self._residual or b.duplicate()
        A.mult(x, self._residual)
        self._residual.axpy(-1.0, b)
        self.iterations, self.residual_norm = ksp.its, float(self._residual.norm())
        return bool(ksp.reason > 0)

    def equivalent_iterations(self, rtol: float) -> int:
        """Return the iterations in which the last solve would have reduced |r| by `rtol`.

        0 if its iterations are too few.
        """
        first = self._ksp.getConvergenceHistory()[:1]
        if self.iterations < self._policy.min_rate_iterations or not 0 < self.residual_norm < first[0]:
            return 0
        return round(self.iterations * math.log(rtol) / math.log(self.residual_norm / first[0]))

    def destroy(self) -> None:
        """Free PETSc's objects, and remove the options from its database."""
        self._options.remove()
        if self._residual is not None:
            self._residual.destroy()
        self._ksp.destroy()


class LinearSolver:
    """Solver of systems with the tangent, which tells preconditioner and direct solver the facts by which they decide.

    Attributes:
        operators: K as matrices.
        tangent: K as the balance assembles it.
        ksp: Krylov method of Newton's method.
        preconditioner: preconditioner of `ksp`.
        direct: direct solver.
        forcing: tolerances of Newton's method; None: always the same one.
        is_iterative: whether the method of the study is a Krylov method.
        steps_are_linear: whether a step is a single solve.
        correction: solution of the last solve that SNES did not ask for.
        failures: number of failed solves whose correction was left out.
    """

    def __init__(
        self, balance: Balance, ksp: PETSc.KSP, options: PetscOptionSet, given: PetscOptions, chosen: PetscOptions,
        policy: SolverPolicy, *, plain: bool = False,
    ) -> None:  # fmt: skip
        """Set up the solver (collective).

        Args:
            balance: balance of forces.
            ksp: Krylov method of a SNES.
            options: options of that SNES in PETSc's database.
            given: options of the study.
            chosen: options of the study over the defaults.
            policy: tuned numbers.
            plain: use PETSc alone.

        Raises:
            InputError: PETSc refuses an option.
        """
        self.balance, self.tangent, self.ksp, self._policy = balance, balance.tangent, ksp, policy
        self.failures = 0
        # Iterations of the last solve to the tight tolerance; None: those of the KSP.
        self._equivalent: int | None = None
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
            )  # fmt: skip
        self._asked_rtol = float(given.get("ksp_rtol", 0.0))
        self.steps_are_linear = steps_are_linear(balance, given, ksp.getType())
        is_single_cg = self.steps_are_linear and self.is_iterative
        self._step_cg = LinearStepCG(ksp.comm, int(ksp.max_it), policy) if is_single_cg else None
        # SNES asks the KSP to keep the set-up of its preconditioner after each tangent
        ksp.setPreSolve(renew_smoothers_before_solve)
        self.forcing = None if self._asked_rtol else _forcing(balance, chosen, policy)
        dofs = balance.work_vector.getSize()
        self.direct = DirectSolver(symmetric=balance.symmetric, dofs=dofs, dim=balance.domain.dim, policy=policy)
        self.operators.add_pattern_listeners(self.preconditioner, self.direct)

    def _set_up_at_rest(self) -> None:
        """Assemble the tangent at rest and set up the KSP (collective)."""
        self.operators.assemble(None)
        self.operators.update_entries()
        self.ksp.setOperators(self.tangent.matrix)
        self.ksp.setUp()

    # --- facts ---

    def edges_broke(self, count: int | None) -> None:
        """Note that `count` edges broke on all ranks; None: an unknown number."""
        self.preconditioner.edges_broke(count)

    def _tell_of_last_solve(self) -> None:
        """Tell the preconditioner of the iterations of the last solve."""
        iterations = int(self.ksp.its)
        self.preconditioner.solved(iterations, iterations if self._equivalent is None else self._equivalent)

    def shrink(self) -> bool:
        """Remove the entries of dead cells, if the preconditioner is to be updated anyway (collective).

        Returns:
            Whether there is a new matrix.
        """
        self._tell_of_last_solve()
        update = self.preconditioner.next_update()
        if self.direct.serves:
            # Each tangent is factorised anew.
            update = max(update, Update.REFRESH)
        if update == Update.NONE:
            return False
        return self.operators.shrink(1.0 if update == Update.REBUILD else self._policy.shrink_below)

    # --- the tangent of Newton's method ---

    def linearise(self, norm: float, solved_norm: float, eigenvalue_floor: float | None) -> None:
        """Update tangent, preconditioner and tolerance of the KSP to an iterate of Newton's method (collective).

        Args:
            norm: |r| there, N.
            solved_norm: |r| of a solution, N.
            eigenvalue_floor: see `TangentOperators`.
        """
        forcing = self.forcing
        if forcing is None:
            self._prepare(eigenvalue_floor)
            return
        self._equivalent = forcing.equivalent_iterations(self.ksp.its)
        keeps_tangent = forcing.record_iterate(norm, solved_norm, self._residual_left_by_cg)
        keeps_tangent = keeps_tangent and self.operators.eigenvalue_floor == eigenvalue_floor
        if not keeps_tangent:
            self._prepare(eigenvalue_floor)
            if self.ksp.getType() == "cg":
                self.operators.multiply_by(self.preconditioner.fine_level)
        rtol = forcing.tolerance_for(solved_norm, exact=not keeps_tangent and eigenvalue_floor is None)
        # Without inertia a fragment is attached by 1e-8 of its stiffness: a small residual leaves its position open.
        if not self.balance.scheme.inertia and not self.tangent.couplings.has_contact:
            rtol = forcing.tight_tolerance()
        self.ksp.setTolerances(rtol=rtol)

    def begin_attempt(self) -> None:
        """Begin an attempt of Newton's method."""
        if self.forcing is not None:
            self.forcing.begin_attempt()

    def _residual_left_by_cg(self) -> float:
        """Return |r| that the last solve of CG has left of the linear system, N; 0 of other methods (collective)."""
        return float(self.ksp.buildResidual(self.correction).norm()) if self.ksp.getType() == "cg" else 0.0

    def _prepare(self, eigenvalue_floor: float | None) -> None:
        """Assemble the tangent, and update preconditioner or factors to it (collective)."""
        tangent = self.tangent
        # factors of a body without its contact would leave many iterations
        tangent.couplings.keep_beside(self.ksp.getType() != "preonly" and not self.direct.serves)
        self.operators.assemble(eigenvalue_floor)
        self._tell_of_last_solve()
        if tangent.low_rank_updates and self.ksp.getType() == "preonly":
            # Factors leave out the low-rank updates: they are a preconditioner, and no direct solver.
            self.ksp.setType("gmres")
        if self.direct.serves:
            self.direct.update(self.ksp, self.operators)
            return
        self.preconditioner.update(self.operators)
        self._attach_preconditioner()

    def _attach_preconditioner(self) -> None:
        """Give the KSP its preconditioner, with exact solutions for nodes that this one does not know (collective).

        These are nodes of a coupling beside the tangent, and nodes whose stiffness has changed since the set-up.
        """
        base, changed = self.preconditioner.serving, self.preconditioner.changed_nodes
        if changed is None and self.tangent.couplings.beside is None:
            self.ksp.setPC(base)
            return
        from .balancing import solve_nodes_exactly

        base.setReusePreconditioner(True)
        renew_smoothers(base)
        pc = solve_nodes_exactly(base, self.tangent, changed, self.balance.work_vector)
        self.ksp.setPC(pc)
        pc.destroy()

    # --- single solves ---

    def may_factorise(self, max_dofs: int | None = None) -> bool:
        """Return True if a system may be factorised: of at most `max_dofs` dofs, or as many as the policy allows."""
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
        """Return the linear displacement response of a step without contact, (owned dofs,), m (collective).

        0, with a count of the failure, if no method solves.

        Args:
            force: on free dofs, (owned dofs,), N.
            directly: factorise at once, rather than where iterations fail.
        """
        # Tangents of nearly incompressible bodies may be indefinite, so that iterations fail.
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

    def extend(self, x: PETSc.Vec, eigenvalue_floor: float | None, free_fraction: float | None = None) -> int:
        """Extend a jump of the prescribed displacement into the body; return the Krylov iterations (collective).

        Args:
            x: displacement, changed in place.
            eigenvalue_floor: see `TangentOperators`.
            free_fraction: see `Balance.assemble_extension_residual`.
        """
        self.balance.assemble_extension_residual(x, self.balance.work_vector, free_fraction)
        # Without a force on a free dof there is nothing to extend.
        if not self.balance.work_vector.norm():
            return 0
        if not self.solve(eigenvalue_floor):
            self.failures += 1
        x.axpy(-1.0, self.correction)
        return int(self.ksp.its)

    def solve(self, eigenvalue_floor: float | None = None) -> bool:
        """Solve K correction = balance.work_vector at the present displacement.

        Return True if it is solved (collective).
        """
        ksp = self.ksp
        self._prepare(eigenvalue_floor)
        self._equivalent = None
        if self.forcing is not None:
            ksp.setTolerances(rtol=self.forcing.tight_tolerance())
        ksp.setOperators(self.operators.operator, self.operators.matrix)
        ksp.solve(self.balance.work_vector, self.correction)
        return bool(ksp.reason > 0)

    def solve_linear_step(self, solved_norm: float, eigenvalue_floor: float | None) -> tuple[float, int] | None:
        """Solve K correction = balance.work_vector for a step of a linear balance (collective).

        Args:
            solved_norm: |r| of a solution, N; a tolerance of the study may be smaller.
            eigenvalue_floor: see `TangentOperators`.

        Returns:
            |r| that is left, inf if it is unknown, and iterations; None if it was not solved.
        """
        if self._step_cg is None or self.ksp.getType() != "cg":
            return (np.inf, self.ksp.its) if self.solve(eigenvalue_floor) else None
        if not self.balance.scheme.inertia:
            solved_norm *= self._policy.static_residual
        if self._asked_rtol:
            solved_norm = min(solved_norm, self._asked_rtol * self.balance.work_vector.norm())
        self._prepare(eigenvalue_floor)
        K, pc, cg = self.operators.matrix, self.ksp.getPC(), self._step_cg
        solved = cg.solve(self.operators.products or K, K, pc, self.balance.work_vector, self.correction, solved_norm)
        self._equivalent = cg.equivalent_iterations(float(self.ksp.rtol))
        return (cg.residual_norm, cg.iterations) if solved else None

    def linear_step_failed(self) -> None:
        """Note that Newton's method takes over: the iterations of its KSP count."""
        self._equivalent = None

    def destroy(self) -> None:
        """Free PETSc's objects."""
        self.direct.release()
        self.preconditioner.destroy()
        self.correction.destroy()
        if self._step_cg is not None:
            self._step_cg.destroy()
        self.operators.destroy()


def chosen_options(balance: Balance, given: PetscOptions, *, plain: bool = False, policy: SolverPolicy) -> PetscOptions:
    """Return the options of a study over the defaults; `plain`: over those of plain_solver."""
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
    """Return True if a step is one linear solve: of a linear balance, by CG or factors, without other options."""
    allowed = all(key in SINGLE_SOLVE_OPTIONS or key.startswith(("pc_", "mg_")) for key in given)
    # Without inertia a small residual leaves the position of a fragment open (`linearise`).
    has_fragments = balance.stress.chi is not None and not balance.scheme.inertia
    holds = method == "preonly" or (method == "cg" and not has_fragments)
    return allowed and balance.linear and balance.symmetric and holds


def _forcing(balance: Balance, chosen: PetscOptions, policy: SolverPolicy) -> ContractionForcing | None:
    """Return the tolerances of Newton's method; None: `ksp_rtol` in every solve."""
    has_contact = balance.contact.limits_newton_steps
    may_be_rough = balance.conservative if has_contact else balance.scheme.inertia
    inexact = may_be_rough and chosen["snes_type"] == "newtonls"
    return ContractionForcing(float(chosen["ksp_rtol"]), policy) if inexact else None


def _is_default_preconditioner(given: PetscOptions) -> bool:
    """Return True if the study chooses no preconditioner."""
    return not any(key.startswith(("pc_", "mg_")) for key in given)
