"""Edge-projected energy: the strain of a simplex without its broken edges (M22, sections 3.5.2 and 3.6.1).

A strain is a sum over the edges ij of the reference cell, eps = - sum (d_ij . eps . d_ij) sym(g_i x g_j), with
d_ij = X_j - X_i and barycentric gradients g_i: T_strain^-1 of M22 without a matrix inverse (see fracture.edge_stress).
Broken edges are left out of the sum.

Equations: docs/theory.md#edge-projected-strain.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import ufl
from ufl.core.expr import Expr

from .energies import Energy, WrappedEnergy, hooke
from .kinematics import embed


class StrainEnergy(Energy, Protocol):
    """Interface of an energy that is Hooke's law of a strain: linear or corotated."""

    def strain(self, F: Expr, rotation: Expr | None = None) -> Expr:
        """Return the strain (d x d)."""


def edge_dyads(cell: Expr, edges: Any) -> list[tuple[Expr, Expr]]:
    """Return (d_ij, -sym(g_i x g_j)) of the edges of the cells on which the coefficient `cell` is defined."""
    mesh = ufl.domain.extract_unique_domain(cell)
    K = ufl.JacobianInverse(mesh)
    d = K.ufl_shape[0]
    # The first gradient follows from the others: barycentric coordinates sum to 1.
    following = [ufl.as_vector([K[k, i] for i in range(d)]) for k in range(d)]
    gradients = [-sum(following[1:], following[0]), *following]
    dyads = [-ufl.sym(ufl.outer(gradients[i], gradients[j])) for i, j in edges]
    return list(zip(edge_vectors(cell, edges), dyads, strict=True))


def edge_vectors(cell: Expr, edges: Any) -> list[Expr]:
    """Return d_ij = X_j - X_i, m, of the edges of the cells on which the coefficient `cell` is defined."""
    J = ufl.Jacobian(ufl.domain.extract_unique_domain(cell))
    d = J.ufl_shape[0]
    # X_i - X_0
    corners = [ufl.as_vector([0] * d), *(ufl.as_vector([J[i, k] for i in range(d)]) for k in range(d))]
    return [corners[j] - corners[i] for i, j in edges]


def project_on_edges(strain: Expr, integrity: Expr, edges: Any) -> Expr:
    """Return D eps: the part of the strain along edges with integrity 1 (0: broken), in the order of `edges`.

    `edges` (k, 2) are local nodes.
    """
    parts = [
        integrity[number] * ufl.dot(edge, strain * edge) * dyad
        for number, (edge, dyad) in enumerate(edge_dyads(integrity, edges))
    ]
    return sum(parts[1:], parts[0])


def in_plane_block(tensor: Expr, edges: Any) -> Expr:
    """Return the block of a tensor in the space of a cell with these edges: 2 x 2 of 3 x 3 for a triangle."""
    if len(edges) != 3 or tensor.ufl_shape[0] == 2:
        return tensor
    return ufl.as_tensor([[tensor[i, j] for j in range(2)] for i in range(2)])


@dataclass(frozen=True)
class EdgeProjectedEnergy(WrappedEnergy):
    """psi = 1/2 (D eps) : C : (D eps) + r psi_0: force and tangent of M22, eqs. 21-22, symmetric and positive.

    Attributes:
        base: energy of the undamaged material.
        integrity: (k,) integrity of the edges of a cell.
        edges: (k, 2) local nodes of the edges.
        residual: r, share of the stiffness that remains in any damage; 0 except in quasi-static studies.
    """

    base: StrainEnergy
    integrity: Any
    edges: Any
    residual: float = 0.0

    def psi(self, F: Expr, rotation: Expr | None = None) -> Expr:
        """Return the energy density, J/m^3."""
        strain = self.base.strain(F, rotation)
        plane = in_plane_block(strain, self.edges)
        projected = project_on_edges(plane, self.integrity, self.edges)
        if plane is not strain:
            projected = embed(projected, strain[2, 2])
        return hooke(self, projected) + self.residual * hooke(self, strain)
