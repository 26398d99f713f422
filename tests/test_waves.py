"""Speeds of waves against the equations that they solve."""

from __future__ import annotations

import pytest
from scipy.optimize import brentq

from fracsim.mechanics.stability_limit import rayleigh_wave_speed


@pytest.mark.parametrize(("poisson", "within"), [(0.0, 1.4e-2), (0.1, 7e-3), (0.25, 3e-3), (0.4, 3e-3), (0.49, 3e-3)])
def test_a_rayleigh_wave_leaves_the_surface_free(poisson: float, within: float) -> None:
    """(2 - x^2)^2 = 4 sqrt(1 - x^2) sqrt(1 - k x^2), x = c_R / c_s, k = (c_s / c_p)^2 = (1 - 2 nu) / (2 (1 - nu))."""
    k = (1 - 2 * poisson) / (2 * (1 - poisson))
    x = brentq(lambda x: (2 - x**2) ** 2 - 4 * ((1 - x**2) * (1 - k * x**2)) ** 0.5, 0.5, 0.9999)
    assert rayleigh_wave_speed(3000.0, poisson) == pytest.approx(3000.0 * x, rel=within)
