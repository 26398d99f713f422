"""The balance is a sum of terms: a new one takes a file and a line."""

from __future__ import annotations

import gc
import resource
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

import fracsim.scene as scene_module
from fracsim.mechanics.jit import CellForm
from fracsim.scene import build_scene
from support.oscillator import exact
from support.reference import stiffness
from support.scenes import DIRECT, each_step, make_scene, make_study, march, positions
from support.spring import Spring, Tie


@pytest.fixture
def springs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(scene_module.TERMS, "spring", Spring.of)


def test_a_toy_term_moves_the_body(springs: None) -> None:
    """A rigid block of 4 x 4 nodes with 2 N/m at each: u'' + (k n / m) u = 0, and its springs' energy is in the books.

    Nothing else acts on it, and every node has the same share of mass only in the mean: the block is so stiff that it
    moves as one.
    """
    w = np.sqrt(2.0 * 16 / 1.0)
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 1.0], "h": 1 / 3},
        material={"energy": "linear", "young": 1e6, "poisson": 0.0, "density": 1.0},
        initial={"velocity": [1.0, 0.5]},
        time={"scheme": "newmark", "step": 0.02 / w, "end": 2 * np.pi / w},
    )
    start = scene.balance.energies.kinetic_energy(state.v)
    for report in each_step(scene, state):
        mean = state.u.reshape(-1, 2).mean(axis=0)
        np.testing.assert_allclose(mean, np.array([1.0, 0.5]) * exact(w, state.t, (0.0, 1.0)), atol=2e-4)
        assert report.kinetic + report.elastic == pytest.approx(start, rel=1e-6)


def test_a_toy_term_in_a_static_balance(springs: None) -> None:
    """Under g each node of the block hangs at rho g / k, in the mean: the tangent knows the springs, so that Newton's
    method needs one iteration."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 1.0], "h": 1 / 3},
        material={"energy": "linear", "young": 1e6, "poisson": 0.0, "density": 1.0},
        boundary=[{"on": {"point": [0.0, 0.0], "normal": [1.0, 0.0]}, "displacement": [0.0, "free"]}],
        load={"gravity": [0.0, -10.0]},
        time={"scheme": "backward-euler", "step": 1e3, "end": 1e3},
    )
    (report,) = march(scene, state)
    assert state.u.reshape(-1, 2)[:, 1].mean() == pytest.approx(-10.0 / (2.0 * 16), rel=1e-4)
    assert report.solve.newton_iterations == 1


@pytest.mark.parametrize("solver", (DIRECT, {"snes_rtol": 1e-11, "ksp_rtol": 1e-12}), ids=("direct", "multigrid"))
def test_a_term_couples_what_no_cell_does(monkeypatch: pytest.MonkeyPatch, solver: dict[str, Any]) -> None:
    """A spring between the far corners of a plate that is pulled at one of them: K + k b b^T in dense NumPy, found in
    steps that the term holds down to half of what Newton's method wants. The corner under load has a prescribed y."""
    made: list[Tie] = []

    def tie(parts: Any) -> list[Tie]:
        X = parts.domain.nodes[: parts.domain.node_count]
        near, far = (int(np.argmin(np.linalg.norm(X - corner, axis=1))) for corner in ([1.0, 0.0], [0.0, 1.0]))
        made.append(Tie(parts.u, parts.assembler.create_vector(), 2 * near, 2 * far + 1, 0.7))
        return [made[-1]]

    monkeypatch.setitem(scene_module.TERMS, "tie", tie)
    place = {"box": [[1 - 1e-9, -1e-9], [1 + 1e-9, 1e-9]]}
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 1.0], "h": 0.25, "pattern": "unstructured"},
        material={"energy": "linear", "young": 1.0, "poisson": 0.3, "density": 1.0},
        boundary=[
            {"on": {"box": [[-1e-9, -1e-9], [1e-9, 1e-9]]}, "fix": "xy"}, {"on": place, "fix": "y"},
            {"on": "right", "traction": [0.01, 0.0]},
        ],
        time={"scheme": "quasi-static", "step": 1.0, "end": 1.0}, solver=solver,
    )  # fmt: skip
    (report,) = march(scene, state)
    X, free = positions(scene), scene.balance.motion.free_dofs
    K = stiffness(X, scene.domain.cell_nodes, 1 / 2.6, 0.3 / (1.3 * 0.4))
    b = np.zeros(X.size)
    i, j = made[0]._ends
    b[i], b[j] = 1.0, -1.0
    K = K + 0.7 * np.outer(b, b)
    expected = np.zeros(X.size)
    expected[free] = np.linalg.solve(K[np.ix_(free, free)], scene.balance.energies.applied_forces()[free])
    np.testing.assert_allclose(state.u, expected, atol=1e-9)
    assert made[0].steps > 5 and report.solve.newton_iterations > 5
    assert state.work == pytest.approx(report.elastic, rel=1e-6)


