"""Motion of free obstacles: states of motion, and the pose at the end of an implicit step.

The pose is the minimiser of an incremental potential.

z (k,) is the increment of the step, pose(z) the start incremented by q = motion_basis @ z. E(z) and V(z) are the
energies of contact and weight. The scheme steps the momentum M dz/dt as that of every node, with M at the middle of
the step. Its unknown is s z, s the level of the step at which forces balance, k the factor of contact in the step:

    Phi(z) = c_a / 2 (s z - z_a) . M (s z - z_a) + s^2 (k E(z) + V(z)) - s b . z,    b: (1 - s) times the weight.

So the linear momentum that body and obstacle exchange is equal to round-off, in 2D the angular momentum too. In 3D a
moment would act through J(w)^T (pose), an error of the order of the rotation in a step; the momentum at the end is
therefore that of the moment itself.

Equations: docs/theory.md#rigid-obstacles.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, partial
from typing import Protocol

import numpy as np

from ..array_types import Values
from ..forms.schemes import Scheme
from ..mechanics.contact_time_weights import acceleration_change
from ..mechanics.term_protocols import TermColumns
from .node_contact import PoseDerivatives
from .obstacle import FreeObstacle, RigidMotion, column_names
from .pose import Pose, PosedShape, left_jacobian, left_jacobian_derivative, rotation_derivative, solve_matrix


@dataclass(frozen=True)
class RigidSolverPolicy:
    """Tuned numbers of Newton's method for the poses of free obstacles.

    Attributes:
        max_iterations: of Newton's method.
        decrement_tolerance: Newton's decrement, in the energies involved, at which it ends.
        solved_decrement: decrement, in the energies involved, of a solution together with the body. Its square root
            is the error of the motion in a step.
        round_off: error of Phi, in the energies involved, that the line search tolerates.
        reduction_range: smallest and largest factor by which the line search shortens a step.
        min_fraction: of a step of Newton's method in the line search.
        sufficient_decrease: part of the predicted decrease that a step must achieve (Armijo).
    """

    max_iterations: int = 100
    decrement_tolerance: float = 1e-18
    solved_decrement: float = 1e-15
    round_off: float = 1e-13
    reduction_range: tuple[float, float] = (0.1, 0.5)
    min_fraction: float = 1e-12
    sufficient_decrease: float = 1e-4


SOLVER = RigidSolverPolicy()
EPSILON = float(np.finfo(float).eps)


@dataclass(frozen=True)
class SystemDerivatives:
    """Derivatives of contact of several obstacles.

    Attributes:
        bodies: derivatives of each; their energies sum to that of all.
        mixed: of pairs (i, j), i < j, second derivatives (p, p) of their energy by the increments of both poses.
    """

    bodies: Sequence[PoseDerivatives]
    mixed: Mapping[tuple[int, int], Values] = field(default_factory=dict)

    @property
    def energy(self) -> float:
        """Energy of all contact, J."""
        return sum(body.energy for body in self.bodies)


class RigidSystem:
    """Several free obstacles in one step, with a potential in common.

    Phi(z) = sum over obstacles of Phi_i(z_i) + s^2 k sum over pairs of E_ij(z_i, z_j), z: (k,) of each. Steps are of
    one scheme and size.

    Attributes:
        level: s, level of the step at which forces balance.
    """

    def __init__(self, steps: Sequence[RigidStep]) -> None:
        self._steps, first = steps, steps[0]
        self.level, self._factor = first.share, first.factor
        self._ends = np.cumsum([len(step.M) for step in steps])

    def split(self, values: Values) -> list[Values]:
        """Values of each obstacle, of an array of all."""
        return np.split(values, self._ends[:-1])

    def system(self, z: Sequence[Values], contact: SystemDerivatives, *, exact: bool) -> tuple[Values, Values]:
        """(K,) gradient of Phi / s, and (K, K) Hessian of Phi / s^2; positive definite unless `exact`."""
        items = zip(self._steps, z, contact.bodies, strict=True)
        parts = [step.system(z_i, body, exact=exact) for step, z_i, body in items]
        hessian = np.zeros((int(self._ends[-1]),) * 2)
        blocks = [slice(end - len(g), end) for end, (g, _) in zip(self._ends, parts, strict=True)]
        for block, (_, of_body) in zip(blocks, parts, strict=True):
            hessian[block, block] = of_body
        for (i, j), coupling in contact.mixed.items():
            T, S = self._steps[i].pose_jacobian(z[i]), self._steps[j].pose_jacobian(z[j])
            hessian[blocks[i], blocks[j]] = self._factor * T.T @ coupling @ S
            hessian[blocks[j], blocks[i]] = hessian[blocks[i], blocks[j]].T
        return np.concatenate([g for g, _ in parts]), hessian

    def minimise(
        self,
        z: Sequence[Values],
        contact: Callable[[Sequence[Values], bool], SystemDerivatives],
        free: Callable[[Sequence[Values], Sequence[Values]], float],
    ) -> Sequence[Values]:
        """Minimiser of Phi by Newton's method from z (collective).

        Args:
            z: start.
            contact: z, whether exact -> derivatives of contact, of all ranks.
            free: z, dz -> fraction of dz on which no gap closes.
        """
        derivatives, weight = contact(z, True), self._factor * self.level**2
        phi = self._free_potential(z) + weight * derivatives.energy
        for _ in range(SOLVER.max_iterations):
            gradient, hessian = self.system(z, derivatives, exact=True)
            if not is_positive_definite(hessian):
                _, hessian = self.system(z, contact(z, False), exact=False)
            step: Values = np.asarray(-solve_matrix(hessian, gradient) / self.level)
            decrement, dz = -self.level * float(gradient @ step), self.split(step)
            scale = self.energy_scale(z, derivatives)
            if not decrement > SOLVER.decrement_tolerance * scale:
                break
            fraction = free(z, dz)
            tolerance = SOLVER.round_off * (scale + abs(phi)) + weight * self._round_off_of_positions(derivatives)
            while fraction > SOLVER.min_fraction:
                trial = [z_i + fraction * dz_i for z_i, dz_i in zip(z, dz, strict=True)]
                trial_derivatives = contact(trial, True)
                trial_phi = self._free_potential(trial) + weight * trial_derivatives.energy
                if trial_phi <= phi - SOLVER.sufficient_decrease * fraction * decrement + tolerance:
                    break
                fraction *= _minimum_of_parabola(trial_phi - phi, fraction * decrement)
            else:
                break
            z, derivatives, phi = trial, trial_derivatives, trial_phi
        return z

    def energy_scale(self, z: Sequence[Values], contact: SystemDerivatives) -> float:
        """Size of the energies of which Phi is the difference, J."""
        inertia = sum(step.energy_scale(z_i) for step, z_i in zip(self._steps, z, strict=True))
        return inertia + self._factor * self.level**2 * contact.energy

    def _round_off_of_positions(self, contact: SystemDerivatives) -> float:
        """Error of the energy of contact, J: forces times the round-off of positions at the centres."""
        items = zip(self._steps, contact.bodies, strict=True)
        forces = [(body.gradient, step.start.pose.centre) for step, body in items]
        return sum(EPSILON * float(np.linalg.norm(force[: len(x)]) * np.linalg.norm(x)) for force, x in forces)

    def _free_potential(self, z: Sequence[Values]) -> float:
        return sum(step.free_potential(z_i) for step, z_i in zip(self._steps, z, strict=True))


def _minimum_of_parabola(rise: float, decrement: float) -> float:
    """Fraction of a step at the minimum of the parabola with slope -decrement at its start and `rise` at its end, J."""
    low, high = SOLVER.reduction_range
    if not np.isfinite(rise):
        return high
    return float(np.clip(decrement / (2 * (rise + decrement)), low, high))


def is_positive_definite(matrix: Values) -> bool:
    """Whether a symmetric matrix (k, k) is positive definite."""
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return False
    return True


@dataclass(frozen=True, eq=False)
class RigidStep:
    """One free obstacle in one step.

    Attributes:
        body: the obstacle.
        start: its motion at the start.
        scheme: of time integration.
        dt: size of the step, s.
        c_a: of the scheme, 1/s^2.
        share: s, level of the step at which forces balance.
        factor: k of contact.
    """

    body: FreeObstacle
    start: RigidMotion
    scheme: Scheme
    dt: float
    c_a: float
    share: float
    factor: float

    # --- constants of the step ---

    @cached_property
    def M(self) -> Values:
        """(k, k) mass matrix at the middle of a step that continues as it began."""
        half = 0.5 * self.dt * solve_matrix(self.body.mass_matrix(self.start.pose.rotation), self.start.momentum)
        return self.body.mass_matrix(self.start.pose.incremented(self.body.motion_basis @ half).rotation)

    @cached_property
    def _rates(self) -> tuple[Values, Values]:
        """(k,) dz/dt and d2z/dt2 at the start, by momentum, force and M."""
        return solve_matrix(self.M, self.start.momentum), solve_matrix(self.M, self.start.force)

    @cached_property
    def z_a(self) -> Values:
        """(k,) value of s z without acceleration."""
        return np.asarray(self.scheme.reference_displacements(self.dt, np.zeros(len(self.M)), *self._rates)[0])

    @cached_property
    def weight_load(self) -> Values:
        """(k,) b."""
        return np.asarray(
            -(1 - self.share) * self.body.motion_basis.T @ self.body.gravity_derivatives(self.start.pose)[0]
        )

    @cached_property
    def free_flight(self) -> Values:
        """(k,) z without contact, with the weight of the start."""
        weight = -self.body.motion_basis.T @ self.body.gravity_derivatives(self.start.pose)[0]
        acceleration = solve_matrix(self.M, self.weight_load + self.share * weight) / self.c_a
        return np.asarray((self.z_a + acceleration) / self.share)

    # --- kinematics ---

    def start_velocity(self, x: Values) -> Values:
        """(n, d) velocities at the start of points x (n, d), m, that the obstacle carries, m/s."""
        d, rate = self.start.pose.dim, self.increment(self._rates[0])
        return np.asarray(rate[:d] - rotation_derivative(x - self.start.pose.centre) @ rate[d:])

    def increment(self, z: Values) -> Values:
        """(p,) increment q of the pose in the step."""
        return np.asarray(self.body.motion_basis @ z)

    def pose(self, z: Values) -> Pose:
        """Pose at z (k,)."""
        return self.start.pose.incremented(self.increment(z))

    @cached_property
    def _dim(self) -> int:
        return self.start.pose.dim

    def pose_change(self, z: Values, dz: Values) -> Values:
        """(p,) increment of the pose at z for a change dz (k,), to first order."""
        q = self.increment(dz)
        q[self._dim :] = self._left_jacobian(z) @ q[self._dim :]
        return q

    def _left_jacobian(self, z: Values) -> Values:
        return left_jacobian(self.increment(z)[self._dim :])

    def pose_jacobian(self, z: Values) -> Values:
        """(p, k) derivative of the increment of the pose at z by z."""
        T = self.body.motion_basis.copy()
        T[self._dim :] = self._left_jacobian(z) @ T[self._dim :]
        return T

    # --- potential ---

    def free_potential(self, z: Values) -> float:
        """Phi without contact, J."""
        offset = self.share * z - self.z_a
        inertia = self.c_a / 2 * float(offset @ self.M @ offset)
        weight = self.body.gravity_potential(self.pose(z))
        return inertia + self.share**2 * weight - self.share * float(self.weight_load @ z)

    def system(self, z: Values, contact: PoseDerivatives, *, exact: bool) -> tuple[Values, Values]:
        """(k,) gradient of Phi / s, and (k, k) Hessian of Phi / s^2; positive definite unless `exact`."""
        d, T = self._dim, self.pose_jacobian(z)
        weight_gradient, weight_hessian = self.body.gravity_derivatives(self.pose(z))
        forces = self.factor * contact.gradient + weight_gradient
        inertia = self.c_a * self.M @ (self.share * z - self.z_a)
        gradient = inertia + self.share * T.T @ forces - self.weight_load
        if not exact:
            return gradient, self.c_a * self.M + self.factor * T.T @ contact.hessian @ T
        by_jacobian = np.zeros_like(weight_hessian)
        by_jacobian[d:, d:] = left_jacobian_derivative(self.increment(z)[d:], forces[d:])
        by_pose = T.T @ (self.factor * contact.hessian + weight_hessian) @ T
        by_pose = by_pose + self.body.motion_basis.T @ by_jacobian @ self.body.motion_basis
        return gradient, self.c_a * self.M + by_pose

    def energy_scale(self, z: Values) -> float:
        """Size of the energies of which Phi is the difference, J."""
        s_z = self.share * z
        return self.c_a / 2 * float(s_z @ self.M @ s_z + self.z_a @ self.M @ self.z_a)

    def end_motion(self, z: Values, force: Values) -> RigidMotion:
        """State of motion at the end, with force and moment (p,) of the body on the obstacle there, N and N m."""
        pose = self.pose(z)
        weight = self.body.motion_basis.T @ -self.body.gravity_derivatives(pose)[0]
        by_contact = self.share * self.factor * solve_matrix(self.M, self.body.motion_basis.T @ force) / self.c_a
        by_weight = solve_matrix(self.M, self.share * weight + self.weight_load) / self.c_a
        end = self.z_a + by_weight + by_contact
        _, rate, acceleration = self.scheme.complete_step(self.dt, end, np.zeros(len(z)), *self._rates)
        # the force that is carried on is without contact
        carried = acceleration - acceleration_change(self.scheme, self.dt, by_contact)
        return RigidMotion(pose, self.M @ rate, self.M @ carried, self._end_rotation(pose, z))

    def _end_rotation(self, pose: Pose, z: Values) -> Values:
        if pose.dim == 2:
            return self.start.rotation + self.increment(z)[2:]
        return pose.rotation_vector()


# --- states of motion as history and columns of a term ---


class MovingObstacle(Protocol):
    """Free obstacle, with its state of motion at the start of a step until that is accepted."""

    body: FreeObstacle
    motion: RigidMotion


@dataclass(frozen=True)
class FreeMotions:
    """States of motion of free obstacles: history of a term, kinetic energy, and columns of history.csv.

    Attributes:
        free: free obstacles by their numbers.
        is_root: whether this is rank 0.
        restored: called when motions are those of a checkpoint.
    """

    free: Mapping[int, MovingObstacle]
    is_root: bool
    restored: Callable[[], None]

    def snapshot(self) -> dict[int, RigidMotion]:
        """State of motion of each, by its number."""
        return {number: obstacle.motion for number, obstacle in self.free.items()}

    def restore(self, motions: Mapping[int, RigidMotion]) -> None:
        """Restore states of motion."""
        for number, obstacle in self.free.items():
            obstacle.motion = motions[number]

    def to_checkpoint(self) -> dict[str, Values]:
        """Rows of numbers for a checkpoint; shorter ones, as of a pendulum, end with zeros."""
        rows = [obstacle.motion.to_array() for obstacle in self.free.values()]
        length = max(map(len, rows), default=0)
        return {"flights": np.array([np.pad(row, (0, length - len(row))) for row in rows])}

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Set states of motion from the rows of a checkpoint."""
        for row, obstacle in enumerate(self.free.values()):
            obstacle.motion = obstacle.motion.from_array(saved["flights"][row])
        self.restored()

    def place(self, posed: list[PosedShape]) -> list[PosedShape]:
        """All obstacles, by their numbers, with free ones at the poses of their states of motion."""
        for number, obstacle in self.free.items():
            posed[number] = PosedShape(posed[number].shape, obstacle.motion.pose)
        return posed

    def kinetic_energy(self) -> float:
        """Kinetic energy of the free obstacles, on rank 0, J."""
        if not self.is_root:
            return 0.0
        return float(sum(obstacle.body.history_values(obstacle.motion)[-1] for obstacle in self.free.values()))

    def history_columns(self) -> TermColumns:
        """Columns of history.csv.

        position_NAME_x and velocity_NAME_x of the centre of mass, m and m/s; turn_NAME_z and spin_NAME_z, rad and
        rad/s; kinetic_NAME, J.
        """
        columns: dict[str, Callable[[], Values]] = {}
        for obstacle in self.free.values():
            # read column by column, evaluated once for each state of motion
            values = lru_cache(maxsize=1)(obstacle.body.history_values)
            for index, name in enumerate(column_names(obstacle.body)):
                columns[name] = partial(self._reading, obstacle, values, index)
        return TermColumns(columns)

    def _reading(self, obstacle: MovingObstacle, values: Callable[[RigidMotion], Values], index: int) -> Values:
        """(1,) value of a column; 0 on other ranks than 0."""
        return values(obstacle.motion)[index : index + 1] if self.is_root else np.zeros(1)
