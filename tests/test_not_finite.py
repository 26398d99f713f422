"""States that are not finite: no row of them is written, and no checkpoint in place of the last good one."""

from __future__ import annotations

import csv
import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from cases import BAR, STRIP, changed, study
from fracsim.deformable_run import Run, run_study
from fracsim.errors import NotConverged
from fracsim.scene import build_scene
from fracsim.study import Study, values

SCHEMES: dict[str, dict[str, Any]] = {
    "explicit": changed(STRIP, time={"scheme": "explicit", "step": 1e-3, "end": 0.05}),
    "explicit-ductile": changed(
        STRIP, time={"scheme": "explicit", "step": 1e-3, "end": 0.05}, plasticity={"yield_stress": 1e4},
        fracture={"strength": 1e9},
    ),
    "generalized-alpha": STRIP,
    "backward-euler": changed(STRIP, time={"scheme": "backward-euler"}),
    "one-solve": changed(BAR, time={"scheme": "newmark"}),
    "quasi-static": changed(STRIP, time={"scheme": "quasi-static"}),
}  # fmt: skip


def rows(folder: Path) -> list[list[float]]:
    with (folder / "history.csv").open(newline="") as file:
        return [[float(each) for each in row] for row in [*csv.reader(file)][1:]]


@pytest.mark.parametrize("wrong", [np.nan, 1e300])
@pytest.mark.parametrize("name", SCHEMES)
def test_a_step_that_ends_so_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, wrong: float) -> None:
    """One velocity is wrong, or a displacement where nothing has any, whatever the size of the step: it is halved, and
    the run ends at the step before with exit 3, without a row of it and with a checkpoint of the last good state."""
    run = Run(build_scene(MPI.COMM_SELF, study(changed(SCHEMES[name], time={"adapt": True}))), tmp_path / "out")
    stepper = run.scene.stepper
    for _ in range(2):
        run.step()
    path, good = run.checkpoint(), run.state
    book, failed = stepper._close_step, []

    def astray(end: Any, *rest: Any) -> Any:
        which = "u" if name == "quasi-static" else "v"
        values = getattr(end, which).copy()
        values[3] = wrong
        failed.append(end.t)
        return book(replace(end, **{which: values}), *rest)

    monkeypatch.setattr(stepper, "_close_step", astray)
    with pytest.raises(NotConverged) as end:
        run()
    assert len(set(failed)) > 5  # each half of the last one
    message = str(end.value)
    assert "What the step ends with is not finite" in message and f"Last good time: {good.t:g} s" in message
    assert f"Checkpoint: {path}; go on with --restart" in message
    assert np.isfinite(rows(run.folder)).all() and len(rows(run.folder)) == 2
    again = Run(build_scene(MPI.COMM_SELF, study(SCHEMES[name])), run.folder, restart=True)
    for which in ("u", "v", "a"):
        np.testing.assert_array_equal(getattr(again.state, which), getattr(good, which))
    monkeypatch.undo()
    again.step()  # and it does go on
    assert np.isfinite(again.state.u).all()


@pytest.mark.parametrize("what", ["chi", "u", "plastic", "integrity", "t"])
def test_a_checkpoint_is_of_a_finite_state(tmp_path: Path, what: str) -> None:
    """Whatever is not: the last good one stays, and is what is offered."""
    data = study(changed(STRIP, plasticity={"yield_stress": 1e4}, fracture={"strength": 1e9}))
    run = Run(build_scene(MPI.COMM_SELF, data), tmp_path)
    run.step()
    path, t = run.checkpoint(), run.state.t
    before = path.read_bytes()
    run.step()
    stress = run.scene.balance.stress
    assert run.scene.fracture is not None and stress.chi is not None and stress.material.plastic is not None
    if what == "chi":
        stress.chi.x.array[2] = np.nan
    elif what == "plastic":
        stress.material.plastic.accumulated_strain[1] = np.inf
        stress.material.plastic.discard_snapshot()
    elif what == "integrity":
        run.scene.fracture.graph.integrity[1] = np.nan
    elif what == "u":
        run.state = replace(run.state, u=np.full_like(run.state.u, 1e300))
    else:
        run.state = replace(run.state, dissipated=np.nan)
    with pytest.raises(NotConverged, match=r"is not finite \((chi|u|plastic|integrity|dissipated)\): it was not"):
        run.checkpoint()
    assert path.read_bytes() == before and os.listdir(path.parent) == ["state.h5"]
    said = run._save_last_checkpoint()
    assert said.startswith("No checkpoint was written")
    assert said.endswith(f"The last good checkpoint: {path} at t = {t:g} s; go on with --restart")


def test_rigid_bodies_that_go_astray(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As they are thrown, and later: exit 3 without a row, and the last good checkpoint stays and is named."""
    pytest.importorskip("mujoco", reason="an environment made without a network")
    from fracsim.rigid import engine

    def thrown(speed: float) -> Study:
        return Study.model_validate({
            "title": "thrown", "mesh": {"builder": "box", "size": [0.6, 0.2, 0.2], "h": 0.1},
            "material": {"energy": "linear", "young": 1e10, "poisson": 0.2, "density": 2000.0},
            "body": [{"position": [0.0, 0.0, 0.0], "velocity": [0.0, 0.0, speed]}],
            "time": {"scheme": "rigid", "step": 2e-3, "end": 0.02},
            "output": {"every": 10, "picture": False, "checkpoint": 1e-9},
        })  # fmt: skip

    monkeypatch.setattr(values, "MAX_MAGNITUDE", 1e300)  # of what a study may give
    with pytest.raises(NotConverged, match=r"not finite at t = 0 s; look at velocities.*No checkpoint was written"):
        run_study(MPI.COMM_SELF, thrown(1e200), tmp_path / "fast")
    assert rows(tmp_path / "fast") == []
    advance = engine.Engine.advance
    count = iter(range(100))

    def astray(self: Any, *rest: Any) -> Any:
        moved, touches = advance(self, *rest)
        if next(count) == 3:
            moved.position[0, 0] = np.nan
        return moved, touches

    monkeypatch.setattr(engine.Engine, "advance", astray)
    path = tmp_path / "later" / "checkpoint" / "state.h5"
    said = rf"No checkpoint was written: .*\. The last good checkpoint: {re.escape(str(path))} at t = 0\.006 s; go on"
    with pytest.raises(NotConverged, match=said):
        run_study(MPI.COMM_SELF, thrown(1.0), tmp_path / "later")
    assert len(rows(tmp_path / "later")) == 3 and np.isfinite(rows(tmp_path / "later")).all()
    monkeypatch.undo()
    assert run_study(MPI.COMM_SELF, thrown(1.0), tmp_path / "later", restart=True)["steps"] == 10


@pytest.mark.parametrize("scheme", ["explicit", "newmark", "quasi-static"])
def test_a_study_that_overflows_ends_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, scheme: str) -> None:
    """A body that is thrown at, or drawn by, 1e200 m: finite numbers whose energies are none. Studies refuse so much;
    what a run meets on its way may still be as large."""
    monkeypatch.setattr(values, "MAX_MAGNITUDE", 1e300)
    data = study(changed(
        BAR, time={"scheme": scheme, "adapt": False},
        boundary=[{"on": "left", "fix": "xyz"}, {"on": "right", "velocity": [1e200, 0.0, 0.0]}],
    ))  # fmt: skip
    with np.errstate(all="ignore"), pytest.raises(NotConverged):
        run_study(MPI.COMM_SELF, data, tmp_path)
    assert np.isfinite(rows(tmp_path)).all()
