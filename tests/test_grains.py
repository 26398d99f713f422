"""Grain boundaries: labels against brute force, cuts on bisectors, free grains, cracks that run along them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from scipy.stats import kstest

from fracsim.fracture.brittle.grains import GrainBoundaries, GrainParameters, assign_to_seeds, draw_seeds
from fracsim.fracture.brittle.surface_cut import SurfaceCutMesh
from fracsim.meshes.data import MeshData
from fracsim.study import MeshSettings
from fracsim.study.mesh_source import build_mesh
from support.brittle import Broken, cut_points, open_at

ROUND_OFF = 1e3 * np.finfo(float).eps


def box(dim: int, h: float = 0.0) -> MeshData:
    h = h or {2: 0.06, 3: 0.08}[dim]
    size = [1.0, 0.8, 0.5][:dim]
    return build_mesh(MeshSettings.model_validate({"builder": "box", "size": size, "h": h, "pattern": "unstructured"}))


def grains_of(dim: int, settle: bool = False, **table: Any) -> tuple[SurfaceCutMesh, GrainBoundaries]:
    body = SurfaceCutMesh(box(dim))
    return body, GrainBoundaries(body, GrainParameters(**({"count": 12, "seed": 4} | table)), settle)


@pytest.mark.parametrize("dim", (2, 3))
def test_labels_are_those_of_least_energy(dim: int) -> None:
    """Against a loop over points and seeds."""
    random = np.random.default_rng(dim)
    points, seeds, weights = random.random((150, dim)), random.random((9, dim)), random.uniform(0.5, 1.5, 9)
    label, energy = assign_to_seeds(points, seeds, weights)
    for x, found, value in zip(points, label, energy, strict=True):
        every = [k * math.dist(x, p) for k, p in zip(weights, seeds, strict=True)]
        assert found == int(np.argmin(every)) and value == pytest.approx(min(every), rel=1e-14)


def test_seeds_are_uniform_in_the_body() -> None:
    """Each coordinate of points sown in a box is uniform (Kolmogorov-Smirnov, a seed that is fixed); same seed, same
    points; weights keep to their range."""
    body = SurfaceCutMesh(box(3, 0.2))
    seeds, weights = draw_seeds(body, GrainParameters(count=2000, seed=1, spread=0.3))
    for axis, length in enumerate((1.0, 0.8, 0.5)):
        assert kstest(seeds[:, axis] / length, "uniform").pvalue > 0.01
    assert 0.7 <= weights.min() < 0.71 and 1.29 < weights.max() <= 1.3
    assert np.array_equal(seeds, draw_seeds(body, GrainParameters(count=2000, seed=1, spread=0.3))[0])
    assert not np.array_equal(seeds, draw_seeds(body, GrainParameters(count=2000, seed=2, spread=0.3))[0])


@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize("spread", (0.0, 0.3))
def test_cuts_are_where_energies_are_equal(dim: int, spread: float) -> None:
    """q = E_j^2 - E_i^2 vanishes at every cut but for what linear interpolation on an edge of length L leaves of it:
    |q''| L^2 / 8 = |k_j^2 - k_i^2| L^2 / 4, nothing for equal weights (a plane)."""
    body, grains = grains_of(dim, spread=spread)
    edges = body.edges[grains.edges]
    at, ends = cut_points(body.points, edges, grains.cut_positions), grains.node_grain[edges]
    k2 = grains.weights[ends] ** 2
    first, second = (k2[:, a] * np.sum((at - grains.seeds[ends[:, a]]) ** 2, axis=1) for a in (0, 1))
    bound = np.abs(k2[:, 0] - k2[:, 1]) * np.sum(np.diff(body.points[edges], axis=1)[:, 0] ** 2, axis=1) / 4
    assert np.all(ends[:, 0] != ends[:, 1]) and len(at) > 50
    assert np.all(np.abs(second - first) <= bound + 1e-8)  # NEAREST moves a cut by 1e-9 of an edge


@pytest.mark.parametrize("dim", (2, 3))
def test_stretched_grains_are_round_in_shrunk_coordinates(dim: int) -> None:
    """Nodes and cuts are those of the shrunk body with the same seeds; a grain is as much longer as it is stretched."""
    stretch = np.array([6.0, 1.0, 1.0])[:dim]
    body = SurfaceCutMesh(box(dim))
    grains = GrainBoundaries(body, GrainParameters(300, 4, stretch=stretch), False)
    label, _ = assign_to_seeds(body.points / stretch, grains.seeds / stretch, grains.weights)
    assert np.array_equal(grains.node_grain, label)
    ends = grains.node_grain[body.edges[grains.edges]]
    cut = cut_points(body.points, body.edges[grains.edges], grains.cut_positions)
    first, second = (grains.weights[ends[:, a]] * np.linalg.norm((cut - grains.seeds[ends[:, a]]) / stretch, axis=1)
                     for a in (0, 1))  # fmt: skip
    assert np.all(np.abs(first - second) < 1e-8)
    points = np.random.default_rng(0).random((40_000, dim)) * [1.0, 0.8, 0.5][:dim]
    label, _ = assign_to_seeds(points / stretch, grains.seeds / stretch, grains.weights)
    inside = [each for each in (points[label == k] for k in range(300)) if len(each) > 20]
    spread = np.median([each.std(axis=0) for each in inside], axis=0)
    assert spread[0] / spread[1] > 2.5  # the body ends before six times the width


@pytest.mark.parametrize("dim", (2, 3))
def test_settled_nodes_have_a_cell_of_their_grain(dim: int) -> None:
    """No node is without a cell within its grain, and hardly more have changed their grain than were."""
    table = {"count": {2: 60, 3: 12}[dim], "spread": 0.2}
    body, plain = grains_of(dim, **table)
    _, settled = grains_of(dim, settle=True, **table)
    before, after = lost(body, plain), lost(body, settled)
    assert before.sum() > 0 and not after.any()
    assert (plain.node_grain != settled.node_grain).sum() <= 2 * before.sum()


@pytest.mark.parametrize("seed", range(1, 5))
def test_small_grains_of_a_thin_slab_leave_no_node_alone(seed: int) -> None:
    """Two cells thick, 2.5 edges to a grain: one node in ten has no cell in its grain as they are; moved all at once
    one in two hundred keeps none (three of these four seeds), one after the other none."""
    slab = {"builder": "box", "size": [0.2, 0.2, 0.02], "h": 0.012, "pattern": "unstructured"}
    body = SurfaceCutMesh(build_mesh(MeshSettings.model_validate(slab)))
    rules = GrainParameters(75, seed, 0.2, "bias")
    plain, settled = (GrainBoundaries(body, rules, settle) for settle in (False, True))
    assert lost(body, plain).sum() > 50 and not lost(body, settled).any()
    assert (plain.node_grain != settled.node_grain).mean() < 0.2


def lost(body: SurfaceCutMesh, grains: GrainBoundaries) -> Any:
    """(N,) nodes without a cell within their grain."""
    of = grains.node_grain[body.cells]
    flags = np.ones(len(body.points), bool)
    flags[body.cells[np.all(of == of[:, :1], axis=1)]] = False
    return flags


def opened(dim: int, **grains: Any) -> tuple[Broken, GrainBoundaries, MeshData]:
    mesh, table = box(dim), {"count": 12, "seed": 4} | grains
    places = [[0.5, 0.4, 0.25][:dim], [0.15, 0.2, 0.1][:dim]]
    made = open_at(mesh, places, [[1.0, 0.2, 0.1][:dim]] * 2, grains=GrainParameters(**table))
    return made, GrainBoundaries(SurfaceCutMesh(mesh), GrainParameters(**table), False), mesh


@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize("spread", (0.0, 0.3))
def test_a_surface_frees_the_grain_that_it_starts_in(dim: int, spread: float) -> None:
    """Two starts, two free grains: each piece of the split body has nodes of one of them only, or of neither; cut edges
    are those with one end in them; the surface is watertight: volumes add up to the body's."""
    made, grains, mesh = opened(dim, spread=spread)
    assert len(made.opened.starts) == 2
    freed = assign_to_seeds(made.opened.starts, grains.seeds, grains.weights)[0]
    body = SurfaceCutMesh(mesh)
    role = np.where(np.isin(grains.node_grain, freed), grains.node_grain, -1)
    ends = role[body.edges]
    expected = body.edges[ends[:, 0] != ends[:, 1]]
    assert np.array_equal(made.opened.keys, expected)
    for piece in range(made.surface.fragment_count):
        assert len(np.unique(role[made.surface.node_fragment == piece])) == 1
    assert made.volumes.min() > 0
    assert made.volumes.sum() == pytest.approx(np.prod([1.0, 0.8, 0.5][:dim]), rel=ROUND_OFF)


