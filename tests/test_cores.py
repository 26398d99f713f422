"""Nodes of pieces in the cores of others, against barycentric coordinates and VTK's distances."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import pytest
import pyvista
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

pytest.importorskip("mujoco", reason="an environment made without a network")

from fracsim.rigid.bodies import Bodies
from fracsim.rigid.core_contact import SETTINGS, CoreContact, CoreGeometry
from fracsim.rigid.rigid_stepper import RigidState, RigidStepper
from fracsim.scene.rigid_scene import build_rigid_scene
from fracsim.study.reader import load_study
from support.falling import DOWN, stepper_of
from support.solids import copies
from test_pieces_apart import as_placed, in_cells
from test_struck_bodies import bar

Values = npt.NDArray[np.float64]
Found = dict[tuple[int, int], Values]
STEP = 1e-3


@cache
def broken() -> tuple[RigidStepper, RigidState]:
    """Two bars that have met, in pieces, where these broke."""
    mesh = copies(bar(0.0), 2)
    mesh.points[len(mesh.points) // 2 :] += [1.0, 0.2, 1.3]
    stepper = stepper_of(mesh, 2e5, STEP, gravity=0 * DOWN, obstacles=[], surfaces=20)
    state = stepper.start()
    speed: Values = np.array([[0.0, 0.0, 10.0], [0.0, 0.0, -10.0]])
    state = replace(state, bodies=replace(state.bodies, velocity=speed))
    for _ in range(60):
        state, _ = stepper.advance(state)
        if len(state.bodies) > 7:
            break
    assert len(state.bodies) > 7
    return stepper, state


@cache
def shot() -> tuple[RigidStepper, RigidState]:
    """A slab that lies elsewhere than its mesh and is turned, in pieces."""
    body = "body=[{position=[0.4,0.0,0.3],rotation=[0.0,0.0,1.5707963]}]"
    scene = build_rigid_scene(load_study("rigid-slab", [body, "time.end=2e-3"]))
    state, _ = scene.stepper.advance(scene.initial_state)
    count = scene.stepper.fragment_count
    assert count > 7
    return scene.stepper, replace(state, bodies=state.bodies.select(slice(count)))


def fresh(stepper: RigidStepper) -> CoreContact:
    """As pieces broke, nothing being known of where they have been."""
    made = stepper._geometry._make_core_contact(stepper.shapes.rotation)
    assert made is not None
    return made


def pairs(stepper: RigidStepper) -> npt.NDArray[np.int64]:
    """All of pieces."""
    return np.stack(np.triu_indices(len(stepper.shapes.names), 1), axis=1)


def shaken(stepper: RigidStepper, bodies: Bodies, much: float, seed: int) -> Bodies:
    """The bodies at rest, moved and turned by up to `much` of an edge."""
    random, rest = np.random.default_rng(seed), np.tile(np.eye(3), (len(bodies), 1, 1))
    way = much * stepper._geometry.mean_edge
    turn = Rotation.from_rotvec(random.uniform(-0.1, 0.1, (len(bodies), 3)) * much).as_matrix()
    return replace(bodies, position=bodies.centre + random.uniform(-way, way, (len(bodies), 3)), rotation=turn @ rest)


def told(cores: CoreContact, stepper: RigidStepper, bodies: Bodies) -> Found:
    """Depths of nodes in cores, the deepest first, of pairs (whose core, whose nodes), m."""
    things, _, depth, _ = cores.find_deepest(pairs(stepper), bodies)
    found = Found()
    for (first, second), each in zip(things, depth, strict=True):
        key = int(first), int(second)
        found[key] = np.append(found.get(key, np.empty(0)), each)
    return found


def looked_at(stepper: RigidStepper, bodies: Bodies) -> Found:
    """The same by other means: nodes that are in whole cells, and how far from the faces that these share with torn
    ones."""
    body = stepper.instances.get(0)
    domain, of_node, found = body.graph.domain, body.fragments.node_fragment, Found()
    nodes = as_placed(stepper, domain.nodes)
    of_cell, x = of_node[domain.cell_nodes], bodies.to_current(nodes, of_node)
    whole = np.all(of_cell == of_cell[:, :1], axis=1)
    sides = np.sort(domain.cell_nodes[:, [0, 1, 2, 0, 1, 3, 0, 2, 3, 1, 2, 3]].reshape(-1, 3))
    _, facet, count = np.unique(sides, axis=0, return_inverse=True, return_counts=True)
    facet = facet.reshape(-1, 4)
    beside = (count == 2) & (np.bincount(facet[whole].ravel(), minlength=len(count)) == 1)
    skeleton = stepper._geometry.numbering
    torn = np.unique(skeleton.edges[skeleton.broken_edges(body.input_damage()[0])])
    torn = cKDTree(domain.nodes).query(skeleton.points[torn])[1]  # as the domain numbers them
    for piece in range(len(bodies)):
        mine = np.flatnonzero(whole & (of_cell[:, 0] == piece))
        faces = sides.reshape(-1, 4, 3)[mine][beside[facet[mine]]]
        if not len(faces):
            continue
        rows = torn[of_node[torn] != piece]
        X = bodies.to_reference(x[rows], piece)
        inside = in_cells(X, nodes[domain.cell_nodes[mine]])
        if not inside.any():
            continue
        surface = pyvista.make_tri_mesh(nodes, faces)
        depth = np.abs(pyvista.PolyData(X[inside]).compute_implicit_distance(surface)["implicit_distance"])
        for other in np.unique(of_node[rows[inside]]):
            each = np.sort(depth[of_node[rows[inside]] == other])[::-1]
            edge = stepper._geometry.mean_edge
            low, high = SETTINGS.tolerance * edge, SETTINGS.search_radius * edge
            each = each[(each > low) & (each < high)][: SETTINGS.max_nodes]
            if len(each):
                found[piece, int(other)] = each
    return found


def same(one: Found, other: Found) -> None:
    """To round-off."""
    assert one.keys() == other.keys()
    assert all(np.allclose(one[key], other[key], rtol=1e-6, atol=1e-9) for key in one)


@pytest.mark.parametrize("much", [0.6, 0.8])
def test_nodes_in_cores_are_those_in_whole_cells(much: float) -> None:
    """As deep, of pieces that are moved and turned at random."""
    stepper, state = broken()
    some = 0
    for seed in range(4):
        bodies = shaken(stepper, state.bodies, much, seed)
        expected = looked_at(stepper, bodies)
        same(told(fresh(stepper), stepper, bodies), expected)
        some += len(expected)
    assert some > 10


def test_nodes_in_cores_of_a_body_that_lies_elsewhere_than_its_mesh_are_those_in_whole_cells() -> None:
    """And turned: where a ball has shot through it, and as its pieces are moved at random."""
    stepper, state = shot()
    ways = [shaken(stepper, state.bodies, 0.6, seed) for seed in range(2)]
    found = [looked_at(stepper, each) for each in (state.bodies, *ways)]
    for bodies, expected in zip((state.bodies, *ways), found, strict=True):
        same(told(fresh(stepper), stepper, bodies), expected)
    assert sum(map(len, found)) > 10


def test_what_has_moved_step_by_step_is_found_as_what_is_looked_at_once() -> None:
    """Nodes are looked at again when they may have come into a core, and no later."""
    stepper, state = broken()
    followed, some = fresh(stepper), 0
    ways = [shaken(stepper, state.bodies, 0.6, seed) for seed in range(3)]
    places = [state.bodies.centre, *(each.position for each in ways)]
    for start, end in pairwise(places):
        for share in np.linspace(0.0, 1.0, 15):
            bodies = replace(ways[0], position=(1 - share) * start + share * end)
            found = told(followed, stepper, bodies)
            same(found, told(fresh(stepper), stepper, bodies))
            some += len(found)
    assert some > 10


def test_as_pieces_break_no_node_is_in_a_core() -> None:
    """And one that does not move is not looked at."""
    stepper, state = broken()
    rest = replace(state.bodies, position=state.bodies.centre, rotation=np.tile(np.eye(3), (len(state.bodies), 1, 1)))
    assert not told(fresh(stepper), stepper, rest) and not looked_at(stepper, rest)


def test_a_node_that_would_come_into_a_core_touches_it() -> None:
    """At the distance that is left, along the way out: with that gap closed it is no deeper than the tolerance."""
    stepper, state = broken()
    least = SETTINGS.tolerance * stepper._geometry.mean_edge
    before = shaken(stepper, state.bodies, 0.0, 0)
    later = shaken(stepper, state.bodies, 0.5, 1)
    speed = (later.position - before.position) / STEP
    moving = replace(before, velocity=speed, spin=np.zeros_like(speed))
    later = replace(before, position=later.position)
    things, x, axes, gap = fresh(stepper)(pairs(stepper), moving, later, STEP)
    _, _, depth, _ = fresh(stepper).find_deepest(pairs(stepper), later)
    assert len(gap) and np.allclose(axes @ np.swapaxes(axes, 1, 2), np.eye(3), atol=1e-12)
    assert np.allclose(np.linalg.det(axes), 1.0)
    closing = np.einsum("ki,ki->k", axes[:, 0], speed[things[:, 0]] - speed[things[:, 1]])
    some = gap > 0
    assert some.any() and np.allclose((STEP * closing - gap)[some], (depth - least)[some])
    assert x.shape == (len(gap), 3)


def test_shells_and_what_is_whole_have_no_cores() -> None:
    """Nothing is looked for among them."""
    stepper = stepper_of(bar(0.0), 1e9, STEP)
    assert stepper.shapes.core_contact is None and not len(CoreGeometry.empty().faces)
