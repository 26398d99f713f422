"""Multiplicative plasticity F = F_e F_p, det F_p = 1 (M22 section 3.7): the energy of the elastic part, and what flow
within a step takes off the stress.

F_p is 3 x 3 in 2D as well: under plane strain (F33 = 1) a body flows across the plane too. At the end of a step the
elastic stretches flow back along their deviator (eq. 30, mechanics.return_mapping). Where a step is solved with its own
flow, what balances is the stress that this leaves, not the trial stress before it:

    tau = tau_t - beta s,    beta = share softness (1 - Y_s / |s|) where |s| > Y_s, else 0,

s = dev tau_t of the trial stress (F_p of the start of the step), share = 1 - exp(-nu dt) of the flow rate nu, softness
1 / (1 + K / (3 mu)) what hardening by K leaves of the return (Simo and Hughes 1998, box 3.1). The norms |s|, Y_s are of
Cauchy stress.

Equations: docs/theory.md#plasticity.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import ufl
from ufl.core.expr import Expr
from ufl.form import Form

from .balance import points_of_stress
from .energies import Around, Energy
from .kinematics import deformation_gradient, embed, symmetric_components


@dataclass(frozen=True)
class Plastic(Around):
    """psi(F F_p^-1): the volume of a cell is that at rest for F_p too, so no factor stands before psi.

    P = d psi / d F = P_e F_p^-T, hence tau = P F^T = P_e F_e^T: the stress is that of the elastic part.
    """

    whole: Energy
    inverse: Any  # F_p^-1, 3 x 3

    def elastic_part(self, F: Expr) -> Expr:
        """F_e = F F_p^-1, 3 x 3."""
        return embed(F, 1.0) * self.inverse

    def psi(self, F: Expr, rotation: Expr | None = None) -> Expr:
        """Energy density in J/m^3."""
        return self.whole.psi(self.elastic_part(F), embed(rotation, 1.0) if rotation is not None else None)


class Trial:
    """Stress of the elastic part of a deformation, before any flow.

    Attributes:
        part: F_e.    psi: J/m^3.    P: d psi / d F_e, Pa.    pull: F_e^-T.
        mean: tr tau / 3, Pa.    s: s F_e^-T of the deviator s = dev tau, Pa.    size: |s|, Pa.    J: det F_e = det F.
    """

    def __init__(self, energy: Plastic, u: Expr, rotation: Expr | None) -> None:
        self.part = energy.elastic_part(deformation_gradient(u))
        solid = ufl.variable(self.part)
        self.psi = energy.whole.psi(solid, embed(rotation, 1.0) if rotation is not None else None)
        self.P = ufl.diff(self.psi, solid)
        self.J, self.pull = ufl.det(self.part), ufl.inv(self.part).T
        tau = self.P * self.part.T
        self.mean, deviator = ufl.tr(tau) / 3, ufl.dev(tau)
        self.s = self.P - self.mean * self.pull
        self.size = ufl.sqrt(ufl.inner(deviator, deviator))

    def measures(self) -> Expr:
        """(von Mises, mean) of the Cauchy stress in Pa, and psi in J/m^3."""
        return ufl.as_vector([ufl.sqrt(1.5) * self.size / abs(self.J), self.mean / self.J, self.psi])

    def state(self) -> Expr:
        """The measures, and the six components of C_e = F_e^T F_e."""
        stretch = symmetric_components(self.part.T * self.part)
        return ufl.as_vector([*(self.measures()[k] for k in range(3)), *(stretch[k] for k in range(6))])


@dataclass(frozen=True)
class ImplicitFlow:
    """Virtual work and tangent with flow within the step.

    Attributes:
        resistance: Y, the yield stress as it is now, Pa.
        softness: 1 / (1 + K / (3 mu)).
        share: 1 - exp(-nu dt) while a step is solved, 0 when its flow is done.
        frobenius: Y bounds |sigma|, and not the von Mises stress.
    """

    energy: Plastic
    resistance: Expr
    softness: Expr
    share: Expr
    frobenius: bool

    def work(self, u: Expr, w: Expr, dx: ufl.Measure, *, chi: Expr | float, rotation: Expr | None) -> Form:
        """int chi (tau_t - beta s) : grad w F^-1 dX in N m; grad w F_p^-1 is the variation of F_e."""
        trial = Trial(self.energy, u, rotation)
        stress = trial.P - self._flow(trial)[0] * trial.s
        return chi * ufl.inner(stress, self._part(w)) * dx(metadata=points_of_stress(w))

    def tangent(self, u: Expr, v: Expr, w: Expr, dx: ufl.Measure, *, chi: Expr | float, rotation: Expr | None) -> Form:
        """Its derivative in direction v, for d tau_t = C : d with C = 2 mu dev + kappa I x I at small elastic strain:

            int chi [(1 - beta) d P : grad w F_p^-1 + beta kappa tr d(v) tr d(w)
                     - 2 mu share softness Y_s/|s| (n : d(v)) (n : d(w))] dX,    n = s / |s|,  d(v) = grad v F^-1.

        Symmetric but for the Frobenius norm, whose Y_s falls with the pressure: dY_s = -3 p kappa tr d(v) / Y_s. What
        is left out is smaller by the elastic strain: Newton converges a little less than quadratically.
        """
        trial, energy = Trial(self.energy, u, rotation), self.energy
        (beta, turning, rising), (of_v, of_w) = self._flow(trial), (self._part(field) for field in (v, w))
        elastic = ufl.derivative(ufl.inner(trial.P, of_w), u, v)
        kappa = energy.lmbda + 2 / 3 * energy.mu
        volumes, shapes = (ufl.inner(part, of_v) * ufl.inner(part, of_w) for part in (trial.pull, trial.s))
        total = (1 - beta) * elastic + beta * kappa * volumes - 2 * energy.mu * turning * shapes
        if self.frobenius:
            total -= rising * kappa * ufl.inner(trial.pull, of_v) * ufl.inner(trial.s, of_w)
        return chi * total * dx(metadata=points_of_stress(w))

    def _part(self, field: Expr) -> Expr:
        """grad field F_p^-1, 3 x 3."""
        return embed(ufl.grad(field), 0.0) * self.energy.inverse

    def _flow(self, trial: Trial) -> tuple[Expr, Expr, Expr]:
        """(beta, share softness Y_s/|s|^3, share softness 3 p / (Y_s |s|)), norms of tau, s in place of n."""
        limit = abs(trial.J) * deviator_limit(self.resistance, trial.mean / trial.J, self.frobenius)
        whole, flows, ratio = self.share * self.softness, ufl.gt(trial.size, limit), limit / trial.size
        beta = ufl.conditional(flows, whole * (1 - ratio), 0.0)
        rising = ufl.conditional(ufl.And(flows, ufl.gt(limit, 0.0)), 3 * whole * trial.mean / (limit * trial.size), 0.0)
        return beta, ufl.conditional(flows, whole * ratio / trial.size**2, 0.0), rising


def deviator_limit(resistance: Expr, mean: Expr, frobenius: bool) -> Expr:
    """Y_s, the norm of the deviator at yield: sqrt(2/3) Y, or sqrt(Y^2 - 3 p^2), p = tr sigma / 3."""
    if not frobenius:
        return ufl.sqrt(2 / 3) * resistance
    return ufl.sqrt(ufl.max_value(resistance**2 - 3 * mean**2, 0.0))
