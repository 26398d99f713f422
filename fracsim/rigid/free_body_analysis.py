"""Quasi-static analysis of a free body under the loads of one moment (docs/theory.md#free-body-analysis).

    K u = f - M a,   a = R c,   (R^T M R) c = R^T f

with inertia relief: the rigid-body acceleration a, a combination of the rigid modes R, is subtracted from the load. M
is the lumped mass of the mesh. The right side is orthogonal to the rigid modes to round-off, so that the stress does
not depend on the rigid motion in u.

A body is a set of cells of the mesh, each with the fraction of it that belongs to the body. A cell that a crack crosses
belongs to the fragments on both sides, to each with its fraction of stiffness and mass. The other nodes of such cells
are B07's virtual nodes. Every fragment has a system of its own, so that no fragment influences another one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import ufl
from petsc4py import PETSc

from ..errors import NotConverged
from ..forms.energies import cauchy_stress
from ..forms.kinematics import deformation_gradient, symmetric_components
from ..mechanics.jit import CellExpression, CellForm, cell_measure
from ..mechanics.matrix_assembly import TangentAssembler
from ..mechanics.stress import Stress
from ..solvers.petsc_options import PetscOptions, PetscOptionSet, call_petsc
from ..solvers.preconditioner import GAMG_OPTIONS, rigid_body_nullspace

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

SOLVER_OPTIONS: PetscOptions = {
    "ksp_type": "cg",
    "ksp_rtol": 1e-8,
    "ksp_max_it": 2000,
    **GAMG_OPTIONS,
    # no aggregates across cells of other fragments, whose entries are zero
    "pc_gamg_threshold": 0.0,
    # the coarsest matrix has the rigid modes too, and is singular
    "mg_coarse_pc_type": "svd",
}
INCOMPLETE_FACTORS: PetscOptions = {"pc_type": "icc"}


@dataclass(frozen=True)
class InertiaRelief:
    """Subtraction of the rigid-body acceleration from the load on a free body of n nodes.

    Attributes:
        mass: (n,) lumped mass, kg, or (n, d) of each degree of freedom.
        modes: (n d, m) rigid modes in any basis.
    """

    mass: Values
    modes: Values

    def __call__(self, force: Values) -> Values:
        """Return the balanced nodal forces f - M a (n, d), N, of forces f (n, d), N."""
        mass = np.repeat(self.mass, force.shape[1]) if self.mass.ndim == 1 else self.mass.reshape(-1)
        weighted = mass[:, None] * self.modes
        c = np.linalg.solve(self.modes.T @ weighted, self.modes.T @ force.reshape(-1))
        return np.asarray(force - (weighted @ c).reshape(force.shape))


class SolidStiffness:
    """Stiffness matrices of bodies that are parts of one mesh (one rank).

    Attributes:
        stress: of a linear material, with a field chi of its own: the fractions of the cells.
        density: (cells,) kg/m^3.
    """

    def __init__(self, stress: Stress, density: Values) -> None:
        """Compile the forms."""
        domain = stress.domain
        self.stress, self.density = stress, density
        v, w = ufl.TrialFunction(domain.space), ufl.TestFunction(domain.space)
        self._form = CellForm(stress.tangent_form(v, w, cell_measure(domain)))
        sigma = cauchy_stress(stress.energy, deformation_gradient(stress.u))
        self._cauchy_stress = CellExpression(domain.comm, domain.mesh, symmetric_components(sigma), domain.cell_count)
        self._whole_body: SolidBody | None = None

    def whole_body(self, options: PetscOptions | None = None) -> SolidBody:
        """Return the body of all cells, which serves all instances of the mesh; `options`: of PETSc."""
        if self._whole_body is None:
            self._whole_body = self.make_body(np.ones(self.stress.domain.cell_count), options)
        return self._whole_body

    def make_body(self, cell_fractions: Values, options: PetscOptions | None = None) -> SolidBody:
        """Return the body of cells with fractions (cells,); `options`: of PETSc."""
        return SolidBody(self, cell_fractions, options)

    @property
    def beam_thickness(self) -> float:
        """Thickness of the most slender part of a body: an edge of the mesh, m."""
        return self.stress.domain.mean_edge_length

    def cell_stress(self, u: Values, cell_fractions: Values) -> Values:
        """Return stresses (cells, 3 or 6), Pa, of displacements u (nodes, d); 0 in cells without a fraction."""
        result = np.zeros((len(cell_fractions), self._cauchy_stress.width))
        if largest := float(np.abs(u).max()):
            # stress is linear in u: with a large u, F - 1 does not lose digits
            factor = self.stress.domain.bounds.diagonal / largest
            self.stress.u.x.array[:] = factor * u.reshape(-1)
            cells = np.flatnonzero(cell_fractions).astype(np.int32)
            result[cells] = self._cauchy_stress(cells) / factor
        return result

    def assemble_matrix(self, cell_fractions: Values, nodes: Ints) -> PETSc.Mat:
        """Return the matrix over the degrees of freedom of `nodes` (n,), those of all cells with a fraction."""
        assert self.stress.chi is not None
        self.stress.chi.x.array[:] = cell_fractions
        self._form.exclude_cells(cell_fractions == 0)
        full = TangentAssembler(self._form)
        full([])
        d = self.stress.domain.dim
        rows = PETSc.IS().createBlock(d, nodes.astype(PETSc.IntType), comm=PETSc.COMM_SELF)
        matrix = full.matrix.createSubMatrix(rows, rows)
        matrix.setBlockSize(d)
        # semi-definite: the rigid modes never occur in CG
        matrix.setOption(PETSc.Mat.Option.SPD, True)
        rows.destroy()
        full.destroy()
        return matrix


class SolidBody:
    """Analysis of a free solid body.

    Attributes:
        cell_fractions: (cells,) fraction of each cell of the mesh, 0 to 1.
        nodes: (n,) nodes of its cells.
        inertia_relief: of the load.
        matrix: K.
        cg_iterations: of the last solve.
    """

    def __init__(self, stiffness: SolidStiffness, cell_fractions: Values, options: PetscOptions | None = None) -> None:
        """Assemble and set up the solver; `options`: of PETSc, in place of the defaults."""
        domain = stiffness.stress.domain
        assert domain.comm.size == 1
        cells = np.flatnonzero(cell_fractions)
        corners = domain.cell_nodes[cells]
        self.cell_fractions, self.nodes = cell_fractions, np.unique(corners).astype(np.int64)
        self._shape, self.cg_iterations = (len(domain.nodes), domain.dim), 0
        self.matrix = stiffness.assemble_matrix(cell_fractions, self.nodes)
        x = domain.nodes[self.nodes]
        self._null_space = rigid_body_nullspace(domain.comm, x - x.mean(axis=0))
        modes = np.stack([mode.array_r.copy() for mode in self._null_space.getVecs()], axis=1)
        corner_mass = (cell_fractions * stiffness.density * domain.volumes)[cells] / corners.shape[1]
        mass = np.bincount(corners.ravel(), np.repeat(corner_mass, corners.shape[1]), minlength=len(domain.nodes))
        self.inertia_relief = InertiaRelief(mass[self.nodes].astype(float), modes)
        # Small bodies are preconditioned by an incomplete factorisation: most fragments are analysed once or twice, and
        # the coarse spaces of multigrid would take most of the time of the first solve.
        small = len(self.nodes) < 1500
        self._set_up_solver(SOLVER_OPTIONS | (INCOMPLETE_FACTORS if small else {}) | (options or {}))

    def _set_up_solver(self, options: PetscOptions) -> None:
        self.matrix.setNullSpace(self._null_space)
        self.matrix.setNearNullSpace(self._null_space)
        self._options = PetscOptionSet(options)
        ksp = self._ksp = PETSc.KSP().create(self.matrix.comm)
        ksp.setOptionsPrefix(self._options.prefix)
        ksp.setOperators(self.matrix)
        call_petsc(ksp.setFromOptions)
        self._u, self._f = self.matrix.createVecs()

    def __call__(self, force: Values) -> Values:
        """Return the displacement (nodes of the mesh, d), m, of nodal forces (nodes of the mesh, d), N; 0 elsewhere.

        Raises NotConverged.
        """
        self._f.array_w[:] = self.inertia_relief(force[self.nodes]).reshape(-1)
        self._ksp.solve(self._f, self._u)
        self.cg_iterations = self._ksp.its
        if self._ksp.reason < 0:
            raise NotConverged(
                f"the analysis of a struck body ({len(self.nodes)} nodes) failed after {self._ksp.its} iterations; "
                "give solver.ksp_max_it more, or a better mesh"
            )
        u = np.zeros(self._shape)
        u[self.nodes] = self._u.array_r.reshape(-1, self._shape[1])
        return u

    def destroy(self) -> None:
        """Free the memory of PETSc's objects."""
        self._options.remove()
        for owned in (self._ksp, self._u, self._f, self.matrix, self._null_space):
            owned.destroy()
