"""How exactly Newton's linear systems are solved while contact acts, and when the body's tangent is kept."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import fracsim.mechanics.balance as balance_module
from fracsim.stepping.forcing import LOOSE, Forcing
from support.scenes import make_scene, march, positions
from test_itself import SOFT, two_blocks

RTOL = 1e-5


def test_digits_are_asked_for_as_the_residual_falls() -> None:
    """0.9 (|r_k| / |r_k-1|)^2 between rtol and LOOSE; no more of them than the solution needs."""
    forcing = Forcing(RTOL)
    assert forcing.rough(10.0, 0.0) == LOOSE  # nothing is known of the first
    assert forcing.rough(5.0, 0.0) == LOOSE
    assert forcing.rough(0.1, 0.0) == pytest.approx(0.9 * 0.02**2)
    assert forcing.rough(1e-6, 0.0) == RTOL
    assert forcing.rough(1e-8, 1e-10) == pytest.approx(1e-3)
    forcing.begin()
    assert forcing.rough(1e-6, 0.0) == LOOSE and forcing.exact() == RTOL


def test_iterations_are_those_of_an_exact_solve() -> None:
    """A residual that falls to a tenth an iteration takes 2 to 1e-2 and 5 to 1e-5."""
    forcing = Forcing(RTOL)
    assert forcing.iterations(5) == 5
    forcing.rough(1.0, 0.0)
    assert forcing.iterations(2) == 5


def test_a_collision_ends_as_with_exact_solves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two blocks thrown at each other: the same motion by rough solves and kept tangents, which are fewer."""
    file = two_blocks(tmp_path, 2, 0.05)
    made: list[int] = []
    assemble = balance_module.Balance._assemble_body
    monkeypatch.setattr(
        balance_module.Balance, "_assemble_body", lambda self, *given: made.append(1) or assemble(self, *given)
    )

    def thrown(**solver: float) -> tuple[np.ndarray, int, int]:
        made.clear()
        scene, state = make_scene(
            mesh={"file": file}, material=SOFT, contact={}, solver={"snes_rtol": 1e-10} | solver,
            time={"scheme": "backward-euler", "step": 0.01, "end": 0.15},
        )  # fmt: skip
        v = np.zeros_like(positions(scene))
        v[positions(scene)[:, 0] < 1.01, 0] = 1.0
        state.v = v.reshape(-1)
        state.settle()
        its = sum(report.solve.newton for report in march(scene, state))
        return state.u.copy(), its, len(made)

    u, its, tangents = thrown()
    assert tangents < 0.8 * its
    monkeypatch.setattr(balance_module, "STILL", -1.0)
    exact, exact_its, exact_tangents = thrown(ksp_rtol=1e-10)
    assert exact_tangents == exact_its
    np.testing.assert_allclose(u, exact, atol=1e-7 * np.abs(exact).max())
