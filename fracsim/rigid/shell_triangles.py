"""Flat shell triangles: constant membrane strain (CST) and discrete Kirchhoff bending (DKT).

    K = T^T (K_m + K_b + K_d) T,   K_m = A h B_m^T C B_m,   K_b = h^3/12 int B_b^T C B_b dA,   C of plane stress

Six unknowns to a node: displacement u and rotation r, so that a point at height z above it moves by u + r x z n. DKT
(J.-L. Batoz, K.-J. Bathe, L.-W. Ho 1980): slopes beta are quadratic, at the corners those of the rotations, along the
sides after a cubic deflection, beta_s = -3/2 (w_j - w_i) / l - (beta_si + beta_sj) / 4 in their middle, across them
linear. The rotation about the normal, which neither part resists, is held to that of the membrane (T. J. R. Hughes,
F. Brezzi 1989): rigid motions remain without energy, and no other does.

Equations: docs/theory.md#shells.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]

DRILLING = 0.1  # of the shear modulus
SIDES = np.array([[0, 1], [1, 2], [2, 0]])
MIDDLES = np.array([[0.5, 0.5, 0.0], [0.0, 0.5, 0.5], [0.5, 0.0, 0.5]])  # barycentric: exact for quadratics


def plane_stress(young: float, poisson: float) -> Values:
    """C (3, 3) of strains (xx, yy, 2 xy), Pa."""
    shear = (1 - poisson) / 2
    return young / (1 - poisson**2) * np.array([[1, poisson, 0], [poisson, 1, 0], [0, 0, shear]])


@dataclass(frozen=True)
class Plates:
    """n triangles.

    Attributes:
        axes: (n, 3, 3) rows: along the first side, across it in the plane, the normal.
        area: (n,) m^2.    slope: (n, 3, 2) gradients of the barycentric coordinates in the plane, 1/m.
        flat: (n, 3, 2) corners in the plane, m.
    """

    axes: Values
    area: Values
    slope: Values
    flat: Values

    @classmethod
    def of(cls, corners: Values) -> Plates:
        """Of corners (n, 3, 3), m."""
        first, other = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        normal = np.cross(first, other)
        area = np.linalg.norm(normal, axis=1) / 2
        x, z = first / np.linalg.norm(first, axis=1)[:, None], normal / (2 * area[:, None])
        axes = np.stack([x, np.cross(z, x), z], axis=1)
        flat = np.einsum("nai,nki->nka", axes[:, :2], corners - corners[:, :1])
        opposite = flat[:, [2, 0, 1]] - flat[:, [1, 2, 0]]  # of node k: from k + 1 to k + 2
        slope = np.stack([-opposite[:, :, 1], opposite[:, :, 0]], axis=2) / (2 * area)[:, None, None]
        return cls(axes, area, slope, flat)

    def stiffness(self, young: float, poisson: float, thickness: float) -> Values:
        """(n, 18, 18) of (u, r) of the three corners, in the axes of space, N/m, N and N m."""
        C, m, b, d = plane_stress(young, poisson), self.membrane(), self.turning(), self.drilling()
        K = np.einsum("n,nai,ab,nbj->nij", self.area * thickness, m, C, m)
        K += DRILLING * C[2, 2] * thickness / 3 * np.einsum("n,nki,nkj->nij", self.area, d, d)
        for at in MIDDLES:
            bent = self.bending(b, at)
            K += np.einsum("n,nai,ab,nbj->nij", self.area * thickness**3 / 36, bent, C, bent)
        return self.to_space(K)

    def to_space(self, K: Values) -> Values:
        """T^T K T of matrices (n, 18, 18) in the axes of the triangles."""
        blocks = K.reshape(-1, 6, 3, 6, 3)
        return np.einsum("nai,nkalb,nbj->nkilj", self.axes, blocks, self.axes, optimize=True).reshape(-1, 18, 18)

    def membrane(self) -> Values:
        """(n, 3, 18) strain (xx, yy, 2 xy) of the middle surface."""
        B = np.zeros((len(self.area), 3, 3, 6))
        B[:, 0, :, 0] = B[:, 2, :, 1] = self.slope[:, :, 0]
        B[:, 1, :, 1] = B[:, 2, :, 0] = self.slope[:, :, 1]
        return B.reshape(-1, 3, 18)

    def drilling(self) -> Values:
        """(n, 3, 18) of each corner, its rotation about the normal beyond that of the membrane, (v_x - u_y) / 2."""
        B = np.zeros((len(self.area), 3, 3, 6))
        B[:, :, :, 0], B[:, :, :, 1] = self.slope[:, None, :, 1] / 2, -self.slope[:, None, :, 0] / 2
        B[:, np.arange(3), np.arange(3), 5] = 1.0
        return B.reshape(-1, 3, 18)

    def turning(self) -> Values:
        """(n, 6, 2, 18) beta at the corners and in the middles of the sides: a point at z moves by z beta in the plane.

        beta = (r_y, -r_x) = -grad w.
        """
        beta = np.zeros((len(self.area), 6, 2, 3, 6))
        corner = np.arange(3)
        beta[:, corner, 0, corner, 4], beta[:, corner, 1, corner, 3] = 1.0, -1.0
        for side, (i, j) in enumerate(SIDES):
            arm = self.flat[:, j] - self.flat[:, i]
            length = np.linalg.norm(arm, axis=1)
            s = arm / length[:, None]
            both = beta[:, i] + beta[:, j]
            along = -np.einsum("na,nakl->nkl", s, both) / 4
            along[:, j, 2] -= 1.5 / length
            along[:, i, 2] += 1.5 / length
            n = np.stack([-s[:, 1], s[:, 0]], axis=1)
            across = np.einsum("na,nakl->nkl", n, both) / 2
            beta[:, 3 + side] = s[:, :, None, None] * along[:, None] + n[:, :, None, None] * across[:, None]
        return beta.reshape(-1, 6, 2, 18)

    def bending(self, turning: Values, at: Values) -> Values:
        """(n, 3, 18) curvature (xx, yy, 2 xy), the strain per height, at barycentric coordinates (3,)."""
        parts = [(4 * at[k] - 1) * self.slope[:, k] for k in range(3)]
        parts += [4 * (at[i] * self.slope[:, j] + at[j] * self.slope[:, i]) for i, j in SIDES]
        slope = np.stack(parts, axis=1)  # (n, 6, 2) of the quadratic shape functions
        grad = np.einsum("nkb,nkaj->nabj", slope, turning)
        return np.stack([grad[:, 0, 0], grad[:, 1, 1], grad[:, 0, 1] + grad[:, 1, 0]], axis=1)

    def stress(self, u: Values, young: float, poisson: float, thickness: float) -> Values:
        """(n, 2, 3) stress (xx, yy, xy) in the axes of the triangles on both faces, below and above, in their middles,
        Pa, of unknowns (n, 3, 6) in the axes of space."""
        return self.stressing(young, poisson, thickness).of(u)

    def stressing(self, young: float, poisson: float, thickness: float) -> Stressing:
        """What makes `stress` of unknowns."""
        C, bent = plane_stress(young, poisson), self.bending(self.turning(), np.full(3, 1 / 3))
        both = np.stack([self.membrane() - thickness / 2 * bent, self.membrane() + thickness / 2 * bent], axis=1)
        both = (C @ both).reshape(-1, 6, 6, 3)
        return Stressing(np.einsum("nckb,nbj->nckj", both, self.axes).reshape(-1, 6, 18))


@dataclass(frozen=True)
class Stressing:
    """(n, 6, 18) from unknowns (n, 18) in the axes of space to stress on both faces."""

    matrix: Values

    def of(self, u: Values, chosen: Ints | slice = slice(None)) -> Values:
        """(k, 2, 3) of chosen triangles, of their unknowns (k, 3, 6)."""
        return np.asarray((self.matrix[chosen] @ u.reshape(-1, 18, 1)).reshape(-1, 2, 3))
