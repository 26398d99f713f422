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
from .node_contact import ContactForces, FacetCoupling, LaggedContact
from .pose import Pose, rotation_derivative, rotation_second_derivative

Values = npt.NDArray[np.float64]


type MixedHessian = tuple[Values, Values]  # (p, p) by two poses: exact, and of the positive part


@dataclass(frozen=True)
class PoseDerivatives:
    """Energy of contact of one obstacle, and its derivatives by an increment of the pose.

    Attributes:
        energy: of barrier and friction, J.
        gradient: (p,) minus force and moment, N and N m.
        hessian: (p, p).
        stiffness: (p, p) positive semi-definite part of the Hessian.
    """

    energy: float
    gradient: Values
    hessian: Values
    stiffness: Values

    def __add__(self, second: PoseDerivatives) -> PoseDerivatives:
        """Sum of both."""
        return PoseDerivatives(
            self.energy + second.energy, self.gradient + second.gradient, self.hessian + second.hessian,
            self.stiffness + second.stiffness,
        )  # fmt: skip


def pose_derivatives(
    contact: ContactForces, x: Values, pose: Pose, lagged: LaggedContact | None, start: Pose
) -> PoseDerivatives:
    """Derivatives of contact of points by the pose of an obstacle.

    Args:
        contact: forces on points.
        x: (n, d) points, m.
        pose: of the obstacle.
        lagged: contact at the start of the step. Friction holds the points of the obstacle that were under it then.
        start: pose of the obstacle at the start of the step.
    """
    arm = x[contact.points] - pose.centre
    J, gradient = _jacobian(arm), -contact.normal
    stiffness, hessian = (_congruence(J, blocks) for blocks in (contact.normal_stiffness, contact.normal_hessian))
    if (facets := contact.facets) is not None:
        facet_J = _facet_jacobian(facets, x, pose)
        stiffness, hessian = (
            stiffness + _congruence(facet_J, facets.stiffness),
            hessian + _congruence(facet_J, facets.hessian),
        )
    hessian = hessian + _rotating_forces(gradient, arm)
    pose_gradient = np.einsum("ndp,nd->p", J, gradient)
    if lagged is not None and len(lagged.points):
        arm = _friction_arms(contact, arm, pose, lagged, start)
        J = _jacobian(arm)
        friction = _congruence(J, contact.friction_hessian)
        pose_gradient = pose_gradient - np.einsum("ndp,nd->p", J, contact.friction)
        stiffness, hessian = stiffness + friction, hessian + friction
        d = pose.dim
        hessian[d:, d:] += rotation_second_derivative(contact.friction, arm).sum(axis=0)
    return PoseDerivatives(contact.potential, pose_gradient, hessian, stiffness)


def sum_of_derivatives(local: Sequence[PoseDerivatives], comm: MPI.Intracomm) -> list[PoseDerivatives]:
    """Sums over all ranks of derivatives of several obstacles (collective)."""
    rows = [
        np.concatenate([[part.energy], part.gradient, part.hessian.reshape(-1), part.stiffness.reshape(-1)])
        for part in local
    ]
    result = []
    for row in sum_over_ranks(comm, np.array(rows)):
        p = len(local[0].gradient)
        energy, gradient, *matrices = np.split(row, [1, 1 + p, 1 + p + p * p])
        result.append(PoseDerivatives(float(energy[0]), gradient, *(matrix.reshape(p, p) for matrix in matrices)))
    return result


def carried_point_derivatives(contact: ContactForces, x: Values, pose: Pose) -> PoseDerivatives:
    """Derivatives of contact of points x (n, d), m, that the obstacle itself carries, by its pose."""
    arm = x[contact.points] - pose.centre
    J, gradient = _jacobian(arm), -contact.normal
    stiffness, hessian = (_congruence(J, blocks) for blocks in (contact.stiffness, contact.normal_hessian))
    d = pose.dim
    hessian[d:, d:] += rotation_second_derivative(gradient, arm).sum(axis=0)
    # points move by -J q
    return PoseDerivatives(contact.potential, -np.einsum("ndp,nd->p", J, gradient), hessian, stiffness)


