"""File systems that are full at a random moment: exit 5 with what is left, and with room again the same result.

Where file systems may be mounted, as root, one in memory; else files may only grow so long.
"""

from __future__ import annotations

import random
import resource
import subprocess
from contextlib import suppress
from pathlib import Path

from fracsim.errors import Exit

from . import resumed
from .corpus import RUNS, write
from .trial import Ended, ended, expect, run, started, words

prepare = resumed.prepare


def attack(number: int, chance: random.Random, place: Path) -> str:
    """One run."""
    name, ranks = chance.choice(sorted(RUNS)), chance.choice((1, 1, 2))
    study, disk = write(place / "study.toml", RUNS[name]), place / "disk"
    disk.mkdir()
    used = sum(path.stat().st_size for path in resumed.whole(name, ranks).rglob("*") if path.is_file())
    size = int(chance.uniform(0.02, 0.9) * used)
    out = disk / "out"
    mounted = _mount(disk, f"size={max(size >> 12, 2) << 12}")
    try:
        full = _run(study, out, ranks, place, None if mounted else size // 8)
        if full.code == Exit.DONE:
            return "had room"
        full.expect(Exit.CANNOT_WRITE)
        expect("could not write" in full.said or "cannot write" in full.said, f"nothing says what: {full.said[-800:]}")
        state = out / "checkpoint" / "state.h5"
        named = "go on with --restart" in full.said
        expect(named == state.exists() or "here is no checkpoint" in full.said, f"what is left: {full.said[-800:]}")
        if mounted:
            _mount(disk, "remount,size=1g")
        how = resumed.go_on(study, out, ranks, place)
        resumed.expect_whole(name, ranks, out)
        return f"{'' if mounted else 'limit on files, '}{how}"
    finally:
        if mounted:
            subprocess.run(["umount", "--lazy", str(disk)], check=False)


def _run(study: Path, out: Path, ranks: int, place: Path, longest: int | None) -> Ended:
    command = words("run", study, "-o", out, ranks=ranks)
    if longest is None:
        return run(command, place, "full")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (longest, before[1]))
    try:
        process = started(command, place / "full")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    return ended(process, place / "full")


def _mount(disk: Path, options: str) -> bool:
    """Whether there is a file system of that size now."""
    with suppress(OSError):
        command = ["mount", "-t", "tmpfs", "-o", options, "none", str(disk)]
        return subprocess.run(command, capture_output=True, check=False).returncode == 0
    return False
