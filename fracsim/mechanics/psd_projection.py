"""What makes the tangent of the stress positive: the negative eigenvalues of its moduli taken away.

    A = d(chi P)/dF,   A+ = A + C,   C = - sum of its negative eigenvalues times their projectors

Where a body buckles, tears or is squeezed, A is not positive, Newton's direction may go up the incremental potential,
and CG stops. With A+ (and mass, and what touches) it goes down from anywhere, in more iterations near a solution.
(Teran et al. 2005, Robust quasistatic finite elements and flesh simulation; here of any energy, by the eigenvalues of
d^2 x d^2 moduli instead of a closed form.) Built when it is first asked for.

Equations: docs/theory.md#newtons-method.
"""

from __future__ import annotations

from ctypes import CDLL, c_double, c_int64
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
import ufl

from ..forms.balance import points_of_stress
from ..forms.kinematics import deformation_gradient
from ..mesh.c_library import FAST_FLAGS, at, compile_library
from .jit import CellForm, cell_measure, point_expression, point_field
from .stress import Stress

Values = npt.NDArray[np.float64]

SOURCE = Path(__file__).with_suffix(".c")
LANES = 4
BLOCK = 1024  # cells at a time: their moduli stay in the cache


class PsdProjection:
    """C of a `Stress`.

    Attributes:
        form: int (C : grad v) : grad w dX, compiled; `update` brings it to the current u.
    """

    def __init__(self, stress: Stress) -> None:
        """Compiles (collective)."""
        domain, d = stress.domain, stress.domain.dim
        F = ufl.variable(deformation_gradient(stress.u))
        P = stress.energy_factor * ufl.diff(stress.energy.psi(F, stress.rotation_field), F)
        self._moduli = point_expression(domain, ufl.diff(P, F), every_step=True)
        self._field = point_field(domain, (d * d, d * d), "what makes moduli positive")
        self._size, self._cells = d * d, domain.cell_count
        self._filled = np.zeros(len(self._field.x.array) // d**4, np.uint8)
        v, w = ufl.TrialFunction(domain.space), ufl.TestFunction(domain.space)
        each = [(i, j) for i in range(d) for j in range(d)]
        row, column = (ufl.as_vector([ufl.grad(field)[i, j] for i, j in each]) for field in (w, v))
        form = ufl.dot(row, self._field * column) * cell_measure(domain)(metadata=points_of_stress(w))
        self.form = CellForm(form)

    def update(self, small: float) -> None:
        """Bring C to the current u; moduli stay as they are without an eigenvalue below - `small` of their mean:
        whatever is pressed has such (not collective)."""
        points, n = self._moduli.points_per_cell, self._size
        C = self._field.x.array.reshape(-1, n, n)
        for first in range(0, self._cells, BLOCK):
            cells = np.arange(first, min(first + BLOCK, self._cells), dtype=np.int32)
            of = slice(points * first, points * (first + len(cells)))
            psd_correction(self._moduli.evaluate_at_points(cells).reshape(-1, n, n), small, C[of], self._filled[of])


def psd_correction(A: Values, small: float, C: Values, filled: npt.NDArray[np.uint8]) -> None:
    """Make C what makes symmetric matrices A (k, n, n) positive, where one has an eigenvalue below - small of their
    mean, and zero where none has; `filled`: (k,) which of C are not zero. (A tenth to a third of the time of LAPACK, a
    matrix a call.)
    """
    _code(A.shape[1]).positive(c_int64(len(A)), c_double(small), at(A), at(C), at(filled))


@cache
def _code(size: int) -> CDLL:
    return compile_library("positive", SOURCE.read_text(), [*FAST_FLAGS, f"-DN={size}", f"-DLANES={LANES}"])
