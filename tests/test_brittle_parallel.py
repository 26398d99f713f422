"""Brittle surfaces at 1, 2 and 3 ranks: the same starts, edges, cuts and pieces as in serial."""

from __future__ import annotations

import numpy as np
import pytest

from support.ranks import OnRanks, Results, starting
from support.shattered import RUNS

pytestmark = pytest.mark.ranks


@pytest.fixture(scope="module")
def results(on_ranks: OnRanks) -> Results:
    """Arrays of a rank count."""
    return starting("brittle-", on_ranks)


@pytest.mark.parametrize("name", RUNS)
def test_the_runs_do_shatter(results: Results, name: str) -> None:
    """The comparisons mean something: surfaces start in each run, and the body comes apart."""
    found = results(1)
    assert 1 <= len(found[f"{name}-starts"]) <= RUNS[name]["brittle"]["surfaces"]
    assert found[f"{name}-pieces"][0] >= 2


@pytest.mark.parametrize("ranks", (2, 3))
@pytest.mark.parametrize("name", RUNS)
def test_the_same_pattern(results: Results, ranks: int, name: str) -> None:
    """The very same edges and pieces, and starts to the last bits. Cuts to what a solver tolerance of 1e-10 leaves of
    the stress: 1e-7 of an edge, 1e-5 where principal stresses within 1e-3 of each other leave the direction open."""
    found, serial = results(ranks), results(1)
    assert np.array_equal(found[f"{name}-broken"], serial[f"{name}-broken"])
    assert np.array_equal(found[f"{name}-pieces"], serial[f"{name}-pieces"])
    np.testing.assert_allclose(found[f"{name}-starts"], serial[f"{name}-starts"], rtol=1e-14)
    np.testing.assert_allclose(found[f"{name}-cut"], serial[f"{name}-cut"], atol=1e-5 if name == "ties" else 1e-7)


@pytest.mark.parametrize("ranks", (2, 3))
@pytest.mark.parametrize("name", RUNS)
def test_the_same_motion(results: Results, ranks: int, name: str) -> None:
    """Displacements, chi and energies agree to what the solver's tolerance leaves after some steps."""
    for quantity in ("u", "chi", "energy"):
        if f"{name}-{quantity}" not in results(1):
            continue
        found, serial = results(ranks)[f"{name}-{quantity}"], results(1)[f"{name}-{quantity}"]
        np.testing.assert_allclose(found, serial, atol=1e-6 * np.abs(serial).max())
