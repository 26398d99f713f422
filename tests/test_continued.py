"""A run that was stopped and resumes is the run that was not, to the last digit on the same ranks."""

from __future__ import annotations

import gc
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from fracsim.deformable_run import Run
from fracsim.errors import StepAborted
from fracsim.output.interrupt import InterruptHandler
from fracsim.scene import build_scene
from fracsim.study import Study
from fracsim.study.reader import study_text
from support.continued import CASES, differences, other, unlike
from support.ranks import run_on_ranks
from support.scenes import make_study

# seconds each: what they show of a scheme or a feature a shorter case shows of another
SLOW = {
    "free-obstacles", "contact-of-pieces", "newmark", "branching", "grains", "ductile-implicit", "explicit-joined",
    "quadratic", "explicit-quadratic",
}  # fmt: skip


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in CASES])
def test_a_run_that_resumes_takes_the_same_steps(tmp_path: Path, name: str) -> None:
    """Any number of any later step, and the rows of history.csv: schemes, and what bodies remember beside u and v."""
    assert differences(MPI.COMM_SELF, name, tmp_path) == []


@pytest.mark.ranks
def test_on_two_ranks_as_well(tmp_path: Path) -> None:
    assert run_on_ranks("support.continued", 2, tmp_path)["differences"].tolist() == []


@pytest.mark.parametrize("name", ["contact", "backward-euler", "one-solve"])
def test_a_solver_that_is_renewed_leaves_nothing(tmp_path: Path, name: str) -> None:
    """What was there before a checkpoint is given back: each would keep matrices. It asks on whether to stop."""
    study = make_study(**{"solver": {}, "output": {"picture": False}} | CASES[name][0])
    run = Run(build_scene(MPI.COMM_SELF, study), tmp_path)
    solver, asked = run.scene.solver, iter([False, False, True])
    assert solver is not None
    run.step()
    before = [weakref.ref(each) for each in (solver._newton, solver.linear, run.scene.balance.tangent)]
    run.scene.stepper.set_stop_request(lambda: next(asked, True))
    run.checkpoint()
    with pytest.raises(StepAborted):
        while True:
            run.step()
    gc.collect()
    assert [each() for each in before] == [None] * 3


FLOOR = {"name": "floor", "shape": "plane", "at": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0], "friction": 0.5}
BALL = {"name": "ball", "shape": "sphere", "radius": 0.05, "at": [0.0, 0.0, 0.6], "velocity": [0, 0, -5.0], "mass": 2.0}
RIGID: dict[str, dict[str, Any]] = {
    "falls": {
        "mesh": {"builder": "box", "size": [0.6, 0.2, 0.2], "h": 0.1}, "obstacle": [FLOOR, BALL],
        "fracture": {"strength": 3e5, "kernel": "neighbours"}, "brittle": {"surfaces": 4},
        "body": [{"position": [0.0, 0.0, 0.05], "rotation": [0.0, -0.1, 0.0], "velocity": [0.0, 0.0, -4.0]}],
    },
    "dents": {
        "mesh": {"builder": "box", "size": [0.6, 0.1, 0.1], "h": 0.05}, "obstacle": [],
        "plasticity": {"yield_stress": 1e6, "hardening": 2e9},
        "body": [{"position": [0.0, 0.0, 0.0]},
                 {"position": [0.4, -0.25, 0.16], "rotation": [0.0, 0.0, np.pi / 2], "velocity": [0.0, 0.0, -6.0]}],
    },
}  # fmt: skip


@pytest.mark.parametrize("name", RIGID)
def test_rigid_bodies_go_on_the_same(tmp_path: Path, name: str) -> None:
    """Stopped before they break, and after: places, velocities, blows, loads and broken edges."""
    pytest.importorskip("mujoco", reason="an environment made without a network")
    from fracsim.rigid_run import RigidRun
    from fracsim.scene.rigid_scene import build_rigid_scene

    data = Study.model_validate({
        "title": "rigid", "material": {"energy": "linear", "young": 1e10, "poisson": 0.2, "density": 2000.0},
        "contact": {"friction": 0.4}, "load": {"gravity": [0.0, 0.0, -9.81]},
        "time": {"scheme": "rigid", "step": 2e-3, "end": 0.06}, "output": {"every": 10, "picture": False},
        **RIGID[name],
    })  # fmt: skip
    text = study_text(data, [f"{key}: 1" for key in ("fracsim", "dolfinx", "petsc", "python", "ranks")])

    def begun(where: str, *, restart: bool = False) -> RigidRun:
        scene, interrupt = build_rigid_scene(data), InterruptHandler(MPI.COMM_SELF, None)
        return RigidRun(scene, tmp_path / where, text, interrupt, restart=restart)

    def numbers(run: RigidRun) -> dict[str, Any]:
        kept = {
            key: np.array(values)
            for key, values in run.scene.stepper.to_checkpoint(run.state).items()
            if np.size(values)
        }
        return kept | {"work": np.array(run.state.work), "t": np.array(run.state.t)}

    going, writing, states = begun("going"), begun("writing"), {}
    for step in range(1, 23):
        going.step()
        writing.step()
        states[step] = numbers(going)
        if step in (4, 14):
            writing.checkpoint()
            (tmp_path / f"{step}" / "checkpoint").mkdir(parents=True)
            for file in ("study.toml", "history.csv", "checkpoint/state.h5"):
                (tmp_path / f"{step}" / file).write_bytes((tmp_path / "writing" / file).read_bytes())
    assert going.blows > 0
    for stop in (4, 14):
        again = begun(str(stop), restart=True)
        for step in range(stop + 1, 23):
            again.step()
            assert other(numbers(again), states[step]) == [], (stop, step)
        assert unlike(again.folder, going.folder) == ""
