"""A rectangle or a box."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations
from typing import Any, ClassVar, Literal

import numpy as np

from ..data import Indices, MeshData, MeshError, Points
from ..gmsh_session import mesh_with_gmsh
from ..parameters import is_length, require, require_affordable, require_one_of, require_positive
from ..sizing import SizeField, estimate_cells_in_box
from ..topology import boundary_facets, facet_groups_on_planes


@dataclass(frozen=True)
class Box:
    """A rectangle (two sizes) or a box (three sizes), its faces normal to the axes.

    Attributes:
        size: side lengths [m] along x, y(, z).
        origin: the corner with the least coordinates [m]; zeros where left out.
        h: cell size [m]. Structured: each side has round(size / h) equal steps, at least one.
        pattern: "structured": a lattice, each square cut into 2 triangles or each cube into 6 tetrahedra by Kuhn's
            subdivision; "unstructured": random points, without preferred directions.
        seed: of the random points, where there are any: 1, 2, ... are different meshes.

    Groups: left, right (least and greatest x), bottom, top (y in 2D, z in 3D), and in 3D front, back (least and
    greatest y).

    Raises:
        MeshError: a parameter is out of range.
    """

    name: ClassVar[str] = "box"
    regions: ClassVar[tuple[str, ...]] = ()

    size: tuple[float, ...] = (1.0, 0.25, 0.25)
    h: float = 0.05
    origin: tuple[float, ...] = ()
    pattern: Literal["structured", "unstructured"] = "structured"
    seed: int = 1

    def __post_init__(self) -> None:
        if len(self.size) not in (2, 3):
            raise MeshError(f"box: size = {list(self.size)} must have two entries (triangles) or three (tetrahedra).")
        require_positive("box", h=self.h, **{f"size[{i}]": length for i, length in enumerate(self.size)})
        require(
            len(self.origin) in (0, len(self.size)) and all(is_length(x) for x in self.origin),
            f"box: origin = {list(self.origin)} must have as many numbers as size = {list(self.size)}.",
        )
        require_one_of("box", "pattern", self.pattern, ("structured", "unstructured"))
        require(self.seed > 0, f"box: seed = {self.seed!r} must be 1 or more.")
        random = self.pattern == "unstructured"
        require(random or self.seed == 1, 'box: seed is of random points: give pattern = "unstructured" beside it.')
        require_affordable("box", self.h, self.cells_estimate())

    @property
    def groups(self) -> tuple[str, ...]:
        """Names of the facet groups."""
        return tuple(self._planes())

    @property
    def is_conforming(self) -> bool:
        """Whether cells are positive and share whole facets by construction."""
        return self.pattern == "structured"

    def bounds(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Lower and upper corner of the bounding box [m]."""
        origin = self.origin or (0.0,) * len(self.size)
        return tuple(origin), tuple(o + s for o, s in zip(origin, self.size, strict=True))

    def cells_estimate(self) -> int:
        """Approximate number of cells."""
        if self.pattern == "unstructured":
            return estimate_cells_in_box(SizeField(self.h), (0.0,) * len(self.size), self.size)
        return int(np.prod(self._steps(), dtype=float)) * (2 if len(self.size) == 2 else 6)

    def build(self) -> MeshData:
        """The mesh."""
        if self.pattern == "structured":
            points, cells = lattice(self._steps())
            points = self._placed(points)
        else:
            points, cells = mesh_with_gmsh(self._draw, len(self.size), SizeField(self.h), seed=self.seed)
        # The body is convex: only cells with a facet on a plane have boundary facets.
        low, high = self.bounds()
        beside = ((points == low) | (points == high)).any(axis=1)[cells].sum(axis=1) >= cells.shape[1] - 1
        facets = boundary_facets(cells[beside])
        return MeshData(points, cells, facet_groups_on_planes(points, facets, self._planes()))

    def _steps(self) -> tuple[int, ...]:
        return tuple(max(1, round(length / self.h)) for length in self.size)

    def _placed(self, unit: Points) -> Points:
        """Points of the unit box mapped to the bounds, faces exactly on them."""
        low, high = (np.array(corner, dtype=np.float64) for corner in self.bounds())
        return np.where(unit == 1.0, high, low + unit * (high - low))

    def _planes(self) -> dict[str, tuple[int, float]]:
        """Facet group -> axis and coordinate [m] of its plane."""
        low, high = self.bounds()
        sides = [("left", "right"), ("front", "back"), ("bottom", "top")]
        if len(self.size) == 2:
            del sides[1]
        return {
            name: (axis, corner[axis])
            for axis, names in enumerate(sides)
            for name, corner in zip(names, (low, high), strict=True)
        }

    def _draw(self, gmsh: Any) -> None:
        low, _ = self.bounds()
        if len(self.size) == 2:
            gmsh.model.occ.addRectangle(*low, 0.0, *self.size)
        else:
            gmsh.model.occ.addBox(*low, *self.size)


def lattice(steps: tuple[int, ...]) -> tuple[Points, Indices]:
    """Points (n, d) and positive cells (m, d + 1) of the unit square or cube in a lattice, cut by Kuhn's subdivision.

    Each permutation of the axes is a path of unit steps from the least corner of a cube to the greatest; the nodes
    on the path are one simplex. Neighbouring cubes cut their common face along the same diagonal.
    """
    dim = len(steps)
    ranges = [np.arange(count + 1) / count for count in steps]
    points = np.stack(np.meshgrid(*ranges, indexing="ij"), axis=-1).reshape(-1, dim)
    strides = np.cumprod([1, *(count + 1 for count in steps[:0:-1])])[::-1]
    corners = np.indices(steps).reshape(dim, -1).T @ strides
    paths = np.array([_path(order, strides) for order in permutations(range(dim))])
    cells = corners[:, None, None] + paths[None]
    return points, cells.reshape(-1, dim + 1).astype(np.int64)


def _path(order: tuple[int, ...], strides: Indices) -> list[int]:
    """Node offsets of one simplex of the cube at the origin, positively ordered."""
    nodes = [0, *np.cumsum([strides[axis] for axis in order]).tolist()]
    if np.linalg.det(np.eye(len(order))[list(order)]) < 0:
        nodes[-2:] = nodes[:-3:-1]
    return nodes
