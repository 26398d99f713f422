"""The split surface of every damage: closed, of the right volume, and in as many pieces as the graph."""

from __future__ import annotations

import math
from collections.abc import Callable
from cProfile import Profile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fracsim.mesh.split_surface.closed_surface import SplitSurface, build_split_surface
from fracsim.mesh.split_surface.entity_numbering import CRACK, EntityNumbering
from fracsim.mesh.split_surface.mesh_part import WholeMesh
from fracsim.mesh.split_surface.smooth_cuts import CUTS, smooth_cuts
from fracsim.mesh.split_surface.surface_motion import NodalRotations
from fracsim.meshes.data import MeshData
from fracsim.meshes.topology import boundary_facets, signed_measures
from support.solids import (
    EPS,
    Flags,
    Ints,
    Values,
    assert_closed,
    assert_pieces,
    assert_volume,
    cloud,
    copies,
    enclosed,
    four_cells,
    lattice,
    one_cell,
    patterns,
    separated,
    torn,
    two_cells,
)

DIMS = (2, 3)


def every_damage(mesh: MeshData) -> tuple[MeshData, Flags]:
    """One body for each set of broken edges, and the flags (E,) of all of them."""
    edges = len(EntityNumbering(mesh).edges)
    sets = np.arange(1 << edges)[:, None] >> np.arange(edges) & 1
    return copies(mesh, len(sets)), sets.astype(bool).ravel()


@pytest.mark.parametrize("dim", DIMS)
@pytest.mark.parametrize("body", [one_cell, two_cells, four_cells])
def test_every_set_of_broken_edges_of_small_bodies(dim: int, body: Callable[[int], MeshData]) -> None:
    """8 or 64 patterns of one cell, 32 or 512 of two cells, 256 or 8192 of four around an inner node or edge."""
    mesh, broken = every_damage(body(dim))
    assert len(broken) == len(EntityNumbering(mesh).edges)
    made = torn(mesh, broken)
    assert_closed(made)
    assert_pieces(mesh, made, broken)
    assert_volume(mesh, made)
    assert_node_shares(mesh, made)


def assert_node_shares(mesh: MeshData, made: SplitSurface) -> None:
    """Cut in the middle, each node owns 1 / (d + 1) of its cells, and a piece what its nodes own.

    In barycentric coordinates the part of node i is where lambda_i is largest: all parts are alike.
    """
    share = np.repeat(signed_measures(mesh.points, mesh.cells) / (mesh.dim + 1), mesh.dim + 1)
    expected = np.bincount(made.node_fragment[mesh.cells.ravel()], share, minlength=made.fragment_count)
    label = made.point_fragment[made.elements[:, 0]]
    found, slack = enclosed(made.points, made.elements, label, made.fragment_count)
    assert np.all(np.abs(found - expected) <= slack)


@given(st.sampled_from(DIMS), st.integers(0, 1000), st.sampled_from([0.01, 0.1, 0.5, 0.9, 1.0]), st.booleans())
def test_random_damage_of_unstructured_bodies(dim: int, seed: int, share: float, placed: bool) -> None:
    """Any damage, cut in the middle or anywhere, some edges one way and some the other."""
    mesh, random = cloud(dim, seed), np.random.default_rng(seed)
    size = len(EntityNumbering(mesh).edges)
    broken = random.random(size) < share
    cut = np.where(broken & (random.random(size) < 0.6), random.uniform(0.05, 0.95, size), np.nan) if placed else None
    made = torn(mesh, broken, cut)
    assert_closed(made)
    assert_pieces(mesh, made, broken)
    assert_volume(mesh, made)
    if not placed:
        assert_node_shares(mesh, made)


