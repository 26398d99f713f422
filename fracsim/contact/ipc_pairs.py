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

Which elements of a surface are near each other: candidates, kept while points move little, and pairs that touch.

Three kinds of pairs: centroids against elements, vertices against elements, and in 3D edges against edges, each with a
barrier of its own.

Elements of a surface that cut each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import ipctk
import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix

from .ipc_friction import IpcFriction, projection
from .sample_points import Centroids, Vertices, measures

Values = npt.NDArray[np.float64]
KEPT = 0.1  # of a gap is left by a step
# of the collision detection: faces that slide on each other would take for ever; with 1,000 of them pairs at a
# thousandth of the barrier's distance held Newton's method to a fifth of its steps
ROUNDS = 10_000
CCD = ipctk.AdditiveCCD(ROUNDS, 1.0 - KEPT)
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
NONE: Ints = np.empty((0, 2), np.int64)
VERTICES = 0.8  # of the distance of the barrier, as EDGES
EDGES = 0.5  # of the distance of the barrier
MARGIN = 0.5  # of the distance of the barrier: how far points may move before candidates are looked for again
MOST, WIDE = 128, 3.0  # pieces of a step, and the measure of the boxes in one


@dataclass(frozen=True)
class PairKind:
    """The barrier of one kind of pairs, from `distance` m on with `stiffness` Pa, between sample points or edges and
    elements; `name` of the list of ipctk's candidates, "" for centroids, which have candidates of their own."""

    distance: float
    stiffness: float
    name: str
    samples: Vertices | Centroids

    @cached_property
    def barrier(self) -> ipctk.BarrierPotential:
        """That of ipctk."""
        return ipctk.BarrierPotential(self.distance, self.stiffness, True)

    def active_pairs(self, candidates: ipctk.Candidates, x: Values) -> ActivePairs:
        """Those of the candidates on which the barrier acts with vertices at x (n, d)."""
        pairs = ipctk.NormalCollisions()
        pairs.use_area_weighting = True
        pairs.collision_set_type = ipctk.NormalCollisions.IMPROVED_MAX_APPROX
        positions = self.samples.positions(x)
        pairs.build(candidates, self.samples.mesh, positions, self.distance)
        self.samples.weight(pairs)
        return ActivePairs(self, pairs, positions)


@dataclass(frozen=True)
class ActivePairs:
    """Pairs on which the barrier of a kind acts, with the sample points at `positions` (p, d), m."""

    kind: PairKind
    pairs: ipctk.NormalCollisions
    positions: Values

    def energy(self) -> float:
        """J."""
        return float(self.kind.barrier(self.pairs, self.kind.samples.mesh, self.positions))

    def gradient(self) -> Values:
        """(n d,) by the vertices, N."""
        samples = self.kind.samples
        return samples.gradient(self.kind.barrier.gradient(self.pairs, samples.mesh, self.positions))

    def hessian(self, projection: ipctk.PSDProjectionMethod) -> csr_matrix:
        """(n d, n d) by the vertices, N/m."""
        samples = self.kind.samples
        return samples.hessian(self.kind.barrier.hessian(self.pairs, samples.mesh, self.positions, projection))

    def least_squared_distance(self) -> float:
        """m^2."""
        return float(self.pairs.compute_minimum_distance(self.kind.samples.mesh, self.positions))


