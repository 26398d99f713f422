"""Laws of contact: barrier and penalty potentials of the gap, and Coulomb friction.

A potential b(g) is an energy per area of the gap g; its pressure is -b'(g). The barrier follows Li et al. (2020,
Incremental Potential Contact), but acts on the distance itself, so that it does not depend on the mesh.

Equations: docs/theory.md#barrier, docs/theory.md#contact-in-a-time-step, docs/theory.md#friction.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..array_types import Values
from ..errors import InputError


@dataclass(frozen=True)
class BarrierPolicy:
    """Tuned numbers of barriers.

    Attributes:
        min_gap_ratio: part of a gap that a step of Newton's method leaves at least. Smaller values need more
            iterations to open the gap again.
        tight_gap: gap, in barrier distances, below which the barrier is made stiffer. There b'' = p / g exceeds the
            stiffness of the body so much that Newton's method creeps.
        target_gap: gap, in barrier distances, at which the stiffer barrier bears the same pressure.
        averaging: c in [0, 1], weight of Radau's rule in the mean of a force over a step. With 1 a gap that steps do
            not resolve oscillates without end; with 0.8 the part c / (2 - c) = 2/3 of the oscillation is left.
        closed_value: Pa and Pa/m, pressure and stiffness of a closed gap. Infinity has no product with 0.
        exact_tangent: motion of points since the last tangent, in barrier distances, below which tangents are exact.
            A tangent without its negative eigenvalues gains less than a digit an iteration to the end. Farther from
            the solution CG may find no solution with them.
    """

    min_gap_ratio: float = 0.1
    tight_gap: float = 3e-3
    target_gap: float = 0.1
    averaging: float = 0.8
    closed_value: float = 1e200
    exact_tangent: float = 0.01

    @property
    def early_weight(self) -> float:
        """Weight in the mean of the force after a third of the step."""
        return 0.75 * self.averaging


BARRIER = BarrierPolicy()
# Share of f1 e that is w at the first tangent. A ball that begins to roll took 58 iterations in ten steps with exact
# tangents, 48 with 1, 43 with 0.5, and 44 with 0, which takes more where points slide on.
FIRST_DIRECTION = 0.5


class GapPotential(Protocol):
    """Energy per area of gaps g (n,), m, that are smaller than a width."""

    @property
    def width(self) -> float:
        """Gap from which on nothing acts, m."""

    def energy(self, g: Values) -> Values:
        """(n,) b, J/m^2."""

    def slope(self, g: Values) -> Values:
        """(n,) b', Pa: minus the pressure."""

    def curvature(self, g: Values) -> Values:
        """(n,) b'', Pa/m."""


@dataclass(frozen=True)
class ObstacleLaw:
    """Law of contact with obstacles.

    Attributes:
        barrier: potential of the gap.
        sticking_speed: slip velocity below which friction counts as sticking, m/s.
        sticking_ratio: the same, in the largest slip velocity at the start of the step.
    """

    barrier: GapPotential
    sticking_speed: float
    sticking_ratio: float = 0.0


@dataclass(frozen=True)
class Barrier:
    """Logarithmic barrier b(g) = -kappa d (s - 1)^2 ln s, s = g / d; 0 from s = 1 on, where it is C2.

    The pressure -b'(g) grows without bound as a gap closes.

    Attributes:
        stiffness: kappa, Pa.
        width: d, m.
    """

    stiffness: float
    width: float

    def __post_init__(self) -> None:
        """Raise InputError unless both are positive and finite."""
        _require_positive("a barrier", stiffness=self.stiffness, width=self.width)

    def energy(self, g: Values) -> Values:
        """(n,) b, J/m^2; infinite where a gap is closed."""
        s = self._relative_gap(g)
        return self._where_open(g, -self.stiffness * self.width * (s - 1) ** 2 * np.log(s), np.inf)

    def slope(self, g: Values) -> Values:
        """(n,) b', Pa: minus the pressure, never positive; -closed_value where a gap is closed."""
        s = self._relative_gap(g)
        return self._where_open(g, -self.stiffness * (s - 1) * (2 * np.log(s) + (s - 1) / s), -BARRIER.closed_value)

    def curvature(self, g: Values) -> Values:
        """(n,) b'', Pa/m; never negative."""
        s = self._relative_gap(g)
        # equal to 2 ln s + 3 - 2 / s - 1 / s^2, but without cancellation at s = 1
        factor = 2 * np.log1p(s - 1) + (s - 1) * (3 * s + 1) / s**2
        return self._where_open(g, -self.stiffness / self.width * factor, BARRIER.closed_value)

    def _relative_gap(self, g: Values) -> Values:
        """(n,) s within (0, 1]; 1, where all derivatives vanish, for gaps beyond the width and for closed ones."""
        return np.where((g > 0) & (g < self.width), g, self.width) / self.width

    @staticmethod
    def _where_open(g: Values, open_value: Values, closed_value: float) -> Values:
        # + 0.0 turns -0.0 into 0.0
        return np.where(g > 0, open_value, closed_value) + 0.0


