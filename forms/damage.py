"""What broken edges do to the strain of a simplex: the edge-projected energy (M22 sections 3.5.2 and 3.6.1)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import ufl
from ufl.core.expr import Expr

from .energies import Energy, Scalar, hooke


class Strained(Energy, Protocol):
    """An energy that is Hooke's law of some strain: linear or corotated."""

    def strain(self, F: Expr, rotation: Expr | None = None) -> Expr: ...


def edge_projected(strain: Expr, integrity: Expr, edges: Any) -> Expr:
    """D eps = - sum over edges ij of integrity_ij (d_ij . eps . d_ij) sym(g_i x g_j).

    With d_ij = x_j - x_i and barycentric gradients g_i of the reference cell this is T_strain^-1 diag(integrity)
    T_strain eps without a matrix inverse (see fracsim.edge_stress for the identity). `integrity` is 1 for an intact
    edge and 0 for a broken one, in the order of `edges`, the (k, 2) local nodes of each edge.
    """
    d = strain.ufl_shape[0]
    mesh = ufl.domain.extract_unique_domain(integrity)
    J, K = ufl.Jacobian(mesh), ufl.JacobianInverse(mesh)
    zero = ufl.as_vector([0] * d)
    corners = [zero, *(ufl.as_vector([J[i, k] for i in range(d)]) for k in range(d))]  # x_i - x_0
    others = [ufl.as_vector([K[k, i] for i in range(d)]) for k in range(d)]
    gradients = [-sum(others[1:], others[0]), *others]
    parts = []
    for number, (i, j) in enumerate(edges):
        edge = corners[j] - corners[i]
        along = ufl.dot(edge, strain * edge)
        parts.append(-integrity[number] * along * ufl.sym(ufl.outer(gradients[i], gradients[j])))
    return sum(parts[1:], parts[0])


@dataclass(frozen=True)
class EdgeProjected:
    """psi = 1/2 (D eps) : C : (D eps) + r psi_0: force and tangent of M22 eqs. 21-22, symmetric and positive.

    r is the share of the whole cell's stiffness that is left however damaged (0 but in quasi-static studies).
    """

    whole: Strained
    integrity: Any
    edges: Any
    residual: float = 0.0

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
        return self.whole.reduced

    @property
    def needs_rotation(self) -> bool:
        """As of the whole material."""
        return self.whole.needs_rotation

    @property
    def linear(self) -> bool:
        """As of the whole material."""
        return self.whole.linear

    def psi(self, F: Expr, rotation: Expr | None = None) -> Expr:
        """Energy density in J/m^3."""
        strain = self.whole.strain(F, rotation)
        if (
            strain.ufl_shape[0] == 3 and len(self.edges) == 3
        ):  # a 2D cell in its 3 x 3 embedding: the edges lie in the plane
            plane = ufl.as_tensor([[strain[i, j] for j in range(2)] for i in range(2)])
            kept = edge_projected(plane, self.integrity, self.edges)
            kept = ufl.as_tensor([[kept[0, 0], kept[0, 1], 0], [kept[1, 0], kept[1, 1], 0], [0, 0, strain[2, 2]]])
        else:
            kept = edge_projected(strain, self.integrity, self.edges)
        return hooke(self, kept) + self.residual * hooke(self, strain)

    def thickness_stretch(self, F: Expr) -> Expr | float:
        """F33 = 1: small strain."""
        return 1.0
