"""Drawn surfaces whose points contact, obstacles and smooth cuts move are the same on 1, 2 and 3 ranks."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from fracsim.mesh.split_surface.closed_surface import build_split_surface
from fracsim.mesh.split_surface.entity_numbering import EntityNumbering
from support.drawn import drawn_at
from support.drawn_contact import CASES
from support.ranks import Results, run_on_ranks
from support.solids import lattice
from support.whole_surface import make_surface_map

RANKS = (2, 3)


@pytest.fixture(scope="module")
def surfaces(tmp_path_factory: pytest.TempPathFactory) -> Results:
    """Arrays of support/drawn_contact.py on a rank count, run once."""
    folder = tmp_path_factory.mktemp("drawn")
    return cache(lambda ranks: run_on_ranks("support.drawn_contact", ranks, folder, seconds=300))


@pytest.mark.ranks
@pytest.mark.parametrize("ranks", RANKS)
@pytest.mark.parametrize("name", CASES)
def test_the_points_are_those_of_one_rank(surfaces: Results, name: str, ranks: int) -> None:
    """To round-off of sums, with the same elements and pieces."""
    serial, several = surfaces(1), surfaces(ranks)
    for key in ("triangles", "segments", "piece"):
        np.testing.assert_array_equal(several[f"{name}-{key}"], serial[f"{name}-{key}"])
    # smooth cuts are sums over ranks in the reference configuration, too
    for key in ("reference", "points"):
        np.testing.assert_allclose(several[f"{name}-{key}"], serial[f"{name}-{key}"], rtol=0, atol=1e-14)
    assert len(np.unique(serial[f"{name}-piece"])) > 1


@pytest.mark.parametrize(("name", "without"), [("ball", "smooth"), ("ball-2d", "cut-2d"), ("pieces", "cut")])
def test_no_drawn_point_is_in_the_ball(surfaces: Results, name: str, without: str) -> None:
    """Points of cracks, whose nodes are outside, would be inside it."""
    _, tables, _ = CASES[name]
    (ball,) = tables["obstacle"]
    distance, before = (
        np.linalg.norm(surfaces(1)[f"{key}-points"] - ball["at"], axis=1) - ball["radius"] for key in (name, without)
    )
    assert before.min() < -0.2 * ball["radius"] and distance.min() > 0


@pytest.mark.parametrize("dim", [2, 3])
def test_positions_are_those_of_the_linear_map(dim: int) -> None:
    """Which is built from matrices of the whole mesh, in other ways: all points, and points at other places."""
    rng = np.random.default_rng(dim)
    mesh = lattice(*(4,) * dim)
    skeleton = EntityNumbering(mesh)
    broken = rng.random(len(skeleton.edges)) < 0.3
    pattern = (broken[skeleton.cell_edges] << np.arange(skeleton.cell_edges.shape[1])).sum(axis=1).astype(np.uint8)
    split, u = build_split_surface(skeleton, pattern), rng.random(mesh.points.shape)
    surface = drawn_at(skeleton, pattern, split, u)
    expected = make_surface_map(split, skeleton, pattern, split.points)(u)
    np.testing.assert_allclose(surface.placed_points().rest, expected, atol=1e-12)
    copies = np.arange(split.numbering.first, len(split.points))
    places = split.points.copy()
    places[copies] += 0.1 * rng.random((len(copies), dim))
    expected = make_surface_map(split, skeleton, pattern, places)(u)
    np.testing.assert_allclose(surface.positions(copies, places[copies]), expected[copies], atol=1e-12)
