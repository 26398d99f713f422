"""Elastic energies against Hooke's law, frame indifference, finite differences and independent NumPy formulas."""

from __future__ import annotations

import subprocess
import sys
from itertools import product

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import polar

from fracsim.forms.energies import ENERGIES, Energy, SaintVenantKirchhoff, lame, plane_stress_lambda
from support.laws import Law, Tensor, law_of, rotation

YOUNG, POISSON = 3.0, 0.3
MU, LAMBDA = YOUNG / (2 * (1 + POISSON)), YOUNG * POISSON / ((1 + POISSON) * (1 - 2 * POISSON))
LAMBDA_STAR = 2 * LAMBDA * MU / (LAMBDA + 2 * MU)
EPS = np.finfo(float).eps

# name -> (law, d, mu, lambda in effect): every energy in 3D and plane strain, and plane stress where it is offered
CASES = {f"{name}-{d}d": (name, d, False) for name, d in product(ENERGIES, (2, 3))}
CASES |= {f"{name}-plane-stress": (name, 2, True) for name in ("linear", "stvk")}
NONLINEAR = {key: case for key, case in CASES.items() if case[0] != "linear"}


def make_energy(name: str, reduced: bool = False) -> Energy:
    return ENERGIES[name](MU, LAMBDA_STAR if reduced else LAMBDA, reduced)


def make_law(case: tuple[str, int, bool]) -> tuple[Law, int, float]:
    """(law, dimension, its lambda)."""
    name, dim, reduced = case
    return law_of(make_energy(name, reduced), dim), dim, LAMBDA_STAR if reduced else LAMBDA


def hooke(lmbda: float, strain: Tensor) -> Tensor:
    """2 mu eps + lambda tr(eps) I."""
    return 2 * MU * strain + lmbda * np.trace(strain) * np.eye(len(strain))


def embedded(F: Tensor, out_of_plane: float = 1.0) -> Tensor:
    """F with the out-of-plane stretch."""
    return F if len(F) == 3 else np.block([[F, np.zeros((2, 1))], [np.zeros((1, 2)), np.full((1, 1), out_of_plane)]])


def matrices(dim: int) -> st.SearchStrategy[npt.NDArray[np.float64]]:
    """d x d matrices with entries in [-1, 1]."""
    return arrays(float, (dim, dim), elements=st.floats(-1, 1, width=32))


def near_identity(H: Tensor) -> Tensor:
    """F = I + H/4: Gershgorin keeps it regular and orientation-preserving in 2D and 3D (row sums of |H|/4 below 1)."""
    return np.eye(len(H)) + H / 4


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_rest_has_neither_energy_nor_stress(case: tuple[str, int, bool]) -> None:
    """psi(I) = 0 and P(I) = 0, to the round-off of terms of the size of the moduli."""
    law, dim, _ = make_law(case)
    assert law.psi(np.eye(dim)) == pytest.approx(0, abs=50 * EPS * YOUNG)
    np.testing.assert_allclose(law.P(np.eye(dim)), 0, atol=50 * EPS * YOUNG)


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
@pytest.mark.parametrize("seed", range(3))
def test_small_strain_is_hookes_law(case: tuple[str, int, bool], seed: int) -> None:
    """(psi(I + t H) + psi(I - t H)) / t^2 -> eps : C : eps, the odd terms cancelling: error O(t^2)."""
    law, dim, lmbda = make_law(case)
    H = np.random.default_rng(seed).uniform(-1, 1, (dim, dim))
    strain, t = (H + H.T) / 2, 1e-3
    expected = np.sum(strain * hooke(lmbda, strain))
    measured = (law.psi(np.eye(dim) + t * H) + law.psi(np.eye(dim) - t * H)) / t**2
    assert measured == pytest.approx(expected, rel=100 * t**2)
    stress = (law.P(np.eye(dim) + t * H) - law.P(np.eye(dim) - t * H)) / (2 * t)
    np.testing.assert_allclose(stress, hooke(lmbda, strain), atol=100 * t**2 * YOUNG)


@pytest.mark.parametrize("case", NONLINEAR.values(), ids=NONLINEAR)
@given(data=st.data(), seed=st.integers(0, 10**6))
def test_energy_is_indifferent_to_rotation(case: tuple[str, int, bool], data: st.DataObject, seed: int) -> None:
    """psi(Q F) = psi(F) for rotations Q."""
    law, dim, _ = make_law(case)
    F = near_identity(data.draw(matrices(dim)))
    assert law.psi(rotation(dim, seed) @ F) == pytest.approx(law.psi(F), abs=1000 * EPS * YOUNG)


@pytest.mark.parametrize("dim", (2, 3))
@given(data=st.data(), seed=st.integers(0, 10**6))
def test_neo_hookean_is_indifferent_to_rotation_when_inverted(dim: int, data: st.DataObject, seed: int) -> None:
    """The same for every F, also singular and inverted ones: this energy is finite there."""
    law = law_of(make_energy("neo-hookean"), dim)
    F = 3 * data.draw(matrices(dim))
    scale = YOUNG * (1 + np.linalg.norm(F)) ** (2 * dim)
    assert law.psi(rotation(dim, seed) @ F) == pytest.approx(law.psi(F), abs=100 * EPS * scale)


