"""Exact solutions for nodes whose stiffness has changed since multigrid was set up."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from support.ranks import run_on_ranks

pytestmark = pytest.mark.fast_solver_only("the V cycle in single precision")


@pytest.mark.parametrize("ranks", [1, *(pytest.param(count, marks=pytest.mark.ranks) for count in (2, 3))])
def test_they_are_worth_a_new_set_up(ranks: int, tmp_path: Path) -> None:
    """Cells of a bar become 100 times as stiff: CG takes several times the iterations. With exact solutions for their
    nodes and the neighbours of these it takes no more than before. After a new set-up no node has changed."""
    found = run_on_ranks("support.changed_nodes", ranks, tmp_path)
    before, stale, exact, new, left = (int(found[name]) for name in ("before", "stale", "exact", "new", "left"))
    assert stale > 4 * before and exact < 1.3 * before and exact <= new, (before, stale, exact, new)
    cells, is_stiff = found["cells"].astype(int), found["stiff"] > 0
    touched = np.isin(cells, cells[is_stiff]).any(axis=1)
    np.testing.assert_array_equal(np.flatnonzero(found["changed"]), np.unique(cells[touched]))
    assert left == 0
