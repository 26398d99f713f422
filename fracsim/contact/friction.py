"""Coulomb friction as a potential, with normal force and normal of the step's start (docs/theory.md#friction)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..errors import InputError

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class CoulombFriction:
    """mu lambda f0(|s|) a point, J: lambda (N) the lagged normal force, s = (1 - n n^T) moved the slip of a step, m.

    `moved` (n, d): way of the point less that of the obstacle under it; n the lagged normal. f0' = f1 grows from 0 to
    1, f1 = 2 y / h - (y / h)^2 below the slip h = eps_v dt (m) that passes for sticking, and is 1 above: f0 is convex
    and C2. It is h / 3 > 0 where nothing slips, which a book of energies has to leave out.
    """

    coefficient: float
    sticking_slip: float

    def __post_init__(self) -> None:
        """InputError where it is no friction."""
        if not 0 <= self.coefficient < np.inf:
            raise InputError(f"the coefficient of friction is {self.coefficient}: it must be 0 or positive")
        if not 0 < self.sticking_slip < np.inf:
            raise InputError(f"the slip that passes for sticking is {self.sticking_slip} m: it must be positive")

    def energy(self, force: Values, normal: Values, moved: Values) -> Values:
        """(n,) mu lambda f0, J: -y^3 / (3 h^2) + y^2 / h + h / 3 below y = |s| = h, and y above."""
        h, y = self.sticking_slip, np.linalg.norm(tangential(normal, moved), axis=1)
        z = np.minimum(y / h, 1.0)
        return self.coefficient * force * np.where(y < h, h * (z**2 - z**3 / 3 + 1 / 3), y)

    def gradient(self, force: Values, normal: Values, moved: Values) -> Values:
        """(n, d) by the point, mu lambda f1 s / |s|, N: minus the friction force; never longer than mu lambda."""
        s = tangential(normal, moved)
        secant, _ = self._stiffness(np.linalg.norm(s, axis=1))
        return (self.coefficient * force * secant)[:, None] * s

    def hessian(self, force: Values, normal: Values, moved: Values) -> Values:
        """(n, d, d) mu lambda (f1 / |s| (T - e e^T) + f1' e e^T), e = s / |s|, N/m; positive semi-definite."""
        s = tangential(normal, moved)
        y = np.linalg.norm(s, axis=1)
        secant, tangent = self._stiffness(y)
        e = s / np.maximum(y, np.finfo(float).tiny)[:, None]
        T = np.eye(s.shape[1]) - normal[:, :, None] * normal[:, None, :]
        bent = secant[:, None, None] * T + (tangent - secant)[:, None, None] * e[:, :, None] * e[:, None, :]
        return (self.coefficient * force)[:, None, None] * bent

    def _stiffness(self, y: Values) -> tuple[Values, Values]:
        """f1 / y and f1', 1/m."""
        h = self.sticking_slip
        sticks = y < h
        return np.where(sticks, (2 - y / h) / h, 1 / np.maximum(y, h)), np.where(sticks, 2 * (1 - y / h) / h, 0.0)


def tangential(normal: Values, moved: Values) -> Values:
    """(n, d) the part of `moved` across unit normals (n, d)."""
    return np.asarray(moved - np.einsum("ni,ni->n", normal, moved)[:, None] * normal)
