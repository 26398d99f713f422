"""Contact between the elements of one surface: barrier, friction and collision detection of ipctk, on one rank.

    E(x) = k int b(d(x)) dA,   b(d) = -D (s - 1)^2 ln s where s = (d / D)^2 < 1, 0 elsewhere   (m)

with d the distance from a point of the surface to the rest of it, D the distance at which the barrier begins and k the
stiffness in Pa. The integral is the mean of both sides, with one sample point an element: the centroid, weighted with
the reference area (2D: length, and all per m of thickness). So the pressure between parallel faces is k |b'(d)|, and
has no tangential part where rims lie above one another (sample_points). The "improved max" set of ipctk (Li et al.
2023, Convergent IPC) counts elements near the same point once, and keeps E continuously differentiable.

A vertex or an edge may come near with no centroid near. Each has a barrier of its own, which begins nearer: of vertices
at VERTICES D, of edges against edges in 3D at EDGES D. As many edges cross each other between two flat faces as their
meshes please; from D on, the pressure would depend on them (by a factor of 1.6 to 2.8). At D / 2 the pressure is 4.3 k
by centroids, and 2.6 k more by vertices. Elements that share a point do not touch each other.

The caller maps nodes to points of the surface and forces back: x = W u and W^T f; ipctk's displacement map is unused.

Equations: docs/theory.md#barrier.
"""

from __future__ import annotations

import ipctk
import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix

from .crossings import NONE, crossings
from .near import KEPT, Kind, Near, longest
from .sample_points import Centroids, Vertices, measures
from .slip import Friction, projection

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

VERTICES = 0.8  # of the distance of the barrier, as EDGES
EDGES = 0.5  # of the distance of the barrier
MARGIN = 0.5  # of the distance of the barrier: how far points may move before candidates are looked for again
MOST, WIDE = 128, 3.0  # pieces of a step, and the measure of the boxes in one


