"""A new scheme is one file and one line of SCHEMES: the study's keys, `check`, `list` and the run follow."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest

from cases import STRIP, changed, write_study
from fracsim.study.reader import validate
from support.ranks import TESTS

THETA = '''
from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from fracsim.forms.schemes import Array, EndOfStepScheme


@dataclass(frozen=True)
class Theta(EndOfStepScheme):
    """u = u_n + dt ((1 - theta) v_n + theta v), v = v_n + dt ((1 - theta) a_n + theta a)."""

    theta: float = field(default=0.5, metadata={"gt": 0, "le": 1})
    summary: ClassVar[str] = "a toy"
    inertia: ClassVar[bool] = True
    carries_acceleration: ClassVar[bool] = True

    def rate_coefficients(self, dt: float) -> tuple[float, float]:
        return 1 / (self.theta * dt) ** 2, 1 / (self.theta * dt)

    def reference_displacements(self, dt: float, u: Array, v: Array, a: Array) -> tuple[Array, Array]:
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


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The one file, and a body that falls freely."""
    tmp_path = tmp_path_factory.mktemp("toy")
    (tmp_path / "theta.py").write_text(THETA)
    falling = changed(STRIP, fracture=None, boundary=[], load={"gravity": [0.0, -G]})
    falling |= {"probe": [{"name": "tip", "point": [1.0, 0.25]}], "output": {"every": 100, "picture": False}}
    path = write_study(tmp_path / "fall.toml", falling, time={"step": DT, "end": STEPS * DT, "adapt": False})
    path.write_text(path.read_text().replace('"generalized-alpha"', '"toy"'))
    return tmp_path


def command(folder: Path, *arguments: str, more: str = COMMAND) -> subprocess.CompletedProcess[str]:
    program = [sys.executable, "-c", PROGRAM.format(more=more), *arguments]
    return subprocess.run(program, cwd=folder, capture_output=True, text=True, timeout=100, check=False)


RUN, CHECK = ["run", "fall.toml", "-o"], ["check", "fall.toml"]
# name -> (what the scheme is not, a command line)
LINES: dict[str, tuple[list[str], list[str]]] = {
    "half": ([], [*RUN, "0.5"]),
    "three quarters": ([], [*RUN, "0.75", "--set", "time.theta=0.75"]),
    "listed": ([], ["list"]),
    "checked": ([], CHECK),
    "refused": ([], [*CHECK, "--set", "time.theta=2.0"]),
    "still": (["inertia"], CHECK),
    "moving": (["inertia"], [*CHECK, "--set", "initial.velocity=[1, 0]"]),
    "consistent": (["implicit"], [*CHECK, "--set", "time.mass=consistent"]),
    "passes": (["implicit"], [*CHECK, "--set", "fracture={strength=1e9, passes=2}"]),
}


@pytest.fixture(scope="module")
def answers(folder: Path) -> dict[str, dict[str, Any]]:
    """What one process answers to all of them, one after another."""
    (folder / "lines.json").write_text(json.dumps(list(LINES.values())))
    done = command(folder, str(TESTS), more="exec(" + repr(COMMANDS) + ")")
    assert done.returncode == 0, done.stderr
    return dict(zip(LINES, map(json.loads, done.stdout.splitlines()), strict=True))


def test_a_toy_scheme_runs(folder: Path, answers: dict[str, dict[str, Any]]) -> None:
    """Free fall: v_n = g t_n exactly, and u grows by dt g ((1 - theta) t_n + theta t_{n+1}) a step: after N of them

    u = g dt^2 (N^2 / 2 + (theta - 1/2) N);

    with theta = 3/4 this is neither the exact fall nor that of backward Euler (theta = 1).
    """
    for name in ("half", "three quarters"):
        assert answers[name]["returncode"] == 0, answers[name]["stderr"]
    for theta in (0.5, 0.75):
        with (folder / str(theta) / "history.csv").open() as file:
            last = list(csv.DictReader(file))[-1]
        fallen = G * DT**2 * (STEPS**2 / 2 + (theta - 0.5) * STEPS)
        assert int(last["step"]) == STEPS
        assert float(last["probe_tip_y"]) == pytest.approx(-fallen, rel=1e-8)
        written = tomllib.loads((folder / str(theta) / "study.toml").read_text())["time"]
        assert (written["scheme"], written["theta"], written["rho"]) == ("toy", theta, 0.8)


def test_a_toy_scheme_is_checked_and_listed(answers: dict[str, dict[str, Any]]) -> None:
    listed = answers["listed"]["stdout"]
    assert "  toy                a toy\n" in listed
    assert "(default)" in next(line for line in listed.splitlines() if "generalized-alpha" in line)
    assert "toy, 20 steps of 0.01 s" in answers["checked"]["stdout"]
    assert answers["refused"]["returncode"] == 2
    assert "time.theta = 2.0: must be less than or equal to 1" in answers["refused"]["stderr"]


def test_rules_follow_from_what_a_scheme_is(answers: dict[str, dict[str, Any]]) -> None:
    """Not from its name: without inertia no initial velocity and every body held; explicit: lumped, and no passes."""
    assert "nothing holds the body" in answers["still"]["stderr"]
    assert "[initial] sets a velocity" in answers["moving"]["stderr"]
    assert "explicit steps need mass" in answers["consistent"]["stderr"]
    assert "set passes = 1" in answers["passes"]["stderr"]


def test_two_schemes_cannot_disagree_about_a_key(tmp_path: Path) -> None:
    (tmp_path / "theta.py").write_text(THETA.replace("theta: float", "rho: float"))
    result = command(tmp_path, more="import fracsim.study")
    assert "TypeError: Theta.rho: [time] has this key already, with other limits" in result.stderr


def test_without_the_line_there_is_no_toy(folder: Path) -> None:
    with pytest.raises(Exception, match=r'time\.scheme = "toy": must be'):
        validate(tomllib.loads((folder / "fall.toml").read_text()), "test.toml")
