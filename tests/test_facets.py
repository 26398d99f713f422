"""Facets between their corners before an obstacle: the deepest place, and what acts there."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.linalg import block_diag
from scipy.sparse import csr_matrix

from fracsim.contact.closest_point import find_closest_points, minimise_on_simplex, smoothing_error
from fracsim.contact.facet_contact import ContactFacets, FacetForces, add_facet_friction, evaluate_facets, merge_forces
from fracsim.contact.laws import Barrier, CoulombFriction
from fracsim.contact.node_contact import (
    ContactForces,
    PoseCoupling,
    contact_wrench,
    evaluate_points,
    lag_contact,
    no_contact,
)
from fracsim.contact.obstacle_term import ObstacleTerm
from fracsim.contact.pose import Pose, PosedShape, rotation_derivative
from fracsim.contact.shapes import Capsule, HalfSpace, RoundedBox, RoundedCylinder, Shape, Sphere
from fracsim.contact.step_limit import safe_motion_fractions
from fracsim.mesh.split_surface.closed_surface import build_split_surface
from fracsim.mesh.split_surface.entity_numbering import EntityNumbering
from fracsim.mesh.split_surface.surface_map import nodal_stiffness
from support.drawn import drawn_at
from support.scenes import each_step, make_scene, march

Values = npt.NDArray[np.float64]

SHAPES: dict[str, Shape] = {
    "ball": Sphere(0.3), "capsule": Capsule(0.1, 0.5, (1.0, 0.3, 0.2)), "cylinder": RoundedCylinder(0.25, 0.4, 0.05),
    "box": RoundedBox((0.5, 0.4, 0.3), 0.05), "disk": Sphere(0.3, 2), "rectangle": RoundedBox((0.5, 0.3), 0.05),
}  # fmt: skip
WIDTH, SOFTEN = 0.1, 0.02
LAW = Barrier(1.0, WIDTH)


def facets_near(name: str, count: int) -> tuple[PosedShape, Values]:
    """An obstacle, and facets (count, c, d) of half its size to twice that whose gaps are 10 to 90 % of the width."""
    rng, shape = np.random.default_rng(1), SHAPES[name]
    placed = PosedShape(shape, Pose.at_point(np.full(shape.dim, 0.2)))
    x = rng.normal(size=(count, shape.dim, shape.dim)) * rng.uniform(0.1, 0.5, size=(count, 1, 1))
    wanted = rng.uniform(0.1, 0.9, size=count) * WIDTH
    for _ in range(8):
        at = find_closest_points(placed, x, SOFTEN)
        x = x + (wanted - at.gap)[:, None, None] * at.normal[:, None]
    return placed, x[abs(find_closest_points(placed, x, SOFTEN).gap - wanted) < 0.05 * WIDTH]


def acting(placed: PosedShape, x: Values) -> FacetForces:
    corners = np.arange(x.shape[0] * x.shape[1]).reshape(x.shape[:2])
    return FacetForces.from_closest(corners, np.ones(len(x)), find_closest_points(placed, x, SOFTEN), LAW)


@pytest.mark.parametrize("name", SHAPES)
def test_the_place_is_the_deepest(name: str) -> None:
    """Against a lattice of places: none is nearer than the gap, nor is the gap smaller by more than the softening; and
    the softened least of the lattice is never below it."""
    placed, x = facets_near(name, 40)
    c, d = x.shape[1:]
    steps = np.stack(np.meshgrid(*[np.arange(41)] * (c - 1), indexing="ij"), axis=-1).reshape(-1, c - 1) / 40
    shares = np.column_stack([steps, 1 - steps.sum(axis=1)])
    shares = shares[shares[:, -1] >= -1e-12]
    places = np.einsum("sc,kcd->ksd", shares, x)
    distance = placed.distance(places.reshape(-1, d)).reshape(len(x), -1)
    at = find_closest_points(placed, x, SOFTEN)
    assert (at.gap <= distance.min(axis=1) + 1e-12).all()
    coarse = np.linalg.norm(x - x.mean(axis=1, keepdims=True), axis=2).max(axis=1) / 20
    assert (at.gap > distance.min(axis=1) - smoothing_error(c, SOFTEN) - coarse).all()
    softened = distance + SOFTEN / 2 * np.sum((shares - 1 / c) ** 2, axis=1) - smoothing_error(c, SOFTEN)
    assert (softened.min(axis=1) >= at.gap - 1e-12).all()
    kinds = (at.barycentric > 0).sum(axis=1)
    assert all((kinds == kind).sum() > 1 for kind in range(1, c + 1))


@pytest.mark.parametrize("c", [2, 3])
def test_the_least_of_a_quadratic_over_shares(c: int) -> None:
    """By the conditions that tell it: no corner lies below it, and those that have a share are as high; among 300 it is
    found inside, on sides and in corners."""
    rng = np.random.default_rng(4)
    factors, slope, share = rng.normal(size=(300, c, c)), rng.normal(size=(300, c)), rng.dirichlet(np.ones(c), 300)
    Q = factors @ factors.transpose(0, 2, 1) * 10.0 ** rng.uniform(-3, 1, size=(300, 1, 1)) + 1e-3 * np.eye(c)
    least = minimise_on_simplex(Q, slope, share)
    np.testing.assert_allclose(least.sum(axis=1), 1.0, rtol=1e-12)
    after = slope + np.einsum("kce,ke->kc", Q, least - share)
    over = after - np.einsum("kc,kc->k", after, least)[:, None]
    assert (least >= 0).all() and over.min() > -1e-11 and abs(over * (least > 0)).max() < 1e-11
    assert set((least > 0).sum(axis=1)) == set(range(1, c + 1))


@pytest.mark.parametrize("name", ["box", "rectangle"])
def test_the_deepest_place_does_not_depend_on_where_it_is_looked_for_first(name: str) -> None:
    """From a corner, or where it was before another obstacle."""
    placed, x = facets_near(name, 40)
    shares, start = find_closest_points(placed, x, SOFTEN).barycentric, np.zeros(x.shape[:2])
    start[np.arange(len(x)), np.random.default_rng(5).integers(x.shape[1], size=len(x))] = 1.0
    for begin in (start, np.roll(shares, 1, axis=0)):
        np.testing.assert_allclose(find_closest_points(placed, x, SOFTEN, begin).barycentric, shares, atol=1e-8)
    x[:] = x[:, :1]  # of a facet that is a point: its middle
    np.testing.assert_allclose(find_closest_points(placed, x, SOFTEN).barycentric, 1 / x.shape[1], atol=1e-12)


@pytest.mark.parametrize("name", SHAPES)
def test_forces_and_stiffness_are_derivatives(name: str) -> None:
    """By finite differences of the energy, and of the forces; the tangent's share is positive with that of corners."""
    placed, x = facets_near(name, 25)
    n, size = len(x), x[0].size
    found, h = acting(placed, x), 1e-6
    by_force, by_energy = np.zeros((n, size, size)), np.zeros((n, size))
    for place in range(size):
        e = np.zeros(size)
        e[place] = h
        up, down = (acting(placed, x + sign * e.reshape(x.shape[1:])) for sign in (1, -1))
        by_energy[:, place] = (up.energy - down.energy) / (2 * h)
        by_force[:, place] = -(up.forces - down.forces).reshape(n, -1) / (2 * h)
    scale = np.linalg.norm(found.forces.reshape(n, -1), axis=1)
    error = np.linalg.norm(found.forces.reshape(n, -1) + by_energy, axis=1)
    assert (error < 1e-5 * scale + 1e-7).all() and (scale > 0.1).sum() > n / 8
    exact = found.hessian
    np.testing.assert_allclose(exact, exact.transpose(0, 2, 1), atol=1e-9 * abs(exact).max())
    error = np.linalg.norm(exact - by_force, axis=(1, 2)) / (np.linalg.norm(exact, axis=(1, 2)) + 1.0)
    assert np.quantile(error, 0.9) < 1e-4  # the rest are at a kink of the curvature: where a rounded edge begins


