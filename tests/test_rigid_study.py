"""Studies with time.scheme = "rigid": what they write, what they refuse, restarts, and any number of ranks."""

from __future__ import annotations

import csv
import json
import subprocess
import tomllib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from mpi4py import MPI

from cases import fracsim_here
from fracsim.deformable_run import run_study
from fracsim.errors import Exit, InputError, NotConverged, Stopped
from fracsim.fracture.brittle.grains import SurfaceParameters
from fracsim.mesh.input_topology import MeshTopology
from fracsim.rigid.instance_placement import InstancePlacement, InstancePoses
from fracsim.rigid.instances import Instances
from fracsim.rigid.parallel_analyses import ImpactLoads, ParallelAnalyses, analyse_impact
from fracsim.rigid.rigid_stepper import RigidReport, RigidState, RigidStepper
from fracsim.studies import folder
from fracsim.study import Study
from fracsim.study.check import check_study
from fracsim.study.reader import load_study, study_text
from support.rigid import breakable
from support.solids import copies, lattice
from support.vtu import frames

pytest.importorskip("mujoco", reason="an environment made without a network")

Values = npt.NDArray[np.float64]
FLOOR = {"name": "floor", "shape": "plane", "at": [0.0, 0.0, 0.0], "normal": [0.0, 0.0, 1.0], "friction": 0.5}


def tables(**changed: Any) -> dict[str, Any]:
    """A bar of 0.6 m that falls askew on a floor and breaks."""
    plain: dict[str, Any] = {
        "title": "dropped",
        "mesh": {"builder": "box", "size": [0.6, 0.2, 0.2], "h": 0.1},
        "material": {"energy": "linear", "young": 1e10, "poisson": 0.2, "density": 2000.0},
        "fracture": {"strength": 3e5, "kernel": "neighbours"},
        "brittle": {"surfaces": 4},
        "body": [{"position": [0.0, 0.0, 0.05], "rotation": [0.0, -0.1, 0.0], "velocity": [0.0, 0.0, -4.0]}],
        "obstacle": [FLOOR],
        "contact": {"friction": 0.4},
        "load": {"gravity": [0.0, 0.0, -9.81]},
        "time": {"scheme": "rigid", "step": 2e-3, "end": 0.06},
        "output": {"every": 10, "picture": False},
    }
    return {key: value for key, value in (plain | changed).items() if value is not None}


def study(**changed: Any) -> Study:
    """The same, as the program has it."""
    return Study.model_validate(tables(**changed))


def rows(path: Path) -> dict[str, Values]:
    """Columns of a CSV file by name, without what depends on the machine."""
    with path.open(newline="") as file:
        head, *lines = [*csv.reader(file)]
    values = np.array(lines, float).T
    return {name: column for name, column in zip(head, values, strict=True) if name != "wall_step"}


