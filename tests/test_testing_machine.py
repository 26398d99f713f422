"""Loading like a testing machine's: forces in newtons, a thickness, steps that shorten, an end that the load sets."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from mpi4py import MPI

from cases import BAR, STRIP, changed, study
from fracsim.deformable_run import Run
from fracsim.errors import InputError
from fracsim.scene import build_scene
from fracsim.study.check import check_study
from fracsim.study.reader import validate

Data = dict[str, Any]
Values = npt.NDArray[np.float64]
YOUNG, LENGTH, HEIGHT, STRENGTH = 1e6, 1.0, 0.25, 2e4
# a bar in plane stress without lateral contraction: sigma = E u / L everywhere until it breaks
SMOOTH: Data = changed(
    STRIP,
    mesh={"h": 0.125},
    material={"energy": "linear", "poisson": 0.0, "plane": "stress"},
    fracture={"strength": STRENGTH},
    boundary=[
        {"on": "left", "fix": "xy"},
        {"on": "right", "displacement": {"time": [0, 1], "value": [[0, 0], [0.06, 0]]}},
    ],
    time={"scheme": "quasi-static", "step": 0.1, "end": 1.0},
)  # fmt: skip


def history(folder: Path) -> dict[str, Values]:
    with (folder / "history.csv").open(newline="") as file:
        rows = list(csv.reader(file))
    return dict(zip(rows[0], np.array(rows[1:], float).T, strict=True))


def run(data: Data, folder: Path, **tables: Any) -> dict[str, Values]:
    Run(build_scene(MPI.COMM_SELF, study(data, **tables)), folder)()
    return history(folder)


# --- force and thickness --------------------------------------------------------------------------------------------


def test_a_force_is_the_load_whatever_its_area_and_thickness(tmp_path: Path) -> None:
    """u = F L / (E A) of a bar of nu = 0 under F = 30 N: A = 0.25 m x 0.02 m; 3D: A = (0.25 m)^2."""
    force = [{"on": "left", "fix": "xy"}, {"on": "right", "force": [30.0, 0.0]}]
    tip = [{"name": "tip", "point": [1.0, 0.25]}, {"name": "grip", "on": "left"}]
    flat = run(SMOOTH, tmp_path / "flat", fracture=None, boundary=force, probe=tip,
               material={"thickness": 0.02}, time={"end": 0.1}, output={"fields": ["stress"]})  # fmt: skip
    assert flat["probe_tip_x"][-1] == pytest.approx(30.0 * LENGTH / (YOUNG * HEIGHT * 0.02), rel=1e-6)
    assert flat["reaction_grip_x"][-1] == pytest.approx(-30.0, rel=1e-6)
    solid = run(BAR, tmp_path / "solid", material={"poisson": 0.0}, time={"scheme": "quasi-static", "end": 0.01},
                boundary=[{"on": "left", "fix": "xyz"}, {"on": "right", "force": [30.0, 0.0, 0.0]}],
                probe=[{"name": "tip", "point": [1.0, 0.25, 0.25]}])  # fmt: skip
    assert solid["probe_tip_x"][-1] == pytest.approx(30.0 * LENGTH / (YOUNG * HEIGHT**2), rel=1e-6)


def test_a_thickness_multiplies_forces_and_energies_and_nothing_else(tmp_path: Path) -> None:
    """A 2D body is linear in its thickness: also where it breaks, and under a weight of so many kg."""
    weight = {"name": "weight", "shape": "box", "size": [0.1, 0.1], "at": [0.5, 0.35], "velocity": [0, -1.0]}
    thin = run(STRIP, tmp_path / "thin", material={"thickness": 0.02}, obstacle=[weight | {"mass": 0.1}])
    whole = run(STRIP, tmp_path / "whole", obstacle=[weight | {"mass": 5.0}])
    assert whole["broken_edges"][-1] > 0 and np.abs(whole["contact_weight_y"]).max() > 0
    scaled = [name for name in whole if name.startswith(("kinetic", "elastic", "dissipated", "external_work"))]
    scaled += [name for name in whole if name.startswith(("reaction", "contact", "work"))]
    for name in sorted(set(whole) - {"wall_step"}):
        factor = 0.02 if name in scaled else 1.0
        atol = 1e-9 * np.abs(whole[name]).max()
        np.testing.assert_allclose(thin[name], factor * whole[name], rtol=1e-9, atol=atol, err_msg=name)
    summaries = [json.loads((tmp_path / name / "summary.json").read_text()) for name in ("thin", "whole")]
    for key in ("external_work", "dissipated"):
        assert summaries[0][key] == pytest.approx(0.02 * summaries[1][key], rel=1e-9)
    masses = [
        np.genfromtxt(tmp_path / name / "pieces.csv", delimiter=",", names=True)["mass"] for name in ("thin", "whole")
    ]
    np.testing.assert_allclose(masses[0], 0.02 * masses[1], rtol=1e-9)


def test_driven_groups_and_obstacles_say_how_far_they_have_moved(tmp_path: Path) -> None:
    way = {"time": [0, 0.05], "value": [[0, 0], [0, -0.01]]}
    pushed = {"name": "weight", "shape": "sphere", "radius": 0.05, "at": [0.5, 0.31], "displacement": way}
    rows = run(STRIP, tmp_path / "out", obstacle=[pushed])
    np.testing.assert_allclose(rows["motion_grip_x"], rows["time"], rtol=1e-9)  # driven at 1 m/s
    np.testing.assert_allclose(rows["motion_weight_y"], -0.2 * rows["time"], rtol=1e-9)


# --- steps that shorten, and the end of a run -----------------------------------------------------------------------


def test_the_peak_is_met_to_the_length_of_breaking_steps(tmp_path: Path) -> None:
    """The bar breaks at u = L f_t / E = 20 mm, at 1/3 s of 60 mm a second; steps of 0.1 s see 18 mm, and halved ones
    (0.1 / 32 = 3.1 ms) the last 3.1 ms before it. The load is f_t A there."""
    coarse = run(SMOOTH, tmp_path / "coarse", time={"breaking_step": 0.1 / 32, "until": {"drop": 0.8}})
    peak, share = np.abs(coarse["reaction_grip_x"]).max(), 0.1 / 32 / (1 / 3)
    assert (1 - share) * STRENGTH * HEIGHT <= peak <= STRENGTH * HEIGHT * (1 + 1e-6)
    broke = np.flatnonzero(np.diff(coarse["broken_edges"], prepend=0) > 0)
    assert (
        len(broke) and (coarse["dt"][broke] <= 0.1 / 32 * (1 + 1e-9)).all() and coarse["dt"].max() == pytest.approx(0.1)
    )
    summary = json.loads((tmp_path / "coarse" / "summary.json").read_text())
    assert summary["steps_retaken"] >= 5 and summary["load"]["of"] == "grip"
    assert summary["load"]["peak"] == pytest.approx(np.abs(coarse["onset_grip_x"]).max())
    assert peak <= summary["load"]["peak"] <= (1 + share) * STRENGTH * HEIGHT and summary["load"]["ended_the_run"]
    # it ended with the load, in the step in which that fell
    assert coarse["time"][-1] < 0.9 and abs(coarse["reaction_grip_x"][-1]) <= 0.2 * peak
    assert (
        np.abs(coarse["reaction_grip_x"][:-1]) > 0.2 * np.maximum.accumulate(np.abs(coarse["reaction_grip_x"]))[:-1]
    ).all()


def test_the_load_falls_from_that_at_which_edges_break(tmp_path: Path) -> None:
    """In steps of 12 mm edges break at 24 mm, beyond f_t L / E = 20 mm. The peak is that of peak_reactions.

    The load of the step before, 0.6 f_t A, is no peak above f_t A.
    """
    run(SMOOTH, tmp_path / "out", time={"step": 0.2, "until": {"drop": 0.8, "above": STRENGTH * HEIGHT}})
    load = (summary := json.loads((tmp_path / "out" / "summary.json").read_text()))["load"]
    assert load["peak"] == pytest.approx(1.2 * STRENGTH * HEIGHT, rel=1e-3)
    assert load["peak"] == pytest.approx(summary["peak_reactions"]["reaction_grip_x"], rel=1e-3)
    assert load["ended_the_run"] and load["peak_time"] == pytest.approx(0.4)


def test_a_step_taken_again_leaves_nothing_behind(tmp_path: Path) -> None:
    """The same as with the short steps from the start."""
    retaken = run(SMOOTH, tmp_path / "retaken", time={"step": 0.32, "breaking_step": 0.02, "end": 0.4})
    short = run(SMOOTH, tmp_path / "short", time={"step": 0.02, "end": 0.4})
    end = np.flatnonzero(np.isclose(short["time"], retaken["time"][-1]))[-1]
    for name in ("broken_edges", "pieces", "reaction_grip_x", "elastic", "dissipated"):
        assert retaken[name][-1] == pytest.approx(short[name][end], rel=1e-5, abs=1e-6 * np.abs(short[name]).max()), (
            name
        )


def test_a_restart_knows_the_peak(tmp_path: Path) -> None:
    """Stopped at the peak of the load: what goes on ends with its fall, and with the same rows."""
    tables: dict[str, Any] = {
        "time": {"step": 0.02, "breaking_step": 0.01, "until": {"drop": 0.8}},
        "fracture": {"energy": 1e-3}, "output": {"surface": False},
    }  # fmt: skip
    whole = run(SMOOTH, tmp_path / "whole", **tables)
    peak = int(np.abs(whole["reaction_grip_x"]).argmax())
    part = Run(build_scene(MPI.COMM_SELF, study(SMOOTH, **tables)), tmp_path / "part")
    for _ in range(peak + 1):
        part.step()
    part.checkpoint()
    part.history.close()
    Run(build_scene(MPI.COMM_SELF, study(SMOOTH, **tables)), tmp_path / "part", restart=True)()
    again = history(tmp_path / "part")
    # where a bar of uniform stress breaks first is a matter of round-off, what it carries once it is torn one of how
    # exactly Newton's method solves (4e-8 of the peak)
    for name in ("time", "dt", "reaction_grip_x"):
        most = np.nanmax(np.abs(whole[name]))
        np.testing.assert_allclose(again[name], whole[name], rtol=1e-6, atol=1e-6 * most, err_msg=name)
    summaries = [json.loads((tmp_path / name / "summary.json").read_text()) for name in ("whole", "part")]
    assert summaries[0]["load"]["ended_the_run"] and summaries[1]["load"] == pytest.approx(summaries[0]["load"])


# --- how long a crack is --------------------------------------------------------------------------------------------


def test_the_length_and_the_tip_of_a_crack_are_in_the_history(tmp_path: Path) -> None:
    """A segment of 0.4 m in a panel of 1 m: as long as asked for, and its tip at its end."""
    h = 1 / 24
    panel = changed(
        SMOOTH, mesh={"size": [1.0, 1.0], "h": h}, fracture={"strength": 1e9, "energy": 1.0}, time={"end": 0.1},
        crack=[{"segment": [[0.0, 0.49], [0.4, 0.49]]}],
        boundary=[{"on": "left", "fix": "x"}, {"on": "bottom", "fix": "y"}],
    )  # fmt: skip
    rows = run(panel, tmp_path / "out", probe=[])
    assert rows["crack_length"][-1] == pytest.approx(0.4, abs=0.05 * h)
    assert (rows["tip_x"][-1], rows["tip_y"][-1]) == (0.4, 0.49)


def test_a_crack_in_space_has_an_area(tmp_path: Path) -> None:
    """All of the section with a plane aslant: 0.25 m x 0.25 m / cos."""
    tilted = {"plane": {"point": [0.5, 0.13, 0.13], "normal": [1.0, 0.2, 0.0]}}
    rows = run(BAR, tmp_path / "out", fracture={"strength": 1e9}, crack=[tilted], time={"end": 0.01}, probe=[])
    assert rows["crack_area"][-1] == pytest.approx(0.25**2 * np.hypot(1, 0.2), rel=1e-9)


def test_a_body_in_space_without_a_crack_has_none_in_its_history(tmp_path: Path) -> None:
    """With a fracture energy, and nothing broken yet."""
    rows = run(BAR, tmp_path / "out", fracture={"strength": 1e9, "energy": 1e9}, time={"end": 0.01}, probe=[])
    assert rows["crack_area"][-1] == 0.0


# --- check tells, and refuses ---------------------------------------------------------------------------------------


def test_a_cohesive_crack_ends_the_run_at_the_given_drop(tmp_path: Path) -> None:
    """Its edges break at a hundredth of the load at most, long after the drop by half."""
    cohesive = {"strength": STRENGTH, "energy": 6000.0, "law": "cohesive"}
    found = run(
        SMOOTH, tmp_path / "out", fracture=cohesive, time={"step": 0.02, "end": 10.0, "until": {"drop": 0.5}},
        boundary=[
            {"on": "left", "fix": "xy"},
            {"on": "right", "displacement": {"time": [0, 10], "value": [[0, 0], [0.6, 0]]}},
        ],
    )  # fmt: skip
    load = found["reaction_grip_x"]
    assert load[-1] <= load.max() / 2 < load[-2] and found["broken_edges"][-1] == 0


def test_check_tells_area_and_resultant_of_each_load() -> None:
    """Right end of 0.25 m x 0.25 m; 0.0625 m^3 of 1000 kg/m^3; the largest of a table."""
    loads = [
        {"on": "left", "fix": "xyz"},
        {"on": "right", "pressure": {"time": [0, 1, 2], "value": [0.0, 80.0, 10.0]}},
        {"on": {"point": [0, 0.25, 0], "normal": [0, 1, 0]}, "traction": [0.0, 0.0, 4.0]},
        {"on": "right", "force": [0.0, 7.0, 0.0]},
    ]
    lines = check_study(study(BAR, boundary=loads, load={"gravity": [0, 0, -10.0]}))
    found = "\n".join(lines)
    assert 'boundary.1.pressure on group "right": 0.0625 m^2, (-5, 0, 0) N at t = 1 s' in found
    assert "boundary.2.traction on plane through [0.0, 0.25, 0.0]" in found and ": 0.25 m^2, (0, 0, 1) N" in found
    assert 'boundary.3.force on group "right": 0.0625 m^2, (0, 7, 0) N' in found
    assert "load.gravity: (0, 0, -625) N" in found


def refused(**tables: Any) -> str:
    with pytest.raises(InputError) as refusal:
        check_study(validate(changed(STRIP, **tables), "test.toml"))
    return str(refusal.value)


def test_what_contradicts_itself_is_refused() -> None:
    held = {"on": "left", "fix": "xy"}
    assert "boundary.0 and boundary.1 both prescribe y of group \"left\": remove one of them" in refused(
        boundary=[held, {"on": "left", "displacement": ["free", 0.1]}]
    )  # fmt: skip
    assert "boundary.1.force acts along x on group \"left\", where boundary.0 prescribes x: it would do" in refused(
        boundary=[held, {"on": "left", "force": [1.0, 0.0]}]
    )  # fmt: skip
    assert "boundary.0.traction acts along y" in refused(boundary=[{"on": "left", "traction": [0.0, 1.0]}, held])
    # held twice, and a load along what is free, agree
    sliding = {"on": "left", "fix": "x"}
    check_study(
        study(STRIP, boundary=[held, sliding, {"on": "right", "fix": "x"}, {"on": "right", "force": [0.0, 1.0]}])
    )


def test_motions_that_contradict_each_other_at_some_nodes_are_noted() -> None:
    """A motion that another one replaces at all its nodes is refused, whatever the names of the places."""
    held, side = {"on": "left", "fix": "xy"}, {"box": [[1.0, 0.0], [1.0, 0.25]]}
    pulled = {"on": "right", "displacement": {"time": [0, 1], "value": [[0, 0], [0.1, 0]]}}
    lifted = {"time": [0, 1], "value": [["free", 0], ["free", 0.1]]}

    def notes(*boundary: dict[str, Any]) -> list[str]:
        scene = build_scene(MPI.COMM_SELF, study(STRIP, boundary=[held, *boundary], probe=[]))
        found = [*scene.balance.motion.notes]
        scene.destroy()
        return found

    with pytest.raises(InputError, match="prescribe different displacements along x at all nodes"):
        notes(pulled, {"on": side, "displacement": [0.05, "free"]})
    assert notes(pulled, {"on": side, "displacement": pulled["displacement"]}) == []
    assert notes(pulled, {"on": "top", "displacement": lifted}) == [
        "boundary.0 and boundary.2 prescribe different displacements along y at 1 node, where boundary.2 holds",
        "boundary.1 and boundary.2 prescribe different displacements along y at 1 node, where boundary.2 holds",
    ]


@pytest.mark.parametrize("load", [{"traction": [10.0, 0.0]}, {"force": [0.0, 1.0]}, {"pressure": 5.0}])
def test_a_load_on_nodes_that_another_entry_holds_is_refused(load: dict[str, Any]) -> None:
    """The place has another name there; on a part of the held nodes, or along a free component, a load acts."""
    held = {"on": {"point": [1.0, 0.0], "normal": [1.0, 0.0]}, "fix": "xy"}
    with pytest.raises(InputError, match=r'boundary\.0\.\w+ acts on group "right", where other entries prescribe '):
        build_scene(MPI.COMM_SELF, study(STRIP, boundary=[{"on": "right", **load}, held], probe=[]))
    build_scene(MPI.COMM_SELF, study(STRIP, boundary=[{"on": "top", **load}, held], probe=[])).destroy()


def test_ends_and_steps_that_cannot_be_are_refused() -> None:
    assert "there are: grip" in refused(time={"until": {"drop": 0.5, "of": "nobody"}})
    ball = {"name": "ball", "shape": "sphere", "radius": 0.1, "at": [0.5, 0.5]}
    assert "say which, of = NAME; there are: grip, ball" in refused(obstacle=[ball], time={"until": {"drop": 0.5}})
    assert "none: add a [[probe]]" in refused(probe=[], time={"until": {"drop": 0.5}})
    assert "time.until.drop = 1.0" in refused(time={"until": {"drop": 1.0}})
    assert "breaking_step = 0.1 s must lie between" in refused(time={"breaking_step": 0.1})
    assert "not scheme = \"explicit\"" in refused(time={"scheme": "explicit", "breaking_step": 1e-3})  # fmt: skip
    assert "material.thickness is that of 2D meshes" in refused(
        mesh={"size": [1.0, 0.25, 0.25]}, material={"thickness": 0.1}, boundary=[], probe=[]
    )


# --- passes beside what touches -------------------------------------------------------------------------------------


@pytest.mark.parametrize("itself", [False, "pieces"])
def test_a_step_is_solved_again_with_new_walls_beside_an_obstacle(itself: bool | str) -> None:
    """Walls that came to light in one pass of a step are there in the next: what was before knows nothing of them."""
    ball = {"name": "ball", "shape": "sphere", "radius": 0.1, "at": [0.5, 0.36], "velocity": [0.0, -1.0]}
    time = {"scheme": "backward-euler", "step": 5e-3, "end": 0.02}
    breaks = {"passes": 4, "strength": 3e4}
    struck = study(STRIP, mesh={"h": 0.0625}, fracture=breaks, obstacle=[ball], contact={"itself": itself}, time=time)
    scene = build_scene(MPI.COMM_SELF, struck)
    state, broken, solves = scene.start(), [], []
    while not scene.ended(state):
        state, report = scene.stepper.advance(state)
        broken.append(report.broken)
        solves.append(report.solve.newton_iterations)
    assert sum(broken) > 0 and np.isfinite(state.u).all()
    assert scene.fracture is not None and scene.fracture.graph.broken_count == sum(broken)
