"""The surface of copies of one mesh: that of a copy is built again where its own edges broke."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import numpy.typing as npt

from ...mesh.split_surface.closed_surface import SplitSurface, build_split_surface
from ...mesh.split_surface.entity_numbering import EntityNumbering
from ...mesh.split_surface.surface_motion import PointParents
from ...meshes.data import MeshData
from ...meshes.topology import signed_measures
from ...rigid.instance_placement import Poses
from .body_surface import Surface
from .fragment_table import PieceNames, sums, volumes

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Patterns = npt.NDArray[np.integer]


class SurfaceOfCopies(Surface):
    """See Surface; numbers of nodes, cells, edges and pieces are those of the mesh of all copies.

    Attributes:
        skeleton: of one copy.
    """

    def __init__(self, mesh: MeshData, poses: Poses, density: float) -> None:
        """`poses`: where the copies are at rest; `density`: kg/m^3."""
        self.skeleton, self._poses, self._names, self.builds = EntityNumbering(mesh), poses, PieceNames(), 0
        count = len(poses)
        share = np.repeat(density * signed_measures(mesh.points, mesh.cells) / (mesh.dim + 1), mesh.dim + 1)
        self.mass = np.tile(sums(mesh.cells.ravel(), share, len(mesh.points)), count)
        self._pattern: Patterns = np.zeros(count * len(mesh.cells), np.uint8)
        self._parts = count * [build_split_surface(self.skeleton, self._pattern[: len(mesh.cells)])]
        self._of = self._pattern.reshape(count, -1).copy()  # of the parts
        self._dented: dict[int, Values] = {}
        self._build(None)

    def reshape(self, points: Mapping[int, Values]) -> None:
        """Nodes of copies, by their numbers, are at places (N, 3) at rest, m; of all others where the mesh has them."""
        new = [number for number, each in points.items() if each is not self._dented.get(number)]
        for number in new:
            self._dented[number] = points[number]
            self._parts[number] = build_split_surface(self.skeleton.moved(points[number]), self._of[number])
        if new:
            self._join()

    @property
    def edge_count(self) -> int:
        """Of all copies."""
        return len(self._poses) * len(self.skeleton.edges)

    def broken_edges(self, pattern: Patterns) -> npt.NDArray[np.bool_]:
        """(E,) which edges the patterns (C,) of the cells call broken."""
        broken = np.zeros((len(self._poses), len(self.skeleton.edges)), bool)
        each = pattern.reshape(len(self._poses), -1)
        for number in np.flatnonzero(each.any(axis=1)):
            broken[number] = self.skeleton.broken_edges(each[number])
        return broken.reshape(-1)

    def replay(self, broken_at: Values, times: Iterable[float]) -> None:
        """See Surface."""
        for t in times:
            broken = (broken_at <= t * (1 + 1e-12)).reshape(len(self._poses), -1)
            found = [self.skeleton.pieces(each) for each in broken]
            first = np.cumsum([0, *(count for count, _ in found)])
            piece = np.concatenate([each + start for (_, each), start in zip(found, first, strict=False)])
            self._names.update(int(first[-1]), piece, self.mass)

    def _build(self, cut: Values | None) -> None:
        pattern = self._pattern.reshape(len(self._poses), -1)
        cuts = None if cut is None else cut.reshape(len(self._poses), -1)
        for number in np.flatnonzero((pattern != self._of).any(axis=1)):
            self._parts[number] = build_split_surface(
                self.skeleton, pattern[number], None if cuts is None else cuts[number]
            )
            self._of[number] = pattern[number]
        self._join()

    def _join(self) -> None:
        self.split = made = joined(self._parts, self.skeleton, self._poses)
        self.names = self._names.update(made.fragment_count, made.node_fragment, self.mass)
        piece = made.point_fragment
        self.volume = volumes(made.points, made.elements, piece[made.elements[:, 0]], made.fragment_count)
        self._piece = self.names[piece]
        self.builds += 1


def joined(parts: Sequence[SplitSurface], skeleton: EntityNumbering, poses: Poses) -> SplitSurface:
    """One surface of those of all copies, where they are at rest."""

    def numbers(name: str, step: int | Sequence[int]) -> Ints:
        first = np.cumsum([0, *(len(parts) * [step] if isinstance(step, int) else step)])
        each = [getattr(part, name) for part in parts]
        return np.concatenate(
            [np.where(rows >= 0, rows + start, rows) for rows, start in zip(each, first, strict=False)]
        )

    points, nodes = [len(part.points) for part in parts], len(skeleton.points)
    places = [part.points @ turn.T + place for part, turn, place in zip(parts, poses.turn, poses.place, strict=True)]
    parents = [part.parents.parents + nodes * k for k, part in enumerate(parts)]
    starts = np.cumsum([0, *(len(each) for each in parents)])
    start = [part.parents.start[:-1] + first for part, first in zip(parts, starts, strict=False)]
    arm = [part.parents.arm @ turn.T for part, turn in zip(parts, poses.turn, strict=True)]
    follow = PointParents(np.append(np.concatenate(start), starts[-1]), np.concatenate(parents), np.concatenate(arm),
                    nodes * len(parts))  # fmt: skip
    pieces = [part.fragment_count for part in parts]
    return SplitSurface(
        np.concatenate(places), follow, numbers("elements", points), numbers("cell", len(skeleton.cells)),
        numbers("edge", len(skeleton.edges)), np.concatenate([part.origin for part in parts]),
        np.empty((0, 3), np.int64), np.empty(0, np.int64), np.concatenate([part.broken for part in parts]),
        sum(pieces), numbers("piece_of_node", pieces),
    )  # fmt: skip
