"""Energy from nowhere is told, and only that."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from fracsim.output.energy_gain import Gained


def watched(rows: list[tuple[float, float, float, float]], *, at_rest: bool = True) -> Gained:
    """A watch that has seen rows of (kinetic, elastic, dissipated, work), J."""
    watch = Gained(at_rest=at_rest)
    for kinetic, elastic, dissipated, work in rows:
        report: Any = SimpleNamespace(kinetic=kinetic, elastic=elastic)
        state: Any = SimpleNamespace(dissipated=dissipated, work=work)
        watch.look(report, state)
    return watch


def test_losses_and_balance_are_not_told() -> None:
    assert watched([(1.0, 1.0, 0.0, 2.0), (0.5, 1.0, 0.3, 2.0), (0.2, 0.2, 0.3, 2.0)]).note() == ""
    assert watched([(3.0, 0.0, 0.0, 0.0), (2.9, 0.0, 0.1, 0.0)], at_rest=False).note() == ""


def test_a_gain_is_told_with_its_share() -> None:
    """2 J of work, then 3 J held: 1 J from nowhere, a third of what is at play; even after a loss of 1 J before."""
    watch = watched([(1.0, 1.0, 0.0, 2.0), (1.0, 2.0, 0.0, 2.0)])
    assert watch.note().startswith("the body gained 1 J of energy from nowhere, 33% of all")
    assert watched([(1.0, 0.0, 0.0, 2.0), (2.0, 0.0, 0.0, 2.0)]).rise == pytest.approx(1.0)
