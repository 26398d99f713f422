"""Multiplicative plasticity F = F_e F_p, det F_p = 1 (M22 section 3.7): the energy of the elastic part, and what flow
within a step takes off the stress.

F_p is 3 x 3 in 2D as well: under plane strain (F33 = 1) a body flows across the plane too. At the end of a step the
elastic stretches flow back along their deviator (eq. 30, fracsim.plasticity). In equilibrium with the stress that this
leaves, not with the trial stress before it, the step solves

    tau = tau_t - beta s,    beta = share softness (1 - Y_s / |s|) where |s| > Y_s, else 0,

s = dev tau_t of the trial stress (F_p of the start of the step). share is 1 - exp(-nu dt) of the flow rate nu, softness
1 / (1 + K / (3 mu)) what hardening by K leaves of the return (Simo and Hughes 1998, box 3.1). The norms |s|, Y_s are of
Cauchy stress.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import ufl
from ufl.core.expr import Expr
from ufl.form import Form

from .balance import ONE_POINT
from .energies import Energy, Scalar
from .kinematics import deformation_gradient, embed


@dataclass(frozen=True)
class Plastic:
    """psi(F F_p^-1): the volume of a cell is that at rest for F_p too, so no factor stands before psi.

    P = d psi / d F = P_e F_p^-T, hence tau = P F^T = P_e F_e^T: the stress is that of the elastic part.
    """

    elastic: Energy
    inverse: Any  # F_p^-1, 3 x 3

    linear: ClassVar[bool] = False
    reduced: ClassVar[bool] = False

    @property
    def mu(self) -> Scalar:
        """Lame's mu, Pa."""
        return self.elastic.mu

    @property
    def lmbda(self) -> Scalar:
        """Lame's lambda, Pa."""
        return self.elastic.lmbda

    @property
    def needs_rotation(self) -> bool:
        """Whether psi takes the polar rotation, which is that of F_e."""
        return self.elastic.needs_rotation

    def elastic_part(self, F: Expr) -> Expr:
        """F_e = F F_p^-1, 3 x 3."""
        return embed(F, 1.0) * self.inverse

    def psi(self, F: Expr, rotation: Expr | None = None) -> Expr:
        """Energy density in J/m^3."""
        return self.elastic.psi(self.elastic_part(F), embed(rotation, 1.0) if rotation is not None else None)

    def thickness_stretch(self, F: Expr) -> Expr | float:
        """F33 = 1: plane strain."""
        return 1.0


def kirchhoff_stress(energy: Energy, F: Expr, rotation: Expr | None = None) -> Expr:
    """tau = P F^T in Pa, 3 x 3, of a body in 3D or plane strain."""
    solid = ufl.variable(embed(F, 1.0))
    return ufl.diff(energy.psi(solid, embed(rotation, 1.0) if rotation is not None else None), solid) * solid.T


@dataclass(frozen=True)
class Relaxation:
    """What flow within the step takes off the stress.

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
        """-int chi beta s : grad w F^-1 dX in N m, to be added to the virtual work of the trial stress."""
        s, part, _ = self._trial(u, rotation)
        return -chi * part * ufl.inner(s, _rate(w, u)) * dx(metadata=ONE_POINT)

    def tangent(self, u: Expr, v: Expr, w: Expr, dx: ufl.Measure, *, chi: Expr | float, rotation: Expr | None) -> Form:
        """Its derivative in direction v for small elastic strains, in which d tau_t = C : d and d = sym(grad v F^-1):

            -int chi 2 mu (beta dev d(v) : d(w) + share softness Y_s/|s| (n : d(v)) (n : d(w))) dX,    n = s / |s|.

        Symmetric. What it leaves out is smaller by the elastic strain: Newton converges a little less than quadratically.
        """
        s, part, turning = self._trial(u, rotation)
        d_v, d_w = (ufl.sym(_rate(field, u)) for field in (v, w))
        along = ufl.inner(s, d_v) * ufl.inner(s, d_w)
        both = part * ufl.inner(ufl.dev(d_v), d_w) + turning * along
        return -2 * chi * self.energy.mu * both * dx(metadata=ONE_POINT)

    def _trial(self, u: Expr, rotation: Expr | None) -> tuple[Expr, Expr, Expr]:
        """(s, beta, share softness Y_s/|s|^3), the last with the norm of tau twice: for s in place of n."""
        F = deformation_gradient(u)
        tau, J = kirchhoff_stress(self.energy, F, rotation), ufl.det(F)
        s = ufl.dev(tau)
        square = ufl.inner(s, s)
        size, limit = ufl.sqrt(square) / abs(J), deviator_limit(self.resistance, ufl.tr(tau) / (3 * J), self.frobenius)
        whole, flows = self.share * self.softness, ufl.gt(size, limit)
        return (
            s,
            ufl.conditional(flows, whole * (1 - limit / size), 0.0),
            ufl.conditional(flows, whole * limit / (size * square), 0.0),
        )


def deviator_limit(resistance: Expr, pressure: Expr, frobenius: bool) -> Expr:
    """Y_s, the norm of the deviator at yield: sqrt(2/3) Y, or sqrt(Y^2 - 3 p^2), p = tr sigma / 3."""
    if not frobenius:
        return ufl.sqrt(2 / 3) * resistance
    return ufl.sqrt(ufl.max_value(resistance**2 - 3 * pressure**2, 0.0))


def _rate(field: Expr, u: Expr) -> Expr:
    """grad field F^-1, 3 x 3: the gradient along the current coordinates."""
    return embed(ufl.grad(field) * ufl.inv(deformation_gradient(u)), 0.0)
