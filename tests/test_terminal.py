"""What a user's file says reaches a terminal as text: no control character of it is obeyed there."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
from mpi4py import MPI

from cases import BAR, STRIP, changed, command, fracsim_here, study, write_study
from fracsim.deformable_run import Run
from fracsim.errors import InputError
from fracsim.meshes import BUILDERS
from fracsim.scene import build_scene
from fracsim.study.reader import validate

# sets the title of a window, clears the screen, begins a line anew, turns the direction of writing
EVIL = "a\x1b]0;b\x07\x1b[2J\rc\x9b31md\u202ee\nf"
SAID = r"a\x1b]0;b\x07\x1b[2J\rc\x9b31md\u202ee\nf"


def controls(text: str) -> set[str]:
    """Characters of a text that are not printed, but for the ends of lines."""
    return {each for each in text if not each.isprintable()} - {"\n"}


def test_the_title_is_printed_as_text(tmp_path: Path) -> None:
    bar = write_study(tmp_path / "bar.toml", changed(BAR, title=EVIL))
    for words in (("check", bar), ("run", bar, "-o", tmp_path / "out")):
        done = fracsim_here(*words)
        assert done.returncode == 0 and SAID in done.stdout and not controls(done.stdout + done.stderr)


def test_names_of_groups_are_printed_as_text(tmp_path: Path) -> None:
    """Of a mesh file: by check, by mesh, and in the message of a group that does not exist."""
    mesh = BUILDERS["box"](size=(1.0, 1.0, 1.0), h=0.5).build()
    left = mesh.facet_groups["left"]
    tags = [np.full(len(mesh.cells), 2, np.int32), np.full(len(left), 1, np.int32)]
    evil = EVIL.replace("\n", "").replace("\r", "")
    names = {evil: np.array([1, 2]), evil + "body": np.array([2, 3])}
    cells = [("tetra", mesh.cells), ("triangle", left)]
    data = {"gmsh:physical": tags, "gmsh:geometrical": tags}
    made = meshio.Mesh(mesh.points, cells, cell_data=data, field_data=names)
    made.write(tmp_path / "part.msh", file_format="gmsh22", binary=False)
    tables: dict[str, Any] = {"boundary": [{"on": evil, "fix": "xyz"}], "probe": []}
    path = write_study(tmp_path / "bar.toml", BAR | {"mesh": {"file": str(tmp_path / "part.msh")}} | tables)
    for words in (("check", path), ("mesh", path, "-o", tmp_path / "a.vtu")):
        done = fracsim_here(*words)
        assert done.returncode == 0, done.stderr
        assert not controls(done.stdout + done.stderr)
    tables["boundary"][0]["on"] = "right"
    done = fracsim_here("check", write_study(path, BAR | {"mesh": {"file": str(tmp_path / "part.msh")}} | tables))
    assert done.returncode == 2 and r"a\x1b]0;b\x07" in done.stderr and not controls(done.stdout + done.stderr)


def test_no_text_of_the_command_has_control_characters(tmp_path: Path) -> None:
    """A traceback too: of a fault of the program, which quotes what it was given."""
    code = f"""
import sys
from unittest import mock
from fracsim import cli, process
sys.argv = ["fracsim", "check", "x"]
with mock.patch("fracsim.study.reader.load_study", side_effect=RuntimeError({EVIL!r})):
    cli.main(process.start_process)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=60, check=False, cwd=tmp_path)
    said = done.stderr.decode()
    assert done.returncode == 1 and "Traceback" in said and r"\x1b]0;b\x07\x1b[2J" in said
    assert controls(said) <= {"\r"}  # which a line that tells of progress begins with


def test_a_file_by_such_a_name_is_told_of_as_text(tmp_path: Path) -> None:
    done = subprocess.run(command("check", tmp_path / EVIL), capture_output=True, timeout=60, check=False)
    assert done.returncode == 2 and not controls((done.stdout + done.stderr).decode())


# --- how long names are ---------------------------------------------------------------------------------------------


def named(length: int) -> dict[str, Any]:
    """A ball far from a strip, by a name so long."""
    ball = {"name": "b" * length, "shape": "sphere", "at": [0.0, 9.0], "radius": 0.1, "velocity": [0.1, 0.0]}
    return changed(STRIP, time={"end": 0.002, "step": 0.001}, obstacle=[ball])


def test_the_longest_name_of_an_obstacle_makes_files(tmp_path: Path) -> None:
    Run(build_scene(MPI.COMM_SELF, study(named(64))), tmp_path)()
    assert len(list((tmp_path / "surface").glob(f"obstacle_{'b' * 64}_*.vtu"))) > 1
    probe = changed(BAR, probe=[{"name": "p" * 64, "on": "right"}])
    Run(build_scene(MPI.COMM_SELF, study(probe)), tmp_path / "probed")()


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (named(65), 'obstacle.0.name = "bbbbbb.*: must have 64 letters or fewer'),
        (named(240), "must have 64 letters or fewer"),
        (changed(BAR, probe=[{"name": "p" * 65, "on": "right"}]), "probe.0.name = .*: must have 64 letters or fewer"),
        (changed(BAR, material={"r" * 101: {"young": 1e5}}), "material: the name of a region has 100 letters or fewer"),
        (changed(BAR, material={EVIL: {"young": 1e5}}), "and no control characters"),
    ],
)
def test_longer_names_are_refused(data: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        validate(data, "study.toml")
