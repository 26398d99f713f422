"""Scatter and direction of the strength against their distributions and a bar that is pulled."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

from fracsim.fracture.strength import (
    EdgeStrength,
    FibreAnisotropy,
    WeibullScatter,
    fibre_factors,
    hash_points,
    round_points,
    weibull_factors,
)
from fracsim.study.check import check_study
from support.scenes import make_scene, make_study, march


@pytest.mark.parametrize("modulus", (2.0, 8.0, 50.0))
def test_scatter_is_weibull_with_mean_one(modulus: float) -> None:
    """P(w < x) = 1 - exp(-(x/s)^m), s = 1 / Gamma(1 + 1/m): Kolmogorov-Smirnov, and the mean within 4 errors."""
    points = np.random.default_rng(1).uniform(-1, 1, (20_000, 3))
    sample = weibull_factors(points, WeibullScatter(modulus=modulus, seed=3))
    law = stats.weibull_min(modulus, scale=1 / stats.weibull_min(modulus).mean())
    assert stats.kstest(sample, law.cdf).pvalue > 1e-3
    assert abs(sample.mean() - 1) < 4 * law.std() / np.sqrt(len(sample))


def test_the_seed_decides() -> None:
    """The same seed gives the same numbers in any order of the places, another seed other and uncorrelated ones."""
    points = np.random.default_rng(2).uniform(-1, 1, (5_000, 2))
    order = np.random.default_rng(3).permutation(len(points))
    first, again, other = (weibull_factors(points, WeibullScatter(modulus=5.0, seed=seed)) for seed in (7, 7, 8))
    assert np.array_equal(first, again)
    assert np.array_equal(weibull_factors(points[order], WeibullScatter(modulus=5.0, seed=7)), first[order])
    assert abs(np.corrcoef(first, other)[0, 1]) < 4 / np.sqrt(len(points))


@pytest.mark.parametrize("size", (1e-3, 1.0, np.sqrt(2.0), 250.0))
def test_round_off_of_the_mesh_does_not_change_the_strength(size: float) -> None:
    """A mesh of another library, 1e-15 of the body away, has the same numbers; one 2e-9 away has others.

    The body lies three times its size from the origin, and its size differs by round-off, too.
    """
    random = np.random.default_rng(4)
    lattice = size * (3 + np.stack(np.meshgrid(*[np.linspace(0, 1, 18)] * 3), axis=-1).reshape(-1, 3))
    first = hash_points(round_points(lattice, size))
    same = round_points(lattice + 1e-15 * size * random.uniform(-1, 1, lattice.shape), size * (1 + 4e-16))
    other = round_points(lattice + 2e-9 * size, size)
    assert np.array_equal(first, hash_points(same))
    assert np.all(first != hash_points(other))


def test_direction() -> None:
    """ratio along the fibre, 1 across, in between by the square of the cosine, whatever the lengths."""
    fibre = FibreAnisotropy(direction=[3.0, 0.0, 4.0], ratio=2.5)
    vectors = np.array([[6.0, 0.0, 8.0], [0.0, 5.0, 0.0], [-4.0, 0.0, 3.0], [1.0, 0.0, 0.0]])
    assert fibre_factors(vectors, fibre) == pytest.approx([2.5, 1.0, 1.0, 1 + 1.5 * 0.36], rel=1e-14)


def test_no_edge_of_a_cell_is_weaker_than_is_said_of_it() -> None:
    """With scatter, a fibre and two regions' worth of strengths; one edge of each cell is that weak but for the tie."""
    mesh = {"builder": "box", "size": [1.0, 1.0, 1.0], "h": 0.34, "pattern": "unstructured"}
    graph = make_scene(mesh=mesh, fracture={"strength": 1.0})[0].fracture.graph
    cells = np.arange(len(graph.cell_edges))
    of_cell = np.where(cells % 2, 1.0, 3.0)
    how = {"scatter": WeibullScatter(5.0, 2), "fibre": FibreAnisotropy([1.0, 0.0, 1.0], 2.0)}
    strength = EdgeStrength(graph, of_cell, tie_break=1e-3, **how)
    least = strength(cells, graph.cell_edges).min(axis=1)
    said = strength.minimum_in(cells)
    assert np.all(said <= least) and np.all(said >= (1 - 2.1e-3) * least)
    assert EdgeStrength(graph, 2.0, tie_break=0.1).minimum_in(cells) == pytest.approx(1.8)


def pulled(**fracture: Any) -> int:
    """Steps until a unit square breaks that is strained by 0.1 % a step along x (E = 1, nu = 0: stress = strain)."""
    scene, state = make_scene(
        time={"scheme": "quasi-static", "step": 1.0, "end": 40.0},
        boundary=[
            {"on": "left", "fix": "xy"},
            {"on": "right", "displacement": {"time": [0, 40], "value": [[0.0, 0.0], [0.04, 0.0]]}},
        ],
        fracture={"strength": 0.0095, **fracture},
    )
    for step in range(1, 41):
        if march(scene, state, 1)[0].broken:
            return step
    return 0


def test_a_fibre_along_the_load_strengthens() -> None:
    """Strength 0.0095 breaks at 0.010, the tenth step; twice that along the load in the step that reaches 0.019."""
    assert pulled() == 10
    assert pulled(fibre={"direction": [1.0, 0.0], "ratio": 2.0}) in (19, 20)
    assert pulled(fibre={"direction": [0.0, 1.0], "ratio": 2.0}) == 10


def test_ratio_one_is_isotropic() -> None:
    """A fibre of ratio 1 changes nothing."""
    directions = np.random.default_rng(5).normal(size=(100, 3))
    assert np.array_equal(
        fibre_factors(directions, FibreAnisotropy(direction=[1.0, 2.0, 3.0], ratio=1.0)), np.ones(100)
    )


def test_scatter_breaks_the_weakest_first() -> None:
    """With a modulus of 3 some edge is far below the mean: the square breaks before the tenth step."""
    assert 0 < pulled(heterogeneity={"modulus": 3.0, "seed": 1}) < 10


def test_the_weakest_of_many_edges_is_told() -> None:
    """The weakest of N Weibull numbers of mean 1 has mean N^(-1/m): the load of a body depends on its cells."""
    modulus, seeds = 8.0, 400
    for cells in (8, 16):
        points = np.stack(np.meshgrid(*2 * [np.arange(cells) + 0.5]), axis=-1).reshape(-1, 2)
        weakest = [weibull_factors(points, WeibullScatter(modulus, seed)).min() for seed in range(seeds)]
        error = np.std(weakest) / np.sqrt(seeds)
        assert abs(np.mean(weakest) - (cells**2) ** (-1 / modulus)) < 4 * error
    scatter = {"strength": 1.0, "heterogeneity": {"modulus": modulus}}
    lines = "\n".join(check_study(make_study(fracture=scatter)))
    assert f"half h lowers the weakest to {4 ** (-1 / modulus):.2g} in 2D, {8 ** (-1 / modulus):.2g} in 3D" in lines
    assert "half h" not in "\n".join(check_study(make_study(fracture={"strength": 1.0})))
