"""The mass matrix, lumped to the nodes or consistent with the shape functions: made once, for it is constant.

Lumped (vertex quadrature, the default) is a vector: inertia costs one product, and a node of debris keeps its own mass.
Consistent is a sparse matrix with the pattern of the tangent: higher frequencies come out too high instead of too low.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from dolfinx.fem import petsc as fem_petsc
from petsc4py import PETSc

from ..mesh.domain import Domain
from .kernels import compile_form

Values = npt.NDArray[np.float64]


class Mass(Protocol):
    """What the equations need of a mass matrix; values are those of the owned dofs."""

    lumped: Values  # kg, of each dof
    diagonal: bool  # whether it is the lumped one; the other also couples the nodes of dead cells

    def times(self, values: Values) -> Values:
        """M a."""

    def solve(self, force: Values, free: npt.NDArray[np.bool_]) -> Values:
        """a with M a = force on free dofs and a = 0 on the others."""

    def add_to(self, tangent: PETSc.Mat, factor: float) -> None:
        """tangent += factor M, leaving rows and columns of prescribed dofs decoupled."""


class LumpedMass:
    """M as a diagonal: int rho w at the vertices."""

    diagonal = True

    def __init__(self, domain: Domain, density: Any, vector: PETSc.Vec) -> None:
        self.lumped = lumped_mass(domain, density)
        self._diagonal = vector.duplicate()

    def times(self, values: Values) -> Values:
        """M a."""
        return self.lumped * values

    def solve(self, force: Values, free: npt.NDArray[np.bool_]) -> Values:
        """a = force / m on free dofs."""
        return np.where(free, force / self.lumped, 0.0)

    def add_to(self, tangent: PETSc.Mat, factor: float) -> None:
        """Add to the diagonal; on prescribed dofs it only scales a row that stands alone."""
        self._diagonal.array_w[:] = factor * self.lumped
        tangent.setDiagonal(self._diagonal, PETSc.InsertMode.ADD)


class ConsistentMass:
    """M = int rho u . w as a matrix."""

    diagonal = False

    def __init__(self, domain: Domain, density: Any, vector: PETSc.Vec, bcs: list[fem.DirichletBC]) -> None:
        self.lumped = lumped_mass(domain, density)
        u, w = ufl.TrialFunction(domain.space), ufl.TestFunction(domain.space)
        form = compile_form(density * ufl.inner(u, w) * ufl.dx(domain=domain.mesh))
        self._whole = fem_petsc.assemble_matrix(form)
        self._whole.assemble()
        self._free = fem_petsc.assemble_matrix(form, bcs=bcs, diagonal=0.0)
        self._free.assemble()
        self._x, self._y = vector.duplicate(), vector.duplicate()

    def times(self, values: Values) -> Values:
        """M a."""
        self._x.array_w[:] = values
        self._whole.mult(self._x, self._y)
        return self._y.array_r.copy()

    def solve(self, force: Values, free: npt.NDArray[np.bool_]) -> Values:
        """Conjugate gradients with the diagonal to 1e-12: some twenty iterations at any mesh size."""
        matrix = self._free.copy()
        self._x.array_w[:] = np.where(free, 0.0, 1.0)
        matrix.setDiagonal(self._x, PETSc.InsertMode.ADD)
        ksp = PETSc.KSP().create(matrix.comm)
        ksp.setOperators(matrix)
        ksp.setType("cg")
        ksp.pc.setType("jacobi")
        ksp.setTolerances(rtol=1e-12)
        self._x.array_w[:] = np.where(free, force, 0.0)
        ksp.solve(self._x, self._y)
        ksp.destroy()
        matrix.destroy()
        return self._y.array_r.copy()

    def add_to(self, tangent: PETSc.Mat, factor: float) -> None:
        """One pass over the stored entries: both have the same pattern."""
        tangent.axpy(factor, self._free, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)


def lumped_mass(domain: Domain, density: Any) -> Values:
    """(owned dofs,) share of each node in the mass of its cells, for each component, kg."""
    w, ones = ufl.TestFunction(domain.space), fem.Constant(domain.mesh, np.ones(domain.dim))
    vertices = ufl.dx(domain=domain.mesh, metadata={"quadrature_rule": "vertex", "quadrature_degree": 1})
    vector = fem_petsc.assemble_vector(compile_form(density * ufl.inner(ones, w) * vertices))
    vector.ghostUpdate(PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
    values = vector.array_r.copy()
    vector.destroy()
    return values
