"""Quasi-static steps end in balance, and their books are kept on two sides that share nothing."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fracsim.mesh.selection import select_nodes
from fracsim.mesh.selectors import Group
from fracsim.scene import Scene
from fracsim.timestepping.stepper import StepReport
from support.scenes import DIRECT, Walk, each_step, make_scene, march

PLATE: dict[str, Any] = {
    "mesh": {
        "builder": "notched-plate",
        "length": 1.0,
        "height": 1.0,
        "notch_length": 0.5,
        "notch_width": 0.02,
        "h": 0.08,
    },
    "material": {"energy": "linear", "young": 1.0, "poisson": 0.3, "density": 1.0},
    "fracture": {"strength": 0.02},
    "time": {"scheme": "quasi-static", "step": 0.05, "end": 1.0},
}


def pulled_to(*held: float) -> list[dict[str, Any]]:
    """The plate's lower edge fixed and its upper one moved: up to 0.02 m in half the time, then held."""
    table = {"time": [0.0, 0.5, 1.0], "value": [[0.0, 0.0], [0.0, 0.02], [0.0, 0.02]]}
    return [{"on": "bottom", "fix": "xy"}, {"on": "top", "displacement": table}]


def torn_plate(**tables: Any) -> tuple[Scene, Walk]:
    return make_scene(**PLATE | {"boundary": pulled_to()} | tables)


def grip(scene: Scene) -> float:
    """Reaction of the upper edge along y, N."""
    top = select_nodes(scene.domain, Group("top"))
    return float(scene.balance.reactions.reshape(-1, 2)[top, 1].sum())


@pytest.mark.parametrize("energy", ("linear", "corotated", "neo-hookean"))
def test_steps_end_in_balance(energy: str) -> None:
    """With chi of the step's end the residual on free dofs is what the solver leaves: a thousandth of the forces and
    less, where passes that ended when no edge broke left a tenth of them and more."""
    scene, state = torn_plate(material=PLATE["material"] | {"energy": energy}, solver=DIRECT | {"snes_rtol": 1e-8})
    free, largest = scene.balance.motion.free_dofs, 0.0
    for report in each_step(scene, state):
        residual = np.linalg.norm(scene.balance.update_forces()[free])
        largest = max(largest, float(np.linalg.norm(scene.balance.reactions[~free])))
        assert residual <= 1e-6 * largest
        assert report.solve.converged
    assert scene.fracture.graph.broken_count > 20
    assert scene.stepper.failures.unbalanced_steps == 0


@pytest.mark.parametrize(
    ("approach", "energy", "gap"),
    (("chi", "linear", 5e-6), ("chi", "corotated", 2e-3), ("chi", "neo-hookean", 2e-2), ("edge", "linear", 5e-6)),
)
def test_work_is_energy_and_what_was_lost(approach: str, energy: str, gap: float) -> None:
    """Forces times displacements against the integral of psi, what the cells released, and what forces out of balance
    lost on the way to the next: exact for a linear body but for the 1e-8 of its stiffness that dead cells keep."""
    scene, state = torn_plate(
        material=PLATE["material"] | {"energy": energy}, fracture={"strength": 0.02, "approach": approach},
        solver=DIRECT | {"snes_rtol": 1e-10 if energy == "linear" else 1e-7},
    )  # fmt: skip
    for report in each_step(scene, state):
        assert state.work == pytest.approx(report.elastic + state.dissipated, abs=gap * max(state.work, 1e-12))
    assert state.dissipated > 0.2 * state.work


@pytest.mark.parametrize("friction", (0.0, 0.3))
def test_an_obstacle_that_breaks_a_beam_does_the_work_up_to_the_break(friction: float) -> None:
    """All of the work is dissipated once the beam is in two, which the punch no longer touches."""
    way = {"time": [0.0, 1.0], "value": [[0.0, 0.0], [0.0, -0.02]]}
    scene, state = make_scene(
        mesh={"builder": "box", "size": [0.4, 0.1], "h": 0.02, "pattern": "unstructured"},
        material={"energy": "linear", "young": 1e6, "poisson": 0.3, "density": 1e3},
        fracture={"strength": 7e3, "radius": 0.04},
        brittle={"surfaces": 1},
        boundary=[{"on": "left", "fix": "xy"}],
        obstacle=[
            {"name": "punch", "shape": "sphere", "radius": 0.03, "at": [0.38, 0.1302], "displacement": way}
            | {"friction": friction}
        ],
        time={"scheme": "quasi-static", "step": 0.25, "end": 1.0},
    )
    for report in each_step(scene, state):
        if report.broken:
            break
    assert report.broken and report.elastic < 1e-6
    assert state.work == pytest.approx(state.dissipated, rel=1e-2)
    (punch,) = scene.balance.energies.works_of_obstacles()[0]
    assert punch > 0.3  # J; by the force after the break it was 0.13


