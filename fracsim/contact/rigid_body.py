"""A step of a free obstacle: its pose as the minimum of an incremental potential, for a body that is where it is.

z (k,) is its way in the step, pose(z) = start moved by q = ways @ z, E(z) and V(z) the energies of contact and weight.
The scheme of the study steps the momentum M dz/dt as it steps that of every node, with M (inertia in axes of space)
held where the obstacle will be half-way; its unknown is s z, s the level of the step where forces balance (term.Level),
contact enters as a blow of factor k (blow), and

    Phi(z) = c_a / 2 (s z - z_a) . M (s z - z_a) + s^2 (k E(z) + V(z)) - s b . z,    b: (1 - s) times the weight.

So the linear momentum that body and obstacle exchange is the same to the last digit, in 2D the angular one too, and
without a moment the angular momentum of a body that tumbles stays as it is. In 3D a moment would act through J(w)^T
(pose), an error of the order of the turn in a step; the momentum at the end is therefore that of the moment itself.

Equations: docs/theory.md#rigid-obstacles.

What contact does to the pose of an obstacle: energy of the points in touch, and its derivatives.

Points see the obstacle through x - c alone, turned with it. With D the energy of a point as a function of its place
seen from the obstacle, y its arm and J = [-1, G(y)] (pose), the derivative by an increment (t, w) is J^T D', the second
one J^T D'' J and, of forces D' that turn with the obstacle, G(D') between t and w and `second_order_turn` in w.

How far a free obstacle is on its way with a step of Newton's method that takes it along.

Poses of several rigid bodies as the least of one potential: the sum of theirs, with barriers between them.

Phi(z) = sum over bodies of Phi_i(z_i) (rigid_body) + s^2 k sum over pairs of E_ij(z_i, z_j), by Newton's method on ways
that pass through nothing. One body by itself is the same with no pair.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from scipy.sparse import csr_matrix

from ..forms.schemes import Scheme
from ..mechanics.contact_time_weights import acceleration_change
from ..mesh.parallel import sum_over_ranks
from .node_contact import ContactForces, FacetCoupling, LaggedContact
from .obstacle import FreeObstacle, RigidMotion
from .pose import Pose, left_jacobian, left_jacobian_derivative, rotation_derivative, rotation_second_derivative

Values = npt.NDArray[np.float64]
ITERATIONS = 100
SMALL = 1e-18  # share of the energies at play: Newton's decrement where z is found
ROUND_OFF = 1e-13  # share of the energies at play by which Phi may be wrong
SHORTEST = 1e-12  # share of a step of Newton's method


@dataclass(frozen=True)
class PoseDerivatives:
    """Of one obstacle, summed over its points.

    Attributes:
        energy: of barrier and friction, J.    gradient: (p,) by an increment of the pose.    hessian: (p, p).
        stiffness: (p, p) the part of the Hessian that is sure to be positive semi-definite.
    """

    energy: float
    gradient: Values
    hessian: Values
    stiffness: Values

    def __add__(self, other: PoseDerivatives) -> PoseDerivatives:
        """Both together."""
        return PoseDerivatives(
            self.energy + other.energy, self.gradient + other.gradient, self.hessian + other.hessian,
            self.stiffness + other.stiffness,
        )  # fmt: skip


def pose_derivatives(
    found: ContactForces, x: Values, pose: Pose, held: LaggedContact | None, start: Pose
) -> PoseDerivatives:
    """Of points in touch at x (n, d), m; friction holds the places of the obstacle that were under them at its pose at
    the `start` of the step, not those that are there now."""
    arm = x[found.points] - pose.centre
    J, gradient = _by_pose(arm), -found.normal
    stiffness, hessian = (_summed(J, blocks) for blocks in (found.normal_stiffness, found.normal_hessian))
    if (inner := found.facets) is not None:
        facing = _of_facets(inner, x, pose)
        stiffness, hessian = stiffness + _summed(facing, inner.stiffness), hessian + _summed(facing, inner.hessian)
    hessian = hessian + _turning_with(gradient, arm)
    total = np.einsum("ndp,nd->p", J, gradient)
    if held is not None and len(held.points):
        arm = _under(found, arm, pose, held, start)
        J = _by_pose(arm)
        stick = _summed(J, found.friction_hessian)
        total = total - np.einsum("ndp,nd->p", J, found.friction)
        stiffness, hessian = stiffness + stick, hessian + stick
        d = pose.dim
        hessian[d:, d:] += rotation_second_derivative(found.friction, arm).sum(axis=0)
    return PoseDerivatives(found.potential, total, hessian, stiffness)


def carried_point_derivatives(found: ContactForces, x: Values, pose: Pose) -> PoseDerivatives:
    """Of points in touch at x (n, d), m, that the body carries itself: they go by -J q."""
    arm = x[found.points] - pose.centre
    J, gradient = _by_pose(arm), -found.normal
    stiffness, hessian = (_summed(J, blocks) for blocks in (found.stiffness, found.normal_hessian))
    d = pose.dim
    hessian[d:, d:] += rotation_second_derivative(gradient, arm).sum(axis=0)
    return PoseDerivatives(found.potential, -np.einsum("ndp,nd->p", J, gradient), hessian, stiffness)


def mixed_pose_hessian(found: ContactForces, x: Values, own: Pose, other: Pose) -> tuple[Values, Values]:
    """(p, p) second derivative of the energy of points at x (n, d) that one body carries before another one, by
    increments of both their poses, exact and of the positive part."""
    at, d = x[found.points], own.dim
    mine, its = _by_pose(at - own.centre), _by_pose(at - other.centre)
    turned = its.copy()
    n, p = len(at), its.shape[2]
    exact, stiffness = (
        -mine.reshape(n * d, p).T @ (blocks @ its).reshape(n * d, p)
        for blocks in (found.normal_hessian, found.stiffness)
    )
    turned[:, :, :d], turned[:, :, d:] = 0.0, rotation_derivative(-found.normal)
    return np.asarray(exact + mine.reshape(n * d, p).T @ turned.reshape(n * d, p)), np.asarray(stiffness)


def point_set_derivatives(
    energy: float, gradient: Values, exact: csr_matrix, stiff: csr_matrix, arm: Values
) -> PoseDerivatives:
    """Of all points that the body carries, with arms (m, d): derivatives (m, d) of the energy by them, and second ones
    (m d, m d), exact and positive semi-definite."""
    d, J = arm.shape[1], point_jacobian(arm).reshape(arm.size, -1)
    hessian, stiffness = (np.asarray(J.T @ (each @ J)) for each in (exact, stiff))
    hessian[d:, d:] += rotation_second_derivative(gradient, arm).sum(axis=0)
    return PoseDerivatives(energy, J.T @ gradient.reshape(-1), hessian, stiffness)


def point_jacobian(arm: Values) -> Values:
    """(m, d, p) how points with arms (m, d) go with an increment of the pose."""
    return -_by_pose(arm)


def contact_wrench(found: ContactForces, x: Values, pose: Pose) -> Values:
    """(p,) force and moment of the body on the obstacle about its reference point, N and N m: action and reaction at
    the points themselves."""
    return resultant(-(found.normal + found.friction), x[found.points] - pose.centre)


def resultant(force: Values, arm: Values) -> Values:
    """(p,) sums of forces (n, d) and of their moments arm x force."""
    moment = -np.einsum("ndr,nd->r", rotation_derivative(arm), force)
    return np.concatenate([force.sum(axis=0), moment])


def point_pose_hessian(
    found: ContactForces, x: Values, pose: Pose, held: LaggedContact | None, start: Pose, *, exact: bool = False
) -> Values:
    """(k, d, p) derivative of minus the forces on the points by an increment of the pose, as `stiffness` has it, or
    `exact`; friction as in `push`: with an arm other than that of the stiffness Newton's method would creep."""
    arm = x[found.points] - pose.centre
    result = np.asarray((found.normal_hessian if exact else found.normal_stiffness) @ _by_pose(arm))
    if held is not None and len(held.points):
        result = result + found.friction_hessian @ _by_pose(_under(found, arm, pose, held, start))
    if exact:
        result[:, :, pose.dim :] += rotation_derivative(found.normal)
    if (inner := found.facets) is not None:
        blocks = (inner.hessian if exact else inner.stiffness) @ _of_facets(inner, x, pose)
        at = np.searchsorted(found.points, inner.corners)
        np.add.at(result, at, blocks.reshape(*at.shape, x.shape[1], -1))
    return result