def test_flat_against_flat_is_counted_once() -> None:
    """Before a plane the corners have counted all: lying flat or tilted, nothing is added, nor to the tangent."""
    rng = np.random.default_rng(2)
    placed = PosedShape(HalfSpace((0.0, 0.0, 1.0)), Pose.at_point(np.zeros(3)))
    x = rng.normal(size=(200, 3, 3))
    x[:, :, 2] = rng.uniform(0.3, 2.0, size=(200, 3)) * WIDTH
    x[:50, :, 2] = x[:50, :1, 2]
    found, own = acting(placed, x), np.abs(LAW.curvature(x[:, :, 2])).max()
    np.testing.assert_allclose(found.energy, 0.0, atol=1e-9 * LAW.energy(x[:, :, 2]).max())
    np.testing.assert_allclose(found.forces, 0.0, atol=1e-9 * own * WIDTH)
    np.testing.assert_allclose(found.hessian, 0.0, atol=1e-8 * own)


def test_facets_before_a_flat_side_have_no_forces() -> None:
    """Their parts are equal but for round-off; the least gap counts them. At the edge of a side a facet has forces."""
    placed = PosedShape(RoundedBox((2.0, 2.0, 2.0), 0.1), Pose.at_point(np.zeros(3)))
    corners = np.array([[-0.3, -0.3, 0.0], [0.3, -0.2, 0.0], [0.0, 0.4, 0.0]])
    over_side, over_edge = ([0.0, 0.0, 1.0 + 0.5 * WIDTH], [0.9, 0.0, 1.0 + 0.5 * WIDTH])
    x = np.concatenate([corners + over_side, corners + over_edge])
    facets = ContactFacets(np.arange(6).reshape(2, 3), np.ones(2), SOFTEN)
    found, stored, least_gap = evaluate_facets(facets, placed, x, LAW)
    np.testing.assert_array_equal(found.corners, [[3, 4, 5]])
    assert stored > 0
    both = acting(placed, x.reshape(2, 3, 3))
    assert least_gap == both.closest.gap.min() and abs(both.forces[0]).max() <= 1e-8 * abs(both.forces[1]).max()


