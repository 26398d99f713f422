"""The surface of what holds together, for contact between pieces alone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fracsim.mesh.ghost_exchange import KeyLookup
from fracsim.mesh.split_surface.closed_surface import build_split_surface
from fracsim.mesh.split_surface.entity_numbering import CRACK, EntityNumbering
from fracsim.mesh.split_surface.fragment_surface import PlanarPoints, project_onto_fragments
from fracsim.meshes.topology import signed_measures
from support.drawn import drawn_at
from support.solids import assert_closed, cloud, components, enclosed, lattice, patterns, separated, torn
from support.whole_surface import build_fragment_surface, has_same_fragments, make_surface_map


@given(st.sampled_from([2, 3]), st.integers(0, 1000), st.sampled_from([0.01, 0.05, 0.2]))
def test_it_encloses_what_the_nodes_with_a_whole_cell_own(dim: int, seed: int, share: float) -> None:
    """A piece has of a cell what lies on its side of planes through the middles of edges; nothing else is there.

    Of a single fragment the boundary of the body alone is there.
    """
    mesh = cloud(dim, seed)
    skeleton = EntityNumbering(mesh)
    broken = np.random.default_rng(seed).random(len(skeleton.edges)) < share
    pattern = patterns(skeleton, broken)
    solid = np.zeros(len(mesh.points), bool)
    solid[mesh.cells[pattern == 0]] = True
    made = build_fragment_surface(skeleton, pattern)
    inner = ~broken & solid[skeleton.edges].all(axis=1)
    count, piece = components(len(mesh.points), skeleton.edges[inner])
    if len(np.unique(piece[solid])) < 2:
        assert np.all(made.origin != CRACK)
        return
    assert_closed(made)
    own = np.zeros((len(mesh.cells), count), int)
    np.add.at(own, (np.arange(len(mesh.cells))[:, None], piece[mesh.cells]), solid[mesh.cells])
    share = {2: np.array([0.0, 1 / 4, 3 / 4, 1.0]), 3: np.array([0.0, 1 / 8, 1 / 2, 7 / 8, 1.0])}[dim]
    expected = signed_measures(mesh.points, mesh.cells) @ share[own]
    label = piece[made.parents.first_parent[made.elements[:, 0]]]
    found, slack = enclosed(made.points, made.elements, label, count)
    assert np.all(np.abs(found - expected) <= slack)


def test_a_crack_within_a_piece_is_not_there_and_one_between_pieces_is() -> None:
    mesh = lattice(6, 4)
    skeleton = EntityNumbering(mesh)
    above = (mesh.points[:, 1] > 2.0).astype(int)
    through = separated(skeleton, above)
    notch = through & (mesh.points[skeleton.edges][:, :, 0].max(axis=1) < 3.5)
    whole = torn(mesh, np.zeros(len(through), bool))
    assert np.array_equal(build_fragment_surface(skeleton, patterns(skeleton, notch)).elements, whole.elements)
    parted, all_walls = build_fragment_surface(skeleton, patterns(skeleton, through)), torn(mesh, through)
    assert parted.fragment_count == 2 and len(parted.elements) < len(all_walls.elements)
    cut = all_walls.points[np.unique(all_walls.elements)]  # without the middles of cells, which the flat cut has not
    on_edges = ~(cut[:, None] == mesh.points[mesh.cells].mean(axis=1)).all(axis=2).any(axis=1)
    here = parted.points[np.unique(parted.elements)]
    assert np.array_equal(np.unique(here, axis=0), np.unique(cut[on_edges], axis=0))


@pytest.mark.parametrize("dim", [2, 3])
def test_a_plane_that_says_where_edges_are_cut_is_the_wall(dim: int) -> None:
    """What is above it and below it, to round-off; where it comes too near to a node it is not followed."""
    mesh = lattice(*(4,) * dim)
    skeleton = EntityNumbering(mesh)
    y, ends = mesh.points[:, 1], mesh.points[skeleton.edges][:, :, 1]
    for height, wall in ((1.7, 1.7), (1.95, 1.85)):
        broken = separated(skeleton, (y > height).astype(int))
        cut = np.where(broken, (height - ends[:, 0]) / np.where(broken, ends[:, 1] - ends[:, 0], 1.0), np.nan)
        made = build_fragment_surface(skeleton, patterns(skeleton, broken), cut)
        label = (y > height).astype(int)[made.parents.first_parent[made.elements[:, 0]]]
        found, slack = enclosed(made.points, made.elements, label, 2)
        assert np.all(np.abs(found - np.array([wall, 4 - wall]) * 4 ** (dim - 1)) <= 10 * slack)


@given(st.sampled_from([2, 3]), st.integers(0, 1000), st.sampled_from([0.02, 0.1]), st.integers(1, 20))
def test_a_surface_that_is_said_to_be_the_same_is(dim: int, seed: int, share: float, more: int) -> None:
    """Points, elements, and where points are as the nodes move; edges that end in no wall change none."""
    mesh, rng = cloud(dim, seed), np.random.default_rng(seed)
    skeleton = EntityNumbering(mesh)
    halves = separated(skeleton, (mesh.points[:, 0] > np.median(mesh.points[:, 0])).astype(int))
    then = halves | (rng.random(len(skeleton.edges)) < share)
    now = then.copy()
    now[rng.integers(0, len(now), more)] = True
    before, pattern = patterns(skeleton, then), patterns(skeleton, now)
    one, other = build_fragment_surface(skeleton, before), build_fragment_surface(skeleton, pattern)
    same = len(one.points) == len(other.points) and np.array_equal(one.elements, other.elements)
    if has_same_fragments(skeleton, pattern, before):
        assert same
        u = rng.random(mesh.points.shape)
        places = [
            make_surface_map(made, skeleton, at, made.points)(u) for made, at in ((one, before), (other, pattern))
        ]
        np.testing.assert_array_equal(*places)
    assert has_same_fragments(skeleton, before, before) and (same or not has_same_fragments(skeleton, pattern, before))


def test_a_crack_within_a_half_leaves_the_surface_of_the_halves() -> None:
    mesh = lattice(8, 6)
    skeleton = EntityNumbering(mesh)
    x, y = mesh.points.T
    through = separated(skeleton, (y > 3.0).astype(int))
    notch = separated(skeleton, (x > 2.0).astype(int)) & (mesh.points[skeleton.edges][:, :, 1].max(axis=1) < 1.5)
    assert notch.any()
    halves, both = patterns(skeleton, through), patterns(skeleton, through | notch)
    assert has_same_fragments(skeleton, both, halves) and not has_same_fragments(
        skeleton, patterns(skeleton, notch), both
    )


@pytest.mark.parametrize("dim", [2, 3])
def test_walls_are_drawn_where_they_are_cut_flat(dim: int) -> None:
    """However nodes move, the surface of a piece inside a body that is drawn encloses what its flat one does, though it
    has other points; with a crack in it at rest, where the sides of that lie on each other."""
    mesh, rng = lattice(*(8,) * dim), np.random.default_rng(dim)
    skeleton, x = EntityNumbering(mesh), mesh.points
    inner = ((x >= 2) & (x <= 6)).all(axis=1).astype(int)
    around = separated(skeleton, inner)
    crack = separated(skeleton, x[:, 0] > 4) & ~around & (x[skeleton.edges].mean(axis=1)[:, 1] < 4)
    for broken, share in ((around, 0.2), (around | crack, 0.0)):
        pattern, u = patterns(skeleton, broken), share * rng.random(x.shape)
        flat, drawn = build_fragment_surface(skeleton, pattern), build_split_surface(skeleton, pattern)
        of_flat = make_surface_map(flat, skeleton, pattern, flat.points).with_arm_share(
            rng.uniform(0.5, 1.0, len(flat.points))
        )
        surface = drawn_at(skeleton, pattern, drawn, u)
        before = surface.placed_points()
        assert flat.numbering is not None
        rows = KeyLookup(flat.numbering.keys(np.arange(len(x))))
        after = project_onto_fragments(before, surface, PlanarPoints(rows, of_flat.rest, of_flat(u)))
        each = [
            enclosed(places, made.elements, inner[made.parents.first_parent[made.elements[:, 0]]], 2)[0][1]
            for made, places in ((flat, of_flat(u)), (drawn, after.rest), (drawn, before.rest))
        ]
        assert each[1] == pytest.approx(each[0], rel=1e-12) and abs(each[2] - each[0]) > 1e-2 * each[0]
    sides = np.isin(drawn.edge, np.flatnonzero(crack & (inner[skeleton.edges] == 1).all(axis=1)))
    _, number = np.unique(np.round(after.rest, 9), axis=0, return_inverse=True)
    _, count = np.unique(np.sort(number.reshape(-1)[drawn.elements[sides]], axis=1), axis=0, return_counts=True)
    assert len(count) and np.all(count == 2)
