"""Balancing preconditioner of a stiffness between few nodes beside the tangent, against a dense one; its product."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import csr_matrix

from fracsim.mechanics.extra_couplings import FewNodesCoupling
from fracsim.solvers.balancing import solve_nodes_exactly
from support.ranks import Results, run_on_ranks

ON_RANKS = pytest.mark.parametrize("ranks", [1, *(pytest.param(count, marks=pytest.mark.ranks) for count in (2, 3))])
RANDOM = np.random.default_rng(5)


def body_of(nodes: int, d: int) -> Any:
    """A mesh as a coupling needs it: the number of its nodes."""
    numbers = SimpleNamespace(local_range=(0, nodes), size_global=nodes)
    space = SimpleNamespace(dofmap=SimpleNamespace(index_map=numbers))
    return SimpleNamespace(comm=MPI.COMM_SELF, dim=d, node_count=nodes, space=space)


def positive(n: int) -> np.ndarray:
    """(n, n) positive definite matrix."""
    root = RANDOM.normal(size=(n, n))
    return root @ root.T + np.eye(n)


def preconditioned(
    K: np.ndarray, C: np.ndarray, numbers: np.ndarray, d: int, values: np.ndarray, *, must_be_positive: bool = False
) -> np.ndarray:
    """P of `values`, with M = 1 / diag K; nodes have changed, though none more, where P must be positive."""
    n, body = len(K), body_of(len(K) // d, d)
    rows = csr_matrix(K)
    tangent: Any = SimpleNamespace(
        domain=body, owned_rows=lambda nodes: rows[(d * nodes[:, None] + np.arange(d)).reshape(-1)],
        couplings=SimpleNamespace(beside=FewNodesCoupling(body, numbers, csr_matrix(C))),
    )  # fmt: skip
    operator = PETSc.Mat().createDense((n, n), array=np.asfortranarray(K), comm=MPI.COMM_SELF)
    operator.assemble()
    base = PETSc.PC().create(MPI.COMM_SELF)
    base.setOperators(operator)
    base.setType("jacobi")
    base.setUp()
    x, y = operator.createVecs()
    x.array_w[:] = values
    solve_nodes_exactly(base, tangent, np.zeros(0, np.int64) if must_be_positive else None, x).apply(x, y)
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


@pytest.fixture(scope="module")
def plates(tmp_path_factory: pytest.TempPathFactory) -> Results:
    """Results by the number of ranks."""
    return cache(lambda ranks: run_on_ranks("support.balancing", ranks, tmp_path_factory.mktemp("plates")))


@ON_RANKS
def test_contact_beside_the_tangent_is_that_in_it(plates: Results, ranks: int) -> None:
    """Plates pressed together: products are the same, CG converges, and P solves for the coupled nodes exactly."""
    assert plates(ranks)["contact-product"] < 1e-12
    solved_as_on_one_rank(plates, ranks, "contact")


@pytest.mark.fast_solver_only("multigrid of an earlier tangent")
@ON_RANKS
def test_changed_nodes_are_solved_for_with_those_in_contact(plates: Results, ranks: int) -> None:
    """Cells of the plates become stiffer, at nodes in contact and at others. P solves for both kinds exactly."""
    in_contact, has_changed = plates(ranks)["changed-exact"].T > 0
    for nodes in (in_contact & has_changed, in_contact & ~has_changed, has_changed & ~in_contact):
        assert np.count_nonzero(nodes) > 50
    assert not plates(ranks)["contact-exact"][:, 1].any()
    solved_as_on_one_rank(plates, ranks, "changed")


def solved_as_on_one_rank(plates: Results, ranks: int, case: str) -> None:
    """P A x = x at the nodes of P, which are those of one rank, as is the solution."""
    result, serial = plates(ranks), plates(1)
    assert result[f"{case}-iterations"] < 100 and result[f"{case}-solution"] < 1e-5
    assert result[f"{case}-inverse"] < 1e-8
    np.testing.assert_array_equal(result[f"{case}-exact"], serial[f"{case}-exact"])
    x = serial[f"{case}-x"]
    np.testing.assert_allclose(result[f"{case}-x"], x, rtol=0, atol=1e-7 * np.abs(x).max())
