"""Direct solver (MUMPS) in place of Krylov iterations, and its cost in iterations.

It serves where no Krylov method converges (fragments that are hardly attached, nearly incompressible bodies), where a
shorter step would be no easier, and where CG takes more iterations than a factorisation costs. MUMPS counts the
operations of its elimination, from which the number of iterations of the same time follows
(`SolverPolicy.flops_per_iteration`).

Equations: docs/theory.md#linear-systems.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from petsc4py import PETSc

from .policy import DEFAULT_POLICY, SolverPolicy

if TYPE_CHECKING:
    from .tangent_operators import TangentOperators


class DirectSolver:
    """Factors of the tangent, which serve a KSP in place of its preconditioner.

    Symmetric tangents are factorised as L D L^T, at half the operations; D tells whether they are positive definite.

    Attributes:
        equivalent_iterations: CG iterations that take as long as one factorisation, as far as is known.
        trial_iterations: iterations of an attempt, above which it may continue with factors.
        is_positive: whether the last tangent was positive definite; True where it is not symmetric.
        serves: whether the KSP solves by factors at present.
    """

    def __init__(self, *, symmetric: bool, dofs: int, dim: int, policy: SolverPolicy = DEFAULT_POLICY) -> None:
        """Prepare the solver; nothing is factorised yet.

        Args:
            symmetric: all tangents are symmetric.
            dofs: number of dofs of the body.
            dim: dimension of the body.
            policy: costs.
        """
        self._policy, self._symmetric = policy, symmetric
        self.equivalent_iterations, self.is_positive = float(policy.assumed_direct_cost), True
        compact = dofs * policy.compact_direct_cost if dim == 3 else 0.0
        self.trial_iterations = max(policy.tangents_on_trial * policy.assumed_direct_cost, compact)
        self.serves = False
        # MUMPS keeps the ordering of the unknowns, a third of the time in 2D, until the pattern changes.
        self._pc: PETSc.PC | None = None

    @contextmanager
    def serving(self, ksp: PETSc.KSP, afterwards: PETSc.PC) -> Iterator[None]:
        """Solve by factors within the block, and with the preconditioner `afterwards` after it (collective)."""
        method = ksp.getType()
        ksp.setType("preonly")
        self.serves = True
        try:
            yield
        finally:
            self.serves = False
            ksp.setType(method)
            ksp.setPC(afterwards)
            if ksp.reason == PETSc.KSP.ConvergedReason.DIVERGED_PCSETUP_FAILED:
                # PETSc would take failed factors as valid in the next solve.
                self.release()

    @property
    def pc(self) -> PETSc.PC:
        """Factors as a preconditioner."""
        assert self._pc is not None
        return self._pc

    def update(self, ksp: PETSc.KSP, operators: TangentOperators) -> None:
        """Factorise the tangent of the next solve (collective)."""
        operators.update_entries()
        if self._pc is None:
            self._pc = PETSc.PC().create(ksp.comm)
            self._pc.setType("cholesky" if self._symmetric else "lu")
            self._pc.setFactorSolverType("mumps")
        operators.attach_to(ksp, self._pc)

    def pattern_changed(self) -> None:
        """Forget the pattern: factors of the old one would be written past their arrays."""
        if self._pc is not None:
            self._pc.reset()

    matrix_ends = pattern_changed

    def measure_cost(self, ksp: PETSc.KSP) -> None:
        """Measure the cost of the last factorisation, and whether the tangent is positive definite (collective)."""
        factors, entries = self.pc.getFactorMatrix(), ksp.getOperators()[1].getInfo(PETSc.Mat.InfoType.GLOBAL_SUM)
        # RINFOG(3) of MUMPS: floating-point operations of the elimination.
        operations = factors.getMumpsRinfog(3)
        self.equivalent_iterations = operations / (self._policy.flops_per_iteration * entries["nz_used"])
        self.trial_iterations = self._policy.tangents_on_trial * self.equivalent_iterations
        # INFOG(12): K = L D L^T has as many negative eigenvalues as D has negative pivots (Sylvester's law of inertia).
        negative_pivots = factors.getMumpsInfog(12)
        self.is_positive = not self._symmetric or negative_pivots == 0

    def release(self) -> None:
        """Free the memory of the factors (collective)."""
        if self._pc is not None:
            self._pc.destroy()
            self._pc = None
