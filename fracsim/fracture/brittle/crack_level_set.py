"""The surface through a start as a level set phi (m) on the nodes of the input mesh: planar, or curving.

Planar: phi = N . (X - X_0). Curved: phi grows along its own surface. A node j that completes a cell behind a facet that
the surface crosses gets

    N_j   = unit(w_j D_j + (1 - w_j) N),       N the mean normal of the facet's nodes, D_j in the sense of N,
    phi_j = mean over i of phi_i + (N_i + N_j) / 2 . (X_j - X_i)     (the trapezoidal rule),

with D_j the principal direction around the node and w_j how far it can be relied on: 1 where the stress has the
strength and one principal stress stands out, 0 where there is no tension, so that the surface goes straight on there.

Equations: docs/theory.md#brittle-surfaces.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from .principal_stress import directions, largest, material_normals, unit
from .surface_cut import Body, sides_of

Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
Values = npt.NDArray[np.float64]


def planar(points: Values, origin: Values, normal: Values) -> Values:
    """(N,) signed distances of points (N, d) from a plane."""
    return np.asarray((points - origin) @ normal)


@dataclass(frozen=True)
class DirectionField:
    """Principal directions around the nodes.

    Attributes:
        direction: (N, d) unit vectors in the reference configuration, without a sense.
        weight: (N,) 0 to 1, how far they can be relied on.
    """

    direction: Values
    weight: Values

    @classmethod
    def of(cls, body: Body, stress: Values, gradient: Values, strength: Values) -> DirectionField:
        """From stress and F (C, d, d) and strength (C,) of the cells.

        Q = sum V w N x N / sum V over the cells around a node; its largest eigenvector is the direction, and what that
        eigenvalue is ahead of the next is the weight.
        """
        share = np.clip(largest(stress) / strength, 0.0, 1.0) * body.volumes
        normal = material_normals(directions(stress, body.centroids, 0), gradient)
        dyads = (share[:, None, None] * normal[:, :, None] * normal[:, None, :]).reshape(len(stress), -1)
        sums = (body.around @ dyads) / (body.around @ body.volumes)[:, None]
        values, vectors = np.linalg.eigh(sums.reshape(-1, body.dim, body.dim))
        return cls(vectors[:, :, -1], np.clip(values[:, -1] - values[:, -2], 0.0, 1.0))


class Curved:
    """phi grown from one start.

    Attributes:
        phi: (N,) m, NaN where the surface does not come.
    """

    def __init__(self, body: Body, field: DirectionField, broken: Flags) -> None:
        self._body, self._field, self._broken = body, field, broken
        self.phi = np.full(len(body.points), np.nan)
        self._normal = np.zeros(body.points.shape)

    def __call__(self, cell: int, origin: Values, normal: Values) -> Values:
        """Grow from a cell until nothing is left to complete; returns phi."""
        new = self._body.cells[cell]
        self.phi[new] = planar(self._body.points[new], origin, normal)
        self._normal[new] = normal
        while len(new):
            new = self._layer(new)
        return self.phi

    def extended(self, wanted: Flags) -> Values:
        """(N,) phi; on nodes that are wanted (N,) and where the surface does not come, that of the nearest plane."""
        unknown = np.isnan(self.phi) & wanted
        known = np.flatnonzero(~np.isnan(self.phi))
        points, phi = self._body.points, self.phi.copy()
        near = known[cKDTree(points[known]).query(points[unknown])[1]]
        phi[unknown] = phi[near] + np.einsum("ni,ni->n", self._normal[near], points[unknown] - points[near])
        return phi

    def _layer(self, new: Ints) -> Ints:
        """Complete the cells around new nodes that lack one node; returns those nodes."""
        cells, missing, known = self._to_complete(new)
        node = self._body.cells[cells][missing]
        others = self._body.cells[cells][~missing].reshape(len(cells), self._body.dim)[known]
        node = node[known]
        if not len(node):
            return node
        normal, phi = self._beyond(node, others)
        target, place, count = np.unique(node, return_inverse=True, return_counts=True)
        self.phi[target] = np.bincount(place, phi) / count
        for axis in range(self._body.dim):
            self._normal[target, axis] = np.bincount(place, normal[:, axis])
        self._normal[target] = unit(self._normal[target])
        return target

    def _to_complete(self, new: Ints) -> tuple[Ints, Flags, Flags]:
        """Cells around new nodes that lack one node, (n, d + 1) flags of that node, and which of the cells the surface
        enters through the facet opposite, over intact edges."""
        body = self._body
        cells = np.unique(body.around[new].indices).astype(np.int64)
        missing = np.isnan(self.phi[body.cells[cells]])
        lacking = np.count_nonzero(missing, axis=1) == 1
        cells, missing = cells[lacking], missing[lacking]
        ends = self.phi[body.edges[body.cell_edges[cells]]]
        side = sides_of(ends, body.tolerance)
        crossed = (side[:, :, 0] != side[:, :, 1]) & ~np.isnan(ends).any(axis=2)
        return cells, missing, crossed.any(axis=1) & ~(crossed & self._broken[body.cell_edges[cells]]).any(axis=1)

    def _beyond(self, node: Ints, others: Ints) -> tuple[Values, Values]:
        """(n, d) normals and (n,) phi at nodes from those of the facets (n, d nodes) opposite."""
        ahead = unit(self._normal[others].sum(axis=1))
        found, weight = self._field.direction[node], self._field.weight[node][:, None]
        sense = np.where(np.einsum("ni,ni->n", found, ahead) >= -1e-9, 1.0, -1.0)[:, None]
        normal = unit(weight * sense * found + (1 - weight) * ahead)
        step = self._body.points[node][:, None] - self._body.points[others]
        mean = (self._normal[others] + normal[:, None]) / 2
        return normal, (self.phi[others] + np.einsum("nki,nki->nk", mean, step)).mean(axis=1)
