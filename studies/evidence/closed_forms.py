"""Closed forms that the report compares with, each with its source or derivation; SI units, no code of fracsim.

tests/test_evidence_precision.py checks them against the equations that they solve: motion, balance, energy.
"""

from __future__ import annotations

from math import cos as cosine
from math import cosh, pi, sin, sinh, sqrt, tan
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq

Values = npt.NDArray[Any]


# --- beams ---


def timoshenko_deflection(
    force: float, length: float, width: float, depth: float, young: float, poisson: float
) -> float:
    """Deflection (m) of a cantilever under a force at its end: w = P L^3 / (3 E I) + P L / (kappa G A).

    kappa = 10 (1 + nu) / (12 + 11 nu) for a rectangle (Cowper 1966).
    """
    area, inertia = width * depth, width * depth**3 / 12
    kappa, shear = 10 * (1 + poisson) / (12 + 11 * poisson), young / (2 * (1 + poisson))
    return force * length**3 / (3 * young * inertia) + force * length / (kappa * shear * area)


def euler_frequency(length: float, depth: float, young: float, density: float) -> float:
    """First frequency (Hz) of an Euler-Bernoulli cantilever; I / A = depth^2 / 12.

    beta L = 1.8751 is the first root of cos cosh = -1, f1 = (beta L)^2 / (2 pi) sqrt(E I / (rho A L^4)).
    """
    root = brentq(lambda b: cosine(b) * cosh(b) + 1, 1.0, 2.5)
    return root**2 / (2 * pi) * sqrt(young * depth**2 / 12 / density) / length**2


def timoshenko_frequency(length: float, depth: float, young: float, poisson: float, density: float) -> float:
    """First frequency (Hz) of a Timoshenko cantilever with shear and rotary inertia, kappa after Cowper.

    Han, Benaroya and Wei (1999), J. Sound Vib. 225, clamped-free beam. With x in units of L, s^2 = E I / (kappa G A
    L^2), r^2 = I / (A L^2), b^2 = rho A L^4 omega^2 / (E I), the transverse motion is exp(i a x), a^2 = b^2 (r^2 +
    s^2)/2 +- sqrt(b^4 (r^2 - s^2)^2 / 4 + b^2); clamped at 0, free at 1. The frequency is the first zero of the
    determinant of the four end conditions, which is set up here instead of expanded.
    """
    kappa = 10 * (1 + poisson) / (12 + 11 * poisson)
    radius2 = depth**2 / 12 / length**2
    shear2 = radius2 * 2 * (1 + poisson) / kappa
    unit = sqrt(young * depth**2 / 12 / density) / length**2  # omega per b, 1/s
    guess = 1.8751**2
    b = brentq(lambda b: _timoshenko_determinant(b, radius2, shear2), 0.7 * guess, 1.05 * guess)
    return float(b * unit / (2 * pi))


def _timoshenko_determinant(b: float, r2: float, s2: float) -> float:
    """Determinant of the end conditions for y = C ch(p x) + S sh(p x) + c cos(q x) + d sin(q x) and the rotation psi.

    Balance of forces, y'' - psi' = -s^2 b^2 y, gives psi = m (C sh + S ch) + n (d cos - c sin). Ends: y = psi = 0 at 0,
    psi' = 0 and y' - psi = 0 at 1.
    """
    half, root = b**2 * (r2 + s2) / 2, sqrt(b**4 * (r2 - s2) ** 2 / 4 + b**2)
    p, q = sqrt(root - half), sqrt(root + half)
    m, n = (p**2 + s2 * b**2) / p, (q**2 - s2 * b**2) / q
    rows = [
        [1, 0, 1, 0],
        [0, m, 0, n],
        [m * p * cosh(p), m * p * sinh(p), -n * q * cosine(q), -n * q * sin(q)],
        [(p - m) * sinh(p), (p - m) * cosh(p), (n - q) * sin(q), (q - n) * cosine(q)],
    ]
    return float(np.linalg.det(np.array(rows, float)))


# --- bars ---


def pulse(t: Values, duration: float) -> Values:
    """sin^4(pi t / duration) from 0 to `duration`, 0 outside. Three continuous derivatives give order 2."""
    inside = (t > 0) & (t < duration)
    return np.where(inside, np.sin(pi * t / duration) ** 4, 0.0)