def _under(found: ContactForces, arm: Values, pose: Pose, held: LaggedContact, start: Pose) -> Values:
    """(k, d) arms of what friction holds: places of the obstacle that were under points as the step began."""
    arm, turned = arm.copy(), pose.rotation @ start.rotation.T
    arm[np.searchsorted(found.points, held.points)] = (held.obstacle_point - start.centre) @ turned.T
    return arm


def _by_pose(arm: Values) -> Values:
    """(n, d, p) J."""
    still = np.broadcast_to(-np.eye(arm.shape[1]), (len(arm), arm.shape[1], arm.shape[1]))
    return np.concatenate([still, rotation_derivative(arm)], axis=2)


def _of_facets(inner: FacetCoupling, x: Values, pose: Pose) -> Values:
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
    mixed, twice = rotation_derivative(gradient).sum(axis=0), rotation_second_derivative(gradient, arm).sum(axis=0)
    return np.block([[np.zeros((d, d)), mixed], [mixed.T, twice]])


@dataclass(frozen=True)
class PosePredictor:
    """From points at x (n, d) by `moved` (n, d), m, and from the obstacle's way z (k,) by `dz`."""

    positions: Values
    motion: Values
    z: Values
    dz: Values

    def fraction_at(self, x: Values, comm: MPI.Comm = MPI.COMM_SELF) -> float:
        """Of the way, where the points of all ranks of `comm` are at x (n, d) now: the nearest place on it
        (collective)."""
        gone, length = sum_over_ranks(
            comm, [float(np.vdot(x - self.positions, self.motion)), float(np.vdot(self.motion, self.motion))]
        )
        return float(np.clip(gone / length, 0.0, 1.0)) if length > 0 else 0.0

    def way_at(self, share: float) -> Values:
        """(k,) z there."""
        return self.z + share * self.dz


