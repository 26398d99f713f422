"""Contact between two triangle-mesh obstacles of which one at least is free: barrier and lagged friction of ipctk.

The points of an obstacle are x = c + R X, so that derivatives by poses follow from those by points.

Equations: docs/theory.md#barrier, docs/theory.md#friction, docs/theory.md#rigid-obstacles.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix

from .ipc_pairs import IpcPairs
from .laws import ObstacleLaw
from .mesh_obstacles import MESH, free_fraction_on_arcs
from .obstacle import RigidObstacle
from .obstacle_pairs import Numbers, PairDerivatives, PosedObstacles
from .pose_derivatives import point_jacobian, point_set_derivatives
from .rigid_obstacles import RigidObstacles
from .sample_points import IpcFriction
from .step_limit import PoseMotion
from .triangle_mesh_shape import StackedMeshes

Values = npt.NDArray[np.float64]


class MeshPair:
    """A pair of triangle-mesh obstacles, as obstacle_pairs.BarrierPair."""

    def __init__(
        self, numbers: Numbers, obstacles: Mapping[int, RigidObstacle], law: ObstacleLaw, stiffness: float
    ) -> None:
        """`obstacles`: by their numbers; `law`: distance and friction; `stiffness`: of the barrier, Pa."""
        self.numbers, self._law, members = numbers, law, [obstacles[number] for number in numbers]
        self._meshes = StackedMeshes(*(obstacle.shape for obstacle in members))
        self._coefficient = max(obstacle.friction for obstacle in members)

        def build(distance: float) -> IpcPairs:
            return IpcPairs(
                self._meshes.points, self._meshes.triangles, distance=distance, stiffness=stiffness,
                friction=self._coefficient, patch=self._meshes.patches,
            )  # fmt: skip

        self._distance, self._pairs = law.barrier.width, build(law.barrier.width)
        start = self._meshes.positions([obstacle.posed_at(0.0).pose for obstacle in members])
        if (gap := self._pairs.min_gap(start)) < self._distance:
            self._distance = MESH.gap_share * gap
            self._pairs = build(self._distance)
        self._friction: IpcFriction | None = None
        self._start: Values = start  # (n, 3) points of both at the start of the step, m

    def _near_positions(self, posed: PosedObstacles) -> Values | None:
        """(n, 3) points of both obstacles, m; None: they are far, and were so at the start of the step."""
        max_gap = self._distance if self._friction is None else np.inf
        return self._meshes.near_positions([posed[number].pose for number in self.numbers], max_gap)

    def begin_step(self, motion: RigidObstacles, dt: float, *, time_averaged: bool) -> None:
        """Begin a step of dt, s: friction is lagged; forces are those of the end of the step, whatever the scheme."""
        self._friction = None
        if self._coefficient and (x := self._near_positions(motion.start_posed)) is not None:
            parts = [(n, x[rows]) for n, rows in zip(self.numbers, self._meshes.rows, strict=True)]
            velocity = np.concatenate([np.broadcast_to(motion.velocity(n, y), y.shape) for n, y in parts])
            pressed = self._pairs.gradient(x).any(axis=1)
            if pressed.any():
                speed = float(np.linalg.norm(np.ptp(velocity[pressed], axis=0)))
                slip = dt * max(self._law.sticking_speed, self._law.sticking_ratio * speed)
                self._start, self._friction = x, self._pairs.lag_friction(x, x, slip)

    def is_open(self, posed: PosedObstacles) -> bool:
        """Whether the obstacles do not intersect."""
        return (x := self._near_positions(posed)) is None or not len(self._pairs.intersections(x))

    def energies(self, posed: PosedObstacles) -> tuple[float, float]:
        """Energy of the barrier, and potential of all forces in the step, J."""
        if (x := self._near_positions(posed)) is None:
            return 0.0, 0.0
        energy = self._pairs.energy(x)
        return energy, energy + (0.0 if self._friction is None else self._friction.energy(x))

    def derivatives(self, posed: PosedObstacles, *, exact: bool) -> PairDerivatives | None:
        """Derivatives of the potential by both poses; None: out of contact."""
        if (x := self._near_positions(posed)) is None:
            return None
        gradient = self._pairs.gradient(x)
        if self._friction is not None:
            gradient = gradient + self._friction.gradient(x)
        if not gradient.any():
            return None
        H = self._pairs.hessian(x, exact=exact)
        if self._friction is not None:
            H = csr_matrix(H + self._friction.hessian(x, exact=exact))
        energy, first, rows = self.energies(posed)[1], 3 * self._meshes.count, self._meshes.rows
        dofs = slice(None, first), slice(first, None)
        arms = [x[part] - posed[number].pose.centre for number, part in zip(self.numbers, rows, strict=True)]
        by_first, by_second = (
            point_set_derivatives(energy, gradient[part], H[columns, columns], arm, exact=exact)
            for part, columns, arm in zip(rows, dofs, arms, strict=True)
        )
        J, J_second = (point_jacobian(arm).reshape(arm.size, -1) for arm in arms)
        return by_first, by_second, np.asarray(J.T @ (H[dofs[0], dofs[1]] @ J_second))

    def dissipated(self, posed: PosedObstacles) -> float:
        """Energy dissipated by friction in the step, J."""
        if self._friction is None or (x := self._near_positions(posed)) is None:
            return 0.0
        return float(np.vdot(self._friction.gradient(x), x - self._start))

    def safe_fraction(self, first: PoseMotion, second: PoseMotion) -> float:
        """Fraction of the motions of both that leaves a tenth of each gap."""
        moving = first, second
        if not any(q.any() for _, q in moving):
            return 1.0

        def positions(fraction: float) -> Values:
            return self._meshes.positions([posed.pose.incremented(fraction * q) for posed, q in moving])

        rotation = max(float(np.linalg.norm(q[3:])) for _, q in moving)
        return free_fraction_on_arcs(self._pairs.free_fraction, positions, rotation)
