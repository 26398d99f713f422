"""Fields around crack tips: stress, Eshelby stress and inertia, and the forces on tips; on any number of ranks.

Gradients and values of nodal fields are sparse matrices that are kept. A linear cell has one point, its centroid. A
quadratic cell has the points of the stress quadrature, of equal weights (mechanics.jit): products of fields are
evaluated at points, and a cell gets their mean.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from scipy.sparse import csr_matrix

from ...forms.crack_closure import spring_modulus
from ...mechanics.jit import quadratic_shape_functions
from ...mechanics.stress import Stress
from ...mesh.domain import Domain
from ...mesh.edge_graph import EdgeGraph
from ...mesh.ghost_exchange import with_ghosts
from ...mesh.parallel import RemoteRows
from ...mesh.simplices import local_edges
from ...mesh.small_matrices import barycentric_gradients
from ..effective_stress import UndamagedStress
from ..principal_stress import first_principal_directions, material_normals, symmetric_tensors
from .configurational_force import closure_spring_stress, eshelby_stress, first_piola_stress, transposed_product
from .cut_cells import CutCells, CutGeometry
from .neighbour_search import NearbyCells, NeighbourPairs, weighted_mean
from .tip_neighbourhoods import CrackTips, TipNeighbourhoods, TipRadii
from .tip_parameters import TIP

Cells = npt.NDArray[np.integer]
Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


class GradientOperators:
    """Operators at the m = n `count` points of n cells, cell by cell; results have each component contiguous.

    Attributes:
        count: number of points of a cell.
    """

    @classmethod
    def of_cells(cls, domain: Domain, cells: Cells, slopes: Values) -> Self:
        """Build the operators of cells (n,) from the gradients (n, d + 1, d) of barycentric coordinates, 1/m."""
        if domain.order == 1:
            corners = domain.dim + 1
            return cls(domain.cell_nodes[cells], slopes[:, None], np.full((1, corners), 1 / corners))
        values, by_coordinate = quadratic_shape_functions(domain.mesh)
        gradients = np.einsum("pka,nai->npki", by_coordinate, slopes[:, 1:])
        return cls(domain.all_cell_nodes[cells], gradients, values)

    def __init__(self, nodes: Cells, gradients: Values, values: Values) -> None:
        """Assemble the matrices.

        Args:
            nodes: (n, k) nodes of cells.
            gradients: (n, count, k, d) gradients of the shape functions, 1/m.
            values: (count, k) shape functions.
        """
        cells, self.count, width, self._d = gradients.shape
        rows = cells * self.count
        # Columns are the nodes of these cells alone.
        unique_nodes, index = np.unique(nodes, return_inverse=True)
        index, size = np.repeat(index.reshape(cells, 1, width), self.count, axis=1).reshape(-1), len(unique_nodes)
        self._dofs = np.arange(self._d)[:, None] + self._d * unique_nodes
        # One block of rows for each axis.
        # Row pointers are multiples of the number of nodes of a cell.
        by_axis = gradients.transpose(3, 0, 1, 2).ravel()
        self._gradients = csr_matrix(
            (by_axis, np.tile(index, self._d), width * np.arange(self._d * rows + 1)), (self._d * rows, size)
        )
        self._values = csr_matrix((np.tile(values.ravel(), cells), index, width * np.arange(rows + 1)), (rows, size))

    def gather_nodal_values(self, field: Values) -> Values:
        """Return the values (d, nodes of the cells) of a nodal field (all nodes * d,)."""
        return field[self._dofs]

    def evaluate_gradients(self, nodal: Values) -> Values:
        """Return the gradients (m, d, d) of a field, H_ij = du_i / dX_j of a displacement."""
        rows = np.array([self._gradients @ component for component in nodal])
        return rows.reshape(self._d, self._d, -1).transpose(2, 0, 1)

    def evaluate_values(self, nodal: Values) -> Values:
        """Return the values (m, d) of a field."""
        return np.array([self._values @ component for component in nodal]).T

    def repeat_at_points(self, cell_values: Values) -> Values:
        """Return the values (m,) of cells (n,) at their points."""
        return cell_values if self.count == 1 else np.repeat(cell_values, self.count)

    def average_over_points(self, point_values: Values) -> Values:
        """Return the means (n, ...) over each cell of values at points (m, ...)."""
        if self.count == 1:
            return point_values
        return np.asarray(point_values.reshape(-1, self.count, *point_values.shape[1:]).mean(axis=1))


@dataclass(frozen=True)
class TipFields:
    """Fields in the cells around tips, which `TipNeighbourhoods.remote_values` requests.

    Attributes:
        neighbourhoods: tips and sums around them.
        disc_radius: (tips,) radius of the disc, in 3D ball, of the force, m.
        cell_stress: (cells, 3 or 6) Cauchy stress of the undamaged material in all cells of this rank, Pa.
        stress: (requested, 3 or 6) that stress in the cells around tips, Pa.
        sigma: (requested, d, d) Eshelby stress of the damaged body, Pa.
        inertia: (requested, d) rho (H^T a - (grad v)^T v), N/m^3; 0 without inertia.
        H: (requested, 2, 2) displacement gradient; empty in 3D.
        inertia_force: (requested, 2) rho a, N/m^3; empty in 3D.
        elastic: (tips,) mu, Pa, and (tips,) (lambda + 3 mu) / (lambda + mu).
        rotates: a rotation causes no strain (the energy is not linear).
    """

    neighbourhoods: TipNeighbourhoods
    disc_radius: Values
    cell_stress: Values
    stress: Values
    sigma: Values
    inertia: Values
    H: Values
    inertia_force: Values
    elastic: tuple[Values, Values]
    rotates: bool

    @property
    def tips(self) -> CrackTips:
        """Tips of this rank."""
        return self.neighbourhoods.tips

    def evaluate_forces(self) -> Values:
        """Return the configurational forces (tips, d), J/m^2 (collective).

        g = - sum V Sigma grad q + int q Sigma n dA + sum V q rho (H^T a - (grad v)^T v)

        The surface integral is over the body's surface, for cracks that advance towards it: it does not move with the
        crack. In 3D the result is G along the advance of the crack (crack_front).
        """
        force = self.neighbourhoods.evaluate_forces(self.sigma, self.inertia)
        return force if force.shape[1] == 2 else self.neighbourhoods.front_release_rate(force)

    def mean_stress(self, rows: Ints) -> Values:
        """Return the mean stress (m, d, d) around tips `rows` (m,), Pa."""
        return self.neighbourhoods.mean_stress(rows, self.stress)

    def stress_intensities(self) -> Values:
        """Return K_I and K_II (tips, 2) of tips in 2D, Pa sqrt(m)."""
        fields = self.stress, self.H, self.inertia_force
        return self.neighbourhoods.stress_intensities(fields, self.elastic, rotates=self.rotates)


class TipFieldEvaluator:
    """Evaluates `TipFields` at the present displacement.

    Attributes:
        centres: (cells, d) centroids of the cells of this rank, m.
        cut_cells: cut cells of all ranks.
        neighbourhoods: tips of this rank, and sums around them.
    """

    def __init__(
        self, stress: Stress, graph: EdgeGraph, radii: TipRadii, *, may_branch: bool = False, shares: bool = False
    ) -> None:
        """Find the near cells of other ranks (collective).

        Args:
            stress: stress of the body.
            graph: edges and their damage.
            radii: radii of neighbourhoods.
            may_branch: cracks may branch (2D).
            shares: tips of a front share their force (3D).
        """
        self._stress, self._graph, self._radii = stress, graph, radii
        domain = self._domain = stress.domain
        self.centres: Values = domain.nodes[domain.cell_nodes].mean(axis=1)
        self._motion: tuple[Values, Values] | None = None
        # All ranks search within the same radius.
        largest = max(float(np.max(radius, initial=0.0)) for radius in (radii.disc + radii.cell_reach, radii.start))
        largest_radius = domain.comm.allreduce(largest, op=MPI.MAX)
        self._nearby, self._geometry = NearbyCells(domain, largest_radius), CutGeometry(domain, graph)
        self.cut_cells = CutCells(graph, self._geometry, self.centres)
        self.neighbourhoods = TipNeighbourhoods(
            self._nearby, self.cut_cells, graph, self._geometry, radii, may_branch=may_branch, shares=shares
        )
        # Gradients of barycentric coordinates, NaN until they are needed.
        self._barycentric_gradients = np.full((domain.cell_count, domain.dim + 1, domain.dim), np.nan)
        self._operators: tuple[RemoteRows, GradientOperators] | None = None
        # Quadratic cells need the stress at points, not means.
        self._undamaged = UndamagedStress(stress) if domain.order == 2 else None
        material, count = stress.material, (domain.cell_count,)
        mu, lmbda = np.asarray(material.mu), np.asarray(material.lmbda)
        self._elastic = np.broadcast_to(mu, count), np.broadcast_to((lmbda + 3 * mu) / (lmbda + mu), count)
        self._density = np.broadcast_to(np.asarray(material.density), count)

    @property
    def has_motion(self) -> bool:
        """Whether the body moves with inertia."""
        return self._motion is not None

    def set_motion(self, v: Values, a: Values) -> None:
        """Store velocity (owned dofs,) in m/s and acceleration in m/s^2."""
        self._motion = v, a

    def update_tips(self, cut: Values) -> CrackTips:
        """Return the tips of this rank; `cut`: (edges,) cut positions (collective)."""
        # Without a change the tips and the cells around them are those of the last pass.
        if self.cut_cells.has_changed():
            self.neighbourhoods.update(cut)
        return self.neighbourhoods.tips

    def evaluate_fields(self, stress: Values, psi: Values) -> TipFields:
        """Evaluate the fields around tips (collective).

        Args:
            stress: (cells, 3 or 6) Cauchy stress of the undamaged material, Pa.
            psi: (cells,) energy density of the undamaged material, J/m^3.
        """
        exchange, tips, (mu, kappa) = self.neighbourhoods.remote_values, self.neighbourhoods.tips, self._elastic
        cells, operators = exchange.requested, self.operators
        H = operators.evaluate_gradients(operators.gather_nodal_values(self._stress.u.x.array))
        # Column by column, which takes half the time of rows.
        cell_stress = np.array([column[cells] for column in stress.T]).T
        assert self._stress.chi is not None
        chi = self._stress.chi.x.array[cells]
        if self._undamaged is None:
            point_stress, point_psi = cell_stress, psi[cells]
        else:
            point_stress, point_psi = self._undamaged.evaluate_at_points(cells)
        sigma = self._eshelby_stress(operators.repeat_at_points(chi), point_stress, point_psi, H)
        inertia, inertia_force = np.zeros((2, len(H), self._domain.dim))
        if self._motion is not None:
            # Cells without stiffness carry no inertia either, unless they carry pressure.
            density = np.where(self._stress.cracks_close | (chi > 0), self._density[cells], 0.0)
            v, a = (with_ghosts(self._domain, owned) for owned in self._motion)
            density = operators.repeat_at_points(density)
            kinetic, inertia, inertia_force = self._inertia_terms(density, H, operators, v, a)
            # The kinetic energy density belongs to the energy of Eshelby's stress.
            for axis in range(self._domain.dim):
                sigma[:, axis, axis] += kinetic
        sigma, inertia, H, inertia_force = map(operators.average_over_points, (sigma, inertia, H, inertia_force))
        if self._stress.cracks_close:
            sigma += self._closure_stress(cells, 1 - chi)
        # Stress intensities are evaluated in 2D alone: 3D saves the exchange.
        in_plane = (H, inertia_force) if self._domain.dim == 2 else (np.empty((len(cells), 0)),) * 2
        remote_stress, sigma, inertia, H, inertia_force = exchange(cell_stress, sigma, inertia, *in_plane)
        elastic, rotates = (mu[tips.cell], kappa[tips.cell]), not self._stress.energy.linear
        radius = tips.radius
        fields = remote_stress, sigma, inertia, H, inertia_force
        return TipFields(self.neighbourhoods, radius, stress, *fields, elastic, rotates)

    @property
    def operators(self) -> GradientOperators:
        """Operators of the cells of this rank that any rank requests, kept as long as these are the same."""
        exchange = self.neighbourhoods.remote_values
        if self._operators is None or self._operators[0] is not exchange:
            cells = exchange.requested
            built = GradientOperators.of_cells(self._domain, cells, self._gradients_of_coordinates(cells))
            self._operators = exchange, built
        return self._operators[1]

    def cut_points(self, edges: npt.NDArray[np.integer], cut: Values) -> Values:
        """Return the points (n, d) at which local edges (n,) are cut, m."""
        return self._geometry.cut_points(edges, cut)

    def mean_stress_at(self, cells: Ints, stress: Values) -> Values:
        """Return the mean stress (n, d, d), Pa, around the centroids of cells (n,) far from cracks (collective).

        `stress` is that of all cells (cells, 3 or 6), Pa.
        """
        average = self._radii.average[cells]
        pairs = self._nearby.find_pairs(self.centres[cells], average)
        weight = self._nearby.volumes[pairs.second] * (1 - pairs.distance / average[pairs.first])
        mean = weighted_mean(pairs.sum(weight[:, None] * self._near_values(pairs, stress)), pairs.sum(weight)[:, None])
        return symmetric_tensors(mean, self._domain.dim)

    def crack_normals(self, stress: Values, cells: Ints) -> tuple[Values, Values]:
        """Return the normals (n, d) of cracks across the first principal stress (n, d, d) in cells (n,).

        The first ones are unit vectors in space, the second ones those in the reference configuration.
        """
        normals = first_principal_directions(stress, self.centres[cells], self._domain.bounds.diagonal)
        if self._stress.energy.linear:
            return normals, normals
        H = self.mean_gradients(cells, self._stress.u.x.array)
        return normals, material_normals(normals, np.eye(stress.shape[1]) + H)

    def mean_stress_ahead(
        self, points: Values, normals: tuple[Values, Values], radius: Values, least_radius: Values, stress: Values
    ) -> Values:
        """Return the mean stress (n, d, d), Pa, over half discs, in 3D half balls, ahead of points (collective).

        Ahead is the direction of the tension across the coming crack: sum V <n . s n>+ (X - X_0), less its part along
        the normal. Split cells do not count, nor do cells that are compressed along n, before which the crack ends.
        Within the least radius these count as without stress: a few cells in tension beside a load start no crack.

        Args:
            points: (n, d) reference points X_0, m.
            normals: (n, d) normals of the coming cracks, n in space and those in the reference configuration.
            radius: (n,) m.
            least_radius: (n,) at most `radius`, m.
            stress: (cells, 3 or 6) Cauchy stress, Pa.
        """
        d, (spatial, material) = self._domain.dim, normals
        pairs = self._nearby.find_pairs(points, radius)
        near = self._near_values(pairs, stress)
        n = spatial[pairs.first]
        tension = np.einsum("ni,nij,nj->n", n, symmetric_tensors(near, d), n)
        volume = self._nearby.volumes[pairs.second] * ~self.neighbourhoods.split_cells[pairs.second]
        ahead = pairs.sum((volume * np.maximum(tension, 0.0))[:, None] * pairs.apart)
        ahead -= np.einsum("ni,ni->n", ahead, material)[:, None] * material
        volume = volume * (np.einsum("ni,ni->n", ahead[pairs.first], pairs.apart) >= 0)
        tensile = volume * (tension > 0)
        counted = np.where(pairs.distance < least_radius[pairs.first], volume, tensile)
        return symmetric_tensors(weighted_mean(pairs.sum(tensile[:, None] * near), pairs.sum(counted)[:, None]), d)

    def find_largest(self, cells: Ints, values: Values, radius: Values) -> npt.NDArray[np.bool_]:
        """Return whether the value of cells (n,) is the largest within radius (n,), m, of their centroids (collective).

        `values` are those of all cells (cells,). Values that are equal but for rounding are all the largest.
        """
        pairs = self._nearby.find_pairs(self.centres[cells], radius)
        near = self._near_values(pairs, values)
        return ~pairs.any(near * (1 - TIP.force_round_off) > values[cells][pairs.first])

    def _near_values(self, pairs: NeighbourPairs, values: Values) -> Values:
        """Return the values (pairs, ...) of the second cells of pairs, from those (cells, ...) of all (collective)."""
        needed, index = np.unique(pairs.second, return_inverse=True)
        exchange = self._nearby.request_values(needed)
        (near,) = exchange(values[exchange.requested])
        return np.ascontiguousarray(near)[index]

    def mean_gradients(self, cells: Ints, field: Values) -> Values:
        """Return the mean gradients (n, d, d) of a nodal field (nodes * d,) in cells (n,)."""
        operators = GradientOperators.of_cells(self._domain, cells, self._gradients_of_coordinates(cells))
        return operators.average_over_points(operators.evaluate_gradients(operators.gather_nodal_values(field)))

    def _eshelby_stress(self, chi: Values, stress: Values, psi: Values, H: Values) -> Values:
        """Return Eshelby's stress (m, d, d), Pa, of undamaged stress (m, 3 or 6) and energy density (m,)."""
        cauchy = symmetric_tensors((chi * stress.T).T, self._domain.dim)
        P = first_piola_stress(cauchy, H, linear=self._stress.energy.linear)
        return eshelby_stress(chi * psi, H, P)

    def _closure_stress(self, cells: Ints, share: Values) -> Values:
        """Return Eshelby's stress (n, d, d), Pa, of the springs of broken edges, of which cells have `share` (n,)."""
        graph, material, corners = self._graph, self._stress.material, self._domain.cell_nodes[cells]
        nodes, moved = self._domain.nodes[corners], self._stress.u.x.array.reshape(-1, self._domain.dim)[corners]
        # The length of an edge depends on its corners alone, also with quadratic displacement.
        H = np.einsum("nki,nkj->nij", moved, self._gradients_of_coordinates(cells))
        first, second = local_edges(self._domain.dim).T
        stiff = np.broadcast_to(spring_modulus(material, self._domain.dim, len(first)), (len(self.centres),))[cells]
        modulus = (share * stiff)[:, None] * ~graph.intact(cells)
        vectors = nodes[:, second] - nodes[:, first]
        psi, P = closure_spring_stress(vectors, modulus, H, linear=self._stress.energy.linear)
        return eshelby_stress(psi, H, P)

    @staticmethod
    def _inertia_terms(
        density: Values, H: Values, operators: GradientOperators, v: Values, a: Values
    ) -> tuple[Values, Values, Values]:
        """Return rho v^2 / 2 (m,), J/m^3, rho (H^T a - (grad v)^T v) (m, d) and rho a (m, d), N/m^3, at points."""
        nodal_v = operators.gather_nodal_values(v)
        velocity = operators.evaluate_values(nodal_v)
        inertia_force = density[:, None] * operators.evaluate_values(operators.gather_nodal_values(a))
        momentum = density[:, None] * velocity
        gradient_v = operators.evaluate_gradients(nodal_v)
        inertia = transposed_product(H, inertia_force) - transposed_product(gradient_v, momentum)
        return np.einsum("ni,ni->n", velocity, momentum) / 2, inertia, inertia_force

    def _gradients_of_coordinates(self, cells: Ints) -> Values:
        """Return the gradients (n, d + 1, d) of the barycentric coordinates of cells (n,), 1/m."""
        # Gradients of reference cells never change.
        new = cells[np.isnan(self._barycentric_gradients[cells, 0, 0])]
        if len(new):
            self._barycentric_gradients[new] = barycentric_gradients(self._domain.nodes[self._domain.cell_nodes[new]])
        return self._barycentric_gradients[cells]