def mixed_pose_hessian(contact: ContactForces, x: Values, carrier: Pose, second: Pose) -> MixedHessian:
    """(p, p) second derivatives of the energy by the poses of a carrier of points and of another obstacle.

    Args:
        contact: forces on points.
        x: (n, d) points, m.
        carrier: pose of the obstacle that carries the points.
        other: pose of the obstacle before them.

    Returns:
        The exact one, and that of the positive part.
    """
    points, d = x[contact.points], carrier.dim
    carrier_J, other_J = _jacobian(points - carrier.centre), _jacobian(points - second.centre)
    rotating = other_J.copy()
    n, p = len(points), other_J.shape[2]
    exact, stiffness = (
        -carrier_J.reshape(n * d, p).T @ (blocks @ other_J).reshape(n * d, p)
        for blocks in (contact.normal_hessian, contact.stiffness)
    )
    rotating[:, :, :d], rotating[:, :, d:] = 0.0, rotation_derivative(-contact.normal)
    exact = exact + carrier_J.reshape(n * d, p).T @ rotating.reshape(n * d, p)
    return np.asarray(exact), np.asarray(stiffness)


def point_set_derivatives(
    energy: float, gradient: Values, exact: csr_matrix, stiff: csr_matrix, arm: Values
) -> PoseDerivatives:
    """Derivatives by the pose of an energy of all points that the obstacle carries.

    Args:
        energy: J.
        gradient: (m, d) by the points, N.
        exact: (m d, m d) second derivatives, N/m.
        stiff: (m d, m d) their positive semi-definite part.
        arm: (m, d) of the points about the centre, m.
    """
    d, J = arm.shape[1], point_jacobian(arm).reshape(arm.size, -1)
    hessian, stiffness = (np.asarray(J.T @ (blocks @ J)) for blocks in (exact, stiff))
    hessian[d:, d:] += rotation_second_derivative(gradient, arm).sum(axis=0)
    return PoseDerivatives(energy, J.T @ gradient.reshape(-1), hessian, stiffness)


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


def point_pose_hessian(
    contact: ContactForces,
    x: Values,
    pose: Pose,
    lagged: LaggedContact | None,
    start: Pose,
    *,
    exact: bool = False,
) -> Values:
    """(k, d, p) derivatives of minus the forces on points by an increment of the pose.

    As `stiffness` has it, or `exact`. Friction as in `pose_derivatives`: with an arm other than that of the stiffness
    Newton's method would creep.
    """
    arm = x[contact.points] - pose.centre
    result = np.asarray((contact.normal_hessian if exact else contact.normal_stiffness) @ _jacobian(arm))
    if lagged is not None and len(lagged.points):
        friction_arm = _friction_arms(contact, arm, pose, lagged, start)
        result = result + contact.friction_hessian @ _jacobian(friction_arm)
    if exact:
        result[:, :, pose.dim :] += rotation_derivative(contact.normal)
    if (facets := contact.facets) is not None:
        blocks = (facets.hessian if exact else facets.stiffness) @ _facet_jacobian(facets, x, pose)
        rows = np.searchsorted(contact.points, facets.corners)
        np.add.at(result, rows, blocks.reshape(*rows.shape, x.shape[1], -1))
    return result


def _friction_arms(contact: ContactForces, arm: Values, pose: Pose, lagged: LaggedContact, start: Pose) -> Values:
    """(k, d) arms of the points of the obstacle that were under the points in lagged contact, m."""
    arm, rotation = arm.copy(), pose.rotation @ start.rotation.T
    arm[np.searchsorted(contact.points, lagged.points)] = (lagged.obstacle_point - start.centre) @ rotation.T
    return arm


def _jacobian(arm: Values) -> Values:
    """(n, d, p) J of arms (n, d), m."""
    d, by_rotation = arm.shape[1], rotation_derivative(arm)
    J = np.empty((len(arm), d, d + by_rotation.shape[2]))
    J[:, :, :d], J[:, :, d:] = -np.eye(d), by_rotation
    return J


def _facet_jacobian(facets: FacetCoupling, x: Values, pose: Pose) -> Values:
    """(k, c d, p) J of the corners of facets."""
    k, c = facets.corners.shape
    d = x.shape[1]
    return _jacobian(x[facets.corners.reshape(-1)] - pose.centre).reshape(k, c * d, -1)


def _congruence(J: Values, blocks: Values) -> Values:
    """(p, p) sum of J^T B J over blocks B (n, i, i) and J (n, i, p)."""
    n, i, p = J.shape
    return np.asarray(J.reshape(n * i, p).T @ (blocks @ J).reshape(n * i, p))


def _rotating_forces(gradient: Values, arm: Values) -> Values:
    """(p, p) second derivative due to normal forces, which rotate with the obstacle."""
    d = arm.shape[1]
    mixed = rotation_derivative(gradient).sum(axis=0)
    by_rotation = rotation_second_derivative(gradient, arm).sum(axis=0)
    return np.block([[np.zeros((d, d)), mixed], [mixed.T, by_rotation]])