def pulse_integral(t: Values, duration: float) -> Values:
    """Integral of `pulse` from 0 to t, s: sin^4 a = 3/8 - cos(2 a)/2 + cos(4 a)/8."""
    t = np.clip(t, 0.0, duration)
    k = 2 * pi / duration
    return 3 / 8 * t - np.sin(k * t) / (2 * k) + np.sin(2 * k * t) / (16 * k)


def bar_velocity(x: Values, t: float, duration: float) -> Values:
    """Velocity v = p(t - (1 - x)) of d'Alembert's solution on 0 < x < 1 with E = rho = 1, pulled at x = 1 by p(t).

    A traction sends stress p and velocity p / (rho c0) inwards; valid until the wave returns from x = 0.
    """
    return pulse(t - (1 - x), duration)


def bar_displacement(x: Values, t: float, duration: float) -> Values:
    """Displacement int v dt of `bar_velocity`."""
    return pulse_integral(t - (1 - x), duration)


def clamp_stress(t: Values, force: Values) -> Values:
    """Stress at the clamp of a bar of unit L, E, rho under a uniform body force at the (equally spaced) times t.

    A body force of unit impulse gives every point the velocity 1. The clamp at x = 0 stops it with the stress rho c0 =
    1 until the wave has returned from the free end (t = 2), then with -1 for as long, and so on. Hence sigma(t) = int
    b(s) q(t - s) ds with the square wave q of period 4; by the trapezoidal rule.
    """
    step = t[1] - t[0]
    half = np.concatenate([[0.0], np.cumsum((force[1:] + force[:-1]) / 2) * step])  # int b
    result = half.copy()
    for turn in range(1, int(t[-1] / 2) + 1):
        result += 2 * (-1) ** turn * np.interp(t - 2 * turn, t, half, left=0.0)
    return result


# --- finite strain ---


def lame(young: float, poisson: float) -> tuple[float, float]:
    """Lame parameters (mu, lambda) in Pa."""
    return young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))


def stvk_stress(F: Values, young: float, poisson: float) -> Values:
    """First Piola-Kirchhoff stress P = F (2 mu E + lambda tr(E) I), E = (F^T F - I) / 2, in Pa."""
    mu, lmbda = lame(young, poisson)
    E = (F.T @ F - np.eye(3)) / 2
    return np.asarray(F @ (2 * mu * E + lmbda * np.trace(E) * np.eye(3)))


def neo_hookean_stress(F: Values, young: float, poisson: float) -> Values:
    """P = m F (1 - 1/(I_C + 1)) + l (J - alpha) cof F, Smith et al. 2018 eq. 18 (docs/theory.md#elastic-energies)."""
    mu, lmbda = lame(young, poisson)
    m, volumetric = 4 / 3 * mu, lmbda + 5 / 6 * mu
    alpha = 1 + m / volumetric - m / (4 * volumetric)
    J = np.linalg.det(F)
    cofactor = J * np.linalg.inv(F).T
    return np.asarray(m * F * (1 - 1 / (np.sum(F * F) + 1)) + volumetric * (J - alpha) * cofactor)


STRESSES = {"stvk": stvk_stress, "neo-hookean": neo_hookean_stress}


def uniaxial(energy: str, stretch: float, young: float, poisson: float) -> tuple[float, float]:
    """(lateral stretch, P11 in Pa) of a bar with free sides: P22 = 0."""
    stress = STRESSES[energy]

    def state(side: float) -> Values:
        return stress(np.diag([stretch, side, side]), young, poisson)

    side = float(brentq(lambda s: state(s)[1, 1], 0.5, 1.2, xtol=1e-15))
    return side, float(state(side)[0, 0])


# --- plate with a hole ---


def howland_factor(ratio: float) -> float:
    """Peak stress at a hole of diameter `ratio` times the width of a long strip, over the mean stress far away.

    Peterson's fit of Howland's (1930) series, net section: 2 + 0.284 a - 0.600 a^2 + 1.32 a^3, a = 1 - ratio; over a
    for the gross section. 3 in an infinite plate (Kirsch 1898).
    """
    a = 1 - ratio
    return (2 + 0.284 * a - 0.600 * a**2 + 1.32 * a**3) / a


# --- Brazilian disk ---