def assert_same(found: dict[str, Values], expected: dict[str, Values]) -> None:
    """The same pieces and edges, and the rest but for the tolerance of the engine, as far as bodies carry it on."""
    for key, values in expected.items():
        if key in ("piece", "pieces", "broken_edges", "step"):
            assert np.array_equal(found[key], values), key
        elif not key.endswith("_its"):
            kin = [np.abs(other).max() for name, other in expected.items() if name.split("_")[0] == key.split("_")[0]]
            assert np.allclose(found[key], values, atol=1e-5 * max([*kin, 1e-3])), key


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run."""
    folder = tmp_path_factory.mktemp("rigid") / "out"
    run_study(MPI.COMM_SELF, study(), folder)
    return folder


def test_a_run_writes_what_every_run_writes(done: Path) -> None:
    """history.csv, surface.pvd, pieces.csv and summary.json agree with one another; there is no fields.xdmf."""
    history, pieces = rows(done / "history.csv"), rows(done / "pieces.csv")
    summary = json.loads((done / "summary.json").read_text())
    assert summary["outcome"] == "done" and summary["steps"] == 30 == len(history["step"])
    assert summary["pieces"] > 1 and summary["broken_edges"] > 0 and summary["blows"] > 0
    assert history["pieces"][-1] == summary["pieces"] and history["broken_edges"][-1] == summary["broken_edges"]
    assert not (done / "fields.xdmf").exists()
    last = pieces["time"] == pieces["time"][-1]
    assert last.sum() == summary["pieces"] == frames(done)[-1].pieces
    assert pieces["mass"][last].sum() == pytest.approx(0.6 * 0.2 * 0.2 * 2000.0, rel=1e-11)
    assert np.abs([pieces[f"turn_{axis}"][last] for axis in "xyz"]).max() > 0.01
    energy = 0.5 * pieces["mass"] * sum(pieces[f"velocity_{axis}"] ** 2 for axis in "xyz")
    assert energy[0] == pytest.approx(history["kinetic"][0], rel=0.02)
    assert history["dissipated"][-1] > 0 and history["contact_floor_z"].min() < -1000


def test_drawn_pieces_are_rigid_and_stay_above_the_floor(done: Path) -> None:
    """Distances between points of the one body of the first frame are those at rest, and nothing is in the floor."""
    drawn = frames(done)
    sides = np.ptp(drawn[0].points, axis=0)
    cos, sin = np.cos(0.1), np.sin(0.1)
    assert np.allclose(sides, [0.6 * cos + 0.2 * sin, 0.2, 0.6 * sin + 0.2 * cos], atol=1e-6)
    assert min(frame.points[:, 2].min() for frame in drawn) > -1e-4
    assert np.isfinite(drawn[-1].points).all() and drawn[-1].pieces > drawn[0].pieces == 1


def test_momentum_of_a_run_is_what_acted(done: Path) -> None:
    """m v at the end = m v at the start + weight times t - what the floor was pushed by."""
    history, pieces = rows(done / "history.csv"), rows(done / "pieces.csv")
    last = pieces["time"] == pieces["time"][-1]
    mass = pieces["mass"][last].sum()
    given = -2e-3 * history["contact_floor_z"].sum()
    expected = mass * (-4.0 - 9.81 * 0.06) + given
    assert pieces["mass"][last] @ pieces["velocity_z"][last] == pytest.approx(expected, abs=1e-6 * mass)


def test_a_restart_goes_on_as_if_nothing_had_been(done: Path, tmp_path: Path) -> None:
    """Stopped at once at the wall-time limit, and resumed: the same rows and pieces."""
    with pytest.raises(Stopped, match="Checkpoint"):
        run_study(MPI.COMM_SELF, study(), tmp_path / "out", wall_limit=0.0)
    assert 0 < len(rows(tmp_path / "out" / "history.csv")["step"]) < 30
    run_study(MPI.COMM_SELF, study(), tmp_path / "out", restart=True)
    for name in ("history.csv", "pieces.csv"):
        assert_same(rows(tmp_path / "out" / name), rows(done / name))


def test_a_restart_after_the_break_has_its_pieces(done: Path, tmp_path: Path) -> None:
    """To 0.05 s, and on to 0.06 s; summary.json counts the analyses and the seconds of both parts."""
    often = {"every": 10, "picture": False, "checkpoint": 1e-9}
    short = study(time={"scheme": "rigid", "step": 2e-3, "end": 0.05}, output=often)
    first = run_study(MPI.COMM_SELF, short, tmp_path / "out")
    summary = run_study(MPI.COMM_SELF, study(), tmp_path / "out", restart=True)
    assert summary["analyses"] == json.loads((done / "summary.json").read_text())["analyses"] > 0
    assert summary["cpu"] > first["cpu"] and summary["seconds"]["motion"] > first["seconds"]["motion"]
    found, expected = (rows(folder / "history.csv") for folder in (tmp_path / "out", done))
    assert expected["pieces"][24] > 1
    assert_same(found, expected)
    drawn = [frames(folder)[-1] for folder in (tmp_path / "out", done)]
    assert np.allclose(drawn[0].points, drawn[1].points, atol=1e-6)


def test_a_blow_within_a_step_is_told(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """A hammer goes 0.1 m down and back within 2 ms, half of it before the end of a step; a restart keeps the note."""
    way = {"time": [0.0045, 0.0055, 0.0065], "value": [[0.0, 0.0, 0.0], [0.0, 0.0, -0.1], [0.0, 0.0, 0.0]]}
    hammer = {"name": "hammer", "shape": "sphere", "radius": 0.05, "at": [3.0, 0.0, 1.0], "displacement": way}
    still = {"obstacle": [hammer], "body": None, "brittle": None, "fracture": None, "load": None}
    for end, restart in ((0.008, False), (0.012, True)):
        once = study(
            time={"scheme": "rigid", "step": 2e-3, "end": end}, output={"picture": False, "checkpoint": 1e-9}, **still
        )
        run_study(MPI.COMM_SELF, once, tmp_path / "out", restart=restart)
        assert (
            "obstacle.0.displacement has a peak at t = 0.0055 s within a step of 0.002 s, and 50% of its largest"
            in capfd.readouterr().err
        )


def test_steps_without_balanced_contact_are_told_after_a_restart(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the step that was wrong before the checkpoint, too."""
    often = {"picture": False, "checkpoint": 1e-9}
    advance = RigidStepper.advance

    def inexact(self: RigidStepper, state: RigidState) -> tuple[RigidState, RigidReport]:
        state, report = advance(self, state)
        return state, replace(report, contact_error=0.25)

    monkeypatch.setattr(RigidStepper, "advance", inexact)
    run_study(
        MPI.COMM_SELF, study(time={"scheme": "rigid", "step": 2e-3, "end": 0.004}, output=often), tmp_path / "out"
    )
    monkeypatch.undo()
    capfd.readouterr()
    longer = study(time={"scheme": "rigid", "step": 2e-3, "end": 0.006}, output=often)
    run_study(MPI.COMM_SELF, longer, tmp_path / "out", restart=True)
    assert "contact of rigid bodies did not converge in " in (said := capfd.readouterr().err) and "0.25 m/s" in said


