"""A new scheme is one file and one line of SCHEMES: the study's keys, `check`, `list` and the run follow."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from cases import STRIP, changed, write_study
from fracsim.study.file import validate
from support.ranks import TESTS

THETA = '''
from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from fracsim.forms.schemes.scheme import Array, AtTheEnd


@dataclass(frozen=True)
class Theta(AtTheEnd):
    """u = u_n + dt ((1 - theta) v_n + theta v), v = v_n + dt ((1 - theta) a_n + theta a)."""

    theta: float = field(default=0.5, metadata={"gt": 0, "le": 1})
    summary: ClassVar[str] = "a toy"
    inertia: ClassVar[bool] = True
    carries_acceleration: ClassVar[bool] = True

    def rates(self, dt: float) -> tuple[float, float]:
        return 1 / (self.theta * dt) ** 2, 1 / (self.theta * dt)

    def references(self, dt: float, u: Array, v: Array, a: Array) -> tuple[Array, Array]:
        rest = u + dt * (1 - self.theta) * v
        return rest + self.theta * dt * (v + (1 - self.theta) * dt * a), rest
'''
# the line of the registry, before anything of the study is imported
PROGRAM = "from fracsim.forms.schemes import SCHEMES; from theta import Theta; SCHEMES['toy'] = Theta; {more}"
COMMAND = "import sys; from fracsim.cli import main; sys.argv[0] = 'fracsim'; main()"
# lines of a file, each with what is set of the scheme first
COMMANDS = """
import json
import sys
sys.path.insert(0, sys.argv[1])
from cases import fracsim_here
for changed, line in json.load(open("lines.json")):
    for name in changed:
        setattr(Theta, name, False)
    print(json.dumps(vars(fracsim_here(*line))))
    for name in changed:
        setattr(Theta, name, True)
"""
STEPS, DT, G = 20, 0.01, 9.81


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The one file, and a body that falls freely."""
    (tmp_path / "theta.py").write_text(THETA)
    falling = changed(STRIP, fracture=None, boundary=[], load={"gravity": [0.0, -G]})
    falling |= {"probe": [{"name": "tip", "point": [1.0, 0.25]}], "output": {"every": 100, "picture": False}}
    path = write_study(tmp_path / "fall.toml", falling, time={"step": DT, "end": STEPS * DT, "adapt": False})
    path.write_text(path.read_text().replace('"generalized-alpha"', '"toy"'))
    return tmp_path


def command(folder: Path, *arguments: str, more: str = COMMAND) -> subprocess.CompletedProcess[str]:
    program = [sys.executable, "-c", PROGRAM.format(more=more), *arguments]
    return subprocess.run(program, cwd=folder, capture_output=True, text=True, timeout=100, check=False)


def commands(folder: Path, *lines: tuple[list[str], list[str]]) -> list[dict[str, str]]:
    """What a process answers to command lines, one after another, each with things that the scheme is not."""
    (folder / "lines.json").write_text(json.dumps(lines))
    done = command(folder, str(TESTS), more="exec(" + repr(COMMANDS) + ")")
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_a_toy_scheme_runs(folder: Path) -> None:
    """Free fall: v_n = g t_n exactly, and u grows by dt g ((1 - theta) t_n + theta t_{n+1}) a step: after N of them

    u = g dt^2 (N^2 / 2 + (theta - 1/2) N);

    with theta = 3/4 this is neither the exact fall nor that of backward Euler (theta = 1).
    """
    run = ["run", "fall.toml", "-o"]
    for result in commands(folder, ([], [*run, "0.5"]), ([], [*run, "0.75", "--set", "time.theta=0.75"])):
        assert result["returncode"] == 0, result["stderr"]
    for theta in (0.5, 0.75):
        with (folder / str(theta) / "history.csv").open() as file:
            last = list(csv.DictReader(file))[-1]
        fallen = G * DT**2 * (STEPS**2 / 2 + (theta - 0.5) * STEPS)
        assert int(last["step"]) == STEPS
        assert float(last["probe_tip_y"]) == pytest.approx(-fallen, rel=1e-8)
        written = tomllib.loads((folder / str(theta) / "study.toml").read_text())["time"]
        assert (written["scheme"], written["theta"], written["rho"]) == ("toy", theta, 0.8)


def test_a_toy_scheme_is_checked_and_listed(folder: Path) -> None:
    check = ["check", "fall.toml"]
    listed, checked, refused = commands(folder, ([], ["list"]), ([], check), ([], [*check, "--set", "time.theta=2.0"]))
    assert "  toy                a toy\n" in listed["stdout"]
    assert "(default)" in next(line for line in listed["stdout"].splitlines() if "generalized-alpha" in line)
    assert "toy, 20 steps of 0.01 s" in checked["stdout"]
    assert refused["returncode"] == 2
    assert "time.theta = 2.0: must be less than or equal to 1" in refused["stderr"]


def test_rules_follow_from_what_a_scheme_is(folder: Path) -> None:
    """Not from its name: without inertia no initial velocity and every body held; explicit: lumped, and no passes."""
    check = ["check", "fall.toml"]
    still, moving, consistent, passes = commands(
        folder,
        (["inertia"], check),
        (["inertia"], [*check, "--set", "initial.velocity=[1, 0]"]),
        (["implicit"], [*check, "--set", "time.mass=consistent"]),
        (["implicit"], [*check, "--set", "fracture={strength=1e9, passes=2}"]),
    )
    assert "nothing holds the body" in still["stderr"]
    assert "[initial] sets a velocity" in moving["stderr"]
    assert "explicit steps need mass" in consistent["stderr"]
    assert "set passes = 1" in passes["stderr"]


def test_two_schemes_cannot_disagree_about_a_key(folder: Path) -> None:
    (folder / "theta.py").write_text(THETA.replace("theta: float", "rho: float"))
    result = command(folder, more="import fracsim.study")
    assert "TypeError: Theta.rho: [time] has this key already, with other limits" in result.stderr


def test_without_the_line_there_is_no_toy(folder: Path) -> None:
    with pytest.raises(Exception, match=r'time\.scheme = "toy": must be'):
        validate(tomllib.loads((folder / "fall.toml").read_text()), "test.toml")