@dataclass(frozen=True)
class Penalty:
    """Quadratic penalty b(g) = kappa (d - g)^2 / (2 d) below the gap g = d, 0 above, for explicit steps.

    Its force and its stiffness are bounded. The law continues for negative gaps, which explicit steps may reach.

    Attributes:
        stiffness: kappa, Pa, the pressure of a gap that is just closed.
        width: d, m.
    """

    stiffness: float
    width: float

    def __post_init__(self) -> None:
        """Raise InputError unless both are positive and finite."""
        _require_positive("a penalty", stiffness=self.stiffness, width=self.width)

    @property
    def rate(self) -> float:
        """Stiffness b'' = kappa / d, Pa/m."""
        return self.stiffness / self.width

    def energy(self, g: Values) -> Values:
        """(n,) b, J/m^2."""
        return np.asarray(self.rate / 2 * self._penetration(g) ** 2)

    def slope(self, g: Values) -> Values:
        """(n,) b', Pa: minus the pressure."""
        # + 0.0 turns -0.0 into 0.0
        return np.asarray(-self.rate * self._penetration(g)) + 0.0

    def curvature(self, g: Values) -> Values:
        """(n,) b'', Pa/m."""
        return np.where(g < self.width, self.rate, 0.0)

    def _penetration(self, g: Values) -> Values:
        return np.maximum(self.width - g, 0.0)


@dataclass(frozen=True)
class TimeAveragedPotential:
    """Potential whose slope is a mean of the barrier's slope over a time step; for schemes of second order.

        p = 3 c / 4 b'((2 g_n + g) / 3) + (1 - 3 c / 4) b'(g)

    With c = 1 this is Radau's rule, exact for quadratic b'. It never adds energy. The rest damps gaps that steps do
    not resolve (docs/theory.md#contact-in-a-time-step).

    Attributes:
        barrier: b.
        start_gap: (n,) gaps g_n at the start of the step, m.
    """

    barrier: GapPotential
    start_gap: Values

    def energy(self, g: Values) -> Values:
        """(n,) potential of p, J/m^2; infinite where a gap is closed."""
        early, late = self._evaluate_both(self.barrier.energy, g)
        return np.asarray(3 * BARRIER.early_weight * early + (1 - BARRIER.early_weight) * late)

    def slope(self, g: Values) -> Values:
        """(n,) p, Pa: minus the pressure; never positive."""
        early, late = self._evaluate_both(self.barrier.slope, g)
        return np.asarray(BARRIER.early_weight * early + (1 - BARRIER.early_weight) * late)

    def curvature(self, g: Values) -> Values:
        """(n,) dp/dg, Pa/m; never negative."""
        early, late = self._evaluate_both(self.barrier.curvature, g)
        return np.asarray(BARRIER.early_weight / 3 * early + (1 - BARRIER.early_weight) * late)

    def _evaluate_both(self, function: Callable[[Values], Values], g: Values) -> tuple[Values, Values]:
        """(n,) values after a third of the step and at its end; a gap closed at the end counts as closed before."""
        return function(np.where(g > 0, (2 * self.start_gap + g) / 3, g)), function(g)


def stiffness_factor(relative_gap: float) -> float:
    """Factor of kappa that moves a gap, given in barrier distances, to the target gap at the same pressure.

    It is 1 unless the gap is below the tight gap. The stiffness is never reduced again. Doubling it, as Li et al.
    (2020) do, takes ten steps for the same.
    """
    if not 0 < relative_gap < BARRIER.tight_gap:
        return 1.0
    tight, target = Barrier(1.0, 1.0).slope(np.array([relative_gap, BARRIER.target_gap]))
    return float(tight / target)