def test_the_linear_energy_is_not_indifferent() -> None:
    """A quarter turn has sym(F) - I = -I and so the energy (2 mu + 2 lambda) of it: why linear is for small
    rotations."""
    quarter = np.array([[0.0, -1.0], [1.0, 0.0]])
    expected = MU * 2 + LAMBDA / 2 * 4
    assert law_of(make_energy("linear"), 2).psi(quarter) == pytest.approx(expected, rel=10 * EPS)


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
@pytest.mark.parametrize("seed", range(3))
def test_stress_is_the_derivative_of_the_energy(case: tuple[str, int, bool], seed: int) -> None:
    """P : H against central differences of psi with the optimal step eps^(1/3): error O(eps^(2/3)).

    For the corotated energy R follows F in the difference: P with the lagged R is exact, not an approximation.
    """
    law, dim, _ = make_law(case)
    random = np.random.default_rng(seed)
    F, H = near_identity(random.uniform(-1, 1, (dim, dim))), random.uniform(-1, 1, (dim, dim))
    t = EPS ** (1 / 3)
    difference = (law.psi(F + t * H) - law.psi(F - t * H)) / (2 * t)
    assert np.sum(law.P(F) * H) == pytest.approx(difference, abs=100 * t**2 * YOUNG)


@pytest.mark.parametrize("dim", (2, 3))
@given(data=st.data())
def test_stvk_stress(dim: int, data: st.DataObject) -> None:
    """P = F (2 mu E + lambda tr(E) I) with E = (F^T F - I) / 2; plane strain is the in-plane block at F33 = 1."""
    F = embedded(near_identity(data.draw(matrices(dim))))
    expected = F @ hooke(LAMBDA, (F.T @ F - np.eye(3)) / 2)
    law = law_of(make_energy("stvk"), dim)
    np.testing.assert_allclose(law.P(F[:dim, :dim]), expected[:dim, :dim], atol=200 * EPS * YOUNG)


@pytest.mark.parametrize("dim", (2, 3))
@given(data=st.data())
def test_corotated_stress(dim: int, data: st.DataObject) -> None:
    """P = R (2 mu (U - I) + lambda tr(U - I) I) with F = R U by SciPy."""
    F = near_identity(data.draw(matrices(dim)))
    R, U = polar(F)
    expected = R @ hooke(LAMBDA, U - np.eye(dim))
    np.testing.assert_allclose(law_of(make_energy("corotated"), dim).P(F), expected, atol=200 * EPS * YOUNG)


def neo_hookean_psi(F: Tensor) -> float:
    """M22 eq. 25 as printed, with mu = 4/3 mu_L, lambda = lambda_L + 5/6 mu_L (docs/theory.md#elastic-energies)."""
    mu, lmbda = 4 / 3 * MU, LAMBDA + 5 / 6 * MU
    alpha = 1 + mu / lmbda - mu / (4 * lmbda)
    trace = np.trace(F.T @ F)
    return mu / 2 * (trace - 3) + lmbda / 2 * (np.linalg.det(F) - alpha) ** 2 - mu / 2 * np.log(trace + 1)


def neo_hookean_P(F: Tensor) -> Tensor:
    """Its derivative by hand: mu (1 - 1/(I_C + 1)) F + lambda (J - alpha) cof F, cof F by cross products of columns."""
    mu, lmbda = 4 / 3 * MU, LAMBDA + 5 / 6 * MU
    alpha = 1 + mu / lmbda - mu / (4 * lmbda)
    a, b, c = F.T
    cofactor = np.column_stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)])
    return mu * (1 - 1 / (np.sum(F * F) + 1)) * F + lmbda * (np.linalg.det(F) - alpha) * cofactor


@pytest.mark.parametrize("dim", (2, 3))
@given(data=st.data())
def test_neo_hookean_is_smith_de_goes_kim(dim: int, data: st.DataObject) -> None:
    """psi - psi(I) of M22 eq. 25 and its stress, for every F, inverted ones included."""
    F = embedded(2 * data.draw(matrices(dim)))
    law, block = law_of(make_energy("neo-hookean"), dim), F[:dim, :dim]
    scale = YOUNG * (1 + np.linalg.norm(F)) ** (2 * dim)
    assert law.psi(block) == pytest.approx(neo_hookean_psi(F) - neo_hookean_psi(np.eye(3)), abs=100 * EPS * scale)
    np.testing.assert_allclose(law.P(block), neo_hookean_P(F)[:dim, :dim], atol=100 * EPS * scale)