@pytest.mark.parametrize("dim", DIMS)
def test_undamaged_is_the_boundary_of_the_mesh(dim: int) -> None:
    """The same facets in the same sense, no points but boundary nodes (2D: all, for the triangles that fill it)."""
    mesh = cloud(dim, 3)
    made = torn(mesh, np.zeros(len(EntityNumbering(mesh).edges), bool))
    nodes = made.parents.parents
    assert np.array_equal(made.points, mesh.points[nodes])
    assert_same_turned(nodes[made.elements], boundary_facets(mesh.cells))
    assert np.all(made.edge == -1)
    if dim == 2:
        assert np.array_equal(made.fill, mesh.cells)


def assert_same_turned(left: Ints, right: Ints) -> None:
    """The same oriented simplices in any order, each begun at its lowest node."""
    rolled = [np.stack([np.roll(row, -int(row.argmin())) for row in rows]) for rows in (left, right)]
    assert np.array_equal(*(rows[np.lexsort(rows.T)] for rows in rolled))


def test_a_torn_facet_has_no_t_junction_with_a_whole_one() -> None:
    """Only facets with a broken edge are divided; all others are there as they were, damaged cell or not."""
    mesh = lattice(3, 3, 3)
    skeleton = EntityNumbering(mesh)
    broken = np.zeros(len(skeleton.edges), bool)
    facets = boundary_facets(mesh.cells)
    broken[skeleton.cell_edges[skeleton.boundary[0, 0]]] = True
    made = torn(mesh, broken)
    pairs = {tuple(pair) for pair in skeleton.edges[broken].tolist()}
    untouched = [facet for facet in facets.tolist() if not any(
        tuple(sorted((facet[k], facet[k - 1]))) in pairs for k in range(3))]  # fmt: skip
    nodes = np.where(np.diff(made.parents.start) == 1, made.parents.first_parent, -1)
    is_node = np.all(made.points == mesh.points[np.maximum(nodes, 0)], axis=1) & (nodes >= 0)
    triangles = made.elements[(made.edge < 0) & is_node[made.elements].all(axis=1)]
    assert_same_turned(nodes[triangles], np.array(untouched))


@pytest.mark.parametrize("dim", DIMS)
def test_fill_covers_the_body_once(dim: int) -> None:
    """2D: triangles of positive area that sum up to the body; their free sides are the outlines."""
    mesh = cloud(2, 8)
    broken = np.random.default_rng(dim).random(len(EntityNumbering(mesh).edges)) < 0.4
    made = torn(mesh, broken)
    area = signed_measures(made.points, made.fill)
    assert area.min() > 0
    assert abs(area.sum() - signed_measures(mesh.points, mesh.cells).sum()) < 1e-13
    sides = np.concatenate([made.fill[:, [0, 1]], made.fill[:, [1, 2]], made.fill[:, [2, 0]]])
    there, back = ({tuple(side) for side in each.tolist()} for each in (sides, sides[:, ::-1]))
    assert there - back == {tuple(side) for side in made.elements.tolist()}


# --- cuts with a place ---


@pytest.mark.parametrize("dim", (2, 3))
def test_smooth_cuts_make_a_crack_flat(dim: int) -> None:
    """A random mesh cut between the nodes on both sides of a plane: half of the roughness of cuts in the middle and
    less, away from the boundary; closed and with the volume of the mesh, each end with its share of the edge."""
    mesh = cloud(dim, 3, nodes=1000)
    skeleton = EntityNumbering(mesh)
    broken = separated(skeleton, (mesh.points[:, 0] > 0.5).astype(int))
    cut = smooth_cuts(WholeMesh(skeleton), broken)
    assert (
        np.array_equal(~np.isnan(cut), broken)
        and cut[broken].min() >= CUTS.min_distance
        and cut[broken].max() <= 1 - CUTS.min_distance
    )
    rough, smooth = (torn(mesh, broken, each) for each in (None, cut))
    crack = [made.points[np.unique(made.elements[made.origin == CRACK])] for made in (rough, smooth)]
    inner = [each[(np.abs(each[:, 1:] - 0.5) < 0.3).all(axis=1), 0] for each in crack]
    assert np.std(inner[1]) < 0.5 * np.std(inner[0])
    assert_closed(smooth)
    assert_volume(mesh, smooth)