def test_one_pass_is_made_up_for_in_the_next_step() -> None:
    """passes = 1 ends steps out of balance; what the body loses on its way back is booked with the next one."""
    scene, state = torn_plate(fracture={"strength": 0.02, "passes": 1}, solver=DIRECT | {"snes_rtol": 1e-10})
    out = []
    for report in each_step(scene, state):
        assert state.work == pytest.approx(report.elastic + state.dissipated, abs=5e-6 * max(state.work, 1e-12))
        out.append(state.out_of_balance is not None)
    assert any(out) and state.dissipated > 0.2 * state.work


def test_a_constant_load_on_an_elastic_plate_dissipates_nothing() -> None:
    """Put on slowly, F u / 2 = elastic; the body is unloaded at t = 0."""
    for load in ([0.0, 0.001], {"time": [0.0, 1.0], "value": [[0.0, 0.0], [0.0, 0.001]]}):
        sides = [{"on": "bottom", "fix": "xy"}, {"on": "top", "traction": load}]
        tables = PLATE | {"boundary": sides, "fracture": {"strength": 1.0}}
        scene, state = make_scene(**tables, solver=DIRECT | {"snes_rtol": 1e-10})
        report = march(scene, state)[-1]
        assert scene.fracture.graph.broken_count == 0
        assert state.work == pytest.approx(report.elastic, rel=1e-8) and report.elastic > 0
        assert abs(state.dissipated) <= 1e-8 * state.work


@pytest.mark.parametrize("step", (0.05, 0.1))
def test_a_reaction_never_rises_where_edges_broke_under_a_held_displacement(step: float) -> None:
    """A body that lost stiffness cannot pull harder. Where a step ended out of balance it did: by a fifth and more."""
    scene, state = torn_plate(time=PLATE["time"] | {"step": step})
    before, held = 0.0, 0
    for _ in each_step(scene, state):
        if state.t > 0.5 + 1e-9:
            assert grip(scene) <= before * (1 + 1e-6)
            held += 1
        before = grip(scene)
    assert held >= 5


def test_a_break_at_a_held_displacement_lowers_the_reaction_within_its_step() -> None:
    """Edges broken by hand at a displacement that is held: the next step is in balance and pulls less, those after it
    as much as that one."""
    scene, state = torn_plate(fracture={"strength": 1e9})
    march(scene, state, 12)
    whole, graph = grip(scene), scene.fracture.graph
    ends = scene.domain.nodes[graph.edge_nodes]
    across = (ends[:, 0, 1] > 0.501) != (ends[:, 1, 1] > 0.501)
    flags = across & (ends.mean(axis=1)[:, 0] < 0.7)
    assert graph.break_edges(flags) > 0
    state.remember()
    pulls = []
    for _ in range(4):
        march(scene, state, 1)
        pulls.append(grip(scene))
    assert pulls[0] < 0.99 * whole
    np.testing.assert_allclose(pulls[1:], pulls[0], rtol=1e-5)


def test_steps_start_from_any_state() -> None:
    """A state taken up again, after the body has broken further, leads to the same next state."""
    scene, state = torn_plate(solver=DIRECT | {"snes_rtol": 1e-10})
    march(scene, state, 8)
    start = state.state
    ends: list[tuple[Any, StepReport, Any]] = []
    for _ in range(2):
        state.state = start
        reports = march(scene, state, 2)
        ends.append((state.u.copy(), reports[-1], scene.fracture.graph.broken.copy()))
        march(scene, state, 3)
    np.testing.assert_allclose(ends[1][0], ends[0][0], atol=1e-12)
    assert np.array_equal(ends[1][2], ends[0][2])
    assert ends[1][1].elastic == pytest.approx(ends[0][1].elastic, rel=1e-10)


@pytest.mark.parametrize("order", (1, 2))
def test_components_that_are_free_have_no_reaction(order: int) -> None:
    """A bar of 600 N hangs on its left face; the right face rests on a guide that is free vertically.

    A linear step is one solve, after which the residual of free components is still that of the first guess.
    """
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.2], "h": 0.05, "order": order},
        material={"energy": "linear", "young": 1e6, "poisson": 0.3, "density": 300.0},
        boundary=[{"on": "left", "fix": "xy"}, {"on": "right", "fix": "x"}],
        load={"gravity": [0.0, -10.0]},
        probe=[{"name": "wall", "on": "left"}, {"name": "guide", "on": "right"}],
        time={"scheme": "quasi-static", "step": 1.0, "end": 1.0},
        solver={},
    )
    march(scene, state)
    told = dict(zip(scene.probes.columns, scene.probes(), strict=True))
    assert told["reaction_guide_y"] == pytest.approx(0.0, abs=1e-3)
    assert told["reaction_wall_y"] == pytest.approx(600.0, rel=1e-6)
