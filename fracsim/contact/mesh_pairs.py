"""Contact between two triangle-mesh obstacles of which one at least is free: barrier and lagged friction of ipctk.

The points of an obstacle are x = c + R X, so that derivatives by poses follow from those by points.

Equations: docs/theory.md#barrier, docs/theory.md#friction, docs/theory.md#rigid-obstacles.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix

from .ipc_pairs import IpcPairs
from .laws import ObstacleLaw
from .mesh_obstacles import MESH, free_fraction_on_arcs
from .obstacle import RigidObstacle
from .obstacle_pairs import Numbers, PosedObstacles, StepMotion
from .pose import Pose
from .pose_derivatives import PoseDerivatives, point_jacobian, point_set_derivatives
from .sample_points import IpcFriction
from .step_limit import PoseMotion

Values = npt.NDArray[np.float64]


class MeshPair:
    """A pair of triangle-mesh obstacles; `posed` are all obstacles at their poses, by their numbers."""

    def __init__(self, obstacles: Mapping[int, RigidObstacle], law: ObstacleLaw, stiffness: float) -> None:
        """`obstacles`: the two by their numbers; `law`: distance and friction; `stiffness`: of the barrier, Pa."""
        self._numbers, self._law = list(obstacles), law
        self._free = [number for number, obstacle in obstacles.items() if obstacle.free]
        tessellations = [obstacle.shape.tessellate() for obstacle in obstacles.values()]
        self._points, first = [points for points, _ in tessellations], len(tessellations[0][0])
        self._rows = slice(0, first), slice(first, None)
        self._friction_coefficient = max(obstacle.friction for obstacle in obstacles.values())
        reference = np.concatenate(self._points)
        elements = np.concatenate([tessellations[0][1], tessellations[1][1] + first])
        patches = np.repeat(np.array([0, 1], np.int32), [first, len(reference) - first])

        def build(distance: float) -> IpcPairs:
            law = {"distance": distance, "stiffness": stiffness, "friction": self._friction_coefficient}
            return IpcPairs(reference, elements, **law, share=None, patch=patches)

        self._distance, self._pairs = law.barrier.width, build(law.barrier.width)
        start = self._positions([obstacle.posed_at(0.0).pose for obstacle in obstacles.values()])
        if (gap := self._pairs.min_gap(start)) < self._distance:
            self._distance = MESH.gap_share * gap
            self._pairs = build(self._distance)
        self._friction: IpcFriction | None = None
        self._start: Values = start  # (n, 3) points of both at the start of the step, m

    def _positions(self, poses: Sequence[Pose]) -> Values:
        """(n, 3) points of both obstacles at poses, m."""
        return np.concatenate([pose.points_to_space(X) for pose, X in zip(poses, self._points, strict=True)])

    def _at(self, posed: PosedObstacles) -> Values | None:
        """(n, 3) points of both obstacles, m; None: they are far, and were so at the start of the step."""
        x = self._positions([posed[number].pose for number in self._numbers])
        first, second = (x[rows] for rows in self._rows)
        gap = np.maximum(first.min(axis=0) - second.max(axis=0), second.min(axis=0) - first.max(axis=0)).max()
        return x if gap < self._distance or self._friction is not None else None

    def begin_step(self, motion: StepMotion, dt: float, *, time_averaged: bool) -> None:
        """Begin a step of dt, s: friction is lagged; forces are those of the end of the step, whatever the scheme."""
        self._friction = None
        if self._friction_coefficient and (x := self._at(motion.start_posed)) is not None:
            ends = [motion.velocity(n, x[rows]) for n, rows in zip(self._numbers, self._rows, strict=True)]
            velocity = np.concatenate([np.broadcast_to(v, X.shape) for v, X in zip(ends, self._points, strict=True)])
            pressed = self._pairs.gradient(x).any(axis=1)
            if pressed.any():
                speed = float(np.linalg.norm(np.ptp(velocity[pressed], axis=0)))
                slip = dt * max(self._law.sticking_speed, self._law.sticking_ratio * speed)
                self._start, self._friction = x, self._pairs.lag_friction(x, x, slip)

    def are_open(self, posed: PosedObstacles) -> bool:
        """Whether the obstacles do not intersect."""
        return (x := self._at(posed)) is None or not len(self._pairs.intersections(x))

    def energies(self, posed: PosedObstacles) -> tuple[float, float]:
        """Energy of the barrier, and potential of all forces in the step, J."""
        if (x := self._at(posed)) is None:
            return 0.0, 0.0
        energy = self._pairs.energy(x)
        return energy, energy + (0.0 if self._friction is None else self._friction.energy(x))

    def _gradient(self, x: Values) -> Values:
        """(n, 3) minus the forces on the points, N."""
        gradient = self._pairs.gradient(x)
        return gradient if self._friction is None else gradient + self._friction.gradient(x)

    def _hessian(self, x: Values, *, exact: bool) -> csr_matrix:
        """(3 n, 3 n) second derivatives by the points, N/m."""
        H = self._pairs.hessian(x, exact=exact)
        return H if self._friction is None else csr_matrix(H + self._friction.hessian(x, exact=exact))

    def derivatives(
        self, posed: PosedObstacles, *, exact: bool
    ) -> tuple[dict[int, PoseDerivatives], dict[Numbers, Values]]:
        """Energies and derivatives by the poses of free obstacles, as of ObstaclePairs."""
        if (x := self._at(posed)) is None or not (gradient := self._gradient(x)).any():
            return {}, {}
        energy, H = self.energies(posed)[1], self._hessian(x, exact=exact)
        first = 3 * len(self._points[0])
        dofs, bodies, J = (slice(0, first), slice(first, None)), dict[int, PoseDerivatives](), list[Values]()
        for number, rows, columns in zip(self._numbers, self._rows, dofs, strict=True):
            arm = x[rows] - posed[number].pose.centre
            J.append(point_jacobian(arm).reshape(arm.size, -1))
            if number in self._free:
                block = H[columns, columns]
                bodies[number] = point_set_derivatives(energy, gradient[rows], block, arm, exact=exact)
                energy = 0.0  # it counts once
        if len(self._free) < 2:
            return bodies, {}
        return bodies, {(self._numbers[0], self._numbers[1]): np.asarray(J[0].T @ (H[dofs[0], dofs[1]] @ J[1]))}

    def work(self, posed: PosedObstacles, increments: Mapping[int, Values] | Sequence[Values]) -> tuple[float, float]:
        """Work of a prescribed obstacle on the free one by its own increment (6,) in the step; dissipation, J."""
        if (x := self._at(posed)) is None:
            return 0.0, 0.0
        gradient, total = self._gradient(x), 0.0
        for number, rows in zip(self._numbers, self._rows, strict=True):
            if number not in self._free:
                J = point_jacobian(x[rows] - posed[number].pose.centre)
                total += float(np.einsum("nd,ndp,p->", gradient[rows], J, increments[number]))
        if self._friction is None:
            return total, 0.0
        return total, float(np.vdot(self._friction.gradient(x), x - self._start))

    def safe_fraction(self, motions: Mapping[int, PoseMotion]) -> float:
        """Fraction of the motions of both that leaves a tenth of each gap; 1 where the motion of one is not given."""
        if not all(number in motions for number in self._numbers):
            return 1.0
        moving = [motions[number] for number in self._numbers]
        if not any(q.any() for _, q in moving):
            return 1.0

        def positions(fraction: float) -> Values:
            return self._positions([posed.pose.incremented(fraction * q) for posed, q in moving])

        rotation = max(float(np.linalg.norm(q[3:])) for _, q in moving)
        return free_fraction_on_arcs(self._pairs.free_fraction, positions, rotation)
