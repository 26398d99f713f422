"""Plastic flow at the end of a step: the elastic stretches of cells past yield flow back to the yield surface.

With F_e = U Sigma V^T and the logarithmic deviator e = V dev(log Sigma) V^T of the elastic stretch a cell flows by

    F_p <- exp(beta e) F_p,    exp(beta e) = V (det(Sigma)^(-1/3) Sigma)^beta V^T,

which leaves F_e <- F_e exp(-beta e) and det F_p = 1. M22 eq. 30 prints the factors the other way round; but V belongs
to the configuration between F_p and F_e: only in this order do the stretches of F_e shrink along their own axes. The
accumulated plastic strain alpha grows by beta sqrt(2/3) |e|, and beta is the root of

    q(beta) - Y(alpha + beta sqrt(2/3) |e|) = exp(-nu dt) (q(0) - Y(alpha)),

q the measure of the Cauchy stress and Y = yield_stress + K alpha: the stress beyond yield decays like exp(-nu t) where
the body is held, however it is cut into steps, and is gone at once for nu -> infinity. Eq. 31 is the first guess of the
root without hardening (with nu for 1 - exp(-nu dt), so that halving the step would double the flow).
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem

from .domain import Domain
from .forms.kinematics import symmetric_components
from .forms.plasticity import Plastic, Relaxation, Trial
from .kernels import CellExpression
from .material import MaterialFields, PerCell, per_cell
from .spectrum import deviatoric_power, eigenvalues, times
from .study import Study

if TYPE_CHECKING:
    from .equilibrium import Equilibrium

Values = npt.NDArray[np.float64]
Cells = npt.NDArray[np.int32]

WEAKEST = 0.01  # share of the yield stress that softening leaves
CLOSE = 1e-6  # of the stress: how near the root is found
ITERATIONS = 12  # of the secant; three do for small elastic strains
BLOCK = 16384  # cells at a time: their arrays stay in the cache


class Plasticity:
    """What the cells remember of their flow.

    Attributes:
        inverse: F_p^-1, DG0, 3 x 3.
        strain: (cells,) accumulated plastic strain alpha.
        relaxation: what flow takes off the stress while a step is solved.
        fraction: 1 - exp(-nu dt), the part of the return to the yield surface that a step makes; 0 between steps.
        share: the same where the step is solved with its flow; 0 where flow only follows it.
    """

    def __init__(self, domain: Domain, study: Study, material: MaterialFields) -> None:
        table = study.plasticity
        assert table is not None
        self.rate, self.hardening, self.frobenius = table.flow_rate, table.hardening, table.measure == "frobenius"
        self._implicit, self.fraction = table.update == "implicit", 0.0
        self._yield: PerCell = per_cell(domain, table, "yield_stress", study.material.regions)
        self._modulus: PerCell = 3 * material.mu
        self.strain = np.zeros(domain.cell_count)
        self.inverse = fem.Function(fem.functionspace(domain.mesh, ("DG", 0, (3, 3))), name="inverse plastic part")
        self.inverse.x.array.reshape(-1, 9)[:] = np.eye(3).reshape(-1)
        self._resistance, self._softness = fem.Function(domain.cell_scalar), fem.Function(domain.cell_scalar)
        self.share = fem.Constant(domain.mesh, np.float64(0.0))
        self.energy = Plastic(material.energy, _block(self.inverse, domain.dim))
        self.relaxation = Relaxation(self.energy, self._resistance, self._softness, self.share, self.frobenius)
        self.refresh()

    def resistance(self, strain: Values, cells: Cells | slice = slice(None)) -> Values:
        """Y = yield_stress + K alpha of cells with the given alpha, Pa; never below a small share of yield_stress."""
        start = self._yield[cells] if isinstance(self._yield, np.ndarray) else self._yield
        return np.maximum(start + self.hardening * strain, WEAKEST * start)

    def refresh(self) -> None:
        """The fields that belong to `strain`."""
        Y, count = self.resistance(self.strain), len(self.strain)
        soft = (self.hardening < 0) & (WEAKEST * self._yield >= Y)  # as soft as it gets
        self._resistance.x.array[:count] = Y
        self._softness.x.array[:count] = 1 / (1 + np.where(soft, 0.0, self.hardening / self._modulus))

    def memory(self) -> Values:
        """(cells, 10) F_p^-1 and alpha, for a checkpoint."""
        return np.column_stack([self.inverse.x.array.reshape(-1, 9)[: len(self.strain)], self.strain])

    def restore(self, memory: Values) -> None:
        """Take up what `memory` gave."""
        self.inverse.x.array.reshape(-1, 9)[: len(memory)] = memory[:, :-1]
        self.strain[:] = memory[:, -1]
        self.refresh()

    def begin(self, dt: float) -> None:
        """A step of dt is to be solved; with 0: it is done."""
        self.fraction = -math.expm1(-self.rate * dt) if dt else 0.0
        self.share.value = self.fraction if self._implicit else 0.0


def _block(inverse: fem.Function, dim: int) -> ufl.core.expr.Expr:
    """F_p^-1; in plane strain with the zeros written out, so that no kernel multiplies by them."""
    if dim == 3:
        return inverse
    return ufl.as_tensor([[inverse[0, 0], inverse[0, 1], 0], [inverse[1, 0], inverse[1, 1], 0], [0, 0, inverse[2, 2]]])


def plastic_material(domain: Domain, study: Study, material: MaterialFields) -> MaterialFields:
    """The material with an energy of the elastic part of F, and with what its cells remember."""
    plastic = Plasticity(domain, study, material)
    return replace(material, energy=plastic.energy, plastic=plastic)


class Flow:
    """The flow of a step, once its displacement is known."""

    def __init__(self, equations: Equilibrium) -> None:
        plastic = equations.material.plastic
        assert plastic is not None
        self.plastic: Plasticity = plastic
        self._equations, domain = equations, equations.domain
        self._inverse: Values = plastic.inverse.x.array.reshape(-1, 9)
        rotation = equations.rotation.field if equations.rotation is not None else None
        trial, of = Trial(plastic.energy, equations.u, rotation), (domain.comm, domain.mesh)
        self._stress = CellExpression(*of, trial.measures(), domain.cell_count)
        self._stretch = CellExpression(*of, symmetric_components(trial.part.T * trial.part), domain.cell_count)
        self._before: tuple[Cells, Values, Values] | None = None

    def begin(self, dt: float) -> None:
        """The flow to come is that of a step of dt."""
        self.plastic.begin(dt)

    def __call__(self) -> float:
        """Let the cells past yield flow; returns the energy that this rank's cells lost to it, J."""
        plastic, trial = self.plastic, self._stress()
        measure, Y = self._measured(trial), plastic.resistance(plastic.strain)
        cells = np.flatnonzero((measure > Y * (1 + CLOSE)) & np.isfinite(measure)).astype(np.int32)
        self._before = cells, self._inverse[cells], plastic.strain[cells]
        lost = 0.0
        if plastic.fraction > 0:
            blocks = [cells[k : k + BLOCK] for k in range(0, len(cells), BLOCK)]
            lost = sum(self._flow(block, trial[block], measure[block]) for block in blocks)
        plastic.begin(0.0)
        if len(cells) and plastic.hardening:
            plastic.refresh()
        return lost

    def undo(self) -> None:
        """Take the last flow back: the step will be solved again."""
        assert self._before is not None
        cells, inverse, strain = self._before
        self._inverse[cells], self.plastic.strain[cells] = inverse, strain
        self.plastic.refresh()

    def _measured(self, stress: Values) -> Values:
        """What is compared with Y, from (n, 3) measures: q, or |sigma| with |sigma|^2 = 2/3 q^2 + 3 p^2."""
        vm, p, _ = stress.T
        return np.sqrt(2 / 3 * vm**2 + 3 * p**2) if self.plastic.frobenius else vm.copy()

    def _flow(self, cells: Cells, trial: Values, measure: Values) -> float:
        """Energy lost by a block of cells past yield, J."""
        plastic, alpha = self.plastic, self.plastic.strain[cells]
        C = np.ascontiguousarray(self._stretch(cells).T)
        values = eigenvalues(C)
        logs = np.log(values)
        logs -= logs.mean(axis=0)
        size = np.sqrt(np.sum(logs**2, axis=0) / 6)  # sqrt(2/3) |e| of e = logs / 2
        beta, stress = self._root(cells, measure, C, values, logs, size)
        plastic.strain[cells] = alpha + beta * size
        gain = plastic.resistance(plastic.strain[cells], cells) - plastic.resistance(alpha, cells)
        # What psi lost goes down from the trial stress, which the body never had: it flowed at the yield stress.
        (vm, _, psi), (vm_trial, _, psi_trial) = stress.T, trial.T
        over = np.sqrt(np.prod(values, axis=0)) * (vm_trial - vm) + gain
        chi = 1.0 if self._equations.chi is None else self._equations.chi.x.array[cells]
        volumes = self._equations.domain.volumes[cells]
        return float(np.sum(chi * volumes * (psi_trial - psi - over / 2 * beta * size)))

    def _root(
        self, cells: Cells, measure: Values, C: Values, values: Values, logs: Values, size: Values
    ) -> tuple[Values, Values]:
        """(beta, (n, 3) measures after it) by the secant from beta = 0 and the root for a stress linear in beta.

        The cells are left with their F_p of that beta. A beta of 1 has no deviator left to relax: the Frobenius norm of
        a large pressure may stay above yield.
        """
        plastic, start = self.plastic, np.ascontiguousarray(self._inverse[cells].T)
        alpha, share = plastic.strain[cells], plastic.fraction
        excess = measure - plastic.resistance(alpha, cells)
        before, g_before, after = np.zeros(len(cells)), share * excess, np.empty((len(cells), 3))
        beta = np.clip(share * excess / (measure + np.maximum(plastic.hardening, 0.0) * size), 0.0, 1.0)
        live: Any = slice(None)  # those whose root is not found
        for _ in range(ITERATIONS):
            now, where = beta[live], cells[live]
            power = deviatoric_power(C[:, live], values[:, live], logs[:, live], -now / 2)
            self._inverse[where] = times(start[:, live], power).T
            stress = self._stress(where)
            after[live] = stress
            g = self._measured(stress) - plastic.resistance(alpha[live] + now * size[live], where)
            g -= (1 - share) * excess[live]
            wrong = (np.abs(g) > CLOSE * measure[live]) & ((now < 1) | (g < 0)) & (g != g_before[live])
            live, now, g = np.flatnonzero(wrong) if isinstance(live, slice) else live[wrong], now[wrong], g[wrong]
            if not len(live):
                break
            step = g * (now - before[live]) / (g - g_before[live])
            before[live], g_before[live], beta[live] = now, g, np.clip(now - step, 0.0, 1.0)
        return beta, after
