"""Spall of an elastic bar by a triangular pulse: closed form, and exact solution by characteristics. NumPy alone.

A pulse rises to p0 within T_r and falls to 0 within T_f. It reflects at the free end as tension. At a distance x from
the end, s after the start of the pulse came back, the stress is p(s) - p(s + 2 x / c). It is largest when the peak
comes back, p0 2 x / (c T_f): the strength f_t is first reached at x_1 = f_t c T_f / (2 p0). The piece keeps the pulse
of 2 x_1 / c behind the peak, whose mean is p0 - f_t / 2: it leaves with (2 p0 - f_t) / (rho c).

All places beyond x_1 reach f_t before the peak: the place where they do runs at c (T_f + T_r) / (T_f - T_r). No release
runs as fast. So there is one plane for a sharp front alone (T_r = 0) and f_t < p0 < 2 f_t.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[Any]


@dataclass(frozen=True)
class Pulse:
    """A bar (Young's modulus, Pa; density, kg/m^3; length, m) and the pulse at its end (peak, Pa; times, s)."""

    young: float
    density: float
    length: float
    peak: float
    rise: float
    fall: float

    @property
    def wave_speed(self) -> float:
        """c, m/s."""
        return float(np.sqrt(self.young / self.density))

    @property
    def impedance(self) -> float:
        """Rho c, Pa s/m."""
        return self.density * self.wave_speed

    def pressure(self, t: float) -> float:
        """Pressure at the end that is struck, Pa."""
        return float(np.interp(t, [0, self.rise, self.rise + self.fall], [0, self.peak, 0]))

    def first_plane(self, strength: float) -> float:
        """Distance of the first spall plane from the free end, m, for a strength in Pa."""
        return strength * self.wave_speed * self.fall / (2 * self.peak)

    def piece_speed(self, strength: float) -> float:
        """Speed of the piece that leaves, m/s."""
        return (2 * self.peak - strength) / self.impedance


@dataclass(frozen=True)
class SpalledBar:
    """Bar at the end: distances of nodes from the free end, m; openings there, m; velocities of its nodes, m/s."""

    distance: Values
    opening: Values
    velocity: Values


def spall(pulse: Pulse, strength: Values, energy: float, end: float) -> SpalledBar:
    """The bar at a time `end` (s), whose nodes open by sigma = f_t exp(-w f_t / G_c); at once where G_c = 0.

    Equal steps of one node each along both characteristics, which is exact but for the law of the openings, of first
    order. `strength` (nodes,), Pa: the last node is the free end, and neither end opens.
    """
    count, z = len(strength), pulse.impedance
    dt = pulse.length / (count - 1) / pulse.wave_speed
    sigma: Values = np.zeros(count)
    before: Values = np.zeros(count)
    after: Values = np.zeros(count)
    opened = np.zeros(count)
    largest: Values = np.zeros(count)
    from_left, from_right = np.zeros((2, count))
    inside = np.arange(count)[1:-1]
    for step in range(1, round(end / dt) + 1):
        # sigma - z v is kept by waves to the right, sigma + z v by those to the left.
        from_left[1:], from_right[:-1] = sigma[:-1] - z * after[:-1], sigma[1:] + z * before[1:]
        sigma = (from_left + from_right) / 2
        sigma[0], sigma[-1] = -pulse.pressure(step * dt), 0.0
        k = inside[(largest[inside] > 0) | (sigma[inside] >= strength[inside])]
        opened[k], sigma[k] = _open(sigma[k], opened[k], largest[k], strength[k], energy, z / dt)
        largest = np.maximum(largest, opened)
        before, after = (sigma - from_left) / z, (from_right - sigma) / z
        before[0], after[-1] = after[0], before[-1]
    distance = pulse.length * (1 - np.arange(count) / (count - 1))
    return SpalledBar(distance, largest, (before + after) / 2)


def _open(
    whole: Values, opened: Values, largest: Values, strength: Values, energy: float, stiffness: float
) -> tuple[Values, Values]:
    """Openings and stresses (n,) after a step, where `whole` is the stress of nodes that do not open."""

    def stress(w: Values) -> Values:
        return whole - stiffness / 2 * (w - opened)

    if energy == 0:
        free = np.maximum(opened + 2 / stiffness * whole, 0.0)
        return np.maximum(free, 1e-30), stress(free)
    low, high = largest, np.maximum(opened + 2 / stiffness * np.maximum(whole, 0.0), largest)
    grows = stress(low) > strength * np.exp(-low * strength / energy)
    for _ in range(50):
        middle = (low + high) / 2
        above = stress(middle) > strength * np.exp(-middle * strength / energy)
        low, high = np.where(above, middle, low), np.where(above, high, middle)
    secant = strength * np.exp(-largest * strength / energy) / np.maximum(largest, 1e-30)
    closing = np.maximum((whole + stiffness / 2 * opened) / (secant + stiffness / 2), 0.0)
    w = np.where(grows, high, closing)
    return w, stress(w)
