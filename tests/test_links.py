"""What is written is a file of fracsim's own: a link at its place is replaced and not followed, a pipe is not waited
for. What was there by another name stays as it was."""

from __future__ import annotations

import json
import os
import socket
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import pytest
from mpi4py import MPI

from cases import BAR, STRIP, changed, command, fracsim_here, study, swept_here, write_study
from fracsim.deformable_run import Run
from fracsim.errors import InputError
from fracsim.output.file_ownership import NEW, OUTPUT_FILES
from fracsim.scene import build_scene

TEARING = changed(STRIP, time={"end": 0.01, "step": 0.001}, output={"fields": ["damage"], "checkpoint": 1e-9})
WORDS = "years of work"
SMALL = ("--size", "160x120", "--bare")


# files of other studies
UNWRITTEN = ("last.png", "tips.csv")


def run(folder: Path, data: dict[str, Any] = TEARING, **how: Any) -> None:
    Run(build_scene(MPI.COMM_SELF, study(data)), folder, **how)()


def limited(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """In a process of its own: one that waits for a pipe is ended."""
    return subprocess.run(command(*arguments), capture_output=True, text=True, timeout=60, check=False)


@pytest.fixture
def precious(tmp_path: Path) -> Path:
    """A folder with a file for each that a run writes."""
    folder = tmp_path / "precious"
    for name in ("checkpoint", "surface"):
        (folder / name).mkdir(parents=True)
    for name in (
        "study.toml",
        "log.txt",
        "report.html",
        "sweep.csv",
        *OUTPUT_FILES,
        *(f"surface/surface_{n:06d}.vtu" for n in range(12)),
    ):
        (folder / name).write_text(WORDS)
    return folder


def assert_untouched(folder: Path) -> None:
    files = [path for path in folder.rglob("*") if not path.is_dir()]
    assert len(files) == 12 + len(OUTPUT_FILES) + 4
    assert all(path.is_file() and not path.is_symlink() and path.read_text() == WORDS for path in files)


def link(folder: Path, precious: Path, names: list[str], ending: str = "") -> None:
    """Links in an output folder to files that have nothing to do with it."""
    for name in names:
        place = folder / (name + ending)
        place.parent.mkdir(parents=True, exist_ok=True)
        place.unlink(missing_ok=True)
        place.symlink_to(precious / name)


# --- a run ----------------------------------------------------------------------------------------------------------


def test_no_file_that_is_not_whole_is_written_through_a_link(tmp_path: Path, precious: Path) -> None:
    """At the names by which a run writes before it replaces: in a new folder, in an old one, and going on."""
    out = tmp_path / "out"
    for how in ({}, {}, {"restart": True}):
        link(out, precious, ["study.toml", *OUTPUT_FILES], NEW)
        if not how and not (out / "study.toml").exists():  # a new folder may hold no more than this
            for name in OUTPUT_FILES:
                (out / (name + NEW)).unlink()
            (out / "checkpoint").rmdir()
        run(out, **how)
        assert_untouched(precious)
        assert how or not list(out.rglob("*" + NEW))


def test_no_file_is_written_through_a_link(tmp_path: Path, precious: Path) -> None:
    """At the names of the files themselves; frames that do not exist yet as well."""
    out, frames = tmp_path / "out", [f"surface/surface_{number:06d}.vtu" for number in range(12)]
    run(out)
    link(out, precious, [*OUTPUT_FILES, *frames])
    (out / "pieces.csv").unlink()
    (out / "pieces.csv").symlink_to(tmp_path / "gone.csv")  # a link to nothing is not followed either
    run(out, overwrite=True)
    assert_untouched(precious)
    assert not (tmp_path / "gone.csv").exists()
    assert all(
        (out / name).is_file() and not (out / name).is_symlink() for name in OUTPUT_FILES if name not in UNWRITTEN
    )


@pytest.mark.parametrize("name", ["surface", "checkpoint"])
def test_a_folder_that_is_a_link_is_refused(tmp_path: Path, precious: Path, name: str) -> None:
    """Old frames would be deleted there, and new ones written."""
    out = tmp_path / "out"
    run(out)
    (out / name).rename(tmp_path / "moved")
    (out / name).symlink_to(precious / name)
    for how in ((), ("--overwrite",), ("--restart",)):
        done = fracsim_here("run", write_study(tmp_path / "strip.toml", TEARING), "-o", out, *how)
        assert done.returncode == 2
        assert f"--out {out}: {out / name} is a link; a run has a folder of its own there: delete it" in done.stderr
    assert_untouched(precious)


def pipe(path: Path) -> None:
    os.mkfifo(path)


def listening(path: Path) -> None:
    before = Path.cwd()
    os.chdir(path.parent)  # addresses are short
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(path.name)
    os.chdir(before)


OTHERS: dict[str, tuple[Callable[[Path], Any], str]] = {
    "pipe": (pipe, "is a named pipe, not a file"),
    "socket": (listening, "is a socket, not a file"),
    "device": (lambda path: path.symlink_to("/dev/zero"), "is a device, not a file"),
    "folder": (Path.mkdir, "is a folder, not a file"),
}


@pytest.mark.timeout(60)
@pytest.mark.parametrize("kind", ["pipe", *(pytest.param(kind, marks=pytest.mark.slow) for kind in [*OTHERS][1:])])
def test_what_is_no_file_is_refused_and_not_waited_for(tmp_path: Path, kind: str) -> None:
    """At any name of a file of a run, by a run, a restart, a sweep, a picture, a report and an export."""
    out, make, said = tmp_path / "cases" / "end-0.01", *OTHERS[kind]
    strip = write_study(tmp_path / "strip.toml", TEARING)
    run(out)
    for name in ("study.toml", *OUTPUT_FILES):
        place = out / name
        if place.exists():
            place.rename(tmp_path / "kept")
        make(place)
        commands: list[tuple[str | Path, ...]] = [("run", strip, "-o", out, "--overwrite")]
        if name != "last.png":
            commands += [("run", strip, "-o", out, "--restart")]
        commands += [("sweep", strip, "--set", "time.end=0.01", "-o", out.parent)]
        for words in commands:
            done = fracsim_here(*words)
            assert done.returncode == 2 and f"{place} {said}; delete it, or give another folder\n" in done.stderr
        if name in ("surface.pvd", "fields.h5"):
            done = fracsim_here("render", out, "-o", tmp_path / "a.png")
            assert done.returncode == 2 and f"{place}: {said}; give another path" in done.stderr
        if name in ("summary.json",):
            done = fracsim_here("report", out, "-o", tmp_path / "a.html")
            assert done.returncode == 2 and f"its files are not those of a run: {place} {said}" in done.stderr
        if place.is_dir() and not place.is_symlink():
            place.rmdir()
        else:
            place.unlink()
        if (tmp_path / "kept").exists():
            (tmp_path / "kept").rename(place)
    run(out, overwrite=True)


def test_leftovers_that_are_pipes_are_replaced(tmp_path: Path) -> None:
    """By the names of files that are not whole yet, which are fracsim's own."""
    run(tmp_path / "out")
    for name in ("study.toml", *OUTPUT_FILES):
        pipe(tmp_path / "out" / (name + NEW))
    done = limited("run", write_study(tmp_path / "strip.toml", TEARING), "-o", tmp_path / "out", "--overwrite")
    assert done.returncode == 0, done.stderr


# --- HDF5 -----------------------------------------------------------------------------------------------------------


def longer() -> dict[str, Any]:
    return changed(TEARING, time={"end": 0.012})


@pytest.mark.parametrize("how", ["link", "external link", "external data", "virtual data"])
def test_frames_are_not_appended_to_another_file(tmp_path: Path, how: str) -> None:
    out, other = tmp_path / "out", tmp_path / "other.h5"
    run(out)
    h5 = out / "fields.h5"
    os.rename(h5, other)
    if how == "link":
        h5.symlink_to(other)
    else:
        with h5py.File(h5, "w") as file, h5py.File(other) as whole:
            for name in ("points", "cells"):
                whole.copy(name, file)
            if how == "external link":
                file["frames"] = h5py.ExternalLink(str(other), "frames")
            else:
                whole.copy("frames", file)
                frame = file["frames/000003"]
                if how == "external data":
                    frame.create_dataset("more", (4,), float, external=[(str(other), 0, 32)])
                else:
                    layout = h5py.VirtualLayout((4,), float)
                    layout[:] = h5py.VirtualSource(str(other), "points", (4,))
                    frame.create_virtual_dataset("more", layout)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(InputError, match=r"--restart: .*fields\.h5 (is a link|has the data of '/frames.*' in another)"):
        run(out, longer(), restart=True)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    if how != "link":
        (out / "surface.pvd").unlink()
        done = fracsim_here("render", out, "-o", tmp_path / "a.png")
        assert done.returncode == 2 and "in another file, which no run of fracsim does" in done.stderr


def test_a_backup_by_hard_links_stays(tmp_path: Path) -> None:
    """As `cp -al` makes it: a run that goes on writes into files of its own."""
    out, backup = tmp_path / "out", tmp_path / "backup"
    run(out)
    files = [path.relative_to(out) for path in out.rglob("*") if path.is_file()]
    for path in files:
        (backup / path).parent.mkdir(parents=True, exist_ok=True)
        os.link(out / path, backup / path)
    before = {path: (backup / path).read_bytes() for path in files}
    run(out, longer(), restart=True)
    assert {path: (backup / path).read_bytes() for path in files} == before
    with h5py.File(out / "fields.h5") as now, h5py.File(backup / "fields.h5") as then:
        assert len(now["frames"]) == len(then["frames"]) + 2


# --- other commands -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def torn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run in space, with a surface."""
    folder = tmp_path_factory.mktemp("torn") / "out"
    run(folder, changed(BAR, output={"surface": True}))
    return folder


def written(target: Path) -> list[tuple[tuple[str | Path, ...], list[str]]]:
    """Commands, and the files that they write into a folder."""
    return [
        (("mesh", target / "bar.toml", "-o", target / "a.vtu"), ["a.vtu"]),
        (("mesh", target / "bar.toml", "-o", target / "b.xdmf"), ["b.xdmf", "b.h5"]),
        (("render", "torn", *SMALL, "-o", target / "a.png"), ["a.png"]),
        (("render", "torn", *SMALL, "-o", target / "a.gif"), ["a.gif"]),
        (("render", "torn", *SMALL, "-o", target / "frames"), ["frames/frame_000000.png"]),
        (("report", "torn", "-o", target / "r.html"), ["r.html", "r/runs.csv"]),
        *(
            (("export", "torn", "--format", kind, "-o", target), [f"out_000000.{kind}"])
            for kind in ("ply", "obj", "glb")
        ),
        (("view", "torn", "-o", target / "v.html"), ["v.html"]),
    ]


@pytest.mark.parametrize("number", [0, 1, 2, *(pytest.param(n, marks=pytest.mark.slow) for n in (3, 4)), 5, 6, 7, 8, 9])
def test_commands_replace_links(tmp_path: Path, torn: Path, number: int) -> None:
    """Of files named with -o, and of others beside them; what they write is what they write elsewhere."""
    out = tmp_path / "target"
    out.mkdir()
    write_study(out / "bar.toml", BAR)
    words, names = written(out)[number]
    words = tuple(torn if word == "torn" else word for word in words)
    for name in names:
        (tmp_path / Path(name).name).write_text(WORDS)
        (out / name).parent.mkdir(exist_ok=True)
        (out / name).symlink_to(tmp_path / Path(name).name)
    done = fracsim_here(*words)
    assert done.returncode == 0, done.stderr
    for name in names:
        assert (tmp_path / Path(name).name).read_text() == WORDS
        assert not (out / name).is_symlink() and (out / name).stat().st_size > 50
    assert not [path for path in out.iterdir() if path.name.startswith(".")]


@pytest.mark.timeout(60)
@pytest.mark.parametrize("number", [0, 1, 2, 5, 8, *(pytest.param(n, marks=pytest.mark.slow) for n in (3, 6, 7))])
def test_commands_refuse_what_is_no_file(tmp_path: Path, torn: Path, number: int) -> None:
    out = tmp_path / "target"
    out.mkdir()
    write_study(out / "bar.toml", BAR)
    words, names = written(out)[number]
    words = tuple(torn if word == "torn" else word for word in words)
    pipe(out / names[-1] if "/" not in names[-1] else out / names[0])
    done = fracsim_here(*words)
    assert done.returncode == 2 and "is a named pipe, not a file" in done.stderr and "Traceback" not in done.stderr
    assert sorted(path.name for path in out.iterdir() if not path.is_dir()) == sorted(
        {"bar.toml", names[-1] if "/" not in names[-1] else names[0]}
    )


def test_a_picture_of_a_folder_that_somebody_gave(tmp_path: Path, torn: Path) -> None:
    """Its last.png is a link, its surface.pvd names other files: VTK would read any, by its ending."""
    out = tmp_path / "out"
    subprocess.run(["cp", "-r", torn, out], check=True)
    (tmp_path / "aunt.png").write_text(WORDS)
    (out / "last.png").symlink_to(tmp_path / "aunt.png")
    assert fracsim_here("render", out, *SMALL).returncode == 0
    assert (tmp_path / "aunt.png").read_text() == WORDS and not (out / "last.png").is_symlink()
    pvd, text = out / "surface.pvd", (out / "surface.pvd").read_text()
    for name in (
        "../part.vtu",
        "/tmp/part.vtu",
        "surface/../part.vtu",
        "surface/part.stl",
        "surface/surface_000000.pkl",
    ):
        pvd.write_text(text.replace("surface/surface_000000.vtu", name))
        done = fracsim_here("render", out)
        assert done.returncode == 2 and f"names the file {name}, which no run of fracsim writes" in done.stderr


def test_a_sweep_replaces_links(tmp_path: Path, precious: Path) -> None:
    out, bar = tmp_path / "out", write_study(tmp_path / "bar.toml", BAR)
    case = out / "end-0.01"
    case.mkdir(parents=True)
    link(case, precious, ["log.txt"])
    link(out, precious, ["sweep.csv"])
    assert swept_here(bar, "--set", "time.end=0.01", "-o", out).returncode == 0
    assert_untouched(precious)
    assert json.loads((case / "summary.json").read_text())["outcome"] == "done"
    assert "end-0.01" in (out / "sweep.csv").read_text()