def test_a_slab_is_shot_through_and_not_carried_along(tmp_path: Path) -> None:
    """Twelve milliseconds later most of its mass is where it was, without the ball, which took a piece along.

    Round-off decides in how many pieces it is: 10 with one DOLFINx, 23 with another.
    """
    coarse = load_study(folder() / "rigid-slab.toml", ["mesh.h=0.018", "brittle.surfaces=30", "output.interval=0.012"])
    run_study(MPI.COMM_SELF, coarse, tmp_path / "out")
    pieces = rows(tmp_path / "out" / "pieces.csv")
    last = pieces["time"] == pieces["time"].max()
    mass, speed, z = (pieces[name][last] for name in ("mass", "velocity_z", "centre_z"))
    assert mass.sum() == pytest.approx(2700 * 0.4 * 0.4 * 0.02, rel=1e-9) and len(mass) > 6
    assert -(mass @ speed) < 0.3 * 60 * mass.sum(), "the ball has no end of momentum: whole it would have all of 60 m/s"
    assert mass[z > 0.1].sum() > 0.6 * mass.sum() and speed.min() < -40


def test_an_analysis_that_fails_ends_the_run_with_its_reason(tmp_path: Path) -> None:
    """CG in one iteration: what failed, what to do, and a summary that says so."""
    with pytest.raises(NotConverged, match=r"struck body .*solver\.ksp_max_it.* No checkpoint"):
        run_study(MPI.COMM_SELF, study(solver={"ksp_max_it": 1}), tmp_path / "out")
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["outcome"] == "not converged"


