"""Speeds of waves."""

from __future__ import annotations


def rayleigh_speed[Numbers](shear: Numbers, poisson: Numbers) -> Numbers:
    """c_R, m/s, of waves along a free surface, which no crack that opens outruns, from the speed of shear waves c_s,
    m/s, and Poisson's ratio in plane strain.

    c_R = c_s (0.862 + 1.14 nu) / (1 + nu), within 0.7 % of the root of Rayleigh's equation from nu = 0.1 on, 1.4 % at 0
    (Freund 1990).
    """
    return shear * (0.862 + 1.14 * poisson) / (1 + poisson)  # type: ignore[operator]
