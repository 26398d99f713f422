"""Arrays of 2 x 2 and 3 x 3 matrices, those of simplices, all at once: a LAPACK call each costs more than the sums."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Matrices = npt.NDArray[np.float64]


def cofactors(A: Matrices) -> Matrices:
    """(n, d, d) cofactor matrices: det(A) A^-T."""
    result = np.empty_like(A)
    if A.shape[1] == 2:
        result[:, 0, 0], result[:, 0, 1] = A[:, 1, 1], -A[:, 1, 0]
        result[:, 1, 0], result[:, 1, 1] = -A[:, 0, 1], A[:, 0, 0]
        return result
    for i in range(3):  # a row is the cross product of the other two
        p, q = A[:, (i + 1) % 3], A[:, (i + 2) % 3]
        for j in range(3):
            k, m = (j + 1) % 3, (j + 2) % 3
            result[:, i, j] = p[:, k] * q[:, m] - p[:, m] * q[:, k]
    return result


def inverse_transpose(A: Matrices) -> Matrices:
    """(n, d, d) A^-T = cofactors / det."""
    cofactor = cofactors(A)
    determinant = np.einsum("nj,nj->n", A[:, 0], cofactor[:, 0])
    return cofactor / determinant[:, None, None]


def barycentric_gradients(corners: Matrices) -> Matrices:
    """(n, d + 1, d) gradients g_i of the barycentric coordinates of (n, d + 1, d) corners, 1/m."""
    basis = corners[:, 1:] - corners[:, :1]
    others = inverse_transpose(basis)
    return np.concatenate([-others.sum(axis=1, keepdims=True), others], axis=1)
