"""Elastic energy densities psi(F), J/m^3 of the reference volume, and the stresses derived from them.

Every energy is a frozen dataclass with Lame's parameters mu and lmbda in Pa (numbers, or UFL coefficients for fields)
and a method `psi`. It is written for the d x d block of F, so that the same code serves 3D and plane strain (F33 = 1).
Plane stress uses the reduced lambda* of `plane_stress_lambda`, for energies that allow it.

Equations: docs/theory.md#elastic-energies.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import ufl
from ufl.core.expr import Expr

from .kinematics import embed, green_strain, identity, small_strain

Scalar = Any  # a float, or a UFL coefficient for a field


def lame(young: float, poisson: float) -> tuple[float, float]:
    """Return mu = Y / (2 (1 + nu)) and lambda = Y nu / ((1 + nu)(1 - 2 nu)), in the unit of Y (M22, eq. 24)."""
    return young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))


def plane_stress_lambda(mu: float, lmbda: float) -> float:
    """Return lambda* = 2 lambda mu / (lambda + 2 mu), with which the 2D energy implies sigma_33 = 0."""
    return 2 * lmbda * mu / (lmbda + 2 * mu)


def hooke(moduli: Any, strain: Expr) -> Expr:
    """Return mu strain:strain + lambda/2 tr(strain)^2, J/m^3, for any measure of strain."""
    return moduli.mu * ufl.inner(strain, strain) + moduli.lmbda / 2 * ufl.tr(strain) ** 2


class Energy(Protocol):
    """Interface of an elastic energy."""

    @property
    def mu(self) -> Scalar:
        """Lame's mu, Pa."""

    @property
    def lmbda(self) -> Scalar:
        """Lame's lambda, Pa."""

    @property
    def plane_stress(self) -> bool:
        """Whether lmbda is lambda* of plane stress."""

    @property
    def needs_rotation(self) -> bool:
        """Whether psi takes the polar rotation of F, lagged by one iterate."""

    @property
    def linear(self) -> bool:
        """Whether the stress is linear in u: reference and present configuration are the same."""

    def psi(self, F: Expr, rotation: Expr | None = None) -> Expr:
        """Return the energy density, J/m^3, at the deformation gradient F (d x d) and its rotation (d x d)."""

    def thickness_stretch(self, F: Expr) -> Expr | float:
        """Return F33, dimensionless."""


class WrappedEnergy:
    """Base of an energy made of another one: it has the moduli and the kind of `base`.

    Attributes:
        base: energy of the undamaged, elastic material.
    """

    base: Any

    @property
    def mu(self) -> Scalar:
        """Lame's mu of the base material, Pa."""
        return self.base.mu

    @property
    def lmbda(self) -> Scalar:
        """Lame's lambda of the base material, Pa."""
        return self.base.lmbda

    @property
    def plane_stress(self) -> bool:
        """Whether lmbda is lambda* of plane stress."""
        return bool(self.base.plane_stress)

    @property
    def needs_rotation(self) -> bool:
        """Whether psi takes a polar rotation."""
        return bool(self.base.needs_rotation)

    @property
    def linear(self) -> bool:
        """Whether the stress is linear in u."""
        return bool(self.base.linear)

    def thickness_stretch(self, F: Expr) -> Expr | float:
        """Return F33, dimensionless."""
        stretch: Expr | float = self.base.thickness_stretch(F)
        return stretch


@dataclass(frozen=True)
class _PlaneStrain:
    """Base of energies without a plane-stress form of the out-of-plane stretch: F33 = 1.

    Attributes:
        mu: Lame's mu, Pa.
        lmbda: Lame's lambda, Pa; lambda* in plane stress.
        plane_stress: whether lmbda is lambda*.
    """

    mu: Scalar
    lmbda: Scalar
    plane_stress: bool = False
    needs_rotation: ClassVar[bool] = False
    linear: ClassVar[bool] = False

    def thickness_stretch(self, F: Expr) -> Expr | float:
        """Return F33 = 1."""
        return 1.0