class PairSearch:
    """Candidates within `distance` + 2 `margin` (m) of each other; x (n, d) of the mesh's points.

    They are looked for on the whole way of a step of Newton's method, and serve all that stays within `margin` of it:
    where the line search stops, the steps after it, and the way of the next one, which mostly goes on along it.
    """

    def __init__(self, mesh: ipctk.CollisionMesh, kinds: list[PairKind], distance: float, margin: float) -> None:
        self._mesh, self._kinds, self._margin, self._radius = mesh, kinds, margin, 0.5 * distance + margin
        self.clear_caches()

    def clear_caches(self) -> None:
        """Nothing is known of any place."""
        self._candidates: list[ipctk.Candidates] = []
        self._found: list[ActivePairs] = []
        self._from = self._way = self._found_at = np.full(self._mesh.rest_positions.shape, np.nan)

    def active_pairs(self, x: Values) -> list[ActivePairs]:
        """The pairs of each kind on which its barrier acts; those of the last x are kept."""
        if not np.array_equal(x, self._found_at):
            each = zip(self._kinds, self.candidates(x), strict=True)
            self._found = [kind.active_pairs(candidates, x) for kind, candidates in each]
            self._found_at = x.copy()
        return self._found

    def set_stiffness(self, stiffness: Sequence[float]) -> None:
        """Barriers have this stiffness of each kind, Pa, from here on; what touches stays."""
        self._kinds = [replace(kind, stiffness=k) for kind, k in zip(self._kinds, stiffness, strict=True)]
        self._found = [replace(met, kind=kind) for kind, met in zip(self._kinds, self._found, strict=False)]

    def candidates(self, x: Values) -> list[ipctk.Candidates]:
        """Of each kind; the same ones while they hold."""
        if not self._holds(x):
            self._look(x, x)
        return self._candidates

    def free_fraction(self, x: Values, to: Values) -> float:
        """The share in (0, 1] of the way from x to `to` on which nothing meets: KEPT of each gap is left."""
        self.search_along(x, to)
        own = [each for kind, each in zip(self._kinds, self._candidates, strict=True) if kind.name]
        steps = (each.compute_collision_free_stepsize(self._mesh, x, to, 0.0, CCD) for each in own)
        return float(min(steps))

    def search_along(self, x: Values, to: Values) -> None:
        """Have candidates for all the way from x to `to`."""
        if not (self._holds(x) and self._holds(to)):
            self._look(x, to)

    def _look(self, x: Values, to: Values) -> None:
        """Candidates on the way from x to `to`; what all points have in common brings nothing together."""
        start, end = centred(x), centred(to)
        found = ipctk.Candidates()  # one tree for all kinds: it is most of what a look costs
        found.build(self._mesh, start, end, self._radius, ipctk.LBVH())
        self._candidates = [self._of_kind(kind, found, start, end) for kind in self._kinds[:-1]] + [found]
        self._from, self._way = start, end - start

    def _of_kind(self, kind: PairKind, found: ipctk.Candidates, start: Values, end: Values) -> ipctk.Candidates:
        if isinstance(kind.samples, Centroids):
            return kind.samples.candidates(start, end, self._radius)
        return _taken(found, kind.name)

    def _holds(self, x: Values) -> bool:
        """Whether no pair within reach can be missing: points are near the way on which was looked."""
        off, squares = centred(x) - self._from, np.sum(self._way**2, axis=1)
        along = np.clip(np.sum(off * self._way, axis=1) / np.where(squares > 0, squares, 1.0), 0.0, 1.0)
        return max_length(off - along[:, None] * self._way) <= self._margin


def _taken(found: ipctk.Candidates, name: str) -> ipctk.Candidates:
    """The candidates of that name, which `found` loses."""
    part = ipctk.Candidates()
    setattr(part, name, getattr(found, name))
    setattr(found, name, [])
    return part


def centred(x: Values) -> Values:
    """x (n, d) about their mean."""
    result: Values = x - x.mean(axis=0)
    return result


def max_length(vectors: Values) -> float:
    """The greatest length of the rows."""
    return float(np.sqrt(np.max(np.sum(vectors**2, axis=1), initial=0.0)))


def intersecting_elements(mesh: ipctk.CollisionMesh, x: Values) -> Ints:
    """(k, 2) elements at x (n, d), m, of which neither is a neighbour of the other."""
    phase = ipctk.LBVH()
    phase.build(x, mesh.edges, mesh.faces, 0.0)
    return _of_triangles(phase, mesh, x) if x.shape[1] == 3 else _of_segments(phase, mesh, x)


