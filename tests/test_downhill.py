"""When an attempt with positive moduli gives up."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from fracsim.stepping.downhill import EXACT, PATIENCE, POSITIVE, Downhill, Way


def stalls_after(norms: list[float], how: Way | None) -> int | None:
    """The iteration at which an attempt with such residuals stops, if it does."""
    now: list[float] = []
    vector = SimpleNamespace(duplicate=lambda: None)
    snes: Any = SimpleNamespace(
        setObjective=lambda _: None, setFunction=lambda *_: None, getFunctionNorm=lambda: now[-1]
    )
    balance: Any = SimpleNamespace(vector=vector)
    down = Downhill(balance, snes)
    down.made_positive(how)
    for its, norm in enumerate(norms):
        now.append(norm)
        if down.stalls(norm, its):
            return its
    return None


ROUND = [100.0, 10.0, 0.1, *[0.11] * 30]  # exact below a hundredth: from the third on


@pytest.mark.parametrize(
    ("norms", "how", "at"),
    [
        (ROUND, POSITIVE[0], 2 + PATIENCE),
        (ROUND, POSITIVE[2], None),  # positive all the way: goes down, however slowly
        (ROUND, None, None),
        ([1.0] * 30, EXACT, PATIENCE),
        ([100.0, 10.0, *[20.0] * 30], POSITIVE[0], None),  # far away residuals may rise
        ([100.0, *(0.5 * 0.99**k for k in range(30))], POSITIVE[0], None),
    ],
)
def test_what_goes_about_in_circles_gives_up(norms: list[float], how: Way | None, at: int | None) -> None:
    assert stalls_after(norms, how) == at
