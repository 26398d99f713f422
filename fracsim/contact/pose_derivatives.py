"""Derivatives of contact by the pose of a rigid obstacle.

Points depend on the obstacle through x - c alone, in its frame. With D the energy of a point by its position there, y
its arm and J = [-1, G(y)] (pose), the derivative by an increment (t, w) is J^T D'. The second derivative is J^T D'' J
and, of forces D' that rotate with the obstacle, G(D') between t and w and `rotation_second_derivative` in w.

Equations: docs/theory.md#rigid-obstacles.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix

from ..mesh.parallel import sum_over_ranks
from .node_contact import ContactForces, LaggedContact
from .pose import Pose, rotation_derivative, rotation_second_derivative

if TYPE_CHECKING:
    from .mesh_obstacle_term import MeshObstacleTerm
    from .obstacle_term import ObstacleTerm

Values = npt.NDArray[np.float64]


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
        self._jacobian = _jacobian(self._arm)
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
            self._friction_jacobian = _jacobian(self._friction_arm)
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


def carried_point_derivatives(contact: ContactForces, x: Values, pose: Pose, *, exact: bool) -> PoseDerivatives:
    """Derivatives of contact of points x (n, d), m, that the obstacle itself carries, by its pose."""
    arm = x[contact.points] - pose.centre
    J, d = _jacobian(arm), pose.dim
    hessian = _product(J, contact.tangent(exact=exact) @ J)
    if exact:
        hessian[d:, d:] += rotation_second_derivative(-contact.normal, arm).sum(axis=0)
    # points move by -J q
    return PoseDerivatives(contact.potential, np.einsum("ndp,nd->p", J, contact.normal), hessian)


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
    by_second = contact.tangent(exact=exact) @ _jacobian(points - second.centre)
    if exact:
        by_second[:, :, d:] += rotation_derivative(contact.normal)
    return -_product(_jacobian(points - carrier.centre), by_second)


def point_set_derivatives(
    energy: float, gradient: Values, blocks: csr_matrix, arm: Values, *, exact: bool
) -> PoseDerivatives:
    """Derivatives by the pose of an energy of all points that the obstacle carries.

    Args:
        energy: J.
        gradient: (m, d) by the points, N.
        blocks: (m d, m d) second derivatives by the points, N/m, or their positive semi-definite part.
        arm: (m, d) of the points about the centre, m.
        exact: whether the second derivatives are exact.
    """
    d, J = arm.shape[1], point_jacobian(arm).reshape(arm.size, -1)
    hessian = np.asarray(J.T @ (blocks @ J))
    if exact:
        hessian[d:, d:] += rotation_second_derivative(gradient, arm).sum(axis=0)
    return PoseDerivatives(energy, J.T @ gradient.reshape(-1), hessian)


def point_jacobian(arm: Values) -> Values:
    """(m, d, p) derivatives of points with arms (m, d), m, by an increment of the pose."""
    return -_jacobian(arm)


def contact_wrench(contact: ContactForces, x: Values, pose: Pose) -> Values:
    """(p,) force and moment of the body, points x (n, d), on the obstacle about its reference point, N and N m."""
    return resultant(-(contact.normal + contact.friction), x[contact.points] - pose.centre)


def resultant(force: Values, arm: Values) -> Values:
    """(p,) sums of forces (n, d) and of their moments arm x force."""
    moment = -np.einsum("ndr,nd->r", rotation_derivative(arm), force)
    return np.concatenate([force.sum(axis=0), moment])


def closing_distance(start: Pose, end: Pose, x: Values, force: Values, motion: Values) -> float:
    """Largest approach in a step of an obstacle and the points that it pushes, m.

    Args:
        start: pose of the obstacle.
        end: its pose at the end of the step.
        x: (n, d) points of the body then, m.
        force: (n, d) normal forces on these, N.
        motion: (n, d) of these without contact, m.
    """
    size = np.linalg.norm(force, axis=1)
    pushed = size > 0
    obstacle_motion = x[pushed] - start.points_to_space(end.to_body(x[pushed]))
    normal = force[pushed] / size[pushed, None]
    distance = np.einsum("ni,ni->n", obstacle_motion - motion[pushed], normal)
    return float(distance.max(initial=0.0))


def _jacobian(arm: Values) -> Values:
    """(n, d, p) J of arms (n, d), m."""
    d, by_rotation = arm.shape[1], rotation_derivative(arm)
    J = np.empty((len(arm), d, d + by_rotation.shape[2]))
    J[:, :, :d], J[:, :, d:] = -np.eye(d), by_rotation
    return J


def _product(J: Values, values: Values) -> Values:
    """(p, q) sum of J^T V over n points, J (n, d, p), V (n, d, q)."""
    n, d, p = J.shape
    return np.asarray(J.reshape(n * d, p).T @ values.reshape(n * d, values.shape[2]))


class PoseContact:
    """Contact of the body with some obstacles, as the obstacles see it.

    Attributes:
        group: these obstacles.
    """

    def __init__(self, term: ObstacleTerm | MeshObstacleTerm) -> None:
        """`term`: of the contact; one of explicit steps is asked for `wrenches` alone."""
        self._term, self.group = term, term.group
        self._free = [(number, self.group.numbers.index(number)) for number in self.group.free]

    def poses_moved(self) -> None:
        """Take over the poses of obstacles, and discard forces (not collective)."""
        self._term.poses_moved()

    def wrenches(self) -> dict[int, Values]:
        """(p,) force and moment of the body on free ones at the current u, N and N m, of all ranks (collective)."""
        if not self._free or self._term.is_far():
            return {number: np.zeros_like(self.group.bodies.increments[number]) for number, _ in self._free}
        return self._summed([self._term.rank_wrench(index) for _, index in self._free])

    def _summed(self, local: Sequence[Values]) -> dict[int, Values]:
        """Sums over the ranks of values of free obstacles, by their numbers (collective)."""
        sums = sum_over_ranks(self._term.comm, np.array(local))
        return {number: values for (number, _), values in zip(self._free, sums, strict=True)}

    # --- in implicit steps ---

    def rest_fraction(self, increments: Mapping[int, Values], u: Values | None) -> float:
        """Fraction of increments (p,) from the current poses on which no gap to the body closes (collective).

        `u`: (owned dofs,) displacement of the body at rest, m; None: the current one at the end of the step.
        """
        u, posed = self._term.end_displacement if u is None else u, self.group.posed
        moving = {i: (posed[i], increments[n]) for i, n in enumerate(self.group.numbers) if n in increments}
        return self._term.safe_fraction(u, None, moving) if moving else 1.0

    def start_fraction(self, number: int, q: Values, u: Values) -> float:
        """Fraction of an increment (p,) of an obstacle and the motion of the body that closes no gap (collective).

        Both from the start of the step; `u`: (owned dofs,) displacement of the level after the motion, m.
        """
        level, index = self._term.level, self.group.numbers.index(number)
        change = level.displacement_at_end(u) - level.u_n
        return self._term.safe_fraction(level.u_n, change, {index: (self.group.start_posed[index], q)})

    def pose_derivatives(self, *, exact: bool) -> dict[int, PoseDerivatives]:
        """Energy and derivatives by the poses of free ones, of all ranks (collective)."""
        if not self._free:
            return {}
        parts = [PoseDerivatives.none(len(self.group.bodies.increments[number])) for number, _ in self._free]
        if not self._term.is_far():
            parts = [self._term.rank_derivatives(index, exact=exact) for _, index in self._free]
            rows = [np.concatenate([[part.energy], part.gradient, part.hessian.reshape(-1)]) for part in parts]
            parts = [PoseDerivatives.from_array(row) for row in self._summed(rows).values()]
        return {number: part for (number, _), part in zip(self._free, parts, strict=True)}

    def mixed_hessians(self) -> dict[int, Values]:
        """(owned dofs, p) d2E/dx dq by the increments q of poses, of free ones in contact (collective)."""
        if not self._free or self._term.is_far():
            return {}
        parts = [self._term.rank_mixed_hessian(index) for _, index in self._free]
        touching = self._summed([np.array(part.any(), float) for part in parts])
        items = zip(self._free, parts, strict=True)
        return {
            number: self._term.assemble_mixed_hessian(index, part)
            for (number, index), part in items
            if touching[number]
        }

    def uses_exact_tangent(self) -> bool:
        """Whether the tangent at the current u has negative eigenvalues of contact (collective)."""
        return self._term.uses_exact_tangent()

    @property
    def allows_exact_tangent(self) -> bool:
        """Whether tangents are exact near the solution."""
        return self._term.allows_exact_tangent