@dataclass(frozen=True)
class SystemDerivatives:
    """What contact does to bodies.

    Attributes:
        each: of every one; their energies sum to that of all.    mixed: of pairs (i, j), i < j, the second derivative
            (p, p) of their energy by an increment of the first pose and of the second, exact and the positive part's.
    """

    bodies: Sequence[PoseDerivatives]
    mixed: Mapping[tuple[int, int], tuple[Values, Values]] = field(default_factory=dict)

    @property
    def energy(self) -> float:
        """J."""
        return sum(push.energy for push in self.bodies)


class RigidSystem:
    """Steps of several bodies, of one scheme and size; z: (k,) of each."""

    def __init__(self, steps: Sequence[RigidStep]) -> None:
        self._steps, first = steps, steps[0]
        self._share, self._factor = first.share, first.factor
        self._ends = np.cumsum([len(step.M) for step in steps])

    def split(self, values: Values) -> list[Values]:
        """Those of each body."""
        return np.split(values, self._ends[:-1])

    def system(self, z: Sequence[Values], contact: SystemDerivatives) -> tuple[Values, Values, Values]:
        """(K,) gradient of Phi / s, (K, K) Hessian of Phi / s^2, and its part that is positive definite."""
        parts = [step.system(way, push) for step, way, push in zip(self._steps, z, contact.bodies, strict=True)]
        size, at = (
            int(self._ends[-1]),
            [slice(end - len(g), end) for end, (g, _, _) in zip(self._ends, parts, strict=True)],
        )
        hessian, stiffness = np.zeros((size, size)), np.zeros((size, size))
        for where, (_, exact, positive) in zip(at, parts, strict=True):
            hessian[where, where], stiffness[where, where] = exact, positive
        for (i, j), both in contact.mixed.items():
            T, S = self._steps[i].pose_jacobian(z[i]), self._steps[j].pose_jacobian(z[j])
            for whole, block in zip((hessian, stiffness), both, strict=True):
                whole[at[i], at[j]] = self._factor * T.T @ block @ S
                whole[at[j], at[i]] = whole[at[i], at[j]].T
        return np.concatenate([g for g, _, _ in parts]), hessian, stiffness

    def minimise(
        self,
        z: Sequence[Values],
        contact: Callable[[Sequence[Values]], SystemDerivatives],
        free: Callable[[Sequence[Values], Sequence[Values]], float],
    ) -> tuple[Sequence[Values], SystemDerivatives]:
        """The z of least Phi that is reached from z on ways that pass through nothing, and what contact does there
        (collective).

        `contact`: z -> Pushes, of all ranks.    `free`: share of the way from z by dz on which no gap closes.
        """
        now, weight = contact(z), self._factor * self._share**2
        height = self._free_potential(z) + weight * now.energy
        for _ in range(ITERATIONS):
            gradient, hessian, stiffness = self.system(z, now)
            step: Values = np.asarray(-_solved(hessian, stiffness, gradient) / self._share)
            decrement, dz = -self._share * float(gradient @ step), self.split(step)
            at_play = (
                sum(each.energy_scale(way) for each, way in zip(self._steps, z, strict=True)) + weight * now.energy
            )
            if not decrement > SMALL * at_play:
                break
            share, slack = free(z, dz), ROUND_OFF * (at_play + abs(height))
            while share > SHORTEST:
                there = [way + share * change for way, change in zip(z, dz, strict=True)]
                found = contact(there)
                level = self._free_potential(there) + weight * found.energy
                if level <= height - 1e-4 * share * decrement + slack:
                    break
                share /= 2
            else:
                break
            z, now, height = there, found, level
        return z, now

    def _free_potential(self, z: Sequence[Values]) -> float:
        return sum(step.free_potential(way) for step, way in zip(self._steps, z, strict=True))


