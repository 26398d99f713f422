"""Barrier, longest step and friction of contact."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

from fracsim.contact import laws
from fracsim.contact.facet_contact import ContactFacets, evaluate_facets
from fracsim.contact.laws import Barrier, CoulombFriction, FrictionDirection, TimeAveragedPotential, tangential
from fracsim.contact.node_contact import StepStart, evaluate_points
from fracsim.contact.pose import Pose, PosedShape
from fracsim.contact.shapes import Capsule, HalfSpace, RoundedBox, Shape, Sphere
from fracsim.contact.step_limit import PointMotion, safe_fractions, safe_motion_fractions
from fracsim.errors import InputError
from support.laws import rotation
from support.shapes import ALL, Values, differences, points

EPS = np.finfo(float).eps
BARRIER = Barrier(stiffness=2e6, width=1e-3)


def test_barrier_by_hand() -> None:
    """b(d / 2) = kappa d ln 2 / 4, b' = -kappa (ln 2 + 1 / 2), b'' = kappa / d (2 ln 2 + 5)."""
    g = np.array([0.5e-3])
    assert BARRIER.energy(g)[0] == pytest.approx(2e6 * 1e-3 * np.log(2) / 4)
    assert BARRIER.slope(g)[0] == pytest.approx(-2e6 * (np.log(2) + 0.5))
    assert BARRIER.curvature(g)[0] == pytest.approx(2e6 / 1e-3 * (2 * np.log(2) + 5))


@given(share=st.floats(1e-6, 1.5).filter(lambda share: abs(share - 1) > 2e-4))
def test_slope_and_curvature_are_derivatives(share: float) -> None:
    """By central differences with a step that suits the gap; not across g = d, where the third derivative jumps."""
    g, h = np.array([[share * BARRIER.width]]), 1e-4 * share * BARRIER.width
    scale = BARRIER.stiffness * max(1.0, 1 / share)
    by = [differences(lambda x, f=f: f(x[:, 0]), g, h)[0, 0] for f in (BARRIER.energy, BARRIER.slope)]
    assert BARRIER.slope(g[0])[0] == pytest.approx(by[0], rel=1e-6, abs=1e-6 * scale)
    assert BARRIER.curvature(g[0])[0] == pytest.approx(by[1], rel=1e-6, abs=1e-6 * scale / share / BARRIER.width)


@given(start=st.floats(1e-4, 2.0), end=st.floats(1e-4, 2.0).filter(lambda share: abs(share - 1) > 2e-3))
def test_along_the_way_it_gives_no_energy(start: float, end: float) -> None:
    """-p (g - g_n), what its force does on a way from g_n to g, is no more than b(g_n) - b(g), and on short ways all of
    it but for a fifth of what the force at the end would lose. p and p' are derivatives of its potential."""
    d = BARRIER.width
    start_gap, g, h = np.array([start * d]), np.array([[end * d]]), 1e-4 * end * d
    along = TimeAveragedPotential(BARRIER, start_gap)
    done = -along.slope(g[0]) * (g[0] - start_gap)
    released = BARRIER.energy(start_gap) - BARRIER.energy(g[0])
    round_off = 1e-12 * (BARRIER.energy(start_gap) + BARRIER.energy(g[0]))
    assert done <= released + round_off
    assert done >= -BARRIER.slope(g[0]) * (g[0] - start_gap) - round_off
    if abs(start - end) < 0.01 * end:
        least = released - 0.21 * (released + BARRIER.slope(g[0]) * (g[0] - start_gap))
        assert done >= least - round_off
    scale = BARRIER.stiffness * max(1.0, 1 / end)
    by = [differences(lambda x, f=f: f(x[:, 0]), g, h)[0, 0] for f in (along.energy, along.slope)]
    if abs((2 * start + end) / 3 - 1) > 2e-3:
        assert along.slope(g[0])[0] == pytest.approx(by[0], rel=1e-6, abs=1e-6 * scale)
        assert along.curvature(g[0])[0] == pytest.approx(by[1], rel=1e-6, abs=1e-6 * scale / end / d)


