"""Stiffness of few pairs beside the tangent: what is told apart, and its preconditioner against dense inverses."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import csr_matrix, random_array

from fracsim.mechanics.extra_couplings import LIMITS, StiffCoupling, stiff_directions
from fracsim.solvers.low_rank import WoodburyPreconditioner

RANDOM = np.random.default_rng(5)


def springs(n: int, count: int, stiffness: float) -> csr_matrix:
    """(n, n) of springs between neighbours, `count` of them."""
    H = np.zeros((n, n))
    for k in range(0, 2 * count, 2):
        H[k : k + 2, k : k + 2] += stiffness * np.array([[1.0, -1.0], [-1.0, 1.0]])
    return csr_matrix(H)


def test_springs_between_two_points_are_a_direction_each() -> None:
    """(1, -1) / sqrt 2 with the eigenvalue 2 k; a soft one is not told apart."""
    H = springs(40, 3, 1e6) + csr_matrix(([5.0], ([20], [20])), shape=(40, 40))
    found = stiff_directions(H, 1e3)
    assert found is not None
    U, k = found
    np.testing.assert_allclose(k, 2e6)
    np.testing.assert_allclose((U @ np.diag(k) @ U.T), springs(40, 3, 1e6).toarray(), atol=1e-8)


def test_many_are_left_in_the_tangent() -> None:
    n = 4 * LIMITS.group_dofs
    chain = np.eye(n) + np.diag(np.full(n - 1, 0.1), 1) + np.diag(np.full(n - 1, 0.1), -1)
    assert stiff_directions(csr_matrix(chain), 0.1) is None  # too many in one group
    assert stiff_directions(springs(n, LIMITS.directions + 1, 1.0), 0.1) is None
    found = stiff_directions(springs(n, LIMITS.directions, 1.0), 0.1)
    assert found is not None and len(found[1]) == LIMITS.directions


def matrix_of(dense: np.ndarray) -> PETSc.Mat:
    result = PETSc.Mat().createDense(dense.shape, array=np.asfortranarray(dense), comm=MPI.COMM_SELF)
    result.assemble()
    return result


@pytest.mark.parametrize("stiffness", [1e-3, 1e5])
def test_a_body_with_springs_is_inverted_exactly(stiffness: float) -> None:
    """With P = K^-1 the preconditioner is the inverse of K + U S U^T."""
    n, m = 30, 4
    root = random_array((n, n), density=0.3, rng=RANDOM).toarray()
    K, U = root @ root.T + np.eye(n), RANDOM.normal(size=(n, m))
    S = stiffness * RANDOM.uniform(1, 2, m)
    body = PETSc.PC().create(MPI.COMM_SELF)
    operator = matrix_of(K)
    body.setOperators(operator)
    body.setType("lu")
    body.setUp()
    x, y = operator.createVecs()
    x.array_w[:] = RANDOM.normal(size=n)
    half = [StiffCoupling(operator, U[:, part], S[part]) for part in (slice(0, 1), slice(1, m))]
    WoodburyPreconditioner(body, half, x).apply(body, x, y)
    expected = np.linalg.solve(K + U @ np.diag(S) @ U.T, x.array_r)
    np.testing.assert_allclose(y.array_r, expected, rtol=1e-7, atol=1e-9 * np.abs(expected).max())
