"""A step of a trust region, of several problems at once: conjugate gradients that go to the border of where the model
is trusted once they leave it, or once it has no minimum in there (Steihaug, SIAM J. Numer. Anal. 20, 1983).

    min  g z + z K z / 2   over   |z| <= radius
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.sparse import sparray

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

RTOL, MOST = 1e-2, 200  # of the conjugate gradients


def trusted_step(K: sparray, inverse: Values, g: Values, of: Ints, radius: Values) -> tuple[Values, Values]:
    """Steps z (n, d) of problems that share no entry of K, and by how much each lowers its model (p,).

    `inverse`: (n, d, d) blocks to precondition with; `g`: (n, d); `of`: (n,) the problem of each node; `radius`: (p,).
    """

    def sums(values: Values) -> Values:
        return of_each(of, values.sum(axis=1), len(radius))

    z, r = np.zeros_like(g), g.copy()
    y = np.einsum("nij,nj->ni", inverse, r)
    p, size = -y, sums(r * y)
    enough, going = RTOL**2 * size, size > 0
    for _ in range(MOST):
        if not going.any():
            break
        q = (K @ p.reshape(-1)).reshape(p.shape)
        curved, long, along = sums(p * q), sums(p * p), sums(z * p)
        border = np.sqrt(along**2 + long * np.maximum(radius**2 - sums(z * z), 0.0)) - along
        border = np.divide(border, long, out=np.zeros_like(long), where=long > 0)
        share = np.divide(size, curved, out=border.copy(), where=going & (curved > 0))
        out = share >= border
        share = np.where(going, np.minimum(share, border), 0.0)[of, None]
        z, r = z + share * p, r + share * q
        y = np.einsum("nij,nj->ni", inverse, r)
        before, size = size, sums(r * y)
        going &= ~out & (size > enough)
        turned = np.divide(size, before, out=np.zeros_like(size), where=going)
        p = np.where(going[of, None], turned[of, None] * p - y, 0.0)
    return z, -0.5 * sums((g + r) * z)


def of_each(of: Ints, values: Values, count: int) -> Values:
    """(count,) sums of values (n,), each `of` (n,) a problem."""
    return np.asarray(np.bincount(of, values, count), np.float64)
