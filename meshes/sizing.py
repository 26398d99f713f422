"""How large cells should be from place to place, and how many of them that makes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from .data import Points
from .topology import Floats

# Measured on boxes of 3 000 to 340 000 cells: cells = measure / (share * h^d). An equilateral triangle has 0.433 h^2
# and a regular tetrahedron 0.118 h^3, but regular tetrahedra do not fill space, nor do triangles between random points.
SHARE = {2: 0.404, 3: 0.092}

# Asked for h, gmsh makes surface edges of length h but inner edges of 1.3 h (its criterion is on the circumsphere).
# Asked for this share of h inside, the median edge is h within 2 % (the same boxes, algorithm HXT).
INNER_SIZE_FACTOR = 0.7


@dataclass(frozen=True)
class SizeField:
    """Cell size: `h`, or finer near a fine place, an axis-parallel rectangle (a line or a point where it is thin).

    size(x) = min(h, fine + growth * distance(x, place)); the distance is taken in the x-y plane of gmsh's model.

    Attributes:
        h: size [m] away from the place.
        fine: size [m] at the place; None: `h` everywhere.
        low, high: corners of the place [m].
        growth: change of size per distance, dimensionless.
    """

    h: float
    fine: float | None = None
    low: tuple[float, float] = (0.0, 0.0)
    high: tuple[float, float] = (0.0, 0.0)
    growth: float = 0.3

    def at(self, points: Points) -> Floats:
        """Cell size [m] at points (n, 2 or 3): (n,)."""
        if self.fine is None:
            return np.full(len(points), self.h)
        outside = np.maximum(np.maximum(np.subtract(self.low, points[:, :2]), points[:, :2] - self.high), 0.0)
        return np.minimum(self.h, self.fine + self.growth * np.linalg.norm(outside, axis=1))

    def apply(self, gmsh: Any, factor: float = 1.0) -> None:
        """Hand the sizes, times the factor, to gmsh as its background field, and nothing else."""
        for source in ("FromPoints", "FromCurvature", "ExtendFromBoundary"):
            gmsh.option.setNumber(f"Mesh.MeshSize{source}", 0)
        gmsh.option.setNumber("Mesh.MeshSizeMax", factor * self.h)
        field = gmsh.model.mesh.field
        tag = field.add("MathEval")
        field.setString(tag, "F", f"{factor!r}*({self._expression()})")
        field.setAsBackgroundMesh(tag)

    def _expression(self) -> str:
        if self.fine is None:
            return f"{self.h!r}"
        # |x - a| + |x - b| - |b - a| is twice the distance of x to the interval [a, b]; gmsh's parser knows abs.
        squares = "+".join(
            f"((abs({axis}-({a!r}))+abs({axis}-({b!r}))-{b - a!r})/2)^2"
            for axis, a, b in zip("xy", self.low, self.high, strict=True)
        )
        return f"{self.fine!r}+{self.growth!r}*sqrt({squares})"


def estimate_cells_in_box(
    sizing: SizeField, low: tuple[float, ...], high: tuple[float, ...], filled: float = 1.0
) -> int:
    """About how many cells gmsh makes of these sizes in a box of which the given share is filled.

    The integral of dx / (share * size^d), by the midpoint rule; `low` and `high` in metres.
    """
    dim = len(low)
    sides = np.subtract(high, low)
    middles = [low[i] + sides[i] * (np.arange(200) + 0.5) / 200 for i in range(2)]
    points = np.stack(np.meshgrid(*middles, indexing="ij"), axis=-1).reshape(-1, 2)
    density = float(np.mean(1.0 / sizing.at(points) ** dim))
    return max(1, round(filled * float(np.prod(sides)) * density / SHARE[dim]))


def estimate_cells_in_body(volume: float, wall: float, h: float) -> int:
    """About how many cells gmsh makes of size h in a body of this volume [m^3], solid (wall 0) or a shell.

    A wall no thicker than h has cells from one side to the other: three tetrahedra to a prism over a triangle of
    0.433 h^2, whatever its thickness.
    """
    solid = volume / (SHARE[3] * h**3)
    through = 3 * volume / wall / (0.433 * h**2) if wall else 0.0
    return max(1, round(max(solid, through)))
