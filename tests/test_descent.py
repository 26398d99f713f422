"""What the line search of Newton's method goes down beside contact."""

from __future__ import annotations

from typing import Any, cast

import pytest
from petsc4py import PETSc

from fracsim.solvers.line_search import MeritFunction


class Hill:
    """A balance whose potential is that of the place x (1,), J; something always touches."""

    def __init__(self) -> None:
        self.work_vector, self.displacement_version, self._x = PETSc.Vec().createSeq(1), 0, 0.0
        self.contact, self.energies, self.eliminated = self, self, None

    def set_iterate(self, x: PETSc.Vec) -> None:
        if x.array_r[0] != self._x:
            self._x, self.displacement_version = float(x.array_r[0]), self.displacement_version + 1

    def is_active(self) -> bool:
        return True

    def incremental_potential(self) -> tuple[float, float]:
        return self._x, 1.0


def rises(*heights: float) -> list[float]:
    """What a line search sees that sets out from 0 and tries these."""
    hill, x = Hill(), PETSc.Vec().createSeq(1)
    descent, seen = MeritFunction(cast("Any", hill), cast("Any", None)), []
    descent.begin_line_search()
    for height in (0.0, *heights):
        x.array_w[:] = height
        seen.append(descent(x))
    assert seen[0] == 0
    return seen[1:]


@pytest.mark.parametrize("height", [1e-14, -1e-14, -1.0])
def test_whole_steps_go_down_where_nothing_but_round_off_is_left(height: float) -> None:
    assert rises(height)[0] < 0


def test_a_step_is_not_cut_until_it_makes_no_difference() -> None:
    """Uphill all along: with the shortest step there is no way down, and the search fails at once instead of standing
    still to the last iteration. One that is near the solution may be cut to round-off."""
    assert min(rises(1.0, 1e-3, 1e-14)) > 0
    assert rises(1e-10, 1e-14)[1] < 0
    assert rises(1.0, -0.5)[1] == -0.5
