"""Volume and second moments of rounded bodies in closed form, by slices."""

from __future__ import annotations

from math import comb, pi

import numpy as np
import numpy.typing as npt
from numpy.polynomial import Polynomial
from scipy.special import beta

Values = npt.NDArray[np.float64]


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