def test_a_thin_free_plate_is_pushed_softly() -> None:
    """A block moves a free plate of 1 kg by some micrometres in a step: its velocity is that of the block, its momentum
    the impulse of the contact. Parts of the facets' forces are 1e6 times as large as the force that moves the plate."""
    gap = 5e-5
    block = {"shape": "box", "size": [1.2, 1.2, 0.5], "rounding": 0.01, "name": "block", "at": [0.5, 0.5, 0.251 + gap],
             "displacement": {"time": [0.0, 1.0], "value": [[0.0, 0.0, 0.0], [0.0, 0.0, -3 * gap]]}}  # fmt: skip
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 1.0, 1e-3], "h": 0.1}, boundary=[], obstacle=[block],
        material={"energy": "linear", "young": 1e7, "poisson": 0.0, "density": 1000.0},
        contact={"itself": False, "distance": 0.9 * gap}, time={"scheme": "backward-euler", "step": 0.05, "end": 0.2},
    )  # fmt: skip
    mass, impulse = scene.balance.mass.lumped, 0.0
    for report in each_step(scene, state):
        assert report.solve.newton_iterations <= 20
        impulse += 0.05 * scene.balance.contact.contacts[0].contact_forces()[2::3].sum()
    momentum = (mass * state.v)[2::3].sum()
    assert state.step == 4 and momentum == pytest.approx(impulse, rel=1e-5)
    assert momentum == pytest.approx(-3 * gap * mass[2::3].sum(), rel=1e-3)


def test_a_facet_over_a_ball_is_held_before_it_is_cut() -> None:
    """A triangle whose corners are far from a small ball in its middle: the energy has no bound as they meet."""
    placed = PosedShape(Sphere(0.05), Pose.at_point(np.zeros(3)))
    facet = ContactFacets(np.array([[0, 1, 2]]), np.array([1.0]), SOFTEN)
    turn = 2 * np.pi / 3 * np.arange(3)
    flat = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(3)])
    energies = []
    for gap in (2e-1, 5e-2, 2e-2, 1e-2, 7e-3, -1e-3):
        found, stored, _ = evaluate_facets(facet, placed, flat + np.array([0.0, 0.0, 0.05 + gap]), LAW)
        energies.append(stored)
        assert found.forces[:, :, 2].sum() > 0 or not 0 < gap < WIDTH
    assert energies[0] == 0 and (np.diff(energies) > 0).all() and energies[-1] == np.inf


