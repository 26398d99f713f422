"""No piece passes through another, at 20 m/s and as a wall comes down: after every step, by barycentric coordinates and
VTK's distances, which share nothing with the engine, and by what the engine finds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
import pyvista
from scipy.spatial import cKDTree

pytest.importorskip("mujoco", reason="an environment made without a network")

from fracsim.mesh.small_matrices import barycentric_gradients
from fracsim.mesh.split_surface.closed_surface import build_split_surface
from fracsim.rigid.rigid_stepper import RigidState, RigidStepper
from fracsim.scene.rigid_scene import build_rigid_scene
from fracsim.study.reader import load_study
from support.falling import DOWN, stepper_of
from support.solids import copies
from test_struck_bodies import bar

Values = npt.NDArray[np.float64]
Depths = dict[tuple[int, int], float]
SPEED, STEP, STEPS, NONE = 20.0, 1e-3, 150, 1e-3
CORE = 0.04  # of the mean edge


def as_placed(stepper: RigidStepper, points: Values) -> Values:
    """(k, 3) where points of the mesh (k, 3) are of the one body that is at rest where its study puts it, m."""
    poses = stepper._geometry.poses
    return np.asarray(points @ poses.rotation[0].T + poses.position[0])


def in_others(stepper: RigidStepper, state: RigidState) -> Depths:
    """Of pairs of pieces, how far corners of the drawn surface of one, crack faces as well, that are in a whole cell of
    the other are from its surface, m: they come free of one another by no shorter way."""
    body, bodies, found = stepper.instances.get(0), state.bodies, dict[tuple[int, int], float]()
    domain, of_node = body.graph.domain, body.fragments.node_fragment
    made, nodes = (
        build_split_surface(stepper._geometry.numbering, *body.input_damage()),
        as_placed(stepper, domain.nodes),
    )
    own, owner = made.point_fragment, made.elements[:, 0]
    x = bodies.to_current(as_placed(stepper, made.points), own)
    of_cell = of_node[domain.cell_nodes]
    whole = np.all(of_cell == of_cell[:, :1], axis=1)
    for piece in range(len(bodies)):
        corners, X = nodes[domain.cell_nodes[whole & (of_cell[:, 0] == piece)]], bodies.to_reference(x, piece)
        if not len(corners):
            continue
        near = np.flatnonzero(np.all((corners.min(axis=(0, 1)) < X) & (corners.max(axis=(0, 1)) > X), axis=1))
        near = near[own[near] != piece]
        inside = near[in_cells(X[near], corners)]
        if not len(inside):
            continue
        surface = pyvista.make_tri_mesh(x, made.elements[own[owner] == piece])
        depth = np.abs(pyvista.PolyData(x[inside]).compute_implicit_distance(surface)["implicit_distance"])
        for other in np.unique(own[inside][depth > NONE]):
            pair = min(int(other), piece), max(int(other), piece)
            found[pair] = max(found.get(pair, 0.0), float(depth[own[inside] == other].max()))
    return found


def in_cores(stepper: RigidStepper, state: RigidState) -> Depths:
    """Of pairs of pieces, how far nodes of one are in the cells that are wholly of the other, m: no crack goes through
    these, so that its roughness does not explain it."""
    body, bodies = stepper.instances.get(0), state.bodies
    domain, of_node, found = body.graph.domain, body.fragments.node_fragment, dict[tuple[int, int], float]()
    nodes = as_placed(stepper, domain.nodes)
    of_cell, x = of_node[domain.cell_nodes], bodies.to_current(nodes, of_node)
    whole = np.all(of_cell == of_cell[:, :1], axis=1)
    for piece in range(len(bodies)):
        cells = domain.cell_nodes[whole & (of_cell[:, 0] == piece)]
        if not len(cells):
            continue
        corners, X = nodes[cells], bodies.to_reference(x, piece)
        near = np.all((corners.min(axis=(0, 1)) < X) & (corners.max(axis=(0, 1)) > X), axis=1)
        rows = np.flatnonzero(near & (of_node != piece))
        rows = rows[in_cells(X[rows], corners)] if len(rows) else rows
        if not len(rows):
            continue
        facets, count = np.unique(
            np.sort(cells[:, [0, 1, 2, 0, 1, 3, 0, 2, 3, 1, 2, 3]].reshape(-1, 3)), axis=0, return_counts=True
        )
        surface = pyvista.make_tri_mesh(nodes, facets[count == 1])
        depth = np.abs(pyvista.PolyData(X[rows]).compute_implicit_distance(surface)["implicit_distance"])
        for other in np.unique(of_node[rows]):
            found[int(other), piece] = float(depth[of_node[rows] == other].max())
    return found


def in_cells(X: Values, corners: Values) -> npt.NDArray[np.bool_]:
    """(n,) which of the points (n, 3) are in one of the cells with corners (c, 4, 3), by barycentric coordinates."""
    middle, found = corners.mean(axis=1), np.zeros(len(X), bool)
    radius = np.linalg.norm(corners - middle[:, None], axis=2).max()
    near = cKDTree(X).sparse_distance_matrix(cKDTree(middle), radius, output_type="ndarray")
    point, cell = near["i"], near["j"]
    shares = np.einsum("nkd,nd->nk", barycentric_gradients(corners)[cell], X[point] - corners[cell, 0])
    shares[:, 0] += 1.0
    found[point[shares.min(axis=1) > 0]] = True
    return found


def from_birth(stepper: RigidStepper) -> Depths:
    """Of pairs of pieces, how far their hulls may lie in one another, as they do from birth, m."""
    overlaps, found = stepper.initial_overlaps, dict[tuple[int, int], float]()
    for pair, depth in zip(np.searchsorted(stepper.shapes.names, overlaps.names), overlaps.depth, strict=True):
        key = int(pair[0]), int(pair[1])
        found[key] = max(found.get(key, 0.0), float(depth))
    return found


@pytest.mark.slow
def test_pieces_do_not_pass_through_one_another_at_twenty_metres_a_second() -> None:
    """Two bars of 3 m that meet and break: no surface is in another piece by a millimetre more than hulls of these two
    are from birth, and the engine finds no convex part of one in a part of another by more than v dt / 2 beyond that.

    Where parts by 8.6 mm are in one another, the surfaces themselves are by 1.9 mm."""
    mesh = copies(bar(0.0), 2)
    mesh.points[len(mesh.points) // 2 :] += [1.0, 0.2, 1.3]
    stepper = stepper_of(mesh, 2e5, STEP, gravity=0 * DOWN, obstacles=[], surfaces=20)
    velocity: Values = np.array([[0.0, 0.0, SPEED / 2], [0.0, 0.0, -SPEED / 2]])
    state = stepper.start()
    state = replace(state, bodies=replace(state.bodies, velocity=velocity))
    for _ in range(STEPS):
        state, _ = stepper.advance(state)
        assert max(in_cores(stepper, state).values(), default=0.0) < CORE * stepper._geometry.mean_edge
        allowed, told = from_birth(stepper), {pair[:2]: pair[2] for pair in stepper.find_penetrations(state)}
        assert max(told.values(), default=0.0) < SPEED * STEP / 2
        for pair, depth in in_others(stepper, state).items():
            assert depth < allowed.get(pair, 0.0) + told.get(pair, 0.0) + NONE
    assert len(state.bodies) > 10
    moved = replace(state.bodies, position=0.5 * state.bodies.position)
    assert max(in_others(stepper, replace(state, bodies=moved)).values()) > 0.1, "it would be seen"
    assert max(in_cores(stepper, replace(state, bodies=moved)).values()) > 0.1, "and so would this"


@pytest.mark.slow
def test_grains_of_a_wall_do_not_pass_through_one_another() -> None:
    """Of a wall that a ball is driven through no node comes into cells that are wholly of another piece, by more than a
    little, at any step in which they fall: 0.14 of the mean edge where only convex parts met."""
    scene = build_rigid_scene(load_study("rigid-wall", ["time.end=0.26", "brittle.grains.seed=4"]))
    stepper, state, seen = scene.stepper, scene.initial_state, 0
    while not scene.ended(state):
        state, _ = stepper.advance(state)
        if len(state.bodies) > 1:
            depths = in_cores(stepper, state)
            assert max(depths.values(), default=0.0) < CORE * stepper._geometry.mean_edge
            seen += len(depths)
    assert len(state.bodies) > 20 and seen > 0, "some touch"