def test_barrier_is_c2_where_it_begins() -> None:
    """At d (1 - e): b = kappa d e^3, b' = -3 kappa e^2, b'' = 6 kappa e / d to leading order; zero from d on."""
    e = 10.0 ** -np.arange(2, 9)
    g = BARRIER.width * (1 - e)
    got = [BARRIER.energy(g), BARRIER.slope(g), BARRIER.curvature(g)]
    kappa, d = BARRIER.stiffness, BARRIER.width
    for value, expected in zip(got, [kappa * d * e**3, -3 * kappa * e**2, 6 * kappa / d * e], strict=True):
        # e itself carries the round-off of g / d
        np.testing.assert_allclose(value / expected, 1, atol=0.05)
        np.testing.assert_allclose((value / expected)[2:5], 1, atol=2e-3)
    for each in (BARRIER.energy, BARRIER.slope, BARRIER.curvature):
        np.testing.assert_array_equal(each(np.array([d, 2 * d, np.inf])), 0)


def test_closed_gaps_are_infinitely_dear() -> None:
    """Their slopes are finite, but no norm of them is: products with 0 are 0, and no solver takes them."""
    g = np.array([0.0, -1e-3, -np.inf])
    np.testing.assert_array_equal(BARRIER.energy(g), np.inf)
    for law in (BARRIER.slope(g), BARRIER.curvature(g)):
        assert np.isfinite(law).all()
        with np.errstate(over="ignore"):
            assert not np.isfinite(law**2).any()
    assert BARRIER.energy(np.empty(0)).shape == (0,)


@pytest.mark.parametrize("along", (False, True))
def test_a_point_in_an_obstacle_is_pushed_straight_out_of_it(along: bool) -> None:
    """Before a floor: a force in no other direction, and no stiffness that a tangent could hold (with infinities
    0 times infinity would be an invalid value)."""
    x, area = np.array([[0.3, -1e-4], [0.5, 0.5e-3]]), np.array([0.1, 0.2])
    start = StepStart(np.array([0.5e-3, 0.5e-3])) if along else None
    found = evaluate_points(
        x, area, PosedShape(HalfSpace((0.0, 1.0)), Pose.at_point(np.zeros(2))), BARRIER, None, None, np.zeros(2), start
    )
    assert found.energy == np.inf and found.potential == np.inf
    assert (found.normal[:, 0] == 0).all() and found.normal[0, 1] > 1e150 and 0 < found.normal[1, 1] < 1e8
    stiffness = found.tangent(exact=False)
    assert not stiffness[0].any() and stiffness[1, 1, 1] > 0
    facets = ContactFacets(np.array([[0, 1]]), np.array([0.2]), 1e-4)
    inner, stored, _ = evaluate_facets(
        facets, PosedShape(Sphere(0.1, dim=2), Pose.at_point(np.array([0.4, -0.05]))), x, BARRIER
    )
    assert stored == np.inf and np.isfinite(inner.forces).all() and np.isfinite(inner.stiffness).all()


@given(shares=st.lists(st.floats(1e-9, 2), min_size=2, max_size=20))
def test_barrier_pushes_the_more_the_smaller_the_gap(shares: list[float]) -> None:
    """Energy falls, pressure falls, and it is convex."""
    g = np.sort(shares) * BARRIER.width
    assert (np.diff(BARRIER.energy(g)) <= 0).all() and (np.diff(BARRIER.slope(g)) >= 0).all()
    assert (BARRIER.slope(g) <= 0).all() and (BARRIER.curvature(g) >= 0).all()


@pytest.mark.parametrize("wrong", (lambda: Barrier(0.0, 1.0), lambda: Barrier(1.0, np.nan),
                                   lambda: CoulombFriction(-1, 1),
                                   lambda: CoulombFriction(0.3, 0.0)))  # fmt: skip
def test_bad_numbers_are_said(wrong: object) -> None:
    assert callable(wrong)
    with pytest.raises(InputError, match="must be"):
        wrong()


@pytest.mark.parametrize("dim", (2, 3))
@given(seed=st.integers(0, 10**6))
def test_nothing_tunnels_through_a_thin_capsule(dim: int, seed: int) -> None:
    """Fast points through a wire of 1 mm that moves and turns: along all of the share every gap keeps its tenth."""
    rng = np.random.default_rng(seed)
    wire, pose = Capsule(5e-4, 1.0, axis=(0.0, 0.0, 1.0)[-dim:]), Pose.at_point(np.zeros(dim))
    x = rng.uniform(-1, 1, (20, dim))
    x = x[wire.distance(x) > 1e-3]
    target = rng.uniform(-0.5, 0.5, len(x))[:, None] * np.eye(dim)[-1]
    moved = 10 * (target - x)  # aimed at the wire, and far beyond
    q = rng.normal(size=3 if dim == 2 else 6) * rng.choice([0.0, 1.0])
    motion = PointMotion(PosedShape(wire, pose), x, moved, q)
    share = safe_fractions(motion.gap, motion.speed, len(x))
    assert ((share > 0) & (share <= 1)).all()
    assert q.any() or (share < 1).all()  # the wire at rest is hit by all
    now = wire.distance(x)
    for part in np.linspace(0, 1, 300):
        assert (motion.gap(part * share) >= laws.BARRIER.min_gap_ratio * now * (1 - 1e-9)).all()


