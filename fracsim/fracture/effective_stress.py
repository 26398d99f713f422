"""Stress and energy density of the undamaged material at the displacement of now: what criteria and damage go by."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import ufl

from ..forms.energies import cauchy_stress
from ..forms.kinematics import deformation_gradient, symmetric_components
from ..mechanics.jit import CellExpression
from ..mechanics.stress import Stress

Values = npt.NDArray[np.float64]


class Undamaged:
    """Cauchy stress in Pa and energy density in J/m^3 of cells.

    Attributes:
        not_finite: cells whose stress was no number when it was looked at (crushed flat), over all times.
    """

    def __init__(self, stress: Stress, *, often: bool = False) -> None:
        """`often`: it is asked for in every step (collective)."""
        energy, F, domain = stress.material.energy, deformation_gradient(stress.u), stress.domain
        tensor = symmetric_components(cauchy_stress(energy, F, stress.rotation_field))
        both = ufl.as_vector([*tensor, energy.psi(F, stress.rotation_field)])  # one kernel: F is worked out once
        kernels = stress.kernels if often else None
        self._evaluate = CellExpression(domain.comm, domain.mesh, both, domain.cell_count, kernels=kernels)
        self.not_finite = 0

    def __call__(self) -> tuple[Values, Values]:
        """(cells, 3 or 6) and (cells,), means over each cell."""
        values = self._evaluate()
        if not np.isfinite(values.sum()):  # a crushed cell: J = 0
            self.not_finite += int(np.count_nonzero(~np.isfinite(values).all(axis=1)))
            _zero_where_none(values)
        return values[:, :-1], values[:, -1]

    def at_points(self, cells: npt.NDArray[np.integer]) -> tuple[Values, Values]:
        """(m, 3 or 6) and (m,) at the points of cells, those of each one after the other."""
        values = self._evaluate.evaluate_at_points(cells.astype(np.int32)).reshape(-1, self._evaluate.width)
        _zero_where_none(values)
        return values[:, :-1], values[:, -1]


def _zero_where_none(values: Values) -> None:
    np.nan_to_num(values, copy=False, nan=0.0, posinf=0.0, neginf=0.0)
