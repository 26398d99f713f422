"""Cells as small graphs: what each pattern of broken edges means, and damage that never heals."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from fracsim.mesh.edge_graph import EdgeGraph, Incidence
from fracsim.mesh.simplices import is_split, local_edges, node_groups
from fracsim.meshes.topology import components
from support.ranks import OnRanks
from support.scenes import make_scene

DIMS = (2, 3)


def intact_edges(dim: int, pattern: int) -> list[tuple[int, int]]:
    """Local edges of a pattern that are not broken."""
    return [(int(i), int(j)) for bit, (i, j) in enumerate(local_edges(dim)) if not pattern >> bit & 1]


def groups(dim: int, pattern: int) -> npt.NDArray[np.integer]:
    """Connected components of the nodes by SciPy."""
    edges = np.array(intact_edges(dim, pattern)).reshape(-1, 2)
    graph = coo_matrix((np.ones(len(edges)), edges.T), shape=(dim + 1, dim + 1))
    return connected_components(graph, directed=False)[1]


@pytest.mark.parametrize("dim", DIMS)
def test_local_edges_are_all_pairs_of_nodes(dim: int) -> None:
    """A simplex joins every two of its nodes."""
    assert {tuple(sorted(edge)) for edge in local_edges(dim).tolist()} == set(combinations(range(dim + 1), 2))


@pytest.mark.parametrize("dim", DIMS)
def test_groups_of_every_pattern(dim: int) -> None:
    """Each node is named after the lowest node of its connected component, for all 8 or 64 patterns."""
    for pattern, found in enumerate(node_groups(dim)):
        label = groups(dim, pattern)
        expected = [np.flatnonzero(label == own)[0] for own in label]
        assert found.tolist() == expected


@pytest.mark.parametrize("dim", DIMS)
def test_split_means_not_connected(dim: int) -> None:
    """A cell is split where its intact edges leave more than one component."""
    expected = [groups(dim, pattern).max() > 0 for pattern in range(len(is_split(dim)))]
    assert is_split(dim).tolist() == expected


def test_triangles_split_with_two_broken_edges() -> None:
    """docs/theory.md#edge-damage: 2D, two broken edges."""
    assert is_split(2).tolist() == [pattern.bit_count() >= 2 for pattern in range(8)]


def test_tetrahedra_split_around_a_node_or_between_pairs() -> None:
    """docs/theory.md#edge-damage: all three edges of a node, or all four edges between two pairs of nodes."""
    for pattern in range(64):
        intact = {frozenset(edge) for edge in intact_edges(3, pattern)}
        lonely = any(not any(node in edge for edge in intact) for node in range(4))
        pairs = [({0, i}, {1, 2, 3} - {i}) for i in (1, 2, 3)]
        parted = any(all(frozenset((a, b)) not in intact for a in one for b in other) for one, other in pairs)
        assert is_split(3)[pattern] == (lonely or parted)
    assert is_split(3).sum() == 26  # 64 patterns less the 38 connected graphs on four labelled nodes


@pytest.fixture(scope="module")
def graph() -> EdgeGraph:
    scene, _ = make_scene(mesh={"builder": "box", "size": [1, 1, 1], "h": 0.5}, fracture={"strength": 1.0})
    return scene.fracture.graph


def test_edges_of_the_mesh(graph: EdgeGraph) -> None:
    """Kuhn's lattice of n^3 cubes: 3 n (n+1)^2 axis edges, 3 n^2 (n+1) face and n^3 body diagonals."""
    n = 2
    assert graph.edge_count == 3 * n * (n + 1) ** 2 + 3 * n**2 * (n + 1) + n**3
    ends = graph.edge_nodes[graph.cell_edges]
    expected = graph.cell_nodes[:, local_edges(3)]
    assert np.array_equal(np.sort(ends, axis=2), np.sort(expected, axis=2))


def test_damage_only_grows(graph: EdgeGraph) -> None:
    """Breaking counts what is new, never heals, and every cell's pattern says which of its edges are broken."""
    random = np.random.default_rng(0)
    for _ in range(5):
        before, flags = graph.broken.copy(), random.random(len(graph.broken)) < 0.1
        count = graph.break_edges(flags)
        assert count == np.count_nonzero(flags & ~before)
        assert np.array_equal(graph.broken, before | flags)
        bits = graph.broken[graph.cell_edges] @ (1 << np.arange(6))
        assert np.array_equal(graph.pattern, bits)
    assert graph.broken_count == np.count_nonzero(graph.broken)
    assert graph.break_edges(np.zeros(len(graph.broken), bool)) == 0


