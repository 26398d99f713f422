"""Effective stress: Cauchy stress and energy density of the undamaged material at the present displacement.

Fracture criteria and degradation depend on it (docs/theory.md#edge-criterion).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import ufl

from ..forms.energies import cauchy_stress
from ..forms.kinematics import deformation_gradient, symmetric_components
from ..mechanics.jit import CellExpression
from ..mechanics.stress import Stress

Values = npt.NDArray[np.float64]


class UndamagedStress:
    """Cauchy stress (Pa) and energy density (J/m^3) of cells, without damage.

    Attributes:
        not_finite: number of evaluations of a cell so crushed (J = 0) that its stress is not finite. It counts as 0.
    """

    def __init__(self, stress: Stress, *, every_step: bool = False) -> None:
        """Compile the expression (collective); `every_step`: it is evaluated in every step."""
        energy, F, domain = stress.material.energy, deformation_gradient(stress.u), stress.domain
        tensor = symmetric_components(cauchy_stress(energy, F, stress.rotation_field))
        # Stress and energy density share one kernel, so that F is evaluated once.
        combined = ufl.as_vector([*tensor, energy.psi(F, stress.rotation_field)])
        kernels = stress.kernels if every_step else None
        self._evaluate = CellExpression(domain.comm, domain.mesh, combined, domain.cell_count, kernels=kernels)
        self.not_finite = 0

    def __call__(self) -> tuple[Values, Values]:
        """Return the means over cells of the stress (cells, 3 or 6) and of the energy density (cells,)."""
        values = self._evaluate()
        # One sum finds out whether any value is not finite, which is rare.
        if not np.isfinite(values.sum()):
            self.not_finite += int(np.count_nonzero(~np.isfinite(values).all(axis=1)))
            _set_not_finite_to_zero(values)
        return values[:, :-1], values[:, -1]

    def evaluate_at_points(self, cells: npt.NDArray[np.integer]) -> tuple[Values, Values]:
        """Return stress (m, 3 or 6) and energy density (m,) at the quadrature points of cells, cell by cell."""
        values = self._evaluate.evaluate_at_points(cells.astype(np.int32)).reshape(-1, self._evaluate.width)
        _set_not_finite_to_zero(values)
        return values[:, :-1], values[:, -1]


def _set_not_finite_to_zero(values: Values) -> None:
    """Replace NaN and infinite entries by 0, in place."""
    np.nan_to_num(values, copy=False, nan=0.0, posinf=0.0, neginf=0.0)
