"""Rigid poses: where a body is and how it is turned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

Values = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Pose:
    """x = c + R X: `centre` c (d,) in m, `rotation` R (d, d), X in the frame of the body.

    An increment is q = (t, w), (3,) in 2D and (6,) in 3D: c moves by t (m) and the body turns about c by the angle or
    rotation vector w (rad, axes of space): x = c + t + exp(w) R X.
    """

    centre: Values
    rotation: Values

    @classmethod
    def at(cls, centre: Values) -> Pose:
        """Not turned."""
        return cls(np.asarray(centre, float), np.eye(len(centre)))

    @property
    def dim(self) -> int:
        """2 or 3."""
        return len(self.centre)

    def to_body(self, x: Values) -> Values:
        """(n, d) X = R^T (x - c) of points x (n, d)."""
        return np.asarray((x - self.centre) @ self.rotation)

    def points_to_space(self, X: Values) -> Values:
        """(n, d) x = c + R X."""
        return np.asarray(self.centre + X @ self.rotation.T)

    def vectors_to_space(self, v: Values) -> Values:
        """(n, d) R v."""
        return np.asarray(v @ self.rotation.T)

    def tensors_to_space(self, A: Values) -> Values:
        """(n, d, d) R A R^T."""
        return np.asarray(self.rotation @ A @ self.rotation.T)

    def turned(self) -> Values:
        """(1,) or (3,) angle or rotation vector of R, rad, at most half a turn."""
        if self.dim == 3:
            return np.asarray(Rotation.from_matrix(self.rotation).as_rotvec())
        return np.arctan2(self.rotation[1:, 0], self.rotation[:1, 0])

    def moved(self, q: Values) -> Pose:
        """The pose after an increment q = (t, w); the rotation stays one to round-off however often this is done."""
        t, w = q[: self.dim], q[self.dim :]
        if self.dim == 3:
            turned = Rotation.from_rotvec(w) * Rotation.from_matrix(self.rotation)
            return Pose(self.centre + t, turned.as_matrix())
        angle = np.arctan2(self.rotation[1, 0], self.rotation[0, 0]) + w[0]
        cos, sin = np.cos(angle), np.sin(angle)
        return Pose(self.centre + t, np.array([[cos, -sin], [sin, cos]]))

    def way_to(self, other: Pose) -> Values:
        """(p,) the increment that leads from here to another pose, with a turn of half a turn at most."""
        w = Pose(other.centre, other.rotation @ self.rotation.T).turned()
        return np.concatenate([other.centre - self.centre, w])


def turned(y: Values, w: Values) -> Values:
    """(n, d) exp(w) y of vectors y (n, d), each turned by its own angle w (n, 1) or rotation vector w (n, 3), rad."""
    if y.shape[1] == 3:
        return np.asarray(Rotation.from_rotvec(w).apply(y)) if len(y) else y
    cos, sin = np.cos(w[:, 0]), np.sin(w[:, 0])
    return np.stack([cos * y[:, 0] - sin * y[:, 1], sin * y[:, 0] + cos * y[:, 1]], axis=1)


def turning(y: Values) -> Values:
    """(n, d, p) G(y): a body that turns by w sees the fixed points y (n, d) move by G(y) w = -w x y; p = 1 or 3."""
    if y.shape[1] == 2:
        return np.stack([y[:, 1], -y[:, 0]], axis=1)[:, :, None]
    zero = np.zeros(len(y))
    a, b, c = y.T
    rows = [[zero, -c, b], [c, zero, -a], [-b, a, zero]]
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)
