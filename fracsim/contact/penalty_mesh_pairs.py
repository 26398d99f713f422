"""Penalty between two triangle-mesh obstacles of which one at least is free, in explicit steps, without friction.

Points before facets, and sharp edges, of both (penalty_pairs). The points of an obstacle are x = c + R X.

Equations: docs/theory.md#explicit-contact.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
import numpy.typing as npt

from .ipc_pairs import vertex_areas
from .laws import Penalty
from .mesh_obstacles import MESH
from .obstacle import RigidObstacle
from .obstacle_pairs import SAMPLES, Numbers, PosedObstacles
from .penalty_contacts import ContactStiffness
from .penalty_pairs import PenaltyHistory, PenaltyPairs
from .pose import Pose
from .pose_derivatives import resultant
from .rigid_obstacles import PAIR_PENALTY

Values = npt.NDArray[np.float64]

type PenaltyLimit = Callable[[Numbers, float], Penalty]  # numbers of a pair, area that may touch at once, m^2


class PenaltyMeshPair:
    """A pair of triangle-mesh obstacles; `posed` are all obstacles at their poses, by their numbers."""

    def __init__(self, obstacles: Mapping[int, RigidObstacle], penalty: Penalty) -> None:
        """`obstacles`: the two by their numbers, apart at the start."""
        self._first, self._second = obstacles
        self._free = [number for number, obstacle in obstacles.items() if obstacle.free]
        tessellations = [obstacle.shape.tessellate() for obstacle in obstacles.values()]
        self._points, self._count = [points for points, _ in tessellations], len(tessellations[0][0])
        self._reference = np.concatenate(self._points)
        self._elements = np.concatenate([tessellations[0][1], tessellations[1][1] + self._count]).astype(np.int64)
        self._area = vertex_areas(self._reference, self._elements)
        areas = self._area[: self._count].sum(), self._area[self._count :].sum()
        self._touching_area = SAMPLES.touching_share * float(min(areas))
        start = self._positions([obstacle.posed_at(0.0).pose for obstacle in obstacles.values()])
        self._pairs = self._build_pairs(penalty)
        if (gap := self._pairs.min_gap(start)) < penalty.width:
            self._pairs = self._build_pairs(Penalty(penalty.stiffness, MESH.gap_share * gap))

    @property
    def _numbers(self) -> Numbers:
        return self._first, self._second

    def _build_pairs(self, penalty: Penalty) -> PenaltyPairs:
        """Pairs with a penalty, of which each side has one half."""
        patches = np.repeat(np.array([0, 1], np.int32), [self._count, len(self._reference) - self._count])
        stiffness = ContactStiffness.of_one_body(0.5 * penalty.rate * self._area)
        return PenaltyPairs(self._reference, self._elements, stiffness, distance=penalty.width, patch=patches)

    def set_penalties(self, penalty: PenaltyLimit) -> None:
        """Set the penalty by the numbers of both obstacles and the area that may touch at once, m^2."""
        rate, width = penalty(self._numbers, self._touching_area).rate, self._pairs.width
        self._pairs = self._build_pairs(Penalty(rate * width, width))

    def _positions(self, poses: Sequence[Pose]) -> Values:
        """(n, 3) points of both obstacles at poses, m."""
        return np.concatenate([pose.points_to_space(X) for pose, X in zip(poses, self._points, strict=True)])

    def _near_positions(self, posed: PosedObstacles, max_gap: float) -> Values | None:
        """(n, 3) points of both obstacles, m; None: their bounding boxes are `max_gap`, m, apart."""
        x = self._positions([posed[number].pose for number in self._numbers])
        first, second = x[: self._count], x[self._count :]
        gap = np.maximum(first.min(axis=0) - second.max(axis=0), second.min(axis=0) - first.max(axis=0)).max()
        return x if gap < max_gap else None

    def are_far(self, posed: PosedObstacles) -> bool:
        """Whether the obstacles cannot be in contact."""
        return self._near_positions(posed, self._pairs.width) is None

    def wrenches(self, posed: PosedObstacles) -> dict[int, Values]:
        """(6,) force and moment of each on the other, of both, N and N m; empty where they do not touch."""
        x = self._near_positions(posed, self._pairs.width)
        if x is None or not (gradient := self._pairs.gradient(x)).any():
            return {}
        arms = x - np.repeat(
            [posed[number].pose.centre for number in self._numbers], [self._count, len(x) - self._count], axis=0
        )
        rows = slice(None, self._count), slice(self._count, None)
        return {n: resultant(-gradient[part], arms[part]) for n, part in zip(self._numbers, rows, strict=True)}

    def energies(self, posed: PosedObstacles) -> tuple[float, float]:
        """Energy of the penalty, twice, as there is no friction, J."""
        x = self._near_positions(posed, self._pairs.width)
        energy = 0.0 if x is None else self._pairs.energy(x)
        return energy, energy

    def work(self, posed: PosedObstacles, increments: Mapping[int, Values] | Sequence[Values]) -> tuple[float, float]:
        """Work of a prescribed obstacle on the free one by its own increment (6,) in the step, and 0, J."""
        wrenches = self.wrenches(posed).items()
        return -sum(float(wrench @ increments[n]) for n, wrench in wrenches if n not in self._free), 0.0

    def near_springs(self, posed: PosedObstacles, max_gap: float) -> Iterator[tuple[Numbers, Values, Values]]:
        """Numbers, positions (k, 3), m, and stiffness (k,), N/m, of contacts at gaps below `max_gap`, m, or less."""
        if (x := self._near_positions(posed, max_gap)) is None:
            return
        near = self._pairs.near_contacts(x)
        if len(near.gap):
            yield self._numbers, near.positions(x, np.arange(len(x)) < self._count), near.stiffness

    def accept_step(self, posed: PosedObstacles) -> None:
        """Store contacts at the end of a step."""
        if (x := self._near_positions(posed, PAIR_PENALTY.near_gap * self._pairs.width)) is not None:
            self._pairs.end_step(x)

    # --- state ---

    @property
    def history(self) -> PenaltyHistory:
        """Contacts at the end of the last step."""
        return self._pairs.history

    def set_history(self, history: PenaltyHistory) -> None:
        """Set the contacts at the end of the last step."""
        self._pairs.set_history(history)
