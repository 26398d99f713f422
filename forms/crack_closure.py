"""Crack closure: broken edges resist shortening, as springs of the energy.

    psi = chi psi_d + share k/2 sum min(s, 0)^2 over broken edges,   k of `spring_modulus`

psi_d is the energy that damage leaves: chi psi_0 (share 1 - chi), or the edge-projected one (chi 1, share 1). s is
Green's strain (stretch^2 - 1)/2 of the edge, or n . eps . n with the linear energy. The force of a spring is
continuous: it is 0 while the crack is open, and a cycle of closing and opening dissipates nothing.

Equations: docs/theory.md#crack-closure; alternatives: docs/theory.md#rejected-alternatives.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import ufl
from ufl.core.expr import Expr

from .damage import edge_vectors, in_plane_block
from .energies import Energy, Scalar, WrappedEnergy
from .kinematics import small_strain

# Mean of cos^4 of the angle between a random and a fixed direction: 3/8 in 2D, 1/5 in 3D.
MEAN_COS4 = {2: 3 / 8, 3: 1 / 5}


def spring_modulus(energy: Any, dim: int, edges: int) -> Scalar:
    """Return k, Pa, with which shortened edges in all directions resist uniaxial strain like the undamaged cell.

    k edges <cos^4> = lambda + 2 mu; in 3D that is all of Hooke's law if nu = 1/4.
    """
    return (energy.lmbda + 2 * energy.mu) / (edges * MEAN_COS4[dim])


def midpoint_corrections(u: Expr, point: Expr, edges: Any) -> list[Expr]:
    """Return grad grad u . (X_m - X) (d, d) for the midpoint m of each edge, for straight-sided cells.

    The length of an edge with quadratic displacement is the distance of its ends, x_j - x_i = F_m (X_j - X_i) with F_m
    at its midpoint; the midside node of a broken edge is free. F is linear in a cell, F_m = F + grad grad u . (X_m -
    X), so that the edge strains are known at every point.

    Args:
        u: displacement, m.
        point: X (d,) in the reference cell, whose corners are 0 and the unit vectors.
        edges: (k, 2) local nodes.
    """
    J = ufl.Jacobian(ufl.domain.extract_unique_domain(u))
    corners = [ufl.as_vector([1.0 if i == k else 0.0 for i in range(len(point))]) for k in range(-1, len(point))]
    # The slope of a parabola at the midpoint is that of its chord.
    second_gradient = ufl.grad(ufl.grad(u))
    return [ufl.dot(second_gradient, J * ((corners[i] + corners[j]) / 2 - point)) for i, j in edges]


@dataclass(frozen=True)
class CrackClosureEnergy(WrappedEnergy):
    """Degraded energy with the springs of broken edges.

    Attributes:
        base: energy that damage leaves.
        chi: factor of `base`.
        share: factor of the springs.
        integrity: (k,) integrity of the edges of a cell: 0 has a spring.
        edges: (k, 2) local nodes of the edges.
        corrections: (k,) F in the middle of an edge less F, with quadratic displacement (`midpoint_corrections`).
    """

    base: Energy
    chi: Any
    share: Any
    integrity: Any
    edges: Any
    corrections: Any = None

    def psi(self, F: Expr, rotation: Expr | None = None) -> Expr:
        """Return the energy density, J/m^3."""
        return self.chi * self.base.psi(F, rotation) + self.share * self._springs(in_plane_block(F, self.edges))

    def _springs(self, F: Expr) -> Expr:
        """Return the energy density of the springs, J/m^3."""
        squares = [
            (1 - self.integrity[number]) * ufl.min_value(self._edge_strain(self._at_midpoint(F, number), edge), 0) ** 2
            for number, edge in enumerate(edge_vectors(self.integrity, self.edges))
        ]
        return spring_modulus(self, F.ufl_shape[0], len(self.edges)) / 2 * sum(squares[1:], squares[0])

    def _at_midpoint(self, F: Expr, number: int) -> Expr:
        """Return F in the middle of an edge."""
        return F if self.corrections is None else F + self.corrections[number]

    def _edge_strain(self, F: Expr, edge: Expr) -> Expr:
        """Return s of an edge vector d of the reference cell."""
        square = ufl.inner(edge, edge)
        if self.linear:
            return ufl.dot(edge, small_strain(F) * edge) / square
        return (ufl.dot(F * edge, F * edge) / square - 1) / 2
