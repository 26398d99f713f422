"""Sphere and capsule (in 2D disk and stadium): all points within a radius of a point or a segment."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from ...errors import InputError
from .axes import Values, frame, unit
from .moments import revolved
from .outlines import Outline, polygon, profile, surface_of_revolution
from .shape import Body, require_lengths


@dataclass(frozen=True)
class _Swept(Body):
    """All within a radius of a segment or point, which the subclasses say."""

    @abstractmethod
    def _core(self) -> tuple[Values, float, float]:
        """Unit vector along the segment, half its length and the radius, m."""

    def _from_core(self, x: Values) -> tuple[Values, Values, Values]:
        """Vectors (n, d) from the nearest points of the segment, their lengths, and heights along it (n,)."""
        axis, half, _ = self._core()
        height = x @ axis
        away = x - np.clip(height, -half, half)[:, None] * axis
        return away, np.linalg.norm(away, axis=1), height

    def _distance(self, x: Values) -> Values:
        return self._from_core(x)[1] - self._core()[2]

    def _normal(self, x: Values) -> Values:
        away, length, _ = self._from_core(x)
        on_core = length < np.finfo(float).tiny
        if not on_core.any():
            return np.asarray(away / length[:, None])
        some = frame(self._core()[0])[:, 0]  # on the segment itself every direction across it is as good
        return np.where(on_core[:, None], some, away / np.where(on_core, 1.0, length)[:, None])

    def _curvature(self, x: Values) -> Values:
        """(P - n n^T) / |x - nearest|, P across the axis beside the segment and the identity beyond its ends."""
        axis, half, _ = self._core()
        _, length, height = self._from_core(x)
        n, beside = self._normal(x), (abs(height) < half).astype(float)
        P = np.eye(self.dim) - beside[:, None, None] * np.outer(axis, axis)
        on_core = length < np.finfo(float).tiny
        bent = (P - n[:, :, None] * n[:, None, :]) / np.where(on_core, 1.0, length)[:, None, None]
        return np.where(on_core[:, None, None], 0.0, bent)

    def _radius(self) -> float:
        return self._core()[2]

    def _depth(self) -> float:
        return self._radius()

    def _resized(self, by: float) -> Self:
        return replace(self, radius=self._radius() + by)  # type: ignore[call-arg]

    def _outline(self) -> Outline:
        axis, half, radius = self._core()
        side = profile(0.0, half, radius)
        points, elements = polygon(side) if self.dim == 2 else surface_of_revolution(side)
        return points @ frame(axis).T, elements

    def _moments(self) -> tuple[float, Values]:
        axis, half, radius = self._core()
        return revolved(axis, 0.0, half, radius)


@dataclass(frozen=True)
class Sphere(_Swept):
    """All within `radius` (m) of the centre; in 2D a disk."""

    radius: float
    dim: int = 3

    def __post_init__(self) -> None:
        """InputError where it is no sphere."""
        require_lengths(self, radius=self.radius)
        if self.dim not in (2, 3):
            raise InputError(f"a sphere in {self.dim} dimensions is not known: dim is 2 or 3")

    @property
    def round(self) -> bool:
        """It is."""
        return True

    def _core(self) -> tuple[Values, float, float]:
        return np.eye(self.dim)[-1], 0.0, self.radius


@dataclass(frozen=True)
class Capsule(_Swept):
    """All within `radius` of a segment of `length` along `axis`, m: from end to end length + 2 radius. 2D: stadium."""

    radius: float
    length: float
    axis: tuple[float, ...] = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        """InputError where it is no capsule."""
        unit(self.axis)
        require_lengths(self, radius=self.radius, length=self.length)

    @property
    def dim(self) -> int:
        """2 or 3."""
        return len(self.axis)

    def _core(self) -> tuple[Values, float, float]:
        return unit(self.axis), self.length / 2, self.radius
