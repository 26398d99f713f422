"""Surface of a body for contact with itself, with crack faces retracted where there is no room.

Each rank holds the whole surface and decides alike; the pairs are shared (ipc_pairs.PairShare).

The two sides of a new crack coincide. They are offset by a gap of twice the distance of the barrier, so that no
barrier acts as an edge breaks; with the default distance there is room for a strain of about 1 %. Where that is not
enough, in a compressed body or for a single-node fragment without a deformation gradient, faces are retracted towards
their nodes until no barrier acts more strongly than before: contact gains no energy. Faces without room even so are
excluded. In later steps faces are extended and included again where nothing acts on them.

Equations: docs/theory.md#new-crack-faces.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, repeat
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..errors import InputError
from ..mesh.ghost_exchange import KeyLookup
from ..mesh.parallel import allgather
from ..mesh.split_surface.closed_surface import SplitSurface, build_split_surface
from ..mesh.split_surface.drawn_surface import DrawnSurface
from ..mesh.split_surface.entity_numbering import CRACK, EntityNumbering
from ..mesh.split_surface.fragment_surface import (
    PlanarPoints,
    build_fragment_surface,
    has_same_fragments,
    project_onto_fragments,
)
from ..mesh.split_surface.point_matching import match_points, point_identity
from ..mesh.split_surface.surface_map import SurfaceMap, make_surface_map
from ..meshes.data import format_point
from .ipc_pairs import IpcPairs, PairShare
from .pair_search import PairFilter, intersecting_pairs

if TYPE_CHECKING:
    from .mesh_obstacles import AllMeshPairs

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

# pairs of a body with itself, or with several obstacles
type SurfacePairs = IpcPairs | AllMeshPairs
# factors of arms, excluded elements, steps between two releases of faces and steps to the next
SurfaceSnapshot = tuple[Values, Ints, tuple[int, int]]


@dataclass(frozen=True)
class SurfacePolicy:
    """Tuned numbers of the surface of self-contact.

    Attributes:
        face_gap: gap between the sides of a new crack, in distances of the barrier.
        max_offset: part of the way to its nodes by which a crack face is offset at most, for slivers.
        factor: of an arm each time that it is shortened.
        min_arm: arm, in the full one, below which it is not shortened.
        gentle_rounds: rounds with `factor`, after which arms are shortened to `min_arm` at once. One face makes room
            for the next, and each round costs a search.
        max_pause: largest number of steps between two attempts to release faces.
        closed_pressure: pressure, in stiffnesses, of faces without room: that of a fifth of the barrier's distance.
        round_off: relative tolerance of pressures.
        exact_tangent: length of steps of Newton's method, in distances of the barrier, below which tangents of the
            first attempt are exact. CG finds no solution with indefinite ones: a torn loaf failed in all attempts and
            converged in the second one with positive ones.
        later_exact_tangent: the same in later attempts. With positive tangents to the end |r| fell by a third to a
            half in each iteration: a torn loaf took 26 iterations of the second attempt in place of 10.
        max_coupled_nodes: nodes in contact up to which their stiffness is kept apart from the matrix.
    """

    face_gap: float = 2.0
    max_offset: float = 0.4
    factor: float = 0.7
    min_arm: float = 0.2
    gentle_rounds: int = 4
    max_pause: int = 16
    closed_pressure: float = 10.0
    round_off: float = 1e-6
    exact_tangent: float = 1.0
    later_exact_tangent: float = 0.01
    max_coupled_nodes: int = 3000


SURFACE = SurfacePolicy()
NO_ELEMENTS: Ints = np.empty(0, np.int64)


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


class RetractableSurface:
    """Elements in contact, of which crack faces are retracted where there is no room for them.

    A surface that ranks share overrides what needs them: `pressures`, `_intersecting_faces` and the agreements.

    Attributes:
        elements: (m, d) points of the elements.
        point_map: map from nodes to points, with new faces retracted.
        pairs: pairs that may be in contact.
        closed_pressure: pressure, in stiffnesses, of faces without room.
    """

    closed_pressure: ClassVar[float] = SURFACE.closed_pressure
    pairs: SurfacePairs

    def __init__(self, elements: Ints, point_map: SurfaceMap, stiffness: float) -> None:
        """`stiffness`: of the law, Pa."""
        self.elements, self.point_map, self._stiffness = elements, point_map, stiffness
        is_copy = np.zeros(len(point_map.share), bool)
        is_copy[point_map.copies] = True
        self._crack_faces = np.flatnonzero(is_copy[elements].any(axis=1))
        self._excluded = NO_ELEMENTS
        self._release_interval = (1, 1)  # steps between two attempts to release faces, and to the next one

    def _build_pairs(self, elements: Ints) -> SurfacePairs:
        """Pairs of elements (k, d)."""
        raise NotImplementedError("a subclass builds pairs")

    def _exclude(self, elements: Ints) -> None:
        """Leave out these elements (k,) and no others."""
        if len(elements) or len(self._excluded):
            self.pairs = self._build_pairs(np.delete(self.elements, elements, axis=0))
        self._excluded = elements

    def _remaining(self) -> Ints:
        """Numbers (m,) of the elements that the pairs have."""
        return np.delete(np.arange(len(self.elements)), self._excluded)

    def remaining_elements(self) -> Ints:
        """(k, d) points of the elements that the pairs have."""
        return np.delete(self.elements, self._excluded, axis=0)

    def snapshot(self) -> SurfaceSnapshot:
        """Factors of arms, excluded elements, and steps to the next release of faces."""
        return self.point_map.share, self._excluded, self._release_interval

    # --- what ranks agree on, if they share the surface ---

    def pressures(self, u: Values) -> Values:
        """(n,) pressure on each point at displacements u (nodes, d), m; Pa (collective)."""
        return self.pairs.pressure(self.point_map(u))

    def _intersecting_faces(self, u: Values) -> Ints:
        """Crack faces that intersect at displacements u (nodes, d), m (collective)."""
        return np.intersect1d(self._crack_faces, self._remaining()[self.pairs.intersections(self.point_map(u))])

    def _common_share(self, share: Values) -> Values:
        """(n,) least factor of the arm of each point on all ranks (collective)."""
        return share

    def _common_flags(self, flags: Flags) -> Flags:
        """(n,) flags of points that are set on all ranks that have the point (collective)."""
        return flags

    def _on_any_rank(self, flag: bool) -> bool:
        """Whether a flag is set on any rank (collective)."""
        return flag

    # --- retraction and release of crack faces ---

    def _crowded_faces(self, u: Values, max_pressure: Values) -> Ints:
        """Crack faces with a pressure above `max_pressure` (n,), Pa, at a corner, or else those that intersect."""
        pressed = self._pressed_faces(u, max_pressure)
        return pressed if self._on_any_rank(len(pressed) > 0) else self._intersecting_faces(u)

    def _pressed_faces(self, u: Values, max_pressure: Values) -> Ints:
        above = self.pressures(u) > max_pressure * (1 + SURFACE.round_off)
        return self._crack_faces[above[self.elements[self._crack_faces]].any(axis=1)]

    def _shorten(self, u: Values, faces: Ints, factor: float) -> bool:
        """Shorten the arms of crack faces by a factor; whether any arm has changed."""
        share, points = self.point_map.share.copy(), np.unique(self.elements[faces])
        share[points] = np.maximum(factor * share[points], np.minimum(SURFACE.min_arm, share[points]))
        share = self._common_share(share)
        changed = self._on_any_rank(not np.array_equal(share, self.point_map.share))
        if changed:
            self.point_map = self.point_map.with_arm_share(share)
        return changed

    def _retract_faces(self, u: Values, load: Values) -> None:
        """Retract faces with a pressure above `load` (n,), Pa, and exclude those without room even so.

        The pairs are those of all elements.
        """
        start = self.point_map.share
        for factor in chain(repeat(SURFACE.factor, SURFACE.gentle_rounds), repeat(SURFACE.min_arm)):
            if not (
                self._shorten(u, self._pressed_faces(u, load), factor)
                or self._shorten(u, cut := self._intersecting_faces(u), factor)
            ):
                break
        max_pressure = np.maximum(load, self.closed_pressure * self._stiffness)
        without_room = np.union1d(self._pressed_faces(u, max_pressure), cut)
        self._exclude(without_room)
        if self._on_any_rank(len(without_room) > 0):
            # points of excluded faces alone keep their arms, so as not to come back smaller each time
            unused: Flags = np.ones(len(start), bool)
            unused[np.delete(self.elements, without_room, axis=0)] = False
            unused = self._common_flags(unused)
            self.point_map = self.point_map.with_arm_share(np.where(unused, start, self.point_map.share))

    def extend_faces(self, u: Values) -> None:
        """Extend retracted faces and include excluded ones where there is room, at displacements u (nodes, d), m.

        Not in the step after edges broke, and less often where there is no room: each attempt costs as much as two
        iterations of Newton's method (collective).
        """
        share, excluded, (pause, remaining) = self.snapshot()
        is_retracted, is_excluded = (self._on_any_rank(flag) for flag in (bool(np.any(share < 1)), len(excluded) > 0))
        if not is_retracted and not is_excluded:
            return
        if remaining:
            self._release_interval = pause, remaining - 1
            return
        load = self.pressures(u)
        if is_retracted:
            self._extend_retracted(u, load)
        if is_excluded:
            self._exclude(NO_ELEMENTS)
            self._retract_faces(u, load)
        same = np.array_equal(share, self.point_map.share) and np.array_equal(excluded, self._excluded)
        pause = 1 if self._on_any_rank(not same) else min(2 * pause, SURFACE.max_pause)
        self._release_interval = pause, pause - 1

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
            self.point_map = self.point_map.with_arm_share(self._common_share(share))
        if self._on_any_rank(len(self._crowded_faces(u, load)) > 0):
            self.point_map = self.point_map.with_arm_share(previous)


class SelfContactSurface(RetractableSurface):
    """Split surface and its pairs for a state of damage; every rank holds all of it.

    Attributes:
        split: the surface.
        rest_positions: (n, d) reference positions of its points with the gap of new cracks, m.
        face_gap: gap between the sides of a new crack, in distances of the barrier.
    """

    face_gap: ClassVar[float] = SURFACE.face_gap

    def __init__(
        self,
        skeleton: EntityNumbering,
        pattern: npt.NDArray[np.uint8],
        law: SelfContactLaw,
        u: Values,
        previous: SelfContactSurface | None,
        cut: Values | None = None,
        comm: MPI.Intracomm = MPI.COMM_SELF,
    ) -> None:
        """Build the surface (collective).

        Args:
            skeleton: of the mesh.
            pattern: (cells,) broken edges of each cell.
            law: contact law.
            u: (nodes, d) displacements, m.
            previous: surface until now.
            cut: (edges,) positions at which edges are cut, for contact between fragments; other edges are cut in the
                middle, which leaves both sides most room.
            comm: ranks that share the pairs.
        """
        self._skeleton, self._pattern, self._fragments_only = skeleton, pattern, law.fragments_only
        fragments = law.fragments_only
        split = build_fragment_surface(skeleton, pattern, cut) if fragments else build_split_surface(skeleton, pattern)
        self.split, self.rest_positions = split, offset_crack_faces(split, self.face_gap * law.distance)
        super().__init__(split.elements, make_surface_map(split, skeleton, pattern, self.rest_positions), law.stiffness)
        self._share = PairShare.by_slabs(comm, self.rest_positions, self.point_map.copies)
        self._parameters = {"distance": law.distance, "stiffness": law.stiffness, "friction": law.friction}
        self._nodes, self._size = len(skeleton.points), float(np.linalg.norm(np.ptp(skeleton.points, axis=0)))
        self.pairs = self._build_pairs(self.split.elements)
        if previous is None:
            self._check_apart()
        else:
            share, pressure = self._previous_state(previous, u)
            self.point_map = self.point_map.with_arm_share(share)
            self._retract_faces(u, pressure)

    def represents(self, pattern: npt.NDArray[np.uint8]) -> bool:
        """Whether the surface is also that of a pattern (cells,): most edges break within fragments."""
        if same := self._fragments_only and has_same_fragments(self._skeleton, pattern, self._pattern):
            self._pattern = pattern
        return same

    def place_faces(self, points: SurfaceMap, surface: DrawnSurface, u: Values) -> SurfaceMap:
        """Drawn points with those between fragments where they are here, at u (nodes, d), m (collective)."""
        return project_onto_fragments(
            points, surface, PlanarPoints(self._rows_by_key, self.point_map.rest, self.point_map(u))
        )

    @cached_property
    def _rows_by_key(self) -> KeyLookup:
        assert self.split.numbering is not None
        return KeyLookup(self.split.numbering.keys(np.arange(len(self._skeleton.points))))

    def _check_apart(self) -> None:
        """Raise InputError where a body at rest intersects or touches itself."""
        cut_pairs = self.pairs.intersections(self.split.points)
        refuse_intersections(self.split.points[self.split.elements[cut_pairs]].mean(axis=(1, 2)))

    def find_intersections(self, u: Values) -> tuple[Ints, Flags]:
        """(k, 2) elements that intersect, excluded ones too, at displacements u (nodes, d), m (collective).

        Also returns (k,) flags of pairs of which one is excluded.
        """
        x, share = self.point_map(u), self._share
        rank_pairs = intersecting_pairs(self.elements, PairFilter.of(len(x), is_owned=share.points), x)
        pairs = np.unique(np.concatenate(allgather(share.comm, rank_pairs)), axis=0)
        return pairs, np.asarray(np.isin(pairs, self._excluded).any(axis=1))

    def _build_pairs(self, elements: Ints) -> SurfacePairs:
        return IpcPairs(self.rest_positions, elements, **self._parameters, share=self._share, patch=None)

    def set_stiffness(self, stiffness: float) -> None:
        """Set the stiffness of the barrier, Pa."""
        self._parameters["stiffness"] = self._stiffness = stiffness
        self.pairs.set_stiffness(stiffness)

    def restore(self, memory: SurfaceSnapshot) -> None:
        """Restore a snapshot of this surface.

        Where edges have broken since, in an earlier pass of the step, the surface is another one and stays as it is.
        """
        share, excluded, interval = memory
        if len(share) != len(self.point_map.share):
            return
        self._release_interval = interval
        if share is not self.point_map.share:
            self.point_map = self.point_map.with_arm_share(share)
        if excluded is not self._excluded:
            self._exclude(excluded)

    def _identity(self) -> Values:
        return point_identity(self.split, self.point_map.copies, np.arange(self._nodes), self._size)

    def _previous_state(self, previous: SelfContactSurface, u: Values) -> tuple[Values, Values]:
        """(n,) factors of arms and pressures, Pa, of points on the previous surface; of new points 1 and 0."""
        # new points have full arms and no pressure that they may keep
        share, load = np.ones(len(self.split.points)), np.zeros(len(self.split.points))
        pressure, old = previous.pairs.pressure(previous.point_map(u)), previous.point_map.copies
        selected = np.flatnonzero((pressure[old] > 0) | (previous.point_map.share[old] < 1))
        rows = match_points(previous._identity()[selected], self._identity())
        points = self.point_map.copies[rows[rows >= 0]]
        share[points] = previous.point_map.share[old[selected]][rows >= 0]
        load[points] = pressure[old[selected]][rows >= 0]
        # nodes have kept their numbers, and come before copies
        nodes = min(old.min(initial=len(pressure)), self.point_map.copies.min(initial=len(load)))
        load[:nodes] = pressure[:nodes]
        return share, load


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