@pytest.mark.parametrize("name", SHAPES)
def test_no_facet_near_an_obstacle_is_passed_over(name: str) -> None:
    """As points go from far to within it and on: of facets that are not `near` the deepest place is no nearer than was
    asked, and those that are not `closing` keep a tenth of their gaps on the way; nothing of them is nearer than what
    is `beyond`."""
    rng, shape = np.random.default_rng(6), SHAPES[name]
    placed, d = PosedShape(shape, Pose.at_point(np.full(shape.dim, 0.2))), shape.dim
    x = 0.3 * rng.normal(size=(80, d)) + 3.0
    corners = np.sort(np.stack([rng.permutation(80)[:d] for _ in range(120)]), axis=1)
    facets, skipped = ContactFacets(corners, np.ones(120), 1e-3), []
    for way in np.linspace(0.3, -0.9, 12):
        relative = way * (1 + 0.1 * rng.normal(size=x.shape))
        gaps = [find_closest_points(placed, (x + part * relative)[corners], 1e-3).gap for part in (0.0, 0.3, 0.6, 1.0)]
        reach = float(np.quantile(gaps[0], 0.1))
        assert placed.distance_bound(x) <= gaps[0].min() + facets.max_gap_error + 1e-12
        far = np.setdiff1d(np.arange(120), facets.within_reach(placed, x, reach))
        assert (gaps[0][far] >= reach).all()
        closing = facets.closing_facets(placed, x, relative, None, 1.2 * np.linalg.norm(relative, axis=1))
        free = np.setdiff1d(np.arange(120), closing)
        assert (np.min(gaps, axis=0)[free] >= 0.1 * gaps[0][free] - 1e-12).all()
        skipped += [len(far), len(free)]
        x = x + 0.3 * relative
    assert np.mean(skipped) > 30


@pytest.mark.parametrize("name", ["capsule", "box", "rectangle"])
def test_facets_before_what_turns_keep_a_tenth_of_their_gaps(name: str) -> None:
    """Small steps along the share of the ways that is safe, of points and a turning obstacle: by the deepest places at
    each. Facets allow less than their corners alone."""
    rng, shape = np.random.default_rng(7), SHAPES[name]
    placed, x = facets_near(name, 40)
    d, apart, itself = shape.dim, [], PosedShape(shape, Pose.at_point(np.zeros(shape.dim)))
    corners = np.arange(x.shape[0] * d).reshape(-1, d)
    facets = ContactFacets(corners, np.ones(len(corners)), SOFTEN)
    for far in (0.0, 0.1, 0.3):
        flat = (x + far * find_closest_points(placed, x, SOFTEN).normal[:, None]).reshape(-1, d)
        moved, q = 0.05 * rng.normal(size=flat.shape), np.r_[0.2 * rng.normal(size=d), rng.normal(size=2 * d - 3)]
        every = safe_motion_fractions(placed, flat, moved, q, facets)
        apart.append(float((safe_motion_fractions(placed, flat, moved, q) > every).mean()))
        gap = facets.closest_points(placed, flat, np.arange(len(corners))).gap
        # a known least gap changes nothing, however long the motion
        for part in (1e-3, 1e-2, 0.1, 1.0):
            way = placed, flat, part * moved, part * q, facets
            known = safe_motion_fractions(*way, min_gap=min(gap.min(), placed.distance(flat).min()))
            np.testing.assert_array_equal(known, safe_motion_fractions(*way))
        least = every[corners].min(axis=1)
        for part in np.linspace(0.0, 1.0, 5):
            ways = [(placed.pose.incremented(part * s * q), flat[c] + part * s * moved[c])
                    for c, s in zip(corners, least, strict=True)]  # fmt: skip
            seen = np.array([pose.to_body(places) for pose, places in ways])
            assert (find_closest_points(itself, seen, SOFTEN).gap > 0.1 * gap - 1e-9).all()
    assert max(apart) > 0.1


