"""Surface of a body in contact, distributed over the ranks: no rank has all of it.

Each rank has the elements of its own cells and those of others that may come near them. These are exchanged for some
displacements: for all positions within a margin of one of them. Beyond it they are exchanged again: any two points have
come nearer by at most the diagonal of the bounding box of the motions of all points.

Equations: docs/theory.md#contact, docs/theory.md#explicit-contact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, cast

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from scipy.sparse import csr_matrix

from ..array_types import Flags, Ints, Pattern, Values
from ..mechanics.term_protocols import CutPositions
from ..mesh.domain import Domain
from ..mesh.fragments import find_components
from ..mesh.ghost_exchange import KeyedReduction, KeyLookup, find_saved_keys, min_over_ranks, sum_at_nodes
from ..mesh.parallel import allgather, gather, max_over_ranks, on_root
from ..mesh.simplices import is_split
from ..mesh.split_surface.closed_surface import SplitSurface, build_split_surface
from ..mesh.split_surface.drawn_surface import DrawnSurface
from ..mesh.split_surface.entity_numbering import EntityNumbering
from ..mesh.split_surface.fragment_surface import (
    OpenEdges,
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
from .element_exchange import (
    ElementRows,
    ElementSet,
    ExchangePath,
    PointRows,
    bounding_boxes,
    exchange_elements,
)
from .mesh_obstacles import MeshObstacle, SurfacePart
from .retractable_surface import (
    SURFACE,
    RetractableSurface,
    SelfContactLaw,
    offset_crack_faces,
    refuse_intersections,
)
from .sample_points import vertex_areas
from .triangle_mesh_shape import refuse_overlap


@dataclass(frozen=True)
class SurfaceState:
    """What changes of a surface between breaks.

    Attributes:
        surface_count: number of surfaces until then.
        version: number of changes of arms and of left-out elements until then.
        share: (n,) factors of the arms of this rank's points.
        is_excluded: (m,) flags of this rank's elements.
        is_new: whether edges broke in the last step.
    """

    surface_count: int
    version: int
    share: Values
    is_excluded: Flags
    is_new: bool


class PartitionedSurface[Part: SurfacePart[Any]]:
    """Contact surface of a body, built again when edges break (HistoryTerm, CutFaces, SurfaceSeparator).

    Attributes:
        law: contact law.
        mean_edge: mean length of edges of the mesh, m.
        current: elements of this rank and of others near them.
        element_set: those of this rank, with their factors and flags at the last exchange.
        surface_count: number of surfaces until now.
        exchange_count: number of exchanges of elements until now: points have new numbers after each.
        has_retracted: whether any face on any rank is retracted or left out.
        start_displacement: (owned dofs,) at the start of the last step in which faces may have been extended, which
            each exchange serves too, m; None: none.
    """

    closed_pressure: ClassVar[float]  # pressure, in stiffnesses, of faces without room
    current: RetractableSurface[Part]
    element_set: ElementSet
    _path: ExchangePath  # for which elements were exchanged
    start_displacement: Values | None = None
    _cuts: CutPositions | None = None
    _open: OpenEdges | None = None  # of the current surface, in contact between fragments
    _restored: SurfaceState | None = None
    # values at the nodes of all points, and of this rank's points
    _nodes: NodeExchange | None = None
    _own_nodes: NodeExchange | None = None

    def __init__(
        self,
        domain: Domain,
        u: fem.Function,
        law: SelfContactLaw,
        meshes: Sequence[MeshObstacle],
        reach: float,
        margin: float,
    ) -> None:
        """Build the surface (collective).

        Args:
            domain: mesh.
            u: displacement.
            law: contact law.
            meshes: obstacles; none: the body touches itself.
            reach: distance within which elements of other ranks are wanted, m.
            margin: approach of two points after which elements are exchanged again, m; infinite: as edges break alone.

        Raises:
            InputError: if the surface at rest intersects itself, or an obstacle.
        """
        self.law, self._domain, self._u, self._meshes = law, domain, u, meshes
        self._comm, self._owned, self.mean_edge = domain.comm, domain.node_count * domain.dim, domain.mean_edge_length
        is_refined = domain.order == 2 and not law.corners_only
        # subdivided quadratic cells do not break
        self._cell_parts = 2**domain.dim if is_refined else 1
        self._topology = EntityNumbering(subdivided_local_mesh(domain) if is_refined else local_mesh(domain))
        self._is_shared = sum_at_nodes(domain, np.arange(len(domain.nodes)), np.ones((len(domain.nodes), 1)))[:, 0] > 1
        self._pattern: Pattern = np.zeros(domain.cell_count, np.uint8)
        self._margin, self._search_reach = margin, reach + margin if np.isfinite(margin) else reach
        # before obstacles alone crack faces are not offset from one another
        self._face_gap = 0.0 if meshes else SURFACE.face_gap * law.distance
        self.surface_count = self.exchange_count = self._version = 0
        self.has_retracted = False
        self._build_own_elements()
        self._exchange([self._current_u])
        self._refuse_contact()

    # --- contacts, which a subclass has ---

    def _build_parts(self, surface: RetractableSurface[Part], elements: Ints) -> list[Part]:
        """Contacts of elements (k,) of a surface, with themselves or with each obstacle."""
        return [self._build_part(surface, elements, mesh) for mesh in self._meshes or (None,)]

    def _build_part(self, surface: RetractableSurface[Part], elements: Ints, mesh: MeshObstacle | None) -> Part:
        """Contacts of elements (k,) of a surface with themselves (None), or with an obstacle."""
        raise NotImplementedError("a subclass has contacts")

    def _point_stiffness(self, weights: csr_matrix, area: Values, local_area: Values) -> Values:
        """(n,) stiffness of the points of this rank, N/m (collective); 0 where contact has none of points."""
        return np.zeros(len(area))

    def _keep_history(self, previous: RetractableSurface[Part]) -> None:
        """Take over the contacts at the end of the last step (collective)."""

    def _searched_boxes(self, boxes: Values) -> Values:
        """(k, 2, d) boxes, m, near which elements of other ranks are wanted; `boxes`: (m, 2, d) of the elements.

        Those of the elements around the points of each element: the weights of a pair depend on the pairs beside it.
        """
        corners, d, count = self.element_set.elements.corners, boxes.shape[2], len(self.element_set.points.keys)
        bounds, at_points = np.concatenate([boxes[:, 0], -boxes[:, 1]], axis=1), np.full((count, 2 * d), np.inf)
        np.minimum.at(at_points, corners, bounds[:, None])
        around = self._over_border(at_points, np.minimum)[corners].min(axis=1)
        return np.stack([around[:, :d], -around[:, d:]], axis=1)

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
        self._exchange([u])
        self._keep_history(previous)
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
            return build_split_surface(self._topology, cells, self._cut_positions())
        minima = partial(min_over_ranks, self._domain.space.dofmap.index_map)
        edges = OpenEdges.find(self._comm, self._topology, cells, minima, self._node_fragments)
        # most edges break within fragments
        same = self._open is not None and moves_alike(self._topology, edges, self._open)
        self._open = edges
        if self._comm.allreduce(same, op=MPI.LAND):
            return None
        return build_surface_of_open_edges(self._topology, edges, self._cut_positions())

    def _node_fragments(self, broken: Flags) -> Ints:
        """(N,) fragment of each node of this rank for `broken` edges (E,) (collective)."""
        return find_components(self._domain, self._topology.edges[~broken]).node_fragment

    def _cut_positions(self) -> Values | None:
        """(edges,) positions of cuts from the lower local node; NaN: in the middle; None: all in the middle.

        They leave room for the barrier between the points around an end of an edge.
        """
        if self._cuts is None:
            return None
        keys, positions = self._cuts()
        ends = self._domain.input_numbering.nodes[self._topology.edges]
        low, high = np.sort(ends, axis=1).T
        size = np.int64(1) << 32
        rows = KeyLookup(keys @ np.array([size, 1]))(low * size + high)
        cut = np.where(rows >= 0, positions[rows, 0] if len(positions) else np.nan, np.nan)
        length = np.linalg.norm(np.diff(self._topology.points[self._topology.edges], axis=1)[:, 0], axis=1)
        room = SURFACE.min_planar_cut_length if self.law.fragments_only else SURFACE.min_cut_length
        margin = np.minimum(room * self.law.distance / length, 0.5)
        return np.asarray(np.clip(np.where(ends[:, 0] > ends[:, 1], 1 - cut, cut), margin, 1 - margin))

    def _over_border(self, values: Values, operation: np.ufunc) -> Values:
        """(n, ...) values of this rank's points, of those that ranks share an operation on all (collective)."""
        result = values.copy()
        result[self._border] = self._border_reduction(values[self._border], operation)
        return result

    def _refuse_contact(self) -> None:
        """Raise InputError where the body at rest intersects itself or an obstacle (collective)."""
        surface, comm = self.current, self._comm
        positions = surface.rest_positions
        if not self._meshes:
            pairs, _ = surface.find_intersections(positions)
            refuse_intersections(np.concatenate(allgather(comm, positions[surface.elements[pairs]].mean(axis=(1, 2)))))
            return
        is_cut = [max_over_ranks(comm, len(cut)) for cut in surface.cut_elements(positions)]

        mesh = self._domain.input_mesh

        def check() -> None:
            assert mesh is not None
            for obstacle, cut in zip(self._meshes, is_cut, strict=True):
                refuse_overlap(obstacle.name, (mesh.points, boundary_facets(mesh.cells)), obstacle.surface, cut=cut > 0)

        on_root(comm, check)

    # --- elements of other ranks ---

    def refresh(self, *displacements: Values) -> None:
        """Exchange elements again if one may be missing at displacements (owned dofs,), m, or between (collective)."""
        if self._restored is None and self._serves(displacements):
            return
        previous, state = self.current, self._restored or self.snapshot()
        self._restored = None
        rows, faces = self.element_set.points, self.element_set.elements
        self.element_set = ElementSet(replace(rows, share=state.share), replace(faces, is_excluded=state.is_excluded))
        self._exchange(displacements)
        self.current.is_new = state.is_new
        self._keep_history(previous)

    def exchange_again(self) -> None:
        """Exchange elements at the current displacement, as a run does that resumes from here (collective)."""
        self.start_displacement, self._restored = None, self.snapshot()
        self.refresh(self._current_u)

    def _serves(self, displacements: Sequence[Values]) -> bool:
        """Whether no element can be missing at displacements (owned dofs,), m, or between (collective)."""
        if self._comm.size == 1 or not np.isfinite(self._margin):
            return True
        return self._path.serves([self._moving_points(u) for u in displacements])

    def _moving_points(self, u: Values) -> list[Values]:
        """(n, d) positions of this rank's points without arms and with full arms, m (collective).

        A subclass adds those of points of obstacles, if elements are wanted near these.
        """
        assert self._own_nodes is not None
        return self._own_map.arm_ends(self._own_nodes(u))

    def _exchange(self, displacements: Sequence[Values]) -> None:
        """Get elements of other ranks that come near those of this rank on a path of displacements, m (collective).

        The path begins at the start of the step, if that is set.
        """
        element_set, comm = self.element_set, self._comm
        if comm.size > 1:
            path = displacements if self.start_displacement is None else [self.start_displacement, *displacements]
            self._path = ExchangePath(comm, self._margin, [self._moving_points(u) for u in path])
            ends = [x[element_set.elements.corners] for points in self._path.stops for x in points[:2]]
            boxes = bounding_boxes(np.concatenate(ends, axis=1))
            searched = self._searched_boxes(boxes)
            element_set = exchange_elements(comm, element_set, boxes, searched, self._search_reach)
        self.current = RetractableSurface(comm, element_set, self.law, self._build_parts, self.closed_pressure)
        self.exchange_count += 1
        points = self.current.element_set.points
        self._point_rows = KeyLookup(points.keys)(self.element_set.points.keys)
        self._element_rows = np.flatnonzero(element_set.elements.rank == comm.rank)
        if self._nodes is not None and self._nodes is not self._own_nodes:
            self._nodes.destroy()
        self._nodes = self._own_nodes if comm.size == 1 else NodeExchange(self._domain, self.current.columns)

    def border_elements(self) -> Ints:
        """Elements (k,) of this rank at points that other ranks have too."""
        on_border = np.zeros(len(self.element_set.points.keys), bool)
        on_border[self._border] = True
        return np.flatnonzero(on_border[self.element_set.elements.corners].any(axis=1))

    # --- positions and forces ---

    def nodal_values(self, u: Values) -> Values:
        """(columns, d) values at the nodes that points follow, of values u of owned dofs (collective)."""
        assert self._nodes is not None
        return self._nodes(u).copy()

    def positions(self, u: Values) -> Values:
        """(n, d) positions of the points of this rank and of others near it, m (collective)."""
        self.refresh(u)
        return self.current.point_map(self.nodal_values(u))

    def interpolate(self, owned: Values) -> Values:
        """(n, d) values at these points of a field with `owned` dofs (collective)."""
        return np.asarray(self.current.point_map.weights @ self.nodal_values(owned))

    def sum_at_nodes(self, parts: Values) -> Values:
        """(owned dofs,) sums over the ranks of values (columns, d) at the nodes that points follow (collective)."""
        assert self._nodes is not None
        return self._nodes.sum_at_nodes(parts)

    def nodal_forces(self, forces: Values) -> Values:
        """(owned dofs,) nodal forces W^T f equivalent to forces (n, d) at the points, N (collective)."""
        return self.sum_at_nodes(self.current.point_map.nodal_forces(forces))

    def nodes_of_points(self, points: Flags | None = None) -> Flags:
        """(owned nodes,) flags of the nodes that points follow: flagged ones (n,), or all (collective)."""
        counts: Values = np.ones(len(self.current.columns))
        if points is not None:
            counts = abs(self.current.point_map.weights).T @ points.astype(float)
        parts = np.repeat(counts[:, None], self._domain.dim, axis=1)
        return np.asarray(self.sum_at_nodes(parts).reshape(-1, self._domain.dim)[:, 0] > 0)

    def extend_faces(self, u: Values) -> None:
        """Extend retracted faces where there is room, at displacements u (owned dofs,), m (collective)."""
        if self.has_retracted:
            self.refresh(u)
            self._faces_changed(self.current.extend_faces(self.nodal_values(u)))

    def _faces_changed(self, changed: bool = True) -> None:
        """Note whether faces are retracted or left out, and that others are than before (collective)."""
        share, excluded, _ = self.current.snapshot()
        self._version += changed
        self.has_retracted = bool(max_over_ranks(self._comm, int(bool(np.any(share < 1)) or len(excluded) > 0)))

    def reach_of_points(self) -> float:
        """Largest motion of a point of this rank where no node moves by more than 1; infinite with retracted faces.

        At least 1, as points move with their nodes in a translation; 1 of a surface without points.
        """
        if self.has_retracted:
            return np.inf
        return float(abs(self.current.point_map.weights).sum(axis=1).max()) if len(self.current.elements) else 1.0

    def following_points(self) -> FollowingPoints:
        """Points of this rank."""
        map_rows = self.current.point_map.weights[self._point_rows]
        nodes = np.unique(map_rows.indices)
        reference, facets = self.current.point_map.rest[self._point_rows], self.element_set.elements.corners
        numbers = self.current.columns[nodes]
        return FollowingPoints(reference, map_rows[:, nodes], numbers, facets, may_stay=not self.has_retracted)

    # --- faces for output ---

    def set_cuts(self, cuts: CutPositions) -> None:
        """Set where edges are cut."""
        self._cuts = cuts

    def separate_surface(self, points: SurfaceMap, surface: DrawnSurface, u: Values, t: float) -> SurfaceMap:
        """Move points of a surface for output to the crack faces of contact, which are offset and retracted."""
        if self._cell_parts > 1:
            return points
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
        share, excluded, is_new = self.current.snapshot()
        is_excluded = np.zeros(len(self.current.elements), bool)
        is_excluded[excluded] = True
        return SurfaceState(
            self.surface_count, self._version, share[self._point_rows], is_excluded[self._element_rows], is_new
        )

    def restore(self, memory: object) -> None:
        """Restore a snapshot (not collective).

        Where edges have broken since, in an earlier pass of the step, the surface is another one and stays as it is.
        """
        state = cast("SurfaceState", memory)
        if state.surface_count != self.surface_count:
            return
        if state.version == self._version:
            self.current.is_new = state.is_new
            return
        self._version, self._restored = state.version, state
        self.has_retracted = True  # until faces are extended again

    def to_checkpoint(self) -> dict[str, Values]:
        """Names and factors of retracted points, names of left-out elements, and whether edges broke in the last step.

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
        return arrays | {"is_new": np.array([state.is_new], float)}

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Set the state from the arrays of a checkpoint (collective).

        Raises ValueError if it has keys of no point or element, or not as many factors as keys.
        """
        keys, element_keys, share = self.element_set.points.keys, self.element_set.element_keys, saved["share"]
        rows = find_saved_keys(self._comm, keys, saved["retracted"])
        excluded = find_saved_keys(self._comm, element_keys, saved["left_out"])
        if len(share) != len(rows):
            raise ValueError(f"{len(share)} factors of {len(rows)} retracted points")
        full, is_excluded = np.ones(len(keys)), np.zeros(len(element_keys), bool)
        full[rows[rows >= 0]] = share[rows >= 0]
        is_excluded[excluded[excluded >= 0]] = True
        (is_new,) = saved["is_new"]
        self._restored = SurfaceState(self.surface_count, self._version, full, is_excluded, bool(is_new))
        self.refresh(self._current_u)
        self._faces_changed()