@dataclass(frozen=True)
class CoulombFriction:
    """Lagged Coulomb friction of points: the potential mu lambda f0(|s|), J.

    lambda (N) and n are the normal force and the unit normal of the step's start, s = (1 - n n^T) motion the slip of
    the step, m. `motion` (n, d) is the motion of a point minus that of the obstacle under it. f0' = f1 is
    2 y / h - (y / h)^2 below y = h and 1 above, so that f0 is convex and C2. f0(0) = h / 3 is no stored energy.

    Attributes:
        coefficient: mu.
        sticking_slip: h, slip below which friction counts as sticking, m.
    """

    coefficient: float
    sticking_slip: float

    def __post_init__(self) -> None:
        """Raise InputError unless mu is not negative and h positive."""
        if not 0 <= self.coefficient < np.inf:
            raise InputError(f"the coefficient of friction is {self.coefficient}: it must be 0 or positive")
        if not 0 < self.sticking_slip < np.inf:
            raise InputError(f"the slip that passes for sticking is {self.sticking_slip} m: it must be positive")

    def energy(self, force: Values, normal: Values, motion: Values) -> Values:
        """(n,) mu lambda f0, J; f0 = -y^3 / (3 h^2) + y^2 / h + h / 3 below y = |s| = h, and y above."""
        h, y = self.sticking_slip, np.linalg.norm(tangential(normal, motion), axis=1)
        z = np.minimum(y / h, 1.0)
        return self.coefficient * force * np.where(y < h, h * (z**2 - z**3 / 3 + 1 / 3), y)

    def gradient(self, force: Values, normal: Values, motion: Values) -> Values:
        """(n, d) mu lambda f1 s / |s|, N: minus the friction force; never longer than mu lambda."""
        s = tangential(normal, motion)
        secant, _ = self._secant_and_tangent(np.linalg.norm(s, axis=1))
        return (self.coefficient * force * secant)[:, None] * s

    def hessian(
        self, force: Values, normal: Values, motion: Values, direction: FrictionDirection | None = None
    ) -> Values:
        """(n, d, d) mu lambda (f1 / |s| (T - e e^T) + f1' e e^T), e = s / |s|, N/m; positive semi-definite.

        `direction`: w in place of f1 e, with which f1 / |s| T + (f1' - f1 / |s|) / f1 w e^T is made symmetric. It is
        semi-definite for |w| <= 1.
        """
        s = tangential(normal, motion)
        blocks = self.direction_derivative(normal, s, None if direction is None else direction(s))
        if direction is not None:
            blocks = (blocks + blocks.transpose(0, 2, 1)) / 2
        return np.asarray((self.coefficient * force)[:, None, None] * blocks)

    def direction(self, slip: Values) -> Values:
        """(n, d) f1 e at slips (n, d), m."""
        return np.asarray(self._secant_and_tangent(np.linalg.norm(slip, axis=1))[0][:, None] * slip)

    def direction_derivative(self, normal: Values, slip: Values, direction: Values | None = None) -> Values:
        """(n, d, d) derivative of f1 e by slips (n, d), 1/m; `direction`: (n, d) w in place of f1 e in it."""
        y = np.linalg.norm(slip, axis=1)
        secant, tangent = self._secant_and_tangent(y)
        e = slip / np.maximum(y, np.finfo(float).tiny)[:, None]
        T = np.eye(slip.shape[1]) - normal[:, :, None] * normal[:, None, :]
        if direction is None:
            by_length, direction = tangent - secant, e
        else:  # (f1' - f1 / |s|) / f1, which is -1 / (2 h - |s|) below h
            by_length = -1 / np.where(y < self.sticking_slip, 2 * self.sticking_slip - y, y)
        return np.asarray(secant[:, None, None] * T + (by_length[:, None] * direction)[:, :, None] * e[:, None, :])

    def _secant_and_tangent(self, y: Values) -> tuple[Values, Values]:
        """(n,) f1 / y and f1', 1/m."""
        h = self.sticking_slip
        sticks = y < h
        return np.where(sticks, (2 - y / h) / h, 1 / np.maximum(y, h)), np.where(sticks, 2 * (1 - y / h) / h, 0.0)


@dataclass(frozen=True, eq=False)
class FrictionDirection:
    """Direction w of friction as an unknown of Newton's method beside the slip s, where w = f1(|s|) s / |s|, |w| <= 1.

    Friction of a slip has no stiffness along it. Where a point comes to stick, Newton's method overshoots, and the line
    search takes short steps. The primal-dual method of T. F. Chan, G. H. Golub and P. Mulet (1999), A nonlinear
    primal-dual method for total variation-based image restoration, follows the linearised w instead: a point that has
    overshot keeps the direction in which it slipped, and is stiff against the new one. The solution is the same.

    Attributes:
        law: f1.
        normal: (n, d) unit normals.
        last: (n, d) slips, m, and w of the last tangent; None: there is none.
    """

    law: CoulombFriction
    normal: Values
    last: tuple[Values, Values] | None = None

    def __call__(self, slip: Values) -> Values:
        """(n, d) w at slips (n, d), m."""
        if self.last is None:
            return FIRST_DIRECTION * self.law.direction(slip)
        s, w = self.last
        change = np.einsum("nij,nj->ni", self.law.direction_derivative(self.normal, s, w), slip - s)
        w = self.law.direction(s) + change
        return np.asarray(w / np.maximum(1.0, np.linalg.norm(w, axis=1))[:, None])

    def updated(self, motion: Values) -> FrictionDirection:
        """Directions after a tangent at motions (n, d), m."""
        s = tangential(self.normal, motion)
        return FrictionDirection(self.law, self.normal, (s, self(s)))


def tangential(normal: Values, motion: Values) -> Values:
    """(n, d) part of `motion` (n, d) orthogonal to unit normals (n, d)."""
    return np.asarray(motion - np.einsum("ni,ni->n", normal, motion)[:, None] * normal)


def slipped(stretch: Values, max_length: Values) -> Values:
    """(n, d) stretch (n, d) of springs of friction, m, after those longer than `max_length` (n,) have slipped."""
    length = np.linalg.norm(stretch, axis=1)
    share = np.divide(max_length, length, out=np.ones(len(length)), where=length > max_length)
    return np.asarray(share[:, None] * stretch)


def _require_positive(kind: str, **lengths: float) -> None:
    for word, value in lengths.items():
        if not 0 < value < np.inf:
            raise InputError(f"the {word} of {kind} is {value}: it must be a positive number")
