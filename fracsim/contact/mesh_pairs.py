"""Contact between triangle-mesh obstacles of which one at least is free: barrier of ipctk, without friction.

The points of an obstacle are x = c + R X, so that derivatives by poses follow from those by points. Prescribed
obstacles do not touch one another.

Equations: docs/theory.md#barrier, docs/theory.md#rigid-obstacles.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np
import numpy.typing as npt

from .ipc_pairs import IpcPairs
from .laws import BARRIER
from .mesh_obstacles import MESH
from .obstacle import RigidObstacle
from .obstacle_pairs import Numbers, PosedObstacles
from .pose import Pose
from .pose_derivatives import MixedHessian, PoseDerivatives, point_jacobian, point_set_derivatives
from .step_limit import PoseMotion

Values = npt.NDArray[np.float64]

# distance of the barrier in the least gap at the start, where the gap is smaller than the distance
GAP_SHARE = 0.5


class MeshPairs:
    """All pairs of triangle-mesh obstacles; `posed` are all obstacles at their poses, by their numbers."""

    def __init__(self, obstacles: Mapping[int, RigidObstacle], *, distance: float, stiffness: float) -> None:
        """`obstacles`: triangle meshes by their numbers; `distance`, m, and `stiffness`, Pa, of the barrier."""
        self._points = {number: obstacle.shape.tessellate()[0] for number, obstacle in obstacles.items()}
        self._free = [number for number, obstacle in obstacles.items() if obstacle.free]
        sizes = [len(points) for points in self._points.values()]
        ends = np.cumsum(sizes)
        self._rows = {n: slice(end - size, end) for n, size, end in zip(obstacles, sizes, ends, strict=True)}
        elements = [obstacle.shape.tessellate()[1] + self._rows[number].start for number, obstacle in obstacles.items()]
        patch = {number: 1 + self._free.index(number) if number in self._free else 0 for number in obstacles}
        self._patches = np.repeat(np.array([patch[number] for number in obstacles], np.int32), sizes)
        self._rest, self._elements, self._stiffness = (
            np.concatenate([*self._points.values()]),
            np.concatenate(elements),
            stiffness,
        )
        self._distance = distance
        self._pairs = self._build()
        start = self._positions({number: obstacle.posed_at(0.0).pose for number, obstacle in obstacles.items()})
        if (gap := self._pairs.min_gap(start)) < distance:
            self._distance = GAP_SHARE * gap
            self._pairs = self._build()

    def _build(self) -> IpcPairs:
        pairs = IpcPairs(self._rest, self._elements, distance=self._distance, stiffness=self._stiffness)
        pairs.restrict_to_patches(self._patches)
        return pairs

    def _positions(self, poses: Mapping[int, Pose]) -> Values:
        """(n, 3) points of all obstacles at poses, m."""
        return np.concatenate([poses[number].points_to_space(points) for number, points in self._points.items()])

    def _at(self, posed: PosedObstacles) -> Values | None:
        """(n, 3) points of all obstacles, m; None: no two of them are near."""
        x = self._positions({number: posed[number].pose for number in self._points})
        boxes = {number: (x[rows].min(axis=0), x[rows].max(axis=0)) for number, rows in self._rows.items()}
        for i, j in combinations(boxes, 2):
            gap = np.maximum(boxes[i][0] - boxes[j][1], boxes[j][0] - boxes[i][1]).max()
            if gap < self._distance and (i in self._free or j in self._free):
                return x
        return None

    def begin_step(self, posed: PosedObstacles, *, time_averaged: bool) -> None:
        """Begin a step: forces are those of its end, whatever the scheme."""

    def are_open(self, posed: PosedObstacles) -> bool:
        """Whether no two obstacles intersect."""
        return (x := self._at(posed)) is None or not len(self._pairs.intersections(x))

    def energies(self, posed: PosedObstacles) -> tuple[float, float]:
        """Energy of the barriers, and potential of their forces in the step, J."""
        energy = 0.0 if (x := self._at(posed)) is None else self._pairs.energy(x)
        return energy, energy

    def derivatives(self, posed: PosedObstacles) -> tuple[dict[int, PoseDerivatives], dict[Numbers, MixedHessian]]:
        """Energies and derivatives by the poses of free obstacles, as of ObstaclePairs."""
        if (x := self._at(posed)) is None:
            return {}, {}
        energy, gradient = self._pairs.energy(x), self._pairs.gradient(x)
        if not gradient.any():
            return {}, {}
        hessians = self._pairs.hessian(x, exact=True), self._pairs.hessian(x)
        dofs = {number: slice(3 * rows.start, 3 * rows.stop) for number, rows in self._rows.items()}
        arms = {number: x[self._rows[number]] - posed[number].pose.centre for number in self._free}
        bodies = {}
        for number in self._free:
            exact, positive = (H[dofs[number], dofs[number]] for H in hessians)
            bodies[number] = point_set_derivatives(energy, gradient[self._rows[number]], exact, positive, arms[number])
            energy = 0.0  # it counts once
        J = {number: point_jacobian(arm).reshape(arm.size, -1) for number, arm in arms.items()}
        mixed: dict[Numbers, MixedHessian] = {}
        for i, j in combinations(self._free, 2):
            exact, positive = (np.asarray(J[i].T @ (H[dofs[i], dofs[j]] @ J[j])) for H in hessians)
            mixed[i, j] = exact, positive
        return bodies, mixed

    def work(self, posed: PosedObstacles, increments: Mapping[int, Values] | Sequence[Values]) -> float:
        """Work of prescribed obstacles on free ones by their own increments (6,) in the step, J."""
        if (x := self._at(posed)) is None:
            return 0.0
        gradient, total = self._pairs.gradient(x), 0.0
        for number, rows in self._rows.items():
            if number not in self._free:
                J = point_jacobian(x[rows] - posed[number].pose.centre)
                total += float(np.einsum("nd,ndp,p->", gradient[rows], J, increments[number]))
        return total

    def safe_fraction(self, motions: Mapping[int, PoseMotion]) -> float:
        """Fraction of the motions of obstacles that leaves a tenth of each gap; the others are at rest elsewhere.

        Points of an obstacle that rotates move on arcs, which are divided into chords that end on them.
        """
        moving = {number: motions[number] for number in self._points if number in motions}
        if len(moving) < len(self._points) or not any(q.any() for _, q in moving.values()):
            return 1.0
        turn = max(float(np.linalg.norm(q[3:])) for _, q in moving.values())
        pieces = 1 + int(turn / MESH.max_rotation)

        def positions(fraction: float) -> Values:
            return self._positions({n: posed.pose.incremented(fraction * q) for n, (posed, q) in moving.items()})

        for piece in range(pieces):
            first, fraction, chord = piece / pieces, 1.0, 0.0
            start = positions(first)
            while chord < 1 and fraction > MESH.min_fraction:
                chord = self._pairs.free_fraction(start, positions(first + fraction / pieces))
                fraction *= 1.0 if chord == 1 else (1 - BARRIER.min_gap_ratio) * chord
            if chord < 1:
                return first
            if fraction < 1:
                return first + fraction / pieces
        return 1.0
