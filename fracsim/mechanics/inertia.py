"""Inertia M a, with a lumped or a consistent mass matrix, assembled once.

The lumped mass (vertex quadrature, the default) is a vector: inertia costs one product, and a detached node has its
own mass. The consistent mass is a sparse matrix with the pattern of the tangent. Frequencies of the first are too low,
of the second too high. The mass is no part of the compiled form, which would integrate it again in every tangent.

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
    """Contribution of inertia to a tangent in blocks: multiples of the identity, but for prescribed dofs.

    Attributes:
        blocks: (n,) indices of blocks of owned rows.
        values: (n, d) diagonals to be added, N/m.
    """

    blocks: Ints | slice
    values: Values


class MassMatrix(Protocol):
    """Mass matrix of a balance; all arrays are of the owned dofs.

    Attributes:
        lumped: (owned dofs,) lumped mass, kg.
        is_diagonal: whether M is the lumped mass; a consistent one also couples the nodes of dead cells.
    """

    lumped: Values
    is_diagonal: bool

    def multiply(self, values: Values) -> Values:
        """(owned dofs,) M a, N, of a (owned dofs,), m/s^2."""

    def solve(self, force: Values, free: npt.NDArray[np.bool_]) -> Values:
        """(owned dofs,) a, m/s^2, with M a = force (N) on free dofs and a = 0 on the others (collective)."""

    def add_to(self, tangent: PETSc.Mat, factor: float, *, more_entries: bool = False) -> None:
        """Add factor M to the tangent, without coupling to prescribed dofs.

        Args:
            tangent: assembled matrix.
            factor: 1/s^2.
            more_entries: whether the tangent may have entries where M has none.
        """

    def block_values(self, tangent: TangentAssembler, factor: float) -> MassBlocks:
        """Blocks of factor M, to be added to a tangent that is assembled after this (collective)."""

    def destroy(self) -> None:
        """Free PETSc's objects."""


class Inertia(Term):
    """M a, with the acceleration a = c_a (u - u_a) of the time level."""

    name = "inertia"
    linear = True

    def __init__(self, u: fem.Function, mass: MassMatrix) -> None:
        self._u, self._mass = u, mass
        self._level: TimeLevel | None = None

    def begin_step(self, level: TimeLevel) -> None:
        """Take the acceleration of the time level."""
        self._level = level

    @property
    def mass_factor(self) -> float:
        """c_a, 1/s^2."""
        assert self._level is not None
        return self._level.c_a

    def acceleration(self) -> Values | None:
        """(owned dofs,) c_a (u - u_a), m/s^2; None if the scheme keeps inertia out of the balance."""
        assert self._level is not None
        u_a = self._level.u_a
        return np.asarray(self.mass_factor * (self._u.x.array[: len(u_a)] - u_a)) if self.mass_factor else None

    def potential(self) -> float:
        """c_a (u - u_a) . M (u - u_a) / 2, J."""
        a = self.acceleration()
        return 0.0 if a is None else float(a @ self._mass.multiply(a)) / (2 * self.mass_factor)

    def reference_forces(self) -> Values | None:
        """(owned dofs,) M c_a (u - u_a) with the lumped mass, N."""
        assert self._level is not None
        u_a, factor = self._level.u_a, self.mass_factor
        return np.asarray(factor * self._mass.lumped * (self._u.x.array[: len(u_a)] - u_a)) if factor else None


class LumpedMass:
    """Diagonal mass matrix: int rho w by quadrature at the vertices."""

    is_diagonal = True

    def __init__(self, assembler: VectorAssembler, density: Expr) -> None:
        """`density`: kg/m^3, a UFL coefficient."""
        self.lumped = lumped_mass(assembler, density)
        self._diagonal = assembler.create_vector()

    def multiply(self, values: Values) -> Values:
        """(owned dofs,) M a, N, of a (owned dofs,), m/s^2."""
        return self.lumped * values

    def solve(self, force: Values, free: npt.NDArray[np.bool_]) -> Values:
        """(owned dofs,) a = force / m on free dofs, 0 elsewhere, m/s^2."""
        return np.where(free, force / self.lumped, 0.0)

    def add_to(self, tangent: PETSc.Mat, factor: float, *, more_entries: bool = False) -> None:
        """Add factor M to the diagonal of the tangent."""
        # prescribed rows have nothing beside the diagonal: there it is only scaled
        self._diagonal.array_w[:] = factor * self.lumped
        tangent.setDiagonal(self._diagonal, PETSc.InsertMode.ADD)

    def block_values(self, tangent: TangentAssembler, factor: float) -> MassBlocks:
        """Diagonals of the blocks on the diagonal."""
        return MassBlocks(tangent.diagonal_blocks, factor * self.lumped.reshape(len(tangent.diagonal_blocks), -1))

    def destroy(self) -> None:
        """Free PETSc's vector."""
        self._diagonal.destroy()


