"""[fracture] energy: the force on a tip against closed forms, and what it takes to tear a plate against Griffith."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from mpi4py import MPI
from scipy.optimize import brentq

from fracsim.fracture.energy.configurational_force import (
    closure_spring_stress,
    eshelby_stress,
    first_piola_stress,
    plateau,
)
from fracsim.fracture.energy.crack_initiation import CutKind, rank_rows
from fracsim.fracture.energy.cut_plane import centroid_cuts, exit_cuts, plane_crossings, points_on_edges
from fracsim.fracture.energy.mixed_mode import (
    TipDiscFields,
    intensity_contributions,
    kink_angle,
    kink_gain,
    kink_matrix,
    phase_angles,
)
from fracsim.fracture.energy.tip_criterion import TipCriterion, kinked_release
from fracsim.fracture.energy.tip_fields import GradientOperators, TipFields
from fracsim.fracture.energy.tip_parameters import TIP
from fracsim.mesh.domain import distribute
from fracsim.mesh.small_matrices import barycentric_gradients
from fracsim.scene import build_scene, build_scene_on
from fracsim.studies.evidence.precision.torn_strip import SHEAR, crack_of_strip, strip_study
from fracsim.study.check import check_study
from fracsim.timestepping.state import State
from fracsim.timestepping.stepper import StepReport
from support.notched import (
    POISSON,
    STIFF,
    YOUNG,
    balanced,
    near_tip,
    notched,
    plate,
    plate_tables,
    put_in_balance,
    torn,
)
from support.resumed import assert_alike, going_stopped_resumed
from support.scenes import DIRECT, make_study
from support.squares import KINDS, square
from support.strip import run_of_a_strip
from support.tearing import RUNS
from support.tips import criterion_of, seen, tips

Values = npt.NDArray[np.float64]

# --- parts -----------------------------------------------------------------------------------------------------------


def test_the_disc_function() -> None:
    """q is 1 to R / 2 and falls to 0 at R along a line."""
    np.testing.assert_allclose(plateau(np.array([0.0, 0.5, 0.8, 1.1, 1.3]), np.full(5, 1.1)), [1, 1, 0.6 / 1.1, 0, 0])


def disc_gradient(apart: Values, radius: float) -> Values:
    """(n, 2) 1/m, of the disc function at places (n, 2) from the tip."""
    r = np.linalg.norm(apart, axis=1)
    return np.where((r > radius / 2) & (r < radius), -2 / (radius * r), 0.0)[:, None] * apart


@pytest.mark.parametrize("d", [2, 3])
def test_a_patch_has_the_gradient_and_the_middles_of_a_field(d: int) -> None:
    """Of an affine field x -> A x + b on random simplices that share nodes: A, and its value at each centroid."""
    chance = np.random.default_rng(d)
    points, A, b = chance.random((20, d)), chance.random((d, d)), chance.random(d)
    cells = np.array([chance.permutation(20)[: d + 1] for _ in range(30)])
    patch = GradientOperators(cells, barycentric_gradients(points[cells])[:, None], np.full((1, d + 1), 1 / (d + 1)))
    field = (points @ A.T + b).ravel()
    corners = patch.gather_nodal_values(field)
    np.testing.assert_allclose(patch.evaluate_gradients(corners), np.tile(A, (30, 1, 1)), rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(patch.evaluate_values(corners), points[cells].mean(axis=1) @ A.T + b, rtol=1e-12)


def test_eshelbys_stress_is_what_moving_the_material_costs() -> None:
    """d/ds of det(D) psi(F D^-1), D = I + s B, is Sigma : B with Sigma = psi I - F^T P (neo-Hooke in the plane); with
    grad u for F the difference, P, has no part in a body in balance."""
    rng = np.random.default_rng(2)
    F, B = np.eye(2) + 0.2 * rng.standard_normal((2, 2)), rng.standard_normal((2, 2))

    def psi(F: Values) -> float:
        J = float(np.linalg.det(F))
        return float(np.sum(F**2) / 2 - 1 - np.log(J) + (J - 1) ** 2)

    J, step = float(np.linalg.det(F)), 1e-6
    P = F - np.linalg.inv(F).T + 2 * (J - 1) * J * np.linalg.inv(F).T
    cost = [np.linalg.det(D) * psi(F @ np.linalg.inv(D)) for D in (np.eye(2) + step * B, np.eye(2) - step * B)]
    sigma = eshelby_stress(np.array([psi(F)]), F[None], P[None])[0]
    assert float(np.sum(sigma * B)) == pytest.approx((cost[0] - cost[1]) / (2 * step), rel=1e-7)
    H = F - np.eye(2)
    np.testing.assert_allclose(eshelby_stress(np.array([psi(F)]), H[None], P[None])[0] - sigma, P, rtol=1e-12)
    cauchy = P @ F.T / J
    np.testing.assert_allclose(first_piola_stress(cauchy[None], H[None], linear=False)[0], P, rtol=1e-12)


@pytest.mark.parametrize("linear", (True, False))
def test_the_springs_of_closed_edges(linear: bool) -> None:
    """P is the derivative of psi by F, by finite differences; edges that are longer, or not broken, give nothing."""
    rng = np.random.default_rng(4)
    vectors, modulus = rng.standard_normal((5, 3, 2)), rng.uniform(0, 2, (5, 3)) * (rng.uniform(0, 1, (5, 3)) > 0.3)
    H, B, step = 0.3 * rng.standard_normal((5, 2, 2)), rng.standard_normal((5, 2, 2)), 1e-6
    _, P = closure_spring_stress(vectors, modulus, H, linear=linear)
    up, down = (closure_spring_stress(vectors, modulus, H + s * step * B, linear=linear)[0] for s in (1, -1))
    np.testing.assert_allclose(np.sum(P * B, axis=(1, 2)), (up - down) / (2 * step), atol=1e-8)
    longer, _ = closure_spring_stress(vectors, modulus, np.tile(0.1 * np.eye(2), (5, 1, 1)), linear=linear)
    np.testing.assert_array_equal(longer, 0.0)


def test_a_line_cuts_a_triangle_where_it_crosses() -> None:
    """Points of the cuts lie on the line, and its two crossings on two edges."""
    rng = np.random.default_rng(3)
    corners = rng.uniform(0, 1, (50, 3, 2))
    angle = rng.uniform(0, np.pi, 50)
    normal = np.column_stack([np.cos(angle), np.sin(angle)])
    cuts = centroid_cuts(corners, normal)
    assert np.array_equal(np.bincount(cuts.row), np.full(50, 2))
    _, share = plane_crossings(corners, corners.mean(axis=1), normal)
    places = points_on_edges(corners, share)[cuts.row, cuts.edge]
    off = np.einsum("ni,ni->n", places - corners.mean(axis=1)[cuts.row], normal[cuts.row])
    inner = (cuts.share > 0.021) & (cuts.share < 0.979)
    assert inner.sum() > 80 and np.abs(off[inner]).max() < 1e-15


def test_a_crack_does_not_turn_back() -> None:
    """In at the foot of a triangle: out where the line leads; against what lies ahead, or into what is torn: the other
    way, as near to the line as that comes."""
    corners = np.array([[[0.0, 0.0], [1.0, 0.0], [0.5, 1.0]]])  # DOLFINx's edge 0 is (1, 2), 1 (0, 2), 2 (0, 1)
    entry, point, normal = np.array([2]), np.array([[0.4, 0.0]]), np.array([[1.0, 0.2]]) / np.hypot(1, 0.2)
    whole, up = np.zeros((1, 3), bool), np.array([[0.0, 1.0]])
    straight = exit_cuts(corners, entry, point, normal, up, whole)
    assert straight.edge.tolist() == [1]
    assert exit_cuts(corners, entry, point, normal, up, np.array([[False, True, False]])).edge.tolist() == [0]
    assert exit_cuts(corners, entry, point, normal, np.array([[1.0, 0.0]]), whole).edge.tolist() == [0]
    both = np.array([[True, True, False]])
    assert exit_cuts(corners, entry, point, normal, up, both).edge.tolist() == [1]
    steep = np.array([[-0.94, -0.33]])  # out by where it came in: along that edge, by the end that lies ahead
    turned = exit_cuts(corners, entry, point, np.array([[0.33, -0.94]]), steep, whole)
    assert turned.edge.tolist() == [1] and points_on_edges(corners, np.full((1, 3), turned.share[0]))[0, 1, 0] < 0.02


def test_cells_that_mirror_each_other_keep_their_order_as_stresses_vary_by_the_solution() -> None:
    domain, cells, rng = distribute(MPI.COMM_SELF, square("structured", 4)), np.arange(20), np.random.default_rng(5)
    orders = set()
    for _ in range(20):
        sigma = 3e5 * (1 + 1e-9 * rng.normal(size=len(cells)))
        rows = rank_rows(CutKind.TIP_ADVANCE, sigma, cells[:, None] + 0.0, domain.nodes[cells], np.zeros(len(cells)))
        orders.add(tuple(np.lexsort(rows[:, 2::-1].T)))
    assert len(orders) == 1
    # a cell with more stress than that comes first all the same
    sigma[7] *= 1 + 3e-6
    rows = rank_rows(CutKind.TIP_ADVANCE, sigma, cells[:, None] + 0.0, domain.nodes[cells], np.zeros(len(cells)))
    assert np.lexsort(rows[:, 2::-1].T)[0] == 7


def test_a_cell_is_let_go_in_the_time_of_a_rayleigh_wave() -> None:
    """c_R from the secular equation of a half space, to 0.5 % (Viktorov's fit)."""
    scene = build_scene(MPI.COMM_SELF, make_study(**plate_tables(), mesh={"builder": "box", "size": [1, 1], "h": 0.1}))
    criterion = scene.fracture.criterion
    assert isinstance(criterion, TipCriterion)
    shear = np.sqrt(YOUNG / 2 / (1 + POISSON) / 7800.0)
    ratio = (1 - 2 * POISSON) / (2 * (1 - POISSON))  # (c_s / c_p)^2
    c = shear * brentq(lambda x: (2 - x**2) ** 2 - 4 * np.sqrt((1 - x**2) * (1 - ratio * x**2)), 0.5, 0.99)
    np.testing.assert_allclose(criterion.release_rate(), c / (TIP.disc_radius[2] * 0.1), rtol=5e-3)


# --- the force on a tip ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", (1, 2))
@pytest.mark.parametrize("kind", KINDS)
def test_the_force_of_a_known_field(kind: str, order: int) -> None:
    """g of a body whose sides are moved as the fields around a tip ask: K^2 / E' ahead, and - 2 K_I K_II / E' across
    where both are there; to 6 % in tension. With sliding to 18 %, since the crack is as wide as the cells it cuts."""
    scene = balanced(kind, 24, order=order)
    point = tips(scene)[0]
    for first, second in ((1.0, 0.0), (0.0, 1.0), (1.0, 0.4)):
        put_in_balance(scene, near_tip(scene.domain.nodes - point, first, second))
        force = seen(scene).evaluate_forces()[0] * STIFF
        expected = np.array([first**2 + second**2, -2 * first * second])
        np.testing.assert_allclose(force, expected, atol=(0.18 if second else 0.06) * expected[0])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("end", "least"), ((0.94, 0.3), (0.97, 1.1)))
