"""The surface of what holds together, for contact between pieces alone."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from fracsim.mesh.split.skeleton import Skeleton
from fracsim.mesh.split.solid import split_of_pieces
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
