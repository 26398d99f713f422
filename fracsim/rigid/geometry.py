"""The shapes of pieces: what they weigh and how they collide, from the split surface of the mesh that they are of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..mesh.split.build import split
from ..mesh.split.moments import Moments, moments
from ..mesh.split.skeleton import Skeleton
from ..meshes.data import MeshData
from .hulls import Solid, convex_parts

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Shapes:
    """Of n pieces, numbered by their lowest node.

    Attributes:
        names: (n,) lowest node of each.    moments: of what each encloses.    piece_of_node: (N,).
        parts: corners (m, 3) of the convex parts of each about its centre, m.
    """

    names: Ints
    moments: Moments
    piece_of_node: Ints
    parts: list[list[Values]]


class Geometry:
    """Of one mesh, on the rank that has it. What has not changed is not worked out again."""

    def __init__(self, mesh: MeshData) -> None:
        self.skeleton = Skeleton(mesh)
        self._edge = float(np.linalg.norm(np.diff(mesh.points[self.skeleton.edges], axis=1), axis=2).mean())
        self._kept: dict[int, tuple[int, list[Values]]] = {}  # by lowest node: how many nodes, and the hulls

    def shapes(self, pattern: npt.NDArray[np.uint8], cut: Values | None = None) -> Shapes:
        """Of patterns (C,) of broken edges, cut where `cut` (E,) says."""
        made = split(self.skeleton, pattern, cut)
        piece = made.piece_of_point[made.elements[:, 0]]
        of = moments(made.points, made.elements, piece, made.pieces)
        names, size = np.unique(made.piece_of_node, return_index=True)[1], np.bincount(made.piece_of_node)
        kept = {int(name): self._kept[int(name)] for name, count in zip(names, size, strict=True)
                if self._kept.get(int(name), (0,))[0] == count}  # fmt: skip
        for number in [number for number, name in enumerate(names) if int(name) not in kept]:
            hulls = convex_parts(Solid.of(made.points, made.elements[piece == number]), self._edge)
            kept[int(names[number])] = int(size[number]), [each - of.centre[number] for each in hulls]
        self._kept = kept
        return Shapes(names, of, made.piece_of_node, [kept[int(name)][1] for name in names])
