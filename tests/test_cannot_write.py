"""Output that cannot be written in the middle of a run: exit code 5, one message, no hang, nothing lost before it."""

from __future__ import annotations

import csv
import json
import resource
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import h5py
import pytest
import pyvista
from mpi4py import MPI

from cases import STRIP, changed, fracsim_here, mpirun, study, write_study
from fracsim.deformable_run import Run
from fracsim.errors import CannotWrite, Exit
from fracsim.scene import build_scene

TEARING = changed(STRIP, output={"fields": ["damage", "stress"]})
# In its fifth call what writes a file meets a disk with a few bytes left: a limit on the size of files, of this moment
# or, where it `stays`, of all that follows.
FULL = """
import resource
from importlib import import_module
module, owner, name, limit, stays = {where!r}
owner = getattr(import_module(module), owner) if owner else import_module(module)
work, calls = getattr(owner, name), iter(range(100))
def full(*arguments, **options):
    if next(calls) < 4:
        return work(*arguments, **options)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
    try:
        return work(*arguments, **options)
    finally:
        if not stays:
            resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
setattr(owner, name, full)
"""
START = """
import sys
sys.argv = ["fracsim", *{arguments!r}]
from fracsim.cli import main
main()
"""
# what is full -> (what the message names, what of the module is wrapped, bytes that a file may have)
CASES: dict[str, tuple[str, tuple[str, str, str], int]] = {
    "fields": ("fields.xdmf", ("fracsim.output.fields_file", "FieldsFile", "append_frame"), 35_000),
    "xml": ("fields.xdmf", ("fracsim.output.fields_file", "", "append_bytes"), 4_500),
    "surface": ("surface.pvd", ("fracsim.output.surface.vtk_files", "SurfaceFiles", "write_frame"), 1_000),
    "pieces": ("surface.pvd", ("fracsim.output.surface.vtk_files", "", "append_bytes"), 600),
    "history": ("history.csv", ("fracsim.output.history", "", "write_all"), 700),
    "checkpoint": ("checkpoint/state.h5", ("fracsim.deformable_run", "", "write_checkpoint"), 9_000),
}
EVERY_STEP = {"output": {"checkpoint": 1e-9}}


def full(
    case: str, folder: Path, tables: dict[str, Any], *, ranks: int = 0, stays: bool = False
) -> subprocess.CompletedProcess[str]:
    """A run into folder/out that meets a full disk: on ranks, or in this process."""
    _, where, limit = CASES[case]
    path = write_study(folder / "strip.toml", changed(TEARING, **tables))
    arguments = ["run", str(path), "-o", str(folder / "out")]
    code = FULL.format(where=(*where, limit, stays))
    if not ranks:
        return full_here(code, arguments)
    whole = [*mpirun(ranks), sys.executable, "-c", code + START.format(arguments=arguments)]
    return subprocess.run(whole, capture_output=True, text=True, timeout=60, check=False)


def full_here(code: str, arguments: list[str]) -> subprocess.CompletedProcess[str]:
    """What `code` does to this process is undone: the limit, and what it puts in the place of a function."""
    limits, names = resource.getrlimit(resource.RLIMIT_FSIZE), dict[str, Any]()
    try:
        exec(code, names)
        return fracsim_here(*arguments)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        setattr(names["owner"], names["name"], names["work"])


def rows(folder: Path) -> list[list[str]]:
    with (folder / "history.csv").open(newline="") as file:
        return list(csv.reader(file))[1:]


def assert_whole(out: Path) -> None:
    """Every file can be read, and says nothing by halves."""
    assert len({len(row) for row in rows(out)}) == 1 and not list(out.rglob("*.new"))
    with h5py.File(out / "fields.h5") as file:
        assert all({"displacement", "damage", "stress"} == set(frame) for frame in file["frames"].values())
    ElementTree.parse(out / "fields.xdmf")
    assert len(pyvista.get_reader(out / "surface.pvd").time_values) > 0
    with (out / "pieces.csv").open(newline="") as pieces:
        assert len({len(row) for row in csv.reader(pieces)}) == 1


