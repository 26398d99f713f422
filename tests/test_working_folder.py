"""What lies in the working folder is data: a run takes neither settings nor code from there."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from cases import STRIP, changed, command, write_study

# a library that leaves a file beside itself as soon as it is loaded, whatever else it has
LOADED = """
#include <stdio.h>
__attribute__((constructor)) static void loaded(void) { fclose(fopen("FOLDER/LOADED", "w")); }
int PetscDLLibraryRegister_evil(void) { return 0; }
"""
SPEAKS = "open({!r}, 'w').close()\n"


def fracsim(folder: Path, *arguments: str, ranks: int = 0, **environment: str) -> subprocess.CompletedProcess[str]:
    """The command, called in a folder."""
    whole = command(*arguments, ranks=ranks)
    known = os.environ | {"FRACSIM_PROGRESS": "off"} | environment  # a slow machine tells how far a run is
    return subprocess.run(whole, cwd=folder, env=known, capture_output=True, text=True, timeout=100, check=False)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A study among files that libraries look for in the working folder."""
    folder = tmp_path_factory.mktemp("foreign")
    write_study(folder / "strip.toml", changed(STRIP, output={"picture": True}, time={"end": 0.002, "step": 0.001}))
    (folder / "evil.c").write_text(LOADED.replace("FOLDER", str(folder)))
    subprocess.run(["cc", "-shared", "-fPIC", "evil.c", "-o", "libevil.so"], cwd=folder, check=True)
    for name in ("keep.txt", "log.txt"):
        (folder / name).write_text("mine")
    (folder / ".petscrc").write_text(f"-dll_prepend {folder}/libevil.so\n-ksp_max_it 1\n")
    (folder / "petscrc").write_text(f"-log_view :{folder}/keep.txt\n")
    (folder / "petsc.cfg").write_text(f"PETSC_DIR = {folder}\nPETSC_ARCH = evil\n")
    (folder / "ucx.conf").write_text(f"UCX_LOG_FILE={folder}/log.txt\nUCX_LOG_LEVEL=trace\n")
    (folder / "dolfinx_jit_options.json").write_text('{"cache_dir": "cache"')
    (folder / "ffcx_options.json").write_text("[")
    (folder / "matplotlibrc").write_text("backend: module://evil\nsvg.fonttype: path\n")
    for name in ("numpy", "gmsh", "tomllib", "evil", "sitecustomize", "usercustomize", "matplotlib", "fracsim"):
        (folder / f"{name}.py").write_text(SPEAKS.format(str(folder / "IMPORTED")))
    return folder


def assert_untouched(folder: Path) -> None:
    """Nothing was loaded, imported, written over, or put into another cache."""
    assert [name for name in ("LOADED", "IMPORTED", "cache", "__pycache__") if (folder / name).exists()] == []
    assert [(folder / name).read_text() for name in ("keep.txt", "log.txt")] == ["mine", "mine"]


def test_a_run_takes_nothing_from_the_working_folder(folder: Path) -> None:
    """Nor do its picture and its report; options of the environment are the user's own."""
    for arguments in (
        ("check", "strip.toml"),
        ("run", "strip.toml", "-o", "out"),
        ("report", "out", "-o", "report.html"),
    ):
        done = fracsim(folder, *arguments)
        assert (done.returncode, done.stderr) == (0, ""), arguments
        assert_untouched(folder)
    assert (folder / "out" / "last.png").exists()
    assert "<text" in (folder / "report.html").read_text()  # svg.fonttype: path draws letters
    plain = ("run", "strip.toml", "-o", "out", "--set", "output.picture=false")
    done = fracsim(folder, *plain, PETSC_OPTIONS=f"-log_view :{folder}/asked.txt")
    assert (done.returncode, done.stderr) == (0, "")
    assert "PETSc" in (folder / "asked.txt").read_text()
    assert_untouched(folder)


SCRIPT = """
import os
before = os.getcwd()
from fracsim.scene import build_scene
from fracsim.study.reader import load_study
from mpi4py import MPI
scene = build_scene(MPI.COMM_WORLD, load_study("strip.toml"))
state, _ = scene.stepper.advance(scene.start())
import dolfinx
print(state.step, os.getcwd() == before, callable(dolfinx.plot.vtk_mesh))
"""


def test_a_script_takes_nothing_from_the_working_folder(folder: Path, tmp_path: Path) -> None:
    """Where it imports fracsim first. Then it is in its folder again, and has the whole of DOLFINx."""
    (tmp_path / "script.py").write_text(SCRIPT)
    program = [sys.executable, tmp_path / "script.py"]
    done = subprocess.run(program, cwd=folder, capture_output=True, text=True, timeout=100, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "1 True True\n", "")
    assert_untouched(folder)


@pytest.mark.ranks
def test_no_rank_takes_anything_from_the_working_folder(folder: Path) -> None:
    done = fracsim(folder, "run", "strip.toml", "-o", "out2", "--set", "output.picture=false", ranks=2)
    assert (done.returncode, done.stderr) == (0, "")
    assert_untouched(folder)


@pytest.mark.parametrize(("library", "name"), [("dolfinx", "dolfinx_jit_options.json"), ("ffcx", "ffcx_options.json")])
@pytest.mark.parametrize("text", ["{", *(pytest.param(text, marks=pytest.mark.slow) for text in ("[1, 2]", "\x00"))])
def test_settings_of_the_user_that_are_no_json_are_named(tmp_path: Path, library: str, name: str, text: str) -> None:
    path = tmp_path / library / name
    path.parent.mkdir()
    path.write_text(text)
    study = write_study(tmp_path / "strip.toml", STRIP)
    done = fracsim(tmp_path, "run", str(study), "-o", str(tmp_path / "out"), XDG_CONFIG_HOME=str(tmp_path))
    assert done.returncode == 2 and not (tmp_path / "out").exists()
    assert done.stderr.startswith(f"fracsim: the settings of {library} in {path} cannot be read: ")
    assert done.stderr.endswith("; mend the file, which is a table in JSON, or delete it\n")
