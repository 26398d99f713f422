"""Bodies that move, are struck and break: what of contact is a blow and what a load, and what it leaves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

pytest.importorskip("mujoco", reason="an environment made without a network")

from fracsim.contact.obstacle import RigidObstacle
from fracsim.contact.shapes import Sphere
from fracsim.mesh.split_surface.entity_numbering import EntityNumbering
from fracsim.meshes.data import MeshData
from fracsim.rigid.convex_decomposition import Polyhedron, convex_parts
from fracsim.rigid.engine import Engine
from fracsim.rigid.fragment_geometry import FragmentGeometry
from fracsim.rigid.impact_detection import BodyLoad, ImpactDetector, _rows_of
from fracsim.rigid.mujoco_model import ContactParameters
from fracsim.rigid.rigid_stepper import RigidState, RigidStepper
from fracsim.rigid.surface_loads import HertzContact
from support.falling import CUBE, DOWN, MASS, G, cubes, floor, stepper_of
from support.rigid import DENSITY, section_mean
from support.solids import copies, lattice, patterns, separated

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
TAU = 2e-3


def bar(above: float = 0.05) -> MeshData:
    """3 x 1 x 1 m over the floor."""
    mesh = lattice(12, 4, 4, size=0.25)
    mesh.points[:, 2] += above
    return mesh


def moving(stepper: RigidStepper, velocity: Values, spin: Values | None = None) -> RigidState:
    """The start of a run with all bodies moving."""
    state = stepper.start()
    bodies = state.bodies
    turning = bodies.spin if spin is None else bodies.spin + spin
    return replace(state, bodies=replace(bodies, velocity=bodies.velocity + velocity, spin=turning))


def go(stepper: RigidStepper, state: RigidState, end: float) -> RigidState:
    """On to a time."""
    while state.t < end * (1 - 1e-9):
        state, _ = stepper.advance(state)
    return state


# --- blows and loads ---


def test_rows_of_each_body_are_those_that_name_it() -> None:
    """Among numbers in any order: as looked for one by one, in their order, none of what is not there."""
    of = np.random.default_rng(0).integers(0, 9, 50)
    wanted = np.array([2, 5, 8, 11])
    for number, rows in zip(wanted, _rows_of(of, wanted), strict=True):
        assert np.array_equal(rows, np.flatnonzero(of == number))


def tau(first: Ints, second: Ints, speed: Values) -> Values:
    """TAU of every blow."""
    return np.full(len(first), TAU)


def at_points(first: Ints, second: Ints) -> Values:
    """Nothing spreads."""
    return np.zeros(len(first))


def strains(step: float, height: float) -> list[BodyLoad]:
    """Of a cube that is dropped on another one on the floor, in half a second."""
    bodies = cubes([[0.0, 0.0, 0.5], [0.0, 0.0, 1.5 + height]])
    engine, names = Engine(bodies, [[CUBE]] * 2, [floor()], ContactParameters(step, DOWN, 0.5)), np.arange(2)
    blows, found = ImpactDetector(step, 2 * G * step, tau, at_points), []
    for _ in range(round(0.5 / step)):
        after, touches = engine.advance(bodies)
        found += blows.find_loads(touches, bodies, names)
        blows.record_step(touches, bodies, names)
        bodies = after
    return found


@pytest.mark.parametrize("step", [4e-3, 1e-3])
def test_a_blow_has_its_whole_impulse_and_is_passed_on(step: float) -> None:
    """m v of the falling cube acts for tau on both cubes, and through the lower one on the floor, whatever the step;
    later both bear their weights, 1 and 2 m g."""
    found = strains(step, 0.2)
    speed = np.sqrt(2 * G * 0.2)
    first = {each.body_number: each for each in found[::-1] if each.speed > 0.5}
    assert first[1].speed == pytest.approx(speed, rel=0.02)
    assert np.linalg.norm(first[1].force.sum(axis=0)) * TAU == pytest.approx(MASS * speed, rel=0.07)
    down = first[0].force[:, 2].clip(max=0).sum() * TAU
    up = first[0].force[:, 2].clip(min=0).sum() * TAU
    assert -down == pytest.approx(MASS * speed, rel=0.15) and up == pytest.approx(MASS * speed, rel=0.15)
    loads = {each.body_number: each for each in found if not each.speed}
    assert loads[1].force[:, 2].sum() == pytest.approx(MASS * G, rel=0.1)
    assert np.abs(loads[0].force[:, 2]).sum() == pytest.approx(3 * MASS * G, rel=0.1)


def test_what_rests_is_not_struck() -> None:
    """A cube on the floor: one load, no blow."""
    bodies = cubes([[0.0, 0.0, 0.5]])
    engine, blows, found = (
        Engine(bodies, [[CUBE]], [floor()], ContactParameters(2e-3, DOWN)),
        ImpactDetector(2e-3, 4e-3 * G, tau, at_points),
        [],
    )
    for _ in range(200):
        after, touches = engine.advance(bodies)
        found += blows.find_loads(touches, bodies, np.arange(1))
        blows.record_step(touches, bodies, np.arange(1))
        bodies = after
    assert found and not any(each.speed for each in found)
    assert found[-1].force[:, 2].sum() == pytest.approx(MASS * G, rel=0.1)


def test_hertz_time_of_two_equal_balls() -> None:
    """tau = 2.87 (m*^2 / (R* E*^2 v))^(1/5): two glass balls of 10 mm at 1 m/s touch for 57 microseconds, by the
    integral of the equation of motion m* x'' = -4/3 E* sqrt(R*) x^(3/2)."""
    young, poisson, radius, speed = 7e10, 0.22, 0.01, 1.0
    mass = 2500 * 4 / 3 * np.pi * radius**3 / 2
    stiff = 4 / 3 * young / (1 - poisson**2) / 2 * np.sqrt(radius / 2)
    x, v, t, dt = 0.0, speed, 0.0, 1e-8
    while x >= 0:
        v -= dt * stiff * max(x, 0.0) ** 1.5 / mass
        x, t = x + dt * v, t + dt
    duration = HertzContact(young, poisson).duration(*np.array([[mass], [radius / 2], [speed], [1]]))
    assert duration == pytest.approx(t, rel=5e-3)


def test_a_block_that_rests_carries_its_weight() -> None:
    """From the contact forces of the engine: rho g (H - z) in every layer but those that touch."""
    mesh = lattice(4, 4, 8, size=0.25)
    stepper = stepper_of(mesh, 1e12, 1e-3)
    state, body = go(stepper, stepper.start(), 0.1), stepper.instances.get(0)
    assert stepper._engine is not None
    _, touches = stepper._engine.advance(state.bodies)
    points, impulse = touches.received_by(0)
    loads = body.distribute_forces(0, state.bodies.to_reference(points, 0), impulse / 1e-3)
    sigma = body.analyses.analyse(0, loads)[:, 2]
    for low in (0.5, 0.75, 1.0, 1.25, 1.5, 1.75):
        expected = -DENSITY * G * (2.0 - low - 0.125)
        assert section_mean(body.graph.domain, sigma, 2, low, low + 0.25) == pytest.approx(expected, rel=0.02)


# --- breaking ---


def test_the_crack_of_a_blow_does_not_depend_on_the_step() -> None:
    """A bar that comes down askew, at dt, dt/2 and dt/4: the same edges, some 400 of them."""
    found = []
    for step in (1e-3, 5e-4, 2.5e-4):
        stepper = stepper_of(bar(0.02), 2e5, step, contact_time=TAU)
        state = moving(stepper, np.array([0.0, 0.0, -3.0]), np.array([0.0, 1.0, 0.0]))
        broken = 0
        while not broken:
            state, report = stepper.advance(state)
            broken = report.broken
        found.append(stepper.instances.get(0).graph.broken.copy())
    assert np.array_equal(found[0], found[1]) and np.array_equal(found[0], found[2])


def test_momentum_is_kept_through_a_fracture() -> None:
    """Two bars in free space collide and break: m v and m x x v + I w of all pieces stay."""
    mesh = copies(lattice(6, 2, 2, size=0.25), 2)
    mesh.points[len(mesh.points) // 2 :] += [-1.0, 0.3, 0.7]
    stepper = stepper_of(mesh, 2e5, 1e-3, gravity=0 * DOWN, obstacles=[], contact_time=TAU)
    state = stepper.start()
    velocity = np.array([[0.0, 0.0, 6.0], [0.0, 0.0, -4.0]])
    state = replace(state, bodies=replace(state.bodies, velocity=velocity))
    after = go(stepper, state, 0.1)
    assert len(after.bodies) > 3
    size = float(state.bodies.mass.sum()) * 6
    assert np.allclose(after.bodies.momentum, state.bodies.momentum, atol=1e-9 * size)
    assert np.allclose(after.bodies.angular_momentum, state.bodies.angular_momentum, atol=1e-9 * size)
    assert after.bodies.mass.sum() == pytest.approx(state.bodies.mass.sum(), rel=1e-13)


def cell_sums(mesh: MeshData) -> tuple[float, Values, Values]:
    """Mass, centre of mass and second moments of mass about the origin of the cells of a mesh."""
    x = mesh.points[mesh.cells]
    mass = DENSITY * np.abs(np.linalg.det(x[:, 1:] - x[:, :1])) / 6
    total = x.sum(axis=1)
    second = np.einsum("c,cni,cnj->ij", mass, x, x) + np.einsum("c,ci,cj->ij", mass, total, total)
    return mass.sum(), mass @ total / 4 / mass.sum(), second / 20


def test_mass_centre_inertia_and_momenta_are_kept_through_many_fractures() -> None:
    """A bar is cut, and its fragments again and again, all of which fly and spin on their own.

    Cells that two fragments share are cut anew. Masses, centres and inertia at rest sum to those of the cells, and
    momentum and angular momentum stay. Fragments that keep their shape keep their motion, neighbours their velocities.
    """
    stepper = stepper_of(bar(), 1e12, 1e-3, gravity=0 * DOWN, obstacles=[])
    mass, centre, second = cell_sums(bar())
    inertia = np.trace(second) * np.eye(3) - second
    bodies = stepper.start().bodies
    body, random = stepper.instances.get(0), np.random.default_rng(5)
    edges, of_input = body.graph.edge_nodes, body.graph.domain.input_numbering.nodes
    neighbours = 0
    for _ in range(15):
        n = len(bodies)
        move = {"velocity": 5 * random.normal(size=(n, 3)), "spin": 5 * random.normal(size=(n, 3))}
        bodies = replace(bodies, position=bodies.position + random.random((n, 3)), **move)
        inside = np.ptp(body.fragments.node_fragment[edges], axis=1) == 0
        fragment = random.choice(body.fragments.node_fragment[edges[inside, 0]])
        inside &= body.fragments.node_fragment[edges[:, 0]] == fragment
        height = body.graph.domain.nodes[edges] @ random.normal(size=3)
        at = height[inside].mean()
        crosses = np.flatnonzero(inside & (height.min(axis=1) < at) & (height.max(axis=1) > at))
        body._criterion.set_cuts(crosses, ((at - height[:, 0]) / np.diff(height)[:, 0])[crosses])
        body.graph.break_edges(np.isin(np.arange(len(edges)), crosses))
        name = int(of_input[body.fragments.node_fragment == fragment].min())
        body.fragments.update()
        before, names = bodies, list(stepper.shapes.names)
        bodies = stepper._replace_by_fragments(before, {name})
        assert np.array_equal(bodies.centre, stepper.shapes.moments.centre), "where bodies are drawn"
        X = bodies.centre
        assert bodies.mass.sum() == pytest.approx(mass, rel=1e-12)
        assert np.allclose(bodies.mass @ X / mass, centre, rtol=1e-12)
        arms = np.einsum("n,ni,ni->", bodies.mass, X, X) * np.eye(3) - np.einsum("n,ni,nj->ij", bodies.mass, X, X)
        assert np.allclose(bodies.inertia.sum(axis=0) + arms, inertia, rtol=0, atol=1e-12 * np.trace(inertia))
        assert np.allclose(bodies.momentum, before.momentum, rtol=0, atol=1e-12 * mass * 10)
        assert np.allclose(bodies.angular_momentum, before.angular_momentum, rtol=0, atol=1e-11 * mass * 10)
        for row, own in enumerate(stepper.shapes.names):
            if own != name and own in names:
                parent = names.index(own)
                position = before.to_current(X[[row]], np.array([parent]))
                velocity = before.velocity_at(position, np.array([parent]))[0]
                assert np.allclose(bodies.velocity[row], velocity, rtol=1e-12, atol=1e-12)
                assert np.array_equal(bodies.spin[row], before.spin[parent])
                neighbours += bodies.mass[row] != before.mass[parent]
    assert len(bodies) > 15 and neighbours > 3


def test_a_body_broken_at_rest_stays_where_it_is() -> None:
    """Without gravity: hulls that overlap along the crack do not push the pieces apart."""
    stepper = stepper_of(bar(), 1e3, 1e-3, gravity=0 * DOWN, obstacles=[])
    body, state = stepper.instances.get(0), stepper.start()
    points, force = np.array([[1.5, 0.5, 1.05], [0.1, 0.5, 0.05], [2.9, 0.5, 0.05]]), np.diag([1e5, 1e5, 1e5])
    body.break_fragments(0, body.distribute_forces(0, points, force))
    broken = stepper._replace_by_fragments(state.bodies, {0})
    assert len(broken) > 3
    after = go(stepper, RigidState(0.0, 0, broken), 0.02)
    assert np.array_equal(after.bodies.position, broken.position) and after.bodies.kinetic_energy == 0


def test_an_obstacle_strikes_what_it_is_driven_into() -> None:
    """A ball driven sideways into a bar that floats: the bar breaks where it is hit, and the ball has done work."""
    ball = RigidObstacle("ball", Sphere(0.2, 3), np.array([1.5, -0.3, 0.5]), lambda t: np.array([0.0, 8.0 * t, 0.0]))
    stepper = stepper_of(bar(0.0), 2e5, 1e-3, gravity=0 * DOWN, obstacles=[ball])
    state, broken, worked = stepper.start(), 0, 0.0
    for _ in range(25):
        state, report = stepper.advance(state)
        broken, worked = broken + report.broken, worked + float(report.obstacle_work[0])
    assert broken and len(state.bodies) > 1
    assert (
        state.bodies.momentum[1] > 1000 and worked == pytest.approx(state.work) and worked > state.bodies.kinetic_energy
    )


def test_bodies_that_were_not_struck_are_not_analysed() -> None:
    """Of two bars the one that flies alone costs nothing but its motion."""
    mesh = copies(bar(), 2)
    mesh.points[len(mesh.points) // 2 :, 2] += 50.0
    stepper = stepper_of(mesh, 1e12, 2e-3)
    go(stepper, moving(stepper, np.array([0.0, 0.0, -3.0])), 0.05)
    assert stepper.instances.analyses == 0, "too strong to break under this blow: no analysis at all"
    weak = stepper_of(mesh, 1e6, 2e-3)
    go(weak, moving(weak, np.array([0.0, 0.0, -3.0])), 0.05)
    assert weak.instances.analyses > 0
    body = weak.instances.get(0)
    assert set(body.analyses._bodies) <= set(np.flatnonzero(body.graph.domain.nodes[:, 2] < 10))


# --- shapes ---


def test_hulls_cover_their_body_and_little_else() -> None:
    """An L of ten cubes: two or three boxes; of one box, one hull, its eight corners."""
    mesh = lattice(6, 2, 6)
    kept = np.flatnonzero((mesh.points[mesh.cells].mean(axis=1)[:, ::2] < 2).any(axis=1))
    for cells, most in ((mesh.cells, 1), (mesh.cells[kept], 3)):
        parts = convex_parts(Polyhedron.from_triangles(mesh.points, surface_of(cells)))
        assert len(parts) <= most
        assert min(len(part) for part in parts) == 8
        inside = mesh.points[cells].mean(axis=1)
        assert np.any([(part.min(axis=0) <= inside).all(axis=1) & (part.max(axis=0) >= inside).all(axis=1)
                       for part in parts], axis=0).all()  # fmt: skip


def surface_of(cells: Ints) -> Ints:
    """(m, 3) triangles with normals outwards that one cell alone has."""
    every = cells[:, [[1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1]]].reshape(-1, 3)
    _, place, count = np.unique(np.sort(every, axis=1), axis=0, return_index=True, return_counts=True)
    return every[place[count == 1]]


def test_halves_of_a_solid_are_closed_and_as_large_as_it() -> None:
    """Cut askew, where the section of an L is not convex or is in two, and the halves again: volumes and first moments
    sum up, and no part reaches over its planes."""
    mesh = lattice(6, 2, 6)
    kept = mesh.cells[(mesh.points[mesh.cells].mean(axis=1)[:, ::2] < 2).any(axis=1)]
    whole = Polyhedron.from_triangles(mesh.points, surface_of(kept))
    rng = np.random.default_rng(4)
    solids, left = [whole], [whole]
    for _ in range(3):
        left, solids = solids, []
        for solid in left:
            at, normal = whole.moments.centre[0], rng.normal(size=3)
            up, down = solid.cut_by_plane(at, normal)
            solids += [up, down]
            assert ((up.points - at) @ normal).min() > -1e-9 and ((down.points - at) @ normal).max() < 1e-9
    volume = np.array([solid.moments.volume[0] for solid in solids])
    centre = np.array([solid.moments.centre[0] for solid in solids])
    assert volume.min() > 0 and volume.sum() == pytest.approx(whole.moments.volume[0], rel=1e-12)
    assert np.allclose(volume @ centre, whole.moments.volume[0] * whole.moments.centre[0], atol=1e-9)


def test_flat_parts_are_made_a_little_thick() -> None:
    """Four points in a plane, and four in line: a hundredth of their length, so that they collide."""
    for points in ([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], [[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0]]):
        flat = np.array(points)
        (part,) = convex_parts(Polyhedron.from_triangles(flat, np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])))
        widths = np.linalg.svd(part - part.mean(axis=0))[1]
        assert widths.min() > 5e-3 and part.min(axis=0) == pytest.approx(flat.min(axis=0), abs=0.02)
        bodies = cubes([[0.0, 0.0, 0.0]])
        assert Engine(bodies, [[part]], [], ContactParameters(1e-3, DOWN)).advance(bodies)


def test_shapes_of_pieces_lie_where_the_split_surface_is() -> None:
    """A block cut across: hulls of each piece end at the cut; what has not changed is not made again."""
    mesh = lattice(4, 2, 2)
    skeleton = EntityNumbering(mesh)
    broken = separated(skeleton, (mesh.points[:, 0] > 2.5).astype(int))
    geometry = FragmentGeometry(mesh)
    whole = geometry.update_shapes({})
    cut = np.where(broken, np.abs(2.5 - mesh.points[skeleton.edges][:, 0, 0]), np.nan)
    halves = geometry.update_shapes({0: (patterns(skeleton, broken), cut)})
    assert len(whole.convex_parts) == 1 and len(halves.convex_parts) == 2
    for number, (low, high) in enumerate(((0.0, 2.5), (2.5, 4.0))):
        corners = np.concatenate(halves.convex_parts[number]) + halves.moments.centre[number]
        assert corners[:, 0].min() == pytest.approx(low) and corners[:, 0].max() == pytest.approx(high)
    again = geometry.update_shapes({0: (patterns(skeleton, broken), cut)})
    assert all(a is b for a, b in zip(again.convex_parts, halves.convex_parts, strict=True))


def test_shapes_are_the_same_to_the_last_digit_however_the_cracks_got_there() -> None:
    """A block in halves of which one edge more breaks, cut a hair elsewhere: hulls, outermost points and moments are
    those of a geometry that has not seen the halves before, as after a restart."""
    mesh = lattice(4, 2, 2)
    skeleton = EntityNumbering(mesh)
    broken = separated(skeleton, (mesh.points[:, 0] > 1.5).astype(int))
    geometry = FragmentGeometry(mesh)
    geometry.update_shapes({0: (patterns(skeleton, broken), np.where(broken, 0.5, np.nan))})
    broken[np.flatnonzero(~broken)[-1]] = True
    damage = {0: (patterns(skeleton, broken), np.where(broken, 0.5 + 1e-12, np.nan))}
    found, expected = geometry.update_shapes(damage), FragmentGeometry(mesh).update_shapes(damage)
    assert len(found.convex_parts) == 2
    shapes = ((*made.convex_parts, made.hull_points) for made in (found, expected))
    for mine, other in zip(*shapes, strict=True):
        assert all(np.array_equal(a, b) for a, b in zip(mine, other, strict=True))
    assert np.array_equal(found.moments.second, expected.moments.second)
