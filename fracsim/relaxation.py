"""What flow takes off the stress while a step is solved, by the study's `update`.

implicit        the flow of the step itself: exact in steps of any size where loading goes on
extrapolated    the flow of the step before, once more: an elastic step's cost (IMPL-EX)
staggered       nothing (M22): no relaxation at all
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from .domain import Domain
from .forms import plasticity as forms

Values = npt.NDArray[np.float64]
Cells = npt.NDArray[np.int32]

MOST = 1 - 1e-6  # of a deviator that flow takes off in one step, as far as it is remembered


class Relaxation(Protocol):
    """The part beta of the deviator that flow takes off in a step."""

    form: Any  # of forms.plasticity: virtual work and tangent

    def begin(self, dt: float, fraction: float) -> None:
        """A step of dt is to be solved whose flow makes `fraction` of the return; zeros: it is done."""

    def refresh(self, resistance: Values, softness: Values) -> None:
        """Yield stress Y (Pa) and 1 / (1 + K / (3 mu)) of the cells as they are now."""

    def flowed(self, cells: Cells, beta: Values, dt: float) -> None:
        """`cells` have given up beta of their deviator in a step of dt, all others nothing."""

    def undo(self) -> None:
        """Take `flowed` back."""


class Implicit:
    """beta follows from the unknown displacement."""

    def __init__(self, domain: Domain, energy: forms.Plastic, frobenius: bool) -> None:
        self._resistance, self._softness = fem.Function(domain.cell_scalar), fem.Function(domain.cell_scalar)
        self._share = fem.Constant(domain.mesh, np.float64(0.0))
        self.form = forms.Implicit(energy, self._resistance, self._softness, self._share, frobenius)

    def begin(self, dt: float, fraction: float) -> None:
        """The share of the return is all that changes with the step."""
        self._share.value = fraction

    def refresh(self, resistance: Values, softness: Values) -> None:
        """Fields of the form."""
        self._resistance.x.array[: len(resistance)] = resistance
        self._softness.x.array[: len(softness)] = softness

    def flowed(self, cells: Cells, beta: Values, dt: float) -> None:
        """Nothing to remember."""

    def undo(self) -> None:
        """Nothing to forget."""


class Extrapolated:
    """beta = x / (1 + x), x = pace dt: without flow a deviator that yields would grow by the factor 1 + x in a step.

    Attributes:
        pace: (cells,) growth that flow made good in the last step, 1/s; 0 where nothing flowed.
    """

    def __init__(self, domain: Domain, energy: forms.Plastic) -> None:
        self.pace, self._before = np.zeros(domain.cell_count), np.zeros(domain.cell_count)
        self._beta = fem.Function(domain.cell_scalar)
        self.form = forms.Extrapolated(energy, self._beta)

    def begin(self, dt: float, fraction: float) -> None:
        """Steps of another size go on at the same pace."""
        growth = self.pace * dt
        self._beta.x.array[: len(growth)] = growth / (1 + growth)

    def refresh(self, resistance: Values, softness: Values) -> None:
        """Neither counts before the step is solved."""

    def flowed(self, cells: Cells, beta: Values, dt: float) -> None:
        """The pace of the step."""
        self.pace, self._before = self._before, self.pace
        self.pace[:] = 0.0
        beta = np.minimum(beta, MOST)
        self.pace[cells] = beta / (1 - beta) / dt

    def undo(self) -> None:
        """The pace of the step before."""
        self.pace, self._before = self._before, self.pace
