"""Arrays of 2 x 2 and 3 x 3 matrices, all at once: LAPACK's call per matrix costs more than the arithmetic."""

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