def test_a_free_grain_of_equal_weights_is_a_polygon() -> None:
    """2D, equal weights: the piece of a grain is its Voronoi polygon, the part of the box nearer to its seed than to
    others, counted on a fine lattice; within 3 %: corners of the polygon lie inside cells, which lose them."""
    made, grains, _ = opened(2)
    freed = assign_to_seeds(made.opened.starts[:1], grains.seeds, grains.weights)[0][0]
    x, y = np.meshgrid((np.arange(500) + 0.5) / 500, (np.arange(400) + 0.5) / 500, indexing="ij")
    share = (assign_to_seeds(np.column_stack([x.ravel(), y.ravel()]), grains.seeds, grains.weights)[0] == freed).mean()
    piece = made.surface.node_fragment[np.flatnonzero(grains.node_grain == freed)[0]]
    assert made.volumes[piece] == pytest.approx(0.8 * share, rel=0.03)


@pytest.mark.parametrize("shape", ("planar", "curved"))
@pytest.mark.parametrize("dim", (2, 3))
def test_bias_runs_along_grain_boundaries(dim: int, shape: str) -> None:
    """Only edges between grains are cut, no grain is split, and the crack stays within a grain of the plane."""
    mesh = box(dim)
    normal = np.array([1.0, 0.2, 0.1][:dim]) / np.linalg.norm([1.0, 0.2, 0.1][:dim])
    field = (lambda places: np.broadcast_to(normal, places.shape)) if shape == "curved" else None
    table = {"count": 40, "seed": 1, "mode": "bias"}
    made = open_at(
        mesh,
        [[0.5, 0.4, 0.25][:dim]],
        [normal.tolist()],
        curved=shape == "curved",
        field=field,
        grains=GrainParameters(**table),
    )
    body = SurfaceCutMesh(mesh)
    grains = GrainBoundaries(body, GrainParameters(**table), False)
    ends = grains.node_grain[made.opened.keys]
    assert len(ends) > 5 and np.all(ends[:, 0] != ends[:, 1])
    assert made.surface.fragment_count == 2
    for grain in range(40):
        assert len(np.unique(made.surface.node_fragment[grains.node_grain == grain])) <= 1
    size = max(np.ptp(body.points[grains.node_grain == grain] @ normal) for grain in np.unique(grains.node_grain))
    assert np.abs((made.places - made.opened.starts[0]) @ normal).max() <= size
