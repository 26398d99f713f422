"""Cracks that close: broken edges resist being shorter than at rest, as springs of the energy.

    psi = chi psi_d + share k/2 sum min(s, 0)^2 over broken edges,   k of `spring_modulus`

psi_d is the energy that damage leaves: chi psi_0 (share 1 - chi), or the edge-projected one (chi 1, share 1). s is
Green's strain (stretch^2 - 1)/2 of the edge, or n . eps . n with the linear energy.

A shortened edge that counts as intact makes energy out of nothing (docs/theory.md#rejected-alternatives): chi jumps
back at a finite energy, one closed edge lets a cell carry tension across its open ones, and with projected strains the
force jumps as an edge closes, since T^-1 couples it to the others (tried: Newton's method stands still at the jump). A
spring for each edge is the least that has a continuous force: nothing while open, no jump at closing, no loss over a
cycle. Stretch - 1 in place of Green's strain was tried too: where debris passes through itself an edge goes through no
length at all, and its force flips.

With quadratic displacement F differs from point to point, and the middle of a broken edge is free. An edge is as long
as its ends are far apart: (x_j - x_i) = F_m (X_j - X_i) with F_m in its middle, since the slope of a parabola there is
that of its chord. F is linear in a cell, F_m = F + grad grad u . (X_m - X): each point of it knows of every edge.

Equations: docs/theory.md#crack-closure.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import ufl
from ufl.core.expr import Expr

from .damage import edge_vectors, in_plane
from .energies import Around, Energy, Scalar
from .kinematics import small_strain

# Mean of cos^4 between an edge and a fixed direction over all directions: 3/8 in the plane, 1/5 in space.
MEAN_COS4 = {2: 3 / 8, 3: 1 / 5}


def spring_modulus(energy: Any, dim: int, edges: int) -> Scalar:
    """k in Pa: edges in all directions, all of them shortened, are as stiff against uniaxial strain as the whole cell.

    k edges <cos^4> = lambda + 2 mu; in 3D all of Hooke's law is met where nu = 1/4.
    """
    return (energy.lmbda + 2 * energy.mu) / (edges * MEAN_COS4[dim])


def bends_of(u: Expr, place: Expr, edges: Any) -> list[Expr]:
    """grad grad u . (X_m - X) of the middle m of each edge, (d, d); `place`: (d,) X in the reference cell, the
    corners of which are 0 and the unit vectors. Cells have straight sides."""
    J = ufl.Jacobian(ufl.domain.extract_unique_domain(u))
    corners = [ufl.as_vector([1.0 if i == k else 0.0 for i in range(len(place))]) for k in range(-1, len(place))]
    slope = ufl.grad(ufl.grad(u))
    return [ufl.dot(slope, J * ((corners[i] + corners[j]) / 2 - place)) for i, j in edges]


@dataclass(frozen=True)
class Closing(Around):
    """A damaged energy `whole` times `chi`, and `share` of the springs of broken edges (integrity 0, else 1).

    `bends`: what F in the middle of each edge has beyond F, with quadratic displacement (`bends_of`).
    """

    whole: Energy
    chi: Any
    share: Any
    integrity: Any
    edges: Any
    bends: Any = None

    def psi(self, F: Expr, rotation: Expr | None = None) -> Expr:
        """Energy density in J/m^3."""
        return self.chi * self.whole.psi(F, rotation) + self.share * self._springs(in_plane(F, self.edges))

    def _springs(self, F: Expr) -> Expr:
        squares = [
            (1 - self.integrity[number]) * ufl.min_value(self._strain(self._in_middle(F, number), edge), 0) ** 2
            for number, edge in enumerate(edge_vectors(self.integrity, self.edges))
        ]
        return spring_modulus(self, F.ufl_shape[0], len(self.edges)) / 2 * sum(squares[1:], squares[0])

    def _in_middle(self, F: Expr, number: int) -> Expr:
        return F if self.bends is None else F + self.bends[number]

    def _strain(self, F: Expr, edge: Expr) -> Expr:
        """s of an edge d of the reference cell."""
        square = ufl.inner(edge, edge)
        if self.linear:
            return ufl.dot(edge, small_strain(F) * edge) / square
        return (ufl.dot(F * edge, F * edge) / square - 1) / 2
