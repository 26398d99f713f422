"""How exactly Newton's linear systems are solved, with contact and without, and when the tangent is kept."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import fracsim.mechanics.tangent as tangent_module
from fracsim.solvers.forcing_terms import ContractionForcing
from fracsim.solvers.policy import DEFAULT_POLICY
from support.scenes import make_scene, march, positions
from support.solver_policy import set_policy
from test_self_contact import SOFT, two_blocks

RTOL = 1e-5


def nothing() -> float:
    """|r| that CG has left."""
    return 0.0


def test_without_contact_a_solve_leaves_a_share_of_what_the_tangent_leaves() -> None:
    """q^2 where it is new and exact, else 2 q, and a share of little at least; the first q is that of the last
    attempt."""
    sparing = ContractionForcing(RTOL)
    assert not sparing.record_iterate(1.0, 1e-5, nothing)
    assert sparing.tolerance_for(1e-5, exact=True) == RTOL  # nothing is known of the first
    assert not sparing.record_iterate(0.05, 1e-5, nothing)
    assert sparing.tolerance_for(1e-5, exact=True) == pytest.approx(DEFAULT_POLICY.cg_share * 0.05**2)
    assert sparing.record_iterate(1e-4, 1e-5, nothing)  # which leaves 4e-7 of r, less than LEFT of little
    assert sparing.tolerance_for(1e-5, exact=False) == pytest.approx(DEFAULT_POLICY.cg_share_of_solution * 1e-5 / 1e-4)
    sparing.begin_attempt()
    sparing.record_iterate(1.0, 1e-5, nothing)
    assert sparing.tolerance_for(1e-5, exact=True) == pytest.approx(DEFAULT_POLICY.cg_share * 0.05)


def test_what_cg_leaves_is_not_taken_for_what_the_tangent_leaves() -> None:
    """Where CG leaves more of r than of its own norm the first solve of the next attempt leaves less of that, so that
    at most DEFAULT_POLICY.cg_share_of_residual of q are CG's."""
    sparing = ContractionForcing(RTOL)
    sparing.record_iterate(10.0, 1e-5, nothing)
    assert sparing.tolerance_for(1e-5, exact=True) == RTOL
    sparing.record_iterate(0.5, 1e-5, lambda: 1e-3)  # ten times RTOL of r
    sparing.begin_attempt()
    sparing.record_iterate(10.0, 1e-5, nothing)
    assert sparing.tolerance_for(1e-5, exact=True) == pytest.approx(DEFAULT_POLICY.cg_share_of_residual * 0.05 / 10)


def test_no_correction_is_rougher_than_may_be() -> None:
    sparing = ContractionForcing(RTOL)
    sparing.record_iterate(1.0, 1e-6, nothing)
    assert not sparing.record_iterate(0.9, 1e-6, nothing)  # a tangent that leaves nearly all of r
    assert sparing.tolerance_for(1e-6, exact=True) == DEFAULT_POLICY.max_correction_rtol
    sparing.record_iterate(1e-9, 1e-6, nothing)
    # far below the residual of a solution
    assert sparing.tolerance_for(1e-6, exact=False) == DEFAULT_POLICY.max_last_correction_rtol
    sparing.record_iterate(0.0, 0.0, nothing)
    assert sparing.tolerance_for(0.0, exact=False) >= RTOL  # nothing divides by a residual of 0
    assert sparing.equivalent_iterations(2) == 0  # too few to tell


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """A number for each tangent that is assembled."""
    made: list[int] = []
    assemble = tangent_module.Tangent._assemble_body
    monkeypatch.setattr(
        tangent_module.Tangent,
        "_assemble_body",
        lambda self, *given: (made.append(1), assemble(self, *given))[1],
    )
    return made


