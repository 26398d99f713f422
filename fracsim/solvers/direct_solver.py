"""Factors instead of iterations, for tangents that no Krylov method gets through: pieces that hang by a thread, or no
compressibility. A shorter step would be no easier. And where CG takes more iterations than factors cost.

What factors cost is known once they have been made: MUMPS counts the operations of its elimination (RINFOG(3)). With
`FLOPS` of them for each entry of the tangent they take as long as an iteration of CG with multigrid: measured 4 to 16,
of 13 bodies in the plane and in space, slender, thin, compact, linear, quadratic, with 600 to 100,000 dofs. In the
plane they are worth 15 to 70 iterations, in space 30 (600 dofs) to 600 (compact, 15,000). A symmetric tangent is
factorised as one (L D L^T: half the operations), and D tells whether it is positive, as that of a stable balance is.

MUMPS orders the unknowns once for a pattern, a third of the time in the plane: the object is kept from solve to solve
until iterations have their turn again, since its factors are memory.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from petsc4py import PETSc

from .preconditioner import Due, Preconditioner

# dofs up to which a system that no Krylov method gets through is factorised: seconds, and a few GB at most
FACTORISED = 100_000
# dofs up to which that takes no longer than GMRES does to give up, by dimension
SOONER_THAN_GMRES = {2: FACTORISED, 3: 10_000}
TRIED, FLOPS = 40, 11  # iterations for one tangent from which on it is tried what factors cost; see above
# iterations of one solve after which it goes on with factors on trial: four tangents' worth, or what factors cost at
# most in space, where a compact body of n dofs takes n / 16
MANY, COMPACT = 4, 1 / 16


class DirectSolver:
    """The factors of one KSP, which its preconditioner gives way to.

    Attributes:
        worth: iterations of CG that take as long as making them, as far as is known.
        dear: iterations of a solve from which on it may go on with factors.
        positive: whether the last tangent was, as far as factors tell: only those of a symmetric one do.
    """

    def __init__(self, preconditioner: Preconditioner, *, symmetric: bool, dofs: int, dim: int) -> None:
        """`symmetric`: all tangents are."""
        self._preconditioner, self._symmetric = preconditioner, symmetric
        self.worth, self.positive = float(TRIED), True
        self.dear = max(MANY * TRIED, dofs * COMPACT if dim == 3 else 0.0)
        self._pc: PETSc.PC | None = None

    @contextmanager
    def of(self, ksp: PETSc.KSP) -> Iterator[None]:
        """Solve by factors, for as long as it lasts (collective)."""
        preconditioner, kind = self._preconditioner, ksp.getType()
        iterative, preconditioner.due = preconditioner.pc, Due.REFRESH
        preconditioner.pc = self._pc = self._pc or self._made(ksp)
        preconditioner.keep = False
        ksp.setType("preonly")
        try:
            yield
        finally:
            ksp.setType(kind)
            ksp.setPC(iterative)
            preconditioner.pc, preconditioner.due, preconditioner.keep = iterative, Due.REBUILD, True
            if ksp.reason == PETSc.KSP.ConvergedReason.DIVERGED_PCSETUP_FAILED:
                self.forget()  # PETSc takes them for set up the next time, and MUMPS has nothing to solve with

    def forget(self) -> None:
        """Give their memory back (collective)."""
        if self._pc is not None:
            self._pc.destroy()
            self._pc = None

    def _made(self, ksp: PETSc.KSP) -> PETSc.PC:
        pc = PETSc.PC().create(ksp.comm)
        pc.setType("cholesky" if self._symmetric else "lu")
        pc.setFactorSolverType("mumps")
        return pc

    def learn(self, ksp: PETSc.KSP) -> None:
        """What the factors cost that have just served, and what they tell (collective).

        With springs beside the tangent the KSP's own preconditioner is what has them in it (solvers.low_rank).
        """
        assert self._pc is not None
        factors, entries = self._pc.getFactorMatrix(), ksp.getOperators()[1].getInfo(PETSc.Mat.InfoType.GLOBAL_SUM)
        self.worth = factors.getMumpsRinfog(3) / (FLOPS * entries["nz_used"])
        self.dear = MANY * self.worth
        self.positive = not self._symmetric or factors.getMumpsInfog(12) == 0  # negative pivots
