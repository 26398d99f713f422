"""The quasi-static analysis of one free body under the loads of a moment (docs/theory.md#free-body-analysis).

    K u = f - M a,   u orthogonal to the rigid modes

in the configuration at rest, with the body's stress as it is assembled for deformable studies. A body is a set of
cells of the mesh with the share of each that is its own: a cell that a crack runs through belongs to the pieces on both
sides, to each with its share of stiffness and mass. What a piece solves with beyond its own nodes (B07's virtual nodes)
are the other nodes of these cells, in a system of its own, so that no piece feels another.

A small body's preconditioner is an incomplete factor, which is made in no time; multigrid's coarse spaces are most of
what a first solve takes (s of processor time, first and later ones; parts of a wall, a slender figure, a thick slab):

    nodes   786            886            1,320          1,683          2,498
    factor  0.006, 0.007   0.013, 0.012   0.028, 0.027   0.043, 0.042   0.081, 0.090
    grids   0.024, 0.006   0.024, 0.008   0.044, 0.016   0.068, 0.030   0.092, 0.040

Most pieces are solved for once or twice: those of FEW nodes take a factor. A mesh of more has it made for all copies.

Inertia relief: what a free body under a load accelerates with is taken off the load, and what is left strains it.

A rigid motion a = R c of the body balances the load in every rigid mode R,

    R^T (f - M R c) = 0,   (R^T M R) c = R^T f,

with the lumped masses M of the mesh that is solved on, so that f - M a is orthogonal to the modes to round-off and the
strain of K u = f - M a is the same whichever u of all rigid motions is taken. B07 (sec. 5) pins three points instead:
what the load is out of balance by then acts on these (rigid.pinned_analysis).

Equations: docs/theory.md#free-body-analysis.
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
from ..solvers.preconditioner import GAMG_OPTIONS
from ..solvers.rigid_body_modes import rigid_body_nullspace

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
DEFAULTS: PetscOptions = {
    "ksp_type": "cg",
    "ksp_rtol": 1e-8,
    "ksp_max_it": 2000,
    **GAMG_OPTIONS,
    "pc_gamg_threshold": 0.0,  # no aggregates across cells of other pieces, which carry nothing
    "mg_coarse_pc_type": "svd",  # the coarsest matrix has the rigid modes too: it is singular
}
FEW = 1500  # nodes of a body: fewer are preconditioned by an incomplete factor
FACTOR: PetscOptions = {"pc_type": "icc"}


@dataclass(frozen=True)
class Relief:
    """Of one body with n nodes.

    Attributes:
        mass: (n,) lumped, kg, or (n, d) of each unknown.    modes: (n d, m) rigid modes, in any basis.
    """

    mass: Values
    modes: Values

    def __call__(self, force: Values) -> Values:
        """(n, d) nodal forces f - M a that no longer accelerate the body, from forces f (n, d), N."""
        mass = np.repeat(self.mass, force.shape[1]) if self.mass.ndim == 1 else self.mass.reshape(-1)
        weighted = mass[:, None] * self.modes
        c = np.linalg.solve(self.modes.T @ weighted, self.modes.T @ force.reshape(-1))
        return np.asarray(force - (weighted @ c).reshape(force.shape))


class Stiffness:
    """K of the cells of one mesh, for one body after the other (one rank).

    Attributes:
        stress: linear, with a field chi of its own: the share of each cell.    density: (cells,) kg/m^3.
    """

    def __init__(self, stress: Stress, density: Values) -> None:
        domain = stress.domain
        self.stress, self.density, self._space = stress, density, domain.space
        v, w = ufl.TrialFunction(domain.space), ufl.TestFunction(domain.space)
        self._form = CellForm(stress.tangent_form(v, w, cell_measure(domain)))
        sigma = cauchy_stress(stress.energy, deformation_gradient(stress.u))
        self._tensor = CellExpression(domain.comm, domain.mesh, symmetric_components(sigma), domain.cell_count)
        self._whole: FreeBody | None = None

    def whole(self, options: PetscOptions | None = None) -> FreeBody:
        """The body of all cells; kept, for all copies of the mesh."""
        if self._whole is None:
            self._whole = self.body(np.ones(self.stress.domain.cell_count), options)
        return self._whole

    def body(self, share: Values, options: PetscOptions | None = None) -> FreeBody:
        """Of the cells with a share (cells,)."""
        return FreeBody(self, share, options)

    @property
    def finest(self) -> float:
        """m, an edge of the mesh."""
        return self.stress.domain.mean_edge_length

    def tensor(self, u: Values, share: Values) -> Values:
        """(cells, 3 or 6) stress of displacements u (nodes, d) in the cells with a share, 0 in all others, Pa."""
        result = np.zeros((len(share), self._tensor.width))
        if largest := float(np.abs(u).max()):
            # F - 1 of a stiff body has few digits left: stress is linear in u, so take that of a large one
            larger = self.stress.domain.size / largest
            self.stress.u.x.array[:] = larger * u.reshape(-1)
            cells = np.flatnonzero(share).astype(np.int32)
            result[cells] = self._tensor(cells) / larger
        return result

    def matrix(self, share: Values, nodes: Ints) -> PETSc.Mat:
        """Over the dofs of some nodes (n,): those of all cells with a share (cells,) above 0."""
        assert self.stress.chi is not None
        self.stress.chi.x.array[:] = share
        self._form.exclude_cells(share == 0)
        whole = TangentAssembler(self._form)
        whole([])
        d = self.stress.domain.dim
        rows = PETSc.IS().createBlock(d, nodes.astype(PETSc.IntType), comm=PETSc.COMM_SELF)
        own = whole.matrix.createSubMatrix(rows, rows)
        own.setBlockSize(d)
        own.setOption(PETSc.Mat.Option.SPD, True)  # but for the modes, which CG never meets
        rows.destroy()
        whole.destroy()
        return own


class FreeBody:
    """A body that nothing holds.

    Attributes:
        share: (cells,) of each cell of the mesh, 0 to 1.    nodes: (n,) of the mesh, those of its cells.
        relief: takes the rigid acceleration off a load.    matrix: K.    iterations: of CG in the last solve.
    """

    def __init__(self, stiffness: Stiffness, share: Values, given: PetscOptions | None = None) -> None:
        """`given`: PETSc options over DEFAULTS, and FACTOR of what is small."""
        domain = stiffness.stress.domain
        assert domain.comm.size == 1
        alive = np.flatnonzero(share)
        corners = domain.cell_nodes[alive]
        self.share, self.nodes = share, np.unique(corners).astype(np.int64)
        self._shape, self.iterations = (len(domain.nodes), domain.dim), 0
        self.matrix = stiffness.matrix(share, self.nodes)
        places = domain.nodes[self.nodes]
        self._null = rigid_body_nullspace(domain.comm, places - places.mean(axis=0))
        modes = np.stack([mode.array_r.copy() for mode in self._null.getVecs()], axis=1)
        each = (share * stiffness.density * domain.volumes)[alive] / corners.shape[1]
        mass = np.bincount(corners.ravel(), np.repeat(each, corners.shape[1]), minlength=len(domain.nodes))
        self.relief = Relief(mass[self.nodes].astype(float), modes)
        self._solver(DEFAULTS | (FACTOR if len(self.nodes) < FEW else {}) | (given or {}))

    def _solver(self, options: PetscOptions) -> None:
        self.matrix.setNullSpace(self._null)
        self.matrix.setNearNullSpace(self._null)
        self._options = PetscOptionSet(options)
        ksp = self._ksp = PETSc.KSP().create(self.matrix.comm)
        ksp.setOptionsPrefix(self._options.prefix)
        ksp.setOperators(self.matrix)
        call_petsc(ksp.setFromOptions)
        self._u, self._f = self.matrix.createVecs()

    def __call__(self, force: Values) -> Values:
        """(nodes of the mesh, d) displacement under nodal forces (nodes of the mesh, d), N; 0 elsewhere, m.

        Raises NotConverged.
        """
        self._f.array_w[:] = self.relief(force[self.nodes]).reshape(-1)
        self._ksp.solve(self._f, self._u)
        self.iterations = self._ksp.its
        if self._ksp.reason < 0:
            raise NotConverged(
                f"the analysis of a struck body ({len(self.nodes)} nodes) failed after {self._ksp.its} iterations; "
                "give solver.ksp_max_it more, or a better mesh"
            )
        u = np.zeros(self._shape)
        u[self.nodes] = self._u.array_r.reshape(-1, self._shape[1])
        return u

    def destroy(self) -> None:
        """Give the memory of PETSc's objects back."""
        self._options.remove()
        for kept in (self._ksp, self._u, self._f, self.matrix, self._null):
            kept.destroy()
