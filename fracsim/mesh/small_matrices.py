"""Arrays of 2 x 2 and 3 x 3 matrices: cofactors, inverse transposes, gradients of simplices, polar rotations.

Closed formulas over the whole array are faster than one LAPACK call for each small matrix.
"""

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
    # a row is the cross product of the other two
    for i in range(3):
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
    gradients = inverse_transpose(basis)
    return np.concatenate([-gradients.sum(axis=1, keepdims=True), gradients], axis=1)


def polar_rotation(F: Matrices, iterations: int = 20) -> Matrices:
    """(n, d, d) rotations R of the polar decomposition F = R U, by Newton's iteration R <- (R + R^-T) / 2.

    Convergence is quadratic. For inverted or nearly flat cells the iteration would converge to a reflection or stall;
    an SVD is used there. Source: Higham (1986), Computing the polar decomposition.
    """
    # cells of a diverging iterate are not finite
    with np.errstate(invalid="ignore", over="ignore"):
        determinant = np.einsum("nj,nj->n", F[:, 0], cofactors(F)[:, 0])
        regular = determinant > 1e-6 * np.einsum("nij,nij->n", F, F) ** (F.shape[1] / 2)
    if not regular.all():
        result = np.empty_like(F)
        result[regular] = polar_rotation(F[regular], iterations)
        result[~regular] = closest_rotation(F[~regular])
        return result
    R, moving = F.copy(), np.arange(len(F))  # most cells converge before the most stretched one
    for _ in range(iterations):
        change = inverse_transpose(R[moving]) - R[moving]
        R[moving] += change / 2
        # quadratic convergence: the next change is at round-off
        moving = moving[np.abs(change).max(axis=(1, 2), initial=0.0) >= 1e-8]
        if not len(moving):
            break
    return R


def closest_rotation(F: Matrices) -> Matrices:
    """(n, d, d) U diag(1, .., det(U V^T)) V^T, the rotation closest to F; the identity where F is not finite."""
    finite = np.isfinite(F.sum(axis=(1, 2)))
    safe = np.where(finite[:, None, None], F, np.eye(F.shape[1]))
    U, _, Vt = np.linalg.svd(safe)
    U[:, :, -1] *= np.sign(np.linalg.det(U @ Vt)).reshape(-1, 1)
    return U @ Vt