def test_copies_stand_on_a_grid_and_move_as_they_were_told(tmp_path: Path) -> None:
    """Twelve bodies, of which the second entry turns about its middle."""
    six = {"copies": [2, 3, 1], "spacing": [1.0, 0.5, 1.0], "velocity": [0.0, 0.0, 1.0]}
    tower = {"position": [0.0, 0.0, 2.0], "copies": [1, 1, 6], "spacing": [0.0, 0.0, 0.4], "spin": [0.0, 0.0, 3.0]}
    summary = run_study(
        MPI.COMM_SELF,
        study(body=[six, tower], obstacle=None, load=None, time={"scheme": "rigid", "step": 1e-3, "end": 5e-3}),
        tmp_path / "out",
    )
    pieces = rows(tmp_path / "out" / "pieces.csv")
    last = pieces["time"] == pieces["time"][-1]
    assert summary["pieces"] == 12 and summary["analyses"] == 0
    places = np.stack([pieces[f"centre_{axis}"][last] for axis in "xyz"], axis=1)
    assert np.allclose(places[1], [0.3, 0.6, 0.105]) and np.allclose(places[-1], [0.3, 0.1, 4.1])
    assert np.allclose(pieces["spin_z"][last], [0.0] * 6 + [3.0] * 6)
    assert np.allclose(pieces["turn_z"][last], [0.0] * 6 + [0.015] * 6)


def test_a_study_survives_being_written() -> None:
    """study.toml has all defaults, and says the same."""
    text = study_text(study())
    assert study_text(Study.model_validate(tomllib.loads(text))) == text


# --- what is refused ---

