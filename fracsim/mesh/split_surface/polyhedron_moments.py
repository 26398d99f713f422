"""Volume, centre of volume and second moments of bodies with closed polyhedral surfaces, without quadrature error.

Sums over the cones of all elements (corners x_1 ... x_d, apex at the origin), signed by orientation; s = sum x_i:

    V = sum det(x_1 .. x_d) / d!,   int x dV = sum V_e s / (d + 1),
    int x x^T dV = sum V_e (sum_i x_i x_i^T + s s^T) / ((d + 1) (d + 2)).
"""

from __future__ import annotations

from ctypes import c_int64
from dataclasses import dataclass
from math import factorial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ...meshes.topology import determinants
from ..c_library import load_library

SOURCE = Path(__file__).with_suffix(".c")
Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class PolyhedronMoments:
    """Moments of n bodies.

    Attributes:
        volume: (n,) m^3 (2D: m^2).
        centre: (n, d) centre of volume, m; of a body without volume the mean of the points.
        second: (n, d, d) int (x - centre) (x - centre)^T dV, m^5 (2D: m^4).
    """

    volume: Values
    centre: Values
    second: Values

    @property
    def inertia(self) -> Values:
        """(n, 3, 3) inertia tensor about the centre for density 1, tr(S) 1 - S; 2D: (n, 1, 1), tr(S); m^5 (2D: m^4)."""
        trace = np.einsum("nii->n", self.second)[:, None, None]
        return trace if self.second.shape[1] == 2 else trace * np.eye(3) - self.second


def cone_volumes(x: Values) -> Values:
    """(m,) signed volumes of the cones from the origin over elements with corners (m, d, d)."""
    return determinants(x.transpose(1, 2, 0)) / factorial(x.shape[2])


def moments(points: Values, elements: Ints, body: Ints, count: int) -> PolyhedronMoments:
    """Moments of `count` bodies with closed surfaces.

    `points`: (n, d), m.    `elements`: (m, d) points of each element.    `body`: (m,) body of each element.
    """
    d = points.shape[1]
    arrays = [np.ascontiguousarray(points), *(np.ascontiguousarray(numbers, np.int64) for numbers in (elements, body))]
    element_count, sizes = np.zeros(count, np.int64), (d, 1, d, d * d)
    # relative to one point of each body, since sums about a distant origin would cancel
    reference_point, volume, first, second = (np.zeros((count, size)) for size in sizes)
    sums = load_library(SOURCE).sums
    sums(*map(c_int64, (len(elements), d, count)), *(*arrays, element_count, reference_point, volume, first, second))
    arm = np.divide(first, (d + 1) * volume, out=np.zeros_like(first), where=volume > 0)
    across = volume[:, :, None] * arm[:, :, None] * arm[:, None, :]
    about = second.reshape(-1, d, d) / ((d + 1) * (d + 2)) - across
    return PolyhedronMoments(volume[:, 0], reference_point + arm, about)