def _of_segments(phase: ipctk.LBVH, mesh: ipctk.CollisionMesh, x: Values) -> Ints:
    near = _pairs([(each.edge0_id, each.edge1_id) for each in phase.detect_edge_edge_candidates()])
    (a, b), (c, d) = (x[mesh.edges[near[:, k]]].transpose(1, 0, 2) for k in range(2))
    return near[_part(a, b, c, d) & _part(c, d, a, b)]


def _part(a: Values, b: Values, c: Values, d: Values) -> Flags:
    """(k,) whether the line through a and b parts c from d, (k, 2) each."""
    (way_x, way_y), to = (b - a).T, [(each - a).T for each in (c, d)]
    side = [way_x * y - way_y * x for x, y in to]
    return np.asarray(side[0] * side[1] <= 0)


def _of_triangles(phase: ipctk.LBVH, mesh: ipctk.CollisionMesh, x: Values) -> Ints:
    near = _pairs([(each.edge_id, each.face_id) for each in phase.detect_edge_face_candidates()])
    near = near[_pierced(x[mesh.edges[near[:, 0]]], x[mesh.faces[near[:, 1]]])]
    which, triangle = _around(mesh.faces_to_edges, near[:, 0])
    return np.unique(np.sort(np.column_stack([triangle, near[which, 1]]), axis=1), axis=0)


def _around(edges: Ints, of: Ints) -> tuple[Ints, Ints]:
    """All triangles at the edges `of` (k,): (m,) which of the k, and (m,) the triangle; `edges` (triangles, 3)."""
    order = np.argsort(edges, axis=None, kind="stable")
    sorted_edges = edges.reshape(-1)[order]
    first, end = np.searchsorted(sorted_edges, of, "left"), np.searchsorted(sorted_edges, of, "right")
    which = np.repeat(np.arange(len(of)), count := end - first)
    at = np.arange(len(which)) + np.repeat(first - np.cumsum(count) + count, count)
    return which, order[at] // edges.shape[1]


def _pierced(ends: Values, corners: Values) -> Flags:
    """(k,) whether edges (k, 2, 3) go through triangles (k, 3, 3): their ends are on both sides, and the edge turns the
    same way about all three sides."""
    start, way = ends[:, 0], ends[:, 1] - ends[:, 0]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    above = [np.einsum("ij,ij->i", ends[:, k] - corners[:, 0], normal) for k in range(2)]
    turns = [
        np.einsum("ij,ij->i", way, np.cross(corners[:, k] - start, corners[:, (k + 1) % 3] - start)) for k in range(3)
    ]
    same = np.all(np.array(turns) >= 0, axis=0) | np.all(np.array(turns) <= 0, axis=0)
    return np.asarray((above[0] * above[1] <= 0) & (above[0] != above[1]) & same)


def _pairs(found: list[tuple[int, int]]) -> Ints:
    return np.array(found, np.int64).reshape(-1, 2)