FLAT = {"mesh": {"builder": "box", "size": [0.6, 0.2], "h": 0.1}, "obstacle": None, "load": None}
SOFT = {"energy": "corotated", "young": 1.0, "poisson": 0.2, "density": 1.0}
BALL = {"name": "ball", "shape": "sphere", "radius": 2.0, "at": [0.0, 0.0, 9.0]}
HINGE = {"point": [0.0, 0.0, 12.0], "axis": [0.0, 1.0, 0.0]}
ROCK = {"name": "rock", "shape": "mesh", "file": "rock.stl", "at": [0.0, 0.0, -1.0]}
OPEN = "v 0 0 1\nv 1 0 1\nv 0 1 1\nv 0 0 2\nf 1 3 2\nf 1 2 4\nf 1 4 3\n"  # a tetrahedron without a side
HARD = {"yield_stress": 1e6, "hardening": 1e9}
SOFTENING: dict[str, Any] = {"fracture": None, "brittle": None, "plasticity": {"yield_stress": 1e6}}
ORNAMENT = {"builder": "ornament", "h": 0.02}
NEWMARK = {"scheme": "newmark", "step": 1e-3, "end": 0.1}
REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "two dimensions": (FLAT, "2 dimensions"),
    "overlap": ({"body": [{}, {"position": [0.5, 0.0, 0.0]}], "obstacle": None}, "lies in body 1 around .* by 0.1 m"),
    "in the floor": ({"body": [{"position": [0.0, 0.0, -0.05]}]}, "lies in obstacle floor at the start, by 0.05 m"),
    "contact time": ({"contact": {"contact_time": 0.0}}, "contact_time"),
    "restitution": ({"contact": {"restitution": 1.5}}, "restitution"),
    "no surfaces": ({"brittle": None}, r"needs \[brittle\]"),
    "energy": ({"material": SOFT}, 'energy = "linear"'),
    "boundary": ({"boundary": [{"on": "left", "fix": "x"}]}, "by obstacles"),
    "initial": ({"initial": {"velocity": [0.0, 0.0, 1.0]}}, r"in \[\[body\]\]"),
    "hinge": ({"obstacle": [BALL | {"mass": 1.0, "hinge": HINGE}]}, "ball has a hinge, which .* or drive it"),
    "guide": ({"obstacle": [BALL | {"mass": 1.0, "guide": "z"}]}, "ball has a guide"),
    "free in the way": ({"obstacle": [BALL | {"mass": 1.0, "at": [0.3, 0.1, 2.1]}]}, "body 0 .* in obstacle ball"),
    "file that turns": ({"obstacle": [ROCK | {"spin": [0.0, 0.0, 1.0]}]}, "rock is turned by spin"),
    "no file": ({"obstacle": [ROCK]}, r"rock\.stl.*no such file"),
    "flat obstacle": ({"obstacle": [FLOOR | {"at": [0.0, 0.0], "normal": [0.0, 1.0]}]}, "needs 3 numbers"),
    "open mesh": ({"mesh": {"surface": "OPEN", "h": 0.1}}, "is open"),
    "hollow": ({"obstacle": [BALL | {"hollow": True}]}, "hollow"),
    "soft contact": ({"contact": {"stiffness": 1e5}}, "contacts are hard"),
    "without itself": ({"contact": {"itself": False}}, "always meet"),
    "newton": ({"solver": {"snes_max_it": 5}}, "ksp_"),
    "density": ({"material": SOFT | {"energy": "linear", "density": 0.0}}, "density"),
    "flow and break": ({"plasticity": HARD}, r"do not break: .* \[brittle\]"),
    "no hardening": (SOFTENING, r"plasticity\.hardening = 0: .* greater than 0"),
    "negative hardening": (SOFTENING | {"plasticity": {"yield_stress": 1e6, "hardening": -1e9}}, "greater than 0"),
    "no yield stress": (SOFTENING | {"plasticity": {"hardening": 1e9}}, "yield_stress"),
    "flow rate": (SOFTENING | {"plasticity": HARD | {"flow_rate": 2.0}}, "flow_rate is"),
    "shell that flows": (SOFTENING | {"mesh": ORNAMENT, "plasticity": HARD}, "shells"),
    "spacing": ({"body": [{"copies": [2, 1, 1]}]}, "spacing"),
    "no spacing": ({"body": [{"copies": [1, 2, 1], "spacing": [1.0, 0.0, 1.0]}]}, "lie in one another"),
    "body elsewhere": ({"time": NEWMARK}, r"\[\[body\]\] is for"),
    "time elsewhere": ({"time": NEWMARK, "body": None, "contact": {"contact_time": 1.0}}, "contact_time is for"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_what_makes_no_sense_is_refused_in_one_sentence(name: str, tmp_path: Path) -> None:
    """By the study, by `check`, or where the bodies are placed; nothing is written."""
    changed, said = REFUSED[name]
    if changed.get("mesh", {}).get("surface") == "OPEN":
        (tmp_path / "open.obj").write_text(OPEN)
        changed = {"mesh": {"surface": str(tmp_path / "open.obj"), "h": 0.1}}
    with pytest.raises((InputError, ValueError), match=said):
        whole = study(**changed)
        check_study(whole)
        run_study(MPI.COMM_SELF, whole, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_check_refuses_a_hollow_obstacle_as_the_run_does() -> None:
    """While the study is read."""
    with pytest.raises(ValueError, match=r"obstacle ball is hollow, .* build it of boxes or planes"):
        study(obstacle=[BALL | {"hollow": True}])


def test_bad_input_ends_the_program_with_exit_code_2(tmp_path: Path) -> None:
    """One message, no traceback."""
    path = tmp_path / "lies.toml"
    path.write_text(study_text(study(body=[{"position": [0.0, 0.0, -0.05]}])))
    ended = fracsim_here("run", str(path), "-o", str(tmp_path / "out"))
    assert ended.returncode == Exit.BAD_INPUT and "obstacle floor" in ended.stderr
    assert "Traceback" not in ended.stderr and len(ended.stderr.strip().splitlines()) == 1


@pytest.mark.ranks
@pytest.mark.parametrize("ranks", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_ranks_share_analyses_and_give_the_same_run(ranks: int, tmp_path: Path) -> None:
    """Three bars that come down at once, with fewer surfaces than they would open: bodies move on the first rank, and
    are analysed on all."""
    bars = [{**tables()["body"][0], "copies": [1, 3, 1], "spacing": [1.0, 0.5, 1.0]}]
    several = study(body=bars, brittle={"surfaces": 5}, time={"scheme": "rigid", "step": 2e-3, "end": 0.03})
    expected = run_study(MPI.COMM_SELF, several, tmp_path / "alone")
    assert expected["broken_edges"] and expected["pieces"] > 4
    path = tmp_path / "study.toml"
    path.write_text(study_text(several))
    command = ["timeout", "120", "mpirun", "-n", str(ranks), "fracsim", "run", str(path), "-o"]
    ended = subprocess.run([*command, str(tmp_path / "out")], capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    for name in ("history.csv", "pieces.csv"):
        assert_same(rows(tmp_path / "out" / name), rows(tmp_path / "alone" / name))


def test_a_blow_on_a_copy_opens_what_it_opens_on_the_body_itself() -> None:
    """Turned, carried away, and struck as the body would be: the same edges and cuts, none in the other copies, whose
    analyses share its factors; what a checkpoint keeps of them is as before."""
    mesh, rules = lattice(6, 2, 2, size=0.25), SurfaceParameters(6)
    points = np.array([[0.05, 0.25, 0.05], [1.45, 0.25, 0.05], [0.75, 0.25, 0.45]])
    force = 2e4 * np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, -2.0]])
    alone = Instances.of_body(breakable(mesh, 2e4, rules))
    ParallelAnalyses(alone)([ImpactLoads(0, points, force, np.zeros(3))])
    poses = InstancePoses.from_placements(
        [InstancePlacement(np.array([k, 5.0, -k]), np.array([0.3, k, -0.7]), *np.zeros((2, 3))) for k in range(4)]
    )
    sizes = len(mesh.points), len(mesh.cells), len(MeshTopology(mesh).edges)
    several, again = (Instances(lambda *_: breakable(mesh, 2e4, rules), poses, sizes) for _ in range(2))
    turn, place = poses.rotation[2], poses.position[2]
    name = 2 * len(mesh.points)
    broken = ParallelAnalyses(several)([ImpactLoads(name, points @ turn.T + place, force @ turn.T, np.zeros(3))])
    assert broken[name] == alone.get(0).graph.broken.sum() > 0 and several.surfaces_left(name) == (
        2,
        alone.surfaces_left(0)[1],
    )
    assert alone.surfaces_left(0)[1] < 6
    again.from_checkpoint(several.to_checkpoint())
    for each in (several, again):
        pattern, cut = (values.reshape(4, -1) for values in each.damage())
        assert np.array_equal(pattern[2], alone.damage()[0]) and not pattern[[0, 1, 3]].any()
        assert np.allclose(cut[2], alone.damage()[1], atol=1e-6, equal_nan=True)
        assert each.surfaces_left(name) == several.surfaces_left(name) and [*each.damaged] == [2]


def test_a_copy_breaks_as_it_would_alone() -> None:
    """With as many surfaces, whether others are struck before it, with it or after it: a bar that falls on what broke
    others does not stay whole since they took them all."""
    mesh, rules = lattice(6, 2, 2, size=0.25), SurfaceParameters(2)
    points = np.array([[0.05, 0.25, 0.05], [1.45, 0.25, 0.05], [0.75, 0.25, 0.45]])
    force = 3e4 * np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, -2.0]])
    alone = Instances.of_body(breakable(mesh, 2e4, rules))
    ParallelAnalyses(alone)([ImpactLoads(0, points, force, np.zeros(3))])
    places = np.array([[0.0, 5.0 * k, 0.0] for k in range(4)])
    sizes = len(mesh.points), len(mesh.cells), len(MeshTopology(mesh).edges)
    poses = InstancePoses.from_placements([InstancePlacement(each, *np.zeros((3, 3))) for each in places])
    several = Instances(lambda *_: breakable(mesh, 2e4, rules), poses, sizes)
    analyses = ParallelAnalyses(several)
    for together in ([2], [0, 3], [2, 1]):
        analyses([ImpactLoads(k * len(mesh.points), points + places[k], force, np.zeros(3)) for k in together])
    pattern = several.damage()[0].reshape(4, -1)
    assert pattern[0].any() and alone.surfaces_left(0) == (0, 0)
    assert np.array_equal(pattern, np.tile(alone.damage()[0], (4, 1)))


