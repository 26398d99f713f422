"""When an attempt with positive moduli gives up."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from fracsim.solvers.line_search import POSITIVE_TANGENTS, ModifiedNewton, TangentModification
from fracsim.solvers.policy import DEFAULT_POLICY
from support.scenes import Walk
from support.solver_policy import set_policy
from test_cycle import bar


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


LETTERS = {"exact tangents": "e", "positive tangents": "d"}  # of strategies; other positive tangents follow these


def test_what_was_misled_twice_goes_downhill_at_once_for_a_while(monkeypatch: pytest.MonkeyPatch) -> None:
    """A bar whose nodes are thrown about in each of three steps: to where it comes with exact tangents first."""
    set_policy(monkeypatch, max_plain_direct_dofs=0)
    found, u = [], []
    for astray in (2, 0):
        set_policy(monkeypatch, positive_tangent_solves=astray)
        scene, calls = bar(3, {"snes_type": "newtonls", "snes_rtol": 1e-8}), [""]
        walk, rng = Walk(scene), np.random.default_rng(3)
        for thrown in (0, 1, 1, 1, 0, 0):
            away = rng.uniform(-0.6, 0.6, len(walk.u)) * scene.domain.mean_edge_length * scene.balance.motion.free_dofs
            if thrown:
                walk.v = away / 5e-3
            calls.append("|")
            assert walk.advance().solve.converged
            calls.extend(LETTERS.get(name, "") for name in scene.solver.attempts)  # type: ignore[union-attr]
        found.append("".join(calls))
        u.append(walk.u)
    assert found == ["|e|ed|ed|d|d|e", "|e|ed|ed|ed|e|e"]
    np.testing.assert_allclose(*u, rtol=0, atol=1e-7 * np.abs(u[1]).max())