@dataclass(frozen=True)
class LinearElastic(_PlaneStrain):
    """Hooke's law for small strains and rotations: psi = mu eps:eps + lambda/2 tr(eps)^2."""

    linear: ClassVar[bool] = True

    def strain(self, F: Expr, rotation: Expr | None = None) -> Expr:
        """Return eps = sym(F) - I."""
        return small_strain(F)

    def psi(self, F: Expr, rotation: Expr | None = None) -> Expr:
        """Return the energy density, J/m^3."""
        return hooke(self, self.strain(F))

    def thickness_stretch(self, F: Expr) -> Expr | float:
        """Return F33 = 1 + eps33, eps33 = -lambda*/(2 mu) tr(eps), in plane stress; 1 in plane strain."""
        return 1 - self.lmbda / (2 * self.mu) * ufl.tr(small_strain(F)) if self.plane_stress else 1.0


@dataclass(frozen=True)
class Corotated(_PlaneStrain):
    """Hooke's law in a frame that rotates with the cell: eps = sym(R^T F) - I, R the polar rotation of F.

    R is a field lagged by one iterate.
    """

    needs_rotation: ClassVar[bool] = True

    def psi(self, F: Expr, rotation: Expr | None = None) -> Expr:
        """Return the energy density, J/m^3; `rotation` is R (d x d)."""
        return hooke(self, self.strain(F, rotation))

    def strain(self, F: Expr, rotation: Expr | None = None) -> Expr:
        """Return eps = sym(R^T F) - I."""
        # At the polar rotation the first Piola-Kirchhoff stress R (2 mu eps + lambda tr(eps) I) is exact, since the
        # variation of R does no work on a stress that commutes with the stretch. The moduli need that variation: see
        # `turning_moduli`.
        if rotation is None:
            raise ValueError("the corotated energy needs the polar rotation of F")
        return small_strain(rotation.T * F)

    def turning_moduli(self, F: Expr, rotation: Expr, of_v: Expr, of_w: Expr) -> Expr:
        """Return what the variation of R adds to the second variation of psi, J/m^3.

            2 a_w . M a_v,  M = (tr(T) I - T) (tr(S) I - S)^-1,  in 2D tr(T) / tr(S),    F = R S,  T = R^T P

        a is the axial vector of skew(R^T dF). The eigenvalues of M are (T_i + T_j) / (s_i + s_j): a cell in tension
        resists rotation, one in compression gives way. Where a denominator vanishes, in an inverted cell, M is bounded:
        1/x is x / (x^2 + 1e-8).

        Args:
            F: deformation gradient (d x d).
            rotation: R.
            of_v: variation dF (d x d).
            of_w: another one.
        """
        strain = self.strain(F, rotation)
        T, S = elastic_stress(self, strain), strain + identity(strain)
        a_v, a_w = (_axial_vector(rotation.T * variation) for variation in (of_v, of_w))
        if F.ufl_shape[0] == 2:
            return 2 * ufl.tr(T) * _bounded_inverse(ufl.tr(S)) * a_w * a_v
        G_T, G_S = (ufl.tr(tensor) * identity(tensor) - tensor for tensor in (T, S))
        M = ufl.sym(ufl.dot(G_T, ufl.cofac(G_S))) * _bounded_inverse(ufl.det(G_S))
        return 2 * ufl.inner(a_w, ufl.dot(M, a_v))


@dataclass(frozen=True)
class SaintVenantKirchhoff(_PlaneStrain):
    """Saint Venant-Kirchhoff: psi = mu E:E + lambda/2 tr(E)^2, P = F (2 mu E + lambda tr(E) I).

    For large rotations and moderate strains: it softens in compression and does not resist inversion. Source: M22, eq.
    26; M22s, eq. 29 prints P without the leading F.
    """

    def psi(self, F: Expr, rotation: Expr | None = None) -> Expr:
        """Return the energy density, J/m^3."""
        return hooke(self, green_strain(F))

    def thickness_stretch(self, F: Expr) -> Expr | float:
        """Return F33 = sqrt(1 + 2 E33), E33 = -lambda*/(2 mu) tr(E), in plane stress; 1 in plane strain."""
        if not self.plane_stress:
            return 1.0
        return ufl.sqrt(1 - self.lmbda / self.mu * ufl.tr(green_strain(F)))


