"""Inertia M a, with a mass matrix lumped to the nodes or consistent with the shape functions: made once.

Lumped (vertex quadrature, the default; with quadratic displacement by the diagonal) is a vector: inertia costs one
product, and a node of debris keeps its own mass.
Consistent is a sparse matrix with the pattern of the tangent: higher frequencies come out too high instead of too low.
As a term of the form it would be integrated anew in every tangent; what it adds to each block of that is kept, a
multiple of 1.

Equations: docs/theory.md#quadratic-displacement.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem, la
from petsc4py import PETSc
from ufl.core.expr import Expr

from ..mesh.dolfinx_compat import assemble_matrix
from ..mesh.domain import Domain
from .jit import compile_form
from .matrix_assembly import VectorAssembler
from .term import Term, TimeLevel

if TYPE_CHECKING:
    from .matrix_assembly import TangentAssembler

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


class MassBlocks(NamedTuple):
    """What inertia adds to blocks of a tangent, multiples of 1 but for prescribed dofs.

    Attributes:
        blocks: (n,) which, of owned rows.    values: (n, d) what is added on the diagonal of each, N/m.
    """

    blocks: Ints | slice
    values: Values


class MassMatrix(Protocol):
    """What the balance needs of a mass matrix; values are those of the owned dofs."""

    lumped: Values  # kg, of each dof
    is_diagonal: bool  # whether it is the lumped one; the other also couples the nodes of dead cells

    def multiply(self, values: Values) -> Values:
        """(owned dofs,) M a of (owned dofs,) a in m/s^2, N."""

    def solve(self, force: Values, free: npt.NDArray[np.bool_]) -> Values:
        """(owned dofs,) a with M a = force (N) on free dofs and a = 0 on the others, m/s^2 (collective)."""

    def add_to(self, tangent: PETSc.Mat, factor: float, *, more_entries: bool = False) -> None:
        """tangent += factor M, leaving rows and columns of prescribed dofs decoupled; `more_entries`: whether the
        tangent may have entries where M has none."""

    def block_values(self, tangent: TangentAssembler, factor: float) -> MassBlocks:
        """factor M, to be added to the blocks of a tangent, which is assembled after this (collective)."""

    def destroy(self) -> None:
        """Give the memory of PETSc's objects back."""


class Inertia(Term):
    """M a, a the acceleration c_a (u - u_a) of the scheme."""

    name = "inertia"
    linear = True

    def __init__(self, u: fem.Function, mass: MassMatrix) -> None:
        self._u, self._mass = u, mass
        self._level: TimeLevel | None = None

    def begin_step(self, level: TimeLevel) -> None:
        """Take up the scheme's acceleration a = c_a (u - u_a) of the level."""
        self._level = level

    @property
    def mass_factor(self) -> float:
        """c_a, 1/s^2: M is multiplied with it in the tangent."""
        assert self._level is not None
        return self._level.c_a

    def acceleration(self) -> Values | None:
        """(owned dofs,) c_a (u - u_a), m/s^2; None where the scheme keeps inertia out of the balance."""
        assert self._level is not None
        u_a = self._level.u_a
        return np.asarray(self.mass_factor * (self._u.x.array[: len(u_a)] - u_a)) if self.mass_factor else None

    def potential(self) -> float:
        """c_a (u - u_a) . M (u - u_a) / 2, J."""
        a = self.acceleration()
        return 0.0 if a is None else float(a @ self._mass.multiply(a)) / (2 * self.mass_factor)

    def reference_forces(self) -> Values | None:
        """(owned dofs,) M c_a (u - u_a), M lumped, N."""
        assert self._level is not None
        u_a, factor = self._level.u_a, self.mass_factor
        return np.asarray(factor * self._mass.lumped * (self._u.x.array[: len(u_a)] - u_a)) if factor else None


class LumpedMass:
    """M as a diagonal: int rho w at the vertices."""

    is_diagonal = True

    def __init__(self, assembler: VectorAssembler, density: Expr) -> None:
        """`density`: kg/m^3, a UFL coefficient."""
        self.lumped = lumped_mass(assembler, density)
        self._diagonal = assembler.create_vector()

    def multiply(self, values: Values) -> Values:
        """(owned dofs,) M a of (owned dofs,) a in m/s^2, N."""
        return self.lumped * values

    def solve(self, force: Values, free: npt.NDArray[np.bool_]) -> Values:
        """(owned dofs,) a = force / m on free dofs, 0 elsewhere, m/s^2."""
        return np.where(free, force / self.lumped, 0.0)

    def add_to(self, tangent: PETSc.Mat, factor: float, *, more_entries: bool = False) -> None:
        """Add to the diagonal; on prescribed dofs it only scales a row that stands alone."""
        self._diagonal.array_w[:] = factor * self.lumped
        tangent.setDiagonal(self._diagonal, PETSc.InsertMode.ADD)

    def block_values(self, tangent: TangentAssembler, factor: float) -> MassBlocks:
        """On the diagonal."""
        return MassBlocks(tangent.diagonal_blocks, factor * self.lumped.reshape(len(tangent.diagonal_blocks), -1))

    def destroy(self) -> None:
        """Give the memory of PETSc's objects back, where there are any."""
        self._diagonal.destroy()


