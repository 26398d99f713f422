"""What an obstacle does to the points of a surface: barrier and lagged friction, with the forces of both.

The gap to a round obstacle over a step in which a point slides around it.

With the normal n at the end of a way d from gap g_n to g the force of a barrier does p n . d, and not p (g - g_n): more
by p e~, e~ = n . d - (g - g_n) about d . H d / 2 of the curvature H, which a point that slides around a ball gains in
every step. With the normal n_n of the start it loses as much. The barrier acts on

    f = g - e / 2,    e = g - g_n - n_n . d,    so that its force has the direction (n + n_n) / 2

and is right to second order. Where e is no longer small beside g, f = g (g + e / 2) / (g + e): open wherever g is.
The start is seen from the obstacle, and goes with it.

Equations: docs/theory.md#contact-in-a-time-step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import numpy.typing as npt

from .friction import CoulombFriction
from .laws import GapPotential, TimeAveragedPotential
from .pose import Pose, PosedShape

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
HUGE_STIFFNESS = 1e150  # N/m, of a gap that is closed or as good as that


@dataclass(frozen=True, eq=False)
class StepStart:
    """Points as a step began.

    Attributes:
        gap: (n,) of all, m.    known: (k,) those that the barrier acted on.    normal, place: (k, d) of these, m.
    """

    gap: Values
    active: Ints
    normal: Values
    position: Values

    @classmethod
    def from_gaps(cls, gap: Values, dim: int) -> StepStart:
        """Of points of which nothing but gaps (n,), m, is known: f = g."""
        return cls(gap, np.empty(0, np.int64), np.empty((0, dim)), np.empty((0, dim)))

    def carried_with(self, then: Pose, now: Pose) -> StepStart:
        """As it is where the obstacle has gone from one pose to another."""
        normal = now.vectors_to_space(self.normal @ then.rotation)
        return StepStart(self.gap, self.active, normal, now.points_to_space(then.to_body(self.position)))

    def curved_gap(self, points: Ints, gap: Values, normal: Values, x: Values) -> CurvedGap:
        """f of some points (m,), those that are known among them, with gaps (m,) and normals (m, d) at places x."""
        e, turned, has = np.zeros(len(points)), np.zeros_like(x), np.zeros(len(points), bool)
        at = np.searchsorted(points, self.active)
        e[at] = gap[at] - self.gap[self.active] - np.einsum("ni,ni->n", self.normal, x[at] - self.position)
        turned[at], has[at] = normal[at] - self.normal, True
        return CurvedGap.from_gaps(gap, e, normal, turned, has)


@dataclass(frozen=True, eq=False)
class CurvedGap:
    """f of points before an obstacle.

    Attributes:
        value: (m,) m.    gradient: (m, d).    of_curvature: (m,) its second derivative is that share of the gap's, and
            rest: (m, d, d), 1/m.
    """

    value: Values
    gradient: Values
    curvature_factor: Values
    remainder: Values

    @classmethod
    def from_gaps(cls, g: Values, e: Values, n: Values, m: Values, has: npt.NDArray[np.bool_]) -> CurvedGap:
        """Of gaps g and excesses e (k,) with gradients n and m (k, d); f = g but where it `has` an excess.

        Before hollow obstacles e is negative, and f = g - e / 2.
        """
        over = np.where((e > 0) & (g > 0), e, 0.0)
        whole = np.where(over > 0, g + over, 1.0)
        s, t = np.where(over > 0, g / whole, 1.0), over / whole  # s + t = 1
        value = np.where(over > 0, g * (s + t / 2), g - np.where(has & (g > 0), np.minimum(e, 0.0), 0.0) / 2)
        by_g, by_e = 1 - t**2 / 2, np.where(has, -(s**2) / 2, 0.0)
        gg, ge, ee = (np.where(over > 0, each / whole, 0.0)[:, None, None] for each in (t**2, -s * t, s**2))
        nn, nm, mm = (a[:, :, None] * b[:, None, :] for a, b in ((n, n), (n, m), (m, m)))
        rest = gg * nn + ge * (nm + nm.transpose(0, 2, 1)) + ee * mm
        return cls(value, by_g[:, None] * n + by_e[:, None] * m, by_g + by_e, rest)


@dataclass(frozen=True)
class LaggedContact:
    """Where a step began: points in touch then, whose friction of the step is lagged.

    Attributes:
        points: (k,) of the surface.    force: (k,) normal force, N.    normal: (k, d).    start: (k, d) places, m.
        under: (k, d) places that the obstacle presses at, m.
    """

    points: Ints
    force: Values
    normal: Values
    position: Values
    obstacle_point: Values


class FacetCoupling(Protocol):
    """What acts between points and not at each alone (facet_contact)."""

    @property
    def corners(self) -> Ints:
        """(k, c) points."""

    @property
    def hessian(self) -> Values:
        """(k, c d, c d) minus the derivative of the forces, N/m."""

    @property
    def stiffness(self) -> Values:
        """(k, c d, c d) the same, positive semi-definite together with that of the points."""


@dataclass(frozen=True)
class ContactForces:
    """Points in touch with one obstacle, and what acts on them.

    Attributes:
        points: (k,) of the surface, with a gap below the barrier's width or gripped by friction.
        energy: of the barrier, J.    normal, friction: (k, d) forces on the points, N.
        potential: J, of which both are minus the derivatives.
        make_parts: gives `exact` and `stick`, once they are asked for.
        between: what acts between them, its forces being among `normal` (facet_contact); None: nothing does.
    """

    points: Ints
    energy: float
    normal: Values
    friction: Values
    potential: float
    make_hessians: Callable[[], tuple[Values, Values]]
    facets: FacetCoupling | None = None

    @cached_property
    def _hessians(self) -> tuple[Values, Values]:
        return self.make_hessians()

    @property
    def normal_hessian(self) -> Values:
        """(k, d, d) minus the derivative of the normal forces, N/m."""
        return self._hessians[0]

    @property
    def friction_hessian(self) -> Values:
        """(k, d, d) that of friction, positive semi-definite, N/m."""
        return self._hessians[1]

    @cached_property
    def normal_stiffness(self) -> Values:
        """(k, d, d) the part of `exact` that is positive semi-definite, N/m."""
        return positive_part(self.normal_hessian)

    @property
    def stiffness(self) -> Values:
        """(k, d, d) minus the derivative of the forces, positive semi-definite, N/m."""
        return self.tangent(exact=False)

    def tangent(self, *, exact: bool) -> Values:
        """(k, d, d) the same, or `exact`, N/m."""
        return (self.normal_hessian if exact else self.normal_stiffness) + self.friction_hessian


def lag_contact(x: Values, gap: Values, area: Values, placed: PosedShape, barrier: GapPotential) -> LaggedContact:
    """Normal forces at places x (n, d) of the start of a step, with gaps (n,), m."""
    near = np.flatnonzero((gap > 0) & (gap < barrier.width) & (area > 0))
    return LaggedContact(near, -area[near] * barrier.slope(gap[near]), placed.normal(x[near]), x[near], x[near])


def evaluate_points(
    x: Values,
    area: Values,
    placed: PosedShape,
    barrier: GapPotential,
    held: LaggedContact | None,
    friction: CoulombFriction | None,
    way: Values,
    start: StepStart | None = None,
) -> ContactForces:
    """What acts at places x (n, d); `way`: (d,) of the obstacle since the step's start, or (k, d) of its places under
    the points that are held, m; `start`: all as they were then, where the barrier acts along the way (along, bent).

    The barrier's energy is the integral of b(gap) over the surface, each point with its area.
    """
    gap = placed.distance(x)
    near = ((gap if start is None else np.minimum(gap, start.gap)) < barrier.width) & (area > 0)
    if friction is not None and held is not None:
        near[held.points] = True
    points = np.flatnonzero(near)
    gap, share, at = gap[points], area[points], x[points]
    normal = placed.normal(at)
    acting = barrier if start is None else TimeAveragedPotential(barrier, start.gap[points])
    bent = None if start is None else start.curved_gap(points, gap, normal, at)
    along, value = (normal, gap) if bent is None else (bent.gradient, bent.value)
    slope = acting.slope(value)
    rubbed, rubbing = np.zeros_like(at), 0.0
    if friction is not None and held is not None and len(held.points):
        moved = x[held.points] - held.position - way
        rubbed[np.searchsorted(points, held.points)] = -friction.gradient(held.force, held.normal, moved)
        rubbing = float(friction.energy(held.force, held.normal, moved).sum())

    def parts() -> tuple[Values, Values]:
        stiff = acting.curvature(value)[:, None, None] * along[:, :, None] * along[:, None, :]
        curved = placed.curvature(at)
        if bent is not None:
            curved = bent.curvature_factor[:, None, None] * curved + bent.remainder
        exact = share[:, None, None] * (stiff + slope[:, None, None] * curved)
        stick = np.zeros_like(exact)
        if friction is not None and held is not None and len(held.points):
            stick[np.searchsorted(points, held.points)] = friction.hessian(held.force, held.normal, moved)
        return exact, stick

    energy, potential = float(share @ barrier.energy(gap)), float(share @ acting.energy(value))
    return ContactForces(points, energy, -(share * slope)[:, None] * along, rubbed, potential + rubbing, parts)


def no_contact(d: int) -> ContactForces:
    """What an obstacle does that is far away."""
    none = np.empty((0, d))
    return ContactForces(np.empty(0, np.int64), 0.0, none, none, 0.0, lambda: (np.empty((0, d, d)),) * 2)


def positive_part(blocks: Values) -> Values:
    """(n, d, d) symmetric blocks without their negative eigenvalues: a tangent that CG can solve with. Nothing of gaps
    that are closed (barrier.HUGE): there is no step from there."""
    is_open = np.all(abs(blocks) < HUGE_STIFFNESS, axis=(1, 2), keepdims=True)
    values, vectors = np.linalg.eigh(np.where(is_open, blocks, 0.0))
    return np.asarray((vectors * np.maximum(values, 0.0)[:, None, :]) @ vectors.transpose(0, 2, 1))
