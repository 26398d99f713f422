"""A figure with a head, four limbs and a tail, solid or hollow: something to pull apart or to strike."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from ..data import Indices, MeshData, Points
from ..parameters import positive, require, require_affordable, require_not_negative
from ..sizing import estimate_cells_in_body
from ..topology import Floats, boundary_facets, exclude_facets, facets_on_nodes

Place = tuple[float, float, float]


@dataclass(frozen=True)
class RoundCone:
    """The convex hull of two balls: centres and radii, neither ball inside the other."""

    start: Place
    end: Place
    start_radius: float
    end_radius: float

    def scaled(self, scale: float) -> RoundCone:
        start, end = (tuple(scale * x for x in position) for position in (self.start, self.end))
        return RoundCone(start, end, scale * self.start_radius, scale * self.end_radius)  # type: ignore[arg-type]

    def depth(self, points: Points) -> tuple[Floats, Floats]:
        """How far points lie inside, negative outside (n,) [m], and the gradient (n, 3).

        The largest r(t) - |x - c(t)| over the balls between the ends. With s along the axis and q across it that is
        at t = (s - q sin / cos) / L, sin the change of radius over the length L, cut to [0, 1]. The gradient points
        to the centre of that ball.
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


# Shares of the height. Arms and legs spread, so that four hands can pull; the figure looks towards -y.
TORSO = (
    RoundCone((0.0, 0.0, 0.37), (0.0, 0.0, 0.60), 0.135, 0.115),
    RoundCone((0.0, 0.0, 0.65), (0.0, 0.0, 0.80), 0.060, 0.070),
    RoundCone((0.0, 0.01, 0.83), (0.0, -0.09, 0.80), 0.105, 0.060),
    RoundCone((0.0, 0.05, 0.34), (0.0, 0.32, 0.20), 0.065, 0.032),
)
EAR = RoundCone((0.035, 0.015, 0.87), (0.115, 0.03, 0.965), 0.040, 0.035)
ARM = RoundCone((0.05, 0.0, 0.60), (0.410, 0.0, 0.745), 0.060, 0.046)
LEG = RoundCone((0.045, 0.0, 0.36), (0.205, 0.0, 0.078), 0.085, 0.060)
HAND = RoundCone((0.395, 0.0, 0.74), (0.430, 0.0, 0.755), 0.066, 0.058)
FOOT = RoundCone((0.205, 0.01, 0.075), (0.215, -0.08, 0.065), 0.075, 0.065)


def _mirrored(part: RoundCone) -> RoundCone:
    start, end = ((-x, y, z) for x, y, z in (part.start, part.end))
    return RoundCone(start, end, part.start_radius, part.end_radius)


PAIRS = (EAR, ARM, LEG, HAND, FOOT)
PARTS = (*TORSO, *(side for part in PAIRS for side in (part, _mirrored(part))))
BLEND = 0.008  # rounding of the joints
HELD = {"left-hand": HAND, "right-hand": _mirrored(HAND), "left-foot": FOOT, "right-foot": _mirrored(FOOT)}


@dataclass(frozen=True)
class Figure:
    """A standing figure of rounded limbs, arms and legs spread in the x-z plane, its feet at z = 0.

    A smooth union of round cones (torso, neck, head, ears, tail, arms, hands, legs, feet): with d_i the depth of a
    point in part i the depth in the body is s log(sum exp(d_i / s)), s = `BLEND` of the height, which rounds the
    joints. It changes by no more than 1 per length: a wall between two of its levels is nowhere thinner than they
    differ.

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
        positive("figure", height=self.height, h=self.h)
        require_not_negative("figure", wall=self.wall)
        thinnest = self.height * min(part.end_radius for part in PARTS)
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
        return (*HELD, "skin", "inside") if self.wall else (*HELD, "skin")

    def depth(self, points: Points) -> tuple[Floats, Floats]:
        """How far points lie inside the outer surface, negative outside (n,) [m], and the gradient (n, 3)."""
        result = [part.scaled(self.height).depth(points) for part in PARTS]
        depths, gradients = np.array([d for d, _ in result]), np.array([g for _, g in result])
        blend, deepest = BLEND * self.height, depths.max(axis=0)
        weights = np.exp((depths - deepest) / blend)
        sums = weights.sum(axis=0)
        return deepest + blend * np.log(sums), np.einsum("pn,pni->ni", weights / sums, gradients)

    def bounds(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Those of the balls at the ends of all parts."""
        balls = [(p.start, p.start_radius) for p in PARTS] + [(p.end, p.end_radius) for p in PARTS]
        centres, radii = np.array([b[0] for b in balls]), np.array([b[1] for b in balls])[:, None]
        low, high = (centres - radii).min(axis=0), (centres + radii).max(axis=0)
        return tuple((self.height * low).tolist()), tuple((self.height * high).tolist())

    def cells_estimate(self) -> int:
        return estimate_cells_in_body(self.volume(), self.wall, self.h)

    def volume(self, steps: int = 60) -> float:
        """Volume by the midpoint rule, `steps` points along each side of the bounds [m^3]."""
        low, high = (np.array(corner) for corner in self.bounds())
        axes = [lo + (hi - lo) * (np.arange(steps) + 0.5) / steps for lo, hi in zip(low, high, strict=True)]
        points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        depth = self.depth(points)[0]
        filled = (depth > 0) & (depth < self.wall) if self.wall else depth > 0
        return float(np.prod(high - low) * filled.mean())

    def build(self) -> MeshData:
        from ..surfaces.closed import combine_shells
        from ..surfaces.fill import fill_shells  # SciPy

        shells = [self._shell(0.0), self._shell(self.wall)] if self.wall else [self._shell(0.0)]
        surface = combine_shells(shells, "figure")
        parts = [surface.part(number) for number in range(int(surface.shell.max()) + 1)]
        points, cells, _ = fill_shells(parts, surface.bodies, self.h, "figure")
        return MeshData(points, cells, self._groups(points, boundary_facets(cells)))

    def _shell(self, level: float) -> tuple[Points, Indices]:
        from ..surfaces.level_set import level_surface

        def below(points: Points) -> tuple[Floats, Floats]:
            depth, gradient = self.depth(points)
            return depth - level, gradient

        low, high = (np.array(corner) for corner in self.bounds())
        return level_surface(below, low, high, self.h)

    def _groups(self, points: Points, boundary: Indices) -> dict[str, Indices]:
        """Hands and feet: where their own parts are the deepest of all."""
        groups = {}
        if self.wall:
            groups["inside"] = facets_on_nodes(boundary, self.depth(points)[0] > self.wall / 2)
        outside = exclude_facets(boundary, *groups.values())
        depths = np.array([part.scaled(self.height).depth(points)[0] for part in PARTS])
        deepest = depths.argmax(axis=0)
        for name, part in HELD.items():
            groups[name] = facets_on_nodes(outside, deepest == PARTS.index(part))
        return groups | {"skin": exclude_facets(boundary, *groups.values())}
