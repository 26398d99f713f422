"""Elastic energy densities psi(F) in J/m^3 of the reference volume, and the stresses derived from them.

Every energy is a frozen dataclass with Lame's parameters mu and lmbda in Pa (numbers, or UFL coefficients for
fields) and a method `psi`. It is written on the d x d block of F, so that the same lines serve 3D and plane strain
(F33 = 1); plane stress is the same again with the reduced lambda* of `plane_stress_lambda`, for energies that allow it.

Equations: docs/theory.md#elastic-energies.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import ufl
from ufl.core.expr import Expr

from .kinematics import embed, green_strain, identity, small_strain

Scalar = Any  # a float, or a UFL coefficient that stands for a field


def lame(young: float, poisson: float) -> tuple[float, float]:
    """Lame's mu = Y / (2 (1 + nu)) and lambda = Y nu / ((1 + nu)(1 - 2 nu)), in the unit of Y (M22 eq. 24)."""
    return young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))


def plane_stress_lambda(mu: float, lmbda: float) -> float:
    """lambda* = 2 lambda mu / (lambda + 2 mu), for which sigma_33 = 0 is built into the 2D energy."""
    return 2 * lmbda * mu / (lmbda + 2 * mu)


def hooke(moduli: Any, strain: Expr) -> Expr:
    """mu strain:strain + lambda/2 tr(strain)^2 in J/m^3, whichever measure of strain it is given."""
    return moduli.mu * ufl.inner(strain, strain) + moduli.lmbda / 2 * ufl.tr(strain) ** 2


class Energy(Protocol):
    """What the solver needs of an energy."""

    @property
    def mu(self) -> Scalar: ...

    @property
    def lmbda(self) -> Scalar: ...

    @property
    def reduced(self) -> bool:
        """Whether lmbda is lambda* of plane stress."""

    @property
    def needs_rotation(self) -> bool:
        """Whether psi takes the polar rotation of F, lagged per iterate."""

    @property
    def linear(self) -> bool:
        """Whether the stress is linear in u: reference and current configuration are not told apart."""

    def psi(self, F: Expr, rotation: Expr | None = None) -> Expr: ...

    def thickness_stretch(self, F: Expr) -> Expr | float: ...


class Around:
    """An energy made of another one, `whole`, with its moduli and its kind."""

    whole: Any

    @property
    def mu(self) -> Scalar:
        """Lame's mu of the whole material, Pa."""
        return self.whole.mu

    @property
    def lmbda(self) -> Scalar:
        """Lame's lambda of the whole material, Pa."""
        return self.whole.lmbda

    @property
    def reduced(self) -> bool:
        """Whether lmbda is lambda* of plane stress."""
        return bool(self.whole.reduced)

    @property
    def needs_rotation(self) -> bool:
        """Whether psi takes a polar rotation."""
        return bool(self.whole.needs_rotation)

    @property
    def linear(self) -> bool:
        """Whether the stress is linear in u."""
        return bool(self.whole.linear)

    def thickness_stretch(self, F: Expr) -> Expr | float:
        """F33, dimensionless."""
        stretch: Expr | float = self.whole.thickness_stretch(F)
        return stretch


@dataclass(frozen=True)
class _PlaneStrain:
    """F33 = 1: the out-of-plane stretch of an energy without a plane-stress form."""

    mu: Scalar
    lmbda: Scalar
    reduced: bool = False
    needs_rotation: ClassVar[bool] = False
    linear: ClassVar[bool] = False

    def thickness_stretch(self, F: Expr) -> Expr | float:
        """F33, dimensionless."""
        return 1.0


@dataclass(frozen=True)
class Linear(_PlaneStrain):
    """Hooke's law: psi = mu eps:eps + lambda/2 tr(eps)^2. Small strains and rotations only."""

    linear: ClassVar[bool] = True

    def strain(self, F: Expr, rotation: Expr | None = None) -> Expr:
        """eps = sym(F) - I."""
        return small_strain(F)

    def psi(self, F: Expr, rotation: Expr | None = None) -> Expr:
        """Energy density in J/m^3."""
        return hooke(self, self.strain(F))


@dataclass(frozen=True)
class Corotated(_PlaneStrain):
    """Hooke's law in a frame that turns with the cell: eps = sym(R^T F) - I, R the polar rotation of F.

    R is a field lagged per iterate. Where R is the polar rotation of F the first Piola-Kirchhoff stress
    R (2 mu eps + lambda tr(eps) I) is exact, since R's own variation does no work on a stress that commutes with
    the stretch; the tangent leaves that variation out and stays symmetric and positive.
    """

    needs_rotation: ClassVar[bool] = True

    def psi(self, F: Expr, rotation: Expr | None = None) -> Expr:
        """Energy density in J/m^3; `rotation` is R (d x d)."""
        return hooke(self, self.strain(F, rotation))

    def strain(self, F: Expr, rotation: Expr | None = None) -> Expr:
        """eps = sym(R^T F) - I."""
        if rotation is None:
            raise ValueError("the corotated energy needs the polar rotation of F")
        return small_strain(rotation.T * F)


