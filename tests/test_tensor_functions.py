"""Spectra and powers of symmetric tensors against LAPACK, repeated eigenvalues above all."""

from __future__ import annotations

import numpy as np
import pytest

from fracsim.mechanics.tensor_functions import Values, deviatoric_power, eigenvalues, multiply_unimodular
from support.laws import rotation

EPS = np.finfo(float).eps
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
SPECTRA = {
    "apart": (1.5, 1.0, 0.4),
    "far apart": (30.0, 1.0, 0.02),
    "small strain": (1.002, 1.0, 0.999),
    "two upper": (1.3, 1.3, 0.7),
    "two lower": (1.3, 0.7, 0.7),
    "nearly two": (1.3, 0.7 * (1 + 1e-9), 0.7),
    "one digit apart": (1.3, 0.7 * (1 + EPS), 0.7),
    "three": (1.2, 1.2, 1.2),
    "nearly three": (1.2 * (1 + 1e-12), 1.2, 1.2 * (1 - 3e-13)),
    "identity": (1.0, 1.0, 1.0),
}


def tensors(spectrum: tuple[float, ...]) -> tuple[Values, Values]:
    """((n, 3, 3), (6, n)) of tensors with the given eigenvalues along random axes, and along the coordinates."""
    Q = np.array([np.eye(3), *(rotation(3, seed) for seed in range(30))])
    A = np.einsum("nij,j,nkj->nik", Q, np.array(spectrum), Q)
    A = (A + A.transpose(0, 2, 1)) / 2
    return A, np.array([A[:, i, j] for i, j in PAIRS])


@pytest.mark.parametrize("spectrum", SPECTRA.values(), ids=SPECTRA)
def test_eigenvalues(spectrum: tuple[float, ...]) -> None:
    """Falling; a double root is known to sqrt(eps) only, which the power below does not feel."""
    A, C = tensors(spectrum)
    found = eigenvalues(C)
    assert np.all(np.diff(found, axis=0) <= EPS * max(spectrum))
    np.testing.assert_allclose(found[::-1].T, np.linalg.eigvalsh(A), atol=5 * np.sqrt(EPS) * max(spectrum))


@pytest.mark.parametrize("exponent", (-0.5, -0.01, 0.0, 1.0))
@pytest.mark.parametrize("spectrum", SPECTRA.values(), ids=SPECTRA)
def test_powers(spectrum: tuple[float, ...], exponent: float) -> None:
    """(C / det^(1/3))^p to round-off times the condition of C, whether eigenvalues are apart, close or equal."""
    A, C = tensors(spectrum)
    values = eigenvalues(C)
    logs = np.log(values)
    found = deviatoric_power(C, values, logs - logs.mean(axis=0), np.full(C.shape[1], exponent))
    w, V = np.linalg.eigh(A)
    scaled = (w / np.cbrt(np.prod(w, axis=1))[:, None]) ** exponent
    expected = np.einsum("nij,nj,nkj->nik", V, scaled, V)
    scale = 50 * EPS * max(spectrum) / min(spectrum) * scaled.max()
    np.testing.assert_allclose(found, [expected[:, i, j] for i, j in PAIRS], atol=scale)


@pytest.mark.parametrize("least", (1e-16, 1e-20, 0.0))
def test_a_tensor_that_is_all_but_singular(least: float) -> None:
    """Its eigenvalues are positive, and its powers numbers, whatever round-off has made of the smallest one."""
    _, C = tensors((1.0, 0.5, least))
    values = eigenvalues(C)
    assert np.all(values > 0)
    np.testing.assert_allclose(values[:2].T, np.tile([1.0, 0.5], (C.shape[1], 1)), atol=1e-14)
    logs = np.log(values)
    assert np.isfinite(deviatoric_power(C, values, logs - logs.mean(axis=0), np.full(C.shape[1], -0.5))).all()


@pytest.mark.parametrize("stretch", (1e3, 1e6, 1e9, 1e12))
def test_products_whose_determinant_is_round_off(stretch: float) -> None:
    """A stretch and its inverse in other planes: by what cancels in the determinant nothing is scaled."""
    _, S = tensors((1.5, 1.0, 1 / 1.5))
    Q = np.array([rotation(3, seed) for seed in range(S.shape[1])])
    A = np.einsum("nij,j,nkj->nik", Q, np.array([stretch, 1.0, 1 / stretch]), Q[::-1])
    found = multiply_unimodular(A.reshape(-1, 9).T, S).T.reshape(-1, 3, 3)
    product = A @ tensors((1.5, 1.0, 1 / 1.5))[0]
    np.testing.assert_allclose(found, product, atol=5e-2 * stretch)


def test_products_have_determinant_one() -> None:
    """A S scaled by det^(-1/3)."""
    random = np.random.default_rng(0)
    A = np.eye(3) + 0.3 * random.uniform(-1, 1, (20, 3, 3))
    S, components = tensors((1.5, 1.0, 0.4))
    product = A @ S[:20]
    found = multiply_unimodular(A.reshape(-1, 9).T, components[:, :20]).T.reshape(-1, 3, 3)
    np.testing.assert_allclose(found, product / np.cbrt(np.linalg.det(product))[:, None, None], atol=50 * EPS)
    np.testing.assert_allclose(np.linalg.det(found), 1, atol=20 * EPS)
