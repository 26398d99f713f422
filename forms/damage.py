"""What broken edges do to the strain of a simplex: the edge-projected energy (M22 sections 3.5.2 and 3.6.1).

A strain is a sum over the edges ij of the reference cell, eps = - sum (d_ij . eps . d_ij) sym(g_i x g_j), with
d_ij = X_j - X_i and barycentric gradients g_i (see fracture.edge_stress for the identity): T_strain^-1 without a matrix
inverse. Broken edges are left out of the sum.

Equations: docs/theory.md#edge-projected-strain.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import ufl
from ufl.core.expr import Expr

from .energies import Around, Energy, hooke
from .kinematics import embed


class Strained(Energy, Protocol):
    """An energy that is Hooke's law of some strain: linear or corotated."""

    def strain(self, F: Expr, rotation: Expr | None = None) -> Expr: ...


def edge_dyads(cell: Expr, edges: Any) -> list[tuple[Expr, Expr]]:
    """(d_ij, -sym(g_i x g_j)) of the edges of the cell that `cell`, a coefficient, lives on."""
    mesh = ufl.domain.extract_unique_domain(cell)
    K = ufl.JacobianInverse(mesh)
    d = K.ufl_shape[0]
    others = [ufl.as_vector([K[k, i] for i in range(d)]) for k in range(d)]
    gradients = [-sum(others[1:], others[0]), *others]
    dyads = [-ufl.sym(ufl.outer(gradients[i], gradients[j])) for i, j in edges]
    return list(zip(edge_vectors(cell, edges), dyads, strict=True))


def edge_vectors(cell: Expr, edges: Any) -> list[Expr]:
    """d_ij = X_j - X_i of the edges of the cell, m."""
    J = ufl.Jacobian(ufl.domain.extract_unique_domain(cell))
    d = J.ufl_shape[0]
    corners = [ufl.as_vector([0] * d), *(ufl.as_vector([J[i, k] for i in range(d)]) for k in range(d))]  # X_i - X_0
    return [corners[j] - corners[i] for i, j in edges]


def edge_projected(strain: Expr, integrity: Expr, edges: Any) -> Expr:
    """D eps: the part of the strain along edges with `integrity` 1 (0: broken), in the order of `edges`.

    `edges`: (k, 2) local nodes.
    """
    parts = [
        integrity[number] * ufl.dot(edge, strain * edge) * dyad
        for number, (edge, dyad) in enumerate(edge_dyads(integrity, edges))
    ]
    return sum(parts[1:], parts[0])


def in_plane(tensor: Expr, edges: Any) -> Expr:
    """The block of a tensor that a cell with these edges lies in: 2 x 2 of the 3 x 3 embedding of a triangle."""
    if len(edges) != 3 or tensor.ufl_shape[0] == 2:
        return tensor
    return ufl.as_tensor([[tensor[i, j] for j in range(2)] for i in range(2)])


@dataclass(frozen=True)
class EdgeProjected(Around):
    """psi = 1/2 (D eps) : C : (D eps) + r psi_0: force and tangent of M22 eqs. 21-22, symmetric and positive.

    r is the share of the whole cell's stiffness that is left however damaged (0 but in quasi-static studies).
    """

    whole: Strained
    integrity: Any
    edges: Any
    residual: float = 0.0

    def psi(self, F: Expr, rotation: Expr | None = None) -> Expr:
        """Energy density in J/m^3."""
        strain = self.whole.strain(F, rotation)
        plane = in_plane(strain, self.edges)
        kept = edge_projected(plane, self.integrity, self.edges)
        if plane is not strain:
            kept = embed(kept, strain[2, 2])
        return hooke(self, kept) + self.residual * hooke(self, strain)
