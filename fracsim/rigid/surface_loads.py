"""Hertz's contact of spheres, and contact forces as nodal loads on a body (docs/theory.md#blows-and-loads).

    tau = 2.87 (m^2 / (R E*^2 v))^(1/5),   a = (3 F R / (4 E*))^(1/3),   p(r) = 3 F / (2 pi a^2) sqrt(1 - r^2 / a^2)

with the reduced mass m and radius R of two bodies of one material that meet at a speed v, and E* = E / (1 - nu^2) / 2.
E* is twice as large if one of the two is rigid (K. L. Johnson 1985, equations 11.24, 4.22 and 3.39).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from ..mesh.small_matrices import barycentric_gradients

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class PointLoadSettings:
    """Resolution of contact forces.

    Attributes:
        nearest_cells: cells with the closest centres that are tried for a point; one of them has it, or is the nearest.
        min_radius: mean edges; the force on a smaller circle acts at a point.
        density: points on a square of a mean edge.
        min_pairs: least number of pairs of points on a circle.
        max_pairs: largest number of them.
    """

    nearest_cells: int = 24
    min_radius: float = 0.05
    density: float = 12.0
    min_pairs: int = 8
    max_pairs: int = 256


SETTINGS = PointLoadSettings()


# --- Hertz's contact ---


@dataclass(frozen=True)
class HertzContact:
    """Contact of elastic spheres of one material.

    Attributes:
        young: Young's modulus, Pa.
        poisson: Poisson's ratio.
    """

    young: float
    poisson: float

    def duration(self, mass: Values, radius: Values, speed: Values, both_elastic: Flags) -> Values:
        """Return the durations tau (k,), s, of impacts.

        Args:
            mass: (k,) reduced masses, kg.
            radius: (k,) reduced radii, m.
            speed: (k,) m/s.
            both_elastic: (k,) False where one of the two bodies is rigid.
        """
        modulus = self._contact_modulus(both_elastic)
        return np.asarray(2.87 * (mass**2 / (radius * modulus**2 * speed)) ** 0.2)

    def radius_cubed_per_force(self, radius: Values, both_elastic: Flags) -> Values:
        """Return a^3 / F (k,), m^3/N, for reduced radii (k,), m."""
        return np.asarray(0.75 * radius / self._contact_modulus(both_elastic))

    def _contact_modulus(self, both_elastic: Flags) -> Values:
        """Return E* (k,), Pa."""
        return np.asarray(self.young / (1 - self.poisson**2) / np.where(both_elastic, 2, 1))


class ImpactSpheres:
    """Bodies and obstacles as spheres, for the durations and contact radii of their impacts by Hertz's law."""

    def __init__(self, hertz: HertzContact, contact_time: float | None) -> None:
        """`contact_time`: duration of all impacts, s; None: that of Hertz's law."""
        self._hertz, self._contact_time = hertz, contact_time
        self.set_bodies(np.empty(0), np.empty(0), 0)

    def set_bodies(self, mass: Values, half_size: Values, elastic_count: int) -> None:
        """Set the masses (n,), kg, and half the sizes (n,), m, of all bodies and obstacles.

        `elastic_count`: number of the first ones that are elastic; all others are rigid.
        """
        self._mass, self._half_size, self._elastic_count = mass, half_size, elastic_count

    def duration(self, first: Ints, second: Ints, speed: Values) -> Values:
        """Return the durations (k,), s, of impacts of bodies (k,) with others (k,) at speeds (k,), m/s."""
        if self._contact_time is not None:
            return np.full(len(first), self._contact_time)
        mass = reduced_value(self._mass[first], self._mass[second])
        return self._hertz.duration(mass, self._radius(first, second), speed, self._are_both_elastic(first, second))

    def radius_cubed_per_force(self, first: Ints, second: Ints) -> Values:
        """Return a^3 / F (k,), m^3/N, of contacts of bodies (k,) with others (k,)."""
        return self._hertz.radius_cubed_per_force(self._radius(first, second), self._are_both_elastic(first, second))

    def _radius(self, first: Ints, second: Ints) -> Values:
        """Return reduced radii (k,), m."""
        return reduced_value(self._half_size[first], self._half_size[second])

    def _are_both_elastic(self, first: Ints, second: Ints) -> Flags:
        return np.asarray(np.maximum(first, second) < self._elastic_count)


def reduced_value(first: Values, second: Values) -> Values:
    """Return reduced masses or radii 1 / (1 / a + 1 / b); a or b may be infinite."""
    return np.asarray(1.0 / (1.0 / first + 1.0 / second))


# --- nodal loads ---


