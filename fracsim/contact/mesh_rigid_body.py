"""A free solid in a step, with the body where it is: its pose is eliminated as that of other free obstacles is.

All of it is on rank 0 but how it flies, its way z and its pose.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix

from .ipc_friction import IpcFriction
from .mesh_obstacles import MeshObstaclePairs
from .obstacle import FreeObstacle, RigidMotion
from .obstacle_pairs import ObstaclePairs
from .pose import Pose, PosedShape
from .rigid_body import PoseDerivatives, PosePredictor, RigidStep, point_jacobian, point_set_derivatives, resultant
from .step_limit import PoseMotion

Values = npt.NDArray[np.float64]

ON_THE_WAY = 1e-9  # of the length of a step of Newton's method: places that are on it


@dataclass(frozen=True)
class MeshSurroundings:
    """What a solid is before in a step.

    Attributes:
        facing, friction: what the body does to it, unless that is far.    x: (n, 3) where that is; None: far.
        others: where other obstacles are, by their numbers.    start: (n, 3) where the body was as the step began.
    """

    pairs: MeshObstaclePairs | None
    friction: IpcFriction | None
    positions: Values | None
    obstacles: Mapping[int, PosedShape]
    start: Values | None = None


class FreeMesh:
    """A free solid, and its pose.

    Attributes:
        flight: how it moves, at the start of a step until it is over.    step: the one that began last.
        z: (k,) its way in the step.    pose: where it is.    stops: what it meets beside the body, on rank 0.
    """

    step: RigidStep
    z: Values
    obstacle_pairs: ObstaclePairs

    def __init__(self, body: FreeObstacle) -> None:
        self.body, self.motion = body, body.start_motion()
        self.pose = self.motion.pose
        self._step_motion: RigidMotion | None = None  # that the step began with
        self._solution: Values | None = None  # z of the last solution of this step
        self._predictor: PosePredictor | None = None
        self._equilibrium: tuple[Values | None, Pose] | None = None  # where it was settled last in the step

    # --- a step ---

    def reset_pose(self) -> None:
        """Between two steps."""
        self.pose = self.motion.pose

    def begin_step(self, step: RigidStep) -> None:
        """A step begins, for the first time or once more."""
        if self._step_motion is not self.motion:
            self._solution = None
        self._step_motion, self.step, self._equilibrium = self.motion, step, None
        self.discard_predictor()
        self.move_to(np.zeros(self.body.motion_basis.shape[1]))

    @property
    def in_step(self) -> bool:
        """Whether the step that began is not over yet."""
        return self._step_motion is self.motion

    def move_to(self, z: Values) -> None:
        """At z (k,)."""
        self.z, self.pose = z, self.step.pose(z)

    def discard_predictor(self) -> None:
        """Newton's method starts anew."""
        self._predictor = None

    def store_solution(self) -> None:
        """The step is over: where it is first looked for if it is taken again."""
        self._solution = self.z

    # --- where it is ---

    def equilibrate(self, before: MeshSurroundings) -> Values:
        """The way z that belongs to the body where it is."""
        here = self.z
        for z in self._candidates(before):
            if self._may_be_at(before, z):
                z, _ = self.step.minimise(
                    z, lambda z: self.pose_derivatives(before, z), lambda z, dz: self.free_fraction(before, z, dz)
                )
                self._equilibrium = before.positions, self.step.pose(z)
                return z
        return here  # the body or a stop is in its way: Newton's method fails, and the step is halved

    def _candidates(self, before: MeshSurroundings) -> Iterator[Values]:
        if (way := self._predictor) is not None and before.positions is not None:
            yield way.way_at(way.fraction_at(before.positions))
        yield self.z
        if self._solution is not None:
            yield self._solution
        yield np.zeros_like(self.z)

    def _may_be_at(self, before: MeshSurroundings, z: Values) -> bool:
        """Whether it gets there, and the body where that is, with nothing between them on their ways."""
        pose = self.step.pose(z)
        if not self.obstacle_pairs.are_open(pose, before.obstacles):
            return False
        if before.pairs is None or before.positions is None or before.start is None:
            return True
        if (way := self._predictor) is not None:
            off = before.positions - way.positions - (share := way.fraction_at(before.positions)) * way.motion
            on_it = abs(off).max() <= ON_THE_WAY * abs(way.motion).max()
            if on_it and np.array_equal(z, way.way_at(share)):
                return True  # longest_step has looked
        x, then = before.start, self.step.start.pose
        if self._equilibrium is not None and self._equilibrium[0] is not None:
            x, then = self._equilibrium[0], self._equilibrium[1]
        before.pairs.mesh.move_to(pose)
        return before.pairs.moving_free_fraction(x, before.positions, then) == 1

    def pose_derivatives(self, before: MeshSurroundings, z: Values) -> PoseDerivatives:
        """What the body and stops do to it at z."""
        self.move_to(z)
        found = self.obstacle_pairs.pose_derivatives(self.pose, before.obstacles)
        parts = self._parts(before)
        return found if parts is None else found + point_set_derivatives(*parts)

    def _met(self, before: MeshSurroundings) -> tuple[MeshObstaclePairs, Values, int] | None:
        """The body's facets, with the solid where it is, the points (n + m, 3) of both and n; None: far."""
        facing = before.pairs
        if facing is None or before.positions is None:
            return None
        facing.mesh.move_to(self.pose)
        return (
            None
            if facing.is_far(before.positions)
            else (facing, facing.with_mesh(before.positions), len(before.positions))
        )

    def _parts(self, before: MeshSurroundings) -> tuple[float, Values, csr_matrix, csr_matrix, Values] | None:
        """Energy, its derivative by the points of the solid, second ones, exact and positive, and arms; None: far."""
        if (met := self._met(before)) is None:
            return None
        facing, both, n = met
        energy, g = facing.energy(both), facing.gradient(both)
        exact, stiff = facing.hessian(both, exact=True), facing.hessian(both)
        if before.friction is not None:
            energy, g = energy + before.friction.energy(both), g + before.friction.gradient(both)
            exact = exact + before.friction.hessian(both, exact=True)
            stiff = stiff + before.friction.hessian(both)
        own = slice(3 * n, None)
        return energy, g[n:], exact[own, own], stiff[own, own], facing.mesh.positions - self.pose.centre

    def free_fraction(self, before: MeshSurroundings, z: Values, dz: Values) -> float:
        """Share of the way from z by dz that closes no gap, with the body where it is."""
        self.move_to(z)
        start, q = self.pose, self.step.pose_change(z, dz)
        still = {number: (placed, np.zeros_like(q)) for number, placed in before.obstacles.items()}
        share = self.obstacle_pairs.safe_fraction(start, q, still)
        if before.pairs is None or before.positions is None:
            return share
        before.pairs.mesh.move_to(self.step.pose(z + dz))
        return min(share, before.pairs.moving_free_fraction(before.positions, before.positions, start))

    # --- how it gives way ---

    def condensation(self, before: MeshSurroundings) -> tuple[Values, Values] | None:
        """(3 n, k) Phi_xz by the body's points and (k, k) Phi_zz^-1, its positive definite part; None: nothing of the
        body is near."""
        if (met := self._met(before)) is None:
            return None
        facing, both, n = met
        H = facing.hessian(both)
        if before.friction is not None:
            H = H + before.friction.hessian(both)
        J = point_jacobian(facing.mesh.positions - self.pose.centre).reshape(-1, 6)
        mixed = self.step.factor * (H[: 3 * n, 3 * n :] @ J) @ self.step.pose_jacobian(self.z)
        if not mixed.any():
            return None
        resistance = self.step.system(self.z, self.pose_derivatives(before, self.z))[2]
        return mixed, np.asarray(np.linalg.inv(resistance))

    def predict_pose(self, before: MeshSurroundings, moved: Values) -> Pose:
        """Where Newton's method takes it together with the points, which go by `moved` (n, 3), m."""
        given, dz = self.condensation(before), np.zeros_like(self.z)
        if given is not None:
            mixed, compliance = given
            dz = -compliance @ (mixed.T @ moved.reshape(-1))
        assert before.positions is not None
        self._predictor = PosePredictor(before.positions, moved, self.z, dz)
        return self.step.pose(self.z + dz)

    def wrench(self, before: MeshSurroundings) -> Values:
        """(6,) force and moment of body and stops on it, N and N m."""
        force = self.obstacle_pairs.wrench(self.pose, before.obstacles)
        parts = self._parts(before)
        return force if parts is None else force + resultant(-parts[1], parts[4])

    # --- first guesses ---

    def first_guess(self, before: MeshSurroundings, to: Values, led: list[Values]) -> tuple[Values, float]:
        """Where it goes by itself, stays or is taken along by another one on its way (6,), whichever is free first with
        the body on its way `to` (n, 3) from the start, and the share of that way which closes no gap."""
        d, first = 3, 0.0
        along = [
            np.asarray(np.linalg.lstsq(self.body.motion_basis[:d], way[:d], rcond=None)[0]) for way in led if way.any()
        ]
        ways: list[Values] = [self.step.free_flight, 0 * self.step.free_flight, *along]
        for z in ways:
            share = self._safe_share(before, to, z)
            if share == 1:
                return z, 1.0
            first = first or share
        return ways[0], first

    def _safe_share(self, before: MeshSurroundings, to: Values, z: Values) -> float:
        start = self.step.start.pose
        others: dict[int, PoseMotion] = {number: (placed, np.zeros(6)) for number, placed in before.obstacles.items()}
        share = self.obstacle_pairs.safe_fraction(start, self.step.increment(z), others)
        if before.pairs is None or before.start is None:
            return share
        before.pairs.mesh.move_to(self.step.pose(z))
        return min(share, before.pairs.moving_free_fraction(before.start, to, start))