@pytest.mark.parametrize("name", ENERGIES)
def test_plane_strain_is_3d_at_unit_thickness_stretch(name: str) -> None:
    """The 2D energy at F is the 3D energy at diag(F, 1), with the same out-of-plane stress."""
    F = near_identity(np.array([[0.3, -0.7], [0.5, -0.4]]))
    flat, solid = law_of(make_energy(name), 2), law_of(make_energy(name), 3)
    assert flat.psi(F) == pytest.approx(solid.psi(embedded(F)), abs=50 * EPS * YOUNG)
    np.testing.assert_allclose(flat.full_cauchy(F), solid.cauchy(embedded(F)), atol=200 * EPS * YOUNG)


def test_linear_plane_stress_is_uniaxial_tension() -> None:
    """Contraction nu e across leaves sigma_yy = 0 and sigma_xx = E e, as in a 3D bar that is free sideways."""
    e = 1e-2
    flat, solid = law_of(make_energy("linear", True), 2), law_of(make_energy("linear"), 3)
    in_plane = np.diag([1 + e, 1 - POISSON * e])
    np.testing.assert_allclose(flat.P(in_plane), np.diag([YOUNG * e, 0]), atol=50 * EPS * YOUNG)
    bar = np.diag([1 + e, 1 - POISSON * e, 1 - POISSON * e])
    np.testing.assert_allclose(solid.P(bar), np.diag([YOUNG * e, 0, 0]), atol=50 * EPS * YOUNG)
    np.testing.assert_allclose(flat.full_cauchy(in_plane), solid.cauchy(bar), atol=50 * EPS * YOUNG)


@given(H=matrices(2))
def test_stvk_plane_stress_is_3d_without_stress_across(H: Tensor) -> None:
    """S33 = 0 gives E33 = -lambda/(lambda + 2 mu) tr(E): at that stretch the 3D Cauchy stress is the 2D one and s33 =
    0."""
    F = np.eye(2) + H / 8
    trace = np.trace(F.T @ F - np.eye(2)) / 2
    F33 = np.sqrt(1 - 2 * LAMBDA / (LAMBDA + 2 * MU) * trace)
    expected = law_of(make_energy("stvk"), 3).cauchy(embedded(F, F33))
    assert expected[2, 2] == pytest.approx(0, abs=200 * EPS * YOUNG)
    flat = law_of(make_energy("stvk", True), 2)
    np.testing.assert_allclose(flat.full_cauchy(F), expected, atol=500 * EPS * YOUNG)


def test_lame_parameters_are_those_of_a_bar() -> None:
    """E = mu (3 lambda + 2 mu) / (lambda + mu) and nu = lambda / (2 (lambda + mu)), back from Lame's."""
    mu, lmbda = lame(210e9, 0.28)
    assert mu * (3 * lmbda + 2 * mu) / (lmbda + mu) == pytest.approx(210e9, rel=10 * EPS)
    assert lmbda / (2 * (lmbda + mu)) == pytest.approx(0.28, rel=10 * EPS)
    # plane stress: E / (1 - nu^2) is the modulus 2 mu + lambda* of a strip that cannot contract in its plane
    assert 2 * mu + plane_stress_lambda(mu, lmbda) == pytest.approx(210e9 / (1 - 0.28**2), rel=10 * EPS)


@pytest.mark.parametrize("case", NONLINEAR.values(), ids=NONLINEAR)
@pytest.mark.parametrize("seed", range(3))
def test_cauchy_stress_is_symmetric_and_objective(case: tuple[str, int, bool], seed: int) -> None:
    """sigma = sigma^T (balance of moments) and sigma(Q F) = Q sigma(F) Q^T (the stress turns with the body)."""
    law, dim, _ = make_law(case)
    F = near_identity(np.random.default_rng(seed).uniform(-1, 1, (dim, dim)))
    Q, sigma = rotation(dim, seed), law.cauchy(F)
    np.testing.assert_allclose(sigma, sigma.T, atol=500 * EPS * YOUNG)
    np.testing.assert_allclose(law.cauchy(Q @ F), Q @ sigma @ Q.T, atol=500 * EPS * YOUNG)


def test_stvk_cauchy_stress_is_the_push_forward() -> None:
    """sigma = J^-1 F S F^T."""
    F = near_identity(np.random.default_rng(7).uniform(-1, 1, (3, 3)))
    S = hooke(LAMBDA, (F.T @ F - np.eye(3)) / 2)
    expected = F @ S @ F.T / np.linalg.det(F)
    np.testing.assert_allclose(law_of(SaintVenantKirchhoff(MU, LAMBDA), 3).cauchy(F), expected, atol=200 * EPS * YOUNG)


def test_forms_need_no_dolfinx() -> None:
    """The mathematics is usable where DOLFINx is not: importing it must not bring it in."""
    modules = ("balance", "energies", "kinematics", "schemes")
    lines = [*(f"import fracsim.forms.{name}" for name in modules), "import sys", "assert 'ufl' in sys.modules"]
    lines += [f"assert {name!r} not in sys.modules" for name in ("dolfinx", "petsc4py", "mpi4py", "gmsh")]
    subprocess.run([sys.executable, "-c", "; ".join(lines)], check=True, timeout=60)
