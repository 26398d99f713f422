"""Level set phi (m) of a crack surface on the nodes of the input mesh: planar or curved.

Planar: phi = N . (X - X_0). Curved: phi is extended along its own surface. A node j that completes a cell behind a
facet which the surface crosses gets

    N_j   = unit(w_j D_j + (1 - w_j) N),       N the mean normal of the facet's nodes, D_j oriented like N,
    phi_j = mean over i of phi_i + (N_i + N_j) / 2 . (X_j - X_i)     (trapezoidal rule),

with the principal direction D_j around the node and its reliability w_j: 1 where the stress reaches the strength and
one principal stress stands out, 0 without tension, where the surface continues straight.

Equations: docs/theory.md#brittle-surfaces.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from ..principal_stress import (
    first_principal_directions,
    first_principal_stress,
    material_normals,
    unit_or_first_axis,
)
from .surface_cut import SurfaceCutMesh, sides_of_level_set

Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
Values = npt.NDArray[np.float64]


def plane_distance(points: Values, origin: Values, normal: Values) -> Values:
    """Return the signed distances (nodes,) of points (nodes, d) from a plane, m."""
    return np.asarray((points - origin) @ normal)


@dataclass(frozen=True)
class DirectionField:
    """First principal directions around the nodes.

    Attributes:
        direction: (nodes, d) unit vectors in the reference configuration, of arbitrary sign.
        weight: (nodes,) reliability of the directions, 0 to 1.
    """

    direction: Values
    weight: Values

    @classmethod
    def from_cells(cls, mesh: SurfaceCutMesh, stress: Values, gradient: Values, strength: Values) -> DirectionField:
        """Average the directions of cells at nodes.

        Q = sum V w N x N / sum V over the cells around a node. Its eigenvector of the largest eigenvalue is the
        direction, and the distance to the next eigenvalue is the weight.

        Args:
            mesh: the input mesh.
            stress: (cells, d, d) Pa.
            gradient: (cells, d, d) deformation gradient F.
            strength: (cells,) Pa.
        """
        share = np.clip(first_principal_stress(stress) / strength, 0.0, 1.0) * mesh.volumes
        normal = material_normals(first_principal_directions(stress, mesh.centroids, mesh.size), gradient)
        dyads = (share[:, None, None] * normal[:, :, None] * normal[:, None, :]).reshape(len(stress), -1)
        sums = (mesh.node_cells @ dyads) / (mesh.node_cells @ mesh.volumes)[:, None]
        values, vectors = np.linalg.eigh(sums.reshape(-1, mesh.dim, mesh.dim))
        return cls(vectors[:, :, -1], np.clip(values[:, -1] - values[:, -2], 0.0, 1.0))


class CurvedLevelSet:
    """Level set that is extended cell by cell from one start.

    Attributes:
        phi: (nodes,) m, NaN where the surface does not come.
    """

    def __init__(self, mesh: SurfaceCutMesh, field: DirectionField, broken: Flags) -> None:
        """Prepare the extension over intact edges; `broken`: (edges,)."""
        self._mesh, self._field, self._broken = mesh, field, broken
        self.phi = np.full(len(mesh.points), np.nan)
        self._normal = np.zeros(mesh.points.shape)

    def __call__(self, cell: int, origin: Values, normal: Values) -> Values:
        """Extend phi from a cell until no cell can be completed; return it."""
        new = self._mesh.cells[cell]
        self.phi[new] = plane_distance(self._mesh.points[new], origin, normal)
        self._normal[new] = normal
        while len(new):
            new = self._extend_by_layer(new)
        return self.phi

    def extrapolate_to(self, required: Flags) -> Values:
        """Return phi (nodes,), on required nodes without a value that of the tangent plane at the nearest node."""
        unknown = np.isnan(self.phi) & required
        defined = np.flatnonzero(~np.isnan(self.phi))
        points, phi = self._mesh.points, self.phi.copy()
        # Beyond the surface phi continues as the tangent plane.
        near = defined[cKDTree(points[defined]).query(points[unknown])[1]]
        phi[unknown] = phi[near] + np.einsum("ni,ni->n", self._normal[near], points[unknown] - points[near])
        return phi

    def _extend_by_layer(self, new: Ints) -> Ints:
        """Complete the cells around new nodes that lack one node; return the nodes that got a value."""
        cells, missing, enters = self._cells_to_complete(new)
        node = self._mesh.cells[cells][missing]
        facet = self._mesh.cells[cells][~missing].reshape(len(cells), self._mesh.dim)[enters]
        node = node[enters]
        if not len(node):
            return node
        normal, phi = self._extend_behind_facets(node, facet)
        # A node behind several facets gets the mean of their values.
        target, row, count = np.unique(node, return_inverse=True, return_counts=True)
        self.phi[target] = np.bincount(row, phi) / count
        for axis in range(self._mesh.dim):
            self._normal[target, axis] = np.bincount(row, normal[:, axis])
        self._normal[target] = unit_or_first_axis(self._normal[target])
        return target

    def _cells_to_complete(self, new: Ints) -> tuple[Ints, Flags, Flags]:
        """Find the cells around new nodes that lack one value.

        Returns:
            Cells (n,), flags (n, d + 1) of the lacking node, and flags (n,) of the cells that the surface enters
            through the facet opposite to it, over intact edges.
        """
        mesh = self._mesh
        cells = np.unique(mesh.node_cells[new].indices).astype(np.int64)
        missing = np.isnan(self.phi[mesh.cells[cells]])
        lacks_one = np.count_nonzero(missing, axis=1) == 1
        cells, missing = cells[lacks_one], missing[lacks_one]
        ends = self.phi[mesh.edges[mesh.cell_edges[cells]]]
        side = sides_of_level_set(ends, mesh.tolerance)
        crossed = (side[:, :, 0] != side[:, :, 1]) & ~np.isnan(ends).any(axis=2)
        return cells, missing, crossed.any(axis=1) & ~(crossed & self._broken[mesh.cell_edges[cells]]).any(axis=1)

    def _extend_behind_facets(self, node: Ints, facet: Ints) -> tuple[Values, Values]:
        """Return normals (n, d) and phi (n,) at nodes (n,) behind facets (n, d nodes)."""
        ahead = unit_or_first_axis(self._normal[facet].sum(axis=1))
        direction, weight = self._field.direction[node], self._field.weight[node][:, None]
        # Directions that are at right angles but for rounding keep their sign.
        sign = np.where(np.einsum("ni,ni->n", direction, ahead) >= -1e-9, 1.0, -1.0)[:, None]
        normal = unit_or_first_axis(weight * sign * direction + (1 - weight) * ahead)
        step = self._mesh.points[node][:, None] - self._mesh.points[facet]
        mean = (self._normal[facet] + normal[:, None]) / 2
        return normal, (self.phi[facet] + np.einsum("nki,nki->nk", mean, step)).mean(axis=1)