def test_no_toy_term_without_its_line() -> None:
    """The list of terms is what a study asks for, in the order of the sum."""
    scene, _ = make_scene(load={"gravity": [0.0, -1.0]}, damping={"mass": 1.0, "stiffness": 0.1})
    assert [term.name for term in scene.balance.terms] == ["stress", "viscosity", "dead loads", "inertia", "drag"]
    scene, _ = make_scene(
        boundary=[{"on": "left", "fix": "xy"}], time={"scheme": "quasi-static", "step": 1.0, "end": 1.0}
    )
    assert [term.name for term in scene.balance.terms] == ["stress"]


def test_a_step_that_breaks_binds_its_forms_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forces are compared before and after the breaks of a step, and forms bound to the living cells once, after it."""
    bound: list[int] = []
    leave_out = CellForm.exclude_cells
    monkeypatch.setattr(CellForm, "exclude_cells", lambda form, dead: bound.append(1) or leave_out(form, dead))
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.5], "h": 0.1, "pattern": "unstructured"},
        boundary=[{"on": "left", "fix": "xy"}, {"on": "right", "velocity": [0.2, 0.0]}],
        fracture={"strength": 0.05},
        time={"scheme": "newmark", "step": 0.1, "end": 2.0},
    )
    forms, most = 4, 0  # of the stress alone, the residual, the residual at supports, the tangent
    for report in each_step(scene, state):
        assert len(bound) <= forms and (report.broken or not bound or scene.balance.stress.chi is not None)
        most = max(most, len(bound))
        bound.clear()
    assert most == forms


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_scenes_that_are_dropped_give_their_memory_back() -> None:
    """200 scenes built, stepped and destroyed in one process: a scene has 10 MB, and the second hundred adds none."""

    def once() -> None:
        tables: dict[str, Any] = {
            "mesh": {"builder": "box", "size": [1.0, 0.5, 0.5], "h": 0.05},
            "boundary": [{"on": "left", "fix": "xyz"}, {"on": "right", "velocity": [0.01, 0.0, 0.0]}],
            "fracture": {"strength": 1.0}, "solver": {}, "time": {"scheme": "newmark", "step": 0.1, "end": 1.0},
        }  # fmt: skip
        scene = build_scene(MPI.COMM_SELF, make_study(**tables))
        scene.stepper.advance(scene.start())
        scene.destroy()
        gc.collect()

    def peak() -> float:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024

    once()
    first = peak()
    for _ in range(100):
        once()
    middle = peak()
    for _ in range(100):
        once()
    assert peak() - middle < 1.0, (first, middle, peak())  # MiB


def test_any_solver_options_are_forgotten() -> None:
    """PETSc's database is as it was once a scene is destroyed."""
    from petsc4py import PETSc

    gc.collect()  # scenes of other tests take their options along
    before = dict(PETSc.Options().getAll())
    scene, state = make_scene(solver=DIRECT)
    march(scene, state, 1)
    scene.destroy()
    assert dict(PETSc.Options().getAll()) == before


@pytest.mark.fast_solver_only("the number of its calls")
def test_a_step_is_read_in_few_files() -> None:
    """One implicit step without contact crosses files fewer than 150 times (a goal of the structure)."""
    from fracsim.studies.cross_file_calls import STUDY, count_calls

    calls = count_calls(STUDY)
    assert 0 < sum(calls.values()) < 150, calls.most_common(20)