@dataclass(frozen=True)
class PointLoads:
    """Forces (k) at points within cells of a mesh at rest.

    Attributes:
        nodes: (k, d + 1) nodes of the cell that has the point.
        weights: (k, d + 1) barycentric coordinates of the point, 0 to 1.
        force: (k, d) in the axes of the body at rest, N.
    """

    nodes: Ints
    weights: Values
    force: Values

    @property
    def owner(self) -> Ints:
        """(k,) node with the largest barycentric coordinate; the force acts on the fragment of this node."""
        return np.asarray(np.take_along_axis(self.nodes, self.weights.argmax(axis=1)[:, None], axis=1)[:, 0])

    def select(self, chosen: Flags) -> PointLoads:
        """Return the forces flagged in `chosen` (k,)."""
        return PointLoads(self.nodes[chosen], self.weights[chosen], self.force[chosen])

    def nodal_forces(self, count: int) -> Values:
        """Return the forces (count, d), N, at all nodes of the mesh."""
        result = np.zeros((count, self.force.shape[1]))
        np.add.at(result, self.nodes, self.weights[:, :, None] * self.force[:, None])
        return result


def locate_forces(nodes: Values, cells: Ints, points: Values, force: Values) -> PointLoads:
    """Return forces at points as loads on the cells that have the points.

    The convex parts that collide are a little larger than the body. A point outside of it is moved to the nearest cell.

    Args:
        nodes: (N, d) positions, m.
        cells: (m, d + 1) cells that may be loaded.
        points: (k, d) m.
        force: (k, d) N.
    """
    corners = nodes[cells]
    count = min(SETTINGS.nearest_cells, len(cells))
    _, near = cKDTree(corners.mean(axis=1)).query(points, k=np.arange(1, count + 1))
    candidates = corners[near.reshape(-1)]
    arm = np.repeat(points, near.shape[1], axis=0) - candidates[:, 0]
    weights = np.einsum("nkd,nd->nk", barycentric_gradients(candidates), arm)
    weights[:, 0] += 1.0
    inside = np.maximum(weights, 0.0)
    inside /= inside.sum(axis=1, keepdims=True)
    # distance of the point from its projection into each candidate
    offset = np.einsum("nk,nkd->nd", inside - weights, candidates)
    best = np.einsum("nd,nd->n", offset, offset).reshape(near.shape).argmin(axis=1)
    rows = np.arange(len(points))
    return PointLoads(cells[near[rows, best]].astype(np.int64), inside.reshape(*near.shape, -1)[rows, best], force)


def distribute_on_circles(points: Values, force: Values, radius: Values, edge: float) -> tuple[Values, Values]:
    """Return points (n, 3), m, and forces (n, 3), N, that represent Hertz's pressure on circles across the forces.

    The points have equal forces: a share q of the force acts within r = a sqrt(1 - (1 - q)^(2/3)). They lie on a
    spiral of golden angles, each with its mirror image, so that the moment of the force is kept.

    Args:
        points: (k, 3) centres of the circles, m.
        force: (k, 3) N.
        radius: (k,) a, m.
        edge: mean edge of the mesh, m.
    """
    wide = np.flatnonzero(radius > SETTINGS.min_radius * edge)
    if not len(wide):
        return points, force
    narrow = np.setdiff1d(np.arange(len(radius)), wide)
    pairs_wanted = np.pi * SETTINGS.density / 2 * (radius[wide] / edge) ** 2
    pairs = np.clip(pairs_wanted, SETTINGS.min_pairs, SETTINGS.max_pairs).astype(np.int64)
    circle = np.repeat(np.arange(len(wide)), pairs)
    number = np.arange(len(circle)) - np.repeat(np.cumsum(pairs) - pairs, pairs)
    share = (number + 0.5) / pairs[circle]
    # successive points are a golden angle apart, which spreads them evenly over the circle
    angle = np.pi * (3 - np.sqrt(5)) * number
    r = radius[wide][circle] * np.sqrt(1 - (1 - share) ** (2 / 3))
    first, second = _perpendicular_axes(force[wide])
    arm = (r * np.cos(angle))[:, None] * first[circle] + (r * np.sin(angle))[:, None] * second[circle]
    centre, point_force = points[wide][circle], (force[wide] / (2 * pairs[:, None]))[circle]
    return (
        np.concatenate([points[narrow], centre + arm, centre - arm]),
        np.concatenate([force[narrow], point_force, point_force]),
    )


def _perpendicular_axes(direction: Values) -> tuple[Values, Values]:
    """Return two unit vectors (k, 3) across each direction (k, 3), which may have any length but 0."""
    coordinate_axis = np.eye(3)[np.abs(direction).argmin(axis=1)]
    first = np.cross(direction, coordinate_axis)
    first /= np.linalg.norm(first, axis=1)[:, None]
    second = np.cross(direction, first)
    return first, second / np.linalg.norm(second, axis=1)[:, None]