@dataclass(frozen=True)
class NeoHookean(_PlaneStrain):
    """Stable neo-Hookean energy of Smith, de Goes and Kim (2018; M22, eq. 25), shifted so that psi(I) = 0.

    psi = m/2 (I_C - 3) + l/2 (J - alpha)^2 - m/2 log(I_C + 1) - psi_0, with m = 4/3 mu, l = lambda + 5/6 mu and
    alpha = 1 + m/l - m/(4 l). It is finite and smooth for every F, inverted ones included.
    """

    def psi(self, F: Expr, rotation: Expr | None = None) -> Expr:
        """Return the energy density, J/m^3."""
        m = 4 / 3 * self.mu
        volumetric = self.lmbda + 5 / 6 * self.mu
        alpha = 1 + 3 / 4 * m / volumetric
        # In 2D F33^2 = 1 is added.
        trace_C = ufl.inner(F, F) + (3 - F.ufl_shape[0])
        # Without the shift a degraded body at rest would seem to store energy.
        at_rest = volumetric / 2 * (1 - alpha) ** 2 - m / 2 * math.log(4)
        distortion = m / 2 * (trace_C - 3) - m / 2 * ufl.ln(trace_C + 1)
        return distortion + volumetric / 2 * (ufl.det(F) - alpha) ** 2 - at_rest


@dataclass(frozen=True)
class UserEnergy(_PlaneStrain):
    """Energy of the user, given for the 3 x 3 deformation gradient; 2D is plane strain.

    Attributes:
        law: object with a method `psi(F)`, J/m^3.
    """

    law: Any = None

    def psi(self, F: Expr, rotation: Expr | None = None) -> Expr:
        """Return the energy density, J/m^3."""
        return self.law.psi(embed(F, 1.0))


ENERGIES: dict[str, type] = {
    "linear": LinearElastic,
    "corotated": Corotated,
    "stvk": SaintVenantKirchhoff,
    "neo-hookean": NeoHookean,
}


def first_piola_kirchhoff(energy: Energy, F: Expr, rotation: Expr | None = None) -> Expr:
    """Return P = d psi / d F, Pa (d x d)."""
    variable = ufl.variable(F)
    return ufl.diff(energy.psi(variable, rotation), variable)


def _bounded_inverse(x: Expr) -> Expr:
    """Return x / (x^2 + 1e-8): 1/x to 1e-8 / x^2, and at most 5,000."""
    return x / (x**2 + 1e-8)


def _axial_vector(tensor: Expr) -> Expr:
    """Return the axial vector of the skew part of a tensor; in 2D its component across the plane."""
    if tensor.ufl_shape[0] == 2:
        return (tensor[1, 0] - tensor[0, 1]) / 2
    pairs = ((2, 1), (0, 2), (1, 0))
    return ufl.as_vector([(tensor[i, j] - tensor[j, i]) / 2 for i, j in pairs])


def cauchy_stress(energy: Energy, F: Expr, rotation: Expr | None = None) -> Expr:
    """Return the Cauchy stress J^-1 P F^T, Pa (d x d, symmetric); for the linear energy sigma = P.

    J includes the out-of-plane stretch, so that the plane-stress value is the force per present area.
    """
    P = first_piola_kirchhoff(energy, F, rotation)
    if energy.linear:
        return P
    return P * F.T / (ufl.det(F) * energy.thickness_stretch(F))


def elastic_stress(energy: Energy, strain: Expr) -> Expr:
    """Return 2 mu strain + lambda tr(strain) I, Pa: Hooke's law, the limit of every energy at small strain."""
    return 2 * energy.mu * strain + energy.lmbda * ufl.tr(strain) * identity(strain)


def full_cauchy_stress(energy: Energy, F: Expr, rotation: Expr | None = None) -> Expr:
    """Return the 3 x 3 Cauchy stress, Pa, of a 2D or 3D body; in 2D with the stress out of the plane."""
    if F.ufl_shape[0] == 3 or energy.plane_stress:
        return embed(cauchy_stress(energy, F, rotation), 0.0)
    return cauchy_stress(energy, embed(F, 1.0), embed(rotation, 1.0) if rotation is not None else None)


def von_mises(stress: Expr) -> Expr:
    """Return sqrt(3/2 s:s), Pa, s the deviator of a 3 x 3 stress."""
    deviator = ufl.dev(stress)
    return ufl.sqrt(1.5 * ufl.inner(deviator, deviator))