def test_a_uniform_body_pulls_at_no_tip(kind: str, end: float, least: float) -> None:
    """However near the edge that it goes for: an advance would move that edge as well, sum V grad q = int q n ds, which
    a tip feels otherwise as an energy that it takes to get on. With q linear in cells both sums are the same."""
    look = seen(plate(kind, 30, crack=[{"segment": [[0.0, 0.507], [end, 0.507]]}]))
    density, none = np.tile(np.eye(2), (len(look.sigma), 1, 1)), np.zeros((len(look.sigma), 2))
    assert look.tips.surface[0, 0] > least * look.disc_radius[0]
    assert np.linalg.norm(look.neighbourhoods.evaluate_forces(density, none)[0]) < 1e-12 * look.disc_radius[0]


@pytest.mark.parametrize("order", (1, 2))
@pytest.mark.parametrize("kind", KINDS)
def test_no_force_of_waves_that_pass(kind: str, order: int) -> None:
    """Standing waves of pressure and shear, in a body one of whose edges is broken: no cell has come apart, so nothing
    is released, whatever passes the disc: g = 0 where the waves stand farthest out, and where they go fastest.

    Beside what the energy alone makes there, and beside - int rho v^2 / 2 grad q, summed over the disc; what is left
    is that cells count by their middles.
    """
    scene = plate(kind, 24, order=order)
    graph, criterion, nodes = scene.fracture.graph, criterion_of(scene), scene.domain.nodes
    flags = np.zeros(len(graph.broken), bool)
    flags[np.argmin(np.linalg.norm(nodes[graph.edge_nodes].mean(axis=1) - 0.5, axis=1))] = True
    graph.break_edges(flags)
    criterion.cut_positions[flags] = 0.5
    (point, *_) = tips(scene)
    shape, push = waves(nodes)
    scene.balance.set_displacement(shape.ravel())
    still = float(np.linalg.norm(seen(scene).evaluate_forces(), axis=1).min())
    criterion.set_motion(np.zeros(shape.size), push.ravel(), 0.0, 1e-9)
    assert np.linalg.norm(seen(scene).evaluate_forces(), axis=1).max() < 0.15 * still

    r = TIP.disc_radius[2] / 24 * (np.arange(40) + 0.5) / 40
    t = 2 * np.pi * np.arange(80) / 80
    apart = (r[:, None, None] * np.column_stack([np.cos(t), np.sin(t)])).reshape(-1, 2)
    area = np.repeat(r, len(t)) * (TIP.disc_radius[2] / 24 / 40) * (2 * np.pi / 80)
    velocity = np.sqrt(YOUNG / 7800.0) * 3.0
    kinetic = 7800.0 / 2 * velocity**2 * np.sum(waves(point + apart)[0] ** 2, axis=1)
    slope = disc_gradient(apart, TIP.disc_radius[2] / 24)
    carried = float(np.linalg.norm((area * kinetic) @ slope))
    assert carried > 0.3 * still
    scene.balance.set_displacement(np.zeros(shape.size))
    criterion.set_motion(velocity * shape.ravel(), np.zeros(shape.size), 0.0, 1e-9)
    assert np.linalg.norm(seen(scene).evaluate_forces(), axis=1).max() < 0.15 * carried


