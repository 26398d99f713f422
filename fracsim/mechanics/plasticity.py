"""History of plastic flow: F_p with det F_p = 1, and the accumulated plastic strain (M22 section 3.7).

With quadratic displacement each point where stress is integrated has its own; those of a cell come one after the other.
The key `update` of a study selects how flow enters the stress while a step is solved:

    extrapolated    F_p changes at the rate of the last step, at the cost of an elastic step (after IMPL-EX: Oliver,
                    Huespe and Cante 2008, who extrapolate the plastic multiplier)
    implicit        the flow of the step itself (forms.plasticity): exact in steps of any size under monotonic loading
    staggered       no flow (M22)

Without any flow the stress of a yielding bar is too high by 3 mu times the strain of a step.

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

from ..forms.plasticity import ElastoplasticEnergy, ImplicitFlow
from ..mesh.domain import Domain
from .jit import point_field, points_per_cell
from .material_fields import MaterialFields, PerCell
from .tensor_functions import multiply_unimodular

Values = npt.NDArray[np.float64]
Points = npt.NDArray[np.int32]
Flags = npt.NDArray[np.bool_]

# weights of xx, yy, zz, xy, xz, yz in the squared norm of a symmetric tensor, and the unit tensor
NORM_WEIGHTS = np.array([1.0, 1.0, 1.0, 2.0, 2.0, 2.0])
IDENTITY = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])[:, None]


@dataclass(frozen=True)
class PlasticityLimits:
    """Bounds on plastic flow.

    Attributes:
        extrapolation: largest norm of dt D in an extrapolated step; below 1 no stretch changes its sign.
        softened_share: least share of the initial yield stress that softening leaves.
    """

    extrapolation: float = 0.9
    softened_share: float = 0.01


LIMITS = PlasticityLimits()


class FlowPrediction(Protocol):
    """Prediction of the flow of a step while the step is solved."""

    @property
    def form(self) -> ImplicitFlow | None:
        """Virtual work and tangent with flow; None if the energy of F_e is sufficient."""

    def begin_step(self, dt: float, fraction: float) -> None:
        """Begin a step of dt (s) whose flow makes `fraction` of the return to the yield surface; zeros: end it."""

    def record_flow(self, points: Points, power: Values, dt: float) -> None:
        """Record the flow of a step of dt (s): (6, n) exp(-beta e) of `points`; no other points flowed."""


class ImplicitPlasticFlow:
    """Flow that follows from the unknown displacement of the step."""

    def __init__(self, domain: Domain, energy: ElastoplasticEnergy, frobenius: bool) -> None:
        self._flow_stress, self._compliance = (point_field(domain, (), name) for name in ("resistance", "softness"))
        self._fraction = fem.Constant(domain.mesh, np.float64(0.0))
        self.form = ImplicitFlow(energy, self._flow_stress, self._compliance, self._fraction, frobenius)

    def begin_step(self, dt: float, fraction: float) -> None:
        """Set the fraction of the return to the yield surface."""
        self._fraction.value = fraction

    def update_flow_stress(self, flow_stress: Values, compliance: Values) -> None:
        """Set Y (points,), Pa, and 1 / (1 + K / (3 mu)) (points,)."""
        self._flow_stress.x.array[: len(flow_stress)] = flow_stress
        self._compliance.x.array[: len(compliance)] = compliance

    def record_flow(self, points: Points, power: Values, dt: float) -> None:
        """Nothing: the next step does not depend on the flow of this one."""


class ExtrapolatedPlasticFlow:
    """Flow at the rate D = (exp(-beta e) - I) / dt of the last step: F_p^-1 (I + dt D) replaces F_p^-1 in a solve.

    The tangent is that of an elastic body. Steps of another size have the same rate.
    """

    form = None

    def __init__(self, inverse: Values) -> None:
        """`inverse`: (points, 9) F_p^-1, which is replaced for the duration of a solve."""
        self._inverse = inverse
        self.elastic: Flags | None = None  # (points,) points that do not flow; None: all may
        self._points: Points = np.empty(0, np.int32)
        self._rate: Values = np.empty((6, 0))
        self._replaced: Values | None = None  # (9, n) F_p^-1 of the points during a solve

    def begin_step(self, dt: float, fraction: float) -> None:
        """Replace F_p^-1 by its extrapolation over dt (s); with 0 put it back."""
        if self._replaced is not None and not dt:
            self._inverse[self._points], self._replaced = self._replaced.T, None
        if not dt or not len(self._points):
            return
        if self._replaced is None:
            self._replaced = np.ascontiguousarray(self._inverse[self._points].T)
        longest = LIMITS.extrapolation
        duration = longest / np.maximum(np.sqrt(NORM_WEIGHTS @ self._rate**2), longest / dt)
        if self.elastic is not None:
            duration = np.where(self.elastic[self._points], 0.0, duration)
        self._inverse[self._points] = multiply_unimodular(self._replaced, IDENTITY + duration * self._rate).T

    def record_flow(self, points: Points, power: Values, dt: float) -> None:
        """Record D of the step."""
        self._points, self._rate = points, (power - IDENTITY) / dt

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
    """Yield criterion and flow rule.

    Attributes:
        yield_stress: Pa, of the Cauchy stress, a number or (cells,).
        frobenius: whether the norm of the whole stress is compared with it; else that of von Mises.
        flow_rate: nu, 1/s; inf: independent of the rate.
        hardening: K, Pa; negative: softening.
        update: how flow enters the stress while a step is solved (head of this module).
    """

    yield_stress: PerCell
    frobenius: bool = False
    flow_rate: float = math.inf
    hardening: float = 0.0
    update: Literal["extrapolated", "implicit", "staggered"] = "extrapolated"


class PlasticHistory:
    """History variables of plastic flow at all points where stress is integrated.

    Attributes:
        energy: stored energy of the elastic part of F.
        inverse: field of F_p^-1 (3 x 3); replaced by `prediction` while a step is solved.
        points_per_cell: number of points of a cell.
        volumes: (points,) volumes of the points of this rank, m^d.
        inverse_rows: (points, 9) values of `inverse`.
        accumulated_strain: (points,) accumulated plastic strain alpha.
        prediction: flow while a step is solved; None for staggered steps.
        dt: size of the step that is solved, s; 0 between steps.
        elastic: (points,) flags of points that do not flow; None: all may.
        fraction: 1 - exp(-nu dt), the part of the return to the yield surface in a step; 0 between steps.
        rate: nu, 1/s.    hardening: K, Pa.    frobenius: as for YieldLaw.
    """

    def __init__(self, domain: Domain, law: YieldLaw, material: MaterialFields, *, implicit: bool = True) -> None:
        """Body that has not flowed yet.

        Args:
            domain: the mesh.
            law: yield criterion and flow rule.
            material: elastic material.
            implicit: whether steps are solved for u; explicit schemes know u before the stress.
        """
        self.rate, self.hardening, self.frobenius = law.flow_rate, law.hardening, law.frobenius
        self.dt, self.fraction = 0.0, 0.0
        self.elastic: Flags | None = None
        count = self.points_per_cell = points_per_cell(domain)
        self._yield, self._modulus = self._at_points(law.yield_stress), self._at_points(3 * material.mu)
        self.volumes = np.repeat(domain.volumes / count, count) if count > 1 else domain.volumes
        self.accumulated_strain = np.zeros(count * domain.cell_count)
        self.inverse = point_field(domain, (3, 3), "inverse plastic part")
        self.inverse_rows: Values = self.inverse.x.array.reshape(-1, 9)[: len(self.accumulated_strain)]
        self.inverse.x.array.reshape(-1, 9)[:] = np.eye(3).reshape(-1)
        self.energy = ElastoplasticEnergy(material.energy, _block(self.inverse, domain.dim))
        # with u known before the stress nothing needs to be extrapolated
        u_known = law.update == "extrapolated" and not implicit
        self.prediction = self._prediction(domain, "implicit" if u_known else law.update)
        self.update_flow_stress()
        self._snapshot: Values | None = None

    def _at_points(self, value: PerCell) -> PerCell:
        """Parameter of cells at their points."""
        return np.repeat(value, self.points_per_cell) if isinstance(value, np.ndarray) else value

    def cell_means(self, values: Values) -> Values:
        """(cells,) means of (points,) values."""
        return values if self.points_per_cell == 1 else values.reshape(-1, self.points_per_cell).mean(axis=1)

    def _prediction(self, domain: Domain, update: str) -> FlowPrediction | None:
        if update == "implicit":
            return ImplicitPlasticFlow(domain, self.energy, self.frobenius)
        return ExtrapolatedPlasticFlow(self.inverse_rows) if update == "extrapolated" else None

    def flow_stress(self, strain: Values, points: Points | slice = slice(None)) -> Values:
        """Y = yield_stress + K alpha, Pa, of points with strain alpha; never below a share of yield_stress.

        It is infinite where the body is elastic.
        """
        start = self._yield[points] if isinstance(self._yield, np.ndarray) else self._yield
        Y = np.maximum(start + self.hardening * strain, LIMITS.softened_share * start)
        return Y if self.elastic is None else np.where(self.elastic[points], np.inf, Y)

    def set_elastic(self, cells: Flags) -> None:
        """Let the flagged ones of all cells (cells,) of this rank keep their plastic strain, and the others flow."""
        self.elastic = np.repeat(cells, self.points_per_cell)
        if isinstance(self.prediction, ExtrapolatedPlasticFlow):
            self.prediction.elastic = self.elastic
        self.update_flow_stress()

    def flowing_points(self, before: Flags | None) -> Points:
        """Return the points (n,) that may flow and were elastic `before`, (points,) flags; None: all that may flow."""
        flows = np.ones(len(self.accumulated_strain), bool) if self.elastic is None else ~self.elastic
        return np.flatnonzero(flows if before is None else flows & before).astype(np.int32)

    def update_flow_stress(self) -> None:
        """Give the prediction the flow stress of the current strain."""
        if not isinstance(self.prediction, ImplicitPlasticFlow):
            return
        Y = self.flow_stress(self.accumulated_strain)
        fully_softened = (self.hardening < 0) & (LIMITS.softened_share * self._yield >= Y)
        compliance = 1 / (1 + np.where(fully_softened, 0.0, self.hardening / self._modulus))
        self.prediction.update_flow_stress(Y, compliance)

    def discard_snapshot(self) -> None:
        """Discard the last snapshot, since cells flowed."""
        self._snapshot = None

    def snapshot(self) -> Values:
        """(points, 10) F_p^-1 and alpha, or (points, 16) with the rate D between them if flow is extrapolated."""
        if self._snapshot is None:
            self.begin_step(0.0)  # a failed step may have left its extrapolation in place
            rates = [self.prediction.rates] if isinstance(self.prediction, ExtrapolatedPlasticFlow) else []
            self._snapshot = np.column_stack([self.inverse_rows, *rates, self.accumulated_strain])
        return self._snapshot

    def restore(self, snapshot: Values) -> bool:
        """Restore a snapshot of any `update`; returns whether anything changed."""
        self.begin_step(0.0)
        if snapshot is self._snapshot:
            return False
        self.inverse_rows[:] = snapshot[:, :9]
        self.accumulated_strain[:] = snapshot[:, -1]
        if isinstance(self.prediction, ExtrapolatedPlasticFlow) and snapshot.shape[1] > 10:
            self.prediction.rates = snapshot[:, 9:-1]
        self.update_flow_stress()
        self._snapshot = snapshot
        return True

    def begin_step(self, dt: float) -> None:
        """Begin to solve a step of dt (s); with 0 end it."""
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
    """Material with the energy of the elastic part of F and a PlasticHistory; `implicit`: whether the scheme is."""
    plastic = PlasticHistory(domain, law, material, implicit=implicit)
    return replace(material, energy=plastic.energy, plastic=plastic)
