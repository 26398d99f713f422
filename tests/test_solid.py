"""The surface of what holds together, for contact between pieces alone."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from fracsim.mesh.split.places import whole
from fracsim.mesh.split.skeleton import Skeleton
from fracsim.mesh.split.solid import is_same_solid, split_of_pieces
from fracsim.meshes.topology import signed_measures
from support.solids import assert_closed, cloud, components, enclosed, lattice, patterns, separated, torn


@given(st.sampled_from([2, 3]), st.integers(0, 1000), st.sampled_from([0.01, 0.05, 0.2]))
def test_it_encloses_what_the_nodes_with_a_whole_cell_own(dim: int, seed: int, share: float) -> None:
    """Each such node owns 1 / (d + 1) of its cells, and its piece what its nodes own; nothing else is there."""
    mesh = cloud(dim, seed)
    skeleton = Skeleton(mesh)
    broken = np.random.default_rng(seed).random(len(skeleton.edges)) < share
    pattern = patterns(skeleton, broken)
    solid = np.zeros(len(mesh.points), bool)
    solid[mesh.cells[pattern == 0]] = True
    made = split_of_pieces(skeleton, pattern)
    assert_closed(made)
    of_node = np.where(solid[mesh.cells], signed_measures(mesh.points, mesh.cells)[:, None] / (dim + 1), 0.0)
    inner = ~broken & solid[skeleton.edges].all(axis=1)
    count, piece = components(len(mesh.points), skeleton.edges[inner])
    expected = np.bincount(piece[mesh.cells.ravel()], of_node.ravel(), minlength=count)
    label = piece[made.follow.first_parent[made.elements[:, 0]]]
    found, slack = enclosed(made.points, made.elements, label, count)
    assert np.all(np.abs(found - expected) <= slack)


def test_a_crack_within_a_piece_is_not_there_and_one_between_pieces_is() -> None:
    mesh = lattice(6, 4)
    skeleton = Skeleton(mesh)
    above = (mesh.points[:, 1] > 2.0).astype(int)
    through = separated(skeleton, above)
    notch = through & (mesh.points[skeleton.edges][:, :, 0].max(axis=1) < 3.5)
    whole = torn(mesh, np.zeros(len(through), bool))
    assert np.array_equal(split_of_pieces(skeleton, patterns(skeleton, notch)).elements, whole.elements)
    parted, all_walls = split_of_pieces(skeleton, patterns(skeleton, through)), torn(mesh, through)
    assert np.array_equal(parted.elements, all_walls.elements) and parted.pieces == 2


@given(st.sampled_from([2, 3]), st.integers(0, 1000), st.sampled_from([0.02, 0.1]), st.integers(1, 20))
def test_a_surface_that_is_said_to_be_the_same_is(dim: int, seed: int, share: float, more: int) -> None:
    """Points, elements, and where points are as the nodes move; edges that end in no wall change none."""
    mesh, rng = cloud(dim, seed), np.random.default_rng(seed)
    skeleton = Skeleton(mesh)
    halves = separated(skeleton, (mesh.points[:, 0] > np.median(mesh.points[:, 0])).astype(int))
    then = halves | (rng.random(len(skeleton.edges)) < share)
    now = then.copy()
    now[rng.integers(0, len(now), more)] = True
    before, pattern = patterns(skeleton, then), patterns(skeleton, now)
    one, other = split_of_pieces(skeleton, before), split_of_pieces(skeleton, pattern)
    same = len(one.points) == len(other.points) and np.array_equal(one.elements, other.elements)
    if is_same_solid(skeleton, pattern, before):
        assert same
        u = rng.random(mesh.points.shape)
        places = [whole(made, skeleton, at, made.points)(u) for made, at in ((one, before), (other, pattern))]
        np.testing.assert_array_equal(*places)
    assert is_same_solid(skeleton, before, before) and (same or not is_same_solid(skeleton, pattern, before))


def test_a_crack_within_a_half_leaves_the_surface_of_the_halves() -> None:
    mesh = lattice(8, 6)
    skeleton = Skeleton(mesh)
    x, y = mesh.points.T
    through = separated(skeleton, (y > 3.0).astype(int))
    notch = separated(skeleton, (x > 2.0).astype(int)) & (mesh.points[skeleton.edges][:, :, 1].max(axis=1) < 1.5)
    assert notch.any()
    halves, both = patterns(skeleton, through), patterns(skeleton, through | notch)
    assert is_same_solid(skeleton, both, halves) and not is_same_solid(skeleton, patterns(skeleton, notch), both)
