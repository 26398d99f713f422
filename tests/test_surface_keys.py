"""Keys of the points of a rank's split surface name the same points before and after edges break, and on all ranks."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mpi4py import MPI

from fracsim.mesh.ghost_exchange import KeyLookup, find_saved_keys
from support.ranks import run_on_ranks
from support.surface_keys import broken_stages


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("dim", [2, 3])
def test_points_are_found_as_by_position_and_nodes(dim: int, order: int) -> None:
    """As edges break: by keys and by descriptions, of all points; some points stay and others have lost nodes."""
    (old, _, old_points), (new, _, new_points) = broken_stages(dim, order)
    assert len(set(new.tolist())) == len(set(new_points)) == len(new)
    found = KeyLookup(new)(old)
    number = {description: row for row, description in enumerate(new_points)}
    assert found.tolist() == [number.get(description, -1) for description in old_points]
    of_crack = np.array([len(description) > dim + 1 for description in old_points])
    assert (found[of_crack] >= 0).any() and (found[of_crack] < 0).any()


@pytest.mark.ranks
def test_points_have_the_same_keys_on_all_ranks(tmp_path: Path) -> None:
    """All keys of one rank are those of two and three; areas that ranks share add up to that of one rank."""
    alone = run_on_ranks("support.surface_keys", 1, tmp_path)
    for ranks in (2, 3):
        parts = run_on_ranks("support.surface_keys", ranks, tmp_path)
        for name, values in alone.items():
            if name.endswith("-count"):
                assert parts[name] > values
            elif name.endswith("-area"):
                np.testing.assert_allclose(parts[name], values, rtol=1e-12)
            else:
                np.testing.assert_array_equal(parts[name], values)


def test_saved_keys_of_no_point_are_refused() -> None:
    """A checkpoint of another mesh, or a damaged one."""
    keys = np.array([7, 3, 11])
    assert find_saved_keys(MPI.COMM_SELF, keys, np.array([11, 7])).tolist() == [2, 0]
    with pytest.raises(ValueError, match="1 of 2 keys are of no point or element"):
        find_saved_keys(MPI.COMM_SELF, keys, np.array([11, 8]))
