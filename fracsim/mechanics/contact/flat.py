"""What the deepest place of a facet would be before an obstacle that is flat: the least of its corners' gaps, softened.

    G'(g) = min over shares l of   sum_c l_c g_c + mu/2 |l - 1/c|^2,      l_c >= 0,  sum l_c = 1

As `deepest`, with distances that are linear between the corners: there G = G' with all derivatives, and before a convex
obstacle G <= G'.

    dG'/dg_c = l_c,      d2G'/dg2 = - (1 - 1 1^T / n) / mu   over the n shares above 0
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from .deepest import most_above
from .shares import least_over_shares

Values = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class IfFlat:
    """Of facets whose corners have `gaps` (k, c), m; `soften`: mu, m."""

    gaps: Values
    soften: float

    @cached_property
    def share(self) -> Values:
        """(k, c) l."""
        k, c = self.gaps.shape
        return least_over_shares(np.tile(self.soften * np.eye(c), (k, 1, 1)), self.gaps, np.full((k, c), 1 / c))

    @property
    def gap(self) -> Values:
        """(k,) G' less the most that it can be above the least, m."""
        c = self.gaps.shape[1]
        off = self.share - 1 / c
        above = self.soften / 2 * np.einsum("kc,kc->k", off, off) - most_above(c, self.soften)
        return np.asarray(np.einsum("kc,kc->k", self.share, self.gaps) + above)

    def curvature(self) -> Values:
        """(k, c, c) d2G'/dg2, 1/m."""
        free = self.share > 0
        both = free[:, :, None] & free[:, None, :]
        count = free.sum(axis=1)[:, None, None]
        return np.asarray(np.where(both, 1 / count - np.eye(self.gaps.shape[1]), 0.0) / self.soften)
