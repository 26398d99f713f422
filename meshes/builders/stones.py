"""Many small stones beside and above one another, each a body of its own: something to pour."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, permutations
from typing import Any, ClassVar

import numpy as np

from ..data import Indices, MeshData, Points
from ..parameters import positive, require, require_not_negative
from ..topology import boundary_facets, orient_cells

MOST = 100_000
ROOM = 1.05  # between the middles of neighbours, in diameters of the largest stone there may be


@dataclass(frozen=True)
class Stones:
    """`count` stones on a lattice around the z axis, filled layer by layer from z = 0 on; no two touch.

    Each is an icosahedron turned at random, its corners 1 - spread to 1 + spread radii from the middle, and a fan of 20
    tetrahedra: as few cells as a lump can have.

    Attributes:
        count: how many.    aside: stones in a layer along x and y.
        radius: mean distance of corners from the middle [m].    spread: of that distance, as a share.
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
        positive("stones", radius=self.radius)
        require_not_negative("stones", spread=self.spread)
        require(1 <= self.count <= MOST, f"stones: count = {self.count!r} must be from 1 to {MOST:,}.")
        within = min(self.aside) >= 1 and max(self.aside) <= MOST
        require(within, f"stones: aside = {list(self.aside)} must be two numbers of 1 or more, at most {MOST:,}.")
        require(self.spread <= 0.5, f"stones: spread = {self.spread!r} must be at most 0.5: corners would turn in.")
        require(self.seed >= 0, f"stones: seed = {self.seed!r} must be 0 or more.")

    def bounds(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        points = self._corners().reshape(-1, 3)
        return tuple(points.min(axis=0).tolist()), tuple(points.max(axis=0).tolist())

    def cells_estimate(self) -> int:
        return 20 * self.count

    def build(self) -> MeshData:
        corners = self._corners()
        first = np.column_stack([np.zeros(20, np.int64), 1 + _FACES])
        points = np.concatenate([self._middles()[:, None], corners], axis=1).reshape(-1, 3)
        item = 13 * np.arange(self.count)[:, None, None]
        cells, _ = orient_cells(points, (first + item).reshape(-1, 4))
        return MeshData(points, cells, {"surface": boundary_facets(cells)})

    def _middles(self) -> Points:
        """(count, 3) m."""
        step, (nx, ny) = 2 * ROOM * (1 + self.spread) * self.radius, self.aside
        number = np.arange(self.count)
        along = number % nx - (nx - 1) / 2, number // nx % ny - (ny - 1) / 2, number // (nx * ny) + 0.5
        return np.asarray(step * np.column_stack(along))

    def _corners(self) -> Points:
        """(count, 12, 3) m."""
        chance = np.random.default_rng(self.seed)
        turned, _ = np.linalg.qr(chance.normal(size=(self.count, 3, 3)))
        far = self.radius * (1 + self.spread * chance.uniform(-1, 1, (self.count, 12, 1)))
        return np.asarray(self._middles()[:, None] + far * (_CORNERS @ turned))


def _icosahedron() -> tuple[Points, Indices]:
    """12 corners on the unit sphere, and the 20 triples of them that are nearest to one another."""
    golden = (1 + 5**0.5) / 2
    signs: list[Any] = [(0.0, a, b * golden) for a in (-1, 1) for b in (-1, 1)]
    corners = np.array([np.roll(item, shift) for item in signs for shift in range(3)]) / np.hypot(1, golden)
    apart = np.linalg.norm(corners[:, None] - corners, axis=2)
    side = apart[apart > 0].min() * (1 + 1e-9)
    near = [
        triple for triple in combinations(range(12), 3) if all(apart[pair] <= side for pair in permutations(triple, 2))
    ]
    return corners, np.array(near, np.int64)


_CORNERS, _FACES = _icosahedron()