def waves(places: Values) -> tuple[Values, Values]:
    """(n, 2) displacement in m of a wave of pressure and one of shear that stand, and their acceleration, m/s^2."""
    modulus = YOUNG / 2 / (1 + POISSON)
    whole, push = np.zeros((2, *places.shape))
    for angle, turn, stiff in ((0.3, 0.0, modulus * 2 * (1 - POISSON) / (1 - 2 * POISSON)), (1.1, np.pi / 2, modulus)):
        s = np.sin(3.0 * places @ [np.cos(angle), np.sin(angle)] + 0.4)
        each = s[:, None] * [[np.cos(angle + turn), np.sin(angle + turn)]]
        whole, push = whole + each, push - 9.0 * stiff / 7800.0 * each
    return whole, push


def test_a_short_kink_in_closed_form() -> None:
    """To the first order in the angle (Cotterell and Rice 1980), where a crack turns in pure sliding and what it
    releases (Amestoy and Leblond 1992: 75.8 degrees, 1.517), and no sliding at a kink, but for a degree or two."""
    t, step = 0.3, 1e-6
    slope = (kink_matrix(np.array([step])) - kink_matrix(np.array([-step])))[0] / (2 * step)
    np.testing.assert_allclose(slope, [[0.0, -1.5], [0.5, 0.0]], atol=1e-9)
    mirrored = kink_matrix(np.array([-t]))[0] * [[1, -1], [-1, 1]]
    np.testing.assert_allclose(kink_matrix(np.array([t]))[0], mirrored, rtol=1e-12)
    psi = np.linspace(-1.57, 1.57, 21)
    for each, angle, gain in zip(psi, kink_angle(psi), kink_gain(psi), strict=True):
        first, second = kink_matrix(np.array([angle]))[0] @ [np.cos(each), np.sin(each)]
        assert first**2 + second**2 == pytest.approx(gain, rel=1e-4)
        assert abs(second) < 0.03 * first
        for other in (angle - 0.1, angle + 0.1):
            K = kink_matrix(np.array([other]))[0] @ [np.cos(each), np.sin(each)]
            assert gain > K @ K
    assert np.degrees(kink_angle(np.array([np.pi / 2]))[0]) == pytest.approx(-75.8, abs=0.1)
    assert kink_gain(np.array([np.pi / 2]))[0] == pytest.approx(1.517, abs=1e-3)
    # Where the sides press on each other, what they press with does not count.
    assert kink_angle(np.array([2.0, np.pi]))[0] == kink_angle(np.array([np.pi / 2]))[0]
    assert kink_gain(np.array([2.0]))[0] == pytest.approx(np.sin(2.0) ** 2 * kink_gain(np.array([np.pi / 2]))[0])


