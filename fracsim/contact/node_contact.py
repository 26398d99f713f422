"""Contact of points of a surface with one obstacle: barrier and lagged friction, with derivatives by points and pose.

Second-order schemes use the curved gap of a step. With the normal n at the end of a motion d from gap g_n to g the
force of a barrier does the work p n . d instead of p (g - g_n). A point that slides round a sphere would gain the
difference, about p d . H d / 2 with the curvature H, in every step. The barrier therefore acts on

    f = g - e / 2,    e = g - g_n - n_n . d,    so that its force has the direction (n + n_n) / 2.

Where e is not small beside g, f = g (g + e / 2) / (g + e), which is open wherever g is. The start of the step is taken
in the frame of the obstacle.

Points depend on the obstacle through x - c alone, in its frame. With D the energy of a point by its position there, y
its arm and J = [-1, G(y)] (pose), the derivative by an increment (t, w) is J^T D'. The second derivative is J^T D'' J
and, of forces D' that rotate with the obstacle, G(D') between t and w and `rotation_second_derivative` in w.

Equations: docs/theory.md#contact-in-a-time-step, docs/theory.md#rigid-obstacles.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ..array_types import Flags, Ints, Values
from .laws import CoulombFriction, FrictionDirection, GapPotential, TimeAveragedPotential
from .pose import (
    Pose,
    PosedShape,
    arm_jacobian,
    point_jacobian,
    resultant,
    rotation_derivative,
    rotation_second_derivative,
)

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

    from .facet_contact import FacetForces


# N/m, of a closed gap (laws.BARRIER.closed_value times an area)
CLOSED_STIFFNESS = 1e150


@dataclass(frozen=True)
class LaggedContact:
    """Contact at the start of a step, with which the friction of the step is lagged.

    Attributes:
        points: (k,) of the surface.
        force: (k,) normal forces, N.
        normal: (k, d) unit normals.
        position: (k, d) positions of the points, m.
        obstacle_point: (k, d) points of the obstacle that press on them, m.
    """

    points: Ints
    force: Values
    normal: Values
    position: Values
    obstacle_point: Values

    def select(self, points: Ints) -> LaggedContact:
        """Contact of points (m,) of the surface, ascending, which are numbered in this order."""
        rows = np.isin(self.points, points)
        arrays = self.force, self.normal, self.position, self.obstacle_point
        return LaggedContact(np.searchsorted(points, self.points[rows]), *(values[rows] for values in arrays))


@dataclass(frozen=True, eq=False)
class StepStart:
    """Points at the start of a step.

    Attributes:
        gap: (n,) gaps of all points, m.
        contact: those on which the barrier acted; None: gaps alone are known, and f = g.
    """

    gap: Values
    contact: LaggedContact | None = None

    def select(self, points: Ints) -> StepStart:
        """Start of points (m,), ascending, which are numbered in this order."""
        return StepStart(self.gap[points], self.contact and self.contact.select(points))

    def carried_with(self, start: Pose, end: Pose) -> StepStart:
        """The same start, moved with an obstacle from its pose at the start to that at the end."""
        if (contact := self.contact) is None:
            return self
        normal = end.vectors_to_space(contact.normal @ start.rotation)
        position = end.points_to_space(start.to_body(contact.position))
        return StepStart(self.gap, replace(contact, normal=normal, position=position))

    def curved_gap(self, points: Ints, gap: Values, normal: Values, x: Values) -> CurvedGap:
        """Curved gap f of points (m,), which include the active ones, with gaps (m,) and normals (m, d) at x (m, d)."""
        e, e_gradient, has_excess = np.zeros(len(points)), np.zeros_like(x), np.zeros(len(points), bool)
        if (contact := self.contact) is not None:
            rows = np.searchsorted(points, contact.points)
            motion = x[rows] - contact.position
            e[rows] = gap[rows] - self.gap[contact.points] - np.einsum("ni,ni->n", contact.normal, motion)
            e_gradient[rows], has_excess[rows] = normal[rows] - contact.normal, True
        return CurvedGap.from_gaps(gap, e, normal, e_gradient, has_excess)


@dataclass(frozen=True, eq=False)
class CurvedGap:
    """Gap f of points to an obstacle with its derivatives.

    Attributes:
        value: (m,) f, m.
        gradient: (m, d).
        curvature_factor: (m,) factor of the gap's own Hessian in that of f.
        remainder: (m, d, d) the other part of the Hessian of f, 1/m.
    """

    value: Values
    gradient: Values
    curvature_factor: Values
    remainder: Values

    @classmethod
    def from_gaps(cls, g: Values, e: Values, n: Values, m: Values, has_excess: Flags) -> CurvedGap:
        """Curved gap of gaps g and excesses e (k,) with gradients n and m (k, d); f = g where there is no excess.

        In hollow obstacles e is negative, and f = g - e / 2.
        """
        positive_e = np.where((e > 0) & (g > 0), e, 0.0)
        total = np.where(positive_e > 0, g + positive_e, 1.0)
        s, t = np.where(positive_e > 0, g / total, 1.0), positive_e / total  # s + t = 1
        negative_e = np.where(has_excess & (g > 0), np.minimum(e, 0.0), 0.0)
        value = np.where(positive_e > 0, g * (s + t / 2), g - negative_e / 2)
        by_g, by_e = 1 - t**2 / 2, np.where(has_excess, -(s**2) / 2, 0.0)
        gg, ge, ee = (np.where(positive_e > 0, f / total, 0.0)[:, None, None] for f in (t**2, -s * t, s**2))
        nn, nm, mm = (a[:, :, None] * b[:, None, :] for a, b in ((n, n), (n, m), (m, m)))
        remainder = gg * nn + ge * (nm + nm.transpose(0, 2, 1)) + ee * mm
        return cls(value, by_g[:, None] * n + by_e[:, None] * m, by_g + by_e, remainder)


@dataclass(frozen=True)
class ContactForces:
    """Forces of one obstacle on points, and their derivatives.

    Attributes:
        points: (k,) of the surface, with a gap below the barrier's width or in lagged contact.
        energy: of the barrier, J.
        normal: (k, d) normal forces on the points, N.
        friction: (k, d) friction forces on the points, N.
        potential: J; both forces are minus its derivatives.
        make_hessians: returns `normal_hessian` and `friction_hessian`; called once, when they are needed.
        min_gap: lower bound of the gaps of all points and facets, m.
        facets: forces on facets, which are in `normal`, and their derivatives; None without any.
    """

    points: Ints
    energy: float
    normal: Values
    friction: Values
    potential: float
    make_hessians: Callable[[], tuple[Values, Values]]
    min_gap: float = 0.0
    facets: FacetForces | None = None

    @cached_property
    def _hessians(self) -> tuple[Values, Values]:
        return self.make_hessians()

    @property
    def normal_hessian(self) -> Values:
        """(k, d, d) minus the derivative of the normal forces, N/m."""
        return self._hessians[0]

    @property
    def friction_hessian(self) -> Values:
        """(k, d, d) minus the derivative of the friction forces, positive semi-definite, N/m."""
        return self._hessians[1]

    @cached_property
    def normal_stiffness(self) -> Values:
        """(k, d, d) positive semi-definite part of `normal_hessian`, N/m."""
        return positive_part(self.normal_hessian)

    def tangent(self, *, exact: bool) -> Values:
        """(k, d, d) minus the derivative of all forces, N/m; positive semi-definite unless `exact`."""
        return (self.normal_hessian if exact else self.normal_stiffness) + self.friction_hessian


def lag_contact(x: Values, gap: Values, area: Values, posed: PosedShape, barrier: GapPotential) -> LaggedContact:
    """Normal forces of the start of a step at points x (n, d) with gaps (n,), m, and areas (n,), m^2."""
    near = np.flatnonzero((gap > 0) & (gap < barrier.width) & (area > 0))
    return LaggedContact(near, -area[near] * barrier.slope(gap[near]), posed.normal(x[near]), x[near], x[near])


def evaluate_points(
    x: Values,
    area: Values,
    posed: PosedShape,
    barrier: GapPotential,
    lagged: LaggedContact | None,
    friction: CoulombFriction | None,
    obstacle_motion: Values,
    start: StepStart | None = None,
    candidates: Ints | None = None,
    direction: FrictionDirection | None = None,
) -> ContactForces:
    """Forces of an obstacle on points; the energy is the integral of b(gap) over the surface.

    Args:
        x: (n, d) positions, m.
        area: (n,) areas of the points, m^2; 0 of those left out.
        posed: the obstacle.
        barrier: b.
        lagged: contact at the start of the step, for friction.
        friction: law of friction.
        obstacle_motion: (d,) motion of the obstacle in the step, or (k, d) of its points in lagged contact, m.
        start: points at the start of the step, where the barrier is averaged over the step.
        candidates: (m,) points, ascending, that may be in contact now; None: all.
        direction: of friction, for its tangent; None: the tangent is exact.
    """
    points = np.arange(len(x)) if candidates is None else candidates
    if start is not None and candidates is not None:
        points = np.union1d(points, np.flatnonzero(start.gap < barrier.width))
    gap = posed.distance(x[points])
    near = ((gap if start is None else np.minimum(gap, start.gap[points])) < barrier.width) & (area[points] > 0)
    points, gap = points[near], gap[near]
    if friction is not None and lagged is not None and len(lagged.points):
        points = np.union1d(points, lagged.points)
        gap = posed.distance(x[points])
    if not len(points):
        return no_contact(x.shape[1], barrier.width)
    point_area, positions = area[points], x[points]
    normal = posed.normal(positions)
    potential = barrier if start is None else TimeAveragedPotential(barrier, start.gap[points])
    curved = None if start is None else start.curved_gap(points, gap, normal, positions)
    gradient, value = (normal, gap) if curved is None else (curved.gradient, curved.value)
    slope = potential.slope(value)
    friction_force, friction_energy = np.zeros_like(positions), 0.0
    if friction is not None and lagged is not None and len(lagged.points):
        motion = x[lagged.points] - lagged.position - obstacle_motion
        rows = np.searchsorted(points, lagged.points)
        friction_force[rows] = -friction.gradient(lagged.force, lagged.normal, motion)
        friction_energy = float(friction.energy(lagged.force, lagged.normal, motion).sum())

    def hessians() -> tuple[Values, Values]:
        along_normal = potential.curvature(value)[:, None, None] * gradient[:, :, None] * gradient[:, None, :]
        gap_hessian = posed.curvature(positions)
        if curved is not None:
            gap_hessian = curved.curvature_factor[:, None, None] * gap_hessian + curved.remainder
        of_normal = point_area[:, None, None] * (along_normal + slope[:, None, None] * gap_hessian)
        of_friction = np.zeros_like(of_normal)
        if friction is not None and lagged is not None and len(lagged.points):
            blocks = friction.hessian(lagged.force, lagged.normal, motion, direction)
            of_friction[np.searchsorted(points, lagged.points)] = blocks
        return of_normal, of_friction

    energy = float(point_area @ barrier.energy(gap))
    total = energy if start is None else float(point_area @ potential.energy(value))
    normal_force = -(point_area * slope)[:, None] * gradient
    min_gap = float(gap.min(initial=barrier.width))
    return ContactForces(points, energy, normal_force, friction_force, total + friction_energy, hessians, min_gap)


def no_contact(d: int, width: float = 0.0) -> ContactForces:
    """Forces of an obstacle from which all points are farther away than the width of its barrier, m."""
    empty = np.empty((0, d))
    return ContactForces(np.empty(0, np.int64), 0.0, empty, empty, 0.0, lambda: (np.empty((0, d, d)),) * 2, width)


def positive_part(blocks: Values) -> Values:
    """(n, d, d) symmetric blocks without their negative eigenvalues, for a tangent that CG can solve with.

    Blocks of closed gaps become 0: Newton's method cannot start from there.
    """
    is_open = np.all(abs(blocks) < CLOSED_STIFFNESS, axis=(1, 2), keepdims=True)
    values, vectors = np.linalg.eigh(np.where(is_open, blocks, 0.0))
    return np.asarray((vectors * np.maximum(values, 0.0)[:, None, :]) @ vectors.transpose(0, 2, 1))


# --- derivatives by the pose of an obstacle ---


@dataclass(frozen=True)
class PoseDerivatives:
    """Energy of contact of one obstacle, and its derivatives by an increment of the pose.

    Attributes:
        energy: of barrier and friction, J.
        gradient: (p,) minus force and moment, N and N m.
        hessian: (p, p), exact or its positive semi-definite part.
    """

    energy: float
    gradient: Values
    hessian: Values

    @classmethod
    def none(cls, size: int) -> PoseDerivatives:
        """Without contact, by p = `size` components."""
        return cls(0.0, np.zeros(size), np.zeros((size, size)))

    @classmethod
    def from_array(cls, numbers: Values) -> PoseDerivatives:
        """From energy, gradient and second derivatives in one row."""
        p = int(np.sqrt(len(numbers) - 0.75) - 0.5)  # 1 + p + p^2 numbers
        return cls(float(numbers[0]), numbers[1 : 1 + p], numbers[1 + p :].reshape(p, p))

    def __add__(self, second: PoseDerivatives) -> PoseDerivatives:
        """Sum of both."""
        sums = self.energy + second.energy, self.gradient + second.gradient, self.hessian + second.hessian
        return PoseDerivatives(*sums)


class PoseCoupling:
    """Contact of points with one obstacle, and how it changes with the pose of the obstacle.

    Friction holds the points of the obstacle that were under the points in lagged contact: with other arms Newton's
    method would creep.
    """

    def __init__(
        self, contact: ContactForces, x: Values, pose: Pose, lagged: LaggedContact | None, start: Pose, *, exact: bool
    ) -> None:
        """Coupling of points and pose.

        Args:
            contact: forces on points.
            x: (n, d) points, m.
            pose: of the obstacle.
            lagged: contact at the start of the step.
            start: pose of the obstacle at the start of the step.
            exact: whether second derivatives are exact; else they are those of the positive semi-definite part.
        """
        self._contact, self._exact, self._arm = contact, exact, x[contact.points] - pose.centre
        self._jacobian = arm_jacobian(self._arm)
        self._by_normal = np.asarray(
            (contact.normal_hessian if exact else contact.normal_stiffness) @ self._jacobian, np.float64
        )
        if (facets := contact.facets) is not None:
            rows = np.searchsorted(contact.points, facets.corners)
            J = self._jacobian[rows]
            k, c, d, p = J.shape
            forces = (facets.hessian if exact else facets.stiffness) @ J.reshape(k, c * d, p)
            np.add.at(self._by_normal, rows, forces.reshape(J.shape))
        self._has_friction = lagged is not None and bool(len(lagged.points))
        if lagged is not None and self._has_friction:
            self._friction_arm, rotation = self._arm.copy(), pose.rotation @ start.rotation.T
            rows = np.searchsorted(contact.points, lagged.points)
            self._friction_arm[rows] = (lagged.obstacle_point - start.centre) @ rotation.T
            self._friction_jacobian = arm_jacobian(self._friction_arm)
            self._by_friction = np.asarray(contact.friction_hessian @ self._friction_jacobian, np.float64)

    def mixed_hessian(self) -> Values:
        """(k, d, p) derivatives of minus the forces on points by an increment of the pose."""
        result = self._by_normal + self._by_friction if self._has_friction else self._by_normal.copy()
        if self._exact:
            result[:, :, self._arm.shape[1] :] += rotation_derivative(self._contact.normal)
        return result

    def derivatives(self) -> PoseDerivatives:
        """Derivatives of the energy of contact by the pose."""
        contact, arm, d = self._contact, self._arm, self._arm.shape[1]
        gradient = -np.einsum("ndp,nd->p", self._jacobian, contact.normal)
        hessian = _product(self._jacobian, self._by_normal)
        if self._exact:  # normal forces rotate with the obstacle
            mixed = rotation_derivative(-contact.normal).sum(axis=0)
            hessian[:d, d:] += mixed
            hessian[d:, :d] += mixed.T
            hessian[d:, d:] += rotation_second_derivative(-contact.normal, arm).sum(axis=0)
        if self._has_friction:
            gradient -= np.einsum("ndp,nd->p", self._friction_jacobian, contact.friction)
            hessian += _product(self._friction_jacobian, self._by_friction)
            if self._exact:
                hessian[d:, d:] += rotation_second_derivative(contact.friction, self._friction_arm).sum(axis=0)
        return PoseDerivatives(contact.potential, np.asarray(gradient), hessian)


def mixed_pose_hessian(contact: ContactForces, x: Values, carrier: Pose, second: Pose, *, exact: bool) -> Values:
    """(p, p) second derivatives of the energy by the poses of a carrier of points and of another obstacle.

    Args:
        contact: forces on points.
        x: (n, d) points, m.
        carrier: pose of the obstacle that carries the points.
        second: pose of the obstacle before them.
        exact: whether they are exact; else those of the positive semi-definite part.
    """
    points, d = x[contact.points], carrier.dim
    by_second = contact.tangent(exact=exact) @ arm_jacobian(points - second.centre)
    if exact:
        by_second[:, :, d:] += rotation_derivative(contact.normal)
    return -_product(arm_jacobian(points - carrier.centre), by_second)


def carried_derivatives(
    energy: float, gradient: Values, hessian: Values | csr_matrix, arm: Values, *, exact: bool
) -> PoseDerivatives:
    """Derivatives by the pose of an energy of points that the obstacle carries.

    Args:
        energy: J.
        gradient: (m, d) by the points, N.
        hessian: second derivatives by the points, N/m, or their positive semi-definite part: (m d, m d), or blocks
            (m, d, d) of points that are independent of one another.
        arm: (m, d) of the points about the centre, m.
        exact: whether the second derivatives are exact.
    """
    d, J = arm.shape[1], point_jacobian(arm)
    by_points = hessian @ J if isinstance(hessian, np.ndarray) else (hessian @ J.reshape(arm.size, -1)).reshape(J.shape)
    by_pose = _product(J, by_points)
    if exact:
        by_pose[d:, d:] += rotation_second_derivative(gradient, arm).sum(axis=0)
    return PoseDerivatives(energy, np.einsum("ndp,nd->p", J, gradient), by_pose)


def contact_wrench(contact: ContactForces, x: Values, pose: Pose) -> Values:
    """(p,) force and moment of the body, points x (n, d), on the obstacle about its reference point, N and N m."""
    return resultant(-(contact.normal + contact.friction), x[contact.points] - pose.centre)


def _product(J: Values, values: Values) -> Values:
    """(p, q) sum of J^T V over n points, J (n, d, p), V (n, d, q)."""
    n, d, p = J.shape
    return np.asarray(J.reshape(n * d, p).T @ values.reshape(n * d, values.shape[2]))