def still(shape: Shape, x: Values, moved: Values) -> PointMotion:
    """Points that move past an obstacle at rest."""
    return PointMotion(
        PosedShape(shape, Pose.at_point(np.zeros(shape.dim))), x, moved, np.zeros(3 if shape.dim == 2 else 6)
    )


def test_a_point_straight_at_a_plane_goes_nine_tenths() -> None:
    """Gap 1, way 4 down: 0.9 / 4. Away, along, or not at all: the whole."""
    plane, x = HalfSpace((0.0, 1.0)), np.array([[0.0, 1.0]] * 4)
    motion = still(plane, x, np.array([[0.0, -4.0], [0.0, 5.0], [7.0, 0.0], [0.0, 0.0]]))
    np.testing.assert_allclose(safe_fractions(motion.gap, motion.speed, 4), [0.225, 1, 1, 1], rtol=1e-12)


def test_a_free_way_past_a_sphere_is_taken() -> None:
    """A near miss costs looks, not the step; a hit stops short, not far short: the gap is closed to 10 %, up to 1 %."""
    sphere = Sphere(1.0)
    x, moved = np.array([[-2.0, 1.3, 0.0], [-2.0, 0.9, 0.0]]), np.array([[4.0, 0.0, 0.0]] * 2)
    motion = still(sphere, x, moved)
    for speed in (motion.speed, lambda share: np.linalg.norm(moved, axis=1)):  # tangents; 1-Lipschitz alone
        share = safe_fractions(motion.gap, speed, 2)
        assert share[0] == 1 and share[1] < 1
        assert motion.gap(share)[1] == pytest.approx(laws.BARRIER.min_gap_ratio * sphere.distance(x)[1], rel=0.01)


@pytest.mark.parametrize("gap", (1e-3, 1e-6, 1e-9))
def test_what_slides_close_over_a_floor_goes_on(gap: float) -> None:
    """10 mm along the floor, however close: only what comes nearer counts."""
    floor = HalfSpace((0.0, 0.0, 1.0))
    motion = still(floor, np.array([[0.0, 0.0, gap]]), np.array([[1e-2, 0.0, 0.0]]))
    assert safe_fractions(motion.gap, motion.speed, 1)[0] == 1


@pytest.mark.parametrize("shape", ALL.values(), ids=ALL.keys())
@given(seed=st.integers(0, 10**6))
def test_no_gap_closes_faster_than_its_bound(shape: Shape, seed: int) -> None:
    """d(s') >= d(s) - speed(s) (s' - s) for s' > s while points and obstacle move, the latter turning a lot or not."""
    rng, d = np.random.default_rng(seed), shape.dim
    pose = Pose(rng.uniform(-1, 1, d), rotation(d, seed))
    q = rng.normal(size=3 if d == 2 else 6)
    q[d:] *= seed % 2
    x, moved = points(shape, 30, seed), rng.normal(size=(30, d))
    motion, shares = PointMotion(PosedShape(shape, pose), x, moved, q), np.linspace(0, 1, 11)
    gaps = np.array([PosedShape(shape, pose.incremented(s * q)).distance(x + s * moved) for s in shares])
    np.testing.assert_allclose([motion.gap(np.full(30, s)) for s in shares], gaps, atol=1e-13)
    for at, s in enumerate(shares):
        least = gaps[at] - motion.speed(np.full(30, s)) * (shares[at:, None] - s)
        assert (gaps[at:] >= least - 1e-12).all()


def test_closed_gaps_have_no_safe_share() -> None:
    with pytest.raises(ValueError, match="1 gaps are closed before the motion"):
        safe_fractions(lambda s: np.array([1.0, 0.0]), np.ones_like, 2)
    assert safe_fractions(lambda s: s, np.ones_like, 0).shape == (0,)


