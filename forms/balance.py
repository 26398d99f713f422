"""Virtual work of a body: the integrands from which residual and tangent are derived.

The quadrature is chosen here. Inertia is linear algebra with a lumped or constant mass matrix (mechanics.inertia).

Equations: docs/theory.md#elastic-energies, docs/theory.md#quadratic-displacement.
"""

from __future__ import annotations

import ufl
from ufl.algorithms.analysis import extract_elements
from ufl.core.expr import Expr
from ufl.form import Form

from .energies import Energy, elastic_stress, first_piola_kirchhoff
from .kinematics import deformation_gradient


def stress_quadrature(field: Expr) -> dict[str, int]:
    """Return the quadrature metadata of a stress, of degree 2 (order - 1).

    The order is that of `field`, a displacement (a sum of fields) or its test function.
    """
    # P1: F is constant in a cell, and one point integrates every energy exactly. P2: F is linear, and the rule of
    # degree 2 (three points in a triangle, four in a tetrahedron) is exact for linear energies, leaves no zero-energy
    # mode, and keeps the order of convergence of every energy.
    order = max(element.embedded_superdegree for element in extract_elements(field))
    return {"quadrature_degree": 2 * (order - 1)}


def internal_work(
    energy: Energy, u: Expr, w: Expr, dx: ufl.Measure, *, chi: Expr | float = 1.0, rotation: Expr | None = None
) -> Form:
    """Return the virtual work of the stress, int chi P : grad w dX, N m; chi degrades the cell (M22, eq. 27)."""
    P = first_piola_kirchhoff(energy, deformation_gradient(u), rotation)
    return chi * ufl.inner(P, ufl.grad(w)) * dx(metadata=stress_quadrature(w))


def elastic_energy(
    energy: Energy, u: Expr, dx: ufl.Measure, *, chi: Expr | float = 1.0, rotation: Expr | None = None
) -> Form:
    """Return the stored energy int chi psi dX, J."""
    return chi * energy.psi(deformation_gradient(u), rotation) * dx(metadata=stress_quadrature(u))


def viscous_work(
    energy: Energy, v: Expr, u_p: Expr, w: Expr, dx: ufl.Measure, *, b: Expr | float, chi: Expr | float = 1.0
) -> Form:
    """Return the stiffness-proportional damping, int chi b (C : Edot) : sym(F_p^T grad w) dX, Edot = sym(F_p^T grad v).

    At small strain this is Rayleigh's b K v. It always dissipates, int b Edot : C : Edot.

    Args:
        energy: elastic energy.
        v: velocity, m/s.
        u_p: displacement at the time of v, predicted at the start of the step, m.
        w: test function.
        dx: measure of the body.
        b: damping coefficient, s.
        chi: degradation.
    """
    # K of the deformed body would be neither positive nor independent of the rotation of a stressed body. A predicted F
    # keeps the form linear in v. With u_p = u_n + dt v_n a rigid spin w has a strain rate of about w^4 dt^3. With F of
    # the start of the step it would be w^2 dt, which brakes the spin.
    F_p = ufl.Identity(u_p.ufl_shape[0]) if energy.linear else deformation_gradient(u_p)
    rate, virtual = (ufl.sym(F_p.T * ufl.grad(field)) for field in (v, w))
    return chi * b * ufl.inner(elastic_stress(energy, rate), virtual) * dx(metadata=stress_quadrature(w))


def traction_work(traction: Expr, w: Expr, ds: ufl.Measure) -> Form:
    """Return the virtual work of a dead load, int t . w dA, t in Pa of the reference area."""
    return ufl.inner(traction, w) * ds


def pressure_work(pressure: Expr, u: Expr, w: Expr, normal: Expr, ds: ufl.Measure, energy: Energy) -> Form:
    """Return the virtual work of a pressure that follows the surface, -int p J F^-T N . w dA.

    p is in Pa, positive in compression. J has the stretch of the thickness in plane stress. A pressure on a body with
    the linear energy acts on the reference surface.
    """
    if energy.linear:
        return -pressure * ufl.inner(normal, w) * ds
    F = deformation_gradient(u)
    cofactor = energy.thickness_stretch(F) * ufl.det(F) * ufl.inv(F).T
    return -pressure * ufl.inner(cofactor * normal, w) * ds
