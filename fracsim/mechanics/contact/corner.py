"""Signed distance to the corner q <= 0 of k-dimensional space: what boxes and cylinders are made of."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[np.float64]


class Corner:
    """f(q) = |max(q, 0)| outside, max_i q_i inside, for points q (n, k); its gradient and Hessian.

    Offset by the rounding, f - r is exact inside the rounded body as well: a convex body grown by r is nowhere thicker.
    """

    def __init__(self, q: Values) -> None:
        self._q, self._out = q, np.maximum(q, 0)
        self._length = np.linalg.norm(self._out, axis=1)
        # too close to the corner to divide by the length: as if inside
        self._inside = self._length < np.finfo(float).tiny

    @cached_property
    def value(self) -> Values:
        """(n,) f, m."""
        return np.where(self._inside, self._q.max(axis=1), self._length)

    @cached_property
    def slope(self) -> Values:
        """(n, k) gradient of f, of length 1; inside that of the nearest face."""
        nearest = np.eye(self._q.shape[1])[self._q.argmax(axis=1)]
        return np.where(self._inside[:, None], nearest, self._out / self._divisor[:, None])

    @cached_property
    def curvature(self) -> Values:
        """(n, k, k) Hessian of f: (diag(q >= 0) - n n^T) / f outside, 0 inside, 1/m.

        q = 0 counts as outside: where a core has no thickness, q is never negative and 0 on its middle plane.
        """
        n, active = self.slope, (self._q >= 0).astype(float)
        tangent = active[:, :, None] * np.eye(n.shape[1]) - n[:, :, None] * n[:, None, :]
        return np.where(self._inside[:, None, None], 0.0, tangent / self._divisor[:, None, None])

    @cached_property
    def _divisor(self) -> Values:
        return np.where(self._inside, 1.0, self._length)
