"""A step of a free obstacle: its pose as the minimum of an incremental potential, for a body that is where it is.

z (k,) is its way in the step, pose(z) = start moved by q = ways @ z, E(z) and V(z) the energies of contact and weight.
The scheme of the study steps the momentum M dz/dt as it steps that of every node, with M (inertia in axes of space)
held where the obstacle will be half-way; its unknown is s z, s the level of the step where forces balance (term.Level),
contact enters as a blow of factor k (blow), and

    Phi(z) = c_a / 2 (s z - z_a) . M (s z - z_a) + s^2 (k E(z) + V(z)) - s b . z,    b: (1 - s) times the weight.

So the linear momentum that body and obstacle exchange is the same to the last digit, in 2D the angular one too, and
without a moment the angular momentum of a body that tumbles stays as it is. In 3D a moment would act through J(w)^T
(turn), an error of the order of the turn in a step; the momentum at the end is therefore that of the moment itself.

Equations: docs/theory.md#rigid-obstacles.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...forms.schemes import Scheme
from ..blow import given
from .free_obstacle import Flight, FreeObstacle
from .pose import Pose, Values
from .push import Push
from .together import Pushes, Together
from .turn import bend, jacobian


@dataclass(frozen=True, eq=False)
class RigidStep:
    """One obstacle in one step.

    Attributes:
        body, start: what moves, and how at the start.    scheme, dt: of the step, s.    c_a, share: of the level.
        factor: k.
    """

    body: FreeObstacle
    start: Flight
    scheme: Scheme
    dt: float
    c_a: float
    share: float
    factor: float

    # --- what holds during the step ---

    @cached_property
    def M(self) -> Values:
        """(k, k) half-way of a step that goes on as it began."""
        half = 0.5 * self.dt * self._rate(self.start.pose)
        return self.body.matrix(self.start.pose.moved(self.body.ways @ half).rotation)

    def _rate(self, pose: Pose) -> Values:
        return _over(self.body.matrix(pose.rotation), self.start.momentum)

    @cached_property
    def _motion(self) -> tuple[Values, Values]:
        """(z, dz/dt) and its rate at the start, by the momentum and the mass half-way."""
        return _over(self.M, self.start.momentum), _over(self.M, self.start.force)

    @cached_property
    def z_a(self) -> Values:
        """(k,) level of s z without acceleration."""
        return np.asarray(self.scheme.references(self.dt, np.zeros(len(self.M)), *self._motion)[0])

    @cached_property
    def before(self) -> Values:
        """(k,) b."""
        late = 1 - self.share
        return np.asarray(-late * self.body.ways.T @ self.body.weight(self.start.pose)[1])

    @cached_property
    def ahead(self) -> Values:
        """(k,) z of free flight, with the weight of the start."""
        weight = -self.body.ways.T @ self.body.weight(self.start.pose)[1]
        return np.asarray((self.z_a + _over(self.M, self.before + self.share * weight) / self.c_a) / self.share)

    # --- where it goes ---

    def increment(self, z: Values) -> Values:
        """(p,) q."""
        return np.asarray(self.body.ways @ z)

    def pose(self, z: Values) -> Pose:
        """Where it is then."""
        return self.start.pose.moved(self.increment(z))

    def onward(self, z: Values, dz: Values) -> Values:
        """(p,) increment of the pose at z that dz is, to first order."""
        q = self.increment(dz)
        q[self.start.pose.dim :] = self._jacobian(z) @ q[self.start.pose.dim :]
        return q

    def _jacobian(self, z: Values) -> Values:
        return jacobian(self.increment(z)[self.start.pose.dim :])

    def by_way(self, z: Values) -> Values:
        """(p, k) derivative of the increment of the pose at z by z."""
        T = self.body.ways.copy()
        d = self.start.pose.dim
        T[d:] = self._jacobian(z) @ T[d:]
        return T

    # --- the potential ---

    def own(self, z: Values) -> float:
        """Phi without contact, J."""
        away = self.share * z - self.z_a
        inertia = self.c_a / 2 * float(away @ self.M @ away)
        return inertia + self.share**2 * self.body.weight(self.pose(z))[0] - self.share * float(self.before @ z)

    def system(self, z: Values, contact: Push) -> tuple[Values, Values, Values]:
        """(k,) gradient of Phi / s, (k, k) Hessian of Phi / s^2, and its part that is positive definite."""
        d, T = self.start.pose.dim, self.by_way(z)
        _, by_pose, twice = self.body.weight(self.pose(z))
        forces = self.factor * contact.gradient + by_pose
        gradient = self.c_a * self.M @ (self.share * z - self.z_a) + self.share * T.T @ forces - self.before
        stiffness = self.c_a * self.M + self.factor * T.T @ contact.stiffness @ T
        bent = np.zeros_like(twice)
        bent[d:, d:] = bend(self.increment(z)[d:], forces[d:])
        curved = T.T @ (self.factor * contact.hessian + twice) @ T
        hessian = self.c_a * self.M + curved + self.body.ways.T @ bent @ self.body.ways
        return gradient, hessian, stiffness

    def scale(self, z: Values) -> float:
        """Energies that Phi is the difference of, J."""
        moved = self.share * z
        return self.c_a / 2 * float(moved @ self.M @ moved + self.z_a @ self.M @ self.z_a)

    def settle(
        self, z: Values, contact: Callable[[Values], Push], free: Callable[[Values, Values], float]
    ) -> tuple[Values, Push]:
        """(k,) the z of least Phi that is reached from z on ways that pass through nothing, and what contact does
        there (collective).

        `contact`: z -> Push, of all ranks.    `free`: share of the way from z by dz on which no gap closes.
        """
        found, now = Together([self]).settle(
            [z], lambda ways: Pushes([contact(ways[0])]), lambda ways, changes: free(ways[0], changes[0])
        )
        return found[0], now.each[0]

    def arrived(self, z: Values, force: Values) -> Flight:
        """How it moves at the end, which is at z, with force and moment (p,) of the body on it there, N and N m."""
        pose = self.pose(z)
        weight = self.body.ways.T @ -self.body.weight(pose)[1]
        struck = self.share * self.factor * _over(self.M, self.body.ways.T @ force) / self.c_a
        reached = self.z_a + _over(self.M, self.share * weight + self.before) / self.c_a + struck
        _, rate, change = self.scheme.finish(self.dt, reached, np.zeros(len(z)), *self._motion)
        carried = change - given(self.scheme, self.dt, struck)
        return Flight(pose, self.M @ rate, self.M @ carried, self._turned(pose, z))

    def _turned(self, pose: Pose, z: Values) -> Values:
        if pose.dim == 2:
            return self.start.turned + self.increment(z)[2:]
        return pose.turned()


def _over(matrix: Values, values: Values) -> Values:
    """A^-1 b."""
    return np.asarray(np.linalg.solve(matrix, values), np.float64)
