"""Contact between the elements of one surface: barrier, lagged friction and collision detection of ipctk.

    E(x) = k int b(d(x)) dA,   b(d) = -D (s - 1)^2 ln s where s = (d / D)^2 < 1, 0 elsewhere   (m)

d is the distance from a point of the surface to the rest of it, D the distance at which the barrier begins, k the
stiffness in Pa. The integral is the mean of both sides, with one sample point an element, its centroid
(sample_points), weighted with the reference area (2D: length, all per m of thickness). The "improved max" set of
ipctk (Li et al. 2023, Convergent IPC) counts elements near the same point once, and keeps E continuously
differentiable. Vertices, and edges against edges in 3D, have barriers of their own, which begin nearer. Elements that
share a point do not touch each other.

The caller maps nodes to points of the surface and forces back: x = W u and W^T f; ipctk's displacement map is unused.

Ranks share the pairs of a surface (PairShare): energies, gradients and second derivatives are those of a rank's own
pairs, and their sums over the ranks are the totals.

Equations: docs/theory.md#barrier, docs/theory.md#friction.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import ipctk
import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from scipy.sparse import csr_matrix

from ..array_types import Flags, Ints, Values
from ..mesh.parallel import sum_over_ranks
from .laws import BARRIER
from .pair_search import (
    PairFilter,
    PairSearch,
    SimplexPairs,
    free_fractions,
    intersecting_pairs,
    pair_distances,
)
from .sample_points import IpcFriction, SamplePoints, projection


@dataclass(frozen=True)
class PairPolicy:
    """Tuned numbers of pairs and of collision detection.

    Attributes:
        vertex_distance: distance at which the barrier of vertices begins, in D, and its stiffness in that of
            centroids. At D / 2 the pressure of centroids is 4.3 k; vertices add 2.6 k.
        edge_distance: the same of edges against edges. From D on, the pressure would depend on how the meshes of two
            flat faces cross, by a factor of 1.6 to 2.8.
        search_margin: motion of points, in D, after which candidates are searched again.
        max_pieces: pieces of one motion, so that bounding boxes of long motions do not all overlap.
        max_box_growth: mean measure of the bounding boxes of a piece, in that of one around an edge.
        max_ccd_rounds: evaluations of the distance of a pair in collision detection.
        distance_tolerance: relative tolerance of distances of pairs on which a barrier may act.
    """

    vertex_distance: float = 0.8
    edge_distance: float = 0.5
    search_margin: float = 0.5
    max_pieces: int = 128
    max_box_growth: float = 3.0
    max_ccd_rounds: int = 100
    distance_tolerance: float = 1e-6


PAIRS = PairPolicy()


@dataclass(frozen=True)
class PairShare:
    """Part of the pairs of a surface that belongs to this rank: those whose lowest point is one of its own.

    The centroid of an element counts as the lowest point of the element. To have these pairs with their weights, a rank
    searches all candidates that have one of its points. The weights of ipctk's "improved max" set depend on all
    candidates between the points of a pair, and on no others.

    Points have the same order on all ranks. The rank has all elements at its own points, and all that may come near
    these.

    Attributes:
        comm: ranks that share the pairs.
        points: (n,) flags of the points of this rank; each point belongs to one rank.
        counted: (n,) flags of the points that count on this rank in means over all points.
    """

    comm: MPI.Intracomm
    points: Flags
    counted: Flags

    @classmethod
    def of(cls, comm: MPI.Intracomm, points: Flags) -> PairShare:
        """Share of a rank with its own points (n,)."""
        return cls(comm, points, points)

    def with_others(self, count: int) -> PairShare:
        """The share of a surface with `count` more points, on all ranks, in pairs with the first ones alone."""
        none, on_root = np.zeros(count, bool), np.full(count, self.comm.rank == 0)
        return PairShare(self.comm, np.append(self.points, none), np.append(self.counted, on_root))


class OwnPairs:
    """Pairs of this rank among the pairs of sample points, edges and triangles."""

    def __init__(self, samples: SamplePoints, vertices: Flags) -> None:
        """`vertices`: (n,) flags of those of this rank."""
        mesh, low = samples.mesh, samples.lowest_vertices
        faces = np.asarray(mesh.faces).reshape(-1, 3)
        self._flags, self._point = vertices, low
        self._edge, self._face = mesh.edges.min(axis=1), faces.min(axis=1, initial=len(low))

    def select(self, pairs: ipctk.NormalCollisions) -> None:
        """Remove the pairs of other ranks."""
        flags, point, edge, face = self._flags, self._point, self._edge, self._face
        pairs.vv_collisions = [p for p in pairs.vv_collisions if flags[min(point[p.vertex0_id], point[p.vertex1_id])]]
        pairs.ev_collisions = [p for p in pairs.ev_collisions if flags[min(edge[p.edge_id], point[p.vertex_id])]]
        pairs.ee_collisions = [p for p in pairs.ee_collisions if flags[min(edge[p.edge0_id], edge[p.edge1_id])]]
        pairs.fv_collisions = [p for p in pairs.fv_collisions if flags[min(face[p.face_id], point[p.vertex_id])]]


@dataclass(frozen=True)
class PairKind:
    """Barrier between sample points, or edges, and elements.

    Attributes:
        simplices: pairs that are searched, and the distance at which the barrier begins.
        stiffness: Pa.
    """

    simplices: SimplexPairs
    stiffness: float

    @cached_property
    def barrier(self) -> ipctk.BarrierPotential:
        """Barrier of ipctk."""
        return ipctk.BarrierPotential(self.simplices.distance, self.stiffness, True)

    def candidates(self, pairs: Ints, x: Values) -> ipctk.Candidates:
        """Candidates of ipctk among pairs (k, 2) of simplices with vertices at x (n, d), m.

        ipctk finds the pairs on which the barrier acts among those within its distance alone.
        """
        limit = (1.0 + PAIRS.distance_tolerance) * self.simplices.distance
        pairs = pairs[pair_distances(self.simplices, pairs, x) < limit]
        # centroids are the sample points behind the vertices
        before = len(x) if self.simplices.centroids else 0
        columns, result = (before + pairs[:, 0], pairs[:, 1]), ipctk.Candidates()
        first, second = (list[int](column) for column in columns)
        if self.simplices.is_one_set:
            result.ee_candidates = list(map(ipctk.EdgeEdgeCandidate, first, second))
        elif self.simplices.second.shape[1] == 3:
            result.fv_candidates = list(map(ipctk.FaceVertexCandidate, second, first))
        else:
            result.ev_candidates = list(map(ipctk.EdgeVertexCandidate, second, first))
        return result


@dataclass(frozen=True)
class ActivePairs:
    """Pairs on which barriers act.

    Attributes:
        vertices: (n, d) m.
        positions: (p, d) sample points, m.
        of_kinds: each kind with any, and ipctk's pairs.
    """

    vertices: Values
    positions: Values
    of_kinds: Sequence[tuple[PairKind, ipctk.NormalCollisions]]


# --- collision mesh ---


def collision_mesh(rest_positions: Values, elements: Ints) -> ipctk.CollisionMesh:
    """Surface of ipctk: the points of elements (m, d) alone, at `rest_positions` (n, d), m."""
    # one thread a rank, and sums in the same order each time
    ipctk.set_num_threads(1)
    corners, is_3d = elements.astype(np.int32), rest_positions.shape[1] == 3
    edges = ipctk.edges(corners) if is_3d and len(corners) else corners.reshape(-1, 2)
    return ipctk.CollisionMesh.build_from_full_mesh(rest_positions, edges, *((corners,) if is_3d else ()))


class IpcPairs:
    """Barrier and lagged Coulomb friction between the elements of a surface; x is always (n, d), m.

    Attributes:
        comm: ranks that share the pairs.
    """

    def __init__(
        self,
        rest_positions: Values,
        elements: Ints,
        *,
        distance: float,
        stiffness: float,
        friction: float = 0.0,
        share: PairShare | None = None,
        patch: npt.NDArray[np.int32] | None = None,
        edge: float | Values | None = None,
    ) -> None:
        """Pairs of a surface; points of no element are ignored.

        Args:
            rest_positions: (n, d) reference positions, m.
            elements: (m, d) points of segments or triangles.
            distance: D, m.
            stiffness: k, Pa.
            friction: coefficient of friction.
            share: of this rank in the pairs; None: all of them.
            patch: (n,) numbers of parts of the surface that touch others alone; None: all touch.
            edge: length of edges, m, or that of edges around each point (n,); None: the mean of these elements.
        """
        self._elements, is_3d = elements, rest_positions.shape[1] == 3
        self._mesh = collision_mesh(rest_positions, elements)
        mesh = self._mesh
        points, surface_edges = np.arange(mesh.num_vertices)[:, None], np.ascontiguousarray(mesh.edges, np.int32)
        surface = np.ascontiguousarray(mesh.faces, np.int32) if is_3d else surface_edges
        sets = [
            SimplexPairs.of(surface, surface, distance, centroids=True),
            SimplexPairs.of(points, surface, PAIRS.vertex_distance * distance),
        ]
        if is_3d:
            sets.append(SimplexPairs.of(surface_edges, surface_edges, PAIRS.edge_distance * distance))
        # in 3D ipctk weights points as half of all pairs of a triangle, and edges as the other half
        self._weights = [2.0, 2.0, 1.0] if is_3d else [1.0, 1.0]
        self.comm = MPI.COMM_SELF if share is None else share.comm
        # numbers of the vertices of ipctk's surface among the points, ascending
        self._points = used = np.unique(elements)
        self._samples = SamplePoints(mesh, used, len(rest_positions))
        vertices = None if share is None or share.comm.size == 1 else share.points[used]
        if vertices is not None:
            # two points of other ranks have the same number and do not touch
            number = np.where(vertices, 1 + np.arange(len(vertices)), 0).astype(np.int32)
            mesh.can_collide = ipctk.make_vertex_patches_filter(number)
        if patch is not None:
            patch = np.ascontiguousarray(patch[used])
            of_patches = ipctk.make_vertex_patches_filter(patch)
            mesh.can_collide = of_patches if vertices is None else of_patches & mesh.can_collide
        where = PairFilter.of(mesh.num_vertices, patch, vertices)
        self._search = PairSearch(where, sets, PAIRS.search_margin * distance)
        self._kinds = [PairKind(pairs, weight * stiffness) for pairs, weight in zip(sets, self._weights, strict=True)]
        self._own_pairs = None if vertices is None else OwnPairs(self._samples, vertices)
        self._active: ActivePairs | None = None  # of the last vertices
        X = self._mesh.rest_positions
        edge = float(ipctk.mean_edge_length(X, X, self._mesh.edges)[0]) if edge is None else edge
        self._edges = np.broadcast_to(edge, len(rest_positions))[used]
        self._counted = np.ones(len(used), bool) if share is None else share.counted[used]
        self._friction = friction

    @property
    def collision_mesh(self) -> ipctk.CollisionMesh:
        """Surface of ipctk: the points of elements alone."""
        return self._mesh

    # --- candidates and active pairs ---

    def _active_pairs(self, x: Values) -> ActivePairs:
        """Pairs on which barriers act; those of the last positions are kept."""
        vertices = x[self._points]
        if self._active is None or not np.array_equal(vertices, self._active.vertices):
            items = zip(self._kinds, self._search.pairs(vertices), strict=True)
            near = [(kind, pairs) for kind, pairs in items if len(pairs)]
            # sample points are placed only where pairs are near
            positions = self._samples.positions(x) if near else vertices
            active = [(kind, self._pairs_in_contact(kind, pairs, vertices, positions)) for kind, pairs in near]
            self._active = ActivePairs(vertices.copy(), positions, [entry for entry in active if len(entry[1])])
        return self._active

    def _pairs_in_contact(
        self, kind: PairKind, near: Ints, vertices: Values, positions: Values
    ) -> ipctk.NormalCollisions:
        """Pairs on which the barrier of a kind acts among near ones (k, 2), with sample points at `positions`, m."""
        pairs, simplices = ipctk.NormalCollisions(), kind.simplices
        pairs.use_area_weighting = True
        pairs.collision_set_type = ipctk.NormalCollisions.IMPROVED_MAX_APPROX
        pairs.build(kind.candidates(near, vertices), self._samples.mesh, positions, simplices.distance)
        if self._own_pairs is not None:
            self._own_pairs.select(pairs)
        if simplices.centroids:
            self._samples.weight_centroids(pairs)
        return pairs

    # --- barrier ---

    def energy(self, x: Values) -> float:
        """Energy E(x) of this rank's pairs, J."""
        active, samples = self._active_pairs(x), self._samples
        energies = (kind.barrier(pairs, samples.mesh, active.positions) for kind, pairs in active.of_kinds)
        return sum(map(float, energies), 0.0)

    def gradient(self, x: Values) -> Values:
        """(n, d) dE/dx of this rank's pairs, N: minus the forces on the points."""
        active, samples = self._active_pairs(x), self._samples
        gradients = [kind.barrier.gradient(pairs, samples.mesh, active.positions) for kind, pairs in active.of_kinds]
        return samples.gradient(gradients)

    def hessian(self, x: Values, *, exact: bool = False) -> csr_matrix:
        """(n d, n d) d2E/dx2 of this rank's pairs, N/m; unless `exact`, each without its negative eigenvalues."""
        active, samples, method = self._active_pairs(x), self._samples, projection(exact=exact)
        hessians = [
            kind.barrier.hessian(pairs, samples.mesh, active.positions, method) for kind, pairs in active.of_kinds
        ]
        return samples.hessian(hessians)

    def set_stiffness(self, stiffness: float) -> None:
        """Set the stiffness k, Pa."""
        items = zip(self._kinds, self._weights, strict=True)
        self._kinds = [replace(kind, stiffness=weight * stiffness) for kind, weight in items]
        self._active = None

    def clear_caches(self) -> None:
        """Discard the candidates of collision detection."""
        self._search.clear_caches()
        self._active = None

    def min_gap(self, x: Values) -> float:
        """Least distance of this rank's pairs on which the barrier acts, m; infinite where there is none."""
        active, samples = self._active_pairs(x), self._samples
        squares = (pairs.compute_minimum_distance(samples.mesh, active.positions) for _, pairs in active.of_kinds)
        return float(np.sqrt(min(squares, default=np.inf)))

    # --- friction ---

    def lag_friction(self, x: Values, start: Values, slip: float) -> IpcFriction:
        """Friction of this rank's pairs with pressures and tangents at x.

        Args:
            x: (n, d) positions at which friction is lagged, m.
            start: (n, d) positions from which slip is measured, m.
            slip: from which on friction has its full size, m: a speed times the time step.
        """
        active, parts = self._active_pairs(x), []
        for kind, pairs in active.of_kinds:
            part = ipctk.TangentialCollisions()
            part.build(self._samples.mesh, active.positions, pairs, kind.barrier, self._friction)
            parts.append(part)
        return IpcFriction(self._samples, parts, start, ipctk.FrictionPotential(slip))

    # --- collisions ---

    def free_fraction(self, x: Values, end: Values) -> float:
        """Fraction in (0, 1] of the straight motion from x to `end` without a collision on any rank (collective).

        The motion is divided into pieces. A pair that would collide keeps at least `BARRIER.min_gap_ratio` of its
        distance at the begin of the piece.
        """
        vertices, motion = x[self._points], end[self._points] - x[self._points]
        total = self._sum(np.column_stack([motion, np.ones(len(motion))]))
        motion -= total[:-1] / max(total[-1], 1.0)  # the mean motion brings nothing together
        pieces = self._piece_count(motion)
        return float(self.comm.allreduce(self._own_free_fraction(vertices, motion, pieces), op=MPI.MIN))

    def _sum(self, values: Values) -> Values:
        """(k,) sum over all points of values (n, k) (collective)."""
        return sum_over_ranks(self.comm, values[self._counted].sum(axis=0))

    def _own_free_fraction(self, vertices: Values, motion: Values, pieces: int) -> float:
        """Fraction of a motion (n, d), in pieces, without a collision of this rank's pairs."""
        for piece in range(min(pieces, PAIRS.max_pieces)):
            start, stop = piece / pieces, (piece + 1) / pieces
            fraction = self._piece_fraction(vertices + start * motion, vertices + stop * motion)
            if fraction < 1.0:
                return (piece + fraction) / pieces
        return min(pieces, PAIRS.max_pieces) / pieces

    def _piece_fraction(self, x: Values, end: Values) -> float:
        """Fraction in (0, 1] of the motion from x to `end` that leaves `BARRIER.min_gap_ratio` of each gap."""
        fractions = (
            free_fractions(kind.simplices, near, x, end, BARRIER.min_gap_ratio, PAIRS.max_ccd_rounds)
            for kind, near in zip(self._kinds, self._search.pairs_along(x, end), strict=True)
            if not kind.simplices.centroids
        )
        return min(float(of_kind.min(initial=1.0)) for of_kind in fractions)

    def _piece_count(self, motion: Values) -> int:
        """Number of pieces in which a motion (n, d) is searched (collective).

        The bounding boxes of a piece have on average at most `max_box_growth` times the measure of one around an
        edge. A few fast points alone do not make pieces shorter.
        """
        pieces, (edges, count) = 1, self._sum(np.column_stack([self._edges, np.ones(len(motion))]))
        edge = edges / max(count, 1.0)
        while pieces < 2**30:
            growth = self._sum(np.prod(1.0 + abs(motion) / (pieces * edge), axis=1)[:, None])
            if not growth > PAIRS.max_box_growth * count:
                break
            pieces *= 2
        return pieces

    def intersections(self, x: Values) -> Ints:
        """(k, 2) elements that intersect, of which one has a point of this rank."""
        return intersecting_pairs(self._kinds[0].simplices.second, self._search.filter, x[self._points])
