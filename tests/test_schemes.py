"""Time schemes by their protocol alone, on a linear oscillator: order, energy, stability, damping."""

from __future__ import annotations

import numpy as np
import pytest

from fracsim.forms.schemes import BackwardEuler, GeneralizedAlpha, Newmark, QuasiStatic, Scheme
from support.oscillator import Values, exact, run, slopes

pytestmark = pytest.mark.any_release

EPS = np.finfo(float).eps
W, START = 3.0, (0.7, -1.1)

# scheme, order of its global error
ORDERS: list[tuple[Scheme, int]] = [
    (BackwardEuler(), 1),
    (Newmark(), 2),
    (Newmark(0.3025, 0.6), 1),
    (Newmark(1 / 6, 0.5), 2),
    (GeneralizedAlpha(0.5), 2),
    (GeneralizedAlpha(0.0), 2),
]


def energy(rows: Values) -> Values:
    """1/2 v^2 + 1/2 w^2 u^2."""
    return 0.5 * rows[:, 1] ** 2 + 0.5 * W**2 * rows[:, 0] ** 2


@pytest.mark.parametrize(
    ("scheme", "order"),
    ORDERS,
    ids=("euler", "trapezoidal", "dissipative", "linear-acceleration", "alpha", "annihilating"),
)
@pytest.mark.parametrize("damping", (0.0, 0.4))
def test_order_of_convergence(scheme: Scheme, order: int, damping: float) -> None:
    """Errors of u and v at a fixed time fall by 2^order where the step is halved."""
    end, zeta = 2.0, damping / (2 * W)
    errors_u, errors_v = [], []
    for steps in (200, 400, 800, 1600):
        u, v, _ = run(scheme, W, end / steps, steps, START, a=damping)[-1]
        tick = 1e-6
        rate = (exact(W, end + tick, START, zeta) - exact(W, end - tick, START, zeta)) / (2 * tick)
        errors_u.append(abs(u - exact(W, end, START, zeta)))
        errors_v.append(abs(v - rate))
    np.testing.assert_allclose(slopes(errors_u)[-1], order, atol=0.05)
    np.testing.assert_allclose(slopes(errors_v)[-1], order, atol=0.05)


@pytest.mark.parametrize("dt", (0.01, 1.0, 100.0))
def test_trapezoidal_rule_keeps_the_energy(dt: float) -> None:
    """Of a linear system, for every step however large.

    Round-off of 1000 steps: v is a difference of displacements over dt, a another, so eps grows by 1 + 1 / (w dt) or 1
    + w dt.
    """
    E = energy(run(Newmark(), W, dt, 1000, START))
    np.testing.assert_allclose(E, E[0], rtol=1000 * EPS * (1 + W * dt + 1 / (W * dt)) ** 2)


@pytest.mark.parametrize("dt", (0.01, 0.1, 1.0, 100.0))
def test_backward_euler_loses_a_known_share(dt: float) -> None:
    """Its amplification is 1 / (1 - i w dt): the energy falls by 1 / (1 + w^2 dt^2) a step, exactly and
    monotonically."""
    E = energy(run(BackwardEuler(), W, dt, 20, START))
    np.testing.assert_allclose(E[1:] / E[:-1], 1 / (1 + (W * dt) ** 2), rtol=1e-9)


@pytest.mark.parametrize("dt", (0.1, 1.0, 10.0))
def test_dissipative_newmark_is_stable(dt: float) -> None:
    """gamma > 1/2 with beta = (gamma + 1/2)^2 / 4: no growth at any step."""
    E = energy(run(Newmark(0.3025, 0.6), W, dt, 400, START))
    assert E[-1] < E[0]
    assert E[200:].max() < E[:200].max()


