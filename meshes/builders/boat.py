"""A rowing boat: an open shell."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ..data import Indices, MeshData, Points
from ..parameters import require, require_affordable, require_positive
from ..shell import extrude_shell


@dataclass(frozen=True)
class Boat:
    """A hull along x, open above, its gunwale at z = 0 and its keel below; round at both ends.

    With s = 2 x / length from -1 to 1, and t from 0 at the keel to 1 at the gunwale, the half beam is
    beam / 2 sqrt(1 - s^2) sqrt(t) at z = -depth (1 - 0.3 s^2) (1 - t).

    Attributes:
        length: [m].
        beam: greatest width [m].
        depth: of the keel amidships [m].
        thickness: of the planks [m].
        h: size of the triangles [m].

    Groups: inner, outer, rim.

    Raises:
        MeshError: a parameter is out of range, or it is too thick for its folds.
    """

    name: ClassVar[str] = "boat"
    groups: ClassVar[tuple[str, ...]] = ("inner", "outer", "rim")
    regions: ClassVar[tuple[str, ...]] = ()

    length: float = 3.0
    beam: float = 1.1
    depth: float = 0.45
    thickness: float = 0.04
    h: float = 0.2

    def __post_init__(self) -> None:
        require_positive(
            "boat", length=self.length, beam=self.beam, depth=self.depth, thickness=self.thickness, h=self.h
        )
        require(self.h <= self.beam / 2, f"boat: h = {self.h!r} must be at most half of beam = {self.beam!r}.")
        require(self.thickness < self.h, f"boat: thickness = {self.thickness!r} must be below h = {self.h!r}.")
        require_affordable("boat", self.h, self.cells_estimate())

    def bounds(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Lower and upper corner of the bounding box [m]."""
        points = self.build().points
        return tuple(points.min(axis=0).tolist()), tuple(points.max(axis=0).tolist())

    def _steps(self) -> tuple[int, int]:
        """Number of cells along the length, and from gunwale to gunwale."""
        across = 2 * round(np.hypot(self.beam / 2, self.depth) / self.h)
        return max(round(self.length / self.h), 4), max(across, 4)

    def cells_estimate(self) -> int:
        """Approximate number of cells."""
        along, across = self._steps()
        return 3 * (2 * (along - 2) * across + 2 * across)

    def build(self) -> MeshData:
        """The mesh."""
        return extrude_shell(*self._surface(), self.thickness, "boat")

    def _surface(self) -> tuple[Points, Indices]:
        """Points and triangles of the middle surface; bow and stern are one node each."""
        along, across = self._steps()
        s = np.linspace(-1, 1, along + 1)[1:-1, None]
        w = np.linspace(-1, 1, across + 1)[None]  # from one gunwale over the keel to the other
        t = w**2
        x, y = self.length / 2 * s + 0 * w, self.beam / 2 * np.sqrt(1 - s**2) * w
        z = -self.depth * (1 - 0.3 * s**2) * (1 - t)
        points = np.stack([x, y, z], axis=2).reshape(-1, 3)
        rows = np.arange(len(points)).reshape(along - 1, across + 1)
        a, b, c, d = rows[:-1, :-1], rows[1:, :-1], rows[1:, 1:], rows[:-1, 1:]
        quads = [np.stack([a, c, b], axis=2), np.stack([a, d, c], axis=2)]
        stern, bow = len(points), len(points) + 1
        ends = np.array([[-self.length / 2, 0.0, 0.0], [self.length / 2, 0.0, 0.0]])
        fans = [
            np.stack([np.full(across, stern), rows[0, 1:], rows[0, :-1]], axis=1),
            np.stack([np.full(across, bow), rows[-1, :-1], rows[-1, 1:]], axis=1),
        ]
        return np.concatenate([points, ends]), np.concatenate([*(halves.reshape(-1, 3) for halves in quads), *fans])