def test_intensities_in_closed_form() -> None:
    """K_I and K_II put around a tip, by quadrature over the disc: whatever else is there that the tip has no part in,
    a stress along its sides, and a body that is accelerated across them, u_y = rho a y^2 / 2 (lambda + 2 mu)."""
    radius, step = 0.3, 1e-6
    r = radius * (np.arange(200) + 0.5) / 200
    t = np.pi * ((np.arange(400) + 0.5) / 200 - 1)
    apart = (r[:, None, None] * np.column_stack([np.cos(t), np.sin(t)])).reshape(-1, 2)
    area = np.repeat(r, len(t)) * radius / 200 * np.pi / 200
    mu, kappa = YOUNG / 2 / (1 + POISSON), 3 - 4 * POISSON
    lmbda, load, along = 2 * mu * POISSON / (1 - 2 * POISSON), 7.0, 0.4 / YOUNG

    def u(places: Values) -> Values:
        x, y = places.T
        side = np.column_stack([along * (1 - POISSON**2) * x, load / 2 / (lmbda + 2 * mu) * y**2])
        return np.asarray(near_tip(places, 0.8, 0.5) + side - [[0, 1]] * (along * POISSON * (1 + POISSON) * y)[:, None])

    H = np.stack([(u(apart + e) - u(apart - e)) / (2 * step) for e in step * np.eye(2)], axis=2)
    strain = (H + H.transpose(0, 2, 1)) / 2
    stress = 2 * mu * strain + lmbda * np.einsum("pii->p", H)[:, None, None] * np.eye(2)
    many = np.ones(len(area))
    c, s = np.cos(0.7), np.sin(0.7)
    Q = np.array([[c, -s], [s, c]])
    discs = [radius * many, np.repeat([[c, s]], len(many), axis=0), np.repeat([Q @ [0, load]], len(many), axis=0)]
    slope = area[:, None] * disc_gradient(apart, radius) @ Q.T
    inside = area * plateau(np.linalg.norm(apart, axis=1), discs[0])
    push = discs[2]
    around = TipDiscFields(
        apart @ Q.T, discs[1], slope, inside, Q @ stress @ Q.T, Q @ H @ Q.T, push, mu * many, kappa * many
    )
    np.testing.assert_allclose(intensity_contributions(around).sum(axis=0), [0.8, 0.5], atol=2e-3)
    still = intensity_contributions(replace(around, inertia_force=0 * push)).sum(axis=0)
    assert abs(still[1] - 0.5) > 0.1  # it is the acceleration's part that makes it so


def tilted(points: Values, first: float, second: float, half: float) -> Values:
    """(n, 2) displacement around a crack from - half to half on y = 0 in a wide body, pulled one way, that has these
    tractions in Pa across it (Westergaard)."""
    z, y = points[:, 0] + 1j * points[:, 1], points[:, 1]
    mu, kappa = YOUNG / 2 / (1 + POISSON), 3 - 4 * POISSON
    whole = np.sqrt(z - half) * np.sqrt(z + half)
    Z = z / whole
    opening = np.column_stack([(kappa - 1) / 2 * whole.real - y * Z.imag, (kappa + 1) / 2 * whole.imag - y * Z.real])
    sliding = np.column_stack([(kappa + 1) / 2 * whole.imag + y * Z.real, (1 - kappa) / 2 * whole.real - y * Z.imag])
    along = second**2 / first - first
    side = along * np.column_stack([(1 - POISSON) * points[:, 0], -POISSON * y])
    return np.asarray((first * opening + second * sliding + side) / (2 * mu))


@pytest.mark.parametrize("kind", KINDS)
def test_both_tips_of_a_tilted_crack_are_told(kind: str) -> None:
    """A crack of 12 h with all of the stress along it, in a body whose sides move as under tension at 30 to 90 degrees:
    K_II / K_I = cot, to 2.5 degrees."""
    scene = balanced(kind, 40, 0.65, 1, 0.35)
    ends = tips(scene)
    half = np.ptp(ends[:, 0]) / 2
    for angle in np.radians([30, 45, 60, 90]):
        first, second = np.sin(angle) ** 2, np.sin(angle) * np.cos(angle)
        put_in_balance(scene, tilted(scene.domain.nodes - [ends[:, 0].mean(), 0.507], first, second, half))
        off = np.degrees(phase_angles(seen(scene).stress_intensities()) - (np.pi / 2 - angle))
        assert np.abs(off).max() < 2.5