class ConsistentMass:
    """M = int rho u . w as a matrix."""

    is_diagonal = False

    def __init__(self, assembler: VectorAssembler, density: Expr, bcs: list[fem.DirichletBC]) -> None:
        """`density`: kg/m^3, a UFL coefficient; `bcs`: on the dofs that the balance prescribes."""
        self.lumped, domain = lumped_mass(assembler, density), assembler.domain
        self._bcs = bcs
        self._multiples: Values | None = None  # of 1, in the blocks of a tangent
        u, w = ufl.TrialFunction(domain.space), ufl.TestFunction(domain.space)
        self._form = compile_form(density * ufl.inner(u, w) * ufl.dx(domain=domain.mesh))
        self._whole = assemble_matrix(self._form)
        self._free = assemble_matrix(self._form, bcs, diagonal=0.0)
        self._x, self._y = assembler.create_vector(), assembler.create_vector()

    def multiply(self, values: Values) -> Values:
        """(owned dofs,) M a of (owned dofs,) a in m/s^2, N."""
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

    def add_to(self, tangent: PETSc.Mat, factor: float, *, more_entries: bool = False) -> None:
        """One pass over the stored entries where both matrices have the same pattern, else row by row."""
        structure = PETSc.Mat.Structure
        same = structure.SUBSET_NONZERO_PATTERN if more_entries else structure.SAME_NONZERO_PATTERN
        tangent.axpy(factor, self._free, same)

    def block_values(self, tangent: TangentAssembler, factor: float) -> MassBlocks:
        """In all of them, which stay the same: cells that die keep their mass."""
        if self._multiples is None:
            self._multiples = tangent.assemble_block_diagonals(self._form, self._bcs)
        return MassBlocks(slice(None), factor * self._multiples)

    def destroy(self) -> None:
        """Give the memory of PETSc's objects back, where there are any."""
        for kept in (self._whole, self._free, self._x, self._y):
            kept.destroy()


def lumped_mass(assembler: VectorAssembler, density: Expr) -> Values:
    """(owned dofs,) share of each node in the mass of its cells, for each component, kg."""
    domain = assembler.domain
    if domain.order == 2:
        return _shared_by_diagonal(assembler, density)
    w, ones = ufl.TestFunction(domain.space), fem.Constant(domain.mesh, np.ones(domain.dim))
    vertices = ufl.dx(domain=domain.mesh, metadata={"quadrature_rule": "vertex", "quadrature_degree": 1})
    return assembler(compile_form(density * ufl.inner(ones, w) * vertices))


# shares of corners and of middles of edges in the mass of a cell with quadratic displacement, by dimension
HRZ_FRACTIONS = {2: (1 / 19, 16 / 57), 3: (1 / 36, 4 / 27)}


def corner_mass_fraction(domain: Domain) -> float:
    """Of the lumped mass of a cell."""
    return HRZ_FRACTIONS[domain.dim][0] if domain.order == 2 else 1 / (domain.dim + 1)


def _shared_by_diagonal(assembler: VectorAssembler, density: Expr) -> Values:
    """The same with quadratic displacement: in proportion to the diagonal of the consistent mass of a cell (Hinton,
    Rock and Zienkiewicz 1976).

    int N_i is 0 at corners of a triangle and negative at those of a tetrahedron, so that neither nodal quadrature nor
    the sums of rows will do. With int N_i^2 / A = 1/30 and 8/45 (a triangle), 1/70 and 8/105 (a tetrahedron) these
    shares are positive and add up to 1. Frequencies converge with h^2, as with linear displacement, those of the
    consistent mass with h^4.
    """
    domain = assembler.domain
    volumes = fem.Function(domain.cell_scalar)
    mass = compile_form(density * ufl.TestFunction(domain.cell_scalar) * ufl.dx(domain=domain.mesh))
    volumes.x.array[:] = 0.0
    fem.assemble_vector(volumes.x.array, mass)
    of_cells, (corner, middle) = volumes.x.array[: domain.cell_count, None], HRZ_FRACTIONS[domain.dim]
    result = fem.Function(domain.space)
    nodes = result.x.array.reshape(-1, domain.dim)
    np.add.at(nodes, domain.cell_nodes, (corner * of_cells)[:, :, None])
    np.add.at(nodes, domain.cell_midside_nodes, (middle * of_cells)[:, :, None])
    result.x.scatter_reverse(la.InsertMode.add)
    return np.asarray(result.x.array[: assembler.owned_dof_count])
