"""Tiny studies for the tests of input and output, and running the command line."""

from __future__ import annotations

import copy
import io
import shutil
import subprocess
import tomllib
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import IO, Any
from unittest import mock

import pytest

from fracsim import cli
from fracsim.study import Study
from fracsim.study.reader import study_text, validate

BAR = tomllib.loads("""
title = "bar"
[mesh]
builder = "box"
size = [1.0, 0.25, 0.25]
h = 0.25
[material]
energy = "linear"
young = 1e6
poisson = 0.3
density = 1000.0
[[boundary]]
on = "left"
fix = "xyz"
[[boundary]]
on = "right"
velocity = [0.1, 0.0, 0.0]
[time]
step = 0.01
end = 0.03
[[probe]]
name = "grip"
on = "right"
[output]
every = 1
picture = false
""")

STRIP = tomllib.loads("""
title = "strip"
[mesh]
builder = "box"
size = [1.0, 0.25]
h = 0.125
[material]
energy = "neo-hookean"
young = 1e6
poisson = 0.3
density = 1000.0
[fracture]
strength = 2e4
[[boundary]]
on = "left"
fix = "xy"
[[boundary]]
on = "right"
velocity = [1.0, 0.0]
[time]
step = 0.005
end = 0.05
[[probe]]
name = "grip"
on = "right"
[[probe]]
name = "tip"
point = [1.0, 0.25]
[output]
every = 1
fields = ["damage", "chi", "piece", "velocity", "stress", "von_mises", "energy_density", "region"]
picture = false
""")

# STRIP that yields before it tears
DUCTILE_TABLES: dict[str, Any] = {
    "plasticity": {"yield_stress": 1.2e4, "hardening": 1e5, "flow_rate": 500.0},
    "output": {"fields": ["damage", "chi", "piece", "plastic_strain"]},
}


# an obstacle file (OBJ), m
WEDGE = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n"


def changed(base: dict[str, Any], **tables: Any) -> dict[str, Any]:
    """A copy of a study with keys of its tables set: changed(BAR, time={"end": 1.0}); None removes, others replace."""
    data = copy.deepcopy(base)
    for name, value in tables.items():
        if value is None:
            del data[name]
        elif isinstance(value, dict) and isinstance(data.get(name), dict):
            data[name] |= value
        else:
            data[name] = value
    return data


def study(base: dict[str, Any], **tables: Any) -> Study:
    return validate(changed(base, **tables), "test.toml")


def write_study(path: Path, base: dict[str, Any], **tables: Any) -> Path:
    path.write_text(study_text(study(base, **tables)))
    return path


def fracsim(
    *arguments: str | Path,
    ranks: int = 0,
    timeout: float = 60,
    env: dict[str, str] | None = None,
    cwd: Path | None = None,
) -> subprocess.CompletedProcess[str]:
    """Run the command line: under mpirun where `ranks` are given, in a process of its own where it needs one.

    A sweep starts processes, which would inherit what MPI has told this one.
    """
    if not ranks and env is None and cwd is None and ("sweep" not in arguments or "--list" in arguments):
        return fracsim_here(*arguments)
    return subprocess.run(
        command(*arguments, ranks=ranks), capture_output=True, text=True, timeout=timeout, env=env, cwd=cwd, check=False
    )


def fracsim_here(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Call the entry point in this process, which has imported what it needs: what it does not catch is raised."""
    said, warned = io.StringIO(), io.StringIO()
    words = ["fracsim", *map(str, arguments)]
    output = redirect_stdout(said), redirect_stderr(warned)
    with mock.patch("sys.argv", words), output[0], output[1], pytest.raises(SystemExit) as end:
        cli.main()
    return subprocess.CompletedProcess(words, int(end.value.code or 0), said.getvalue(), warned.getvalue())


def swept_here(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """A sweep in this process, and its runs too: for tests of what it makes of their ends, not of how they start."""
    import h5py  # noqa: F401  # Debian's starts a process when it is first imported: a real one

    # not subprocess.Popen itself, which compilers of new kernels are started by
    with mock.patch("fracsim.report.sweep.subprocess", mock.Mock(Popen=_RunHere)):
        return fracsim_here("sweep", *arguments)


class _RunHere:
    """What a sweep asks of a process."""

    def __init__(self, work: list[str], stdout: IO[str], **_: Any) -> None:
        self._done = fracsim_here(*work[1:])
        stdout.write(self._done.stdout + self._done.stderr)

    def wait(self) -> int:
        return self._done.returncode


def mpirun(ranks: int) -> list[str]:
    """Its own time limit ends the ranks as well, which killing mpirun from outside does not."""
    return ["env", "MPIEXEC_TIMEOUT=50", "mpirun", "-n", str(ranks)]


def command(*arguments: str | Path, ranks: int = 0) -> list[str]:
    return [*(mpirun(ranks) if ranks else []), shutil.which("fracsim") or "fracsim", *map(str, arguments)]
