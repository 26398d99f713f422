"""Virtual work of a body: the integrands from which residual and tangent are derived.

Quadrature is chosen here and nowhere else: with P1 displacement F is constant in a cell, so one point integrates every
energy exactly. With P2 F is linear, and the rule of degree 2 (three points in a triangle, four in a tetrahedron) is
exact for linear energies, leaves no mode of a cell without stiffness, and costs no order for any energy. Inertia is not
here: with a lumped or constant mass matrix it is linear algebra (solvers.newton).

Equations: docs/theory.md#elastic-energies.
"""

from __future__ import annotations

import ufl
from ufl.algorithms.analysis import extract_elements
from ufl.core.expr import Expr
from ufl.form import Form

from .energies import Energy, elastic_stress, first_piola_kirchhoff
from .kinematics import deformation_gradient


def points_of_stress(field: Expr) -> dict[str, int]:
    """Metadata of the quadrature of a stress, by the order of a displacement (a sum of fields) or its test function:
    2 (order - 1)."""
    return {"quadrature_degree": 2 * (max(each.embedded_superdegree for each in extract_elements(field)) - 1)}


def internal_work(
    energy: Energy, u: Expr, w: Expr, dx: ufl.Measure, *, chi: Expr | float = 1.0, rotation: Expr | None = None
) -> Form:
    """Virtual work of the stress, int chi P : grad w dX in N m; chi is the degradation of the cell (M22 eq. 27)."""
    P = first_piola_kirchhoff(energy, deformation_gradient(u), rotation)
    return chi * ufl.inner(P, ufl.grad(w)) * dx(metadata=points_of_stress(w))


def elastic_energy(
    energy: Energy, u: Expr, dx: ufl.Measure, *, chi: Expr | float = 1.0, rotation: Expr | None = None
) -> Form:
    """Stored energy int chi psi dX in J."""
    return chi * energy.psi(deformation_gradient(u), rotation) * dx(metadata=points_of_stress(u))


def viscous_work(
    energy: Energy, v: Expr, u_n: Expr, w: Expr, dx: ufl.Measure, *, b: Expr | float, chi: Expr | float = 1.0
) -> Form:
    """Stiffness-proportional damping, int chi b (C : Edot) : sym(F_n^T grad w) dX with Edot = sym(F_n^T grad v).

    At small strain this is Rayleigh's b K v (b in s). K of the deformed body would be neither positive nor blind to a
    rotating stressed body; this form always dissipates, int b Edot : C : Edot. F_n is that of the start of the step,
    which keeps the term linear in v; a rigid spin w then has a strain rate of about w^2 dt, which vanishes with dt.
    """
    F_n = ufl.Identity(u_n.ufl_shape[0]) if energy.linear else deformation_gradient(u_n)
    rate, virtual = (ufl.sym(F_n.T * ufl.grad(field)) for field in (v, w))
    return chi * b * ufl.inner(elastic_stress(energy, rate), virtual) * dx(metadata=points_of_stress(w))


def traction_work(traction: Expr, w: Expr, ds: ufl.Measure) -> Form:
    """Virtual work of a dead load, int t . w dA, t in Pa of the reference area."""
    return ufl.inner(traction, w) * ds


def pressure_work(pressure: Expr, u: Expr, w: Expr, normal: Expr, ds: ufl.Measure, *, linear: bool) -> Form:
    """Virtual work of a pressure that follows the surface, -int p J F^-T N . w dA (p in Pa, > 0 pushes).

    `linear`: on the reference surface instead, as befits the linear energy.
    """
    if linear:
        return -pressure * ufl.inner(normal, w) * ds
    F = deformation_gradient(u)
    cofactor = ufl.det(F) * ufl.inv(F).T
    return -pressure * ufl.inner(cofactor * normal, w) * ds
