"""Contact surfaces are distributed: no rank has all of one, and contacts are those of one rank."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from support.ranks import Arrays, run_on_ranks

pytest.importorskip("ipctk", reason="an environment made without a network")
pytestmark = pytest.mark.ranks


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Arrays:
    return run_on_ranks("support.partitioned", 1, tmp_path_factory.mktemp("partitioned"))


@pytest.mark.parametrize("ranks", (2, 3))
def test_contacts_of_a_long_body_in_pieces(ranks: int, alone: Arrays, tmp_path: Path) -> None:
    """Cut across in two places, slantwise, and pressed together: each contact is on one rank, with the gap and
    stiffness of one rank; displacements are the same to round-off. The elements of all ranks are those of one; a rank
    gets elements of others at its borders alone. Of random triangles none within the reach is missing."""
    together = run_on_ranks("support.partitioned", ranks, tmp_path)
    assert together["missing"] == 0
    for case in ("2-True", "2-pieces", "3-True", "3-pieces"):
        one, several = ({key: arrays[f"{case}-{key}"] for key in ("points", "gap", "stiffness", "u", "counts")}
                        for arrays in (alone, together))  # fmt: skip
        assert len(one["points"]) > 10
        np.testing.assert_array_equal(several["points"], one["points"])
        np.testing.assert_allclose(several["gap"], one["gap"], atol=1e-8)
        np.testing.assert_allclose(several["stiffness"], one["stiffness"], rtol=1e-10)
        np.testing.assert_allclose(several["u"], one["u"], atol=1e-11)
        own, held = several["counts"].T
        whole = one["counts"][0, 0]
        assert own.sum() == whole and own.max() < 1.4 * whole / ranks
        assert (held > own).all() and held.max() < 0.9 * whole and held.min() < 0.6 * whole


@pytest.mark.parametrize("ranks", (2, 3))
def test_cracks_that_the_barrier_closes(ranks: int, tmp_path_factory: pytest.TempPathFactory) -> None:
    """Forces with lagged friction, stiffness, energies, gaps and free ways are those of one rank, also after an end has
    moved away and back, for which elements are exchanged within the step. No rank has the whole surface."""
    one, several = (
        run_on_ranks("support.partitioned_barrier", count, tmp_path_factory.mktemp("closed")) for count in (1, ranks)
    )
    for case in ("2-True", "2-pieces", "3-True", "3-pieces"):
        for name in ("closed", "away", "back"):
            for key in ("f", "K", "energies", "fraction", "gap"):
                expected = one[f"{case}-{name}-{key}"]
                assert np.abs(expected).max() > 0
                found = several[f"{case}-{name}-{key}"]
                np.testing.assert_allclose(
                    found, expected, rtol=1e-9, atol=1e-10 * np.abs(expected).max(), err_msg=name
                )
            assert np.array_equal(several[f"{case}-{name}-followed"], one[f"{case}-{name}-followed"])
        assert 0.2 < one[f"{case}-back-followed"].mean() < 1
        assert one[f"{case}-back-gap"] < 1 and one[f"{case}-back-fraction"] < 1
        own, held, exchanges = several[f"{case}-counts"].T
        whole = one[f"{case}-counts"][0, 0]
        assert own.sum() == whole and own.max() < 1.4 * whole / ranks
        assert (held > own).all() and held.max() < 0.95 * whole
        assert (exchanges > one[f"{case}-counts"][0, 2]).all()
