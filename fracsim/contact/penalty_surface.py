"""Elements of a surface on a rank, of its own cells and of others near them, with penalty contact.

Each rank marks the cubes of a grid that its elements overlap, grown by a distance. It sends the marks to ranks whose
bounding boxes they overlap. These send the elements that overlap a marked cube, with their points. So two elements
within the distance are on a common rank, and a rank has all elements at the points of its own elements. Names are keys
(topology.row_keys); the order is that of the input mesh.

The contact of a point, or of an edge with one that comes later in the order of the surface, belongs to the lowest rank
that has an element at the point or edge. Ranks decide alike where crack faces have no room: pressures are summed, and
arms are the shortest of all ranks.

Equations: docs/theory.md#explicit-contact.

Source: S. Plimpton and others (1998), Parallel transient dynamics simulations: algorithms for contact detection and
smoothed particle hydrodynamics, Journal of Parallel and Distributed Computing 50, 104-122.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from itertools import product
from typing import ClassVar

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from scipy.sparse import csr_matrix, vstack

from ..mesh.ghost_exchange import KeyedReduction, KeyLookup
from ..mesh.parallel import allgather, alltoall
from ..mesh.split_surface.local_surface import restrict_to_used_columns
from ..mesh.split_surface.surface_map import SurfaceMap
from ..meshes.topology import row_keys
from .ipc_pairs import vertex_areas
from .ipc_surface import RetractableSurface, SelfContactLaw
from .mesh_obstacles import MeshObstacle
from .penalty_contacts import NO_POINT, ContactStiffness, ElementRanks, own_points
from .penalty_pairs import PenaltyPairs
from .pose import Pose

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


# --- elements, and their exchange ---


@dataclass(frozen=True)
class ExchangePolicy:
    """Tuned numbers of the exchange.

    Attributes:
        margin: motion, in mean edges of the mesh, after which elements are exchanged again.
        cube: side of a cube in mean sizes of elements.
        max_cubes: cubes along the largest element at most.
        bits: bits of the number of a cube along an axis.
    """

    margin: float = 0.5
    cube: float = 2.0
    max_cubes: int = 4
    bits: int = 20


EXCHANGE = ExchangePolicy()


@dataclass(frozen=True)
class PointRows:
    """Points of a part of a surface, row by row.

    Attributes:
        keys: (n,) names.
        lead: (n,) lowest node that each follows, in the input mesh.
        middle, out: (n, d) mean reference position of its nodes, and arm from there, m.
        mean, arms: (n, nodes of the mesh) weights of a SurfaceMap.
        share: (n,) factors of the arms.
        area: (n,) m^2, of the elements of all ranks.
        stiffness: (n,) k_p, N/m.
    """

    keys: Ints
    lead: Ints
    middle: Values
    out: Values
    mean: csr_matrix
    arms: csr_matrix
    share: Values
    area: Values
    stiffness: Values


@dataclass(frozen=True)
class ElementRows:
    """Elements of a part of a surface, row by row.

    Attributes:
        corners: (m, d) rows of points.
        rank: (m,) rank of the cell.
        is_excluded: (m,) whether there is no room for the element, so that it has no contact.
    """

    corners: Ints
    rank: Ints
    is_excluded: Flags


@dataclass(frozen=True)
class ElementSet:
    """Part of a surface.

    Attributes:
        points: its points.
        elements: its elements.
    """

    points: PointRows
    elements: ElementRows

    @property
    def element_keys(self) -> Ints:
        """(m,) names of the elements."""
        return row_keys(np.sort(self.points.keys[self.elements.corners], axis=1))

    def select(self, elements: Ints) -> ElementSet:
        """Some of the elements (k,), with their points."""
        chosen = _take(self.elements, elements)
        rows, corners = np.unique(chosen.corners, return_inverse=True)
        return ElementSet(_take(self.points, rows), replace(chosen, corners=corners.reshape(chosen.corners.shape)))

    def ordered(self) -> ElementSet:
        """Points by their lowest nodes and keys, and elements by their first points and keys."""
        points = self.points
        order = np.lexsort((points.keys, points.lead))
        row = np.empty(len(order), np.int64)
        row[order] = np.arange(len(order))
        corners = row[self.elements.corners]
        # the lowest corner first, so that nothing depends on the cell's numbering on its rank
        d = corners.shape[1]
        turned = (corners.argmin(axis=1)[:, None] + np.arange(d)) % d if d == 3 else np.arange(d)[None]
        corners = np.take_along_axis(corners, np.broadcast_to(turned, corners.shape), axis=1)
        by_corner = np.lexsort((self.element_keys, corners.min(axis=1, initial=len(row))))
        elements = _take(replace(self.elements, corners=corners), by_corner)
        return ElementSet(_take(points, order), elements)

    def point_map(self) -> tuple[Ints, SurfaceMap]:
        """Global numbers of the nodes that the points follow, and the map from these to the points."""
        points = self.points
        columns, (mean, arms) = restrict_to_used_columns([points.mean, points.arms])
        return columns, SurfaceMap(mean, points.middle, arms, points.out, points.share)


def _take[Rows: (PointRows, ElementRows)](rows: Rows, numbers: Ints) -> Rows:
    """Some of the rows."""
    return type(rows)(**{field.name: getattr(rows, field.name)[numbers] for field in fields(rows)})


def join_element_sets(sets: Sequence[ElementSet]) -> ElementSet:
    """Union of parts of a surface whose elements differ, in its order."""
    arrays = {}
    for field in fields(PointRows):
        columns = [getattr(element_set.points, field.name) for element_set in sets]
        is_sparse = isinstance(columns[0], csr_matrix)
        arrays[field.name] = vstack(columns, format="csr") if is_sparse else np.concatenate(columns)
    points = PointRows(**arrays)
    _, first, number = np.unique(points.keys, return_index=True, return_inverse=True)
    starts = np.cumsum([0, *(len(element_set.points.keys) for element_set in sets)])
    corners = [number[rows.elements.corners + start] for rows, start in zip(sets, starts, strict=False)]
    elements = ElementRows(
        np.concatenate(corners),
        np.concatenate([element_set.elements.rank for element_set in sets]),
        np.concatenate([element_set.elements.is_excluded for element_set in sets]),
    )
    return ElementSet(_take(points, first), elements).ordered()


def exchange_elements(
    comm: MPI.Intracomm, element_set: ElementSet, boxes: Values, searched: Values, reach: float
) -> ElementSet:
    """Elements of a rank and those of other ranks within `reach`, m, of boxes, in the order of a surface (collective).

    Args:
        comm: ranks.
        element_set: elements of this rank.
        boxes: (m, 2, d) lower and upper corners of their bounding boxes, m.
        searched: (k, 2, d) boxes near which elements of other ranks are wanted, m.
        reach: m.
    """
    if comm.size == 1:
        return element_set
    grown = searched + reach * np.array([[-1.0], [1.0]])
    origin, side = _grid(comm, boxes, grown)
    element, cube = _overlapped_cubes(boxes, origin, side)
    _, wanted = _overlapped_cubes(grown, origin, side)
    limits = allgather(comm, (_bounds(boxes), _bounds(grown)))
    # a rank asks those ranks alone whose elements may be near
    none: Ints = np.empty(0, np.int64)
    asks = [
        rank != comm.rank and bool(np.all(_bounds(grown)[0] <= high) and np.all(low <= _bounds(grown)[1]))
        for rank, ((low, high), _) in enumerate(limits)
    ]
    wanted = np.unique(wanted)
    requests = alltoall(comm, [wanted if ask else none for ask in asks])
    sent: list[ElementSet | None] = [None] * comm.size
    for rank, cubes in enumerate(requests):
        if len(cubes) and len(near := np.unique(element[np.isin(cube, cubes)])):
            sent[rank] = element_set.select(near)
    arrived = [rows for rows in alltoall(comm, sent) if rows is not None]
    return join_element_sets([element_set, *arrived])


def _bounds(boxes: Values) -> Values:
    """(2, d) bounding box of boxes (k, 2, d)."""
    return np.stack([boxes[:, 0].min(axis=0, initial=np.inf), boxes[:, 1].max(axis=0, initial=-np.inf)])


def _grid(comm: MPI.Intracomm, boxes: Values, grown: Values) -> tuple[Values, float]:
    """(d,) lowest corner of all boxes, m, and the side of the cubes, m (collective)."""
    size = (boxes[:, 1] - boxes[:, 0]).max(axis=1, initial=0.0)
    sums = np.array([size.sum(), len(size)])
    comm.Allreduce(MPI.IN_PLACE, sums, MPI.SUM)
    extremes = np.append(_bounds(np.concatenate([boxes, grown]))[0], -size.max(initial=0.0))
    comm.Allreduce(MPI.IN_PLACE, extremes, MPI.MIN)
    mean = sums[0] / max(sums[1], 1.0)
    return extremes[:-1], float(max(EXCHANGE.cube * mean, -extremes[-1] / EXCHANGE.max_cubes))


def _overlapped_cubes(boxes: Values, origin: Values, side: float) -> tuple[Ints, Ints]:
    """(k,) boxes, and (k,) the numbers of the cubes that each overlaps."""
    low, high = (np.floor((boxes[:, end] - origin) / side).astype(np.int64) for end in range(2))
    rows, cubes, span = [], [], high - low
    for offset in product(*(range(int(largest) + 1) for largest in span.max(axis=0, initial=0))):
        overlap = np.flatnonzero((span >= np.array(offset)).all(axis=1))
        # beyond the bits, in a body that has flown apart, far cubes share a number: more is sent than needed
        position = (low[overlap] + np.array(offset)) & ((1 << EXCHANGE.bits) - 1)
        number = position[:, 0]
        for axis in range(1, boxes.shape[2]):
            number = (number << EXCHANGE.bits) | position[:, axis]
        rows.append(overlap)
        cubes.append(number)
    return np.concatenate(rows), np.concatenate(cubes)


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
                of_triangles = mesh.triangle_ranks(self.comm.size)
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

    def pressures(self, u: Values) -> Values:
        """(n,) pressure on each point at displacements u (columns, d), m; Pa (collective)."""
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
