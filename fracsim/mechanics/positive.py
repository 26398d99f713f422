"""What makes the tangent of the stress positive: the negative eigenvalues of its moduli taken away.

    A = d(chi P)/dF,   A+ = A + C,   C = - sum of its negative eigenvalues times their projectors

Where a body buckles, tears or is squeezed, A is not positive, Newton's direction may go up the incremental potential,
and CG stops. With A+ (and mass, and what touches) it goes down from anywhere, in more iterations near a solution.
(Teran et al. 2005, Robust quasistatic finite elements and flesh simulation; here of any energy, by the eigenvalues of
d^2 x d^2 moduli instead of a closed form.) Built when it is first asked for.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import ufl

from ..forms.balance import points_of_stress
from ..forms.kinematics import deformation_gradient
from .kernels import CellForm, cells_measure, point_expression, point_field
from .stress import Stress

Values = npt.NDArray[np.float64]


class Positive:
    """C of a `Stress`.

    Attributes:
        form: int (C : grad v) : grad w dX, compiled; `update` brings it to the current u.
    """

    def __init__(self, stress: Stress) -> None:
        """Compiles (collective)."""
        domain, d = stress.domain, stress.domain.dim
        F = ufl.variable(deformation_gradient(stress.u))
        P = stress.remaining_stiffness_of_energy * ufl.diff(stress.energy.psi(F, stress.R), F)
        self._moduli = point_expression(domain, ufl.diff(P, F))
        self._field = point_field(domain, (d * d, d * d), "what makes moduli positive")
        self._size = d * d
        v, w = ufl.TrialFunction(domain.space), ufl.TestFunction(domain.space)
        each = [(i, j) for i in range(d) for j in range(d)]
        row, column = (ufl.as_vector([ufl.grad(field)[i, j] for i, j in each]) for field in (w, v))
        form = ufl.dot(row, self._field * column) * cells_measure(domain)(metadata=points_of_stress(w))
        self.form = CellForm(form)

    def update(self, small: float) -> None:
        """Bring C to the current u; moduli stay as they are without an eigenvalue below - `small` of their mean:
        whatever is pressed has such (not collective)."""
        A = self._moduli.at_points().reshape(-1, self._size, self._size)
        mean = A.trace(axis1=1, axis2=2) / self._size
        shifted = A + (small * mean)[:, None, None] * np.eye(self._size)
        points = np.flatnonzero((least_pivots(shifted) < 0) & (mean != 0))
        values, vectors = np.linalg.eigh(A[points])
        C = self._field.x.array.reshape(-1, self._size, self._size)
        C[:] = 0.0
        C[points] = (vectors * -np.minimum(values, 0.0)[:, None, :]) @ vectors.transpose(0, 2, 1)


def least_pivots(A: Values) -> Values:
    """(k,) the least pivot of symmetric matrices (k, n, n): negative where one is not positive (Sylvester's law of
    inertia). A tenth of what their eigenvalues cost."""
    U = A.transpose(1, 2, 0).copy()
    least = U[0, 0].copy()
    with np.errstate(divide="ignore", invalid="ignore"):  # a cell without stiffness
        for k in range(len(U) - 1):
            share = U[k, k + 1 :] / U[k, k]
            for i in range(k + 1, len(U)):
                U[i, i:] -= U[k, i] * share[i - k - 1 :]
            np.fmin(least, U[k + 1, k + 1], out=least)
    return least
