"""Cell size as a function of place, and estimates of numbers of cells."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .data import Points
from .topology import Floats

# Mean measure of a cell over h^d, on boxes of 3 000 to 340 000 cells. An equilateral triangle has 0.433 h^2 and a
# regular tetrahedron 0.118 h^3, but regular tetrahedra do not fill space, and random points make other triangles.
SHARE = {2: 0.404, 3: 0.092}


@dataclass(frozen=True)
class SizeField:
    """Cell size: `h`, or finer near an axis-parallel rectangle, which may be a line or a point.

    size(x) = min(h, fine + growth * distance(x, rectangle)), the distance in the x-y plane of gmsh's model.

    Attributes:
        h: size [m] away from the rectangle.
        fine: size [m] in the rectangle; None: `h` everywhere.
        low: lower corner of the rectangle [m].
        high: upper corner of the rectangle [m].
        growth: change of size over distance.
    """

    h: float
    fine: float | None = None
    low: tuple[float, float] = (0.0, 0.0)
    high: tuple[float, float] = (0.0, 0.0)
    growth: float = 0.3

    def at(self, points: Points) -> Floats:
        """(n,) cell size [m] at points (n, 2 or 3)."""
        if self.fine is None:
            return np.full(len(points), self.h)
        outside = np.maximum(np.maximum(np.subtract(self.low, points[:, :2]), points[:, :2] - self.high), 0.0)
        return np.minimum(self.h, self.fine + self.growth * np.linalg.norm(outside, axis=1))

    def apply(self, gmsh: Any, factor: float = 1.0) -> None:
        """Make the size, times a factor, gmsh's only background field."""
        for source in ("FromPoints", "FromCurvature", "ExtendFromBoundary"):
            gmsh.option.setNumber(f"Mesh.MeshSize{source}", 0)
        gmsh.option.setNumber("Mesh.MeshSizeMax", factor * self.h)
        field = gmsh.model.mesh.field
        tag = field.add("MathEval")
        field.setString(tag, "F", f"{factor!r}*({self._expression()})")
        field.setAsBackgroundMesh(tag)

    def _expression(self) -> str:
        """The size as a formula of x and y for gmsh."""
        if self.fine is None:
            return f"{self.h!r}"
        # |x - a| + |x - b| - |b - a| is twice the distance of x from the interval [a, b]; gmsh's parser knows abs
        squares = "+".join(
            f"((abs({axis}-({a!r}))+abs({axis}-({b!r}))-{b - a!r})/2)^2"
            for axis, a, b in zip("xy", self.low, self.high, strict=True)
        )
        return f"{self.fine!r}+{self.growth!r}*sqrt({squares})"


def estimate_cells_in_box(
    sizing: SizeField, low: tuple[float, ...], high: tuple[float, ...], filled: float = 1.0
) -> int:
    """Approximate number of cells in a box of which a share is filled.

    The integral of 1 / (SHARE * size^d), by the midpoint rule.

    Args:
        sizing: cell size.
        low: lower corner of the box [m].
        high: upper corner of the box [m].
        filled: share of the box.
    """
    dim = len(low)
    sides = np.subtract(high, low)
    middles = [low[i] + sides[i] * (np.arange(200) + 0.5) / 200 for i in range(2)]
    points = np.stack(np.meshgrid(*middles, indexing="ij"), axis=-1).reshape(-1, 2)
    density = float(np.mean(1.0 / sizing.at(points) ** dim))
    return max(1, round(filled * float(np.prod(sides)) * density / SHARE[dim]))


def estimate_cells_in_body(volume: float, wall: float, h: float) -> int:
    """Approximate number of cells of size h [m] in a body of a volume [m^3], solid (wall 0) or with a wall [m]."""
    # A wall thinner than h has cells from one side to the other: three tetrahedra for each prism over an equilateral
    # triangle of 0.433 h^2, whatever its thickness.
    solid = volume / (SHARE[3] * h**3)
    through = 3 * volume / wall / (0.433 * h**2) if wall else 0.0
    return max(1, round(max(solid, through)))
