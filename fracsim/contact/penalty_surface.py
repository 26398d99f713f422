"""Elements of a surface on a rank, of its own cells and of others near them, with penalty contact.

The contact of a point, or of an edge with one that comes later in the order of the surface, belongs to the lowest rank
that has an element at the point or edge. Ranks decide alike where crack faces have no room: pressures are summed, and
arms are the shortest of all ranks.

Equations: docs/theory.md#explicit-contact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..mesh.ghost_exchange import KeyedReduction, KeyLookup
from .ipc_pairs import vertex_areas
from .ipc_surface import RetractableSurface, SelfContactLaw
from .mesh_obstacles import MeshObstacle
from .penalty_contacts import NO_POINT, ContactStiffness, ElementRanks, own_points
from .penalty_pairs import PenaltyPairs
from .pose import Pose
from .surface_exchange import ElementSet

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class PenaltyPart:
    """Contact of the surface of a body with itself, or with one obstacle.

    Its points are (n + m, d): those of the body, then those of the obstacle.

    Attributes:
        contact: penalty.
        friction: coefficient.
        keys: (n + m,) names of its points.
        max_stiffness: (n + m,) stiffness that a point may keep where the surface changes, N/m.
        body_points: (k,) points of the body's elements.
        reach: distance of bounding boxes from which on nothing is in contact, m.
        mesh: the obstacle; None: the body with itself.
    """

    contact: PenaltyPairs
    friction: float
    keys: Ints
    max_stiffness: Values
    body_points: Ints
    reach: float
    mesh: MeshObstacle | None = None

    @cached_property
    def lookup(self) -> KeyLookup:
        """Points of keys."""
        return KeyLookup(self.keys)

    def is_far(self, x: Values) -> bool:
        """Whether the obstacle is out of contact with the body at x (n, d), m, on this rank."""
        if self.mesh is None:
            return False
        return not len(self.body_points) or self.mesh.is_far(x[self.body_points], self.reach)

    def points(self, x: Values, pose: Pose | None = None) -> Values:
        """(n + m, d) points with the body at x (n, d), m, and the obstacle at a pose; None: the current one."""
        if self.mesh is None:
            return x
        return np.concatenate([x, self.mesh.positions if pose is None else self.mesh.positions_at(pose)])

    def gap(self, x: Values) -> float:
        """Least distance from an obstacle of points at x (n, d), m; beyond contact that of vertices."""
        if self.mesh is None or not len(self.body_points):
            return np.inf
        gap = np.inf if self.is_far(x) else self.contact.min_gap(self.points(x))
        return gap if gap < np.inf else max(self.mesh.vertex_distance(x[self.body_points]), self.reach)

    def cut_elements(self, x: Values, count: int) -> Ints:
        """(k,) elements of the body, below `count`, that others intersect with the body at x (n, d), m."""
        if self.is_far(x):
            return np.empty(0, np.int64)
        pairs = self.contact.intersections(self.points(x))
        if self.mesh is not None:
            pairs = pairs[(pairs < count).sum(axis=1) == 1]
        return np.unique(pairs[pairs < count])


class PenaltySurface(RetractableSurface):
    """Elements of this rank and of others near them, and their contacts.

    Attributes:
        element_set: points and elements.
        columns: global numbers of the nodes that the points follow.
        rest_positions: (n, d) of its points with full arms, m.
        parts: contact with itself, or with each obstacle.
    """

    closed_pressure: ClassVar[float] = 0.0  # a face that is pressed at all has no room

    def __init__(
        self,
        comm: MPI.Intracomm,
        element_set: ElementSet,
        law: SelfContactLaw,
        meshes: Sequence[MeshObstacle],
        edge: float,
        distance_reach: float,
    ) -> None:
        """Contacts of elements.

        Args:
            comm: ranks.
            element_set: points and elements.
            law: contact law.
            meshes: obstacles; none: the body touches itself.
            edge: mean length of edges of the mesh, m.
            distance_reach: distance of bounding boxes from which on nothing is in contact, m.
        """
        self.columns, point_map = element_set.point_map()
        super().__init__(element_set.elements.corners, point_map, law.stiffness)
        self.comm, self.element_set, self._law, self._meshes = comm, element_set, law, meshes
        self._edge, self._reach = edge, distance_reach
        self.rest_positions = element_set.points.middle + element_set.points.out
        self._owned_points = own_points(element_set.elements.rank, self.elements, len(self.rest_positions), comm.rank)
        self.parts = self._build_parts(np.arange(len(self.elements)))
        self._exclude(np.flatnonzero(element_set.elements.is_excluded))

    # --- contacts ---

    def _build_parts(self, elements: Ints) -> list[PenaltyPart]:
        """Contacts of elements (k,), without a history."""
        corners, rank = self.elements[elements], self.element_set.elements.rank[elements]
        k, keys, X = self.element_set.points.stiffness, self.element_set.points.keys, self.rest_positions
        distance, edge, body_points = self._law.distance, self._edge, np.unique(corners)
        if not self._meshes:
            ranks = None if self.comm.size == 1 else ElementRanks(rank, self.comm.rank, self._owned_points)
            stiffness = ContactStiffness.of_one_body(k)
            pairs = PenaltyPairs(X, corners, stiffness, distance=distance, ranks=ranks, edge=edge)
            return [PenaltyPart(pairs, self._law.friction, keys, k, body_points, self._reach)]
        pressure, count, parts = self._law.stiffness / self._law.distance, len(X), []
        area = self.element_set.points.area
        reduction = np.divide(k, 0.5 * pressure * area, out=np.ones(len(k)), where=area > 0)
        of_body = ContactStiffness(k, k, reduction)
        for mesh in self._meshes:
            area, size = vertex_areas(mesh.points, mesh.triangles), len(mesh.points)
            of_mesh = ContactStiffness(0.5 * pressure * area, np.full(size, np.inf), np.ones(size))
            triangles, ranks = mesh.triangles + count, None
            if self.comm.size > 1:
                of_triangles = triangle_ranks(mesh, self.comm.size)
                owned = own_points(of_triangles, mesh.triangles, size, self.comm.rank)
                all_ranks, all_owned = np.append(rank, of_triangles), np.append(self._owned_points, owned)
                ranks = ElementRanks(all_ranks, self.comm.rank, all_owned)
            pairs = PenaltyPairs(
                np.concatenate([X, mesh.points]), np.concatenate([corners, triangles]), of_body.followed_by(of_mesh),
                distance=distance, patch=np.repeat(np.array([0, 1], np.int32), [count, size]), ranks=ranks, edge=edge,
            )  # fmt: skip
            # keys of the body are not negative
            mesh_keys, limits = NO_POINT - 1 - np.arange(size), np.append(k, np.full(size, np.inf))
            parts.append(
                PenaltyPart(pairs, mesh.friction, np.append(keys, mesh_keys), limits, body_points, self._reach, mesh)
            )
        return parts

    def _exclude(self, elements: Ints) -> None:
        """Leave out these elements (k,) and no others."""
        if len(elements) or len(self._excluded):
            histories = [part.contact.history for part in self.parts]
            self.parts = self._build_parts(np.delete(np.arange(len(self.elements)), elements))
            for part, history in zip(self.parts, histories, strict=True):
                part.contact.set_history(history)
        self._excluded = elements

    def _include_all(self) -> None:
        self._exclude(np.empty(0, np.int64))

    def added_loads(self, x: Values) -> Values:
        """(columns, parts) bounds of what contacts of this rank add to M omega^2 of each node, N/m."""
        weights = self.point_map.weights
        loads = np.zeros((weights.shape[1], len(self.parts)))
        for part, load in zip(self.parts, loads.T, strict=True):
            if not part.is_far(x):
                contacts = part.contact.contacts_ahead(part.points(x))
                if len(contacts.gap):
                    load += contacts.added_load(weights)
        return loads

    def retract_faces(self, u: Values, keys: Ints, load: Values) -> None:
        """Retract crack faces under pressure at displacements u (columns, d), m (collective).

        `load`: (k,) pressures, Pa, of points with `keys` that may stay.
        """
        loads: Values = np.zeros(len(self.rest_positions))
        loads[KeyLookup(self.element_set.points.keys)(keys)] = load
        self._retract_faces(u, self._over_points(loads, np.maximum))

    def pressures(self, u: Values) -> Values:
        """(n,) pressure on each point at displacements u (columns, d), m; Pa (collective)."""
        return self._pressures(u)

    def set_release_interval(self, interval: tuple[int, int]) -> None:
        """Set the steps between two attempts to release faces, and to the next one."""
        self._release_interval = interval

    # --- what ranks agree on ---

    @cached_property
    def _over_points(self) -> KeyedReduction:
        return KeyedReduction(self.comm, self.element_set.points.keys)

    @cached_property
    def _over_elements(self) -> KeyedReduction:
        return KeyedReduction(self.comm, self.element_set.element_keys)

    def sum_at_points(self, vectors: Values) -> Values:
        """(n, d) sums of vectors at the points over all ranks (collective)."""
        return self._over_points(vectors, np.add)

    def _pressures(self, u: Values) -> Values:
        x, result = self.point_map(u), np.zeros(len(self.rest_positions))
        remaining = self._remaining()
        of_rank = remaining[self.element_set.elements.rank[remaining] == self.comm.rank]
        area = self._over_points(vertex_areas(self.rest_positions, self.elements[of_rank]), np.add)
        for part in self.parts:
            near = not part.is_far(x)
            gradient = part.contact.gradient(part.points(x))[: len(x)] if near else np.zeros_like(x)
            force = np.linalg.norm(self.sum_at_points(gradient), axis=1)
            result += np.divide(force, area, out=np.zeros_like(area), where=area > 0)
        return result

    def _intersecting_faces(self, u: Values) -> Ints:
        x, is_cut = self.point_map(u), np.zeros(len(self.elements), bool)
        remaining = self._remaining()
        for part in self.parts:
            is_cut[remaining[part.cut_elements(x, len(remaining))]] = True
        return np.intersect1d(self._crack_faces, np.flatnonzero(self._over_elements(is_cut, np.logical_or)))

    def _common_share(self, share: Values) -> Values:
        return self._over_points(share, np.minimum)

    def _common_flags(self, flags: Flags) -> Flags:
        return self._over_points(flags, np.logical_and)

    def _on_any_rank(self, flag: bool) -> bool:
        return bool(flag) if self.comm.size == 1 else bool(self.comm.allreduce(bool(flag), op=MPI.LOR))


def triangle_ranks(mesh: MeshObstacle, ranks: int) -> Ints:
    """(k,) rank that has each triangle of an obstacle: slabs of equally many along its longest axis."""
    centroids = mesh.points[mesh.triangles].mean(axis=1)
    axis = int(np.ptp(centroids, axis=0).argmax())
    result = np.empty(len(centroids), np.int64)
    result[np.argsort(centroids[:, axis], kind="stable")] = np.arange(len(centroids)) * ranks // len(centroids)
    return result
