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
        parts: corners (m, 3) of the convex parts of each, at rest, m.
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
        # by lowest node: nodes, triangles and volume, and the hulls; cells that others share change as these break
        self._kept: dict[int, tuple[tuple[int, int, float], list[Values]]] = {}

    def shapes(self, pattern: npt.NDArray[np.uint8], cut: Values | None = None) -> Shapes:
        """Of patterns (C,) of broken edges, cut where `cut` (E,) says."""
        made = split(self.skeleton, pattern, cut)
        piece = made.piece_of_point[made.elements[:, 0]]
        of = moments(made.points, made.elements, piece, made.pieces)
        names, size = np.unique(made.piece_of_node, return_index=True)[1], np.bincount(made.piece_of_node)
        kept: dict[int, tuple[tuple[int, int, float], list[Values]]] = {}
        elements = np.bincount(piece, minlength=made.pieces)
        for number, name in enumerate(map(int, names)):
            key = int(size[number]), int(elements[number]), float(f"{of.volume[number]:.9e}")
            same = self._kept.get(name)
            if same is None or same[0] != key:
                same = key, convex_parts(Solid.of(made.points, made.elements[piece == number]), self._edge)
            kept[name] = same
        self._kept = kept
        return Shapes(names, of, made.piece_of_node, [kept[int(name)][1] for name in names])
