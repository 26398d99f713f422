"""Links, pipes and folders in the place of what a run writes: a message or a run, and no other file is touched."""

from __future__ import annotations

import os
import random
import shutil
from pathlib import Path

from fracsim.errors import Exit

from .checkpoints import stopped
from .corpus import contents
from .trial import call, expect

NAMES = ("study.toml", "history.csv", "fields.xdmf", "fields.h5", "surface.pvd", "pieces.csv", "summary.json",
         "last.png", "surface", "checkpoint", "checkpoint/state.h5", "lock", "surface/0000.vtu")  # fmt: skip
_STOPPED: dict[str, Path] = {}


def prepare(folder: Path) -> None:
    """A run that was stopped, to go on from, of two kinds."""
    for name in ("strip", "rigid"):
        _STOPPED[name] = stopped(name, folder)


def attack(number: int, chance: random.Random, place: Path) -> str:
    """One to three names of a folder that is empty, or of a run that was stopped."""
    os.chdir(place)
    name, fresh = chance.choice(sorted(_STOPPED)), chance.random() < 0.5
    precious, out = place / "precious", place / "out"
    (precious / "folder").mkdir(parents=True)
    (precious / "file").write_text("precious\n")
    (precious / "data.h5").write_bytes((_STOPPED[name] / "out" / "checkpoint" / "state.h5").read_bytes())
    if fresh:
        out.mkdir()
    else:
        shutil.copytree(_STOPPED[name] / "out", out)
    for _ in range(chance.choice((1, 1, 2, 3))):
        _put(out / (chance.choice(NAMES) + chance.choice(("", ".new"))), chance, precious)
    before = contents(precious)
    how = [] if fresh else chance.choice((["--restart"], ["--overwrite"]))
    done = call("run", _STOPPED[name] / "study.toml", "-o", out, "--wall-limit", 20, *how)
    done.expect(Exit.DONE, Exit.BAD_INPUT, Exit.CANNOT_WRITE)
    expect(contents(precious) == before, f"what links lead to was written: {done.said[-500:]}")
    if done.code == Exit.DONE:
        return "ran"
    expect("fracsim: " in done.said, "no message")
    return "refused" if done.code == Exit.BAD_INPUT else "could not write"


def _put(at: Path, chance: random.Random, precious: Path) -> None:
    """Something else in the place of a file."""
    at.parent.mkdir(exist_ok=True)
    if at.is_symlink() or at.is_file():
        at.unlink()
    elif at.is_dir():
        shutil.rmtree(at)
    match chance.randrange(6):
        case 0:
            at.symlink_to(precious / "file")
        case 1:
            at.symlink_to(precious / "folder")
        case 2:
            at.symlink_to(precious / "nothing")
        case 3:
            os.mkfifo(at)
        case 4:
            at.mkdir()
        case _:
            at.symlink_to(precious / "data.h5")