def test_idle_edges_break_and_part_the_graph() -> None:
    """Two triangles on either side of a shared edge: with all other edges broken both cells have come apart,
    and what is left between the shared nodes carries nothing. Edges of a cell that holds together stay."""
    scene, _ = make_scene(mesh={"builder": "box", "size": [1.0, 1.0], "h": 1.0}, fracture={"strength": 1.0})
    graph = scene.fracture.graph
    cells = np.bincount(graph.cell_edges.ravel())
    shared = np.flatnonzero(cells == 2)
    assert graph.break_unloaded_edges() == 0
    graph.break_edges(cells == 1)
    assert graph.broken[shared].sum() == 0
    assert graph.break_unloaded_edges() == 1
    assert graph.broken.all()
    assert graph.break_unloaded_edges() == 0


def test_keys_name_edges(graph: EdgeGraph) -> None:
    """Edges found again from their pairs of input nodes."""
    keys = graph.broken_keys()
    assert keys is not None
    assert np.array_equal(graph.keys.edge_flags(keys), graph.broken)
    assert np.all(keys[:, 0] < keys[:, 1])


@pytest.mark.ranks
@pytest.mark.parametrize("ranks", (1, 2, 3))
@pytest.mark.parametrize("case", ("2d", "3d", "quadratic"))
def test_pieces_are_those_of_scipy(on_ranks: OnRanks, case: str, ranks: int) -> None:
    """Some edges at a time, blocks first and at last all dust: SciPy's components of the input mesh each time, their
    numbers alike on any number of ranks."""
    same, count = on_ranks(ranks)[0][f"parting-{case}"].T
    assert same.all() and count[0] < 5 and count[-1] > 100
    assert np.array_equal(count, on_ranks(1)[0][f"parting-{case}"][:, 1])


@given(st.integers(0, 2**32 - 1))
def test_rows_are_found_by_what_is_in_them(seed: int) -> None:
    """Against a search of the whole table."""
    random = np.random.default_rng(seed)
    table, wanted = random.integers(0, 30, (40, 3)), random.choice(30, random.integers(0, 5), replace=False)
    incidence = Incidence(table, 30)
    assert np.array_equal(incidence(wanted), np.flatnonzero(np.isin(table, wanted).any(axis=1)))


def test_components_are_numbered_by_their_lowest_node() -> None:
    """Pieces keep their numbers by this; single nodes are parts as well."""
    links = np.random.default_rng(3).integers(0, 400, (300, 2))
    count, part = components(links, 400)
    first = np.unique(part, return_index=True)[1]
    assert count == len(first) > 100
    assert np.all(np.diff(first) > 0)
    assert np.array_equal(part[links[:, 0]], part[links[:, 1]])


@pytest.mark.parametrize("kind", ("sparse", "dense", "chain", "zigzag", "none"))
def test_components_are_those_of_scipy(kind: str) -> None:
    """Of random graphs, and of chains whose numbers rise along them or go to and fro; numbered by their lowest node."""
    random, n = np.random.default_rng(7), 400
    chain = {"chain": np.arange(n), "zigzag": np.column_stack([np.arange(n // 2), np.arange(n)[: n // 2 - 1 : -1]])}
    links = {
        "sparse": random.integers(n, size=(n // 2, 2)), "dense": random.integers(n, size=(3 * n, 2)),
        "none": np.empty((0, 2), int),
    } | {name: np.column_stack([way.ravel()[:-1], way.ravel()[1:]]) for name, way in chain.items()}  # fmt: skip
    count, label = components(links[kind], n)
    graph = coo_matrix((np.ones(len(links[kind])), links[kind].T), shape=(n, n))
    parts, expected = connected_components(graph, directed=False)
    _, first = np.unique(label, return_index=True)
    assert count == parts and np.all(np.diff(first) > 0)
    assert len(np.unique(np.column_stack([label, expected]), axis=0)) == parts
