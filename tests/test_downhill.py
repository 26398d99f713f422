"""When an attempt with positive moduli gives up."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from fracsim.solvers.line_search import POSITIVE_TANGENTS, ModifiedNewton, TangentModification
from fracsim.solvers.policy import DEFAULT_POLICY


def stalls_after(norms: list[float], how: TangentModification | None) -> int | None:
    """The iteration at which an attempt with such residuals stops, if it does."""
    now: list[float] = []
    vector = SimpleNamespace(duplicate=lambda: None)
    snes: Any = SimpleNamespace(
        setObjective=lambda _: None, setFunction=lambda *_: None, getFunctionNorm=lambda: now[-1]
    )
    balance: Any = SimpleNamespace(work_vector=vector)
    down = ModifiedNewton(balance, snes)
    down.use_modification(how)
    for its, norm in enumerate(norms):
        now.append(norm)
        if down.has_stalled(norm, its):
            return its
    return None


ROUND = [100.0, 10.0, 0.01, *[0.011] * 30]  # exact below a thousandth: from the third on


@pytest.mark.parametrize(
    ("norms", "how", "at"),
    [
        (ROUND, POSITIVE_TANGENTS[0], 2 + DEFAULT_POLICY.max_stalled_iterations),
        (ROUND, POSITIVE_TANGENTS[3], None),  # positive all the way: goes down, however slowly
        (ROUND, None, None),
        ([100.0, 10.0, *[20.0] * 30], POSITIVE_TANGENTS[0], None),  # far away residuals may rise
        # but not several times, which leaves an unstable equilibrium
        ([100.0, 10.0, *(11.0 * 1.1**k for k in range(30))], POSITIVE_TANGENTS[3], 1 + 10),
        ([100.0, *(0.5 * 0.99**k for k in range(30))], POSITIVE_TANGENTS[0], None),
    ],
)
def test_what_goes_about_in_circles_gives_up(
    norms: list[float], how: TangentModification | None, at: int | None
) -> None:
    assert stalls_after(norms, how) == at
