"""Quadratic displacement at 1, 2 and 3 ranks: the same edges, flow and motion, of curved cells too."""

from __future__ import annotations

import numpy as np
import pytest

from support.quadratic import RUNS
from support.ranks import OnRanks, Results, starting

pytestmark = pytest.mark.ranks


@pytest.fixture(scope="module")
def results(on_ranks: OnRanks) -> Results:
    """Arrays of a rank count."""
    return starting("order-", on_ranks)


def test_the_runs_do_something(results: Results) -> None:
    """The comparisons mean something: bodies tear, flow and are curved."""
    serial = results(1)
    for name in ("block", "plate", "tearing", "waiting"):
        assert serial[f"{name}-history"][:, 0].sum() > 0
    assert np.count_nonzero(serial["block-plastic"][..., -1]) > 0
    assert len(serial["disk-u"]) > 100


@pytest.mark.parametrize("ranks", (2, 3))
@pytest.mark.parametrize("name", RUNS)
def test_the_same_body(results: Results, ranks: int, name: str) -> None:
    """The very same edges, and the same motion to what solver tolerances of 1e-10 leave."""
    found, serial = results(ranks), results(1)
    for quantity in ("u", "v", "mass", "chi", "plastic", "energy", "history"):
        if (key := f"{name}-{quantity}") in serial:
            np.testing.assert_allclose(found[key], serial[key], atol=1e-7 * np.abs(serial[key]).max(), err_msg=key)
    if f"{name}-broken" in serial:
        assert np.array_equal(found[f"{name}-broken"], serial[f"{name}-broken"])
        assert np.array_equal(found[f"{name}-pieces"], serial[f"{name}-pieces"])
