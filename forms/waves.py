"""Wave speeds. It imports nothing, so that a study is read without UFL."""

from __future__ import annotations


def rayleigh_wave_speed[Numbers](shear: Numbers, poisson: Numbers) -> Numbers:
    """Return c_R, m/s, of waves along a free surface, which bounds the speed of an opening crack.

    c_R = c_s (0.862 + 1.14 nu) / (1 + nu) (Freund 1990), within 0.7 % of the root of Rayleigh's equation for nu >= 0.1,
    and 1.4 % at nu = 0.

    Args:
        shear: speed of shear waves c_s, m/s.
        poisson: Poisson's ratio nu; in plane stress that of the equivalent plane strain.
    """
    return shear * (0.862 + 1.14 * poisson) / (1 + poisson)  # type: ignore[operator]
