"""The configurational force on a crack tip: what its advance releases for each area of crack, J/m^2.

Equations: docs/theory.md#configurational-force.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ...mesh.small_matrices import cofactors

Values = npt.NDArray[np.float64]


def across(H: Values, vectors: Values) -> Values:
    """(n, d) H^T v of matrices (n, d, d) and vectors (n, d): component by component, which is quick where these lie one
    after the other in memory."""
    result = np.empty_like(vectors)
    for k in range(vectors.shape[1]):
        result[:, k] = H[:, 0, k] * vectors[:, 0]
        for j in range(1, vectors.shape[1]):
            result[:, k] += H[:, j, k] * vectors[:, j]
    return result


def eshelby(psi: Values, H: Values, P: Values) -> Values:
    """(n, d, d) psi I - H^T P in Pa, of energy densities (n,) in J/m^3, gradients H = grad u and P (n, d, d) in Pa.

    Eshelby (1951); psi and P as the cell has them, chi included.
    """
    result = np.empty_like(P)
    for i in range(P.shape[1]):
        for k in range(P.shape[2]):
            column = H[:, 0, i] * P[:, 0, k]
            for j in range(1, P.shape[1]):
                column += H[:, j, i] * P[:, j, k]
            np.subtract(psi if i == k else 0.0, column, out=result[:, i, k])
    return result


def plateau(distance: Values, radius: Values) -> Values:
    """(n,) q at distances (n,) from a tip: 1 up to R / 2, falling linearly to 0 at R (n,)."""
    return np.clip(2 * (1 - distance / radius), 0.0, 1.0)


def plateau_gradient(apart: Values, radius: Values) -> Values:
    """(n, d) grad q in 1/m at places (n, d) from a tip: q is 1 up to R / 2 and falls linearly to 0 at R (n,)."""
    r = np.linalg.norm(apart, axis=1)
    ring = (r > radius / 2) & (r < radius)
    slope = np.where(ring, -2 / (radius * np.where(ring, r, 1.0)), 0.0)
    return slope[:, None] * apart


def springs(vectors: Values, modulus: Values, H: Values, *, linear: bool) -> tuple[Values, Values]:
    """(n,) psi in J/m^3 and (n, d, d) P in Pa of springs along edges that are shorter than at rest
    (forms.crack_closure).

    psi = k/2 sum min(s, 0)^2, s = (|F d|^2 / |d|^2 - 1) / 2, or d . H d / |d|^2 where strains are taken for small.
    `vectors`: (n, edges, d) m. `modulus`: (n, edges) k in Pa, 0 of edges without one.
    """
    square = np.einsum("nei,nei->ne", vectors, vectors)
    moved = np.einsum("nij,nej->nei", H, vectors)
    strain = np.einsum("nei,nei->ne", vectors, moved) / square
    if not linear:
        strain += np.einsum("nei,nei->ne", moved, moved) / (2 * square)
        moved += vectors
    shorter = np.minimum(strain, 0.0)
    pulled = vectors if linear else moved
    P = np.einsum("ne,nei,nej->nij", modulus * shorter / square, pulled, vectors)
    return np.einsum("ne,ne->n", modulus, shorter**2) / 2, P


def first_piola(cauchy: Values, H: Values, *, linear: bool) -> Values:
    """(n, d, d) P = J sigma F^-T in Pa, F = I + H; sigma itself where strains are taken for small."""
    if linear:
        return cauchy
    cofactor, result = cofactors(H + np.eye(H.shape[1])), np.empty_like(cauchy)
    for i in range(cauchy.shape[1]):
        result[:, i] = across(cofactor, cauchy[:, i])
    return result
