"""Configurational force on a crack tip: the energy that its advance releases per area of crack, J/m^2.

Equations: docs/theory.md#configurational-force.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ...mesh.small_matrices import cofactors

Values = npt.NDArray[np.float64]


def transposed_product(H: Values, vectors: Values) -> Values:
    """Return H^T v (n, d) of matrices (n, d, d) and vectors (n, d)."""
    # By components, which are contiguous in memory for fields from other ranks.
    result = np.empty_like(vectors)
    for k in range(vectors.shape[1]):
        result[:, k] = H[:, 0, k] * vectors[:, 0]
        for j in range(1, vectors.shape[1]):
            result[:, k] += H[:, j, k] * vectors[:, j]
    return result


def eshelby_stress(psi: Values, H: Values, P: Values) -> Values:
    """Return Eshelby's stress psi I - H^T P (n, d, d), Pa (Eshelby, 1951).

    Args:
        psi: (n,) energy density with damage, J/m^3.
        H: (n, d, d) displacement gradient.
        P: (n, d, d) first Piola-Kirchhoff stress with damage, Pa.
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
    """Return q (n,) at distances (n,) from a tip: 1 up to R / 2, then linear to 0 at R (n,)."""
    return np.clip(2 * (1 - distance / radius), 0.0, 1.0)


def closure_spring_stress(vectors: Values, modulus: Values, H: Values, *, linear: bool) -> tuple[Values, Values]:
    """Return psi (n,), J/m^3, and P (n, d, d), Pa, of the springs along shortened edges (forms.crack_closure).

    psi = k/2 sum min(s, 0)^2 with s = (|F d|^2 / |d|^2 - 1) / 2, or d . H d / |d|^2 for small strains.

    Args:
        vectors: (n, edges, d) edge vectors d, m.
        modulus: (n, edges) k, Pa, 0 for intact edges.
        H: (n, d, d) displacement gradient.
        linear: strains are small.
    """
    square = np.einsum("nei,nei->ne", vectors, vectors)
    moved = np.einsum("nij,nej->nei", H, vectors)
    strain = np.einsum("nei,nei->ne", vectors, moved) / square
    if not linear:
        strain += np.einsum("nei,nei->ne", moved, moved) / (2 * square)
        moved += vectors
    shortening = np.minimum(strain, 0.0)
    present = vectors if linear else moved
    P = np.einsum("ne,nei,nej->nij", modulus * shortening / square, present, vectors)
    return np.einsum("ne,ne->n", modulus, shortening**2) / 2, P


def first_piola_stress(cauchy: Values, H: Values, *, linear: bool) -> Values:
    """Return P = J sigma F^-T (n, d, d), Pa, with F = I + H; sigma itself for small strains."""
    if linear:
        return cauchy
    cofactor, result = cofactors(H + np.eye(H.shape[1])), np.empty_like(cauchy)
    for i in range(cauchy.shape[1]):
        result[:, i] = transposed_product(cofactor, cauchy[:, i])
    return result