def hondros(r: Values, radius: float, half_arc: float, pressure: float) -> tuple[Values, Values]:
    """(sigma_x, sigma_y) in Pa at height r on the loaded diameter of a disk; tension positive (Hondros 1959).

    A uniform radial pressure acts on two arcs of angle 2 `half_arc` (radians) around the y axis.
    """
    q, a = (np.asarray(r) / radius) ** 2, half_arc
    first = (1 - q) * sin(2 * a) / (1 - 2 * q * np.cos(2 * a) + q**2)
    second = np.arctan((1 + q) / (1 - q) * tan(a))
    return 2 * pressure / pi * (first - second), -2 * pressure / pi * (first + second)


def disk_stress(x: Values, y: Values, radius: float, half_arc: float, pressure: float, points: int = 200) -> Values:
    """Stress (n, 3) sigma_xx, sigma_yy, sigma_xy in Pa anywhere in the disk of `hondros`.

    Sum over the arcs of the field of two opposite radial forces q per thickness at the ends of a diameter along the
    unit vector e (Michell 1900; Timoshenko and Goodier, section 41). With r1, r2 the vectors from the points of action,
    sigma = -(2 q / pi) ((r1 . e)/|r1|^4 r1 x r1 + (r2 . -e)/|r2|^4 r2 x r2) + q / (pi R) I, where r1 starts at the end
    from which the force pushes along e. Gauss rule over the angle.
    """
    nodes, weights = np.polynomial.legendre.leggauss(points)
    result = np.zeros((len(x), 3))
    X = np.column_stack([x, y])
    for node, weight in zip(nodes, weights, strict=True):
        angle = half_arc * node
        outward = np.array([sin(angle), cosine(angle)])
        force = pressure * radius * half_arc * weight
        for end in (outward, -outward):
            ray = X - radius * end
            factor = -2 * force / pi * (ray @ -end) / np.sum(ray**2, axis=1) ** 2
            result += factor[:, None] * np.column_stack([ray[:, 0] ** 2, ray[:, 1] ** 2, ray[:, 0] * ray[:, 1]])
        result[:, :2] += force / (pi * radius)
    return result


def brazilian_peak(diameter: float, strength: float) -> float:
    """Load pi D sigma_t / 2 (N per metre of thickness) at which the centre of a disk reaches the strength."""
    return pi * diameter * strength / 2


# --- non-local average ---


def kernel_moment(kernel: str) -> float:
    """<q^2> = int g q^2 dA / int g dA over the unit disk; the average of x^2 is x^2 + R^2 <q^2> / 2.

    hat: (1/4 - 1/5) / (1/2 - 1/3) = 3/10; constant: (1/4) / (1/2) = 1/2; gaussian exp(-k q^2) with k = 4.5, with s =
    q^2: int_0^1 s exp(-k s) ds / int_0^1 exp(-k s) ds = 1/k - 1/(exp(k) - 1).
    """
    k = 4.5
    return {"linear": 3 / 10, "constant": 1 / 2, "gaussian": 1 / k - 1 / (np.exp(k) - 1)}[kernel]


# --- plasticity ---


def bilinear_stress(strain: float, young: float, yield_stress: float, hardening: float) -> float:
    """Stress (Pa) of a pulled bar: E e up to the yield stress, then the slope E K / (E + K)."""
    if young * strain <= yield_stress:
        return young * strain
    return yield_stress + (strain - yield_stress / young) * young * hardening / (young + hardening)


def flowing_stress(strain: float, strain_rate: float, elastic: tuple[float, float], flow: Values) -> float:
    """Stress (Pa) of a pulled bar with viscoplastic flow; `elastic` = (E, nu), `flow` = (yield stress, K, rate in 1/s).

    At constant strain the overstress f = s - (Y + K e_p) decays as exp(-rate dt). A flow e_p' reduces the von Mises
    stress by 3 G e_p', hence e_p' = rate f / (3 G + K). In a bar with free sides s = E (e - e_p): f' = E e' - f / T
    with T = (3 G + K) / (rate (E + K)), and f = E e' T (1 - exp(-t / T)) at a time t after yield. With e_p = (E e - Y -
    f) / (E + K) the stress is the bilinear one plus f E / (E + K).
    """
    young, poisson = elastic
    yield_stress, hardening, rate = flow
    fall = (3 * lame(young, poisson)[0] + hardening) / (rate * (young + hardening))  # T, s
    since = max(strain - yield_stress / young, 0.0) / strain_rate
    excess = young * strain_rate * fall * (1 - np.exp(-since / fall))
    return float(bilinear_stress(strain, young, yield_stress, hardening) + excess * young / (young + hardening))