class ConsistentMass:
    """Sparse mass matrix M = int rho u . w."""

    is_diagonal = False

    def __init__(self, assembler: VectorAssembler, density: Expr, bcs: list[fem.DirichletBC]) -> None:
        """Assemble M with and without prescribed dofs (collective).

        Args:
            assembler: of vectors over the dofs.
            density: kg/m^3, a UFL coefficient.
            bcs: conditions on the prescribed dofs of the balance.
        """
        self.lumped, domain = lumped_mass(assembler, density), assembler.domain
        self._bcs = bcs
        self._block_diagonals: Values | None = None
        u, w = ufl.TrialFunction(domain.space), ufl.TestFunction(domain.space)
        self._form = compile_form(density * ufl.inner(u, w) * ufl.dx(domain=domain.mesh))
        self._whole = assemble_matrix(self._form)
        self._free = assemble_matrix(self._form, bcs, diagonal=0.0)
        self._x, self._y = assembler.create_vector(), assembler.create_vector()

    def multiply(self, values: Values) -> Values:
        """(owned dofs,) M a, N, of a (owned dofs,), m/s^2."""
        self._x.array_w[:] = values
        self._whole.mult(self._x, self._y)
        return self._y.array_r.copy()

    def solve(self, force: Values, free: npt.NDArray[np.bool_]) -> Values:
        """(owned dofs,) a, m/s^2, with M a = force (N) on free dofs and a = 0 on the others, by Jacobi-CG to 1e-12."""
        # some twenty iterations at any mesh size
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
        """Add factor M to the tangent, without coupling to prescribed dofs."""
        structure = PETSc.Mat.Structure
        # with the same pattern one pass over the entries, else row by row
        pattern = structure.SUBSET_NONZERO_PATTERN if more_entries else structure.SAME_NONZERO_PATTERN
        tangent.axpy(factor, self._free, pattern)

    def block_values(self, tangent: TangentAssembler, factor: float) -> MassBlocks:
        """Diagonals of all blocks; constant, since dead cells keep their mass."""
        if self._block_diagonals is None:
            self._block_diagonals = tangent.assemble_block_diagonals(self._form, self._bcs)
        return MassBlocks(slice(None), factor * self._block_diagonals)

    def destroy(self) -> None:
        """Free PETSc's matrices and vectors."""
        for owned in (self._whole, self._free, self._x, self._y):
            owned.destroy()


def lumped_mass(assembler: VectorAssembler, density: Expr) -> Values:
    """(owned dofs,) share of each node in the mass of its cells, for each component, kg."""
    domain = assembler.domain
    if domain.order == 2:
        return _hrz_lumped_mass(assembler, density)
    w, ones = ufl.TestFunction(domain.space), fem.Constant(domain.mesh, np.ones(domain.dim))
    vertices = ufl.dx(domain=domain.mesh, metadata={"quadrature_rule": "vertex", "quadrature_degree": 1})
    return assembler(compile_form(density * ufl.inner(ones, w) * vertices))


# mass fractions of a corner and of a midside node of a cell with quadratic displacement, by dimension
HRZ_FRACTIONS = {2: (1 / 19, 16 / 57), 3: (1 / 36, 4 / 27)}


def corner_mass_fraction(domain: Domain) -> float:
    """Fraction of the lumped mass of a cell that each of its corners has."""
    return HRZ_FRACTIONS[domain.dim][0] if domain.order == 2 else 1 / (domain.dim + 1)


def _hrz_lumped_mass(assembler: VectorAssembler, density: Expr) -> Values:
    """(owned dofs,) lumped mass with quadratic displacement, kg: in proportion to the diagonal of the consistent mass.

    int N_i is 0 at corners of a triangle and negative at those of a tetrahedron, so that neither nodal quadrature nor
    row sums are usable. With int N_i^2 / A = 1/30 and 8/45 (triangle), 1/70 and 8/105 (tetrahedron) all fractions are
    positive and add up to 1. Frequencies converge with h^2, those of the consistent mass with h^4.

    Hinton, Rock and Zienkiewicz (1976), A note on mass lumping and related processes in the finite element method.
    """
    domain = assembler.domain
    volumes = fem.Function(domain.scalar_cell_space)
    mass = compile_form(density * ufl.TestFunction(domain.scalar_cell_space) * ufl.dx(domain=domain.mesh))
    volumes.x.array[:] = 0.0
    fem.assemble_vector(volumes.x.array, mass)
    cell_mass, (corner, midside) = volumes.x.array[: domain.cell_count, None], HRZ_FRACTIONS[domain.dim]
    result = fem.Function(domain.space)
    nodes = result.x.array.reshape(-1, domain.dim)
    np.add.at(nodes, domain.cell_nodes, (corner * cell_mass)[:, :, None])
    np.add.at(nodes, domain.cell_midside_nodes.of_edges, (midside * cell_mass)[:, :, None])
    result.x.scatter_reverse(la.InsertMode.add)
    return np.asarray(result.x.array[: assembler.owned_dof_count])