@pytest.mark.parametrize(("d", "c"), [(3, 1), (3, 3), (2, 2)])
def test_stiffness_of_points_at_their_nodes(d: int, c: int) -> None:
    """Points that depend on none to several nodes, some in several groups, against products of dense matrices."""
    rng = np.random.default_rng(1)
    W = np.where(rng.random((9, 6)) < 0.4, rng.normal(size=(9, 6)), 0.0)
    corners, blocks = rng.integers(0, 9, (7, c)), rng.normal(size=(7, c * d, c * d))
    dense = sum((R := np.kron(W[points], np.eye(d))).T @ B @ R for points, B in zip(corners, blocks, strict=True))
    found = nodal_stiffness(csr_matrix(W), [(corners, blocks)])
    np.testing.assert_allclose(found.toarray(), dense, atol=1e-13)
    points, of_points = rng.integers(0, 9, (4, 1)), rng.normal(size=(4, d, d))
    both = nodal_stiffness(csr_matrix(W), [(corners, blocks), (points, of_points)])
    alone = nodal_stiffness(csr_matrix(W), [(points, of_points)])
    np.testing.assert_allclose(both.toarray(), found.toarray() + alone.toarray(), atol=1e-13)
    assert not nodal_stiffness(csr_matrix(W), [(corners[:0], blocks[:0])]).nnz


@pytest.mark.parametrize("name", ["capsule", "rectangle"])
def test_gaps_at_the_start_of_a_step_are_those_of_its_points(name: str) -> None:
    """Facets asked for again with the same start, and then with that of another step, against facets that are new."""
    placed, corners = facets_near(name, 6)
    d, x = placed.shape.dim, corners.reshape(-1, placed.shape.dim)
    rng = np.random.default_rng(3)
    starts = [x + 0.01 * rng.normal(size=x.shape) for _ in range(2)]

    def made() -> ContactFacets:
        return ContactFacets(np.arange(len(x)).reshape(-1, d), np.ones(len(corners)), SOFTEN)

    kept, forces = made(), []
    for begun in (starts[0], starts[0], starts[1]):
        now = x + 0.005 * rng.normal(size=x.shape)
        found, *_ = evaluate_facets(kept, placed, now, LAW, (placed, begun))
        anew, *_ = evaluate_facets(made(), placed, now, LAW, (placed, begun.copy()))
        assert len(found.area) > 1  # facets before a flat side have no forces
        np.testing.assert_allclose(found.forces, anew.forces, atol=1e-7 * abs(anew.forces).max())
        other, *_ = evaluate_facets(made(), placed, now, LAW, (placed, x))
        forces.append(abs(found.forces - other.forces).max() / abs(other.forces).max())
    assert min(forces) > 1e-3  # the start matters


@pytest.mark.parametrize("name", ["capsule", "box", "rectangle"])
def test_what_facets_do_to_a_pose_is_a_derivative(name: str) -> None:
    """Gradient and Hessian of their energy by an increment of the pose, against differences; the same forces and
    stiffness on points and obstacle, from both sides."""
    placed, corners = facets_near(name, 6)
    d, x = placed.shape.dim, corners.reshape(-1, placed.shape.dim)
    facets = ContactFacets(np.arange(len(x)).reshape(-1, d), np.linspace(1.0, 2.0, len(corners)), SOFTEN)

    def felt(q: Values) -> ContactForces:
        there = PosedShape(placed.shape, placed.pose.incremented(q))
        return merge_forces(no_contact(d), *evaluate_facets(facets, there, x, LAW))

    p, h = 3 * d - 3, 1e-5
    steps, found = h * np.eye(p), felt(np.zeros(p))
    exact, positive = (PoseCoupling(found, x, placed.pose, None, placed.pose, exact=exact) for exact in (True, False))
    on = exact.derivatives()
    by_energy = [(felt(q).potential - felt(-q).potential) / (2 * h) for q in steps]
    np.testing.assert_allclose(on.gradient, by_energy, atol=1e-6 * abs(on.gradient).max())
    np.testing.assert_allclose(contact_wrench(found, x, placed.pose), -on.gradient, atol=1e-12 * abs(on.gradient).max())
    for way in np.random.default_rng(2).normal(size=(4, p)):
        twice = (felt(h * way).potential + felt(-h * way).potential - 2 * found.potential) / h**2
        assert twice == pytest.approx(way @ on.hessian @ way, abs=1e-3 * abs(on.hessian).max())
    arm = x[found.points] - placed.pose.centre
    J = np.concatenate([np.broadcast_to(-np.eye(d), (len(arm), d, d)), rotation_derivative(arm)], axis=2)
    both = np.einsum("nip,niq->pq", J, positive.mixed_hessian())
    stiffness = positive.derivatives().hessian
    np.testing.assert_allclose(both, stiffness, atol=1e-9 * abs(stiffness).max())