@pytest.mark.parametrize("gamma", (0.5, 0.6, 0.8, 1.0))
def test_newmark_is_refused_from_where_long_steps_grow(gamma: float) -> None:
    """At a hundred times the period: at beta = gamma / 2 taken, and no growth; just below refused, with reason."""
    for beta, stable in ((gamma / 2, True), (gamma / 2 - 0.02, False)):
        scheme = Newmark(beta, gamma)
        E = energy(run(scheme, W, 100.0, 60, START))
        if stable:
            scheme.check_parameters()
            assert E[30:].max() < 1.01 * E[:30].max()
        else:
            with pytest.raises(ValueError, match="beta >= gamma / 2"):
                scheme.check_parameters()
            assert E[-1] > 1e2 * E[0]


def test_newmark_is_the_trapezoidal_rule() -> None:
    """u' and v' integrated by trapezia: u1 = u0 + dt/2 (v0 + v1), v1 = v0 + dt/2 (a0 + a1)."""
    dt = 0.3
    u, v, a = run(Newmark(), W, dt, 5, START).T
    np.testing.assert_allclose(np.diff(u), dt / 2 * (v[1:] + v[:-1]), atol=100 * EPS)
    np.testing.assert_allclose(np.diff(v), dt / 2 * (a[1:] + a[:-1]), atol=100 * EPS)


@pytest.mark.parametrize("scheme", (Newmark(), Newmark(0.3025, 0.6)))
def test_newmark_follows_constant_acceleration(scheme: Newmark) -> None:
    """Free fall: u = v0 t + a t^2 / 2 exactly, for any beta and gamma."""
    dt, v0, a = 0.5, 2.0, -9.81
    u, v = 0.0, v0
    for step in range(1, 5):
        c_a, c_v = scheme.rate_coefficients(dt)
        u_a, u_v = scheme.reference_displacements(dt, u, v, a)
        u = u_a + a / c_a
        v = c_v * (u - u_v)
        assert u == pytest.approx(v0 * step * dt + a * (step * dt) ** 2 / 2, rel=100 * EPS)
        assert v == pytest.approx(v0 + a * step * dt, rel=100 * EPS)


def test_quasi_static_has_no_inertia() -> None:
    """The solution is the static one at once; the velocity is the mean of the step."""
    scheme = QuasiStatic()
    assert not scheme.inertia
    c_a, c_v = scheme.rate_coefficients(0.25)
    _, u_v = scheme.reference_displacements(0.25, 3.0, 9.0, 9.0)
    assert c_a == 0.0
    assert c_v * (4.0 - u_v) == pytest.approx(4.0)


@pytest.mark.parametrize("scheme", (BackwardEuler(), Newmark()))
def test_small_steps_keep_their_digits(scheme: Scheme) -> None:
    """A body far from the origin in slow motion: with u / dt^2 summed instead of differences, eps u / dt^2 would swamp
    a."""
    dt, u, v = 1e-7, 1.0, 1e-3
    c_a, c_v = scheme.rate_coefficients(dt)
    u_a, u_v = scheme.reference_displacements(dt, u, v, 0.0)
    new = u + dt * v
    assert c_v * (new - u_v) == pytest.approx(v, abs=4 * EPS * c_v)
    assert c_a * (new - u_a) == pytest.approx(0.0, abs=4 * EPS * c_a)


@pytest.mark.parametrize("rho", (0.2, 0.5, 0.8, 1.0))
def test_generalized_alpha_leaves_rho_of_the_fastest_modes(rho: float) -> None:
    """As w dt grows its amplification matrix gets the triple eigenvalue -rho: the state shrinks by rho a step."""
    rows = run(GeneralizedAlpha(rho), W, 1e6 / W, 200, START)
    size = np.linalg.norm(rows * [1, 1 / W / 1e6, 1 / (W * 1e6) ** 2], axis=1)
    growth = (size[200] / size[100]) ** (1 / 100)
    # a triple eigenvalue lets the state fall as n^2 rho^n only: by (200/100)^(2/100) = 1.014 above rho
    assert rho * 0.99 <= growth <= rho * 1.016