def test_a_swinging_bar_moves_as_with_exact_solves(made: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    """A soft cantilever let go, far from its rest: the same motion to the tolerance of the solver, with fewer tangents
    and iterations of CG."""
    set_policy(monkeypatch, max_plain_direct_dofs=0)

    def let_go(**solver: float) -> tuple[np.ndarray, int, int]:
        made.clear()
        scene, state = make_scene(
            mesh={"builder": "box", "size": [4.0, 1.0, 1.0], "h": 0.25}, solver=solver,
            material={"energy": "neo-hookean", "young": 1e6, "poisson": 0.3, "density": 1e3},
            boundary=[{"on": "left", "fix": "xyz"}], load={"gravity": [0.0, 0.0, -100.0]},
            time={"scheme": "backward-euler", "step": 0.005, "end": 0.12},
        )  # fmt: skip
        krylov = sum(report.solve.krylov_iterations for report in march(scene, state))
        return state.u.copy(), krylov, len(made)

    u, krylov, tangents = let_go()
    exact, more_krylov, more_tangents = let_go(ksp_rtol=RTOL)
    assert np.abs(exact).max() > 0.5
    assert u == pytest.approx(exact, abs=1e-6 * np.abs(exact).max())
    assert krylov < more_krylov and tangents < 0.8 * more_tangents


def test_an_obstacle_far_away_costs_no_tangent(made: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    """A soft cantilever let go over a floor that it never reaches: as many tangents as without, and the same motion."""
    set_policy(monkeypatch, max_plain_direct_dofs=0)
    floor = {"name": "floor", "shape": "plane", "at": [0.0, 0.0, -20.0], "normal": [0.0, 0.0, 1.0]}
    counts, ends = [], []
    for obstacles in ([], [floor]):
        made.clear()
        scene, state = make_scene(
            mesh={"builder": "box", "size": [4.0, 1.0, 1.0], "h": 0.35}, obstacle=obstacles,
            material={"energy": "neo-hookean", "young": 1e6, "poisson": 0.3, "density": 1e3},
            boundary=[{"on": "left", "fix": "xyz"}], load={"gravity": [0.0, 0.0, -100.0]},
            time={"scheme": "backward-euler", "step": 0.005, "end": 0.06},
        )  # fmt: skip
        march(scene, state)
        counts.append(len(made))
        ends.append(state.u.copy())
    assert counts[1] == counts[0] > 10 and np.abs(ends[0]).max() > 0.05
    np.testing.assert_allclose(ends[1], ends[0], atol=1e-6 * np.abs(ends[0]).max())


def test_a_load_on_an_end_takes_no_more_corrections_than_with_exact_solves() -> None:
    """CG leaves fifteen times as much of r there as of the preconditioned residual by which it stops. Taken for what
    the tangent leaves, that let it stop earlier from step to step, until every step took a correction more."""

    def loaded(**solver: float) -> tuple[int, int]:
        scene, state = make_scene(
            mesh={"builder": "box", "size": [0.4, 0.1, 0.1], "h": 0.0125}, solver=solver,
            material={"energy": "neo-hookean", "young": 1e5, "poisson": 0.35, "density": 300.0},
            boundary=[{"on": "left", "fix": "xyz"},
                      {"on": "right", "traction": {"time": [0.0, 0.05], "value": [[0.0, 0.0, 0.0], [1e3, 0.0, -1e3]]}}],
            time={"scheme": "backward-euler", "step": 5e-3, "end": 0.05},
        )  # fmt: skip
        solves = [report.solve for report in march(scene, state)]
        return sum(solve.newton_iterations for solve in solves), sum(solve.krylov_iterations for solve in solves)

    (corrections, its), (exact, more_its) = loaded(), loaded(ksp_rtol=RTOL)
    assert corrections == exact and its < more_its


def test_a_collision_ends_as_with_exact_solves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, made: list[int]
) -> None:
    """Two blocks thrown at each other: the same motion by rough solves and kept tangents, which are fewer."""
    file = two_blocks(tmp_path, 2, 0.05)

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
        its = sum(report.solve.newton_iterations for report in march(scene, state))
        return state.u.copy(), its, len(made)

    u, its, tangents = thrown()
    assert tangents < its
    exact, exact_its, exact_tangents = thrown(ksp_rtol=1e-10)
    assert exact_tangents == exact_its
    np.testing.assert_allclose(u, exact, atol=1e-7 * np.abs(exact).max())