def _solved(hessian: Values, stiffness: Values, gradient: Values) -> Values:
    """H^-1 g with H the Hessian where that is positive definite, else the stiffness."""
    with np.errstate(all="ignore"):
        return np.asarray(
            np.linalg.solve(hessian if is_positive_definite(hessian) else stiffness, gradient), np.float64
        )


def is_positive_definite(matrix: Values) -> bool:
    """Whether a symmetric matrix (k, k) is positive definite."""
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return False
    return True


@dataclass(frozen=True, eq=False)
class RigidStep:
    """One obstacle in one step.

    Attributes:
        body, start: what moves, and how at the start.    scheme, dt: of the step, s.    c_a, share: of the level.
        factor: k.
    """

    body: FreeObstacle
    start: RigidMotion
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
        return self.body.mass_matrix(self.start.pose.incremented(self.body.motion_basis @ half).rotation)

    def _rate(self, pose: Pose) -> Values:
        return _over(self.body.mass_matrix(pose.rotation), self.start.momentum)

    @cached_property
    def _motion(self) -> tuple[Values, Values]:
        """(z, dz/dt) and its rate at the start, by the momentum and the mass half-way."""
        return _over(self.M, self.start.momentum), _over(self.M, self.start.force)

    @cached_property
    def z_a(self) -> Values:
        """(k,) level of s z without acceleration."""
        return np.asarray(self.scheme.reference_displacements(self.dt, np.zeros(len(self.M)), *self._motion)[0])

    @cached_property
    def weight_load(self) -> Values:
        """(k,) b."""
        late = 1 - self.share
        return np.asarray(-late * self.body.motion_basis.T @ self.body.gravity_potential(self.start.pose)[1])

    @cached_property
    def free_flight(self) -> Values:
        """(k,) z of free flight, with the weight of the start."""
        weight = -self.body.motion_basis.T @ self.body.gravity_potential(self.start.pose)[1]
        return np.asarray((self.z_a + _over(self.M, self.weight_load + self.share * weight) / self.c_a) / self.share)

    # --- where it goes ---

    def increment(self, z: Values) -> Values:
        """(p,) q."""
        return np.asarray(self.body.motion_basis @ z)

    def pose(self, z: Values) -> Pose:
        """Where it is then."""
        return self.start.pose.incremented(self.increment(z))

    def pose_change(self, z: Values, dz: Values) -> Values:
        """(p,) increment of the pose at z that dz is, to first order."""
        q = self.increment(dz)
        q[self.start.pose.dim :] = self._jacobian(z) @ q[self.start.pose.dim :]
        return q

    def _jacobian(self, z: Values) -> Values:
        return left_jacobian(self.increment(z)[self.start.pose.dim :])

    def pose_jacobian(self, z: Values) -> Values:
        """(p, k) derivative of the increment of the pose at z by z."""
        T = self.body.motion_basis.copy()
        d = self.start.pose.dim
        T[d:] = self._jacobian(z) @ T[d:]
        return T

    # --- the potential ---

    def free_potential(self, z: Values) -> float:
        """Phi without contact, J."""
        away = self.share * z - self.z_a
        inertia = self.c_a / 2 * float(away @ self.M @ away)
        return (
            inertia
            + self.share**2 * self.body.gravity_potential(self.pose(z))[0]
            - self.share * float(self.weight_load @ z)
        )

    def system(self, z: Values, contact: PoseDerivatives) -> tuple[Values, Values, Values]:
        """(k,) gradient of Phi / s, (k, k) Hessian of Phi / s^2, and its part that is positive definite."""
        d, T = self.start.pose.dim, self.pose_jacobian(z)
        _, by_pose, twice = self.body.gravity_potential(self.pose(z))
        forces = self.factor * contact.gradient + by_pose
        gradient = self.c_a * self.M @ (self.share * z - self.z_a) + self.share * T.T @ forces - self.weight_load
        stiffness = self.c_a * self.M + self.factor * T.T @ contact.stiffness @ T
        bent = np.zeros_like(twice)
        bent[d:, d:] = left_jacobian_derivative(self.increment(z)[d:], forces[d:])
        curved = T.T @ (self.factor * contact.hessian + twice) @ T
        hessian = self.c_a * self.M + curved + self.body.motion_basis.T @ bent @ self.body.motion_basis
        return gradient, hessian, stiffness

    def energy_scale(self, z: Values) -> float:
        """Energies that Phi is the difference of, J."""
        moved = self.share * z
        return self.c_a / 2 * float(moved @ self.M @ moved + self.z_a @ self.M @ self.z_a)

    def minimise(
        self, z: Values, contact: Callable[[Values], PoseDerivatives], free: Callable[[Values, Values], float]
    ) -> tuple[Values, PoseDerivatives]:
        """(k,) the z of least Phi that is reached from z on ways that pass through nothing, and what contact does
        there (collective).

        `contact`: z -> Push, of all ranks.    `free`: share of the way from z by dz on which no gap closes.
        """
        found, now = RigidSystem([self]).minimise(
            [z], lambda ways: SystemDerivatives([contact(ways[0])]), lambda ways, changes: free(ways[0], changes[0])
        )
        return found[0], now.bodies[0]

    def end_motion(self, z: Values, force: Values) -> RigidMotion:
        """How it moves at the end, which is at z, with force and moment (p,) of the body on it there, N and N m."""
        pose = self.pose(z)
        weight = self.body.motion_basis.T @ -self.body.gravity_potential(pose)[1]
        struck = self.share * self.factor * _over(self.M, self.body.motion_basis.T @ force) / self.c_a
        reached = self.z_a + _over(self.M, self.share * weight + self.weight_load) / self.c_a + struck
        _, rate, change = self.scheme.complete_step(self.dt, reached, np.zeros(len(z)), *self._motion)
        carried = change - acceleration_change(self.scheme, self.dt, struck)
        return RigidMotion(pose, self.M @ rate, self.M @ carried, self._turned(pose, z))

    def _turned(self, pose: Pose, z: Values) -> Values:
        if pose.dim == 2:
            return self.start.rotation + self.increment(z)[2:]
        return pose.rotation_vector()


def _over(matrix: Values, values: Values) -> Values:
    """A^-1 b."""
    return np.asarray(np.linalg.solve(matrix, values), np.float64)
