"""A finite cylinder with rounded edges, in 3D."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...errors import InputError
from .axes import frame, unit
from .corner import Corner
from .moments import revolved
from .outlines import Outline, profile, surface_of_revolution
from .shape import FILLET, Body, Values, require_fillet, require_lengths, resized_fillet


@dataclass(frozen=True)
class Cylinder(Body):
    """A cylinder of `radius` and full `length` along `axis`, edges rounded with `rounding` (m, default FILLET radius).

    In the half plane through the axis it is a corner, q = (rho - (R - r), |height| - (L / 2 - r)). From inside the
    distance is C1 within the rounding of the wall, as for a box.
    """

    radius: float
    length: float
    rounding: float | None = None
    axis: tuple[float, ...] = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        """InputError where it is no cylinder."""
        unit(self.axis)
        if len(self.axis) != 3:
            raise InputError("a cylinder needs an axis of 3 numbers: in 2D take a sphere (a disk) or a box")
        require_lengths(self, radius=self.radius, length=self.length)
        require_fillet(self, self.fillet, min(self.radius, self.length / 2))
        if self.fillet == self.radius:
            raise InputError("the rounding of a cylinder is its radius: take a capsule")

    @property
    def dim(self) -> int:
        """3."""
        return 3

    @property
    def fillet(self) -> float:
        """Radius of the edges, m; for a thin disk no more than half its thickness."""
        return min(FILLET * self.radius, self.length / 2) if self.rounding is None else self.rounding

    def _core(self) -> tuple[float, float]:
        """Radius and half length of the sharp core that the fillet grows, m."""
        return self.radius - self.fillet, self.length / 2 - self.fillet

    def _polar(self, x: Values) -> tuple[Corner, Values, Values, Values]:
        """The corner, distances from the axis (n,), and unit vectors (n, d) away from the axis and up or down it."""
        axis, (radius, half) = unit(self.axis), self._core()
        height = x @ axis
        across = x - height[:, None] * axis
        rho = np.linalg.norm(across, axis=1)
        on_axis = rho < np.finfo(float).tiny
        away = across / np.where(on_axis, 1.0, rho)[:, None]
        if on_axis.any():
            away[on_axis] = frame(axis)[:, 0]
        q = np.stack([rho - radius, abs(height) - half], axis=1)
        return Corner(q), rho, away, np.where(height < 0, -1.0, 1.0)[:, None] * axis

    def _distance(self, x: Values) -> Values:
        return self._polar(x)[0].value - self.fillet

    def _normal(self, x: Values) -> Values:
        corner, _, away, up = self._polar(x)
        return corner.slope[:, :1] * away + corner.slope[:, 1:] * up

    def _curvature(self, x: Values) -> Values:
        """The corner's Hessian in the half plane, and f_rho / rho around the axis (0 on it: an end is nearest)."""
        corner, rho, away, up = self._polar(x)
        plane = np.stack([away, up], axis=1)
        around = np.cross(away, up)
        on_axis = rho < np.finfo(float).tiny
        ring = np.where(on_axis, 0.0, corner.slope[:, 0] / np.where(on_axis, 1.0, rho))
        bent = plane.transpose(0, 2, 1) @ corner.curvature @ plane
        return np.asarray(bent + ring[:, None, None] * around[:, :, None] * around[:, None, :])

    def _radius(self) -> float:
        return self.fillet

    def _depth(self) -> float:
        return min(self.radius, self.length / 2)

    def _resized(self, by: float) -> Cylinder:
        rounding = resized_fillet(self.fillet, by)
        return replace(self, radius=self.radius + by, length=self.length + 2 * by, rounding=rounding)

    def _outline(self) -> Outline:
        radius, half = self._core()
        side = profile(radius, half, self.fillet)
        points, triangles = surface_of_revolution(side)
        return points @ frame(unit(self.axis)).T, triangles

    def _moments(self) -> tuple[float, Values]:
        radius, half = self._core()
        return revolved(unit(self.axis), radius, half, self.fillet)