class Pairs:
    """Barrier and lagged Coulomb friction between the elements of a surface.

    x is always (n, d): where the points are, m. Candidates are kept until a point has moved by MARGIN `distance`.
    """

    def __init__(
        self, rest: Values, elements: Ints, *, distance: float, stiffness: float, friction: float = 0.0
    ) -> None:
        """`rest` (n, d) m; `elements` (m, d) points of segments or triangles; `distance` m, `stiffness` Pa.

        Points of no element are let alone. `friction` is Coulomb's coefficient.
        """
        ipctk.set_num_threads(1)  # a thread a rank, and sums in the same order each time
        self._elements, corners = elements, elements.astype(np.int32)
        solid = rest.shape[1] == 3
        faces = (corners,) if solid else ()
        self._mesh = ipctk.CollisionMesh.build_from_full_mesh(rest, ipctk.edges(corners) if solid else corners, *faces)
        # the points of a triangle's side are half of all that touches it in ipctk's count, the edges the other half
        vertices = Vertices(self._mesh)
        kinds: list[tuple[float, float, str, Vertices | Centroids]] = [(1.0 + solid, 1.0, "", Centroids(self._mesh))]
        kinds += [(1.0 + solid, VERTICES, "fv_candidates" if solid else "ev_candidates", vertices)]
        kinds += [(1.0, EDGES, "ee_candidates", vertices)] if solid else []
        self._times = [times for times, *_ in kinds]
        made = [Kind(share * distance, times * stiffness, name, of) for times, share, name, of in kinds]
        self._near = Near(self._mesh, made, distance, MARGIN * distance)
        self._edge = ipctk.mean_edge_length(self._mesh.rest_positions, self._mesh.rest_positions, self._mesh.edges)[0]
        self._friction, self._distance = friction, distance
        self._area = areas(rest, elements)

    # --- the barrier ---

    def energy(self, x: Values) -> float:
        """E(x), J."""
        on = self._mesh.vertices(x)
        return sum(met.energy() for met in self._near.touching(on))

    def gradient(self, x: Values) -> Values:
        """(n, d) dE/dx, N: the force on the points is its negative."""
        on = self._mesh.vertices(x)
        found = sum(met.gradient() for met in self._near.touching(on))
        return np.asarray(self._mesh.to_full_dof(found)).reshape(x.shape)

    def hessian(self, x: Values, *, exact: bool = False) -> csr_matrix:
        """(n d, n d) d2E/dx2, N/m; unless `exact`, the share of each pair without its negative eigenvalues."""
        on, how = self._mesh.vertices(x), projection(exact=exact)
        found = sum(met.hessian(how) for met in self._near.touching(on))
        return csr_matrix(self._mesh.to_full_dof(found))

    def stiffen(self, stiffness: float) -> None:
        """The barrier has this stiffness, Pa, from here on."""
        self._near.stiffen([times * stiffness for times in self._times])

    def forget(self) -> None:
        """Forget which elements were near."""
        self._near.forget()

    def least_gap(self, x: Values) -> float:
        """The least distance between elements on which the barrier acts, m; infinite where there is none."""
        return self._gap_at(self._mesh.vertices(x))

    def _gap_at(self, on: Values) -> float:
        return float(np.sqrt(min(met.least_squared_distance() for met in self._near.touching(on))))

    def look_along(self, x: Values, to: Values) -> None:
        """Have candidates for all the way from x to `to` (n, d), m."""
        self._near.look_along(self._mesh.vertices(x), self._mesh.vertices(to))

    # --- friction ---

    def lag_friction(self, x: Values, start: Values, slip: float) -> Friction:
        """Friction with the pressures and directions at x, as points move away from `start` (n, d), m.

        `slip`, m: from this sliding on it has its full size; a speed times the time step.
        """
        on = self._mesh.vertices(x)
        parts = []
        for met in self._near.touching(on):
            part = ipctk.TangentialCollisions()
            part.build(met.kind.samples.mesh, met.positions, met.pairs, met.kind.barrier, self._friction)
            parts.append((met.kind.samples, part))
        return Friction(self._mesh, parts, self._mesh.vertices(start), ipctk.FrictionPotential(slip))

    # --- collisions ---

    def longest_step(self, x: Values, to: Values) -> float:
        """The share in (0, 1] of the straight way from x to `to` on which nothing meets.

        The way is walked in pieces, MOST at most (boxes around longer ones would all meet), and the pair that would
        meet is left at least KEPT of its distance at the begin of the piece.
        """
        on, way = self._mesh.vertices(x), self._mesh.vertices(to) - self._mesh.vertices(x)
        way -= way.mean(axis=0)  # what all have in common brings nothing together
        if self._is_short(on, way):
            return 1.0
        pieces = self._pieces(way)
        for piece in range(min(pieces, MOST)):
            share = self._near.free(on + piece / pieces * way, on + (piece + 1) / pieces * way)
            if share < 1.0:
                return (piece + share) / pieces
        return min(pieces, MOST) / pieces

    def _is_short(self, on: Values, way: Values) -> bool:
        """Whether a way (n, d) leaves KEPT of every gap however points go, as half of Newton's corrections do.

        A pair on which no barrier acts is no nearer than that of edges begins.
        """
        most = 2.0 * longest(way) / (1.0 - KEPT)
        return most <= EDGES * self._distance and most <= self._gap_at(on)

    def _pieces(self, way: Values) -> int:
        """In how many pieces a way (n, d) is walked: so many that boxes around what moves have on average WIDE times
        the measure of one around an edge. A few fast points alone do not make ways shorter."""
        pieces = 1
        while pieces < 2**30 and np.mean(np.prod(1.0 + abs(way) / (pieces * self._edge), axis=1)) > WIDE:
            pieces *= 2
        return pieces

    def overlaps(self, x: Values) -> Ints:
        """(k, 2) elements that cut each other."""
        on = self._mesh.vertices(x)
        return crossings(self._mesh, on) if ipctk.has_intersections(self._mesh, on, ipctk.LBVH()) else NONE

    def pressure(self, x: Values) -> Values:
        """(n,) the barrier's force on each point by its share of the reference surface, Pa; 0 where it has none."""
        force, area = np.linalg.norm(self.gradient(x), axis=1), self._area
        return np.asarray(np.divide(force, area, out=np.zeros_like(area), where=area > 0))


def areas(x: Values, elements: Ints) -> Values:
    """(n,) share of each point in the measure of the elements around it, m^2 (2D: m)."""
    measure, d = measures(x, elements), x.shape[1]
    return np.asarray(np.bincount(elements.reshape(-1), np.repeat(measure / d, d), minlength=len(x)), float)
