"""Triangles (3D) and segments (2D) to draw a shape with: closed, facing outwards, within 1 % of its volume.

Volume and second moments of rounded bodies in closed form, by slices.
"""

from __future__ import annotations

from math import comb, pi

import numpy as np
import numpy.typing as npt
from numpy.polynomial import Polynomial
from scipy.special import beta

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]
Tessellation = tuple[Values, Ints]
ARC = 12  # steps of a quarter circle


def profile(core_radius: float, half: float, rounding: float) -> Values:
    """(k, 2) half a meridian of a rectangle grown by the rounding: (distance from the axis, height), from below."""
    turn = np.linspace(0, np.pi / 2, ARC + 1)
    arc = rounding * np.column_stack([np.cos(turn), np.sin(turn)])
    upper = arc + np.array([core_radius, half])
    upper[-1, 0] = core_radius  # not cos(pi/2)
    lower = upper[::-1] * [1, -1]
    return np.concatenate([lower[:-1] if half == 0 else lower, upper])


def polygon(side: Values) -> Tessellation:
    """Counterclockwise segments around a half profile (k, 2) and its mirror image."""
    other = side[::-1] * [-1, 1]
    points = np.concatenate([side, other[other[:, 0] < 0]])
    index = np.arange(len(points), dtype=np.int32)
    return points, np.column_stack([index, np.roll(index, -1)])


def surface_of_revolution(side: Values) -> Tessellation:
    """Triangles of a half profile (k, 2) turned about the last axis, with a pole at either end."""
    heights, side, steps = side[[0, -1], 1], side[side[:, 0] > 0], 4 * ARC
    turn = np.arange(steps) * (2 * np.pi / steps)
    circle = np.stack([np.cos(turn), np.sin(turn), np.ones(steps)], axis=1)
    rings = (side[:, None, [0, 0, 1]] * circle).reshape(-1, 3)
    poles = np.array([[0, 0, heights[0]], [0, 0, heights[1]]])
    index = np.arange(len(rings)).reshape(-1, steps)
    first, last = (np.full((1, steps), len(rings) + end) for end in (0, 1))
    grid = np.concatenate([first, index, last])
    return np.concatenate([rings, poles]), _triangles(np.column_stack([grid, grid[:, 0]]))


def rounded_block(half: Values, rounding: float) -> Tessellation:
    """Triangles of a box of half sizes (3,) grown by the rounding: each octant of a sphere, moved to its corner."""
    arc = np.tan(np.linspace(0, np.pi / 4, ARC // 2 + 1))
    sides, steps = np.concatenate([-arc[::-1], arc]), np.arange(2 * len(arc))
    lattice = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    triangles = _faces_of_cube(len(steps))
    used, index = np.unique(triangles, return_inverse=True)
    towards = sides[lattice[used]]
    corner = np.where(lattice[used] < len(arc), -half, half)
    points = corner + rounding * towards / np.linalg.norm(towards, axis=1, keepdims=True)
    return points, index.reshape(-1, 3).astype(np.int32)


def _faces_of_cube(count: int) -> Ints:
    """Triangles on the six faces of a lattice of count^3 points, facing outwards."""
    lattice = np.arange(count**3).reshape(count, count, count)
    faces = []
    for axis in range(3):
        low, high = lattice.take(0, axis), lattice.take(-1, axis)
        # the two other axes, in ascending order, are right-handed about axes 0 and 2
        faces += [low, high.T] if axis == 1 else [low.T, high]
    return np.concatenate([_triangles(np.asarray(face.T)) for face in faces])


def _triangles(grid: npt.NDArray[np.integer]) -> Ints:
    """Two triangles a cell of a grid of point numbers, columns x rows right-handed; none where points coincide."""
    a, b, c, d = grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]
    triangles = np.stack([np.stack([a, b, c], axis=-1), np.stack([a, c, d], axis=-1)]).reshape(-1, 3)
    real = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
    return triangles[real].astype(np.int32)


def slices(power: int, half: float, rounding: float, area: Polynomial) -> float:
    """int |x|^power A(s(x)) dx along an axis of a body that is a core of half length h grown by r on all sides.

    A(s) is the measure (or moment) of a slice of the core grown by s: s = r for |x| <= h, and s = sqrt(r^2 - t^2)
    at |x| = h + t. With int_0^r t^k s^m dt = r^(k + m + 1) / 2 * beta((k + 1) / 2, m / 2 + 1) all is exact.
    """
    total = half ** (power + 1) / (power + 1) * float(area(rounding))
    for m, factor in enumerate(area.coef):
        for k in range(power + 1):
            cap = rounding ** (k + m + 1) / 2 * float(beta((k + 1) / 2, m / 2 + 1))
            total += float(factor) * comb(power, k) * half ** (power - k) * cap
    return 2 * total


def revolved(axis: Values, core_radius: float, half: float, rounding: float) -> tuple[float, Values]:
    """Volume and S = int x x^T dV (d, d) of a cylinder (in 2D a rectangle) about `axis`, grown by the rounding."""
    radius = Polynomial([core_radius, 1.0])
    flat = len(axis) == 2
    area, across = (2 * radius, 2 / 3 * radius**3) if flat else (pi * radius**2, pi / 4 * radius**4)
    volume, along = (slices(power, half, rounding, area) for power in (0, 2))
    of_axis = np.outer(axis, axis)
    return volume, along * of_axis + slices(0, half, rounding, across) * (np.eye(len(axis)) - of_axis)


def rounded_box(half: Values, rounding: float) -> tuple[float, Values]:
    """Volume and S = int x x^T dV (d, d) of a box of half sizes (d,), grown by the rounding."""
    areas = [_slice_of_box(2 * np.delete(half, axis)) for axis in range(len(half))]
    spread = [slices(2, float(h), rounding, area) for h, area in zip(half, areas, strict=True)]
    return slices(0, float(half[0]), rounding, areas[0]), np.diag(spread)


def _slice_of_box(sizes: Values) -> Polynomial:
    """A(s) of a segment or a rectangle of these sizes, grown by s (Steiner's formula)."""
    if len(sizes) == 1:
        return Polynomial([sizes[0], 2.0])
    return Polynomial([sizes[0] * sizes[1], 2 * sizes.sum(), pi])
