"""The shapes of pieces: what they weigh and how they collide, from the split surface of the mesh that they are of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..mesh.split_surface.closed_surface import SplitSurface, build_split_surface
from ..mesh.split_surface.entity_numbering import EntityNumbering
from ..mesh.split_surface.polyhedron_moments import PolyhedronMoments, moments
from ..meshes.data import MeshData
from .convex_decomposition import Solid, convex_parts, outermost
from .core_contact import Core, Cores
from .instance_placement import Poses
from .shell_clusters import clustered_parts

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Patterns = npt.NDArray[np.uint8]
_Kept = tuple[int, list[Values], Values]


@dataclass(frozen=True)
class Shapes:
    """Of n pieces, numbered by their lowest node.

    Attributes:
        names: (n,) lowest node of each.    moments: of what each encloses.    piece_of_node: (N,).
        parts: corners (m, 3) of the convex parts of each about its centre, in the axes of the mesh, m; copies that are
        whole share theirs.    turn: (n, 3, 3) from these axes to those of the body at rest.
        outer: (k, 3) the outermost points of each, likewise.    cores: of them, None where none has broken.
    """

    names: Ints
    moments: PolyhedronMoments
    piece_of_node: Ints
    parts: list[list[Values]]
    turn: Values
    outer: list[Values]
    cores: Cores | None = None


@dataclass(frozen=True)
class _Copy:
    """A copy as it was last broken or dented, in the axes of the mesh, its nodes, at `points`, counted from 0."""

    points: Values
    pattern: Patterns
    names: Ints
    of: PolyhedronMoments
    piece_of_node: Ints
    parts: list[list[Values]]
    outer: list[Values]
    core: Core


class Geometry:
    """Of copies of one mesh, on the rank that has it. What has not changed is not worked out again.

    Attributes:
        mean_edge: of the mesh, m.
    """

    def __init__(self, mesh: MeshData, poses: Poses | None = None) -> None:
        """`poses`: where the copies are at rest; None: one, where the mesh has it."""
        self.skeleton, self.poses = EntityNumbering(mesh), poses or Poses.at_rest(1)
        self._shell = mesh.shell
        self.mean_edge = float(np.linalg.norm(np.diff(mesh.points[self.skeleton.edges], axis=1), axis=2).mean())
        # of each copy, by lowest node: the key of its surface to the last digit, or a restart would come to other hulls
        # (cells that others share change as these break); convex parts and outermost points
        self._hulls: dict[int, dict[int, _Kept]] = {}
        self._whole = self._copy(np.zeros(len(mesh.cells), np.uint8), None, 0, mesh.points)
        self._placed = [self._at(number, self._whole) for number in range(len(self.poses))]
        self._known: dict[int, _Copy] = {}

    def shapes(
        self, damage: Mapping[int, tuple[Patterns, Values | None]], points: Mapping[int, Values] | None = None
    ) -> Shapes:
        """Of copies by their numbers: patterns (C,) of broken edges, cut where (E,), and `points` (N, 3) where nodes
        are, m; all others are whole, and as the mesh is."""
        points, whole = points or {}, (self._whole.pattern, None)
        for number in sorted({*damage, *points}):
            (pattern, cut), at = damage.get(number, whole), points.get(number, self._whole.points)
            known = self._known.get(number, self._whole)
            if at is not known.points:
                self._hulls.pop(number, None)
            if at is not known.points or not np.array_equal(known.pattern, pattern):
                self._known[number] = known = self._copy(pattern.copy(), cut, number, at)
                self._placed[number] = self._at(number, known)
        pieces = np.cumsum([0, *(len(each.names) for each in self._placed)])
        of = PolyhedronMoments(*(np.concatenate([getattr(each.moments, name) for each in self._placed])
                       for name in ("volume", "centre", "second")))  # fmt: skip
        piece = [each.piece_of_node + first for each, first in zip(self._placed, pieces, strict=False)]
        parts = [part for each in self._placed for part in each.parts]
        outer = [each for placed in self._placed for each in placed.outer]
        names, turn = (np.concatenate([getattr(each, name) for each in self._placed]) for name in ("names", "turn"))
        return Shapes(names, of, np.concatenate(piece), parts, turn, outer, self._cores(turn))

    def _cores(self, turn: Values) -> Cores | None:
        """Of all pieces, turned by (n, 3, 3)."""
        every = [self._known.get(number, self._whole) for number in range(len(self.poses))]
        if not any(len(each.core.faces) for each in every):
            return None
        centre = np.concatenate([each.of.centre for each in every])
        pieces = [len(each.names) for each in every]
        return Cores([each.core for each in every], pieces, centre, turn, self.mean_edge)

    def _copy(self, pattern: Patterns, cut: Values | None, number: int, at: Values) -> _Copy:
        """A copy with patterns (C,), and nodes at places (N, 3)."""
        made = build_split_surface(self.skeleton.moved(at), pattern, cut)
        piece = made.point_fragment[made.elements[:, 0]]
        of = moments(made.points, made.elements, piece, made.fragment_count)
        names = np.unique(made.node_fragment, return_index=True)[1]
        solids = _solids(made, piece)
        before = self._hulls.get(number, {})
        same = [before.get(name) for name in map(int, names)]
        new = [each for each, kept in enumerate(same) if kept is None or kept[0] != solids[each].key]
        for each, hulls in zip(new, self._parts(made, piece, solids, np.array(new, np.int64)), strict=True):
            far = outermost(solids[each].points if self._in_clusters(made) else np.concatenate(hulls))
            same[each] = solids[each].key, [corners - of.centre[each] for corners in hulls], far - of.centre[each]
        found = [kept for kept in same if kept is not None]
        self._hulls[number] = dict(zip(map(int, names), found, strict=True))
        parts, outer = [kept[1] for kept in found], [kept[2] for kept in found]
        drawn = made.fragment_count > 1 and not self._in_clusters(made)
        core = Core.of_split(made, self.skeleton) if drawn else Core.none()
        return _Copy(at, pattern, names, of, made.node_fragment, parts, outer, core)

    def _parts(self, made: SplitSurface, piece: Ints, solids: list[Solid], chosen: Ints) -> list[list[Values]]:
        """Convex parts of chosen (k,) pieces of a split surface, whose elements are of pieces (m,)."""
        if not self._in_clusters(made):
            return [convex_parts(solids[each].filled, self.mean_edge) for each in chosen]
        place = np.full(made.fragment_count, -1)
        place[chosen] = np.arange(len(chosen))
        of = place[piece]
        assert self._shell is not None
        mine, thickness = np.flatnonzero(of >= 0), self._shell.thickness
        return clustered_parts(made.points, made.elements[mine], of[mine], len(chosen), thickness, self.mean_edge)

    def _in_clusters(self, made: SplitSurface) -> bool:
        """Whether parts are clusters, of few corners: whole a shell may be closed, and its parts are for all copies."""
        return self._shell is not None and made.fragment_count > 1

    def _at(self, number: int, copy: _Copy) -> Shapes:
        """A copy where it is at rest."""
        turn, place = self.poses.turn[number], self.poses.place[number]
        of = PolyhedronMoments(copy.of.volume, copy.of.centre @ turn.T + place, turn @ copy.of.second @ turn.T)
        names, turns = copy.names + number * len(copy.piece_of_node), np.tile(turn, (len(copy.names), 1, 1))
        return Shapes(names, of, copy.piece_of_node, copy.parts, turns, copy.outer)


def _solids(made: SplitSurface, piece: Ints) -> list[Solid]:
    """What each piece of a split surface, whose elements are of pieces (m,), encloses."""
    order = np.argsort(piece, kind="stable")
    ends = np.cumsum(np.bincount(piece, minlength=made.fragment_count))[:-1]
    return [Solid.of(made.points, elements) for elements in np.split(made.elements[order], ends)]