# each once; a row, which only rank 0 knows to be lost, on two ranks, and on one below
@pytest.mark.parametrize(
    ("case", "ranks"),
    [(case, 0) for case in CASES if case != "history"]
    + [(case, 2) for case in ("history", "fields", "surface", "checkpoint")],
)
def test_a_full_disk_ends_the_run(tmp_path: Path, case: str, ranks: int) -> None:
    """With what could not be written, why, and where to go on from; what was written before is whole."""
    out = tmp_path / "out"
    done = full(case, tmp_path, EVERY_STEP if case == "checkpoint" else {}, ranks=ranks)
    assert done.returncode == Exit.CANNOT_WRITE, done.stderr
    path = out / "checkpoint" / "state.h5"
    said = {
        "history": "There is no checkpoint",  # one of now would lack the row of its last step
        "checkpoint": f"The last good checkpoint: {path} at t = 0.02 s; go on with --restart",
    }.get(case, f"Checkpoint: {path}; go on with --restart")
    assert done.stderr.count(f"fracsim: could not write {out / CASES[case][0]}: File too large. {said}") == 1
    assert "Traceback" not in done.stderr and "HDF5" not in done.stderr and "vtk" not in done.stderr
    assert path.exists() == (case != "history")
    assert json.loads((out / "summary.json").read_text())["outcome"] == "could not write"
    assert_whole(out)


@pytest.mark.parametrize("case", ["surface", "history"])
def test_a_disk_that_stays_full(tmp_path: Path, case: str) -> None:
    """The last good checkpoint is named, and stands; with room again the run goes on from there to the same end."""
    out = tmp_path / "out"
    done = full(case, tmp_path, EVERY_STEP, stays=True)
    assert done.returncode == Exit.CANNOT_WRITE, done.stderr
    assert f"The last good checkpoint: {out}/checkpoint/state.h5 at t = 0.0" in done.stderr
    assert_whole(out)
    data = study(changed(TEARING, **EVERY_STEP))
    Run(build_scene(MPI.COMM_SELF, data), out, restart=True)()
    Run(build_scene(MPI.COMM_SELF, data), tmp_path / "whole")()
    assert len(rows(out)) == len(rows(tmp_path / "whole")) == 10
    for found, wanted in zip(rows(out), rows(tmp_path / "whole"), strict=True):
        assert [float(each) for each in found[:10]] == pytest.approx([float(each) for each in wanted[:10]], rel=1e-4)
    assert_whole(out)


def test_a_folder_that_is_gone(tmp_path: Path) -> None:
    """It is not made again: a checkpoint in a folder that somebody removed would be of no use."""
    scene = build_scene(MPI.COMM_SELF, study(TEARING))
    advance, out = scene.stepper.advance, tmp_path / "out"

    def gone(state: Any) -> Any:
        shutil.rmtree(out, ignore_errors=True)
        return advance(state)

    scene.stepper.advance = gone  # type: ignore[method-assign]
    with pytest.raises(
        CannotWrite, match=r"could not write .*fields\.xdmf: No such file or directory\. There is no ch"
    ):
        Run(scene, out)()
    assert not out.exists()


@pytest.mark.parametrize(("stays", "every"), [(False, None), (True, 1e-9), (True, None)])
def test_a_full_disk_in_a_rigid_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stays: bool, every: float | None
) -> None:
    """The message names a checkpoint of now, or the last good one, or says that there is none; runs go on from it."""
    pytest.importorskip("mujoco", reason="an environment made without a network")
    from fracsim.deformable_run import run_study
    from fracsim.output import atomic_write, rigid_frames
    from test_rigid_study import study as falling

    table, out = falling(output={"every": 10, "picture": False, "checkpoint": every}), tmp_path / "out"
    write, calls, full_now = rigid_frames.SurfaceFiles.write_frame, iter(range(100)), []

    def full(self: Any, *arguments: Any) -> None:
        if next(calls) == 2:
            full_now.append(True)
            raise OSError(28, "No space left on device")
        write(self, *arguments)

    def on_disk(comm: Any, path: Path, work: Any) -> Any:
        def tried() -> Any:
            if full_now and stays:
                raise OSError(28, "No space left on device")
            return work()

        return atomic_write.write_on_root(comm, path, tried)

    monkeypatch.setattr(rigid_frames.SurfaceFiles, "write_frame", full)
    monkeypatch.setattr("fracsim.rigid_run.write_on_root", on_disk)
    with pytest.raises(CannotWrite) as error:
        run_study(MPI.COMM_SELF, table, out)
    path = out / "checkpoint" / "state.h5"
    wanted = f"Checkpoint: {path}; go on with --restart" if not stays else (
        f"The last good checkpoint: {path} at t = 0.038 s; go on with --restart" if every else "There is no checkpoint"
    )  # fmt: skip
    assert str(error.value).endswith(f"surface.pvd: No space left on device. {wanted}")
    if stays:
        full_now.clear()
    else:
        assert json.loads((out / "summary.json").read_text())["outcome"] == "could not write"
    if path.exists():
        summary = run_study(MPI.COMM_SELF, table, out, restart=True)
        whole = run_study(MPI.COMM_SELF, table, tmp_path / "whole")
        assert (summary["steps"], summary["broken_edges"]) == (whole["steps"], whole["broken_edges"])
