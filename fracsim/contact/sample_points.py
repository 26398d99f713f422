"""Sample points of the barrier between the elements of a surface, vertices and centroids, and friction at them.

With one point at the centroid of an element, weighted with the element's measure, the barrier between two parallel
faces presses along their normal as long as no centroid overhangs. Points on the rim press outwards as soon as aligned
rims are shifted by dx: their tangential force is F dx / g at a gap g. A stack of mass m without friction then slides
apart, and the speed grows at a rate of sqrt(F / (m g)).

Equations: docs/theory.md#barrier, docs/theory.md#friction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import ipctk
import numpy as np
from scipy.sparse import csr_matrix, kron

from ..array_types import Ints, Values
from .shape_base import measures


class SamplePoints:
    """Vertices of a surface, n, and after them the m centroids of its elements.

    ipctk weights vertices with their shares of the elements around them, and centroids, points of no element, with 1.

    Attributes:
        elements: (m, d) vertices of segments or triangles.
    """

    def __init__(self, surface: ipctk.CollisionMesh, points: Ints, count: int) -> None:
        """Sample points of a surface with the vertices `points` (n,) among N = `count` points."""
        self._surface, self._points, self._point_count = surface, points, count
        self.elements: Ints = np.asarray(surface.faces if surface.dim == 3 else surface.edges, np.int64)
        self._count = surface.num_vertices

    def _weights_of(self, columns: Ints, count: int) -> csr_matrix:
        """(n + m, count) weights of the vertices, which have these columns (n,), in the sample points."""
        m, corners = self.elements.shape
        weights = np.concatenate([np.ones(self._count), np.full(m * corners, 1 / corners)])
        starts = np.append(np.arange(self._count), self._count + np.arange(0, m * corners + 1, corners))
        entries = np.append(columns, columns[self.elements])
        return csr_matrix((weights, entries, starts), shape=(self._count + m, count))

    @cached_property
    def _map(self) -> csr_matrix:
        """(n + m, N) weights of the points in the sample points."""
        return self._weights_of(self._points, self._point_count)

    @cached_property
    def _map_of_dofs(self) -> csr_matrix:
        return kron(self._map, np.eye(self._surface.dim), format="csr")

    @cached_property
    def mesh(self) -> ipctk.CollisionMesh:
        """Surface with the centroids as points of no element."""
        of_vertices = self._weights_of(np.arange(self._count), self._count)
        rest_positions = np.asfortranarray(of_vertices @ self._surface.rest_positions)
        faces = (self._surface.faces,) if self._surface.dim == 3 else ()
        return ipctk.CollisionMesh(rest_positions, self._surface.edges, *faces)

    @property
    def lowest_vertices(self) -> Ints:
        """(n + m,) lowest vertex of which each sample point consists."""
        return np.append(np.arange(self._count), self.elements.min(axis=1))

    @cached_property
    def _weights(self) -> Values:
        """Measures of the elements, m^2 (2D: m), behind a 0 for each vertex."""
        return np.append(np.zeros(self._count), measures(self._surface.rest_positions, self.elements))

    def positions(self, x: Values) -> Values:
        """(n + m, d) sample points with the points at x (N, d), m."""
        return np.asarray(self._map @ x)

    def gradient(self, at_samples: Sequence[Values]) -> Values:
        """(N, d) derivatives by the points of the sum of derivatives ((n + m) d,) by the sample points."""
        shape = self._point_count, self._surface.dim
        if not at_samples:
            return np.zeros(shape)
        return np.asarray(self._map_of_dofs.T @ sum(at_samples[1:], at_samples[0])).reshape(shape)

    def hessian(self, at_samples: Sequence[csr_matrix]) -> csr_matrix:
        """(N d, N d) second derivatives by the points of the sum of those by the sample points."""
        if not at_samples:
            return csr_matrix((self._point_count * self._surface.dim,) * 2)
        return (self._map_of_dofs.T @ sum(at_samples[1:], at_samples[0]) @ self._map_of_dofs).tocsr()

    def weight_centroids(self, pairs: ipctk.NormalCollisions) -> None:
        """Multiply the weights of pairs of centroids by the measures of their elements."""
        measure = self._weights
        for pair in (*pairs.fv_collisions, *pairs.ev_collisions):
            pair.weight *= measure[pair.vertex_id]
        for pair in pairs.vv_collisions:
            pair.weight *= measure[max(pair.vertex0_id, pair.vertex1_id)]


def vertex_areas(x: Values, elements: Ints) -> Values:
    """(n,) share of each point in the measure of the elements around it, m^2 (2D: m)."""
    measure, d = measures(x, elements), x.shape[1]
    return np.asarray(np.bincount(elements.reshape(-1), np.repeat(measure / d, d), minlength=len(x)), float)


@dataclass(frozen=True)
class IpcFriction:
    """Lagged Coulomb friction of ipctk's pairs: a potential of the slip (Li et al. 2020, eq. 19).

        E(x) = mu sum_k N_k f(|T_k^T (x - x_0)|),   f(y) = y for y > e, -y^3 / (3 e^2) + y^2 / e + e / 3 below

    N_k is the normal force of a pair, N, T_k its tangents, e the slip that counts as sticking, m. The gradient is the
    friction of a backward Euler step: against the slip, and at most mu N_k.

    Attributes:
        samples: sample points.
        parts: pairs of each kind.
        start: (n, d) x_0, m.
        potential: of ipctk.
    """

    samples: SamplePoints
    parts: list[ipctk.TangentialCollisions]
    start: Values
    potential: ipctk.FrictionPotential

    def energy(self, x: Values) -> float:
        """E(x), J: not stored, but the work of friction where the slip is longer than e."""
        mesh, motion = self.samples.mesh, self._motion(x)
        return sum((float(self.potential(pairs, mesh, motion)) for pairs in self.parts), 0.0)

    def gradient(self, x: Values) -> Values:
        """(n, d) dE/dx, N: minus the forces on the points."""
        mesh, motion = self.samples.mesh, self._motion(x)
        of_parts = [self.potential.gradient(pairs, mesh, motion) for pairs in self.parts]
        return self.samples.gradient(of_parts)

    def hessian(self, x: Values, *, exact: bool = False) -> csr_matrix:
        """(n d, n d) d2E/dx2, N/m; unless `exact`, each pair without its negative eigenvalues."""
        mesh, motion, method = self.samples.mesh, self._motion(x), projection(exact=exact)
        of_parts = [self.potential.hessian(pairs, mesh, motion, method) for pairs in self.parts]
        return self.samples.hessian(of_parts)

    def _motion(self, x: Values) -> Values:
        """Motion of the sample points, m."""
        return self.samples.positions(x - self.start)


def projection(*, exact: bool) -> ipctk.PSDProjectionMethod:
    """Treatment of negative eigenvalues by ipctk: none if `exact`, else clamped to 0."""
    return ipctk.PSDProjectionMethod.NONE if exact else ipctk.PSDProjectionMethod.CLAMP
