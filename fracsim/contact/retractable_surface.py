"""Elements of a surface in contact, whose crack faces are retracted where there is no room for them.

The two sides of a new crack coincide. They are offset by a gap of twice the distance of the barrier, so that no
barrier acts as an edge breaks; with the default distance there is room for a strain of about 1 %. Where that is not
enough, in a compressed body or for a single-node fragment without a deformation gradient, faces are retracted towards
their nodes until no contact acts more strongly than before: contact gains no energy. Faces without room even so are
excluded. In later steps faces are extended and included again where nothing acts on them.

A rank has the elements of its own cells and others near them. Ranks decide alike where crack faces have no room:
pressures are summed, and arms are the shortest of all ranks.

Equations: docs/theory.md#new-crack-faces.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, repeat
from typing import Any

import numpy as np
from mpi4py import MPI

from ..array_types import Flags, Ints, Values
from ..errors import InputError
from ..mesh.ghost_exchange import KeyedReduction, KeyLookup
from ..mesh.split_surface.closed_surface import SplitSurface
from ..mesh.split_surface.entity_numbering import CRACK
from ..meshes.data import format_point
from .element_exchange import ElementSet, own_points
from .mesh_obstacles import SurfacePart
from .pair_search import PairFilter, intersecting_pairs
from .sample_points import vertex_areas


@dataclass(frozen=True)
class SurfacePolicy:
    """Tuned numbers of the surface of self-contact.

    Attributes:
        face_gap: gap between the sides of a new crack, in distances of the barrier.
        max_offset: part of the way to its nodes by which a crack face is offset at most, for slivers.
        factor: of an arm each time that it is shortened.
        min_arm: arm, in the full one, below which it is not shortened.
        min_arm_length: the same in distances of the barrier. With shorter arms the points around a node would be
            within that distance of one another.
        min_cut_length: distance of a cut from the ends of its edge, in distances of the barrier, where half the edge
            is longer.
        min_planar_cut_length: the same of cuts between fragments, without points of facets and cells between those of
            edges.
        gentle_rounds: rounds with `factor`, after which arms are shortened to `min_arm` at once. One face makes room
            for the next, and each round costs a search.
        closed_pressure: pressure, in stiffnesses, of faces without room: that of a fifth of the barrier's distance.
        round_off: relative tolerance of pressures.
        max_coupled_nodes: nodes in contact up to which their stiffness is kept apart from the matrix.
    """

    face_gap: float = 2.0
    max_offset: float = 0.4
    factor: float = 0.7
    min_arm: float = 0.2
    min_arm_length: float = 8.0
    min_cut_length: float = 12.0
    min_planar_cut_length: float = 4.0
    gentle_rounds: int = 4
    closed_pressure: float = 10.0
    round_off: float = 1e-6
    max_coupled_nodes: int = 3000


SURFACE = SurfacePolicy()
NO_ELEMENTS: Ints = np.empty(0, np.int64)
# factors of arms, excluded elements, and whether edges broke in the last step
type SurfaceSnapshot = tuple[Values, Ints, bool]


@dataclass(frozen=True)
class SelfContactLaw:
    """Law of contact of a body with itself.

    Attributes:
        distance: at which the barrier begins, m.
        stiffness: of the barrier, Pa.
        friction: coefficient of friction.
        sticking_speed: slip velocity below which friction counts as sticking, m/s.
        sticking_speed_ratio: the same in the speed of the nodes (SelfContact); the larger one counts.
        fragments_only: contact between fragments alone, without crack faces inside one and single-node fragments.
        corners_only: quadratic cells are in contact by their corners alone, as crack faces are.
    """

    distance: float
    stiffness: float
    friction: float
    sticking_speed: float
    sticking_speed_ratio: float = 0.0
    fragments_only: bool = False
    corners_only: bool = False

    def sticking_speed_at(self, speed: float) -> float:
        """Slip velocity that counts as sticking, m/s, of nodes with a speed of `speed`, m/s."""
        return max(self.sticking_speed, self.sticking_speed_ratio * speed)


class RetractableSurface[Part: SurfacePart[Any]]:
    """Elements of this rank and of others near them, and their contacts.

    Attributes:
        comm: ranks.
        law: contact law.
        element_set: points and elements.
        elements: (m, d) points of the elements.
        columns: global numbers of the nodes that the points follow.
        point_map: map from these nodes to points, with new faces retracted.
        rest_positions: (n, d) reference positions of the points with full arms, m.
        own_points: (n,) flags of points of which this rank is the lowest one that has an element there.
        is_new: whether edges broke in the last step.
        parts: contact with itself, or with each obstacle.
    """

    def __init__(
        self,
        comm: MPI.Intracomm,
        element_set: ElementSet,
        law: SelfContactLaw,
        build_parts: Callable[[RetractableSurface[Part], Ints], Sequence[Part]],
        closed_pressure: float,
    ) -> None:
        """Build the contacts of elements.

        Args:
            comm: ranks.
            element_set: points and elements.
            law: contact law.
            build_parts: surface, elements (k,) -> their contacts.
            closed_pressure: pressure, in stiffnesses, of faces without room.
        """
        self._build_parts, self._closed_pressure = build_parts, closed_pressure
        self.comm, self.law, self.element_set, faces = comm, law, element_set, element_set.elements
        self.columns, self.point_map = element_set.point_map()
        self.elements, self.rest_positions = faces.corners, element_set.points.middle + element_set.points.out
        self.own_points = own_points(faces.rank, faces.corners, len(self.rest_positions), comm.rank)
        is_copy = np.zeros(len(self.rest_positions), bool)
        is_copy[self.point_map.copies] = True
        self._crack_faces = np.flatnonzero(is_copy[self.elements].any(axis=1))
        self._excluded = NO_ELEMENTS
        self.is_new = True
        self.parts: Sequence[Part] = ()
        self.parts = build_parts(self, np.arange(len(self.elements)))
        self._exclude(np.flatnonzero(faces.is_excluded))

    # --- contacts ---

    def set_law(self, law: SelfContactLaw) -> None:
        """Set another contact law, which the contacts have already."""
        self.law = law

    def cut_elements(self, x: Values) -> list[Ints]:
        """Remaining elements (k,) that the body itself, or each obstacle, intersects with points at x (n, d), m."""
        return [part.cut_elements(x) for part in self.parts]

    def _exclude(self, elements: Ints) -> None:
        """Leave out these elements (k,) and no others."""
        if len(elements) or len(self._excluded):
            self.parts = self._build_parts(self, np.delete(np.arange(len(self.elements)), elements))
        self._excluded = elements

    def remaining(self) -> Ints:
        """Numbers (m,) of the elements that are not excluded."""
        return np.delete(np.arange(len(self.elements)), self._excluded)

    def snapshot(self) -> SurfaceSnapshot:
        """Factors of arms, excluded elements, and whether edges broke in the last step."""
        return self.point_map.share, self._excluded, self.is_new

    def find_intersections(self, x: Values) -> tuple[Ints, Flags]:
        """(k, 2) elements that intersect, of which this rank has the first, with points at x (n, d), m.

        Excluded elements count too. Also returns (k,) flags of pairs of which one is excluded.
        """
        pairs = intersecting_pairs(self.elements, PairFilter.of(len(x)), x)
        pairs = pairs[self.element_set.elements.rank[pairs.min(axis=1, initial=len(self.elements))] == self.comm.rank]
        return pairs, np.asarray(np.isin(pairs, self._excluded).any(axis=1))

    # --- what ranks agree on ---

    @cached_property
    def over_points(self) -> KeyedReduction:
        """Sums, minima and the like of values at points over all ranks that have the point."""
        return KeyedReduction(self.comm, self.element_set.points.keys)

    @cached_property
    def _over_elements(self) -> KeyedReduction:
        return KeyedReduction(self.comm, self.element_set.element_keys)

    def sum_at_points(self, vectors: Values) -> Values:
        """(n, d) sums of vectors at the points over all ranks (collective)."""
        return self.over_points(vectors, np.add)

    def pressures(self, u: Values) -> Values:
        """(n,) pressure on each point at displacements u (columns, d), m; Pa (collective)."""
        x, result, remaining = self.point_map(u), np.zeros(len(self.rest_positions)), self.remaining()
        of_rank = remaining[self.element_set.elements.rank[remaining] == self.comm.rank]
        area = self.over_points(vertex_areas(self.rest_positions, self.elements[of_rank]), np.add)
        for part in self.parts:
            force = np.linalg.norm(self.sum_at_points(part.gradient(x)), axis=1)
            result += np.divide(force, area, out=np.zeros_like(area), where=area > 0)
        return result

    def _intersecting_faces(self, u: Values) -> Ints:
        """Crack faces that intersect at displacements u (columns, d), m (collective)."""
        is_cut, cut = np.zeros(len(self.elements), bool), np.concatenate(self.cut_elements(self.point_map(u)))
        is_cut[self.remaining()[cut]] = True
        return np.intersect1d(self._crack_faces, np.flatnonzero(self._over_elements(is_cut, np.logical_or)))

    def _on_any_rank(self, flag: bool) -> bool:
        """Whether a flag is set on any rank (collective)."""
        return bool(flag) if self.comm.size == 1 else bool(self.comm.allreduce(bool(flag), op=MPI.LOR))

    # --- retraction and release of crack faces ---

    def _crowded_faces(self, u: Values, max_pressure: Values) -> Ints:
        """Crack faces with a pressure above `max_pressure` (n,), Pa, at a corner, or else those that intersect."""
        pressed = self._pressed_faces(u, max_pressure)
        return pressed if self._on_any_rank(len(pressed) > 0) else self._intersecting_faces(u)

    @cached_property
    def _min_share(self) -> Values:
        """(n,) factors of arms below which they are not shortened."""
        length = np.linalg.norm(self.element_set.points.out, axis=1)
        at_length = np.divide(
            SURFACE.min_arm_length * self.law.distance, length, out=np.ones_like(length), where=length > 0
        )
        return np.clip(at_length, SURFACE.min_arm, 1.0)

    def _pressed_faces(self, u: Values, max_pressure: Values) -> Ints:
        above = self.pressures(u) > max_pressure * (1 + SURFACE.round_off)
        return self._crack_faces[above[self.elements[self._crack_faces]].any(axis=1)]

    def _shorten(self, u: Values, faces: Ints, factor: float) -> bool:
        """Shorten the arms of crack faces by a factor; whether any arm has changed."""
        share, points = self.point_map.share.copy(), np.unique(self.elements[faces])
        share[points] = np.maximum(factor * share[points], np.minimum(self._min_share[points], share[points]))
        share = self.over_points(share, np.minimum)
        changed = self._on_any_rank(not np.array_equal(share, self.point_map.share))
        if changed:
            self.point_map = self.point_map.with_arm_share(share)
        return changed

    def retract_faces(self, u: Values, keys: Ints, load: Values) -> None:
        """Retract crack faces under pressure at displacements u (columns, d), m (collective).

        `load`: (k,) pressures, Pa, of points with `keys` that may stay.
        """
        loads: Values = np.zeros(len(self.rest_positions))
        loads[KeyLookup(self.element_set.points.keys)(keys)] = load
        self._retract_faces(u, self.over_points(loads, np.maximum))

    def _retract_faces(self, u: Values, load: Values) -> None:
        """Retract faces with a pressure above `load` (n,), Pa, and exclude those without room even so.

        No element is excluded.
        """
        start = self.point_map.share
        for factor in chain(repeat(SURFACE.factor, SURFACE.gentle_rounds), repeat(SURFACE.min_arm)):
            if not (
                self._shorten(u, self._pressed_faces(u, load), factor)
                or self._shorten(u, cut := self._intersecting_faces(u), factor)
            ):
                break
        max_pressure = np.maximum(load, self._closed_pressure * self.law.stiffness)
        without_room = np.union1d(self._pressed_faces(u, max_pressure), cut)
        self._exclude(without_room)
        if self._on_any_rank(len(without_room) > 0):
            # points of excluded faces alone keep their arms, so as not to come back smaller each time
            unused: Flags = np.ones(len(start), bool)
            unused[np.delete(self.elements, without_room, axis=0)] = False
            unused = self.over_points(unused, np.logical_and)
            self.point_map = self.point_map.with_arm_share(np.where(unused, start, self.point_map.share))

    def extend_faces(self, u: Values) -> bool:
        """Extend retracted faces and include excluded ones where there is room, at displacements u (columns, d), m.

        Not in the step after edges broke. Returns whether anything has changed (collective).
        """
        share, excluded, is_new = self.snapshot()
        self.is_new = False
        is_retracted, is_excluded = (self._on_any_rank(flag) for flag in (bool(np.any(share < 1)), len(excluded) > 0))
        if is_new or not (is_retracted or is_excluded):
            return False
        load = self.pressures(u)
        if is_retracted:
            self._extend_retracted(u, load)
        if is_excluded:
            self._exclude(NO_ELEMENTS)
            self._retract_faces(u, load)
        same = np.array_equal(share, self.point_map.share) and np.array_equal(excluded, self._excluded)
        return self._on_any_rank(not same)

    def _extend_retracted(self, u: Values, load: Values) -> None:
        previous = self.point_map.share
        self.point_map = self.point_map.with_arm_share(np.minimum(previous / SURFACE.factor, 1.0))
        # twice, as a face that stays may be in the way of its neighbours
        for _ in range(2):
            crowded = self._crowded_faces(u, load)
            if not self._on_any_rank(len(crowded) > 0):
                return
            share, points = self.point_map.share.copy(), np.unique(self.elements[crowded])
            share[points] = previous[points]
            self.point_map = self.point_map.with_arm_share(self.over_points(share, np.minimum))
        if self._on_any_rank(len(self._crowded_faces(u, load)) > 0):
            self.point_map = self.point_map.with_arm_share(previous)


def refuse_intersections(positions: Values) -> None:
    """Raise InputError if there are pairs of elements that intersect; `positions`: (k, d) of these, m."""
    if len(positions):
        first = format_point(positions[np.lexsort(positions.T[::-1])[0]])
        raise InputError(
            f"[contact]: {len(positions)} pairs of surface elements cut or touch each other at the start, the "
            f"first near {first}; move the bodies apart"
        )


# --- offset of new crack faces ---


def offset_crack_faces(
    surface: SplitSurface, gap: float, least_cosine: Callable[[Values], Values] = lambda cosine: cosine
) -> Values:
    """(n, d) reference positions, m, with opposite crack faces `gap`, m, apart where the shape of cells allows it.

    Every copy moves towards the mean of the nodes that it follows, so far that all crack faces at it recede by half
    the gap along their normals. (A fixed part of the edge would leave faces aslant to their edge nearer to each
    other.) Points on the boundary of the body stay, and so do tips, points with one copy.

    `least_cosine`: least values (n,) of points of all ranks that share the surface.
    """
    start = surface.parents.start
    arm = np.add.reduceat(surface.parents.arm, start[:-1], axis=0) / np.diff(start)[:, None]
    length = np.linalg.norm(arm, axis=1)
    outward = arm / np.where(length > 0, length, 1.0)[:, None]
    cosine = least_cosine(_min_cosine(surface, outward))
    distance = np.where(cosine > 0, 0.5 * gap / np.where(cosine > 0, cosine, 1.0), np.inf)
    distance = np.where(_is_tip(surface.points), 0.0, np.minimum(distance, SURFACE.max_offset * length))
    result: Values = surface.points - distance[:, None] * outward
    return result


def _min_cosine(surface: SplitSurface, outward: Values) -> Values:
    """(n,) least cosine between `outward` (n, d) and the normals of crack faces at each point; inf without any."""
    corners = surface.elements[surface.origin == CRACK]
    cosine = np.einsum("ekj,ej->ek", outward[corners], unit_normals(surface.points[corners]))
    result = np.full(len(outward), np.inf)
    np.minimum.at(result, corners, cosine)
    return result


def unit_normals(corners: Values) -> Values:
    """(m, d) outward unit normals of segments or triangles (m, d, d)."""
    side = corners[:, 1:] - corners[:, :1]
    normal = np.cross(side[:, 0], side[:, 1]) if side.shape[1] == 2 else side[:, 0, ::-1] * [1.0, -1.0]
    size = np.linalg.norm(normal, axis=1, keepdims=True)
    result: Values = normal / np.where(size > 0, size, 1.0)
    return result


def _is_tip(points: Values) -> Flags:
    """(n,) whether no other point is at the same position."""
    _, group, count = np.unique(points, axis=0, return_inverse=True, return_counts=True)
    return count[group.ravel()] == 1
