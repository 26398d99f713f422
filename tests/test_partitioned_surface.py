"""Contact surfaces in explicit steps are distributed: no rank has all of one, and contacts are those of one rank."""

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