def test_smooth_cuts_leave_a_place_that_is_known() -> None:
    mesh = cloud(3, 5, nodes=100)
    skeleton = EntityNumbering(mesh)
    broken = separated(skeleton, (mesh.points[:, 0] > 0.5).astype(int))
    known = np.where(broken & (np.arange(len(broken)) % 3 == 0), 0.21, np.nan)
    cut = smooth_cuts(WholeMesh(skeleton), broken, known)
    given = ~np.isnan(known)
    assert (cut[given] == 0.21).all() and np.isfinite(cut[broken]).all() and np.unique(cut[broken & ~given]).size > 9
    assert np.isnan(smooth_cuts(WholeMesh(skeleton), np.zeros_like(broken))).all()


@pytest.mark.parametrize("dim", DIMS)
def test_a_planar_cut_stays_planar(dim: int) -> None:
    """Edges across the plane n.x = c are cut where they cross it: all crack points lie on it, and on each side lies the
    volume of that side, here of a box cut askew: a prism with the mean height c' over its base."""
    mesh = jittered(lattice(*[5] * dim, size=0.2), 0.03)
    normal, offset = np.array([1.0, 0.3, -0.2][:dim]), 0.4
    skeleton = EntityNumbering(mesh)
    level = mesh.points @ normal - offset
    broken = separated(skeleton, (level > 0).astype(int))
    low, high = level[skeleton.edges].T
    cut = np.where(broken, low / np.where(broken, low - high, 1.0), np.nan)
    made = torn(mesh, broken, cut)
    crack = np.unique(made.elements[made.edge >= 0])
    assert np.abs(made.points[crack] @ normal - offset).max() <= 4 * EPS
    label = made.point_fragment[made.elements[:, 0]]
    found, slack = enclosed(made.points, made.elements, label, made.fragment_count)
    # the plane meets every line along x inside the unit box: volume = mean of x = c - n_y y - n_z z at y = z = 1/2
    expected = offset - normal[1:].sum() / 2
    assert made.fragment_count == 2
    assert np.abs(found - [expected, 1 - expected]).max() <= slack


def jittered(mesh: MeshData, by: float) -> MeshData:
    """Inner nodes moved at random: no plane of nodes is left."""
    points, random = mesh.points.copy(), np.random.default_rng(5)
    inner = np.all((points > 1e-9) & (points < 1 - 1e-9), axis=1)
    points[inner] += random.uniform(-by, by, (inner.sum(), mesh.dim))
    return MeshData(points, mesh.cells)


# --- children follow parents ---


def turn(dim: int, angle: float) -> Values:
    """A rotation, in 3D about a skew axis (Rodrigues' formula)."""
    if dim == 2:
        return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    x, y, z = np.array([1.0, 2.0, 2.0]) / 3
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * K + (1 - math.cos(angle)) * K @ K


@pytest.mark.parametrize("angle", [0.3, 2.0, math.pi])
@pytest.mark.parametrize("dim", DIMS)
def test_a_turning_half_does_not_shear(dim: int, angle: float) -> None:
    """Every node of a half has a whole cell on its side, so every child turns with it: x = Q X + t."""
    mesh = lattice(6, *[2] * (dim - 1))
    skeleton = EntityNumbering(mesh)
    half = (mesh.points[:, 0] > 2.5).astype(int)
    made = torn(mesh, separated(skeleton, half))
    pattern = patterns(skeleton, separated(skeleton, half))
    Q, shift = turn(dim, angle), np.arange(1.0, dim + 1)
    u = np.where(half[:, None] == 1, mesh.points @ (Q - np.eye(dim)).T + shift, 0.0)
    moved = made.parents.displacement(u, NodalRotations(WholeMesh(skeleton), pattern, made.parents.rotating_nodes)(u))
    turned = half[made.parents.first_parent] == 1
    expected = np.where(turned[:, None], made.points @ (Q - np.eye(dim)).T + shift, 0.0)
    assert np.abs(moved - expected).max() <= 1000 * EPS * 6  # 6 m long
    x = made.points + moved
    for k in range(dim):
        before, after = (
            np.linalg.norm(p[made.elements[:, k]] - p[made.elements[:, k - 1]], axis=1) for p in (made.points, x)
        )
        assert np.abs(after - before).max() <= 1000 * EPS * 6


