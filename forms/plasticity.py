"""Multiplicative plasticity F = F_e F_p, det F_p = 1 (M22, section 3.7): elastic energy, and plastic flow in a step.

F_p is 3 x 3 in 2D as well: under plane strain (F33 = 1) a body flows across the plane too. At the end of a step the
elastic stretches relax along their deviator (eq. 30, mechanics.return_mapping). A step that is solved with its own flow
is balanced by the stress after the return,

    tau = (1 - beta) tau_t + beta m I,    beta = share softness (1 - Y_s / |s|) where |s| > Y_s, else 0,

with s = dev tau_t of the trial stress (F_p of the start of the step), the mean stress m that the change of volume alone
causes, share = 1 - exp(-nu dt) of the flow rate nu, and
softness 1 / (1 + K / (3 mu)), the part of the return that hardening by K leaves (Simo and Hughes 1998, box 3.1). The
norms |s| and Y_s are of Cauchy stress.

Equations: docs/theory.md#plasticity.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import ufl
from ufl.core.expr import Expr
from ufl.form import Form

from .balance import stress_quadrature
from .energies import Energy, WrappedEnergy
from .kinematics import deformation_gradient, embed, symmetric_components


@dataclass(frozen=True)
class ElastoplasticEnergy(WrappedEnergy):
    """psi(F F_p^-1); no factor stands before psi, since F_p keeps the volume.

    P = d psi / d F = P_e F_p^-T, hence tau = P F^T = P_e F_e^T: the stress is that of the elastic part.

    Attributes:
        base: energy of the elastic part.
        plastic_inverse: F_p^-1 (3 x 3).
    """

    base: Energy
    plastic_inverse: Any

    def elastic_part(self, F: Expr) -> Expr:
        """Return F_e = F F_p^-1 (3 x 3)."""
        return embed(F, 1.0) * self.plastic_inverse

    def psi(self, F: Expr, rotation: Expr | None = None) -> Expr:
        """Return the energy density, J/m^3."""
        return self.base.psi(self.elastic_part(F), embed(rotation, 1.0) if rotation is not None else None)

    def turning_moduli(self, F: Expr, rotation: Expr, of_v: Expr, of_w: Expr) -> Expr:
        """Return what the variation of the rotation of F_e adds to the second variation of psi, J/m^3."""
        variations = (embed(variation, 0.0) * self.plastic_inverse for variation in (of_v, of_w))
        return self.base.turning_moduli(self.elastic_part(F), embed(rotation, 1.0), *variations)  # type: ignore[attr-defined]


class TrialStress:
    """Stress of the elastic part of a deformation, before any plastic flow.

    Attributes:
        elastic_gradient: F_e (3 x 3).
        psi: energy density, J/m^3.
        P: d psi / d F_e, Pa.
        J: det F_e = det F.
        inverse_transpose: F_e^-T.
        mean: tr tau / 3, Pa.
        mean_of_volume: mean that the change of volume causes without a deviator, J d psi / d J, Pa.
        bulk_modulus: J d mean_of_volume / d J, Pa.
        s: s F_e^-T of the deviator s = dev tau, Pa.
        deviator_norm: |s|, Pa.
    """

    def __init__(self, energy: ElastoplasticEnergy, u: Expr, rotation: Expr | None) -> None:
        self.elastic_gradient = energy.elastic_part(deformation_gradient(u))
        variable = ufl.variable(self.elastic_gradient)
        self.psi = energy.base.psi(variable, embed(rotation, 1.0) if rotation is not None else None)
        self.P = ufl.diff(self.psi, variable)
        self.J, self.inverse_transpose = ufl.det(self.elastic_gradient), ufl.inv(self.elastic_gradient).T
        tau = self.P * self.elastic_gradient.T
        self.mean, deviator = ufl.tr(tau) / 3, ufl.dev(tau)
        self.s = self.P - self.mean * self.inverse_transpose
        # bounded, as an iterate may have inverted cells
        J, unit = ufl.variable(ufl.max_value(self.J, 0.01)), ufl.Identity(3)
        of_volume = energy.base.psi(J ** (1 / 3) * unit, unit if rotation is not None else None)
        self.mean_of_volume = J * ufl.diff(of_volume, J)
        self.bulk_modulus = J * ufl.diff(self.mean_of_volume, J)
        self.deviator_norm = ufl.sqrt(ufl.inner(deviator, deviator))

    def measures(self) -> Expr:
        """Return von Mises stress and mean of the Cauchy stress, Pa, and psi, J/m^3."""
        mises = ufl.sqrt(1.5) * self.deviator_norm / abs(self.J)
        return ufl.as_vector([mises, self.mean / self.J, self.psi])

    def state(self) -> Expr:
        """Return the measures, and the six components of C_e = F_e^T F_e."""
        stretch = symmetric_components(self.elastic_gradient.T * self.elastic_gradient)
        return ufl.as_vector([*(self.measures()[k] for k in range(3)), *(stretch[k] for k in range(6))])


@dataclass(frozen=True)
class ImplicitFlow:
    """Virtual work and tangent with plastic flow within the step.

    Attributes:
        energy: elastic energy with plastic deformation.
        resistance: Y, the present yield stress, Pa.
        softness: 1 / (1 + K / (3 mu)).
        share: 1 - exp(-nu dt) while a step is solved, 0 when its flow is done.
        frobenius: Y bounds |sigma| instead of the von Mises stress.
    """

    energy: ElastoplasticEnergy
    resistance: Expr
    softness: Expr
    share: Expr
    frobenius: bool

    def work(self, u: Expr, w: Expr, dx: ufl.Measure, *, chi: Expr | float, rotation: Expr | None) -> Form:
        """Return int chi tau : grad w F^-1 dX, N m; grad w F_p^-1 is the variation of F_e.

        The mean of the trial stress grows with the square of a trial shear. It would be many times the yield stress in
        a step whose strain is many times that of yield, and is no part of the stress after the return.
        """
        trial = TrialStress(self.energy, u, rotation)
        beta = self._flow_factors(trial)[0]
        stress = (1 - beta) * trial.P + beta * trial.mean_of_volume * trial.inverse_transpose
        return chi * ufl.inner(stress, self._elastic_variation(w)) * dx(metadata=stress_quadrature(w))

    def tangent(self, u: Expr, v: Expr, w: Expr, dx: ufl.Measure, *, chi: Expr | float, rotation: Expr | None) -> Form:
        """Return the derivative of the work in direction v, with d tau_t = C : d and d m = kappa tr d.

            int chi [(1 - beta) d P : grad w F_p^-1 + beta kappa tr d(v) tr d(w)
                     - 2 mu share softness Y_s/|s| (n : d(v)) (n : d(w))] dX,    n = s / |s|,  d(v) = grad v F^-1.

        The tangent is symmetric except for the Frobenius norm, whose Y_s decreases with the pressure:
        dY_s = -3 p kappa tr d(v) / Y_s.
        """
        trial, energy = TrialStress(self.energy, u, rotation), self.energy
        (beta, turning, pressure_factor), (of_v, of_w) = (
            self._flow_factors(trial),
            (self._elastic_variation(field) for field in (v, w)),
        )
        # d|s| = 2 mu n : d holds at small elastic strain. Newton's method converges less than quadratically, since
        # terms of the order of that strain are left out, and - beta m tr(d(v) d(w)), which makes tangents indefinite.
        elastic = ufl.derivative(ufl.inner(trial.P, of_w), u, v)
        if rotation is not None:
            elastic += energy.turning_moduli(deformation_gradient(u), rotation, ufl.grad(v), ufl.grad(w))
        kappa = trial.bulk_modulus
        volumes, shapes = (ufl.inner(part, of_v) * ufl.inner(part, of_w) for part in (trial.inverse_transpose, trial.s))
        total = (1 - beta) * elastic + beta * kappa * volumes - 2 * energy.mu * turning * shapes
        if self.frobenius:
            total -= pressure_factor * kappa * ufl.inner(trial.inverse_transpose, of_v) * ufl.inner(trial.s, of_w)
        return chi * total * dx(metadata=stress_quadrature(w))

    def _elastic_variation(self, field: Expr) -> Expr:
        """Return grad field F_p^-1 (3 x 3)."""
        return embed(ufl.grad(field), 0.0) * self.energy.plastic_inverse

    def _flow_factors(self, trial: TrialStress) -> tuple[Expr, Expr, Expr]:
        """Return beta, share softness Y_s/|s|^3, and share softness 3 p / (Y_s |s|), with norms of tau, and s for n."""
        limit = abs(trial.J) * deviator_limit(self.resistance, trial.mean / trial.J, self.frobenius)
        full, yields, ratio = (
            self.share * self.softness,
            ufl.gt(trial.deviator_norm, limit),
            limit / trial.deviator_norm,
        )
        beta = ufl.conditional(yields, full * (1 - ratio), 0.0)
        pressure_factor = ufl.conditional(
            ufl.And(yields, ufl.gt(limit, 0.0)), 3 * full * trial.mean / (limit * trial.deviator_norm), 0.0
        )
        return beta, ufl.conditional(yields, full * ratio / trial.deviator_norm**2, 0.0), pressure_factor


def deviator_limit(resistance: Expr, mean: Expr, frobenius: bool) -> Expr:
    """Return Y_s, the norm of the deviator at yield: sqrt(2/3) Y, or sqrt(Y^2 - 3 p^2) with p = tr sigma / 3."""
    if not frobenius:
        return ufl.sqrt(2 / 3) * resistance
    return ufl.sqrt(ufl.max_value(resistance**2 - 3 * mean**2, 0.0))
