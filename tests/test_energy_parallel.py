"""Cracks that take an energy at 1, 2 and 3 ranks: the same edges, cut at the same places."""

from __future__ import annotations

import numpy as np
import pytest

from support.ranks import OnRanks, Results, starting
from support.tearing import RUNS

pytestmark = pytest.mark.ranks


@pytest.fixture(scope="module")
def results(on_ranks: OnRanks) -> Results:
    """Arrays of a rank count."""
    return starting("tearing-", on_ranks)


@pytest.mark.parametrize("name", RUNS)
def test_the_runs_do_tear(results: Results, name: str) -> None:
    """The comparisons mean something: cracks grow by some cells in several steps."""
    assert np.count_nonzero(results(1)[f"{name}-history"][:, 0]) >= 3
    assert results(1)[f"{name}-history"][:, 0].sum() >= 6


@pytest.mark.parametrize("ranks", (2, 3))
@pytest.mark.parametrize("name", RUNS)
def test_the_same_cracks(results: Results, ranks: int, name: str) -> None:
    """The very same edges, cuts to what a solver tolerance of 1e-10 leaves of the direction, and the same motion."""
    found, serial = results(ranks), results(1)
    assert np.array_equal(found[f"{name}-broken"], serial[f"{name}-broken"])
    assert np.array_equal(found[f"{name}-pieces"], serial[f"{name}-pieces"])
    np.testing.assert_allclose(found[f"{name}-cut"], serial[f"{name}-cut"], atol=1e-7)
    for quantity in ("u", "chi", "energy", "dissipated"):
        expected = serial[f"{name}-{quantity}"]
        np.testing.assert_allclose(found[f"{name}-{quantity}"], expected, atol=1e-6 * np.abs(expected).max())