def test_a_container_keeps_what_is_in_it() -> None:
    """Points flung in a closed box stay in it."""
    room, rng = RoundedBox((1.0, 1.0, 1.0), hollow=True), np.random.default_rng(0)
    motion = still(room, rng.uniform(-0.45, 0.45, (200, 3)), rng.normal(size=(200, 3)) * 5)
    share = safe_fractions(motion.gap, motion.speed, 200)
    assert (motion.gap(share) >= laws.BARRIER.min_gap_ratio * room.distance(motion.x) * (1 - 1e-9)).all()


FRICTION = CoulombFriction(coefficient=0.4, sticking_slip=1e-3)


def sliding(dim: int, seed: int, count: int = 20) -> tuple[Values, Values, Values]:
    """Normal forces, normals and motions from deep in sticking to far in sliding."""
    rng = np.random.default_rng(seed)
    n = rng.normal(size=(count, dim))
    moved = rng.normal(size=(count, dim)) * 10 ** rng.uniform(-6, -1, (count, 1))
    return rng.uniform(0, 50, count), n / np.linalg.norm(n, axis=1, keepdims=True), moved


@pytest.mark.parametrize("dim", (2, 3))
@given(seed=st.integers(0, 10**6))
def test_friction_force_and_stiffness_are_derivatives(dim: int, seed: int) -> None:
    """Central differences with a step of 1e-7 m, a thousandth of a thousandth of the slip that sticks."""
    force, n, moved = sliding(dim, seed)
    gradient = differences(lambda x: FRICTION.energy(force, n, x), moved, 1e-7)
    np.testing.assert_allclose(FRICTION.gradient(force, n, moved), gradient, atol=1e-5 * 50)
    hessian = differences(lambda x: FRICTION.gradient(force, n, x), moved, 1e-7)
    stiffest = 0.4 * 50 * 2 / FRICTION.sticking_slip
    np.testing.assert_allclose(FRICTION.hessian(force, n, moved), hessian, atol=1e-3 * stiffest)


@pytest.mark.parametrize("dim", (2, 3))
@given(seed=st.integers(0, 10**6))
def test_coulomb(dim: int, seed: int) -> None:
    """|f| <= mu lambda, with equality once it slides; along the slip and across the normal; stiffness >= 0."""
    force, n, moved = sliding(dim, seed)
    s, f = tangential(n, moved), FRICTION.gradient(force, n, moved)
    size, slip = np.linalg.norm(f, axis=1), np.linalg.norm(s, axis=1)
    assert (size <= 0.4 * force * (1 + 10 * EPS)).all()
    slides = slip >= FRICTION.sticking_slip
    np.testing.assert_allclose(size[slides], 0.4 * force[slides], rtol=20 * EPS)
    np.testing.assert_allclose(np.einsum("ni,ni->n", f, n), 0, atol=1e-13 * 50)
    np.testing.assert_allclose(np.einsum("ni,ni->n", f, s), size * slip, rtol=1e-9, atol=1e-20)
    H = FRICTION.hessian(force, n, moved)
    assert (np.linalg.eigvalsh(H).min(axis=1) >= -1e-12 * np.abs(H).max()).all()


@given(slips=st.lists(st.floats(0, 1e-2), min_size=2, max_size=20))
def test_friction_costs_the_more_the_further_it_slips(slips: list[float]) -> None:
    """mu lambda h / 3 without slip, growing, mu lambda |s| once it slides; the same for a slip the other way."""
    y = np.sort(slips)
    n, moved = np.tile([0.0, 1.0], (len(y), 1)), np.stack([y, y], axis=1)
    energy = FRICTION.energy(np.full(len(y), 5.0), n, moved)
    assert (np.diff(energy) >= -1e-18).all() and (energy >= 2.0 * 1e-3 / 3).all()
    np.testing.assert_allclose(energy[y >= 1e-3], 2.0 * y[y >= 1e-3], rtol=1e-12)
    np.testing.assert_array_equal(energy, FRICTION.energy(np.full(len(y), 5.0), n, -moved))


def test_no_slip_no_force() -> None:
    """At rest the force is 0 and the stiffness 2 mu lambda / h across the normal."""
    n, rest = np.array([[0.0, 0.0, 1.0]]), np.zeros((1, 3))
    np.testing.assert_array_equal(FRICTION.gradient(np.ones(1), n, rest), 0)
    np.testing.assert_allclose(FRICTION.hessian(np.ones(1), n, rest)[0], np.diag([800.0, 800.0, 0.0]))


