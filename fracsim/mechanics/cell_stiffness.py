"""Stiffness of single cells, made positive: what a few nodes are solved for with.

    K_ab = V g_a . |A| . g_b,   A = d(chi P)/dF,   |A|: with the absolute values of its eigenvalues

g_a is the gradient of the shape function of corner a. A direction in which a cell is unstable is gone along as far as
its curvature says, instead of without end (Chen et al. 2024, Stabler neo-Hookean simulation).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from .positive import least_pivots, moduli
from .stress import Stress

Values = npt.NDArray[np.float64]


class CellStiffness:
    """That of a `Stress` with linear displacement."""

    def __init__(self, stress: Stress) -> None:
        """Compiles (collective)."""
        domain = stress.domain
        self._moduli, self._volumes, d = moduli(stress), domain.volumes, domain.dim
        corners = domain.nodes[domain.cell_nodes]
        inverse = np.linalg.inv(corners[:, 1:] - corners[:, :1])
        self._gradients = np.empty((len(corners), d + 1, d))
        self._gradients[:, 1:] = inverse.transpose(0, 2, 1)
        self._gradients[:, 0] = -self._gradients[:, 1:].sum(axis=1)

    def __call__(self, cells: npt.NDArray[np.int32]) -> Values:
        """(k, d + 1, d + 1, d, d) blocks K_ab of owned cells at the current u, N/m (not collective)."""
        g, d = self._gradients[cells], self._gradients.shape[2]
        A = self._moduli.at_points(cells).reshape(-1, d * d, d * d)
        points = np.flatnonzero(least_pivots(A) < 0)
        values, vectors = np.linalg.eigh(A[points])
        A[points] = (vectors * np.abs(values)[:, None, :]) @ vectors.transpose(0, 2, 1)
        A *= self._volumes[cells, None, None]
        blocks = np.einsum("kaj,kijlm,kbm->kabil", g, A.reshape(-1, d, d, d, d), g, optimize=True)
        return np.asarray(blocks)
