"""Factors of the tangent in place of Krylov iterations, and what they cost.

Factors serve where no Krylov method converges (fragments that hang by a thread, nearly incompressible bodies), where a
shorter step would be no easier, and where CG takes more iterations than factors cost. MUMPS counts the operations of
its elimination, from which the number of iterations that take as long is known (`SolverPolicy.flops_per_iteration`).

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
    """Factors of the tangent by MUMPS, which serve a KSP in place of its preconditioner.

    Symmetric tangents are factorised as L D L^T, at half the operations; D tells whether they are positive definite.
    The ordering of the unknowns, a third of the time in the plane, is kept until the pattern changes or `release`.

    Attributes:
        equivalent_iterations: iterations of CG that take as long as the factors of one tangent, as far as is known.
        trial_iterations: iterations of an attempt from which on it may go on with factors.
        is_positive: whether the last tangent was positive definite; True where it is not symmetric.
        serves: whether the KSP solves by factors now.
    """

    def __init__(self, *, symmetric: bool, dofs: int, dim: int, policy: SolverPolicy = DEFAULT_POLICY) -> None:
        """`symmetric`: all tangents are; `dofs`, `dim`: of the body."""
        self._policy, self._symmetric = policy, symmetric
        self.equivalent_iterations, self.is_positive = float(policy.assumed_direct_cost), True
        compact = dofs * policy.compact_direct_cost if dim == 3 else 0.0
        self.trial_iterations = max(policy.tangents_on_trial * policy.assumed_direct_cost, compact)
        self.serves = False
        self._pc: PETSc.PC | None = None

    @contextmanager
    def serving(self, ksp: PETSc.KSP, afterwards: PETSc.PC) -> Iterator[None]:
        """Solve by factors within the block, with the preconditioner `afterwards` after it (collective)."""
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
                self.release()  # PETSc takes failed factors for made the next time

    @property
    def pc(self) -> PETSc.PC:
        """The factors as a preconditioner."""
        assert self._pc is not None
        return self._pc

    def update(self, ksp: PETSc.KSP, operators: TangentOperators) -> None:
        """Factorise the tangent of the next solve (collective)."""
        operators.update_entries()
        if self._pc is None:
            self._pc = PETSc.PC().create(ksp.comm)
            self._pc.setType("cholesky" if self._symmetric else "lu")
            self._pc.setFactorSolverType("mumps")
        operators.set_on(ksp, self._pc)

    def pattern_changed(self) -> None:
        """The tangent has entries at other places: factors of the old ones would be written past their arrays."""
        if self._pc is not None:
            self._pc.reset()

    def measure_cost(self, ksp: PETSc.KSP) -> None:
        """Learn what the factors that served last cost, and whether the tangent is positive definite (collective).

        The KSP's own preconditioner may be another one, which corrects these factors for springs (low_rank).
        """
        factors, entries = self.pc.getFactorMatrix(), ksp.getOperators()[1].getInfo(PETSc.Mat.InfoType.GLOBAL_SUM)
        operations = factors.getMumpsRinfog(3)
        self.equivalent_iterations = operations / (self._policy.flops_per_iteration * entries["nz_used"])
        self.trial_iterations = self._policy.tangents_on_trial * self.equivalent_iterations
        negative_pivots = factors.getMumpsInfog(12)
        self.is_positive = not self._symmetric or negative_pivots == 0

    def release(self) -> None:
        """Give the memory of the factors back (collective)."""
        if self._pc is not None:
            self._pc.destroy()
            self._pc = None
