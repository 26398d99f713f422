"""Positive semi-definite moduli of the stress, by a correction of their negative eigenvalues.

    A = d(chi P)/dF,   A+ = A + C,   C = - k sum of its negative eigenvalues times their projectors

Where a body buckles, fractures or is compressed, A is not positive. Newton's direction may then increase the
incremental potential, and CG stops. With A+ (and mass, and contact) each direction is one of descent, at the price of
more iterations near a solution (Teran et al. 2005, Robust quasistatic finite elements and flesh simulation; here for
any energy, by the eigenvalues of d^2 x d^2 moduli instead of a closed form).

With inertia k = 2: eigenvalues become their absolute values (Chen et al. 2024, Stabler neo-Hookean simulation: absolute
eigenvalue filtering for projected Newton). With zeros in their place, k = 1, a torn body has directions without
stiffness, and CG takes two to four times the iterations. Without inertia k = 1: a body that buckles goes along these
directions, and absolute values would hold it.

Equations: docs/theory.md#newtons-method.
"""

from __future__ import annotations

from ctypes import CDLL
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
import ufl

from ..forms.balance import stress_quadrature
from ..mesh.c_library import FAST_FLAGS, LANES, compile_library
from .jit import CellForm, cell_measure, point_expression, point_field
from .stress import Stress, energy_derivatives

Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.uint8]

SOURCE = Path(__file__).with_suffix(".c")
BLOCK = 1024  # cells at a time: their moduli stay in the processor's cache


class PsdProjection:
    """Correction C of the moduli of a `Stress`.

    Attributes:
        form: int (C : grad v) : grad w dX, compiled, with C of the last `update`.
    """

    def __init__(self, stress: Stress) -> None:
        """Compile the moduli and the form (collective)."""
        domain, d = stress.domain, stress.domain.dim
        self._moduli = point_expression(domain, energy_derivatives(stress)[2], kernels=stress.kernels)
        self._field = point_field(domain, (d * d, d * d), "correction of moduli")
        self._size, self._cells = d * d, domain.cell_count
        self._correct = stress.kernels.psd_correction() or plain_psd_correction
        self._nonzero = np.zeros(len(self._field.x.array) // d**4, np.uint8)
        v, w = ufl.TrialFunction(domain.space), ufl.TestFunction(domain.space)
        components = [(i, j) for i in range(d) for j in range(d)]
        row, column = (ufl.as_vector([ufl.grad(field)[i, j] for i, j in components]) for field in (w, v))
        form = ufl.dot(row, self._field * column) * cell_measure(domain)(metadata=stress_quadrature(w))
        self.form = CellForm(form)

    def update(self, tolerance: float, factor: float) -> None:
        """Update C to the current u (not collective).

        Args:
            tolerance: moduli stay as they are without an eigenvalue below - `tolerance` of their mean, since
                compression alone makes some slightly negative.
            factor: k.
        """
        points, n = self._moduli.points_per_cell, self._size
        C = self._field.x.array.reshape(-1, n, n)
        for first in range(0, self._cells, BLOCK):
            cells = np.arange(first, min(first + BLOCK, self._cells), dtype=np.int32)
            block = slice(points * first, points * (first + len(cells)))
            moduli = self._moduli.evaluate_at_points(cells).reshape(-1, n, n)
            self._correct(moduli, tolerance, factor, C[block], self._nonzero[block])


def plain_psd_correction(A: Values, tolerance: float, factor: float, C: Values, nonzero: Flags) -> None:
    """Put the corrections of matrices A into C by LAPACK; see psd_correction."""
    eigenvalues, vectors = np.linalg.eigh(A)
    corrected = eigenvalues[:, 0] < -tolerance * eigenvalues.mean(axis=1)
    negative = np.where(corrected[:, None], np.minimum(eigenvalues, 0.0), 0.0)
    # A + C = V (L - k min(L, 0)) V^T: eigenvalues below 0 become 0 with k = 1, their absolute values with k = 2.
    C[:] = -factor * (vectors * negative[:, None]) @ vectors.transpose(0, 2, 1)
    nonzero[:] = negative.any(axis=1)


def psd_correction(A: Values, tolerance: float, factor: float, C: Values, nonzero: Flags) -> None:
    """Put the corrections of matrices A into C, in a tenth to a third of the time of one LAPACK call a matrix.

    Args:
        A: (k, n, n) symmetric matrices.
        tolerance: only A with an eigenvalue below - `tolerance` of their mean eigenvalue are corrected.
        factor: k, 1 for zeros in place of negative eigenvalues, 2 for their absolute values.
        C: (k, n, n) corrections, overwritten: zero for all other A.
        nonzero: (k,) flags of C that are not zero, before and after.
    """
    _code(A.shape[1]).positive(len(A), tolerance, factor, A, C, nonzero)


@cache
def _code(size: int) -> CDLL:
    return compile_library(
        "positive", SOURCE.read_text(encoding="utf-8"), [*FAST_FLAGS, f"-DN={size}", f"-DLANES={LANES}"]
    )
