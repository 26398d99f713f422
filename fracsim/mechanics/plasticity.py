"""What cells remember of plastic flow: F_p with det F_p = 1, and the accumulated plastic strain (M22 section 3.7).

With quadratic displacement each point where stress is integrated remembers its own; those of a cell come one after the
other.

What flow takes off the stress while a step is solved, by the study's `update`.

    extrapolated    F_p goes on as it did in the step before: an elastic step's cost (after IMPL-EX: Oliver, Huespe and
                    Cante 2008, who extrapolate the multiplier of the flow)
    implicit        the flow of the step itself (forms.plasticity): exact in steps of any size where loading goes on
    staggered       nothing (M22): no prediction at all

Without any the stress of a yielding bar is too high by 3 mu times the strain of a step.

Equations: docs/theory.md#plasticity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, Protocol

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem

from ..forms.plasticity import ImplicitFlow, Plastic
from ..mesh.domain import Domain
from .jit import point_field, points_per_cell
from .material_fields import MaterialFields, PerCell
from .tensor_functions import multiply_unimodular

Values = npt.NDArray[np.float64]
Points = npt.NDArray[np.int32]
WEIGHTS = np.array([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])  # of squares in the norm of xx, yy, zz, xy, xz, yz
MOST = 0.9  # norm of dt D: with less than 1 no stretch turns over
UNIT = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])[:, None]  # I
WEAKEST = 0.01  # share of the yield stress that softening leaves


class FlowPrediction(Protocol):
    """What is done about the flow of a step before it is known."""

    @property
    def form(self) -> ImplicitFlow | None:
        """Virtual work and tangent; None where the energy of F_e says it all."""

    def begin_step(self, dt: float, fraction: float) -> None:
        """A step of dt is to be solved whose flow makes `fraction` of the return; zeros: it is done."""

    def record_flow(self, points: Points, power: Values, dt: float) -> None:
        """`points` flowed by (6, n) exp(-beta e) in a step of dt, all others did not."""


class ImplicitPlasticFlow:
    """beta follows from the unknown displacement."""

    def __init__(self, domain: Domain, energy: Plastic, frobenius: bool) -> None:
        self._resistance, self._softness = (point_field(domain, (), name) for name in ("resistance", "softness"))
        self._share = fem.Constant(domain.mesh, np.float64(0.0))
        self.form = ImplicitFlow(energy, self._resistance, self._softness, self._share, frobenius)

    def begin_step(self, dt: float, fraction: float) -> None:
        """The share of the return is all that changes with the step."""
        self._share.value = fraction

    def update_flow_stress(self, resistance: Values, softness: Values) -> None:
        """Yield stress Y (Pa) and 1 / (1 + K / (3 mu)) of the points as they are now."""
        self._resistance.x.array[: len(resistance)] = resistance
        self._softness.x.array[: len(softness)] = softness

    def record_flow(self, points: Points, power: Values, dt: float) -> None:
        """Nothing to remember."""


class ExtrapolatedPlasticFlow:
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

    def begin_step(self, dt: float, fraction: float) -> None:
        """Put the stand-in in its place, or F_p^-1 itself back."""
        if self._held is not None and not dt:
            self._inverse[self._points], self._held = self._held.T, None
        if not dt or not len(self._points):
            return
        if self._held is None:
            self._held = np.ascontiguousarray(self._inverse[self._points].T)
        longest = MOST / np.maximum(np.sqrt(WEIGHTS @ self._rate**2), MOST / dt)
        self._inverse[self._points] = multiply_unimodular(self._held, UNIT + longest * self._rate).T

    def record_flow(self, points: Points, power: Values, dt: float) -> None:
        """Remember D of the step, by which the next one is predicted to flow."""
        self._points, self._rate = points, (power - UNIT) / dt

    @property
    def rates(self) -> Values:
        """(points, 6) D, 1/s."""
        rows = np.zeros((len(self._inverse), 6))
        rows[self._points] = self._rate.T
        return rows

    @rates.setter
    def rates(self, rows: Values) -> None:
        self._points = np.flatnonzero(rows.any(axis=1)).astype(np.int32)
        self._rate = np.ascontiguousarray(rows[self._points].T)


@dataclass(frozen=True)
class YieldLaw:
    """When cells flow, and how fast.

    Attributes:
        yield_stress: Pa, of the Cauchy stress, a number or (cells,).
        frobenius: compared with it is the norm of the whole stress; else von Mises'.
        flow_rate: nu, 1/s; inf: independent of the rate.    hardening: K, Pa; < 0 softens.
        update: what a step is solved with (mechanics.plasticity).
    """

    yield_stress: PerCell
    frobenius: bool = False
    flow_rate: float = math.inf
    hardening: float = 0.0
    update: Literal["extrapolated", "implicit", "staggered"] = "extrapolated"


class PlasticHistory:
    """What the cells remember of their flow.

    Attributes:
        inverse: F_p^-1, 3 x 3, at each point; while a step is solved, what `prediction` puts in its place.
        points: of a cell.    volumes: (points,) of this rank, m^d.
        rows: (points, 9) values of `inverse`.
        strain: (points,) accumulated plastic strain alpha.
        prediction: what flow takes off the stress while a step is solved; None where flow only follows it.
        fraction: 1 - exp(-nu dt), the part of the return to the yield surface that a step makes; 0 between steps.
    """

    def __init__(self, domain: Domain, law: YieldLaw, material: MaterialFields, *, implicit: bool = True) -> None:
        """`implicit`: whether u is what a step is solved for; explicit schemes know it beforehand."""
        self.rate, self.hardening, self.frobenius = law.flow_rate, law.hardening, law.frobenius
        self.dt, self.fraction = 0.0, 0.0
        self.points_per_cell = points_per_cell(domain)
        self._yield, self._modulus = self._of_points(law.yield_stress), self._of_points(3 * material.mu)
        self.volumes = (
            np.repeat(domain.volumes / self.points_per_cell, self.points_per_cell)
            if self.points_per_cell > 1
            else domain.volumes
        )
        self.accumulated_strain = np.zeros(self.points_per_cell * domain.cell_count)
        self.inverse = point_field(domain, (3, 3), "inverse plastic part")
        self.inverse_rows: Values = self.inverse.x.array.reshape(-1, 9)[: len(self.accumulated_strain)]
        self.inverse.x.array.reshape(-1, 9)[:] = np.eye(3).reshape(-1)
        self.energy = Plastic(material.energy, _block(self.inverse, domain.dim))
        # where u is known before the stress is asked for nothing need be extrapolated
        known = law.update == "extrapolated" and not implicit
        self.prediction = self._prediction(domain, "implicit" if known else law.update)
        self.update_flow_stress()
        self._memory: Values | None = None

    def _of_points(self, value: PerCell) -> PerCell:
        return np.repeat(value, self.points_per_cell) if isinstance(value, np.ndarray) else value

    def cell_means(self, values: Values) -> Values:
        """(cells,) means of (points,) values."""
        return values if self.points_per_cell == 1 else values.reshape(-1, self.points_per_cell).mean(axis=1)

    def _prediction(self, domain: Domain, update: str) -> FlowPrediction | None:
        if update == "implicit":
            return ImplicitPlasticFlow(domain, self.energy, self.frobenius)
        return ExtrapolatedPlasticFlow(self.inverse_rows) if update == "extrapolated" else None

    def flow_stress(self, strain: Values, points: Points | slice = slice(None)) -> Values:
        """Y = yield_stress + K alpha of points with the given alpha, Pa; never below a small share of yield_stress."""
        start = self._yield[points] if isinstance(self._yield, np.ndarray) else self._yield
        return np.maximum(start + self.hardening * strain, WEAKEST * start)

    def update_flow_stress(self) -> None:
        """What flow within a step has to know of `strain`."""
        if not isinstance(self.prediction, ImplicitPlasticFlow):
            return
        Y = self.flow_stress(self.accumulated_strain)
        soft = (self.hardening < 0) & (WEAKEST * self._yield >= Y)  # as soft as it gets
        self.prediction.update_flow_stress(Y, 1 / (1 + np.where(soft, 0.0, self.hardening / self._modulus)))

    def discard_snapshot(self) -> None:
        """Cells flowed: what `memory` gave is of the past."""
        self._memory = None

    def snapshot(self) -> Values:
        """(points, 10) F_p^-1 and alpha; with six of the last flow between them where it matters."""
        if self._memory is None:
            self.begin_step(0.0)  # a step that failed may have left another in its place
            last = [self.prediction.rates] if isinstance(self.prediction, ExtrapolatedPlasticFlow) else []
            self._memory = np.column_stack([self.inverse_rows, *last, self.accumulated_strain])
        return self._memory

    def restore(self, memory: Values) -> bool:
        """Be as `memory` says, whichever the update was; whether that is anything else than now."""
        self.begin_step(0.0)
        if memory is self._memory:
            return False
        self.inverse_rows[:] = memory[:, :9]
        self.accumulated_strain[:] = memory[:, -1]
        if isinstance(self.prediction, ExtrapolatedPlasticFlow) and memory.shape[1] > 10:
            self.prediction.rates = memory[:, 9:-1]
        self.update_flow_stress()
        self._memory = memory
        return True

    def begin_step(self, dt: float) -> None:
        """A step of dt is to be solved; with 0: it is done."""
        self.dt, self.fraction = dt, -math.expm1(-self.rate * dt) if dt else 0.0
        if self.prediction is not None:
            self.prediction.begin_step(dt, self.fraction)


def _block(inverse: fem.Function, dim: int) -> ufl.core.expr.Expr:
    """F_p^-1; in plane strain with the zeros written out, so that no kernel multiplies by them."""
    if dim == 3:
        return inverse
    return ufl.as_tensor([[inverse[0, 0], inverse[0, 1], 0], [inverse[1, 0], inverse[1, 1], 0], [0, 0, inverse[2, 2]]])


def plastic_material(
    domain: Domain, law: YieldLaw, material: MaterialFields, *, implicit: bool = True
) -> MaterialFields:
    """The material with an energy of the elastic part of F, and with what its cells remember; `implicit`: of the
    scheme."""
    plastic = PlasticHistory(domain, law, material, implicit=implicit)
    return replace(material, energy=plastic.energy, plastic=plastic)
