"""The same body at 1, 2 and 3 ranks: averages, edges, pieces and whole runs, against serial references and each other.

One start of mpirun a rank count does all checks (support/every.py) and saves arrays in the order of the input mesh.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

from fracsim.meshes.data import MeshData
from fracsim.meshes.topology import edges_of
from fracsim.study import MeshSettings
from fracsim.study.mesh_source import build_mesh
from support.ranks import Arrays, OnRanks, run_on_ranks
from support.reference import gradients, lumped_mass
from support.torn import KERNELS, LABELS, MESHES, RADIUS, RUNS, cell_field, is_active, some_whole

EPS = np.finfo(float).eps
RANKS = (1, 2, 3)
pytestmark = pytest.mark.ranks
Results = Callable[[int], Arrays]


@pytest.fixture(scope="module")
def results(on_ranks: OnRanks) -> Results:
    """Arrays of a rank count."""
    return lambda ranks: on_ranks(ranks)[0]


@cache
def mesh_named(name: str) -> MeshData:
    """An input mesh, built here."""
    return build_mesh(MeshSettings.model_validate(MESHES[name]))


# --- non-local average ---


def dense_average(name: str, kernel: str, only_active: bool) -> npt.NDArray[np.float64]:
    """The double sum over all cells of the input mesh."""
    mesh = mesh_named(name)
    corners = mesh.points[mesh.cells]
    centroids, volumes = corners.mean(axis=1), gradients(corners)[1]
    q = cdist(centroids, centroids) / RADIUS[name]
    shape = {"linear": 1 - q, "constant": np.ones_like(q), "gaussian": np.exp(-((3 * q) ** 2) / 2)}[kernel]
    weights = np.where(q <= 1, shape, 0.0) * volumes * (is_active(centroids) if only_active else 1.0)
    sums = weights.sum(axis=1, keepdims=True)
    values = cell_field(centroids)
    return np.divide(weights @ values, sums, out=np.zeros_like(values), where=sums > 0)


@pytest.mark.parametrize("ranks", RANKS)
@pytest.mark.parametrize("name", RADIUS)
@pytest.mark.parametrize("kernel", KERNELS)
def test_averages_across_rank_boundaries(results: Results, ranks: int, name: str, kernel: str) -> None:
    """Equal to the dense sum over all cells, to round-off of a sum over the cells, of all cells and of active ones
    only."""
    cells = len(mesh_named(name).cells)
    for key, only_active in (("average", False), ("active", True)):
        expected = dense_average(name, kernel, only_active)
        np.testing.assert_allclose(results(ranks)[f"{key}-{name}-{kernel}"], expected, atol=cells * EPS)


# --- edges ---


@pytest.mark.parametrize("ranks", RANKS)
def test_an_edge_breaks_for_every_cell_that_has_it(results: Results, ranks: int) -> None:
    """Broken edges are those of the flagged cells, whichever rank said so; all cells around them know."""
    mesh, found = mesh_named("3d"), results(ranks)
    expected = {tuple(edge) for edge in edges_of(mesh.cells[::7]).tolist()}
    assert {tuple(edge) for edge in found["edges-broken"].tolist()} == expected
    assert found["edges-count"].tolist() == [len(expected)] * 2
    for cell, pattern in zip(mesh.cells, found["edges-patterns"], strict=True):
        own = {tuple(edge) for edge in edges_of(cell[None]).tolist()}
        assert int(pattern).bit_count() == len(own & expected)


@pytest.mark.parametrize("ranks", RANKS)
def test_every_edge_has_one_owner(results: Results, ranks: int) -> None:
    """Owned edges of all ranks are the edges of the input mesh, each once."""
    assert np.array_equal(results(ranks)["edges-keys"], edges_of(mesh_named("3d").cells))


@pytest.mark.parametrize("ranks", RANKS[1:])
def test_noise_belongs_to_the_edge(results: Results, ranks: int) -> None:
    """The perturbation that decides ties is the same to the last bit at any rank count."""
    assert np.array_equal(results(ranks)["edges-noise"], results(1)["edges-noise"])


@pytest.mark.parametrize("ranks", RANKS[1:])
def test_what_holds_a_node_is_the_same_at_any_number_of_ranks(ranks: int, results: Results) -> None:
    """And so which edges are spared, ties and all."""
    found, serial = (results(count)["held-broken"] for count in (ranks, 1))
    assert np.array_equal(found, serial) and len(found)


@pytest.mark.parametrize("ranks", RANKS)
def test_requested_rows_are_those_of_their_cells(results: Results, ranks: int) -> None:
    """Rows arrive in the order of the request, and a rank evaluates each row once, whichever ranks request it."""
    mesh, rows = mesh_named("3d"), results(ranks)["requested-rows"]
    assert np.array_equal(rows[:, 0], rows[:, 1]) and len(rows) >= len(mesh.cells) // 2
    assert np.array_equal(np.sort(rows[:, 2:], axis=1), np.sort(mesh.cells[rows[:, 0]], axis=1))
    assert results(ranks)["requested-once"].all()


# --- pieces ---


def reference_pieces(label: str) -> tuple[npt.NDArray[np.integer], npt.NDArray[np.float64], int]:
    """(piece of each node numbered by its lowest node, mass of each piece, broken edges) by SciPy on the input mesh."""
    name, law = LABELS[label]
    mesh = mesh_named(name)
    of_node, edges = law(mesh.points), edges_of(mesh.cells)
    intact = edges[of_node[edges[:, 0]] == of_node[edges[:, 1]]]
    graph = coo_matrix((np.ones(len(intact)), intact.T), shape=(len(of_node),) * 2)
    piece = connected_components(graph, directed=False)[1]
    _, first, inverse = np.unique(piece, return_index=True, return_inverse=True)
    piece = np.argsort(np.argsort(first))[inverse]
    mass = lumped_mass(mesh.points, mesh.cells, 1.0)[:: mesh.dim]
    return piece, np.bincount(piece, mass), len(edges) - len(intact)


@pytest.mark.parametrize("ranks", RANKS)
@pytest.mark.parametrize("label", LABELS)
def test_pieces_and_their_masses(results: Results, ranks: int, label: str) -> None:
    """Counted, numbered and weighed right, however they wind through the ranks; masses add up to the body's."""
    piece, mass, broken = reference_pieces(label)
    found = results(ranks)
    assert found[f"pieces-{label}"].tolist() == [len(mass), broken]
    assert np.array_equal(found[f"piece-{label}"], piece)
    np.testing.assert_allclose(found[f"piece-mass-{label}"], mass, rtol=len(piece) * EPS)
    body = gradients(mesh_of_label(label).points[mesh_of_label(label).cells])[1].sum()
    assert found[f"piece-mass-{label}"].sum() == pytest.approx(body, rel=len(piece) * EPS)


