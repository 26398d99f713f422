"""Quasi-static analysis of shells and their fragments by flat triangles (docs/theory.md#shells).

    K (u, r) = (f - M a, m),   K = T^T (K_m + K_b + K_d) T
    K_m = A h B_m^T C B_m,   K_b = h^3/12 int B_b^T C B_b dA,   C of plane stress

Each node has a displacement u and a rotation r: a point at height z above it moves by u + r x z n. The membrane has
constant strain (CST), bending is by discrete Kirchhoff triangles (DKT; J.-L. Batoz, K.-J. Bathe, L.-W. Ho 1980). The
rotation about the normal is tied to that of the membrane (T. J. R. Hughes, F. Brezzi 1989), so that rigid motions are
the only ones without energy. One node is held; with a balanced load it needs no force.

A fragment is a set of triangles with the fraction of each that belongs to it: the mean of the three cells that are its
thickness. Forces on these cells act on the middle surface with their moment about it. The stress is that of the face
with the larger tension.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.linalg import splu

from ..errors import NotConverged
from ..forms.kinematics import SYMMETRIC_COMPONENTS
from ..mechanics.stress import Stress
from ..meshes.data import Shell
from ..solvers.petsc_options import PetscOptions
from .free_body_analysis import InertiaRelief

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

# Corners of the sides of a triangle.
SIDES = np.array([[0, 1], [1, 2], [2, 0]])


# --- triangles ---


def plane_stress(young: float, poisson: float) -> Values:
    """Return the elastic matrix C (3, 3), Pa, for strains (xx, yy, 2 xy); `young` in Pa."""
    shear = (1 - poisson) / 2
    return young / (1 - poisson**2) * np.array([[1, poisson, 0], [poisson, 1, 0], [0, 0, shear]])


@dataclass(frozen=True)
class ShellTriangles:
    """Geometry of n flat triangles.

    Attributes:
        axes: (n, 3, 3) rows: along the first side, across it in the plane, normal.
        area: (n,) m^2.
        gradients: (n, 3, 2) of the barycentric coordinates in the plane, 1/m.
        plane_corners: (n, 3, 2) corners in the plane, m.
    """

    axes: Values
    area: Values
    gradients: Values
    plane_corners: Values

    @classmethod
    def from_corners(cls, corners: Values) -> ShellTriangles:
        """Return the triangles with corners (n, 3, 3), m."""
        first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        normal = np.cross(first, second)
        area = np.linalg.norm(normal, axis=1) / 2
        x, z = first / np.linalg.norm(first, axis=1)[:, None], normal / (2 * area[:, None])
        axes = np.stack([x, np.cross(z, x), z], axis=1)
        plane_corners = np.einsum("nai,nki->nka", axes[:, :2], corners - corners[:, :1])
        # the side opposite to corner k, from k + 1 to k + 2
        opposite = plane_corners[:, [2, 0, 1]] - plane_corners[:, [1, 2, 0]]
        gradients = np.stack([-opposite[:, :, 1], opposite[:, :, 0]], axis=2) / (2 * area)[:, None, None]
        return cls(axes, area, gradients, plane_corners)

    def stiffness(self, young: float, poisson: float, thickness: float) -> Values:
        """Return element matrices (n, 18, 18) for (u, r) of the corners in the axes of space, in N/m, N and N m."""
        C, membrane, rotations = plane_stress(young, poisson), self.membrane_strain(), self.section_rotations()
        drilling = self.drilling_rotation()
        K = np.einsum("n,nai,ab,nbj->nij", self.area * thickness, membrane, C, membrane)
        # stiffness of the rotation about the normal: a tenth of the shear modulus
        drilling_stiffness = 0.1 * C[2, 2] * thickness / 3
        K += drilling_stiffness * np.einsum("n,nki,nkj->nij", self.area, drilling, drilling)
        # the middles of the sides as integration points are exact for quadratic functions
        for point in np.array([[0.5, 0.5, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5]]):
            curvature = self.curvature(rotations, point)
            K += np.einsum("n,nai,ab,nbj->nij", self.area * thickness**3 / 36, curvature, C, curvature)
        return self.to_space(K)

    def to_space(self, K: Values) -> Values:
        """Return T^T K T of matrices (n, 18, 18) in the axes of the triangles."""
        blocks = K.reshape(-1, 6, 3, 6, 3)
        return np.einsum("nai,nkalb,nbj->nkilj", self.axes, blocks, self.axes, optimize=True).reshape(-1, 18, 18)

    def membrane_strain(self) -> Values:
        """Return B_m (n, 3, 18): strain (xx, yy, 2 xy) of the middle surface."""
        B = np.zeros((len(self.area), 3, 3, 6))
        B[:, 0, :, 0] = B[:, 2, :, 1] = self.gradients[:, :, 0]
        B[:, 1, :, 1] = B[:, 2, :, 0] = self.gradients[:, :, 1]
        return B.reshape(-1, 3, 18)

    def drilling_rotation(self) -> Values:
        """Return (n, 3, 18): rotation of each corner about the normal, beyond (v_x - u_y) / 2 of the membrane."""
        B = np.zeros((len(self.area), 3, 3, 6))
        B[:, :, :, 0], B[:, :, :, 1] = self.gradients[:, None, :, 1] / 2, -self.gradients[:, None, :, 0] / 2
        B[:, np.arange(3), np.arange(3), 5] = 1.0
        return B.reshape(-1, 3, 18)

    def section_rotations(self) -> Values:
        """Return beta (n, 6, 2, 18) at the corners and the middles of the sides.

        A point at height z moves by z beta in the plane, beta = (r_y, -r_x) = -grad w. Along a side the deflection w is
        cubic: beta_s = -3/2 (w_j - w_i) / l - (beta_si + beta_sj) / 4 in its middle. Across a side beta is linear.
        """
        beta = np.zeros((len(self.area), 6, 2, 3, 6))
        corner = np.arange(3)
        beta[:, corner, 0, corner, 4], beta[:, corner, 1, corner, 3] = 1.0, -1.0
        for side, (i, j) in enumerate(SIDES):
            arm = self.plane_corners[:, j] - self.plane_corners[:, i]
            length = np.linalg.norm(arm, axis=1)
            s = arm / length[:, None]
            corner_sum = beta[:, i] + beta[:, j]
            along = -np.einsum("na,nakl->nkl", s, corner_sum) / 4
            along[:, j, 2] -= 1.5 / length
            along[:, i, 2] += 1.5 / length
            n = np.stack([-s[:, 1], s[:, 0]], axis=1)
            across = np.einsum("na,nakl->nkl", n, corner_sum) / 2
            beta[:, 3 + side] = s[:, :, None, None] * along[:, None] + n[:, :, None, None] * across[:, None]
        return beta.reshape(-1, 6, 2, 18)

    def curvature(self, section_rotations: Values, point: Values) -> Values:
        """Return B_b (n, 3, 18): curvature (xx, yy, 2 xy), strain per height, at barycentric coordinates (3,)."""
        corners = [(4 * point[k] - 1) * self.gradients[:, k] for k in range(3)]
        midsides = [4 * (point[i] * self.gradients[:, j] + point[j] * self.gradients[:, i]) for i, j in SIDES]
        # gradients (n, 6, 2) of the quadratic shape functions
        gradients = np.stack(corners + midsides, axis=1)
        grad = np.einsum("nkb,nkaj->nabj", gradients, section_rotations)
        return np.stack([grad[:, 0, 0], grad[:, 1, 1], grad[:, 0, 1] + grad[:, 1, 0]], axis=1)

    def stress(self, u: Values, young: float, poisson: float, thickness: float) -> Values:
        """Return stresses (n, 2, 3), Pa, (xx, yy, xy) in the axes of the triangles, on the lower and the upper face.

        `u`: (n, 3, 6) displacements and rotations of the corners in the axes of space; stresses are those of the
        centres.
        """
        return self.stress_recovery(young, poisson, thickness).evaluate(u)

    def stress_recovery(self, young: float, poisson: float, thickness: float) -> StressRecovery:
        """Return the operator of `stress`."""
        C, bending = plane_stress(young, poisson), self.curvature(self.section_rotations(), np.full(3, 1 / 3))
        membrane = self.membrane_strain()
        faces = np.stack([membrane - thickness / 2 * bending, membrane + thickness / 2 * bending], axis=1)
        faces = (C @ faces).reshape(-1, 6, 6, 3)
        return StressRecovery(np.einsum("nckb,nbj->nckj", faces, self.axes).reshape(-1, 6, 18))


@dataclass(frozen=True)
class StressRecovery:
    """Matrices (n, 6, 18) from displacements and rotations of the corners to stress on both faces."""

    matrix: Values

    def evaluate(self, u: Values, chosen: Ints | slice = slice(None)) -> Values:
        """Return stresses (k, 2, 3), Pa, of chosen triangles with displacements and rotations u (k, 3, 6)."""
        return np.asarray((self.matrix[chosen] @ u.reshape(-1, 18, 1)).reshape(-1, 2, 3))


# --- bodies ---


class ShellStiffness:
    """Stiffness matrices of bodies that are parts of one shell of one material (one rank).

    Attributes:
        stress: of its cells; gives the mesh.
        shell: its middle surface, with triangles in the order of the input mesh.
        nodes: (n, 3) of the middle surface, m.
        triangles: their geometry.
        triangle_mass: (triangles,) kg.
    """

    def __init__(self, stress: Stress, shell: Shell, young: float, poisson: float, density: float) -> None:
        """Compute the element matrices; `young` in Pa, `density` in kg/m^3."""
        self.stress, self.shell = stress, shell
        self.nodes = shell.middle[: len(shell.middle) // 2]
        self.triangles = ShellTriangles.from_corners(self.nodes[shell.triangles])
        self._element_matrices = self.triangles.stiffness(young, poisson, shell.thickness)
        self._stress_recovery = self.triangles.stress_recovery(young, poisson, shell.thickness)
        self.triangle_mass = density * shell.thickness * self.triangles.area
        domain = stress.domain
        assert domain.input_mesh is not None
        count = len(self.nodes)
        # the first half of the nodes of the mesh is on the lower face, the second half on the upper one
        director = domain.input_mesh.points[count:] - domain.input_mesh.points[:count]
        self._half_thickness: Values = director / np.linalg.norm(director, axis=1)[:, None] * shell.thickness / 2
        self._whole_body: ShellBody | None = None

    @property
    def beam_thickness(self) -> float:
        """Side of the square beam that bends like a strip one triangle wide, 6 / (b h^2) = 2 / side^3, m."""
        edge = float(np.sqrt(2.3 * self.triangles.area.mean()))
        return float(np.cbrt(edge * self.shell.thickness**2 / 3))

    def whole_body(self, options: PetscOptions | None = None) -> ShellBody:
        """Return the body of all triangles, which serves all instances of the mesh."""
        if self._whole_body is None:
            self._whole_body = self.make_body(np.ones(self.stress.domain.cell_count), options)
        return self._whole_body

    def make_body(self, cell_fractions: Values, _: PetscOptions | None = None) -> ShellBody:
        """Return the body of cells with fractions (cells,); the direct solver has no options."""
        return ShellBody(self, cell_fractions)

    def triangle_fractions(self, cell_values: Values) -> Values:
        """Return the means (triangles,) of values (cells,) over the three cells of each triangle."""
        of_input = np.empty_like(cell_values)
        of_input[self.stress.domain.input_numbering.cells] = cell_values
        return np.asarray(of_input.reshape(-1, 3).mean(axis=1))

    def assemble_matrix(self, triangles: Ints, fractions: Values, row_of_node: Ints) -> csc_matrix:
        """Return the matrix of triangles (n,) with fractions (n,); `row_of_node`: (nodes,) numbers of nodes in it."""
        dofs = (6 * row_of_node[self.shell.triangles[triangles]][:, :, None] + np.arange(6)).reshape(-1, 18)
        rows, columns = np.repeat(dofs, 18, axis=1).ravel(), np.tile(dofs, 18).ravel()
        size = 6 * (int(row_of_node.max()) + 1)
        entries = fractions[:, None, None] * self._element_matrices[triangles]
        return coo_matrix((entries.ravel(), (rows, columns)), shape=(size, size)).tocsc()

    def mid_surface_forces(self, force: Values) -> Values:
        """Return forces and moments (n, 6) on the middle surface, N and N m, of forces (nodes of the mesh, 3), N."""
        of_input = np.empty_like(force)
        of_input[self.stress.domain.input_numbering.nodes] = force
        lower, upper = np.split(of_input, 2)
        return np.concatenate([lower + upper, np.cross(self._half_thickness, upper - lower)], axis=1)

    def cell_stress(self, u: Values, cell_fractions: Values) -> Values:
        """Return stresses (cells, 6), Pa, of displacements and rotations u (n, 6); 0 in cells without a fraction."""
        chosen = np.flatnonzero(self.triangle_fractions(cell_fractions))
        faces = self._stress_recovery.evaluate(u[self.shell.triangles[chosen]], chosen)
        # larger principal stress of each face
        mean, difference = (faces[:, :, 0] + faces[:, :, 1]) / 2, (faces[:, :, 0] - faces[:, :, 1]) / 2
        tension = mean + np.hypot(difference, faces[:, :, 2])
        in_plane = np.take_along_axis(faces, tension.argmax(axis=1)[:, None, None], axis=1)[:, 0]
        tensor = in_plane[:, [0, 2, 2, 1]].reshape(-1, 2, 2)
        axes = self.triangles.axes[chosen, :2]
        sigma = np.einsum("nai,nab,nbj->nij", axes, tensor, axes)
        result = np.zeros((len(self.triangles.area), 6))
        result[chosen] = np.stack([sigma[:, i, j] for i, j in SYMMETRIC_COMPONENTS[3]], axis=1)
        cells = np.repeat(result, 3, axis=0)[self.stress.domain.input_numbering.cells]
        cells[cell_fractions == 0] = 0.0
        return np.asarray(cells)


class ShellBody:
    """Analysis of a free shell, or of a fragment of one.

    Attributes:
        cell_fractions: (cells,) fraction of each cell of the mesh, 0 to 1.
        nodes: (n,) nodes of its triangles on the middle surface.
        inertia_relief: of the load.
        matrix: K (6 n, 6 n).
        cg_iterations: 0, since the solver is direct.
    """

    cg_iterations = 0

    def __init__(self, stiffness: ShellStiffness, cell_fractions: Values) -> None:
        """Assemble and factorise."""
        self._stiffness, self.cell_fractions = stiffness, cell_fractions
        fractions = stiffness.triangle_fractions(cell_fractions)
        triangles = np.flatnonzero(fractions)
        corners = stiffness.shell.triangles[triangles]
        self.nodes = np.unique(corners)
        row_of_node = np.full(len(stiffness.nodes), -1)
        row_of_node[self.nodes] = np.arange(len(self.nodes))
        self.matrix = stiffness.assemble_matrix(triangles, fractions[triangles], row_of_node)
        corner_mass = np.repeat(fractions[triangles] * stiffness.triangle_mass[triangles] / 3, 3)
        mass = np.bincount(row_of_node[corners].ravel(), corner_mass)
        # rotational inertia is smaller by (thickness / edge)^2 / 12, and neglected
        dof_mass = np.repeat(mass[:, None], 6, axis=1) * np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
        self.inertia_relief = InertiaRelief(dof_mass, _shell_rigid_modes(stiffness.nodes[self.nodes]))
        # the heaviest node is held
        fixed_dofs = np.arange(6 * int(mass.argmax()), 6 * int(mass.argmax()) + 6)
        self._free = np.setdiff1d(np.arange(6 * len(self.nodes)), fixed_dofs)
        self._factors = self._factorise(self.matrix[self._free][:, self._free])

    def _factorise(self, matrix: csc_matrix) -> object:
        """Return the factors of a positive definite matrix, without pivoting. Raises NotConverged if it is singular."""
        try:
            return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        except RuntimeError:
            raise NotConverged(
                f"the analysis of a struck shell ({len(self.nodes)} nodes) has no solution: a part of it hangs by "
                "nothing; give a better mesh"
            ) from None

    def __call__(self, force: Values) -> Values:
        """Return displacements and rotations (nodes of the middle surface, 6), m and rad, of forces, N; 0 elsewhere.

        `force`: (nodes of the mesh, 3).
        """
        load = self.inertia_relief(self._stiffness.mid_surface_forces(force)[self.nodes]).reshape(-1)
        solution = np.zeros(len(load))
        solution[self._free] = self._factors.solve(load[self._free])  # type: ignore[attr-defined]
        u = np.zeros((len(self._stiffness.nodes), 6))
        u[self.nodes] = solution.reshape(-1, 6)
        return u

    def destroy(self) -> None:
        """Do nothing: the factors are freed with this object."""


def _shell_rigid_modes(x: Values) -> Values:
    """Return rigid modes (6 n, 6) of nodes x (n, 3) about their centre, with their rotations."""
    n, arm = len(x), x - x.mean(axis=0)
    modes = np.zeros((n, 6, 6))
    modes[:, np.arange(3), np.arange(3)] = 1.0
    size = float(np.abs(arm).max())
    for axis, w in enumerate(np.eye(3) / size):
        modes[:, :3, 3 + axis], modes[:, 3:, 3 + axis] = np.cross(w, arm), w
    return modes.reshape(-1, 6)
