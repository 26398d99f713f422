"""Whether a body may be near any solid at all: boxes around its nodes on all ranks, and around solids on their ways."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ....mesh.domain import Domain
from ..obstacle import Obstacle
from ..pose import Pose

Values = npt.NDArray[np.float64]

ARMS = 2.0  # longest edges at rest: how far points of walls may be from the nodes that they follow


class Beside:
    """Boxes; nothing is gathered."""

    def __init__(self, domain: Domain, obstacles: Sequence[Obstacle], distance: float) -> None:
        """`distance`: of the barrier, m (collective)."""
        corners = domain.nodes[domain.cell_nodes]
        longest = float(np.ptp(corners, axis=1).max(initial=0.0)) * np.sqrt(domain.dim)
        self._reach = distance + ARMS * float(domain.comm.allreduce(longest, op=MPI.MAX))
        self._comm, self._X = domain.comm, domain.nodes[: domain.node_count]
        self._own = [_Extent(each.shape.outline()[0]) for each in obstacles]

    def is_far(self, bodies: Sequence[Values], ways: Sequence[tuple[Pose, Pose]]) -> bool:
        """Whether nothing of a body with the owned displacements `bodies`, or between them, can be within the barrier
        of a solid between the two poses of its way (collective)."""
        low, high = np.full(3, np.inf), np.full(3, -np.inf)
        for u in bodies:
            x = self._X + u.reshape(-1, 3)
            low, high = np.minimum(low, x.min(axis=0, initial=np.inf)), np.maximum(high, x.max(axis=0, initial=-np.inf))
        ends = np.concatenate([low, -high])
        self._comm.Allreduce(MPI.IN_PLACE, ends, MPI.MIN)
        low, high = ends[:3] - self._reach, -ends[3:] + self._reach
        return not any(
            np.all(low < above) and np.all(high > below)
            for below, above in (own.along(*way) for own, way in zip(self._own, ways, strict=True))
        )


class _Extent:
    """Of a solid's points (m, 3) in its own frame, m."""

    def __init__(self, points: Values) -> None:
        self._low, self._high = points.min(axis=0), points.max(axis=0)
        self._reach = float(np.linalg.norm(points, axis=1).max())

    def along(self, start: Pose, end: Pose) -> tuple[Values, Values]:
        """(3,) corners of a box around it on its way, m; of one that is turned around a ball about its reference."""
        turned = not all(np.array_equal(each.rotation, np.eye(3)) for each in (start, end))
        low, high = (-self._reach, self._reach) if turned else (self._low, self._high)
        return np.minimum(start.centre, end.centre) + low, np.maximum(start.centre, end.centre) + high