class OtherRank:
    """A communicator of two, the second of which analyses with a mesh of its own when it is told to."""

    size, rank = 2, 0

    def __init__(self, other: Instances) -> None:
        self.other, self.asked = other, 0
        self._loads: list[ImpactLoads] = []

    def isend(self, message: object, rank: int, tag: int) -> SimpleNamespace:
        if not isinstance(message, str):
            self.other.apply_outcomes(message.outcomes)  # type: ignore[attr-defined]
            self._loads = message.loads  # type: ignore[attr-defined]
        return SimpleNamespace(wait=lambda: None)

    def gather(self, mine: object) -> list[object]:
        self.asked += len(self._loads[1::2])
        return [mine, [analyse_impact(self.other, each) for each in self._loads[1::2]]]


def test_strikes_on_several_ranks_open_what_they_open_on_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three bars bent one after the other and at once, with surfaces for two of them: the same edges, cuts, starts, and
    numbers of analyses; what one rank opens the other knows when it is asked again."""
    mesh = copies(lattice(6, 2, 2, size=0.25), 3)
    length = len(mesh.points) // 3
    alone, first, second = (Instances.of_body(breakable(mesh, 2e4, SurfaceParameters(5))) for _ in range(3))
    points = np.array([[0.05, 0.25, 0.05], [1.45, 0.25, 0.05], [0.75, 0.25, 0.45]])
    comm = OtherRank(second)
    monkeypatch.setattr("fracsim.rigid.parallel_analyses.gather", lambda comm, value: comm.gather(value))
    serial, spread = ParallelAnalyses(alone), ParallelAnalyses(first, comm, "begin")  # type: ignore[arg-type]
    for size in (1e4, 3e4):
        force = size * np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, -2.0]])
        there = [points + mesh.points[k * length] - mesh.points[0] for k in range(3)]
        strikes = [ImpactLoads(k * length, each, force, np.zeros(3)) for k, each in enumerate(there)]
        broken = serial(strikes)
        assert spread(strikes) == broken
    assert comm.asked and alone.surfaces_left(0) == (0, 0) and alone.get(0).fragments.count > 3
    assert np.array_equal(alone.get(0).graph.broken, first.get(0).graph.broken)
    (pattern, cut), (others, cuts) = alone.damage(), first.damage()
    assert np.array_equal(pattern, others) and np.allclose(cut, cuts, atol=1e-6, equal_nan=True)
    assert (alone.analyses, alone.cg_iterations) == (first.analyses, first.cg_iterations)
    assert np.allclose(alone.to_checkpoint()["starts"], first.to_checkpoint()["starts"])


@pytest.mark.parametrize("shape", ["curved", "planar"])
def test_the_summary_tells_of_single_nodes(tmp_path: Path, shape: str) -> None:
    """`dust` and its mass are those of the last frame of pieces.csv: a single node broken off by curved surfaces."""
    weak = {"fracture": {"strength": 1e4}, "brittle": {"surfaces": 60, "spacing": 0.01, "shape": shape}}
    summary = run_study(MPI.COMM_SELF, study(**weak, time={"scheme": "rigid", "step": 2e-3, "end": 0.02}), tmp_path)
    with (tmp_path / "pieces.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    last = [row for row in rows if row["time"] == rows[-1]["time"]]
    single = [float(row["mass"]) for row in last if row["nodes"] == "1"]
    assert summary["dust"] == len(single) == (1 if shape == "curved" else 0)
    assert summary["dust_mass"] == pytest.approx(sum(single), rel=1e-9) and summary["pieces"] == len(last) > 1
    assert json.loads((tmp_path / "summary.json").read_text())["dust"] == len(single)
