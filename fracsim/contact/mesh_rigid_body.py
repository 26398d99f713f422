"""Pose of a free triangle-mesh obstacle for a given body: static condensation, as for analytic ones (rigid_pose).

All is on rank 0, except the state of motion, the increment z and the pose.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix

from .mesh_obstacles import MeshObstaclePairs
from .obstacle import FreeObstacle, RigidMotion
from .obstacle_pairs import ObstaclePairs
from .pose import Pose, PosedShape
from .pose_derivatives import PoseDerivatives, point_jacobian, point_set_derivatives, resultant
from .rigid_body import PosePredictor, RigidStep
from .sample_points import IpcFriction
from .step_limit import PoseMotion

Values = npt.NDArray[np.float64]

# distance of points from a predicted path, in its length, at which they count as on it
PATH_TOLERANCE = 1e-9


@dataclass(frozen=True)
class MeshSurroundings:
    """Body and obstacles around a free triangle-mesh obstacle in a step.

    Attributes:
        pairs: contact with the body; None: the body is far.
        friction: with the body.
        positions: (n, 3) points of the body, m; None: far.
        obstacles: other obstacles at their poses, by their numbers.
        start: (n, 3) points of the body at the start of the step, m.
    """

    pairs: MeshObstaclePairs | None
    friction: IpcFriction | None
    positions: Values | None
    obstacles: Mapping[int, PosedShape]
    start: Values | None = None


class FreeMesh:
    """Free triangle-mesh obstacle whose pose is eliminated from the balance.

    Attributes:
        body: the obstacle.
        motion: its state of motion at the start of a step, until that is accepted.
        step: the last step that began.
        z: (k,) increment in the step.
        pose: current pose.
        obstacle_pairs: contact with analytic obstacles, on rank 0.
    """

    step: RigidStep
    z: Values
    obstacle_pairs: ObstaclePairs

    def __init__(self, body: FreeObstacle) -> None:
        self.body, self.motion = body, body.start_motion()
        self.pose = self.motion.pose
        self._step_motion: RigidMotion | None = None  # motion with which the step began
        self._solution: Values | None = None  # z of the last solution of this step
        self._predictor: PosePredictor | None = None
        self._equilibrium: tuple[Values | None, Pose] | None = None  # last points and pose in equilibrium in the step

    # --- steps ---

    def reset_pose(self) -> None:
        """Return to the pose of the state of motion."""
        self.pose = self.motion.pose

    def begin_step(self, step: RigidStep) -> None:
        """Begin a step, or begin it again."""
        if self._step_motion is not self.motion:
            self._solution = None
        self._step_motion, self.step, self._equilibrium = self.motion, step, None
        self.discard_predictor()
        self.move_to(np.zeros(self.body.motion_basis.shape[1]))

    @property
    def in_step(self) -> bool:
        """Whether the step that began is not accepted yet."""
        return self._step_motion is self.motion

    def move_to(self, z: Values) -> None:
        """Move to the increment z (k,)."""
        self.z, self.pose = z, self.step.pose(z)

    def discard_predictor(self) -> None:
        """Discard the path of the last step of Newton's method."""
        self._predictor = None

    def store_solution(self) -> None:
        """Store z as a start if the step is taken again."""
        self._solution = self.z

    # --- equilibrium ---

    def equilibrate(self, surroundings: MeshSurroundings) -> Values:
        """(k,) z of equilibrium with the body at its current position.

        Where something is in the way from every start, the current z: Newton's method fails, and the step is halved.
        """
        current = self.z
        for z in self._start_candidates(surroundings):
            if self._is_reachable(surroundings, z):
                z, _ = self.step.minimise(
                    z,
                    lambda z: self.pose_derivatives(surroundings, z),
                    lambda z, dz: self.free_fraction(surroundings, z, dz),
                )
                self._equilibrium = surroundings.positions, self.step.pose(z)
                return z
        return current

    def _start_candidates(self, surroundings: MeshSurroundings) -> Iterator[Values]:
        if (predictor := self._predictor) is not None and surroundings.positions is not None:
            yield predictor.way_at(predictor.fraction_at(surroundings.positions))
        yield self.z
        if self._solution is not None:
            yield self._solution
        yield np.zeros_like(self.z)

    def _is_reachable(self, surroundings: MeshSurroundings, z: Values) -> bool:
        """Whether obstacle and body reach z and their positions without a collision."""
        pose = self.step.pose(z)
        if not self.obstacle_pairs.are_open(pose, surroundings.obstacles):
            return False
        if surroundings.pairs is None or surroundings.positions is None or surroundings.start is None:
            return True
        if (predictor := self._predictor) is not None:
            fraction = predictor.fraction_at(surroundings.positions)
            offset = surroundings.positions - predictor.positions - fraction * predictor.motion
            is_on_path = abs(offset).max() <= PATH_TOLERANCE * abs(predictor.motion).max()
            # the step limit has checked that path
            if is_on_path and np.array_equal(z, predictor.way_at(fraction)):
                return True
        x, start_pose = surroundings.start, self.step.start.pose
        if self._equilibrium is not None and self._equilibrium[0] is not None:
            x, start_pose = self._equilibrium[0], self._equilibrium[1]
        surroundings.pairs.mesh.move_to(pose)
        return surroundings.pairs.moving_free_fraction(x, surroundings.positions, start_pose) == 1

    def pose_derivatives(self, surroundings: MeshSurroundings, z: Values) -> PoseDerivatives:
        """Energy of contact at z, and its derivatives by the pose."""
        self.move_to(z)
        derivatives = self.obstacle_pairs.pose_derivatives(self.pose, surroundings.obstacles)
        of_points = self._point_derivatives(surroundings)
        return derivatives if of_points is None else derivatives + point_set_derivatives(*of_points)

    def _contact(self, surroundings: MeshSurroundings) -> tuple[MeshObstaclePairs, Values, int] | None:
        """Pairs with the mesh at its pose, points (n + m, 3) of body and mesh, and n; None: the body is far."""
        pairs = surroundings.pairs
        if pairs is None or surroundings.positions is None:
            return None
        pairs.mesh.move_to(self.pose)
        if pairs.is_far(surroundings.positions):
            return None
        return pairs, pairs.with_mesh(surroundings.positions), len(surroundings.positions)

    def _point_derivatives(
        self, surroundings: MeshSurroundings
    ) -> tuple[float, Values, csr_matrix, csr_matrix, Values] | None:
        """Derivatives of the energy by the points of the mesh; None: the body is far.

        Returns:
            Energy, J; (m, 3) gradient; second derivatives, exact and positive semi-definite; (m, 3) arms, m.
        """
        if (contact := self._contact(surroundings)) is None:
            return None
        pairs, points, n = contact
        energy, gradient = pairs.energy(points), pairs.gradient(points)
        exact, stiff = pairs.hessian(points, exact=True), pairs.hessian(points)
        if (friction := surroundings.friction) is not None:
            energy, gradient = energy + friction.energy(points), gradient + friction.gradient(points)
            exact = exact + friction.hessian(points, exact=True)
            stiff = stiff + friction.hessian(points)
        mesh_dofs = slice(3 * n, None)
        arms = pairs.mesh.positions - self.pose.centre
        return energy, gradient[n:], exact[mesh_dofs, mesh_dofs], stiff[mesh_dofs, mesh_dofs], arms

    def free_fraction(self, surroundings: MeshSurroundings, z: Values, dz: Values) -> float:
        """Fraction of the change dz from z that closes no gap, with the body at rest."""
        self.move_to(z)
        start, q = self.pose, self.step.pose_change(z, dz)
        motions = {number: (posed, np.zeros_like(q)) for number, posed in surroundings.obstacles.items()}
        fraction = self.obstacle_pairs.safe_fraction(start, q, motions)
        x = surroundings.positions
        if surroundings.pairs is None or x is None:
            return fraction
        surroundings.pairs.mesh.move_to(self.step.pose(z + dz))
        return min(fraction, surroundings.pairs.moving_free_fraction(x, x, start))

    # --- condensation ---

    def condensation(self, surroundings: MeshSurroundings) -> tuple[Values, Values] | None:
        """(3 n, k) Phi_xz by the body's points, and (k, k) inverse of the positive definite part of Phi_zz.

        None where nothing of the body is near.
        """
        if (contact := self._contact(surroundings)) is None:
            return None
        pairs, points, n = contact
        H = pairs.hessian(points)
        if surroundings.friction is not None:
            H = H + surroundings.friction.hessian(points)
        J = point_jacobian(pairs.mesh.positions - self.pose.centre).reshape(-1, 6)
        mixed = self.step.factor * (H[: 3 * n, 3 * n :] @ J) @ self.step.pose_jacobian(self.z)
        if not mixed.any():
            return None
        hessian = self.step.system(self.z, self.pose_derivatives(surroundings, self.z))[2]
        return mixed, np.asarray(np.linalg.inv(hessian))

    def predict_pose(self, surroundings: MeshSurroundings, motion: Values) -> Pose:
        """Pose for a motion (n, 3) of the points, m, by the condensed system."""
        condensed, dz = self.condensation(surroundings), np.zeros_like(self.z)
        if condensed is not None:
            mixed, compliance = condensed
            dz = -compliance @ (mixed.T @ motion.reshape(-1))
        assert surroundings.positions is not None
        self._predictor = PosePredictor(surroundings.positions, motion, self.z, dz)
        return self.step.pose(self.z + dz)

    def wrench(self, surroundings: MeshSurroundings) -> Values:
        """(6,) force and moment of the body and of other obstacles on it, N and N m."""
        total = self.obstacle_pairs.wrench(self.pose, surroundings.obstacles)
        of_points = self._point_derivatives(surroundings)
        return total if of_points is None else total + resultant(-of_points[1], of_points[4])

    # --- first guesses ---

    def first_guess(
        self, surroundings: MeshSurroundings, end: Values, increments: list[Values]
    ) -> tuple[Values, float]:
        """First guess (k,) of the increment, and its fraction that closes no gap.

        The first of these without a collision: free flight, rest, motion with a driven obstacle.

        Args:
            surroundings: body at the start of the step.
            end: (n, 3) points of the body at the end of their motion, m.
            increments: (6,) of driven obstacles.
        """
        d, fraction = 3, 0.0
        carried = [
            np.asarray(np.linalg.lstsq(self.body.motion_basis[:d], increment[:d], rcond=None)[0])
            for increment in increments
            if increment.any()
        ]
        guesses: list[Values] = [self.step.free_flight, 0 * self.step.free_flight, *carried]
        for z in guesses:
            safe = self._safe_fraction(surroundings, end, z)
            if safe == 1:
                return z, 1.0
            fraction = fraction or safe
        return guesses[0], fraction

    def _safe_fraction(self, surroundings: MeshSurroundings, end: Values, z: Values) -> float:
        start = self.step.start.pose
        motions: dict[int, PoseMotion] = {
            number: (posed, np.zeros(6)) for number, posed in surroundings.obstacles.items()
        }
        fraction = self.obstacle_pairs.safe_fraction(start, self.step.increment(z), motions)
        if surroundings.pairs is None or surroundings.start is None:
            return fraction
        surroundings.pairs.mesh.move_to(self.step.pose(z))
        return min(fraction, surroundings.pairs.moving_free_fraction(surroundings.start, end, start))