def mesh_of_label(label: str) -> MeshData:
    return mesh_named(LABELS[label][0])


def test_known_numbers_of_pieces() -> None:
    """Three cuts make four slabs, two combs are two pieces, breaking all makes dust of single nodes."""
    counts = {label: len(reference_pieces(label)[1]) for label in ("slabs", "comb", "whole", "dust")}
    assert counts == {"slabs": 4, "comb": 2, "whole": 1, "dust": 25**2}


def test_masses_of_slabs() -> None:
    """Cut half-way between planes of nodes at h = 1/8 a slab has the mass of its planes: rho A h each, half at the
    ends."""
    planes = np.bincount(np.searchsorted([0.2, 0.45, 0.8], np.arange(9) / 8), [0.5, *[1.0] * 7, 0.5])
    np.testing.assert_allclose(reference_pieces("slabs")[1], planes / 8 * 0.25**2, rtol=1e-12)


# --- whole runs ---


def scale(values: npt.NDArray[Any]) -> float:
    return float(np.abs(values).max(initial=0.0))


@pytest.mark.parametrize("ranks", RANKS[1:])
@pytest.mark.parametrize("name", RUNS)
def test_same_crack(results: Results, ranks: int, name: str) -> None:
    """The very same edges are broken, and the body is in as many pieces."""
    found, serial = results(ranks), results(1)
    assert len(serial[f"{name}-broken"]) > 5
    assert np.array_equal(found[f"{name}-broken"], serial[f"{name}-broken"])
    assert np.array_equal(found[f"{name}-pieces"], serial[f"{name}-pieces"])


@pytest.mark.parametrize("ranks", RANKS[1:])
@pytest.mark.parametrize("quantity", ("u", "v", "chi", "energy", "mass", "history"))
@pytest.mark.parametrize("name", RUNS)
def test_same_motion(results: Results, ranks: int, name: str, quantity: str) -> None:
    """Displacements, velocities, chi, energies, reactions and probes agree to what a solver tolerance of 1e-10 leaves
    after some tens of steps: 1e-7 of the largest value."""
    found, serial = results(ranks)[f"{name}-{quantity}"], results(1)[f"{name}-{quantity}"]
    assert found.shape == serial.shape
    assert np.all(np.isfinite(found))
    # rows of a history: broken edges, kinetic and elastic energy, and probes, of which some components are zero
    columns = [slice(0, 1), slice(1, 2), slice(2, 3), slice(3, None)] if quantity == "history" else [slice(None)]
    for column in columns:
        np.testing.assert_allclose(found[..., column], serial[..., column], atol=1e-7 * scale(serial[..., column]))