class IpcPairs:
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
        made = [PairKind(share * distance, times * stiffness, name, of) for times, share, name, of in kinds]
        self._near = PairSearch(self._mesh, made, distance, MARGIN * distance)
        self._edge = ipctk.mean_edge_length(self._mesh.rest_positions, self._mesh.rest_positions, self._mesh.edges)[0]
        self._friction, self._distance = friction, distance
        self._area = vertex_areas(rest, elements)

    # --- the barrier ---

    def energy(self, x: Values) -> float:
        """E(x), J."""
        on = self._mesh.vertices(x)
        return sum(met.energy() for met in self._near.active_pairs(on))

    def gradient(self, x: Values) -> Values:
        """(n, d) dE/dx, N: the force on the points is its negative."""
        on = self._mesh.vertices(x)
        found = sum(met.gradient() for met in self._near.active_pairs(on))
        return np.asarray(self._mesh.to_full_dof(found)).reshape(x.shape)

    def hessian(self, x: Values, *, exact: bool = False) -> csr_matrix:
        """(n d, n d) d2E/dx2, N/m; unless `exact`, the share of each pair without its negative eigenvalues."""
        on, how = self._mesh.vertices(x), projection(exact=exact)
        found = sum(met.hessian(how) for met in self._near.active_pairs(on))
        return csr_matrix(self._mesh.to_full_dof(found))

    def set_stiffness(self, stiffness: float) -> None:
        """The barrier has this stiffness, Pa, from here on."""
        self._near.set_stiffness([times * stiffness for times in self._times])

    def clear_caches(self) -> None:
        """Forget which elements were near."""
        self._near.clear_caches()

    def min_gap(self, x: Values) -> float:
        """The least distance between elements on which the barrier acts, m; infinite where there is none."""
        return self._gap_at(self._mesh.vertices(x))

    def _gap_at(self, on: Values) -> float:
        return float(np.sqrt(min(met.least_squared_distance() for met in self._near.active_pairs(on))))

    def search_along(self, x: Values, to: Values) -> None:
        """Have candidates for all the way from x to `to` (n, d), m."""
        self._near.search_along(self._mesh.vertices(x), self._mesh.vertices(to))

    # --- friction ---

    def lag_friction(self, x: Values, start: Values, slip: float) -> IpcFriction:
        """Friction with the pressures and directions at x, as points move away from `start` (n, d), m.

        `slip`, m: from this sliding on it has its full size; a speed times the time step.
        """
        on = self._mesh.vertices(x)
        parts = []
        for met in self._near.active_pairs(on):
            part = ipctk.TangentialCollisions()
            part.build(met.kind.samples.mesh, met.positions, met.pairs, met.kind.barrier, self._friction)
            parts.append((met.kind.samples, part))
        return IpcFriction(self._mesh, parts, self._mesh.vertices(start), ipctk.FrictionPotential(slip))

    # --- collisions ---

    def free_fraction(self, x: Values, to: Values) -> float:
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
            share = self._near.free_fraction(on + piece / pieces * way, on + (piece + 1) / pieces * way)
            if share < 1.0:
                return (piece + share) / pieces
        return min(pieces, MOST) / pieces

    def _is_short(self, on: Values, way: Values) -> bool:
        """Whether a way (n, d) leaves KEPT of every gap however points go, as half of Newton's corrections do.

        A pair on which no barrier acts is no nearer than that of edges begins.
        """
        most = 2.0 * max_length(way) / (1.0 - KEPT)
        return most <= EDGES * self._distance and most <= self._gap_at(on)

    def _pieces(self, way: Values) -> int:
        """In how many pieces a way (n, d) is walked: so many that boxes around what moves have on average WIDE times
        the measure of one around an edge. A few fast points alone do not make ways shorter."""
        pieces = 1
        while pieces < 2**30 and np.mean(np.prod(1.0 + abs(way) / (pieces * self._edge), axis=1)) > WIDE:
            pieces *= 2
        return pieces

    def intersections(self, x: Values) -> Ints:
        """(k, 2) elements that cut each other."""
        on = self._mesh.vertices(x)
        return intersecting_elements(self._mesh, on) if ipctk.has_intersections(self._mesh, on, ipctk.LBVH()) else NONE

    def pressure(self, x: Values) -> Values:
        """(n,) the barrier's force on each point by its share of the reference surface, Pa; 0 where it has none."""
        force, area = np.linalg.norm(self.gradient(x), axis=1), self._area
        return np.asarray(np.divide(force, area, out=np.zeros_like(area), where=area > 0))


def vertex_areas(x: Values, elements: Ints) -> Values:
    """(n,) share of each point in the measure of the elements around it, m^2 (2D: m)."""
    measure, d = measures(x, elements), x.shape[1]
    return np.asarray(np.bincount(elements.reshape(-1), np.repeat(measure / d, d), minlength=len(x)), float)
