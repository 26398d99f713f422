"""Stiffness between few nodes beside the tangent: its product, and its preconditioner against a dense one."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import csr_matrix

from fracsim.mechanics.extra_couplings import FewNodesCoupling
from fracsim.solvers.coupled_nodes import CoupledNodesPreconditioner
from support.ranks import run_on_ranks

RANDOM = np.random.default_rng(5)


def body_of(nodes: int, d: int) -> Any:
    """A mesh as a coupling needs it: the number of its nodes."""
    numbers = SimpleNamespace(local_range=(0, nodes))
    space = SimpleNamespace(dofmap=SimpleNamespace(index_map=numbers))
    return SimpleNamespace(comm=MPI.COMM_SELF, dim=d, node_count=nodes, space=space)


def positive(n: int) -> np.ndarray:
    """(n, n) positive definite matrix."""
    root = RANDOM.normal(size=(n, n))
    return root @ root.T + np.eye(n)


def preconditioned(
    K: np.ndarray, C: np.ndarray, numbers: np.ndarray, d: int, values: np.ndarray, *, must_be_positive: bool = False
) -> np.ndarray:
    """P of `values`, with M = 1 / diag K."""
    n, body = len(K), body_of(len(K) // d, d)
    rows = csr_matrix(K)
    tangent: Any = SimpleNamespace(
        domain=body, owned_rows=lambda nodes: rows[(d * nodes[:, None] + np.arange(d)).reshape(-1)]
    )
    operator = PETSc.Mat().createDense((n, n), array=np.asfortranarray(K), comm=MPI.COMM_SELF)
    operator.assemble()
    base = PETSc.PC().create(MPI.COMM_SELF)
    base.setOperators(operator)
    base.setType("jacobi")
    base.setUp()
    x, y = operator.createVecs()
    x.array_w[:] = values
    coupling = FewNodesCoupling(body, numbers, csr_matrix(C))
    CoupledNodesPreconditioner(base, coupling, tangent, x, must_be_positive=must_be_positive).apply(base, x, y)
    return np.asarray(y.array_r.copy())


@pytest.mark.parametrize("stiffness", [1e-3, 1e8])
def test_the_preconditioner_is_that_of_dense_matrices(stiffness: float) -> None:
    """Q + (1 - Q A) M (1 - A Q) with M = 1 / diag K, however stiff the coupling is."""
    d, count, numbers = 3, 12, np.array([1, 4, 5, 9])
    n, m = d * count, d * len(numbers)
    K, C, x = positive(n), stiffness * positive(m), RANDOM.normal(size=n)
    y = preconditioned(K, C, numbers, d, x)
    Z = np.zeros((n, m))
    Z[(d * numbers[:, None] + np.arange(d)).reshape(-1), np.arange(m)] = 1.0
    A = K + Z @ C @ Z.T
    Q, one = Z @ np.linalg.inv(Z.T @ A @ Z) @ Z.T, np.eye(n)
    P = Q + (one - Q @ A) @ np.diag(1 / np.diag(K)) @ (one - A @ Q)
    np.testing.assert_allclose(y, P @ x, rtol=0, atol=1e-6 * np.abs(P @ x).max())
    np.testing.assert_allclose(P, P.T, rtol=0, atol=1e-8)


@pytest.mark.parametrize("kind", ["singular", "infinite"])
def test_a_coupling_that_cannot_be_solved_for_is_left_to_the_body(kind: str) -> None:
    """P = M where K + C of the coupled nodes is 0, or C is not finite as that of a gap of 0."""
    d, numbers, K, x = 2, np.array([0, 2]), positive(6), RANDOM.normal(size=6)
    dofs = (d * numbers[:, None] + np.arange(d)).reshape(-1)
    C = -K[np.ix_(dofs, dofs)] if kind == "singular" else np.full((4, 4), np.inf)
    np.testing.assert_allclose(preconditioned(K, C, numbers, d, x), x / np.diag(K), rtol=1e-12)


@pytest.mark.parametrize("shift", [1.01, 0.99])
def test_nodes_with_an_indefinite_stiffness_end_cg(shift: float) -> None:
    """P = -M, where that is asked for, once K + C of the nodes has a negative eigenvalue, and not before."""
    d, numbers, K, x = 2, np.array([0, 2]), positive(6), RANDOM.normal(size=6)
    dofs = (d * numbers[:, None] + np.arange(d)).reshape(-1)
    C = -shift * np.linalg.eigvalsh(K[np.ix_(dofs, dofs)])[0] * np.eye(4)
    found = preconditioned(K, C, numbers, d, x, must_be_positive=True)
    exact = preconditioned(K, C, numbers, d, x)
    np.testing.assert_allclose(found, -x / np.diag(K) if shift > 1 else exact, rtol=1e-12)


def test_prescribed_dofs_are_not_coupled() -> None:
    d, numbers = 2, np.array([0, 2])
    K, x, y = positive(4), RANDOM.normal(size=6), np.zeros(6)
    body = body_of(3, d)
    coupling = FewNodesCoupling(body, numbers, csr_matrix(K)).without_dofs(body, np.array([1]))
    coupling.add_product(x, y)
    free = [0, 2, 3]  # of the coupled dofs 0, 1, 4, 5
    expected = np.zeros(4)
    expected[free] = K[np.ix_(free, free)] @ x[[0, 4, 5]]
    np.testing.assert_allclose(y, [*expected[:2], 0, 0, *expected[2:]], rtol=1e-12)


@pytest.mark.parametrize("ranks", [1, *(pytest.param(count, marks=pytest.mark.ranks) for count in (2, 3))])
def test_contact_beside_the_tangent_is_that_in_it(ranks: int, tmp_path: Path) -> None:
    """Plates pressed together: products are the same, CG converges, and P solves for the coupled nodes exactly."""
    result = run_on_ranks("support.coupled_nodes", ranks, tmp_path)
    assert result["coupled"] > 200 and result["iterations"] < 100
    assert result["product"] < 1e-12 and result["inverse"] < 1e-8
    assert result["solution"] < 1e-5