@pytest.mark.parametrize("ranks", RANKS[1:])
def test_same_walls_are_drawn_in(results: Results, ranks: int) -> None:
    """Walls that come to light in a squeezed body: as many, by the same shares, and the same ones are left out, at once
    and two steps later, when they are others."""
    found, serial = results(ranks), results(1)
    assert (serial["squeezed-at-once-share"] < 1).sum() > 5
    assert 0 < len(serial["squeezed-at-once-left_out"]) != len(serial["squeezed-later-left_out"])
    for name in ("at-once-share", "at-once-left_out", "later-share", "later-left_out"):
        np.testing.assert_array_equal(found[f"squeezed-{name}"], serial[f"squeezed-{name}"])
    np.testing.assert_allclose(found["squeezed-u"], serial["squeezed-u"], atol=1e-7 * scale(serial["squeezed-u"]))


@pytest.mark.parametrize("run", ("block", "joined"))
@pytest.mark.parametrize("ranks", RANKS)
def test_same_crack_where_products_are_made_in_blocks(results: Results, ranks: int, run: str) -> None:
    """What single entries break (the meshes are so small that they take these by themselves), ties among them."""
    found = results(ranks)
    assert np.array_equal(found[f"{run}-broken-in-blocks"], found[f"{run}-broken"])
    u = found[f"{run}-u"]
    np.testing.assert_allclose(found[f"{run}-u-in-blocks"], u, atol=1e-9 * scale(u))


@pytest.mark.parametrize("name", ("ductile", "ductile-implicit"))
@pytest.mark.parametrize("ranks", RANKS[1:])
def test_same_flow(results: Results, ranks: int, name: str) -> None:
    """F_p and the accumulated plastic strain of every cell, some tens of which have flowed (atol: as of the motion)."""
    found, serial = results(ranks)[f"{name}-plastic"], results(1)[f"{name}-plastic"]
    assert np.count_nonzero(np.asarray(serial[..., -1], float) > 0.01) > 20
    np.testing.assert_allclose(found, serial, atol=1e-6)


@pytest.mark.parametrize("ranks", RANKS)
def test_dead_cells_are_left_out(results: Results, ranks: int) -> None:
    """Each rank leaves out its own, a third of all cells; residual and tangent are the same to the last bit, and to
    round-off a tangent without their entries, which adds in another order, in blocks, and what is brought to those. A
    consistent mass couples their nodes, so that all entries stay."""
    cells = len(mesh_named("3d").cells)
    for mass, ways in (("lumped", ("fitted", "blocks", "brought")), ("consistent", ("blocks", "brought"))):
        found = {key.removeprefix(f"{mass}-"): values for key, values in results(ranks).items()}
        assert found["cells-with-dead"] == cells
        assert found["cells-without-dead"] == cells - len(range(0, cells, 3))
        for name in ("residual", "tangent"):
            assert np.array_equal(found[f"{name}-without-dead"], found[f"{name}-with-dead"])
            for how in ways:
                np.testing.assert_allclose(found[f"{name}-{how}-without-dead"], found[f"{name}-with-dead"], atol=1e-14)
            assert scale(found[f"{name}-with-dead"]) > 1e-3


@pytest.mark.parametrize("ranks", RANKS)
def test_parts_that_share_nodes_or_edges_alone(results: Results, ranks: int) -> None:
    """Parts are those of the graph of cells that share facets; each node goes with the largest around it."""
    found, cells = results(ranks), mesh_named("3d").cells
    cells = cells[some_whole(np.arange(len(cells)))]
    shared = (cells[:, None, :, None] == cells[None, :, None, :]).sum(axis=(2, 3)) == 3
    count, part = connected_components(coo_matrix(shared), directed=False)
    size = np.bincount(part)
    assert found["parts-count"] == count > 5
    of_node = found["parts-of-node"].astype(int)
    sizes = [size[part[(cells == node).any(axis=1)]] for node in range(len(of_node))]
    numbers = np.sort(size)[::-1]
    assert all(numbers[mine] == around.max() if len(around) else mine == -1
               for mine, around in zip(of_node, sizes, strict=True))  # fmt: skip
    assert np.array_equal(of_node, results(1)["parts-of-node"])


def test_the_runs_do_tear() -> None:
    """The comparisons mean something: there is a radius, there are ties, several schemes and energies."""
    assert {table["material"]["energy"] for table in RUNS.values()} == {"neo-hookean", "corotated", "linear"}
    assert all(table["fracture"]["radius"] > 0 for table in RUNS.values())
    assert len({table["time"]["scheme"] for table in RUNS.values()}) == 5


def test_a_failing_rank_fails_the_test(tmp_path: Any) -> None:
    """The harness itself: an error on one rank ends all of them, and is told."""
    with pytest.raises(AssertionError, match="only on rank 1"):
        run_on_ranks("support.faulty", 2, tmp_path, seconds=30)
