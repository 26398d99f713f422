"""Volume, centre and second moments of what closed surfaces enclose: exact for the polyhedra that pieces are.

With the cones of all elements (corners x_1 ... x_d, apex at the origin), signed by the side that they face, and
s = sum x_i,

    V = sum det(x_1 .. x_d) / d!,   int x dV = sum V_e s / (d + 1),
    int x x^T dV = sum V_e (sum_i x_i x_i^T + s s^T) / ((d + 1) (d + 2)).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Moments:
    """Of n bodies.

    Attributes:
        volume: (n,) m^3 (2D: m^2).    centre: (n, d) of volume, m; that of the points where there is no volume.
        second: (n, d, d) int (x - centre) (x - centre)^T dV, m^5 (2D: m^4).
    """

    volume: Values
    centre: Values
    second: Values

    @property
    def inertia(self) -> Values:
        """(n, 3, 3) tensor of inertia about the centre per density, tr S 1 - S; 2D: (n, 1, 1), tr S."""
        trace = np.einsum("nii->n", self.second)[:, None, None]
        return trace if self.second.shape[1] == 2 else trace * np.eye(3) - self.second


def cones(x: Values) -> Values:
    """(m,) signed volumes of the cones from the origin over elements with corners (m, d, d)."""
    if x.shape[2] == 2:
        return np.asarray(x[:, 0, 0] * x[:, 1, 1] - x[:, 0, 1] * x[:, 1, 0]) / 2
    return np.asarray(np.einsum("ni,ni->n", x[:, 0], np.cross(x[:, 1], x[:, 2]))) / 6


def moments(points: Values, elements: Ints, body: Ints, count: int) -> Moments:
    """Moments of `count` bodies from the points (n, d) of their closed surfaces and the elements (m, d), each of the
    body that `body` (m,) says."""
    d = points.shape[1]
    corners = points[elements]
    many = np.maximum(np.bincount(body, minlength=count), 1)
    near = _sums(body, corners.mean(axis=1), count) / many[:, None]  # each body about a point of its own: less cancels
    x = corners - near[body, None]
    cone, middle = cones(x), x.sum(axis=1)
    volume = _sums(body, cone[:, None], count)[:, 0]
    first = _sums(body, cone[:, None] * middle, count) / (d + 1)
    both = np.einsum("mki,mkj->mij", x, x) + np.einsum("mi,mj->mij", middle, middle)
    second = _sums(body, (cone[:, None, None] * both).reshape(len(cone), -1), count) / ((d + 1) * (d + 2))
    arm = np.divide(first, volume[:, None], out=np.zeros_like(first), where=volume[:, None] > 0)
    about = second.reshape(-1, d, d) - np.einsum("n,ni,nj->nij", volume, arm, arm)
    return Moments(volume, near + arm, about)


def _sums(body: Ints, values: Values, count: int) -> Values:
    return np.stack([np.bincount(body, each, count).astype(float) for each in values.T], axis=1)