@pytest.mark.parametrize("name", ["capsule", "box", "rectangle"])
def test_forces_before_an_obstacle_that_spins_and_rubs(name: str) -> None:
    """How forces on points change with the pose, friction holding places that have turned by half a radian since the
    step began, against differences."""
    placed, corners = facets_near(name, 6)
    d, x = placed.shape.dim, corners.reshape(-1, placed.shape.dim)
    facets = ContactFacets(np.arange(len(x)).reshape(-1, d), np.linspace(1.0, 2.0, len(corners)), SOFTEN)
    p, h = 3 * d - 3, 1e-6
    then = placed.pose.incremented(np.concatenate([0.02 * np.ones(d), 0.5 * np.ones(p - d)]))
    inner, *_ = evaluate_facets(facets, placed, x, LAW)
    held = add_facet_friction(lag_contact(x, placed.distance(x), np.ones(len(x)), placed, LAW), inner, x)
    rub = CoulombFriction(0.3, 0.05)
    assert len(held.points) > 4

    def felt(q: Values) -> ContactForces:
        there = PosedShape(placed.shape, placed.pose.incremented(q))
        way = there.pose.points_to_space(then.to_body(held.obstacle_point)) - held.obstacle_point
        return merge_forces(
            evaluate_points(x, np.ones(len(x)), there, LAW, held, rub, way), *evaluate_facets(facets, there, x, LAW)
        )

    steps, found = h * np.eye(p), felt(np.zeros(p))
    exact, positive = (PoseCoupling(found, x, placed.pose, held, then, exact=exact) for exact in (True, False))
    mixed = exact.mixed_hessian()
    for k, q in enumerate(steps):
        up, down = felt(q), felt(-q)
        forces = (down.normal + down.friction - up.normal - up.friction) / (2 * h)
        np.testing.assert_allclose(mixed[:, :, k], forces, atol=1e-5 * abs(mixed).max())
    on = exact.derivatives()
    by_energy = [(felt(q).potential - felt(-q).potential) / (2 * h) for q in steps]
    np.testing.assert_allclose(on.gradient, by_energy, atol=1e-5 * abs(on.gradient).max())
    # what is left of the points once the pose has given way is a potential that goes up: CG may solve with it
    rough, C = positive.mixed_hessian(), np.linalg.inv(positive.derivatives().hessian + 1e-6 * np.eye(p))
    K = block_diag(*found.tangent(exact=False))
    for of, block in zip(np.searchsorted(found.points, inner.corners), inner.stiffness, strict=True):
        at = (d * of[:, None] + np.arange(d)).reshape(-1)
        K[np.ix_(at, at)] += block
    U = rough.reshape(-1, p)
    assert np.linalg.eigvalsh(K - U @ C @ U.T).min() > -1e-9 * abs(K).max()


# --- in a run ---


def pressed(dim: int, radius: float, depth: float) -> dict[str, Any]:
    """A coarse block on a base that a ball is pressed into, over the middle of a facet."""
    over = [0.33, 0.17] if dim == 3 else [0.5]
    down = [0.0] * (dim - 1) + [-depth - 0.02]
    return {
        "mesh": {"builder": "box", "size": [1.0] * dim, "h": 0.5 if dim == 3 else 0.34},
        "material": {"energy": "neo-hookean", "young": 1e4, "poisson": 0.3, "density": 1.0},
        "boundary": [{"on": "bottom", "fix": "xyz"[:dim]}], "probe": [{"name": "base", "on": "bottom"}],
        "obstacle": [{"name": "ball", "shape": "sphere", "radius": radius, "at": [*over, 1.02 + radius],
                      "displacement": {"time": [0.0, 1.0], "value": [[0.0] * dim, down]}}],
        "time": {"scheme": "quasi-static", "step": 0.25, "end": 1.0}, "solver": {"snes_rtol": 1e-9, "ksp_rtol": 1e-9},
    }  # fmt: skip