@pytest.mark.parametrize("dim", (2, 3))
@given(seed=st.integers(0, 10**6))
def test_tangents_of_friction_with_directions(dim: int, seed: int) -> None:
    """Symmetric and never negative after any two iterates; |w| <= 1; exact where the slip is that of the last tangent
    and w belongs to it."""
    force, n, moved = sliding(dim, seed)
    at_first = FrictionDirection(FRICTION, n)
    last = at_first.updated(moved).updated(sliding(dim, seed + 1)[2])
    for direction in (at_first, last):
        w, H = direction(tangential(n, moved)), FRICTION.hessian(force, n, moved, direction)
        assert (np.linalg.norm(w, axis=1) <= 1 + 10 * EPS).all()
        np.testing.assert_array_equal(H, H.transpose(0, 2, 1))
        assert (np.linalg.eigvalsh(H).min(axis=1) >= -1e-12 * np.abs(H).max()).all()
        np.testing.assert_allclose(np.einsum("nij,nj->ni", H, n), 0, atol=1e-12 * np.abs(H).max())
    s = tangential(n, moved)
    there = FrictionDirection(FRICTION, n, (s, FRICTION.direction(s)))
    exact = FRICTION.hessian(force, n, moved)
    np.testing.assert_allclose(FRICTION.hessian(force, n, moved, there), exact, atol=1e-12 * np.abs(exact).max())


def spring_iterates(primal_dual: bool, stiffness: float, end: float) -> list[float]:
    """Slips, m, of whole Newton steps from 20 h for a spring k/2 (s - end)^2 on a point that rubs with 2 N."""
    n, direction, slips = np.array([[0.0, 1.0]]), FrictionDirection(FRICTION, np.array([[0.0, 1.0]])), [20e-3]
    for _ in range(30):
        motion = np.array([[slips[-1], 0.0]])
        residual = stiffness * (slips[-1] - end) + FRICTION.gradient(np.full(1, 5.0), n, motion)[0, 0]
        if abs(residual) < 1e-9:
            break
        H = FRICTION.hessian(np.full(1, 5.0), n, motion, direction if primal_dual else None)
        direction = direction.updated(motion)
        slips.append(slips[-1] - residual / (stiffness + H[0, 0, 0]))
    return slips


@pytest.mark.parametrize("end", (-0.01, 0.0, 0.01, 0.1))
@pytest.mark.parametrize("stiffness", (1.0, 30.0, 100.0))
def test_a_point_that_comes_to_stick_takes_few_whole_newton_steps(stiffness: float, end: float) -> None:
    """A point on a spring that ends in sticking (k |end| < 2 N) or slips on: the balance of spring and Coulomb by
    bisection. Exact tangents overshoot by 2 N / k, and come back and forth without end for the soft spring."""
    slips = spring_iterates(primal_dual=True, stiffness=stiffness, end=end)

    def excess(s: float) -> float:
        z = min(abs(s) / 1e-3, 1.0)
        return stiffness * (s - end) + math.copysign(2.0 * (2 * z - z**2), s)

    assert len(slips) <= 9
    assert slips[-1] == pytest.approx(brentq(excess, -1.0, 1.0, xtol=1e-15), abs=1e-9)
    if stiffness == 1 and end == 0:
        assert len(spring_iterates(primal_dual=False, stiffness=stiffness, end=end)) == 31


def test_a_turn_of_a_ball_is_no_bound() -> None:
    """Past a ball points may go as far however fast it spins, on and beside their facets; of a box that spins less."""
    x, moved = np.array([[0.0, 0.12], [0.3, 0.12], [0.15, 0.4]]), np.array([[0.0, -0.01]] * 3)
    facets = ContactFacets(np.array([[0, 1], [1, 2]]), np.array([0.3, 0.3]), 1e-4)
    shares = {}
    for name, shape in (("ball", Sphere(0.1, dim=2)), ("box", RoundedBox((0.2, 0.2), rounding=0.02))):
        placed = PosedShape(shape, Pose.at_point(np.zeros(2)))
        shares[name] = [
            safe_motion_fractions(placed, x, moved, np.array([0.0, 0.0, turn]), facets) for turn in (0.0, 3.0)
        ]
    np.testing.assert_array_equal(shares["ball"][0], shares["ball"][1])
    assert (shares["ball"][1] == 1).all() and shares["box"][1][0] < shares["box"][0][0] == 1
