"""Derivatives of contact by the pose of a rigid obstacle.

Points depend on the obstacle through x - c alone, in its frame. With D the energy of a point by its position there, y
its arm and J = [-1, G(y)] (pose), the derivative by an increment (t, w) is J^T D'. The second derivative is J^T D'' J
and, of forces D' that rotate with the obstacle, G(D') between t and w and `rotation_second_derivative` in w.

Equations: docs/theory.md#rigid-obstacles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from scipy.sparse import csr_matrix

from ..mesh.parallel import sum_over_ranks
from .node_contact import ContactForces, LaggedContact
from .pose import Pose, rotation_derivative, rotation_second_derivative

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


def sum_of_derivatives(local: Sequence[PoseDerivatives], comm: MPI.Intracomm) -> list[PoseDerivatives]:
    """Sums over all ranks of derivatives of several obstacles (collective)."""
    rows = [np.concatenate([[part.energy], part.gradient, part.hessian.reshape(-1)]) for part in local]
    p, result = len(local[0].gradient), []
    for row in sum_over_ranks(comm, np.array(rows)):
        energy, gradient, hessian = np.split(row, [1, 1 + p])
        result.append(PoseDerivatives(float(energy[0]), gradient, hessian.reshape(p, p)))
    return result


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
