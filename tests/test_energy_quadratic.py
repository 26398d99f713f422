"""[fracture] energy with quadratic displacement: what is made at points of cells, against integrals over the cells, and
the force on a tip against K in closed form."""

from __future__ import annotations

import basix
import numpy as np
import numpy.typing as npt
import pytest
from mpi4py import MPI

from fracsim.fracture.energy.tip_fields import GradientOperators
from fracsim.mesh.domain import Domain, distribute
from fracsim.mesh.small_matrices import barycentric_gradients
from fracsim.meshes import BUILDERS
from support.notched import POISSON, STIFF, YOUNG, near_tip, plate
from support.squares import KINDS
from support.tips import criterion_of, seen, tips

Values = npt.NDArray[np.float64]


class Parabola:
    """u_i = u0_i + A_ij x_j + x_j B_ijk x_k / 2, some (d, d, d) B that is the same in j and k."""

    def __init__(self, d: int, seed: int) -> None:
        chance = np.random.default_rng(seed)
        self.A, B = chance.standard_normal((d, d)), chance.standard_normal((d, d, d))
        self.B, self.u0 = B + B.transpose(0, 2, 1), chance.standard_normal(d)

    def __call__(self, x: Values) -> Values:
        return np.asarray(self.u0 + x @ self.A.T + np.einsum("...j,ijk,...k->...i", x, self.B, x) / 2)

    def gradient(self, x: Values) -> Values:
        return np.asarray(self.A + np.einsum("ijk,...k->...ij", self.B, x))


def quadrature(domain: Domain, cells: npt.NDArray[np.integer]) -> tuple[Values, Values]:
    """(n, q, d) points in cells and (q,) weights of sum 1, exact for polynomials of degree 6."""
    points, weights = basix.make_quadrature(domain.mesh.basix_cell(), 6)
    share = np.column_stack([1 - points.sum(axis=1), points])
    return np.einsum("qk,nki->nqi", share, domain.nodes[domain.cell_nodes[cells]]), weights / weights.sum()


@pytest.mark.parametrize("d", (2, 3))
def test_a_patch_has_a_parabola_and_its_gradient(d: int) -> None:
    """At its points, which are where it says x is; the mean over them of any product of two gradients is that over the
    cell."""
    domain = distribute(MPI.COMM_SELF, BUILDERS["box"](size=(1.0,) * d, h=0.4, pattern="unstructured").build(), 2)
    cells = np.random.default_rng(3).permutation(domain.cell_count)[:20]
    patch = GradientOperators.of_cells(domain, cells, barycentric_gradients(domain.nodes[domain.cell_nodes[cells]]))
    u = Parabola(d, 1)
    field, x = (
        patch.gather_nodal_values(u(domain.nodes).ravel()),
        patch.evaluate_values(patch.gather_nodal_values(domain.nodes.ravel())),
    )
    H = patch.evaluate_gradients(field)
    np.testing.assert_allclose(patch.evaluate_values(field), u(x), atol=1e-12)
    np.testing.assert_allclose(H, u.gradient(x), atol=1e-11)
    places, weights = quadrature(domain, cells)
    exact = np.einsum("q,nqij,nqkl->nijkl", weights, u.gradient(places), u.gradient(places))
    np.testing.assert_allclose(patch.average_over_points(np.einsum("nij,nkl->nijkl", H, H)), exact, atol=1e-10)


def test_what_a_tip_sees_of_a_cell_is_its_mean() -> None:
    """Sigma + rho v^2 / 2 I, rho (H^T a - (grad v)^T v) and H of a body that is bent and moves: Hooke's law by hand,
    and integrals over each cell."""
    scene = plate("unstructured", 12, order=2, crack=[{"segment": [[0.0, 0.507], [0.5, 0.507]]}])
    domain, u, v, a = scene.domain, *(Parabola(2, seed) for seed in (1, 2, 3))
    v.B[:], a.B[:] = 0.0, 0.0  # products with what is linear are integrated exactly
    scene.balance.set_displacement(u(domain.nodes).ravel())
    criterion_of(scene).set_motion(v(domain.nodes).ravel(), a(domain.nodes).ravel(), 0.0, 1.0)
    look = seen(scene)
    cells = look.neighbourhoods.remote_values.requested
    x, w = quadrature(domain, cells)
    H, chi, rho = u.gradient(x), scene.balance.stress.chi.x.array[cells], 7800.0
    mu, lmbda = YOUNG / 2 / (1 + POISSON), YOUNG * POISSON / (1 + POISSON) / (1 - 2 * POISSON)
    strain = (H + np.swapaxes(H, -1, -2)) / 2
    stress = 2 * mu * strain + lmbda * np.einsum("nqii->nq", strain)[..., None, None] * np.eye(2)
    psi = np.einsum("nqij,nqij->nq", strain, stress) / 2
    moved = rho / 2 * np.einsum("nqi,nqi->nq", v(x), v(x))
    elastic = psi[..., None, None] * np.eye(2) - np.einsum("nqji,nqjk->nqik", H, stress)
    expected = np.einsum("q,nqij->nij", w, elastic + moved[..., None, None] * np.eye(2))
    whole = chi == 1
    assert whole.any() and not whole.all()
    np.testing.assert_allclose(look.sigma[whole], expected[whole], rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    np.testing.assert_array_equal(look.sigma[~whole], 0.0)
    push = rho * np.einsum("q,nqi->ni", w, np.einsum("nqji,nqj->nqi", H, a(x)) - np.einsum("ji,nqj->nqi", v.A, v(x)))
    np.testing.assert_allclose(look.inertia[whole], push[whole], atol=1e-9 * np.abs(push).max())
    np.testing.assert_allclose(look.H, np.einsum("q,nqij->nij", w, H), atol=1e-11)


@pytest.mark.parametrize("kind", KINDS)
def test_the_force_of_a_body_in_balance(kind: str) -> None:
    """A square whose sides are moved as a crack with K_I = 1 to its middle asks: G = K^2 / E' of three cracks on the
    mean to 5 %; of one, which ends somewhere in a cell, to 9 %."""
    found = []
    for n, at in ((24, 0.507), (24, 0.532), (32, 0.507)):
        scene = plate(
            kind, n, order=2, crack=[{"segment": [[0.0, at], [0.5, at]]}],
            boundary=[{"on": side, "fix": "xy"} for side in ("left", "right", "bottom", "top")],
            time={"scheme": "quasi-static", "step": 1.0, "end": 1.0},
        )  # fmt: skip
        motion, criterion = scene.balance.motion, criterion_of(scene)
        u = near_tip(scene.domain.nodes - tips(scene)[0], 1.0, 0.0).ravel()
        criterion.toughness, motion.displacements_at = np.inf, lambda t, u=u, dofs=motion.dofs: u[dofs]
        scene.stepper.advance(scene.start())
        found.append(seen(scene).evaluate_forces()[0] @ [STIFF, 0.0])
    assert np.mean(found) == pytest.approx(1.0, abs=0.05)
    assert min(found) > 0.91 and max(found) < 1.09
