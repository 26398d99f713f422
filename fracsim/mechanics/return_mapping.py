"""Return mapping at the end of a step: points beyond yield flow back to the yield surface.

With F_e = U Sigma V^T and the logarithmic deviator e = V dev(log Sigma) V^T of the elastic stretch a point flows by

    F_p <- exp(beta e) F_p,    exp(beta e) = V (det(Sigma)^(-1/3) Sigma)^beta V^T,

which leaves F_e <- F_e exp(-beta e) and det F_p = 1. M22 eq. 30 prints the factors the other way round; but V belongs
to the configuration between F_p and F_e: only in this order do the stretches of F_e shrink along their own axes. The
accumulated plastic strain alpha grows by beta sqrt(2/3) |e|, and beta is the root of

    q(beta) - Y(alpha + beta sqrt(2/3) |e|) = exp(-nu dt) (q(0) - Y(alpha)),

q the measure of the Cauchy stress and Y = yield_stress + K alpha: the stress beyond yield decays like exp(-nu t) at
constant displacement, for any sizes of steps, and at once for nu -> infinity. Eq. 31 is the initial guess of the root
without hardening (with nu instead of 1 - exp(-nu dt), so that half the step would double the flow).

Equations: docs/theory.md#plasticity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import numpy.typing as npt

from ..forms.plasticity import TrialStress
from .jit import point_expression
from .plasticity import ImplicitPlasticFlow, PlasticHistory
from .stress import Stress
from .tensor_functions import deviatoric_power, eigenvalues, multiply_unimodular

Values = npt.NDArray[np.float64]
Points = npt.NDArray[np.int32]
Selection = slice | npt.NDArray[np.intp]  # part of an array, or all of it without a copy


@dataclass(frozen=True)
class ReturnMappingPolicy:
    """Numbers of the secant method for beta.

    Attributes:
        tolerance: error of the root, relative to the stress.
        max_iterations: of the secant method; small elastic strains need one.
        block: points at a time, whose arrays stay in the processor's cache.
    """

    tolerance: float = 1e-6
    max_iterations: int = 12
    block: int = 4096


POLICY = ReturnMappingPolicy()


class ElasticZoneProtocol(Protocol):
    """Interface of a zone around crack tips in which nothing flows."""

    def update(self) -> None:
        """Move the zone to the present tips (collective)."""


class ReturnMapping:
    """Plastic flow of a step whose displacement is known (a protocol of timestepping.inelastic_update).

    Attributes:
        elastic_zone: zone around crack tips; None: the body may flow everywhere.
        stored: stored energy int psi dX after it, without damage, part of this rank, J.
        plastic: history of plastic flow.
        continues: whether a step that is solved again continues from the flow before.
    """

    elastic_energy: float | None = 0.0
    elastic_zone: ElasticZoneProtocol | None = None

    def __init__(self, stress: Stress) -> None:
        plastic, domain = stress.material.plastic, stress.domain
        assert plastic is not None
        self.plastic: PlasticHistory = plastic
        self._stress, self._flowed = stress, True
        # (points,) stress above Y of points that have left the elastic zone since the last flow, Pa; None: none has
        self._excess: Values | None = None
        # An extrapolated flow would be extrapolated anew.
        self.continues = math.isinf(plastic.rate) and isinstance(plastic.prediction, ImplicitPlasticFlow)
        trial = TrialStress(plastic.energy, stress.u, stress.rotation_field)
        self._state, self._measures = (
            point_expression(domain, expression, kernels=stress.kernels)
            for expression in (trial.state(), trial.measures())
        )

    def begin_step(self, dt: float) -> None:
        """Begin a step of dt (s)."""
        self.plastic.begin_step(dt)

    def edges_broke(self) -> None:
        """Move the elastic zone to the present crack tips (collective)."""
        if self.elastic_zone is None:
            return
        before = self.plastic.elastic
        self.elastic_zone.update()
        points = self.plastic.flowing_points(before)
        Y = self.plastic.flow_stress(self.plastic.accumulated_strain[points], points)
        self._excess = np.zeros(len(self.plastic.accumulated_strain)) if self._excess is None else self._excess
        self._excess[points] = np.maximum(self.measured(self.measures(points)) - Y, 0.0)

    def __call__(self) -> float:
        """Return points beyond yield to the yield surface; energy dissipated on this rank, J."""
        plastic, dt = self.plastic, self.plastic.dt
        self._put_back()
        state = self._state.evaluate_at_points().reshape(-1, self._state.width)
        measure, Y = self.measured(state), plastic.flow_stress(plastic.accumulated_strain)
        beyond = (measure > Y * (1 + POLICY.tolerance)) & np.isfinite(measure)
        points = np.flatnonzero(beyond).astype(np.int32)
        power, lost, psi = np.empty((6, len(points))), 0.0, state[:, 2]
        if plastic.fraction > 0:
            for part in (slice(k, k + POLICY.block) for k in range(0, len(points), POLICY.block)):
                where = points[part]
                block = _Return(self, where, state[where], measure[where])
                power[:, part] = block.find()
                lost += self._lost(block)
                psi[where] = block.after[:, 2]
        self.elastic_energy = float(plastic.volumes @ psi)
        if plastic.prediction is not None and dt:
            plastic.prediction.record_flow(points, power, dt)
        plastic.begin_step(0.0)
        self._excess = None
        if len(points) and plastic.hardening:
            plastic.update_flow_stress()
        if len(points) or self._flowed:
            plastic.discard_snapshot()
        self._flowed = len(points) > 0
        return lost

    def snapshot(self) -> Values:
        """(points, 10 or 16) what the cells remember of their flow: see Plasticity.memory."""
        return self.plastic.snapshot()

    def restore(self, saved: object) -> bool:
        """The cells remember no more than that."""
        assert isinstance(saved, np.ndarray)
        return self.plastic.restore(saved)

    def _put_back(self) -> None:
        """Restore F_p of the step's start, which the prediction replaced."""
        if self.plastic.prediction is None:
            return
        self.plastic.prediction.begin_step(0.0, 0.0)
        if self.plastic.prediction.form is None:
            self._stress.update_displacement()  # the rotation was that of another F_e

    def measures(self, points: Points) -> Values:
        """(n, 3) measures (von Mises stress, pressure, energy) of points at their present F_p."""
        count = self.plastic.points_per_cell
        if count == 1:
            return self._measures(points)
        cells, index = np.unique(points // count, return_inverse=True)
        return self._measures.evaluate_at_points(cells.astype(np.int32)).reshape(-1, count, 3)[index, points % count]

    def measured(self, stress: Values) -> Values:
        """(n,) measure that is compared with Y, Pa: q, or |sigma| with |sigma|^2 = 2/3 q^2 + 3 p^2."""
        vm, p = stress[:, 0], stress[:, 1]
        return np.sqrt(2 / 3 * vm**2 + 3 * p**2) if self.plastic.frobenius else vm.copy()

    def _yielding(self, Y: Values, pressure: Values) -> Values:
        """(n,) von Mises stress at yield, Pa: Y, or what the pressure leaves of |sigma| = Y."""
        return np.sqrt(np.maximum(1.5 * (Y**2 - 3 * pressure**2), 0.0)) if self.plastic.frobenius else Y

    def _lost(self, block: _Return) -> float:
        """Energy dissipated by a block of points, J; updates their accumulated strain."""
        plastic, points = self.plastic, block.points
        flowed = block.beta * block.size
        plastic.accumulated_strain[points] = block.alpha + flowed
        # the loss of psi starts at the trial stress, which the body never had: it flowed at the yield stress
        (vm, pressure, psi), (vm_trial, _, psi_trial) = block.after.T, block.trial.T
        start, end = (
            self._yielding(plastic.flow_stress(alpha, points), pressure)
            for alpha in (block.alpha, plastic.accumulated_strain[points])
        )
        gain = end - start
        over = block.J * (vm_trial - vm) + gain
        if self._excess is not None:
            over -= np.minimum(self._excess[points], over)
        chi = 1.0 if self._stress.chi is None else self._stress.chi.x.array[points // plastic.points_per_cell]
        return float(np.sum(chi * plastic.volumes[points] * (psi_trial - psi - over / 2 * flowed)))


class _Return:
    """Return of points beyond yield to the yield surface.

    Attributes:
        points: (n,) the points.
        trial, after: (n, 3) measures before and after.
        alpha: (n,) accumulated plastic strain before.
        size: (n,) sqrt(2/3) |e|.
        beta: (n,) the root.
    """

    def __init__(self, flow: ReturnMapping, points: Points, state: Values, measure: Values) -> None:
        self._flow, self.points, self._measure = flow, points, measure
        plastic = flow.plastic
        self.alpha, self._start = (
            plastic.accumulated_strain[points],
            np.ascontiguousarray(plastic.inverse_rows[points].T),
        )
        self.trial, self._C = state[:, :3], np.ascontiguousarray(state[:, 3:].T)
        self._values = eigenvalues(self._C)
        logs = np.log(self._values)
        self._logs = logs - logs.mean(axis=0)
        self.size = np.sqrt(np.sum(self._logs**2, axis=0) / 6)  # e is half the deviator of log C
        self._excess = measure - plastic.flow_stress(self.alpha, points)
        self.after, self._power = self.trial.copy(), np.empty_like(self._C)

    @cached_property
    def J(self) -> Values:
        """(n,) det F."""
        return np.sqrt(np.prod(self._values, axis=0))

    def find(self) -> Values:
        """(6, n) exp(-beta e), with beta by the secant method from 0 and the root for linear stress.

        If the last two excesses show that the next secant step is the root (errors of the secant method multiply), it
        is taken and not checked. A beta of 1 leaves no deviator: the Frobenius norm of a large pressure may stay above
        yield.
        """
        plastic, q = self._flow.plastic, self._measure
        before, g_before = np.zeros(len(q)), plastic.fraction * self._excess
        self.beta = np.clip(g_before / (q + np.maximum(plastic.hardening, 0.0) * self.size), 0.0, 1.0)
        live: Selection = slice(None)  # points without a root
        for is_last in (False,) * (POLICY.max_iterations - 1) + (True,):
            beta, g = self.beta[live].copy(), self._excess_at(live)
            ratio = np.divide(g, g_before[live] - g, out=np.zeros_like(g), where=g != g_before[live])
            self.beta[live] = np.clip(beta + ratio * (beta - before[live]), 0.0, 1.0)
            tolerance = POLICY.tolerance * q[live]
            converged = (np.abs(g) <= tolerance) | (g * g <= tolerance * np.abs(g_before[live]))
            converged = converged | ((beta == 1) & (g > 0)) | is_last
            self._complete(_narrow(live, converged), beta[converged])
            if converged.all():
                break
            before[live], g_before[live] = beta, g
            live = _narrow(live, ~converged)
        return self._power

    def _excess_at(self, live: Selection) -> Values:
        """(n,) excess of the stress over exp(-nu dt) of the former excess, Pa, at the present beta."""
        plastic, points = self._flow.plastic, self.points[live]
        self._return(live)
        self.after[live] = stress = self._flow.measures(points)
        Y = plastic.flow_stress(self.alpha[live] + self.beta[live] * self.size[live], points)
        return self._flow.measured(stress) - Y - (1 - plastic.fraction) * self._excess[live]

    def _complete(self, points: Selection, before: Values) -> None:
        """Take a last step from beta = `before`, so small that the measures are linear in it."""
        self._return(points)
        step, measures = self.beta[points] - before, self.after[points]
        slope = np.divide(step, before, out=np.zeros_like(step), where=before > 0)
        measures[:, :2] += slope[:, None] * (measures - self.trial[points])[:, :2]
        # s : e of a von Mises stress along e
        measures[:, 2] -= self.J[points] * measures[:, 0] * self.size[points] * step
        self.after[points] = measures

    def _return(self, points: Selection) -> None:
        """Set F_p^-1 = F_p^-1 exp(-beta e), from F_p of the step's start."""
        C, values, logs = (array[:, points] for array in (self._C, self._values, self._logs))
        power = deviatoric_power(C, values, logs, -self.beta[points] / 2)
        self._flow.plastic.inverse_rows[self.points[points]] = multiply_unimodular(self._start[:, points], power).T
        self._power[:, points] = power


def _narrow(points: Selection, mask: npt.NDArray[np.bool_]) -> Selection:
    """`points` of the mask; without a copy if these are all."""
    if mask.all():
        return points
    return np.flatnonzero(mask) if isinstance(points, slice) else points[mask]
