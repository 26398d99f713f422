"""A linear study is solved as one: the tangent is kept, and a step is one solve."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fracsim.scene import Scene
from support.scenes import Walk, each_step, make_scene
from support.solver_policy import set_policy

BAR: dict[str, Any] = {
    "mesh": {"builder": "box", "size": [1.0, 0.25, 0.25], "h": 0.125},
    "material": {"energy": "linear", "young": 1e6, "poisson": 0.3, "density": 1000.0},
    "boundary": [{"on": "left", "fix": "xyz"}, {"on": "right", "velocity": [1.0, 0.0, 0.2]}],
    "load": {"gravity": [0.0, 0.0, -10.0]}, "damping": {"mass": 1.0, "stiffness": 1e-4},
    "time": {"scheme": "backward-euler", "step": 0.01, "end": 0.12},
}  # fmt: skip
TORN = {"fracture": {"strength": 5e4, "radius": 0.2}}
FINE = {"snes_rtol": 1e-9, "ksp_rtol": 1e-9}


def tangents_of(scene: Scene) -> list[int]:
    """A list that grows whenever a tangent is assembled."""
    made: list[int] = []
    assemble = scene.balance.tangent._assembler

    class Counted:
        def __call__(self, *arguments: Any) -> None:
            made.append(1)
            assemble(*arguments)

        def __getattr__(self, name: str) -> Any:
            return getattr(assemble, name)

    scene.balance.tangent._assembler = Counted()  # type: ignore[assignment]
    return made


@pytest.mark.parametrize("scheme", ("backward-euler", "generalized-alpha", "quasi-static"))
def test_one_tangent_serves_all_steps(scheme: str) -> None:
    """Each step is as balanced as was asked for, by a residual that is assembled anew."""
    time = BAR["time"] | {"scheme": scheme}
    scene, state = make_scene(**BAR | {"time": time, "damping": BAR["damping"], "solver": FINE})
    made, balance = tangents_of(scene), scene.balance
    late = balance.scheme.alpha_f
    for report in each_step(scene, state):
        assert report.solve.newton_iterations <= 2
        if not late:
            scale = np.abs(balance.reactions).max()
            rest = balance.update_forces()[balance.motion.free_dofs]
            assert np.linalg.norm(rest) < 2e-9 * max(np.linalg.norm(balance.reactions), scale)
    assert len(made) <= 2  # the last step is a little shorter by round-off


@pytest.mark.parametrize("solver", (FINE, {"ksp_type": "preonly", "pc_type": "lu", "snes_rtol": 1e-11}))
@pytest.mark.parametrize("scheme", ("newmark", "generalized-alpha"))
def test_it_breaks_as_by_newtons_method(scheme: str, solver: dict[str, Any]) -> None:
    """Edges, energies, displacement, where the tangent changes with damage alone: by CG and by factors."""

    def run(more: dict[str, Any]) -> tuple[Walk, list[list[float]], int]:
        time = BAR["time"] | {"scheme": scheme}
        scene, state = make_scene(**BAR | TORN | {"time": time, "solver": solver | more})
        made = tangents_of(scene)
        rows = [[report.broken, report.kinetic, report.elastic] for report in each_step(scene, state)]
        return state, rows, len(made)

    (one, rows, few), (other, expected, many) = run({}), run({"snes_type": "newtonls"})
    assert sum(row[0] for row in rows) > 10
    np.testing.assert_allclose(rows, expected, rtol=1e-6)
    np.testing.assert_allclose(one.u, other.u, atol=1e-7 * np.abs(other.u).max())
    assert few <= many


def test_a_whole_body_at_rest_is_solved_as_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """One solve for five steps of a load that grows in proportion, as by factors; a body that may break, pieces of
    which may hang by next to nothing, goes by Newton's method."""
    set_policy(monkeypatch, max_plain_direct_dofs=0)  # iterations of the plain solver as well
    load = {"time": [0.0, 1.0], "value": [[0.0] * 3, [0.0, 0.0, -10.0]]}
    tables = BAR | {
        "boundary": [BAR["boundary"][0], {"on": "right", "traction": load}], "load": {}, "damping": {},
        "time": {"scheme": "quasi-static", "step": 0.2, "end": 1.0},
    }  # fmt: skip
    (scene, state), (_, exact) = make_scene(**tables | {"solver": {}}), make_scene(**tables)
    solves = [report.solve for report in each_step(scene, state)]
    assert [each.newton_iterations for each in solves] == [1, 0, 0, 0, 0] and solves[0].krylov_iterations > 3
    assert len(list(each_step(exact.scene, exact))) == 5
    np.testing.assert_allclose(state.u, exact.u, atol=1e-6 * np.abs(exact.u).max())
    assert not make_scene(**tables | TORN | {"solver": {}})[0].solver.linear.steps_are_linear


@pytest.mark.parametrize(
    "tables",
    [
        {"material": BAR["material"] | {"energy": "corotated"}}, {"material": BAR["material"] | {"energy": "stvk"}},
        TORN | {"fracture": TORN["fracture"] | {"unilateral": True}},
        {"obstacle": [{"name": "floor", "shape": "plane", "at": [0.0, 0.0, -9.0], "normal": [0.0, 0.0, 1.0]}]},
    ],
)  # fmt: skip
def test_what_is_not_linear(tables: dict[str, Any]) -> None:
    assert make_scene(**BAR)[0].balance.linear
    assert not make_scene(**BAR | tables)[0].balance.linear


def test_shorter_steps_have_another_tangent() -> None:
    """After a step of half the size the residual is still as little."""
    scene, state = make_scene(**BAR | {"solver": FINE})
    made = tangents_of(scene)
    for dt in (0.01, 0.005, 0.005, 0.01):
        state.dt = dt
        state.advance()
        free = scene.balance.motion.free_dofs
        assert np.linalg.norm(scene.balance.update_forces()[free]) < 2e-9 * np.linalg.norm(scene.balance.reactions)
    assert len(made) == 3
