"""Parts of a body that hang on one another at a node, without a ligament, come apart."""

from __future__ import annotations

import numpy as np
import pytest

from fracsim.fracture.energy.hinges import HingeRelease, assign_parts
from fracsim.mesh.fragments import find_fragments
from support import hinged
from support.ranks import OnRanks

HALVES = pytest.mark.parametrize("cut", hinged.CASES.values(), ids=hinged.CASES)


@HALVES
def test_halves_that_hang_on_a_node_come_apart(cut: float) -> None:
    """One piece before and two after, the halves of the cut but for the hinge; no cell is left cut and unsplit."""
    scene = hinged.block()
    graph = scene.fracture.graph
    rule = HingeRelease(graph, np.full(len(graph.split), 0.2), None)
    left, hinge = hinged.halves(scene, cut)
    hinged.cut_but_for(graph, left, hinge)
    assert find_fragments(graph).count == 1
    tips = graph.damaged & ~graph.split
    flags = rule(np.zeros((len(graph.split), 6)))
    assert flags.any() and graph.break_edges(flags) == flags.sum()
    fragments = find_fragments(graph)
    assert fragments.count == 2
    # the node of the hinge goes to the larger half
    of_input = np.empty(len(left), np.int64)
    of_input[graph.domain.input_numbering.nodes] = fragments.node_fragment
    others = np.delete(np.arange(len(left)), hinge[0])
    np.testing.assert_array_equal(of_input[others] == of_input[np.flatnonzero(left)[0]], left[others])
    assert (of_input[hinge[0]] == of_input[np.flatnonzero(left)[0]]) == (left.mean() > 0.5)
    assert not (graph.damaged & ~graph.split & ~tips).any()


@HALVES
def test_parts_smaller_than_the_disc_of_a_tip_stay(cut: float) -> None:
    """A ball of 0.5 m has the volume of the whole block."""
    scene = hinged.block()
    graph = scene.fracture.graph
    rule = HingeRelease(graph, np.full(len(graph.split), 0.5), None)
    hinged.cut_but_for(graph, *hinged.halves(scene, cut))
    assert not rule(np.zeros((len(graph.split), 6))).any()


def test_a_node_between_halves_is_attached_to_one_of_them() -> None:
    """It has no unsplit cell, and an edge to each: one edge breaks, and the node does not become a piece."""
    scene, rule = hinged.bridged_block()
    graph = scene.fracture.graph
    assert find_fragments(graph).count == 1
    flags = rule(np.zeros((len(graph.split), 6)))
    assert flags.sum() == 1 and graph.retained is not None and graph.retained.sum() == 1
    graph.break_edges(flags)
    assert find_fragments(graph).count == 2 and graph.break_unloaded_edges() == 0


def test_a_ligament_holds() -> None:
    """Halves that share a facet are one part."""
    scene = hinged.block()
    graph = scene.fracture.graph
    rule = HingeRelease(graph, np.full(len(graph.split), 0.2), None)
    nodes = scene.domain.nodes
    crossing = (nodes[graph.edge_nodes, 0] < 0.75).sum(axis=1) == 1
    graph.break_edges(crossing & (nodes[graph.edge_nodes, 1].max(axis=1) < 0.4))
    assert graph.split.sum() > 20 and not rule(np.zeros((len(graph.split), 6))).any()


def test_chains_of_small_parts_are_cut_in_one_place() -> None:
    """0 and 1 are large. 5 has two links to 1, 6 and 7 lead to 5 alone, 8 has one to each, 9 none to either."""
    links = np.array([[5, 1], [1, 5], [5, 0], [6, 5], [7, 6], [8, 0], [8, 1], [9, 10]])
    numbers, body = assign_parts(links, np.array([0, 1]))
    assert dict(zip(numbers.tolist(), body.tolist(), strict=True)) == {
        0: 0, 1: 1, 5: 1, 6: 1, 7: 1, 8: 0, 9: -1, 10: -1}  # fmt: skip


@pytest.mark.ranks
@pytest.mark.parametrize("ranks", (2, 3))
@pytest.mark.parametrize("name", (*hinged.CASES, "bridge"))
def test_the_same_edges_on_ranks(on_ranks: OnRanks, ranks: int, name: str) -> None:
    """The very same edges break on any number of ranks."""
    serial, parallel = on_ranks(1)[0], on_ranks(ranks)[0]
    for array in (f"hinged-{name}-broken", f"hinged-{name}-pieces"):
        np.testing.assert_array_equal(parallel[array], serial[array])
