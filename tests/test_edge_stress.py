"""Stress along edges against the matrix T of M22 (with the factor 2 on shear) written out and inverted."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fracsim.forms.kinematics import SYMMETRIC_COMPONENTS
from fracsim.fracture.edge_stress import EdgeStressOperator, normal_stress_bound
from fracsim.mesh.simplices import local_edges
from fracsim.mesh.small_matrices import barycentric_gradients
from support.laws import T_stress, Tensor, rotation

EPS = np.finfo(float).eps
DIMS = (2, 3)


def simplex(dim: int, seed: int) -> Tensor:
    """Corners of a random simplex that is not too flat: the unit simplex under a well-conditioned map."""
    random = np.random.default_rng(seed)
    unit = np.vstack([np.zeros(dim), np.eye(dim)])
    F = rotation(dim, seed) @ np.diag(random.uniform(0.3, 3, dim)) @ rotation(dim, seed + 1)
    return unit @ F.T + random.uniform(-5, 5, dim)


def stress_components(dim: int, seed: int) -> Tensor:
    """Random symmetric tensor: xx, yy, xy or xx, yy, zz, xy, xz, yz."""
    return np.random.default_rng(seed).uniform(-1, 1, 3 if dim == 2 else 6)


def as_matrix(components: Tensor) -> Tensor:
    """The tensor of its components."""
    if len(components) == 3:
        xx, yy, xy = components
        return np.array([[xx, xy], [xy, yy]])
    xx, yy, zz, xy, xz, yz = components
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def normal_stress(components: Tensor, corners: Tensor) -> Tensor:
    """(n, k) of simplices with (n, d + 1, d) corners under (n, 3 or 6) stress."""
    return simplices(corners).normal_stress(np.arange(len(corners)), components)


def carried_by(components: Tensor, corners: Tensor, intact: Tensor) -> Tensor:
    """(n, 3 or 6) what the edges of simplices carry that are (n, k) intact, whether they hold them together or not."""
    n, k = intact.shape
    pattern = (~intact @ (1 << np.arange(k))).astype(np.uint8)
    edges = np.arange(n * k, dtype=np.int32).reshape(n, k)
    damage = SimpleNamespace(
        cell_edges=edges, integrity=intact.ravel().astype(float), pattern=pattern, damaged=np.ones(n, bool),
        split=np.zeros(n, bool),
    )  # fmt: skip
    return simplices(corners).intact_edge_stress(components, damage)


def simplices(corners: Tensor) -> EdgeStressOperator:
    """Those of (n, d + 1, d) corners, half of the way to which they have moved."""
    nodes = np.arange(corners.size // corners.shape[2], dtype=np.int32).reshape(corners.shape[:2])
    rest = np.ascontiguousarray(corners.reshape(-1, corners.shape[2]) / 2)
    return EdgeStressOperator(nodes, rest, rest.copy())


def flags_of(patterns: Tensor, edges: int) -> Tensor:
    """(patterns, edges) which edges are intact."""
    return (patterns[:, None] >> np.arange(edges)) & 1 == 0


@pytest.mark.parametrize("dim", DIMS)
@given(seed=st.integers(0, 10**6))
def test_normal_stress_is_n_sigma_n(dim: int, seed: int) -> None:
    """n . sigma . n by matrix products, edge by edge."""
    corners, components = simplex(dim, seed), stress_components(dim, seed)
    found = normal_stress(components[None], corners[None])[0]
    sigma = as_matrix(components)
    for (i, j), value in zip(local_edges(dim), found, strict=True):
        n = (corners[j] - corners[i]) / np.linalg.norm(corners[j] - corners[i])
        assert value == pytest.approx(n @ sigma @ n, abs=20 * EPS)


@pytest.mark.parametrize("dim", DIMS)
@given(seed=st.integers(0, 10**6))
def test_carried_stress_is_the_dense_projection(dim: int, seed: int) -> None:
    """T^-1 diag(integrity) T sigma for all 8 or 64 patterns; round-off grows with the condition of T."""
    corners, components = simplex(dim, seed), stress_components(dim, seed)
    T = T_stress(corners)
    intact = flags_of(np.arange(1 << len(T)), len(T))
    n = len(intact)
    found = carried_by(np.tile(components, (n, 1)), np.tile(corners, (n, 1, 1)), intact)
    expected = np.array([np.linalg.solve(T, np.where(flags, T @ components, 0.0)) for flags in intact])
    np.testing.assert_allclose(found, expected, atol=100 * EPS * np.linalg.cond(T))


@pytest.mark.parametrize("dim", DIMS)
@given(seed=st.integers(0, 10**6), pattern=st.integers(0, 63))
def test_intact_edges_keep_their_stress(dim: int, seed: int, pattern: int) -> None:
    """Along intact edges the carried stress is the full one, along broken ones zero (docs/theory.md#edge-criterion)."""
    corners, components = simplex(dim, seed)[None], stress_components(dim, seed)[None]
    intact = flags_of(np.array([pattern]), len(local_edges(dim)))
    kept = normal_stress(carried_by(components, corners, intact), corners)
    expected = np.where(intact, normal_stress(components, corners), 0.0)
    np.testing.assert_allclose(kept, expected, atol=100 * EPS * np.linalg.cond(T_stress(corners[0])))


@pytest.mark.parametrize("dim", DIMS)
def test_edge_stress_turns_with_the_body(dim: int) -> None:
    """n . sigma . n does not change where edge and stress are turned together."""
    corners, components, Q = simplex(dim, 3), stress_components(dim, 3), rotation(dim, 5)
    turned = Q @ as_matrix(components) @ Q.T
    upper = ((0, 0), (1, 1), (0, 1)) if dim == 2 else ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    after = normal_stress(np.array([[turned[i, j] for i, j in upper]]), (corners @ Q.T)[None])
    np.testing.assert_allclose(after, normal_stress(components[None], corners[None]), atol=50 * EPS)


@pytest.mark.parametrize("dim", DIMS)
def test_barycentric_gradients(dim: int) -> None:
    """They sum to zero and their coordinates are 1 at the own corner and 0 at the others."""
    corners = simplex(dim, 11)
    gradients = barycentric_gradients(corners[None])[0]
    np.testing.assert_allclose(gradients.sum(axis=0), 0, atol=50 * EPS)
    values = (corners[:, None] - corners[None]) @ gradients.T  # lambda_k(x_i) - lambda_k(x_j)
    identity = np.eye(dim + 1)
    np.testing.assert_allclose(values, identity[:, None] - identity[None], atol=100 * EPS)


@pytest.mark.parametrize("dim", DIMS)
def test_no_direction_is_pulled_harder(dim: int) -> None:
    """Against the eigenvalues: a bound of the largest; the largest of an average is at most the average of bounds.

    In 3D it is near where two principal stresses are equal, and exact to round-off elsewhere.
    """
    stress = np.array([stress_components(dim, seed) for seed in range(200)])
    pull, principal = normal_stress_bound(stress, dim), np.linalg.eigvalsh([as_matrix(each) for each in stress])
    largest, deviator = np.maximum(principal[:, -1], 0), principal - principal.mean(axis=1, keepdims=True)
    p = np.linalg.norm(deviator, axis=1) / np.sqrt(6)
    assert np.all(pull >= largest - 8 * EPS) and np.all(pull <= largest + 0.06 * p)
    distinct = np.full(len(stress), True) if dim == 2 else np.prod(deviator, axis=1) > -(p**3)
    np.testing.assert_allclose(pull[distinct], largest[distinct], rtol=0, atol=1e-10)
    n = rotation(dim, 3)[0]
    single = [3.0 * n[i] * n[j] for i, j in SYMMETRIC_COMPONENTS[dim]]
    np.testing.assert_allclose(normal_stress_bound(np.array([single]), dim), 3.0, rtol=1e-11)
    equal = np.array([[1.0] * dim + [0.0] * (len(single) - dim), [2.0, 2.0, *np.zeros(len(single) - 2)]])
    bounds = normal_stress_bound(equal, dim)
    assert np.all(bounds >= [1.0, 2.0]) and np.all(bounds <= [1.0 + 1e-11, 2.0 + 0.06 * 2 / 3])
    shares = np.random.default_rng(5).dirichlet(np.ones(len(stress)), 50)
    of_average = np.linalg.eigvalsh([as_matrix(each) for each in shares @ stress])[:, -1]
    assert np.all(of_average <= shares @ pull + 8 * EPS)


def test_flat_cells_carry_nothing() -> None:
    """A collapsed cell has no T^-1: it carries no stress, and its neighbours in the array are not disturbed."""
    good = simplex(3, 1)
    flat = good.copy()
    flat[3] = flat[:3].mean(axis=0)
    corners, components = np.array([good, flat]), np.tile(stress_components(3, 1), (2, 1))
    found = carried_by(components, corners, np.ones((2, 6), bool))
    np.testing.assert_allclose(found[0], components[0], atol=1000 * EPS)
    assert not found[1].any()