def test_children_are_the_mean_of_their_parents() -> None:
    """Weights sum to one over the parents; without rotation a point moves as the mean of its parents does."""
    mesh = cloud(3, 4)
    broken = np.random.default_rng(4).random(len(EntityNumbering(mesh).edges)) < 0.3
    made = torn(mesh, broken)
    follow, u = made.parents, np.random.default_rng(1).normal(size=mesh.points.shape)
    identity = np.tile(np.eye(3), (len(follow.rotating_nodes), 1, 1))
    moved = follow.displacement(u, identity)
    rows = np.split(follow.parents, follow.start[1:-1])
    expected = np.array([u[parents].mean(axis=0) for parents in rows])
    assert np.abs(moved - expected).max() <= 8 * EPS * np.abs(u).max()
    assert np.abs(follow.mean(u) - expected).max() <= 8 * EPS * np.abs(u).max()
    # handing forces down is the transpose: the work is the same (M22 section 4.2)
    force = np.random.default_rng(2).normal(size=made.points.shape)
    assert np.vdot(force, follow.mean(u)) == pytest.approx(np.vdot(follow.weights.T @ force, u), rel=1e-12)


def test_a_node_without_a_whole_cell_does_not_turn() -> None:
    """Its fragment is smaller than a cell: identity."""
    mesh = one_cell(3)
    skeleton = EntityNumbering(mesh)
    pattern = np.array([63], np.uint8)
    R = NodalRotations(WholeMesh(skeleton), pattern, np.arange(4))(mesh.points @ (turn(3, 1.0) - np.eye(3)).T)
    assert np.array_equal(R, np.tile(np.eye(3), (4, 1, 1)))


# --- speed ---


def test_a_rebuild_is_array_code() -> None:
    """As many calls for 24,000 cells as for 81,000, 5 % of them damaged, but for a round more of joining pieces: no
    loop over cells, edges or nodes."""
    rebuilt(4)  # imports, and what is made once
    made, calls = zip(*(rebuilt(n) for n in (10, 15)), strict=True)
    assert made[1] > 2 * made[0]
    assert calls[1] < 1.05 * calls[0]


def rebuilt(n: int) -> tuple[int, int]:
    """(triangles, calls made) of the surface of a damaged lattice of 24 n^3 cells, built and moved once."""
    mesh = lattice(n, n, 4 * n, size=1 / 16)
    skeleton = EntityNumbering(mesh)
    near = np.abs(mesh.points[mesh.cells].mean(axis=1)[:, 2] / n - 1 / 8) < 0.03 / 4
    broken = np.zeros(len(skeleton.edges), bool)
    broken[skeleton.cell_edges[near]] = np.random.default_rng(0).random(skeleton.cell_edges[near].shape) < 0.6
    pattern = patterns(skeleton, broken)
    u = np.random.default_rng(1).normal(size=mesh.points.shape) * 1e-3
    with Profile() as calls:
        made = build_split_surface(skeleton, pattern)
        made.parents.displacement(u, NodalRotations(WholeMesh(skeleton), pattern, made.parents.rotating_nodes)(u))
    assert n < 10 or np.mean(pattern != 0) > 0.05
    assert_closed(made)
    assert_volume(mesh, made)
    return len(made.elements), sum(entry.callcount for entry in calls.getstats())