@dataclass(frozen=True)
class StVK(_PlaneStrain):
    """Saint Venant-Kirchhoff: psi = mu E:E + lambda/2 tr(E)^2, P = F (2 mu E + lambda tr(E) I).

    Large rotations, moderate strains: softens in compression and has no resistance to inversion.
    Source: M22 eq. 26; M22s eq. 29 prints P without the leading F.
    """

    def psi(self, F: Expr, rotation: Expr | None = None) -> Expr:
        """Energy density in J/m^3."""
        return hooke(self, green_strain(F))

    def thickness_stretch(self, F: Expr) -> Expr | float:
        """F33 = sqrt(1 + 2 E33), E33 = -lambda*/(2 mu) tr(E) in plane stress; 1 in plane strain."""
        if not self.reduced:
            return 1.0
        return ufl.sqrt(1 - self.lmbda / self.mu * ufl.tr(green_strain(F)))


@dataclass(frozen=True)
class NeoHookean(_PlaneStrain):
    """Stable neo-Hookean of Smith, de Goes and Kim 2018 (M22 eq. 25), shifted so that psi(I) = 0.

    psi = m/2 (I_C - 3) + l/2 (J - alpha)^2 - m/2 log(I_C + 1) - psi_0, with m = 4/3 mu, l = lambda + 5/6 mu and
    alpha = 1 + m/l - m/(4 l). Finite and smooth for every F, inverted ones included. Without the shift a degraded
    body at rest would seem to hold energy.
    """

    def psi(self, F: Expr, rotation: Expr | None = None) -> Expr:
        """Energy density in J/m^3."""
        m = 4 / 3 * self.mu
        volumetric = self.lmbda + 5 / 6 * self.mu
        alpha = 1 + 3 / 4 * m / volumetric
        trace_C = ufl.inner(F, F) + (3 - F.ufl_shape[0])  # 2D: plus F33^2 = 1
        at_rest = volumetric / 2 * (1 - alpha) ** 2 - m / 2 * math.log(4)
        distortion = m / 2 * (trace_C - 3) - m / 2 * ufl.ln(trace_C + 1)
        return distortion + volumetric / 2 * (ufl.det(F) - alpha) ** 2 - at_rest


ENERGIES: dict[str, type] = {"linear": Linear, "corotated": Corotated, "stvk": StVK, "neo-hookean": NeoHookean}


def first_piola_kirchhoff(energy: Energy, F: Expr, rotation: Expr | None = None) -> Expr:
    """P = d psi / d F in Pa (d x d)."""
    variable = ufl.variable(F)
    return ufl.diff(energy.psi(variable, rotation), variable)


def cauchy_stress(energy: Energy, F: Expr, rotation: Expr | None = None) -> Expr:
    """Cauchy stress J^-1 P F^T in Pa (d x d, symmetric); for the linear energy, sigma = P.

    J counts the out-of-plane stretch, so that the plane-stress value is the force per current area.
    """
    P = first_piola_kirchhoff(energy, F, rotation)
    if energy.linear:
        return P
    return P * F.T / (ufl.det(F) * energy.thickness_stretch(F))


def elastic_stress(energy: Energy, strain: Expr) -> Expr:
    """2 mu strain + lambda tr(strain) I in Pa: Hooke's law, to which every energy tends at small strain."""
    return 2 * energy.mu * strain + energy.lmbda * ufl.tr(strain) * identity(strain)


def full_cauchy_stress(energy: Energy, F: Expr, rotation: Expr | None = None) -> Expr:
    """3 x 3 Cauchy stress in Pa of a 2D or 3D body; in 2D with the stress out of the plane."""
    if F.ufl_shape[0] == 3 or energy.reduced:
        return embed(cauchy_stress(energy, F, rotation), 0.0)
    return cauchy_stress(energy, embed(F, 1.0), embed(rotation, 1.0) if rotation is not None else None)


def von_mises(stress: Expr) -> Expr:
    """sqrt(3/2 s:s), s the deviator of a 3 x 3 stress, Pa."""
    deviator = ufl.dev(stress)
    return ufl.sqrt(1.5 * ufl.inner(deviator, deviator))