@pytest.mark.parametrize(("dim", "radius"), [(2, 0.3), (2, 0.02), (3, 0.3), (3, 0.05)])
def test_no_facet_is_cut(dim: int, radius: float) -> None:
    """Of a ball, which may be far smaller than an edge, every place of every facet is outside, though their corners
    are far from it: by dense sampling of the boundary of the mesh. The base carries what the ball presses with, and the
    work of that is stored."""
    scene, state = make_scene(**pressed(dim, radius, 0.06))
    data = scene.domain.input_mesh
    assert data is not None
    top = data.facet_groups["top"]
    shares = np.stack(np.meshgrid(*[np.arange(31)] * dim, indexing="ij"), axis=-1).reshape(-1, dim) / 30
    shares = shares[abs(shares.sum(axis=1) - 1) < 1e-9]
    for report in each_step(scene, state):  # noqa: B007
        u = scene.domain.input_numbering.gather_nodes(state.u.reshape(-1, dim))
        assert u is not None
        x = (data.points + u)[top]
        centre = np.array(scene.study.obstacle[0].at) - [*[0.0] * (dim - 1), 0.08 * state.t]
        from_centre = np.linalg.norm(np.einsum("sc,kcd->ksd", shares, x) - centre, axis=2)
        assert from_centre.min() > radius
        assert radius > 0.1 or np.linalg.norm(x - centre, axis=2).min() > radius + 0.05  # no corner is in touch
    assert from_centre.min() < radius + 0.05 * 0.7
    force = scene.probes()[: 2 * dim].reshape(2, dim)
    np.testing.assert_allclose(force[0], force[1], atol=1e-6 * abs(force).max())
    assert abs(force).max() > 20
    assert state.work == pytest.approx(report.elastic, rel=0.05)  # trapezia in a barrier


def test_what_breaks_under_a_ball_gains_nothing() -> None:
    """Edges around a ball that presses on facets break: new walls are drawn in or left out, so that no facet that acts
    is cut and no more is stored than before; and a checkpoint knows those that are left out."""
    scene, state = make_scene(
        **pressed(3, 0.3, 0.1) | {"fracture": {"strength": 1e9}, "time": {"scheme": "backward-euler", "step": 0.5,
                                                                           "end": 1.0}}
    )  # fmt: skip
    march(scene, state)
    (contact,) = [term for term in scene.balance.terms if isinstance(term, ObstacleTerm)]
    before, graph = contact.stored_energy(), scene.fracture.graph
    assert before > 0
    graph.break_edges(np.random.default_rng(3).random(len(graph.broken)) < 0.5)
    scene.fracture.mark_changed()
    scene.balance.edges_broke(graph.pattern)
    assert contact.stored_energy() <= before * (1 + 1e-6)
    skin, placed = contact.surface, contact.group.posed[0]
    x = skin.positions(contact.end_displacement)
    assert (contact.surface.facets.gaps(placed, x, 1.0) > 0).all()
    left_out = contact.surface._excluded
    assert len(left_out) > 0 and len(contact.surface.facets.area) > 100
    contact.surface.from_checkpoint(contact.surface.to_checkpoint())
    np.testing.assert_array_equal(contact.surface._excluded, left_out)
    # what is drawn: all of it, beside the ball
    skeleton, u = EntityNumbering(scene.domain.input_mesh), contact.end_displacement
    pattern = scene.domain.input_numbering.gather_cells(scene.fracture.graph.pattern)
    split = build_split_surface(skeleton, pattern)
    surface = drawn_at(skeleton, pattern, split, scene.domain.input_numbering.gather_nodes(u.reshape(-1, 3)))
    whole, shares = surface.placed_points(), np.random.default_rng(1).dirichlet(np.full(3, 0.7), 200)
    least = [
        placed.distance(np.einsum("sc,kcd->ksd", shares, each.rest[split.elements]).reshape(-1, 3)).min()
        for each in (whole, contact.separate_surface(whole, surface, u, state.t))
    ]
    assert least[0] < 0 < least[1]
