"""Many small stones on a lattice, each a body of its own."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, permutations
from typing import Any, ClassVar

import numpy as np

from ..data import Indices, MeshData, Points
from ..parameters import require, require_not_negative, require_positive
from ..topology import boundary_facets, orient_cells

MAX_STONES = 100_000  # also of a layer along each axis


@dataclass(frozen=True)
class Stones:
    """Stones on a lattice around the z axis, layer by layer from z = 0 on; no two touch.

    Each is a randomly rotated icosahedron of 20 tetrahedra, its corners 1 - spread to 1 + spread radii from the centre.

    Attributes:
        count: of stones.
        aside: stones of a layer along x and y.
        radius: mean distance of corners from the centre [m].
        spread: variation of that distance, as a share of it.
        seed: of the random numbers.

    Groups: surface.

    Raises:
        MeshError: a parameter is out of range.
    """

    name: ClassVar[str] = "stones"
    groups: ClassVar[tuple[str, ...]] = ("surface",)
    regions: ClassVar[tuple[str, ...]] = ()

    count: int = 50
    aside: tuple[int, int] = (4, 4)
    radius: float = 0.015
    spread: float = 0.25
    seed: int = 1

    def __post_init__(self) -> None:
        require_positive("stones", radius=self.radius)
        require_not_negative("stones", spread=self.spread)
        require(1 <= self.count <= MAX_STONES, f"stones: count = {self.count!r} must be from 1 to {MAX_STONES:,}.")
        within = min(self.aside) >= 1 and max(self.aside) <= MAX_STONES
        require(within, f"stones: aside = {list(self.aside)} must be two numbers of 1 or more, at most {MAX_STONES:,}.")
        require(self.spread <= 0.5, f"stones: spread = {self.spread!r} must be at most 0.5: corners would turn in.")
        require(self.seed >= 0, f"stones: seed = {self.seed!r} must be 0 or more.")

    def bounds(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Lower and upper corner of the bounding box [m]."""
        points = self._corners().reshape(-1, 3)
        return tuple(points.min(axis=0).tolist()), tuple(points.max(axis=0).tolist())

    def cells_estimate(self) -> int:
        """Approximate number of cells."""
        return 20 * self.count

    def build(self) -> MeshData:
        """The mesh."""
        corners = self._corners()
        # nodes of the first stone: its centre and the corners of a face
        first = np.column_stack([np.zeros(20, np.int64), 1 + _FACES])
        points = np.concatenate([self._centres()[:, None], corners], axis=1).reshape(-1, 3)
        offset = 13 * np.arange(self.count)[:, None, None]  # centre and 12 corners
        cells, _ = orient_cells(points, (first + offset).reshape(-1, 4))
        return MeshData(points, cells, {"surface": boundary_facets(cells)})

    def _centres(self) -> Points:
        """(count, 3) centres [m]."""
        # 5 % more than the diameter of the largest possible stone
        step, (nx, ny) = 2 * 1.05 * (1 + self.spread) * self.radius, self.aside
        number = np.arange(self.count)
        along = number % nx - (nx - 1) / 2, number // nx % ny - (ny - 1) / 2, number // (nx * ny) + 0.5
        return np.asarray(step * np.column_stack(along))

    def _corners(self) -> Points:
        """(count, 12, 3) corners [m]."""
        random = np.random.default_rng(self.seed)
        rotations, _ = np.linalg.qr(random.normal(size=(self.count, 3, 3)))
        distance = self.radius * (1 + self.spread * random.uniform(-1, 1, (self.count, 12, 1)))
        return np.asarray(self._centres()[:, None] + distance * (_CORNERS @ rotations))


def _icosahedron() -> tuple[Points, Indices]:
    """Corners (12, 3) on the unit sphere, and faces (20, 3)."""
    golden = (1 + 5**0.5) / 2
    rectangle: list[Any] = [(0.0, a, b * golden) for a in (-1, 1) for b in (-1, 1)]
    corners = np.array([np.roll(corner, shift) for corner in rectangle for shift in range(3)]) / np.hypot(1, golden)
    distance = np.linalg.norm(corners[:, None] - corners, axis=2)
    side = distance[distance > 0].min() * (1 + 1e-9)
    faces = [
        triple
        for triple in combinations(range(12), 3)
        if all(distance[pair] <= side for pair in permutations(triple, 2))
    ]
    return corners, np.array(faces, np.int64)


_CORNERS, _FACES = _icosahedron()
