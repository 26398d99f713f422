"""A standing figure with head, limbs and tail, solid or hollow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ..data import Indices, MeshData, Points
from ..parameters import require, require_affordable, require_not_negative, require_positive
from ..sizing import estimate_cells_in_body
from ..topology import Floats, boundary_facets, exclude_facets, facets_on_nodes

Coordinates = tuple[float, float, float]


@dataclass(frozen=True)
class RoundCone:
    """The convex hull of two balls, given by centres and radii; neither ball lies inside the other."""

    start: Coordinates
    end: Coordinates
    start_radius: float
    end_radius: float

    def scaled(self, scale: float) -> RoundCone:
        """The cone with all lengths multiplied by `scale`."""
        (x, y, z), (u, v, w) = self.start, self.end
        start, end = (scale * x, scale * y, scale * z), (scale * u, scale * v, scale * w)
        return RoundCone(start, end, scale * self.start_radius, scale * self.end_radius)

    def mirrored(self) -> RoundCone:
        """The cone mirrored at the plane x = 0."""
        (x, y, z), (u, v, w) = self.start, self.end
        return RoundCone((-x, y, z), (-u, v, w), self.start_radius, self.end_radius)

    def depth(self, points: Points) -> tuple[Floats, Floats]:
        """Signed depth of points below the surface (n,) [m], negative outside, and its gradient (n, 3).

        The depth is the maximum of r(t) - |x - c(t)| over the balls between the ends. With s along the axis and q
        across it the maximum is at t = (s - q sin / cos) / L, limited to [0, 1], where sin is the change of radius
        over the length L. The gradient points to the centre of that ball.
        """
        axis = np.subtract(self.end, self.start)
        length = float(np.linalg.norm(axis))
        sine = (self.start_radius - self.end_radius) / length
        along = (points - self.start) @ (axis / length)
        across = np.linalg.norm(points - self.start - along[:, None] * (axis / length), axis=1)
        t = np.clip((along - across * sine / (1 - sine**2) ** 0.5) / length, 0.0, 1.0)
        inwards = self.start + t[:, None] * axis - points
        distance = np.linalg.norm(inwards, axis=1)
        radius = self.start_radius + t * (self.end_radius - self.start_radius)
        return radius - distance, inwards / np.maximum(distance, 1e-300)[:, None]


# Parts of a figure of height 1 that looks towards -y. Arms and legs spread, so that four hands can pull.
CENTRE = {
    "torso": RoundCone((0.0, 0.0, 0.37), (0.0, 0.0, 0.60), 0.135, 0.115),
    "neck": RoundCone((0.0, 0.0, 0.65), (0.0, 0.0, 0.80), 0.060, 0.070),
    "head": RoundCone((0.0, 0.01, 0.83), (0.0, -0.09, 0.80), 0.105, 0.060),
    "tail": RoundCone((0.0, 0.05, 0.34), (0.0, 0.32, 0.20), 0.065, 0.032),
}
LEFT = {
    "ear": RoundCone((0.035, 0.015, 0.87), (0.115, 0.03, 0.965), 0.040, 0.035),
    "arm": RoundCone((0.05, 0.0, 0.60), (0.410, 0.0, 0.745), 0.060, 0.046),
    "leg": RoundCone((0.045, 0.0, 0.36), (0.205, 0.0, 0.078), 0.085, 0.060),
    "hand": RoundCone((0.395, 0.0, 0.74), (0.430, 0.0, 0.755), 0.066, 0.058),
    "foot": RoundCone((0.205, 0.01, 0.075), (0.215, -0.08, 0.065), 0.075, 0.065),
}
PARTS = CENTRE | {
    f"{side}-{name}": part if side == "left" else part.mirrored()
    for name, part in LEFT.items()
    for side in ("left", "right")
}
HANDS_AND_FEET = ("left-hand", "right-hand", "left-foot", "right-foot")
BLEND = 0.008  # rounding radius of the joints, over the height


@dataclass(frozen=True)
class Figure:
    """A standing figure of rounded limbs, arms and legs spread in the x-z plane, its feet at z = 0.

    A smooth union of round cones (torso, neck, head, ears, tail, arms, hands, legs, feet): with d_i the depth of a
    point in part i, the depth in the body is s log(sum exp(d_i / s)), s = BLEND * height, which rounds the joints. Its
    gradient is at most 1, so that a wall between two levels is nowhere thinner than the levels differ.

    Attributes:
        height: [m], of the parts before blending.
        wall: least thickness of a hollow figure's wall [m]; 0: solid.
        h: cell size [m].

    Groups: left-hand, right-hand, left-foot, right-foot (the figure's own left is at x > 0), skin (the rest of the
    outside), and inside where there is a wall.

    Raises:
        MeshError: a parameter is out of range, the wall is thicker than the thinnest part, or h is too coarse.
    """

    name: ClassVar[str] = "figure"
    regions: ClassVar[tuple[str, ...]] = ()

    height: float = 0.3
    wall: float = 0.0
    h: float = 0.01

    def __post_init__(self) -> None:
        require_positive("figure", height=self.height, h=self.h)
        require_not_negative("figure", wall=self.wall)
        thinnest = self.height * min(part.end_radius for part in PARTS.values())
        require(
            self.wall <= 0.75 * thinnest,
            f"figure: wall = {self.wall!r} must be no more than {0.75 * thinnest:.3g} m, three quarters of the "
            "thinnest part's radius; 0 makes it solid.",
        )
        require(
            not self.wall or self.h <= 1.5 * self.wall,
            f"figure: h = {self.h!r} must be no more than {1.5 * self.wall:.3g} m, 1.5 times the wall.",
        )
        require(
            self.h < 1.6 * thinnest,
            f"figure: h = {self.h!r} must be less than {1.6 * thinnest:.3g} m, 0.8 of the thinnest part.",
        )
        require_affordable("figure", self.h, self.cells_estimate())

    @property
    def groups(self) -> tuple[str, ...]:
        """Names of the facet groups."""
        return (*HANDS_AND_FEET, "skin", *(("inside",) if self.wall else ()))

    def depth(self, points: Points) -> tuple[Floats, Floats]:
        """Signed depth of points below the outer surface (n,) [m], negative outside, and its gradient (n, 3)."""
        of_parts = [part.scaled(self.height).depth(points) for part in PARTS.values()]
        depths, gradients = np.array([d for d, _ in of_parts]), np.array([g for _, g in of_parts])
        blend, deepest = BLEND * self.height, depths.max(axis=0)
        # log(sum exp) relative to the deepest part, so that nothing overflows
        weights = np.exp((depths - deepest) / blend)
        sums = weights.sum(axis=0)
        return deepest + blend * np.log(sums), np.einsum("pn,pni->ni", weights / sums, gradients)

    def bounds(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Lower and upper corner of the bounding box of the parts [m], before blending."""
        parts = PARTS.values()
        centres = np.array([p.start for p in parts] + [p.end for p in parts])
        radii = np.array([p.start_radius for p in parts] + [p.end_radius for p in parts])[:, None]
        low, high = (centres - radii).min(axis=0), (centres + radii).max(axis=0)
        return tuple((self.height * low).tolist()), tuple((self.height * high).tolist())

    def cells_estimate(self) -> int:
        """Approximate number of cells."""
        return estimate_cells_in_body(self.volume(), self.wall, self.h)

    def volume(self, steps: int = 60) -> float:
        """Volume [m^3] by the midpoint rule with `steps` points along each side of the bounding box."""
        low, high = (np.array(corner) for corner in self.bounds())
        axes = [lo + (hi - lo) * (np.arange(steps) + 0.5) / steps for lo, hi in zip(low, high, strict=True)]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        depth = self.depth(points)[0]
        filled = (depth > 0) & (depth < self.wall) if self.wall else depth > 0
        return float(np.prod(high - low) * filled.mean())

    def build(self) -> MeshData:
        """The mesh."""
        from ..surfaces.closed import combine_shells
        from ..surfaces.fill import fill_shells  # SciPy

        shells = [self._shell(0.0), self._shell(self.wall)] if self.wall else [self._shell(0.0)]
        surface = combine_shells(shells, "figure")
        parts = [surface.part(number) for number in range(int(surface.shell.max()) + 1)]
        points, cells, _ = fill_shells(parts, surface.bodies, self.h, "figure")
        return MeshData(points, cells, self._groups(points, boundary_facets(cells)))

    def _shell(self, level: float) -> tuple[Points, Indices]:
        """Points and triangles of the surface at a depth [m]."""
        from ..surfaces.level_set import level_surface

        def below(points: Points) -> tuple[Floats, Floats]:
            depth, gradient = self.depth(points)
            return depth - level, gradient

        low, high = (np.array(corner) for corner in self.bounds())
        return level_surface(below, low, high, self.h)

    def _groups(self, points: Points, boundary: Indices) -> dict[str, Indices]:
        """Facet groups; a facet belongs to a hand or foot where that part is the deepest."""
        groups = {}
        if self.wall:
            groups["inside"] = facets_on_nodes(boundary, self.depth(points)[0] > self.wall / 2)
        outside = exclude_facets(boundary, *groups.values())
        depths = np.array([part.scaled(self.height).depth(points)[0] for part in PARTS.values()])
        deepest = depths.argmax(axis=0)
        for name in HANDS_AND_FEET:
            groups[name] = facets_on_nodes(outside, deepest == list(PARTS).index(name))
        return groups | {"skin": exclude_facets(boundary, *groups.values())}