def test_who_turns_with_a_tip_sees_no_turn() -> None:
    """A neo-Hookean body spun by 70 degrees, its crack under K_I and K_II: the phase of before, to round-off."""
    scene = balanced("unstructured", 20, material=plate_tables()["material"] | {"energy": "neo-hookean"})
    nodes, phases = scene.domain.nodes, []
    put_in_balance(scene, near_tip(nodes - tips(scene)[0], 1e6, 0.5e6))
    u = scene.balance.stress.u.x.array.reshape(-1, 2).copy()
    c, s = np.cos(1.2), np.sin(1.2)
    for Q in (np.eye(2), np.array([[c, -s], [s, c]])):
        scene.balance.set_displacement(((nodes + u) @ Q.T - nodes).ravel())
        phases.append(phase_angles(seen(scene).stress_intensities())[0])
    assert phases[0] == pytest.approx(np.arctan2(0.5, 1), abs=0.05)
    assert phases[1] == pytest.approx(phases[0], abs=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_a_crack_turns_as_the_field_around_it_asks(kind: str) -> None:
    """Sides moved as fields of K_I and K_II ask: the direction in which most is released to 4 degrees, and what the
    crack that turns releases to 12 %; the first principal stress of the mean is 30 degrees off."""
    scene = balanced(kind, 30)
    point = tips(scene)[0]
    for first, second in ((1.0, 0.5), (1.0, 1.0), (0.0, 1.0)):
        put_in_balance(scene, near_tip(scene.domain.nodes - point, first, second))
        now = seen(scene)
        released, ahead = kinked_release(phase_angles(now.stress_intensities()), now.tips, now.evaluate_forces())
        psi = np.arctan2([second], [first])
        angle = np.arctan2(ahead[0, 1], ahead[0, 0])
        assert np.degrees(angle - kink_angle(psi)[0]) == pytest.approx(0, abs=4)
        expected = (first**2 + second**2) * kink_gain(psi)[0]
        assert released[0] * STIFF == pytest.approx(expected, rel=0.12)


@pytest.mark.slow
@pytest.mark.parametrize(("h", "seed"), [(0.03, 1), (0.025, 2), (0.02, 3), (0.0175, 4), (0.015, 5)])
def test_a_crack_at_45_degrees_kinks_towards_its_normal_load(h: float, seed: int) -> None:
    """A plate in tension: over 3 h both ends of the crack turn by 53.1 degrees, within 4. The hoop stress of K_I = K_II
    is largest there."""
    along, middle = np.sqrt([0.5, 0.5]), np.array([0.5, 0.5])
    study = make_study(
        **plate_tables(), mesh={"builder": "box", "size": [1, 1], "h": h, "pattern": "unstructured", "seed": seed},
        crack=[{"segment": [list(middle - 0.15 * along), list(middle + 0.15 * along)]}],
        boundary=[{"on": "bottom", "fix": "y"}, {"on": {"box": [[0, 0], [0, 0]]}, "fix": "x"},
                  {"on": "top", "displacement": {"time": [0, 100], "value": [["free", 0], ["free", 6e-4]]}}],
        time={"scheme": "quasi-static", "step": 0.5, "end": 100},
    )  # fmt: skip
    scene = build_scene(MPI.COMM_SELF, study)
    criterion, state, start = criterion_of(scene), scene.start(), tips(scene)
    size = np.sqrt(2 * np.mean(scene.domain.volumes))
    distance = np.zeros((2, 1))
    while distance.max(axis=1).min() < 3.5 * size:
        state, _ = scene.stepper.advance(state)
        cuts = criterion.field_evaluator.cut_points(
            np.flatnonzero(~np.isnan(criterion.cut_positions)), criterion.cut_positions
        )
        # cuts ahead of each end of the crack as it was given
        outward = np.sign((start - middle) @ along)[:, None] * along
        arms = cuts - start[:, None]
        distance = np.where(np.einsum("tni,ti->tn", arms, outward) > 0, np.linalg.norm(arms, axis=2), 0.0)
    for arm, away, ahead in zip(arms, distance, outward, strict=True):
        order = np.argsort(away)
        across = arm @ np.array([-ahead[1], ahead[0]])
        sideways, forward = (np.interp(3 * size, away[order], x[order]) for x in (across, arm @ ahead))
        assert np.degrees(np.arctan2(abs(sideways), forward)) == pytest.approx(53.1, abs=4)


# --- a notched plate -------------------------------------------------------------------------------------------------


FINE = [pytest.param(kind, n, order, marks=pytest.mark.slow) for kind in KINDS for n in (36, 48) for order in (1, 2)]
COARSE = [(kind, 24, order) for kind in KINDS for order in (1, 2) if (kind, order) != ("unstructured", 2)]


@pytest.mark.parametrize(("kind", "n", "order"), [*COARSE, *FINE])
def test_a_notched_plate_breaks_at_griffiths_load(
    kind: str, n: int, order: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Single-edge notched tension (Miehe et al. 2010): a sharp crack of G_c = 2.7 kJ/m^2 starts at 645 kN/m, here
    within 3 % (quadratic displacement on 24 random cells: 3.5 %, not tried here). What was lost is G_c for each metre
    of the crack, and some more: each h has places that hold it until the load is up to 3 % higher, whence it jumps.
    Work, stored and lost are three sums that share nothing. While it grows by h the plate is solved for twice at most.
    """
    peak, books, solved, look = 0.0, [], [0], TipCriterion.__call__

    def counted(*given: Any) -> Any:
        solved[-1] += 1
        return look(*given)

    monkeypatch.setattr(TipCriterion, "__call__", counted)
    for reaction, tip, state in torn(notched(kind, n, order=order)):
        peak = max(peak, reaction)
        books.append((tip, state.dissipated, state.work - state.elastic))
        solved.append(0)
        if not tip < 0.75e-3:
            break
    tips, lost, gone = np.array(books).T
    assert peak == pytest.approx(645e3, rel=0.03)
    np.testing.assert_allclose(lost, gone, atol=1e-3 * gone.max())
    whole = np.flatnonzero(np.isfinite(tips))[-1]
    assert 0.93 < lost[whole] / (2.7e3 * (tips[whole] - tips[0])) < 1.09
    grew = np.diff(tips, prepend=np.nan) != 0
    reached = tips[whole] if whole == len(tips) - 1 else 1e-3
    assert np.sum(np.array(solved[: len(tips)])[grew][1:]) / ((reached - tips[0]) * n * 1e3) < 2


@pytest.mark.parametrize(("kind", "n", "order"), [("unstructured", 24, 1), ("unstructured", 24, 2), *FINE])
def test_event_by_event_the_crack_takes_its_energy(
    kind: str, n: int, order: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each cell cut at the load at which its tip reaches G_c, with snap-back: the sum of what the plate lets go, over
    the length of the crack, is G_c to 5 % (to 10 % with 24 cells, where the path has 6 h). A linear plate at
    unit load tells all: load^2 = G_c / |g|."""
    scene = notched(kind, n, end=200.0, order=order)
    criterion, state, rows = scene.fracture.criterion, scene.start(), []
    criterion.toughness, scene.fracture.max_passes, forces = 1e-30, 1, TipFields.evaluate_forces

    def watched(seen: TipFields) -> Values:
        found = forces(seen)
        rows.append([scene.balance.stress.stored_energy(), *seen.tips.point[0], np.linalg.norm(found[0])])
        return np.asarray(found)

    monkeypatch.setattr(TipFields, "evaluate_forces", watched)
    state, _ = scene.stepper.advance(state)
    scene.balance.motion.displacements_at = lambda t, held=scene.balance.motion.displacements_at: held(1.0)
    while rows[-1][1] < 0.75e-3:
        state, _ = scene.stepper.advance(state)
    stored, x, y, force = np.array(rows).T
    length = np.hypot(np.diff(x), np.diff(y)).sum()
    taken = np.sum(np.diff(-stored) / force[:-1])
    assert taken == pytest.approx(length, rel=0.05 if n > 24 else 0.1)
    assert np.abs(y - y[0]).max() < 1e-3 / n  # straight on, within a cell


def test_a_tougher_region_takes_its_own_energy() -> None:
    """A plate pulled by a tenth more than starts its crack stays whole, within 2 h, from where a region of 4 G_c
    begins; without it the crack goes on by more than half of the way that is left."""
    mesh = square("unstructured", 24, 1e-3)
    tough = np.flatnonzero(mesh.points[mesh.cells].mean(axis=1)[:, 0] > 0.7e-3)
    rest = np.setdiff1d(np.arange(len(mesh.cells)), tough)
    reached = []
    for energy in (2.7e3, 4 * 2.7e3):
        study = make_study(
            **plate_tables() | {"material": plate_tables()["material"] | {"tough": {"fracture_energy": energy}}},
            crack=[{"segment": [[0.0, 5.12e-4], [5e-4, 5.12e-4]]}], probe=[{"name": "grip", "on": "top"}],
            boundary=[{"on": "bottom", "fix": "xy"},
                      {"on": "top", "displacement": {"time": [0, 1], "value": [[0, 0], [0, 5e-6]]}}],
            time={"scheme": "quasi-static", "step": 1.0, "end": 1.0},
        )  # fmt: skip
        scene = build_scene_on(distribute(MPI.COMM_SELF, replace(mesh, regions={"tough": tough, "rest": rest})), study)
        *_, (_, tip, _) = torn(scene)
        reached.append(tip)
    assert not reached[0] < 0.8e-3
    assert reached[1] == pytest.approx(0.7e-3, abs=2e-3 / 24)


@pytest.mark.parametrize("order", (1, 2))
def test_a_crack_with_an_energy_closes(order: int) -> None:
    """A cracked plate with `unilateral` is as stiff as a whole one when pushed, to 5 % (with quadratic displacement to
    that of a layer of 1.1 h), and breaks under the same load as one without it when pulled; nothing breaks where it is
    pushed ten times as far."""
    at, forces = (0.5 + 0.3 / 16) * 1e-3, {}
    for far, crack, closes in ((-4.1e-5, True, True), (-4.1e-5, False, False), (5e-6, True, True), (5e-6, True, False)):
        motion = {"time": [0, 1, 9], "value": [[0, 0], [0, 0.85 * far], [0, far]]}
        scene = plate(
            "unstructured", 16, 1e-3, order, **plate_tables(unilateral=closes), probe=[{"name": "grip", "on": "top"}],
            crack=[{"segment": [[0.0, at], [5e-4, at]]}] if crack else [],
            boundary=[{"on": "bottom", "fix": "xy"}, {"on": "top", "displacement": motion}],
            time={"scheme": "quasi-static", "step": 1.0, "end": 9.0 if far > 0 else 1.0},
        )  # fmt: skip
        before = int(scene.fracture.graph.broken.sum())
        found = [abs(reaction) for reaction, _, _ in torn(scene)]
        assert far > 0 or scene.fracture.graph.broken.sum() == before
        forces[far, crack, closes] = max(found)
    pushed, whole, pulled, open_ = forces.values()
    assert pushed == pytest.approx(whole, rel=0.05 if order == 1 else 1.1 / 16)
    assert pulled == pytest.approx(open_, rel=0.01)


@pytest.mark.parametrize("h", [0.1, 0.09, 0.085, 0.08, 0.075, 0.07])
def test_a_smooth_bar_breaks_at_its_strength(h: float) -> None:
    """Uniform stress: it breaks in the first step in which the stress reaches f_t, and loses G_c times its section at
    least: where stress decides it may lose more. The row of that step has the load before the break, too."""
    steps = {"time": [0, 100], "value": [[0.0, "free"], [1.5e-3, "free"]]}
    study = make_study(
        material={"energy": "linear", "young": 1e3, "poisson": 0.0, "density": 1.0},
        mesh={"builder": "box", "size": [2.0, 0.5], "h": h, "pattern": "unstructured"},
        fracture={"strength": 0.5, "energy": 1e-5}, probe=[{"name": "grip", "on": "right"}],
        boundary=[{"on": "left", "fix": "x"}, {"on": {"box": [[0, 0], [0, 0]]}, "fix": "y"},
                  {"on": "right", "displacement": steps}],
        time={"scheme": "quasi-static", "step": 1.0, "end": 70.0},
    )  # fmt: skip
    scene = build_scene(MPI.COMM_SELF, study)
    state, peak = scene.start(), 0.0
    while not scene.fracture.graph.broken.any():
        peak = max(peak, scene.probes()[0])
        state, _ = scene.stepper.advance(state)
    assert peak / 0.5 == pytest.approx(0.5, rel=0.02)
    assert scene.probes()[0] < 1e-6 * peak and state.dissipated > 1e-5 * 0.5
    row = dict(zip(scene.probes.columns, scene.probes(), strict=True))
    # The plate is loaded by E / (2 m) * 1.5e-5 m in a step, so that the last load is one such step above the peak.
    assert row["onset_grip_x"] == pytest.approx(peak + 0.5 * 1e3 / 2.0 * 1.5e-5, rel=1e-6)


# --- in motion -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("scheme", "n", "order"),
    [("explicit", 8, 2), *(pytest.param("newmark", 12, order, marks=pytest.mark.slow) for order in (1, 2))],
)
def test_a_strip_tears_where_it_stores_enough(scheme: str, n: int, order: int) -> None:
    """0.95 G_c never runs, 1.1 G_c does, at about half of c_R or less."""
    assert run_of_a_strip(0.95, scheme, "structured", n, order).length < 1e-9
    run = run_of_a_strip(1.1, scheme, "structured", n, order)
    assert run.length > 0.7 and 0.2 < run.speed < (0.5 if order == 1 else 0.55)


@pytest.mark.parametrize(
    ("scheme", "step", "tolerance"),
    [
        ("explicit", 0.1, 0.003),
        *(("generalized-alpha", step, 0.005) for step in (0.25, 0.8)),
        *(("newmark", step, 1e-6) for step in (0.25, 0.5, 0.8, 1.3)),
    ],
)
def test_the_energy_of_a_running_crack_is_balanced(scheme: str, step: float, tolerance: float) -> None:
    """A strip that stores 1.5 G_c a metre: work is the sum of all energies, to a share of the loss.

    Cells release their energy in many steps, and each release corrects the acceleration. Without that in steps in
    which no edge breaks 2.1 % were missing in explicit steps and 4.5 % by Newmark's method. Steps in which a Rayleigh
    wave goes farther than 0.4 h have two or three passes. When releases before the last pass counted at the
    displacement of their pass, and those without a broken edge left the acceleration as it was, 5.5, 2.7 and 7.4 %
    were missing by Newmark's method, and 8 % too much was dissipated in generalized-alpha steps.
    """
    tables = strip_study(1.5, scheme, "structured", 8)
    tables["time"]["step"] = step / 8 / SHEAR
    scene = build_scene(MPI.COMM_SELF, make_study(**tables))
    rows, advance = [], scene.stepper.advance

    def recorded(state: State) -> tuple[State, StepReport]:
        state, report = advance(state)
        rows.append((state.work, state.dissipated, report.kinetic + report.elastic, report.broken))
        return state, report

    scene.stepper.advance = recorded  # type: ignore[method-assign]
    assert crack_of_strip(scene).length > 1.5
    work, dissipated, stored, broken = np.array(rows).T
    first = np.flatnonzero(broken)[0] - 1
    lost = dissipated[-1] - dissipated[first]
    missing = work[-1] - work[first] - (stored[-1] - stored[first]) - lost
    assert lost > 2.5 and abs(missing) < tolerance * lost


@pytest.mark.slow
@pytest.mark.parametrize("order", (1, 2))
@pytest.mark.parametrize("kind", ("structured", "unstructured"))
def test_explicit_and_implicit_cracks_run_alike(kind: str, order: int) -> None:
    """Faster the more is stored, slower than Rayleigh waves, and by both schemes within 0.12 c_R."""
    assert run_of_a_strip(0.95, "explicit", kind, 12, order).length < 1e-9
    speeds = []
    for ratio in (1.1, 1.5, 2.5):
        speeds.append(run_of_a_strip(ratio, "explicit", kind, 12, order).speed)
        assert run_of_a_strip(ratio, "newmark", kind, 12, order).speed == pytest.approx(speeds[-1], abs=0.12)
    assert 0.3 < speeds[0] < speeds[1] < speeds[2] < 0.95


def test_a_restart_goes_on_as_the_run_would_have(tmp_path: Path) -> None:
    """Cuts are remembered: the tip goes on from where it is in its cell."""
    tables = RUNS["notched"] | {"output": {"picture": False, "interval": 100.0}, "solver": DIRECT}
    going, broken, again = going_stopped_resumed(tables, tmp_path, 1, 4)
    assert 0 < broken < going.breaks.counts[0]
    assert_alike(again, going, 1e-9)
    np.testing.assert_allclose(
        again.scene.fracture.criterion.cut_positions, going.scene.fracture.criterion.cut_positions, atol=1e-9
    )


def test_a_state_is_advanced_twice_alike() -> None:
    """What has been let go of a split cell within a step is not let go once more where the step is taken again."""
    scene = build_scene(MPI.COMM_SELF, make_study(**RUNS["begun"]))
    state = scene.start()
    while scene.fracture.graph.split.sum() < 5:
        state, _ = scene.stepper.advance(state)
    (first, _), (again, _) = scene.stepper.advance(state), scene.stepper.advance(state)
    chi = scene.balance.stress.chi.x.array
    assert np.any((chi > 0) & (chi < 1))
    np.testing.assert_array_equal(first.u, again.u)
    assert first.dissipated == again.dissipated > state.dissipated


# --- what is refused, and told ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"fracture": {"energy": 1.0}}, "Field required"),
        ({"fracture": {"strength": 1.0, "energy": -1.0}}, "greater than 0"),
        ({"fracture": {"strength": 1.0, "energy": 1.0, "radius": 0.1}}, r"not go with fracture\.radius.*3 h"),
        ({"fracture": {"strength": 1.0, "energy": 1.0, "approach": "edge"}}, 'choose approach = "chi"'),
        (
            {
                "fracture": {"strength": 1.0, "energy": 1.0, "law": "cohesive"},
                "plasticity": {"yield_stress": 0.5},
                "material": {"energy": "corotated", "young": 1.0, "poisson": 0.0, "density": 1.0},
                "time": {"scheme": "quasi-static", "step": 1.0, "end": 1.0},
            },
            r"cohesive.* does not go with \[plasticity\]: the law of the crack is that of an elastic body",
        ),
        ({"fracture": {"strength": 1.0, "branching": True}}, r"branching needs fracture\.energy"),
        (
            {
                "fracture": {"strength": 1.0, "energy": 1.0, "branching": True},
                "time": {"scheme": "quasi-static", "step": 1.0, "end": 1.0},
            },
            r"branching needs inertia.*remove it",
        ),
        ({"fracture": {"strength": 1.0, "energy": 1.0}, "output": {"cut": "forces"}}, "say where they cut"),
        ({"fracture": {"strength": 1.0, "energy": 1.0, "cap": 0.1}}, "one cell a pass: remove cap"),
        (
            {"fracture": {"strength": 1.0, "energy": 1.0}, "brittle": {"surfaces": 1}},
            r"energy does not go with \[brittle\]",
        ),
        (
            {
                "fracture": {"strength": 1.0},
                "material": {"young": 1.0, "poisson": 0.0, "density": 1.0, "rim": {"fracture_energy": 1.0}},
            },
            r"material\.rim\.fracture_energy needs fracture\.energy",
        ),
    ],
)
def test_refused(tables: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_study(**tables)


def test_check_tells_irwins_length() -> None:
    """l_ch over the finest cells, of each region that differs; a note where cells are too long, the body too small."""
    lines = check_study(make_study(**plate_tables()))
    length = STIFF * 2.7e3 / 1e22
    assert any(f"l_ch = E' G_c / f_t^2 = {length:.3g} m = {length / 0.5:.3g} h" in line for line in lines)
    assert any("less than h = 0.5 m" in line and f"h = {length:.2g} m" in after for line, after in pairwise(lines))
    tables = plate_tables(strength=1e9) | {"mesh": {"builder": "notched-plate", "h": 0.001}}
    assert any(f"= {STIFF * 2.7e3 / 1e18 / 0.00025:.3g} h" in line for line in check_study(make_study(**tables)))
    fine = {"builder": "box", "size": [1.0, 1.0], "h": 0.05}
    lines = check_study(make_study(**plate_tables(strength=3e7), mesh=fine))
    assert any("over a fifth of the body" in line for line in lines)
    lines = check_study(make_study(**plate_tables(strength=7.9e7), mesh=fine))
    assert [
        line for line in lines if "note" in line and "fragments" not in line
    ] == []  # fragments: a linear energy's note
