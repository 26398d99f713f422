"""What flow takes off the stress while a step is solved, by the study's `update`.

    extrapolated    F_p goes on as it did in the step before: an elastic step's cost (after IMPL-EX: Oliver, Huespe and
                    Cante 2008, who extrapolate the multiplier of the flow)
    implicit        the flow of the step itself (forms.plasticity): exact in steps of any size where loading goes on
    staggered       nothing (M22): no prediction at all

Without any the stress of a yielding bar is too high by 3 mu times the strain of a step.

Equations: docs/theory.md#plasticity.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from ..forms.plasticity import ImplicitFlow, Plastic
from ..mesh.domain import Domain
from .kernels import point_field
from .spectrum import times

Values = npt.NDArray[np.float64]
Points = npt.NDArray[np.int32]

WEIGHTS = np.array([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])  # of squares in the norm of xx, yy, zz, xy, xz, yz
MOST = 0.9  # norm of dt D: with less than 1 no stretch turns over
UNIT = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])[:, None]  # I


class FlowPrediction(Protocol):
    """What is done about the flow of a step before it is known."""

    @property
    def form(self) -> ImplicitFlow | None:
        """Virtual work and tangent; None where the energy of F_e says it all."""

    def begin(self, dt: float, fraction: float) -> None:
        """A step of dt is to be solved whose flow makes `fraction` of the return; zeros: it is done."""

    def flowed(self, points: Points, power: Values, dt: float) -> None:
        """`points` flowed by (6, n) exp(-beta e) in a step of dt, all others did not."""


class Implicit:
    """beta follows from the unknown displacement."""

    def __init__(self, domain: Domain, energy: Plastic, frobenius: bool) -> None:
        self._resistance, self._softness = (point_field(domain, (), name) for name in ("resistance", "softness"))
        self._share = fem.Constant(domain.mesh, np.float64(0.0))
        self.form = ImplicitFlow(energy, self._resistance, self._softness, self._share, frobenius)

    def begin(self, dt: float, fraction: float) -> None:
        """The share of the return is all that changes with the step."""
        self._share.value = fraction

    def refresh(self, resistance: Values, softness: Values) -> None:
        """Yield stress Y (Pa) and 1 / (1 + K / (3 mu)) of the points as they are now."""
        self._resistance.x.array[: len(resistance)] = resistance
        self._softness.x.array[: len(softness)] = softness

    def flowed(self, points: Points, power: Values, dt: float) -> None:
        """Nothing to remember."""


class Extrapolated:
    """F_p^-1 (I + dt D) stands in for F_p^-1 while a step is solved, D = (exp(-beta e) - I) / dt of the last step.

    The tangent is that of an elastic body. Steps of another size go on at the same rate.
    """

    form = None

    def __init__(self, inverse: Values) -> None:
        """`inverse`: (points, 9) F_p^-1, which this changes for the time of a solve."""
        self._inverse = inverse
        self._points: Points = np.empty(0, np.int32)
        self._rate: Values = np.empty((6, 0))
        self._held: Values | None = None  # (9, n) F_p^-1 of the points, while another stands in for it

    def begin(self, dt: float, fraction: float) -> None:
        """Put the stand-in in its place, or F_p^-1 itself back."""
        if self._held is not None and not dt:
            self._inverse[self._points], self._held = self._held.T, None
        if not dt or not len(self._points):
            return
        if self._held is None:
            self._held = np.ascontiguousarray(self._inverse[self._points].T)
        longest = MOST / np.maximum(np.sqrt(WEIGHTS @ self._rate**2), MOST / dt)
        self._inverse[self._points] = times(self._held, UNIT + longest * self._rate).T

    def flowed(self, points: Points, power: Values, dt: float) -> None:
        """Remember D of the step, by which the next one is predicted to flow."""
        self._points, self._rate = points, (power - UNIT) / dt

    @property
    def memory(self) -> Values:
        """(points, 6) D, 1/s."""
        rows = np.zeros((len(self._inverse), 6))
        rows[self._points] = self._rate.T
        return rows

    @memory.setter
    def memory(self, rows: Values) -> None:
        self._points = np.flatnonzero(rows.any(axis=1)).astype(np.int32)
        self._rate = np.ascontiguousarray(rows[self._points].T)
