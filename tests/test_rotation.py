"""The polar rotation of many cells at once, in array code and compiled, against SciPy and what defines it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from mpi4py import MPI
from scipy.linalg import polar

from fracsim.mechanics.polar_rotation import compiled_polar_rotation
from fracsim.mesh.small_matrices import polar_rotation
from support.laws import Tensor, rotation

EPS = np.finfo(float).eps


def compiled(F: Tensor) -> Tensor:
    """Rotations by the compiled function."""
    function = compiled_polar_rotation(MPI.COMM_SELF, F.shape[1])
    assert function is not None
    return function(F)


each_implementation = pytest.mark.parametrize("rotations", (polar_rotation, compiled), ids=("array", "compiled"))


def stretched(dim: int, seed: int, stretches: list[float]) -> Tensor:
    """Q1 diag(stretches) Q2 with random rotations: singular values and handedness as given."""
    return rotation(dim, seed) @ np.diag(stretches[:dim]) @ rotation(dim, seed + 1)


def is_rotation(R: Tensor) -> bool:
    """R^T R = I and det R = 1, to round-off."""
    identity = np.eye(R.shape[1])
    orthogonal = np.allclose(R.transpose(0, 2, 1) @ R, identity, rtol=0, atol=50 * EPS)
    return bool(orthogonal and np.allclose(np.linalg.det(R), 1, rtol=0, atol=50 * EPS))


@each_implementation
@pytest.mark.parametrize("dim", (2, 3))
@given(
    seed=st.integers(0, 10**6),
    logs=st.lists(st.floats(-1.5, 1.5), min_size=3, max_size=3),
    size=st.floats(-3, 3),
)
def test_regular_cells_agree_with_scipy(
    rotations: Callable[[Tensor], Tensor], dim: int, seed: int, logs: list[float], size: float
) -> None:
    """R of F = R U for stretches over three decades about any size: error eps * condition number."""
    stretches = [10 ** (size + x) for x in logs]
    F = stretched(dim, seed, stretches)
    tolerance = 100 * EPS * max(stretches) / min(stretches)
    np.testing.assert_allclose(rotations(F[None])[0], polar(F)[0], atol=tolerance)


@each_implementation
@pytest.mark.parametrize("dim", (2, 3))
def test_a_rotation_is_its_own(rotations: Callable[[Tensor], Tensor], dim: int) -> None:
    """polar(Q) = Q, for many cells in one call."""
    Q = np.array([rotation(dim, seed) for seed in range(50)])
    np.testing.assert_allclose(rotations(Q), Q, atol=20 * EPS)


@each_implementation
@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize(
    "last", (-1.0, -0.2, -1e-9, 0.0, 1e-9), ids=("reflected", "inverted", "just", "flat", "nearly")
)
def test_inverted_and_flat_cells_get_the_closest_rotation(
    rotations: Callable[[Tensor], Tensor], dim: int, last: float
) -> None:
    """R is a rotation, never a reflection, and no other rotation Q has a larger tr(Q^T F), that is a smaller |F -
    Q|."""
    F = np.array([stretched(dim, seed, [1.3, 0.7, last] if dim == 3 else [1.3, last]) for seed in range(5)])
    R = rotations(F)
    assert is_rotation(R)
    best = np.einsum("nij,nij->n", R, F)
    for seed in range(200):
        assert np.all(np.einsum("ij,nij->n", rotation(dim, seed), F) <= best + 50 * EPS)


@each_implementation
@pytest.mark.parametrize("dim", (2, 3))
def test_hopeless_cells_do_not_spoil_others(rotations: Callable[[Tensor], Tensor], dim: int) -> None:
    """Collapsed and not-a-number cells get some rotation; their neighbours in the array get the right one."""
    good = stretched(dim, 1, [1.1, 0.9, 1.2])
    F = np.array([good, np.zeros((dim, dim)), np.full((dim, dim), np.nan), good])
    R = rotations(F)
    assert is_rotation(R)
    np.testing.assert_allclose(R[[0, 3]], [polar(good)[0]] * 2, atol=20 * EPS)


@each_implementation
def test_no_cells(rotations: Callable[[Tensor], Tensor]) -> None:
    """A rank may own none."""
    assert rotations(np.empty((0, 3, 3))).shape == (0, 3, 3)
