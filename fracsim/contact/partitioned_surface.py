"""Surface of a body with penalty contact, distributed over the ranks: no rank has all of it.

Elements of other ranks are exchanged again before anything can be missing: any two points have come nearer by at most
the diagonal of the bounding box of the motions of all points.

Equations: docs/theory.md#explicit-contact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI
from scipy.sparse import csr_matrix

from ..mechanics.term_protocols import CutPositions
from ..mesh.domain import Domain
from ..mesh.fragments import find_components
from ..mesh.ghost_exchange import KeyedReduction, KeyLookup, min_over_ranks, sum_at_nodes
from ..mesh.parallel import allgather, gather, max_over_ranks, on_root
from ..mesh.simplices import is_split
from ..mesh.split_surface.closed_surface import SplitSurface, build_split_surface
from ..mesh.split_surface.drawn_surface import DrawnSurface
from ..mesh.split_surface.entity_numbering import EntityNumbering
from ..mesh.split_surface.fragment_surface import (
    PlanarPoints,
    build_surface_of_open_edges,
    moves_alike,
    project_onto_fragments,
)
from ..mesh.split_surface.local_surface import (
    NodeExchange,
    contact_elements,
    local_map_parts,
    local_mesh,
)
from ..mesh.split_surface.quadratic_surface import subdivided_local_mesh
from ..mesh.split_surface.surface_map import SurfaceMap
from ..mesh.split_surface.surface_motion import PointParents
from ..meshes.topology import boundary_facets
from .clearance import FollowingPoints
from .ipc_pairs import vertex_areas
from .ipc_surface import SURFACE, SelfContactLaw, offset_crack_faces, refuse_intersections
from .mesh_obstacles import MeshObstacle
from .penalty_contacts import NodalMassShare, PenaltyHistory
from .penalty_point_facet import POINT_FACET, penalty_stiffness
from .penalty_surface import (
    EXCHANGE,
    ElementRows,
    ElementSet,
    PenaltySurface,
    PointRows,
    exchange_elements,
)
from .triangle_mesh_shape import refuse_overlap

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
Pattern = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class SurfaceState:
    """What changes of a surface between breaks.

    Attributes:
        surface_count: number of surfaces until then.
        version: number of changes of arms and of left-out elements until then.
        share: (n,) factors of the arms of this rank's points.
        is_excluded: (m,) flags of this rank's elements.
        interval: steps between two attempts to release faces, and steps to the next one.
    """

    surface_count: int
    version: int
    share: Values
    is_excluded: Flags
    interval: tuple[int, int]


class PartitionedSurface:
    """Contact surface of a body, built again when edges break (HistoryTerm, CutFaces, SurfaceSeparator).

    Attributes:
        law: contact law.
        current: elements of this rank and of others near them.
        element_set: those of this rank, with their factors and flags at the last exchange.
        surface_count: number of surfaces until now.
        exchange_count: number of exchanges of elements until now: points have new numbers after each.
        has_retracted: whether any face on any rank is retracted or left out.
    """

    current: PenaltySurface
    element_set: ElementSet
    _cuts: CutPositions | None = None
    # pattern, open edges and loose nodes of the current surface, in contact between fragments
    _open: tuple[Pattern, Flags, Flags] | None = None
    _restored: SurfaceState | None = None
    # values at the nodes of all points, and of this rank's points
    _nodes: NodeExchange | None = None
    _own_nodes: NodeExchange | None = None

    def __init__(
        self,
        domain: Domain,
        u: fem.Function,
        law: SelfContactLaw,
        mass: Values,
        max_added: float,
        meshes: Sequence[MeshObstacle] = (),
    ) -> None:
        """Build the surface (collective).

        Args:
            domain: mesh.
            u: displacement.
            law: contact law.
            mass: (owned dofs,) lumped, kg.
            max_added: increase of the square of the highest frequency that contact may cause, 1/s^2.
            meshes: obstacles; none: the body touches itself.

        Raises:
            InputError: if the surface at rest intersects itself, or an obstacle.
        """
        self.law, self._domain, self._u, self._meshes = law, domain, u, meshes
        self._mass, self._max_added = mass, max_added
        self._comm, self._owned = domain.comm, domain.node_count * domain.dim
        is_refined = domain.order == 2 and not law.corners_only
        # subdivided quadratic cells do not break
        self._cell_parts = 2**domain.dim if is_refined else 1
        self._topology = EntityNumbering(subdivided_local_mesh(domain) if is_refined else local_mesh(domain))
        self._is_shared = sum_at_nodes(domain, np.arange(len(domain.nodes)), np.ones((len(domain.nodes), 1)))[:, 0] > 1
        self._pattern: Pattern = np.zeros(domain.cell_count, np.uint8)
        self._reach = POINT_FACET.clearance_gap * law.distance
        self._margin = EXCHANGE.margin * domain.mean_edge_length
        # before obstacles alone crack faces are not offset from one another
        self._face_gap = 0.0 if meshes else SURFACE.face_gap * law.distance
        self.surface_count = self.exchange_count = self._version = 0
        self.has_retracted = False
        self._build_own_elements()
        self._exchange(self._current_u)
        self._refuse_contact()

    @property
    def _current_u(self) -> Values:
        """(owned dofs,) current displacement, m."""
        return np.asarray(self._u.x.array[: self._owned])

    # --- elements of this rank ---

    def edges_broke(self, pattern: Pattern) -> None:
        """Add new crack faces, retracted where there is no room (collective)."""
        u, self._pattern = self._current_u, pattern
        self.refresh(u)
        previous = self.current
        if not self._build_own_elements():
            return
        pressure = previous.pressures(self.nodal_values(u))
        # new points have full arms and no pressure that they may keep
        rows = KeyLookup(previous.element_set.points.keys)(self.element_set.points.keys)
        states = np.column_stack([-previous.point_map.share, pressure])
        states = self._over_border(np.where((rows >= 0)[:, None], states[rows], [-1.0, 0.0]), np.maximum)
        self.element_set = replace(self.element_set, points=replace(self.element_set.points, share=-states[:, 0]))
        self.surface_count += 1
        self._exchange(u)
        self.set_history([part.contact.history.by_keys(part.keys) for part in previous.parts])
        self.current.retract_faces(self.nodal_values(u), self.element_set.points.keys, states[:, 1])
        self._faces_changed()

    def _build_own_elements(self) -> bool:
        """Build the elements of this rank for the current damage; whether the surface is another one (collective)."""
        domain, numbers = self._domain, self._domain.input_numbering.nodes
        if (split := self._split_surface()) is None:
            return False
        elements, _ = contact_elements(split, self._topology)
        points, corners = np.unique(elements, return_inverse=True)
        assert split.numbering is not None
        keys, start, parents = split.numbering.keys(numbers)[points], split.parents.start, split.parents.parents
        border = np.flatnonzero(np.logical_and.reduceat(self._is_shared[parents], start[:-1])[points])
        reduction = KeyedReduction(self._comm, keys[border])

        def least_cosine(cosine: Values) -> Values:
            cosine[points[border]] = reduction(cosine[points[border]], np.minimum)
            return cosine

        positions = offset_crack_faces(split, self._face_gap, least_cosine)
        follow = PointParents.from_positions(parents, np.diff(start), positions, self._topology.points)
        offset = replace(split, points=positions, parents=follow)
        mean, middle, arms, out = local_map_parts(domain, offset, points, ~is_split(domain.dim)[self._pattern])
        lead, full = np.minimum.reduceat(numbers[parents], start[:-1])[points], np.ones(len(points))
        rows = PointRows(keys, lead, middle, out, mean, arms, full, area=0 * full, stiffness=0 * full)
        corners = corners.reshape(elements.shape)
        faces = ElementRows(corners, np.full(len(corners), self._comm.rank), np.zeros(len(corners), bool))
        element_set = ElementSet(rows, faces).ordered()
        self._border = KeyLookup(element_set.points.keys)(keys[border])
        self._border_reduction = reduction
        local_area = vertex_areas(element_set.points.middle + element_set.points.out, element_set.elements.corners)
        area = self._over_border(local_area, np.add)
        if self._comm.size > 1 and self._own_nodes is not None:
            self._own_nodes.destroy()
        columns, self._own_map = element_set.point_map()
        self._own_nodes = NodeExchange(domain, columns)
        stiffness = self._point_stiffness(self._own_map.weights, area, local_area)
        self.element_set = replace(element_set, points=replace(element_set.points, area=area, stiffness=stiffness))
        return True

    def _split_surface(self) -> SplitSurface | None:
        """Split surface of the cells of this rank; None: as before on all ranks (collective)."""
        cells = np.repeat(self._pattern, self._cell_parts)
        if not self.law.fragments_only:
            return build_split_surface(self._topology, cells)
        state = cells, *self._open_edges(cells)
        # most edges break within fragments
        same = self._open is not None and moves_alike(self._topology, state, self._open)
        self._open = state
        if self._comm.allreduce(same, op=MPI.LAND):
            return None
        cut = None if self._cuts is None else self._cut_positions(*self._cuts())
        return build_surface_of_open_edges(self._topology, *state[1:], cut)

    def _open_edges(self, pattern: Pattern) -> tuple[Flags, Flags]:
        """Flags of open edges and of loose nodes of this rank (fragment_surface.find_open_edges; collective)."""
        topology, loose = self._topology, np.ones(len(self._topology.points))
        loose[topology.cells[pattern == 0]] = 0.0
        is_loose = min_over_ranks(self._domain.space.dofmap.index_map, loose) > 0
        cut = topology.broken_edges(pattern) | is_loose[topology.edges].any(axis=1)
        fragment = find_components(self._domain, topology.edges[~cut]).node_fragment[topology.edges]
        return cut & (fragment[:, 0] != fragment[:, 1]), is_loose

    def _cut_positions(self, keys: Ints, positions: Values) -> Values:
        """(edges,) positions of cuts from the lower local node; NaN: none. Of edges with keys (k, 2) (CutPositions)."""
        ends = self._domain.input_numbering.nodes[self._topology.edges]
        low, high = np.sort(ends, axis=1).T
        size = np.int64(1) << 32
        rows = KeyLookup(keys @ np.array([size, 1]))(low * size + high)
        cut = np.where(rows >= 0, positions[rows, 0] if len(positions) else np.nan, np.nan)
        return np.where(ends[:, 0] > ends[:, 1], 1 - cut, cut)

    def _point_stiffness(self, weights: csr_matrix, area: Values, local_area: Values) -> Values:
        """(n,) stiffness of the points of this rank, N/m: constant while a surface lasts (collective)."""
        d, nodes = self._domain.dim, self._own_nodes
        assert nodes is not None

        def nodal_sums(values: Values) -> Values:
            total = nodes.sum_at_nodes(np.repeat(values[:, None], d, axis=1))
            return nodes(total)[:, 0].copy()

        # before obstacles twice that of self-contact, where both sides yield
        limit = (2 if self._meshes else 1) * self._max_added
        mass_share = NodalMassShare(weights, nodes(self._mass)[:, 0].copy(), nodal_sums)
        return penalty_stiffness(mass_share, area, self.law.stiffness / self.law.distance, limit, local_area)

    def _over_border(self, values: Values, operation: np.ufunc) -> Values:
        """(n, ...) values of this rank's points, of those that ranks share an operation on all (collective)."""
        result = values.copy()
        result[self._border] = self._border_reduction(values[self._border], operation)
        return result

    def _refuse_contact(self) -> None:
        """Raise InputError where the body at rest intersects itself or an obstacle (collective)."""
        positions, surface, comm = self.current.rest_positions, self.current, self._comm
        rank, count = surface.element_set.elements.rank, len(surface.elements)
        if not self._meshes:
            pairs = surface.parts[0].contact.intersections(positions)
            pairs = pairs[rank[pairs.min(axis=1, initial=count)] == comm.rank]
            centres = positions[surface.elements[pairs]].mean(axis=(1, 2))
            refuse_intersections(np.concatenate(allgather(comm, centres)))
            return
        is_cut = [max_over_ranks(comm, len(part.cut_elements(positions, count))) for part in surface.parts]

        mesh = self._domain.input_mesh

        def check() -> None:
            assert mesh is not None
            for obstacle, cut in zip(self._meshes, is_cut, strict=True):
                refuse_overlap(obstacle.name, (mesh.points, boundary_facets(mesh.cells)), obstacle.surface, cut=cut > 0)

        on_root(comm, check)

    # --- elements of other ranks ---

    def refresh(self, u: Values) -> None:
        """Exchange elements again if one may be missing at displacements u (owned dofs,), m (collective)."""
        if self._restored is None and not self._moved_far(u):
            return
        histories = [part.contact.history.by_keys(part.keys) for part in self.current.parts]
        state, self._restored = self._restored or self.snapshot(), None
        rows, faces = self.element_set.points, self.element_set.elements
        self.element_set = ElementSet(replace(rows, share=state.share), replace(faces, is_excluded=state.is_excluded))
        self._exchange(u)
        self.current.set_release_interval(state.interval)
        self.set_history(histories)

    def _moved_far(self, u: Values) -> bool:
        """Whether points may have come nearer by more than the margin since the last exchange (collective)."""
        if self._comm.size == 1:
            return False
        moved = [end - start for end, start in zip(self._arm_ends(u), self._start, strict=True)]
        moved += [mesh.positions - start for mesh, start in zip(self._meshes, self._start_obstacles, strict=True)]
        return motion_diagonal(self._comm, moved) > self._margin

    def _arm_ends(self, u: Values) -> list[Values]:
        """(n, d) positions of this rank's points without arms and with full arms, m (collective)."""
        assert self._own_nodes is not None
        nodal, count = self._own_nodes(u), len(self.element_set.points.keys)
        points, share = np.arange(count), np.ones(count)
        return [self._own_map.evaluate_points(nodal, points, factor * share) for factor in (0.0, 1.0)]

    def _exchange(self, u: Values) -> None:
        """Get elements of other ranks near those of this rank at displacements u (owned dofs,), m (collective)."""
        element_set, comm = self.element_set, self._comm
        if comm.size > 1:
            self._start, self._start_obstacles = self._arm_ends(u), [mesh.positions for mesh in self._meshes]
            corners = np.concatenate([x[self.element_set.elements.corners] for x in self._start], axis=1)
            searched = boxes = _bounding_boxes(corners)
            if self._meshes:
                on_border = np.zeros(len(element_set.points.keys), bool)
                on_border[self._border] = True
                searched = np.concatenate(
                    [boxes[on_border[element_set.elements.corners].any(axis=1)], *self._mesh_boxes()]
                )
            element_set = exchange_elements(comm, element_set, boxes, searched, self._reach + self._margin)
        edge, self.exchange_count = self._domain.mean_edge_length, self.exchange_count + 1
        self.current = PenaltySurface(comm, element_set, self.law, self._meshes, edge, self.law.distance)
        self._point_rows = KeyLookup(element_set.points.keys)(self.element_set.points.keys)
        self._element_rows = np.flatnonzero(element_set.elements.rank == comm.rank)
        if self._nodes is not None and self._nodes is not self._own_nodes:
            self._nodes.destroy()
        self._nodes = self._own_nodes if comm.size == 1 else NodeExchange(self._domain, self.current.columns)

    def _mesh_boxes(self) -> list[Values]:
        """(k, 2, d) bounding boxes of this rank's triangles of each obstacle, m."""
        sides = [mesh.triangles[mesh.triangle_ranks(self._comm.size) == self._comm.rank] for mesh in self._meshes]
        return [_bounding_boxes(mesh.positions[rows]) for mesh, rows in zip(self._meshes, sides, strict=True)]

    def set_history(self, histories: Sequence[PenaltyHistory]) -> None:
        """Set the contacts of each part at the end of the last step; each goes to the rank that it belongs to.

        Collective.
        """
        for part, history in zip(self.current.parts, histories, strict=True):
            lookup = KeyLookup(part.keys)
            stored = part.contact.store(lookup(history.points.points[:, 0]), lookup(history.edges.points))
            if self._comm.size > 1:
                elsewhere = history.select(*(~flags for flags in stored))
                history = PenaltyHistory.join([history.select(*stored), *allgather(self._comm, elsewhere)])
            part.contact.set_history(history.by_numbers(lookup, part.max_stiffness))

    # --- positions and forces ---

    def nodal_values(self, u: Values) -> Values:
        """(columns, d) values at the nodes that points follow, of values u of owned dofs (collective)."""
        assert self._nodes is not None
        return self._nodes(u).copy()

    def positions(self, u: Values) -> Values:
        """(n, d) positions of the points of this rank and of others near it, m (collective)."""
        self.refresh(u)
        return self.current.point_map(self.nodal_values(u))

    def sum_at_nodes(self, parts: Values) -> Values:
        """(owned dofs,) sums over the ranks of values (columns, d) at the nodes that points follow (collective)."""
        assert self._nodes is not None
        return self._nodes.sum_at_nodes(parts)

    def max_added_frequency(self, x: Values) -> float:
        """Bound of what contact adds to the square of a frequency with points at x (n, d), m; 1/s^2 (collective)."""
        loads, d = self.current.added_loads(x), self._domain.dim
        largest = np.zeros(loads.shape[1])
        if self._comm.allreduce(bool(loads.any()), op=MPI.LOR):
            for part in range(loads.shape[1]):
                total = self.sum_at_nodes(np.repeat(loads[:, part, None], d, axis=1))
                largest[part] = (total / self._mass).max(initial=0.0)
            self._comm.Allreduce(MPI.IN_PLACE, largest, MPI.MAX)
        return float(largest.sum())

    def extend_faces(self, u: Values) -> None:
        """Extend retracted faces where there is room, at displacements u (owned dofs,), m (collective)."""
        if self.has_retracted:
            self.refresh(u)
            self.current.extend_faces(self.nodal_values(u))
            self._faces_changed()

    def _faces_changed(self) -> None:
        share, excluded, _ = self.current.snapshot()
        self._version += 1
        self.has_retracted = bool(max_over_ranks(self._comm, int(bool(np.any(share < 1)) or len(excluded) > 0)))

    def reach_of_points(self) -> float:
        """Largest motion of a point of this rank where no node moves by more than 1; infinite with retracted faces."""
        if self.has_retracted:
            return np.inf
        return float(abs(self.current.point_map.weights).sum(axis=1).max()) if len(self.current.elements) else 0.0

    def following_points(self) -> FollowingPoints:
        """Points of this rank."""
        map_rows = self.current.point_map.weights[self._point_rows]
        nodes = np.unique(map_rows.indices)
        reference, facets = self.current.point_map.rest[self._point_rows], self.element_set.elements.corners
        numbers = self.current.columns[nodes]
        return FollowingPoints(reference, map_rows[:, nodes], numbers, facets, may_stay=not self.has_retracted)

    # --- faces for output ---

    def set_cuts(self, cuts: CutPositions) -> None:
        """Set where edges are cut; used for faces between fragments."""
        if self.law.fragments_only:
            self._cuts = cuts

    def separate_surface(self, points: SurfaceMap, surface: DrawnSurface, u: Values, t: float) -> SurfaceMap:
        """Move points of a surface for output to the crack faces of contact, which are offset and retracted."""
        assert self._own_nodes is not None
        share, nodal = self.current.point_map.share[self._point_rows], self._own_nodes(u).copy()
        row_of_key = KeyLookup(self.element_set.points.keys)
        if self.law.fragments_only:
            faces = self._own_map.with_arm_share(share)
            return project_onto_fragments(points, surface, PlanarPoints(row_of_key, faces.rest, faces(nodal)))
        rows = row_of_key(surface.numbering.keys(surface.part.node_numbers))
        # in 2D points within the body are none of contact
        which = np.flatnonzero(rows >= 0)
        # faces without an offset stay where other terms have moved them
        if self._face_gap:
            full_arms = self._own_map.with_arm_share(np.ones(len(share)))(nodal)
            points = points.move_points(which, full_arms[rows[which]])
        drawn_share = points.share.copy()
        drawn_share[which] = np.minimum(share[rows[which]], drawn_share[which])
        return points.with_arm_share(drawn_share)

    # --- state ---

    def snapshot(self) -> SurfaceState:
        """Retracted and left-out parts of this rank."""
        if self._restored is not None:
            return self._restored
        share, excluded, interval = self.current.snapshot()
        is_excluded = np.zeros(len(self.current.elements), bool)
        is_excluded[excluded] = True
        return SurfaceState(
            self.surface_count, self._version, share[self._point_rows], is_excluded[self._element_rows], interval
        )

    def restore(self, memory: object) -> None:
        """Restore a snapshot (not collective).

        Where edges have broken since, in an earlier pass of the step, the surface is another one and stays as it is.
        """
        state = cast("SurfaceState", memory)
        if state.surface_count != self.surface_count:
            return
        if state.version == self._version:
            self.current.set_release_interval(state.interval)
            return
        self._version, self._restored = state.version, state
        self.has_retracted = True  # until faces are extended again

    def to_checkpoint(self) -> dict[str, Values]:
        """Names and factors of retracted points, names of left-out elements, and steps to the next release of faces.

        On rank 0 (collective).
        """
        state = self.snapshot()
        points, elements = np.flatnonzero(state.share < 1), np.flatnonzero(state.is_excluded)
        keys, share, excluded = (
            self.element_set.points.keys[points],
            state.share[points],
            self.element_set.element_keys[elements],
        )
        parts = gather(self._comm, (keys, share, excluded))
        if parts is None:
            return {}
        names = "retracted", "share", "left_out"
        arrays = {name: np.concatenate(rows) for name, rows in zip(names, zip(*parts, strict=True), strict=True)}
        return arrays | {"pause": np.array(state.interval, float)}

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Set the state from the arrays of a checkpoint (collective)."""
        share = np.ones(len(self.element_set.points.keys))
        rows = KeyLookup(self.element_set.points.keys)(saved["retracted"].astype(np.int64))
        share[rows[rows >= 0]] = saved["share"][rows >= 0]
        is_excluded = np.isin(self.element_set.element_keys, saved["left_out"])
        pause, remaining = (int(number) for number in saved["pause"])
        self._restored = SurfaceState(self.surface_count, self._version, share, is_excluded, (pause, remaining))
        self.refresh(self._current_u)
        self._faces_changed()


def _bounding_boxes(corners: Values) -> Values:
    """(m, 2, d) lowest and highest corners of the bounding boxes of points (m, c, d), m."""
    return np.stack([corners.min(axis=1), corners.max(axis=1)], axis=1)


def motion_diagonal(comm: MPI.Intracomm, motions: Sequence[Values]) -> float:
    """Diagonal of the bounding box of motions (k, d) on all ranks, m: no two points approach by more (collective)."""
    d = motions[0].shape[1]
    # by columns: minima along the first axis take twenty times as long
    lowest = [min(motion[:, axis].min(initial=np.inf) for motion in motions) for axis in range(d)]
    highest = [max(motion[:, axis].max(initial=-np.inf) for motion in motions) for axis in range(d)]
    bounds = np.array([*lowest, *(-value for value in highest)])
    comm.Allreduce(MPI.IN_PLACE, bounds, MPI.MIN)
    return float(np.linalg.norm(bounds.reshape(2, -1).sum(axis=0)))
