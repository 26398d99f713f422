"""What contact does to the pose of an obstacle: energy of the points in touch, and its derivatives.

Points see the obstacle through x - c alone, turned with it. With D the energy of a point as a function of its place
seen from the obstacle, y its arm and J = [-1, G(y)] (pose), the derivative by an increment (t, w) is J^T D', the second
one J^T D'' J and, of forces D' that turn with the obstacle, G(D') between t and w and `second_order_turn` in w.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix

from .placed import second_order_turn
from .pose import Pose, Values, turning
from .touch import Grip, Jointly, Touch


@dataclass(frozen=True)
class Push:
    """Of one obstacle, summed over its points.

    Attributes:
        energy: of barrier and friction, J.    gradient: (p,) by an increment of the pose.    hessian: (p, p).
        stiffness: (p, p) the part of the Hessian that is sure to be positive semi-definite.
    """

    energy: float
    gradient: Values
    hessian: Values
    stiffness: Values

    def __add__(self, other: Push) -> Push:
        """Both together."""
        return Push(
            self.energy + other.energy, self.gradient + other.gradient, self.hessian + other.hessian,
            self.stiffness + other.stiffness,
        )  # fmt: skip


def push(found: Touch, x: Values, pose: Pose, held: Grip | None, start: Pose) -> Push:
    """Of points in touch at x (n, d), m; friction holds the places of the obstacle that were under them at its pose at
    the `start` of the step, not those that are there now."""
    arm = x[found.points] - pose.centre
    J, gradient = _by_pose(arm), -found.normal
    stiffness, hessian = (_summed(J, blocks) for blocks in (found.pressed, found.exact))
    if (inner := found.between) is not None:
        facing = _of_facets(inner, x, pose)
        stiffness, hessian = stiffness + _summed(facing, inner.stiffness), hessian + _summed(facing, inner.exact)
    hessian = hessian + _turning_with(gradient, arm)
    total = np.einsum("ndp,nd->p", J, gradient)
    if held is not None and len(held.points):
        arm = _under(found, arm, pose, held, start)
        J = _by_pose(arm)
        stick = _summed(J, found.stick)
        total = total - np.einsum("ndp,nd->p", J, found.friction)
        stiffness, hessian = stiffness + stick, hessian + stick
        d = pose.dim
        hessian[d:, d:] += second_order_turn(found.friction, arm).sum(axis=0)
    return Push(found.potential, total, hessian, stiffness)


def carried(found: Touch, x: Values, pose: Pose) -> Push:
    """Of points in touch at x (n, d), m, that the body carries itself: they go by -J q."""
    arm = x[found.points] - pose.centre
    J, gradient = _by_pose(arm), -found.normal
    stiffness, hessian = (_summed(J, blocks) for blocks in (found.stiffness, found.exact))
    d = pose.dim
    hessian[d:, d:] += second_order_turn(gradient, arm).sum(axis=0)
    return Push(found.potential, -np.einsum("ndp,nd->p", J, gradient), hessian, stiffness)


def between_two(found: Touch, x: Values, own: Pose, other: Pose) -> tuple[Values, Values]:
    """(p, p) second derivative of the energy of points at x (n, d) that one body carries before another one, by
    increments of both their poses, exact and of the positive part."""
    at, d = x[found.points], own.dim
    mine, its = _by_pose(at - own.centre), _by_pose(at - other.centre)
    turned = its.copy()
    n, p = len(at), its.shape[2]
    exact, stiffness = (
        -mine.reshape(n * d, p).T @ (blocks @ its).reshape(n * d, p) for blocks in (found.exact, found.stiffness)
    )
    turned[:, :, :d], turned[:, :, d:] = 0.0, turning(-found.normal)
    return np.asarray(exact + mine.reshape(n * d, p).T @ turned.reshape(n * d, p)), np.asarray(stiffness)


def of_points(energy: float, gradient: Values, exact: csr_matrix, stiff: csr_matrix, arm: Values) -> Push:
    """Of all points that the body carries, with arms (m, d): derivatives (m, d) of the energy by them, and second ones
    (m d, m d), exact and positive semi-definite."""
    d, J = arm.shape[1], ways_of_points(arm).reshape(arm.size, -1)
    hessian, stiffness = (np.asarray(J.T @ (each @ J)) for each in (exact, stiff))
    hessian[d:, d:] += second_order_turn(gradient, arm).sum(axis=0)
    return Push(energy, J.T @ gradient.reshape(-1), hessian, stiffness)


def ways_of_points(arm: Values) -> Values:
    """(m, d, p) how points with arms (m, d) go with an increment of the pose."""
    return -_by_pose(arm)


def on_obstacle(found: Touch, x: Values, pose: Pose) -> Values:
    """(p,) force and moment of the body on the obstacle about its reference point, N and N m: action and reaction at
    the points themselves."""
    return resultant(-(found.normal + found.friction), x[found.points] - pose.centre)


def resultant(force: Values, arm: Values) -> Values:
    """(p,) sums of forces (n, d) and of their moments arm x force."""
    moment = -np.einsum("ndr,nd->r", turning(arm), force)
    return np.concatenate([force.sum(axis=0), moment])


def by_point_and_pose(
    found: Touch, x: Values, pose: Pose, held: Grip | None, start: Pose, *, exact: bool = False
) -> Values:
    """(k, d, p) derivative of minus the forces on the points by an increment of the pose, as `stiffness` has it, or
    `exact`; friction as in `push`: with an arm other than that of the stiffness Newton's method would creep."""
    arm = x[found.points] - pose.centre
    result = np.asarray((found.exact if exact else found.pressed) @ _by_pose(arm))
    if held is not None and len(held.points):
        result = result + found.stick @ _by_pose(_under(found, arm, pose, held, start))
    if exact:
        result[:, :, pose.dim :] += turning(found.normal)
    if (inner := found.between) is not None:
        blocks = (inner.exact if exact else inner.stiffness) @ _of_facets(inner, x, pose)
        at = np.searchsorted(found.points, inner.corners)
        np.add.at(result, at, blocks.reshape(*at.shape, x.shape[1], -1))
    return result


def _under(found: Touch, arm: Values, pose: Pose, held: Grip, start: Pose) -> Values:
    """(k, d) arms of what friction holds: places of the obstacle that were under points as the step began."""
    arm, turned = arm.copy(), pose.rotation @ start.rotation.T
    arm[np.searchsorted(found.points, held.points)] = (held.under - start.centre) @ turned.T
    return arm


def _by_pose(arm: Values) -> Values:
    """(n, d, p) J."""
    still = np.broadcast_to(-np.eye(arm.shape[1]), (len(arm), arm.shape[1], arm.shape[1]))
    return np.concatenate([still, turning(arm)], axis=2)


def _of_facets(inner: Jointly, x: Values, pose: Pose) -> Values:
    """(k, c d, p) J of the corners of facets."""
    k, c = inner.corners.shape
    d = x.shape[1]
    return _by_pose(x[inner.corners.reshape(-1)] - pose.centre).reshape(k, c * d, -1)


def _summed(J: Values, blocks: Values) -> Values:
    """(p, p) sum of J^T B J."""
    n, i, p = J.shape
    return np.asarray(J.reshape(n * i, p).T @ (blocks @ J).reshape(n * i, p))


def _turning_with(gradient: Values, arm: Values) -> Values:
    """(p, p) of normal forces, which turn with the obstacle."""
    d = arm.shape[1]
    mixed, twice = turning(gradient).sum(axis=0), second_order_turn(gradient, arm).sum(axis=0)
    return np.block([[np.zeros((d, d)), mixed], [mixed.T, twice]])
