"""Factors instead of iterations, for tangents that no Krylov method gets through: pieces that hang by a thread, or no
compressibility. A shorter step would be no easier.

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


class Factors:
    """The factors of one KSP, which its preconditioner gives way to."""

    def __init__(self, preconditioner: Preconditioner) -> None:
        self._preconditioner = preconditioner
        self._pc: PETSc.PC | None = None

    @contextmanager
    def of(self, ksp: PETSc.KSP) -> Iterator[None]:
        """Solve by factors, for as long as it lasts (collective)."""
        preconditioner, kind = self._preconditioner, ksp.getType()
        iterative, preconditioner.due = preconditioner.pc, Due.REFRESH
        preconditioner.pc = self._pc = self._pc or _made(ksp)
        preconditioner.keep = False
        ksp.setType("preonly")
        yield
        ksp.setType(kind)
        ksp.setPC(iterative)
        preconditioner.pc, preconditioner.due, preconditioner.keep = iterative, Due.REBUILD, True

    def forget(self) -> None:
        """Give their memory back (collective)."""
        if self._pc is not None:
            self._pc.destroy()
            self._pc = None


def _made(ksp: PETSc.KSP) -> PETSc.PC:
    pc = PETSc.PC().create(ksp.comm)
    pc.setType("lu")
    pc.setFactorSolverType("mumps")
    return pc
