"""The surface of a body that touches itself, with room for walls that come to light where it is crowded (rank 0).

The sides of a new crack recede (crack_wall_offset); where that is not enough, in a body that is squeezed or for a crumb
that has lost its deformation gradient, walls are drawn in towards their nodes until no barrier presses harder on them
than before the edge broke: no energy comes from nothing. What is crowded even so is left out. With every step walls go
out again, and those left out come back, where nothing acts on them.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain, repeat
from typing import ClassVar

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix, kron

from ..errors import InputError
from ..mechanics.extra_couplings import stiff_directions
from ..mesh.split_surface.closed_surface import build_split_surface
from ..mesh.split_surface.entity_numbering import EntityNumbering
from ..mesh.split_surface.fragment_surface import build_fragment_surface, has_same_fragments, project_onto_fragments
from ..mesh.split_surface.point_matching import match_points, point_identity
from ..mesh.split_surface.surface_map import SurfaceMap, whole
from ..meshes.text import format_point
from .crack_wall_offset import offset_crack_faces
from .ipc_pairs import IpcPairs, max_length

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

Memory = tuple[Values, Ints, tuple[int, int]]

GAP = 2.0  # between the sides of a new crack, in distances of the barrier (crack_wall_offset)
IN, LEAST = 0.7, 0.2  # what is left of an arm each time that it is shortened, and in all
GENTLY = 4  # times, and then at once: in a crowd one wall makes room for the next, and each look costs
LONGEST_PAUSE = 16  # steps
NEAR = 10.0  # pressure, in stiffnesses, of walls as good as closed: at a fifth of the barrier's distance
ROUND_OFF = 1e-6  # of a pressure
# of the barrier's distance: steps below it are taken with the exact tangent. Without its negative eigenvalues Newton's
# method gains a digit in two iterations to the end; with them CG may find none. In a first attempt, and in others
NEAR_END = 1.0, 0.1


@dataclass(frozen=True)
class SelfContactLaw:
    """Barrier from `distance` m on with `stiffness` Pa; Coulomb's `friction`, sticking below `creep` m/s, or below the
    share `of_speed` of the speed of the body, where that is more. `pieces`: without walls inside a piece, and without
    crumbs (split.solid). `straight`: quadratic cells are touched by their corners alone, as walls of cracks are."""

    distance: float
    stiffness: float
    friction: float
    sticking_speed: float
    sticking_speed_ratio: float = 0.0
    fragments_only: bool = False
    corners_only: bool = False


class SelfContactSurface:
    """The split surface and its pairs for a state of damage.

    Attributes:
        made: the surface.    at: where its points are, new walls drawn back.    pairs: what may touch.
        gap: between the sides of a new crack, in distances of the barrier.
        close: pressure, in stiffnesses, of walls as good as closed.
        at_once: whether candidates are looked for on the ways of all walls once some are drawn in: fewer looks, and
            more candidates after.
    """

    face_gap: ClassVar[float] = GAP
    closed_pressure: ClassVar[float] = NEAR
    search_all_faces: ClassVar[bool] = False

    def __init__(
        self,
        skeleton: EntityNumbering,
        pattern: npt.NDArray[np.uint8],
        law: SelfContactLaw,
        u: Values,
        before: SelfContactSurface | None,
        cut: Values | None = None,
    ) -> None:
        """`u`: (nodes, d) where the body is, m; `before`: the surface until now. `cut`: (E,) where edges are cut, for
        contact between pieces (split.build); all others are cut in the middle, which leaves both sides most room."""
        self._skeleton, self._pattern, self._fragments_only = skeleton, pattern, law.fragments_only
        if law.fragments_only:
            self.split = build_fragment_surface(skeleton, pattern, cut)
        else:
            self.split = build_split_surface(skeleton, pattern)
        self._rest_positions = offset_crack_faces(self.split, self.face_gap * law.distance)
        self.point_map = whole(self.split, skeleton, pattern, self._rest_positions)
        self._parameters = {"distance": law.distance, "stiffness": law.stiffness, "friction": law.friction}
        copies = np.zeros(len(self._rest_positions), bool)
        copies[self.point_map.copies] = True
        self._crack_faces = np.flatnonzero(copies[self.split.elements].any(axis=1))
        self._nodes, self._size = len(skeleton.points), float(np.linalg.norm(np.ptp(skeleton.points, axis=0)))
        self.pairs = self._build_all_pairs()
        self._excluded: Ints = np.empty(0, np.int64)
        self._release_interval = (1, 1)  # steps between two looks for room, and to the next
        if before is None:
            self._check_apart()
        else:
            share, load = self._previous_state(before, u)
            self.point_map = self.point_map.with_arm_share(share)
            self._retract_faces(u, load)

    def represents(self, pattern: npt.NDArray[np.uint8]) -> bool:
        """Whether it is the surface of these patterns (C,) too: most edges break within pieces."""
        if same := self._fragments_only and has_same_fragments(self._skeleton, pattern, self._pattern):
            self._pattern = pattern
        return same

    def place_faces(self, at: SurfaceMap) -> SurfaceMap:
        """All walls of the body, those between pieces where they are here."""
        return project_onto_fragments(at, self._skeleton, self._pattern, self.point_map)

    def _check_apart(self) -> None:
        """InputError where a body at rest cuts or touches itself."""
        if len(found := self.pairs.intersections(self.split.points)):
            where = format_point(self.split.points[self.split.elements[found[0]]].mean(axis=(0, 1)))
            raise InputError(
                f"[contact]: {len(found)} pairs of surface elements cut or touch each other at the start, the first "
                f"near {where}; move the bodies apart"
            )

    def _build_all_pairs(self) -> IpcPairs:
        return self._build_pairs(self.split.elements)

    def _build_pairs(self, elements: Ints) -> IpcPairs:
        return IpcPairs(self._rest_positions, elements, **self._parameters)

    def _exclude(self, elements: Ints) -> None:
        """Pairs without these elements (k,)."""
        if len(elements):
            self.pairs = self._build_pairs(np.delete(self.split.elements, elements, axis=0))
        self._excluded = elements

    def set_stiffness(self, stiffness: float) -> None:
        """The barrier has this stiffness, Pa, from here on."""
        self._parameters["stiffness"] = stiffness
        self.pairs.set_stiffness(stiffness)

    def snapshot(self) -> Memory:
        """Shares of arms, elements that are left out, and when room is looked for again."""
        return self.point_map.share, self._excluded, self._release_interval

    def restore(self, memory: Memory) -> None:
        """Be again what `memory` gave of this surface; where edges have broken since, in an earlier pass of the step,
        it is another one and stays as those left it."""
        share, out, pause = memory
        if len(share) != len(self.point_map.share):
            return
        self._release_interval = pause
        if share is not self.point_map.share:
            self.point_map = self.point_map.with_arm_share(share)
        if out is not self._excluded:
            self.pairs = self._build_all_pairs()
            self._exclude(out)

    # --- what is crowded ---

    def _identity(self, points: Ints | None = None) -> Values:
        return point_identity(
            self.split, self.point_map.copies if points is None else points, np.arange(self._nodes), self._size
        )

    def _previous_state(self, before: SelfContactSurface, u: Values) -> tuple[Values, Values]:
        """(n,) shares and pressures, Pa, that points had before; of new ones 1 and 0. Nodes have kept their numbers."""
        share, load = np.ones(len(self.split.points)), np.zeros(len(self.split.points))
        pressure, old = before.pairs.pressure(before.point_map(u)), before.point_map.copies
        which = np.flatnonzero((pressure[old] > 0) | (before.point_map.share[old] < 1))
        again = match_points(before._identity()[which], self._identity())
        at = self.point_map.copies[again[again >= 0]]
        share[at], load[at] = before.point_map.share[old[which]][again >= 0], pressure[old[which]][again >= 0]
        nodes = min(old.min(initial=len(pressure)), self.point_map.copies.min(initial=len(load)))
        load[:nodes] = pressure[:nodes]
        return share, load

    def _crowded(self, u: Values, most: Values) -> Ints:
        """Walls that are pressed harder than `most` (n,) Pa at a corner, or else those that cut something."""
        pressed = self._pressed(u, most)
        return pressed if len(pressed) else self._cutting(u)

    def _pressed(self, u: Values, most: Values) -> Ints:
        over = self.pairs.pressure(self.point_map(u)) > most * (1 + ROUND_OFF)
        return self._crack_faces[over[self.split.elements[self._crack_faces]].any(axis=1)]

    def _cutting(self, u: Values) -> Ints:
        return np.intersect1d(self._crack_faces, self.pairs.intersections(self.point_map(u)))

    def _shorten(self, u: Values, walls: Ints, left: float) -> bool:
        """Whether the arms of any of these walls can be shortened, which they are: to that share of what they were."""
        share, tight = self.point_map.share.copy(), np.unique(self.split.elements[walls])
        share[tight] = np.maximum(left * share[tight], np.minimum(LEAST, share[tight]))
        changed = not np.array_equal(share, self.point_map.share)
        if changed:
            may = np.unique(self.split.elements[self._crack_faces]) if self.search_all_faces else tight
            end = (x := self.point_map(u)).copy()
            end[may] = self.point_map.evaluate_points(u, may, np.minimum(LEAST, self.point_map.share[may]))
            self.pairs.search_along(x, end)  # once for all the shares that follow
            self.point_map = self.point_map.with_arm_share(share)
        return changed

    def _retract_faces(self, u: Values, load: Values) -> None:
        """Draw in walls that are pressed harder than with `load` (n,) Pa, and leave out what is as good as closed even
        so. Pairs are those of all elements."""
        start = self.point_map.share
        for left in chain(repeat(IN, GENTLY), repeat(LEAST)):
            if not (self._shorten(u, self._pressed(u, load), left) or self._shorten(u, cut := self._cutting(u), left)):
                break
        crowded = np.union1d(
            self._pressed(u, np.maximum(load, self.closed_pressure * self._parameters["stiffness"])), cut
        )
        self._exclude(crowded)
        if len(crowded):  # what is out is to come back as it was, not smaller each time
            gone = np.ones(len(start), bool)
            gone[np.delete(self.split.elements, crowded, axis=0)] = False
            self.point_map = self.point_map.with_arm_share(np.where(gone, start, self.point_map.share))

    def extend_faces(self, u: Values) -> None:
        """A step begins at u (nodes, d), m: what was drawn in or left out comes back where there is room.

        Not in a step after one in which edges broke, and ever more seldom where there is none: each look costs as much
        as two of Newton's iterations.
        """
        share, out, (pause, waits) = self.snapshot()
        if np.all(share == 1) and not len(out):
            return
        if waits:
            self._release_interval = pause, waits - 1
            return
        load = self.pairs.pressure(self.point_map(u))
        if np.any(share < 1):
            self._extend_retracted(u, load)
        if len(out):
            self.pairs = self._build_all_pairs()
            self._retract_faces(u, load)
        stays = np.array_equal(share, self.point_map.share) and np.array_equal(out, self._excluded)
        pause = min(2 * pause, LONGEST_PAUSE) if stays else 1
        self._release_interval = pause, pause - 1

    def _extend_retracted(self, u: Values, load: Values) -> None:
        before = self.point_map.share
        self.point_map = self.point_map.with_arm_share(np.minimum(before / IN, 1.0))
        for _ in range(2):  # what stays in may be in the way of its neighbours
            crowded = self._crowded(u, load)
            if not len(crowded):
                return
            share, tight = self.point_map.share.copy(), np.unique(self.split.elements[crowded])
            share[tight] = before[tight]
            self.point_map = self.point_map.with_arm_share(share)
        if len(self._crowded(u, load)):
            self.point_map = self.point_map.with_arm_share(before)

    def is_near_tangent(self, x: Values, other: Values | None, *, again: bool) -> bool:
        """Whether x (n, d) is so near to the place of the last tangent that Newton's method is at its end; `again`: it
        has failed before."""
        return other is not None and max_length(x - other) < NEAR_END[again] * self._parameters["distance"]

    # --- from nodes to points and back ---

    def nodal_forces(self, forces: Values) -> Values:
        """(nodes, d) of forces (n, d) at the points, N."""
        return np.asarray(self.point_map.weights.T @ forces)

    def nodal_stiffness(self, H: csr_matrix, least: float) -> tuple[csr_matrix, tuple[Values, Values] | None]:
        """(nodes d, nodes d) of (n d, n d), N/m; and where it is little, (nodes, d m) directions stiffer than `least`
        N/m with their (m,) stiffness."""
        d = self._rest_positions.shape[1]
        points = np.unique(np.flatnonzero(np.diff(H.indptr)) // d)  # few, mostly
        rows = (d * points[:, None] + np.arange(d)).reshape(-1)
        W, H = kron(self.point_map.weights[points], np.eye(d), format="csr"), H[rows][:, rows]
        K = (W.T @ H @ W).tocsr()
        if (found := stiff_directions(H, least)) is None:
            return K, None
        directions, stiffness = found
        return K, ((W.T @ directions).toarray().reshape(self._nodes, d * len(stiffness)), stiffness)
