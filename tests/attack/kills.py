"""SIGKILL at a random moment: of one process, of mpirun, or of one of its ranks. All processes end; what is left goes
on to the same result."""

from __future__ import annotations

import os
import random
import signal
import time
from contextlib import suppress
from pathlib import Path

from . import resumed
from .corpus import RUNS, write
from .trial import alive, descendants, end_all, ended, expect, started, words

prepare = resumed.prepare
LINGER = 20.0  # s that processes have to end in


def attack(number: int, chance: random.Random, place: Path) -> str:
    """One run."""
    name, ranks = chance.choice(sorted(RUNS)), chance.choice((1, 2))
    study, out = write(place / "study.toml", RUNS[name]), place / "out"
    process = started(words("run", study, "-o", out, ranks=ranks), place / "killed")
    # a third while it begins, the others once it has a checkpoint
    wait = chance.uniform(0.0, 1.5)
    if chance.random() < 2 / 3:
        deadline = time.monotonic() + 30
        while not (out / "checkpoint" / "state.h5").exists() and process.poll() is None and time.monotonic() < deadline:
            time.sleep(0.01)
        wait /= 2
    time.sleep(wait)
    below = descendants(process.pid)
    target = chance.choice([process.pid, *below]) if ranks > 1 else process.pid
    with suppress(ProcessLookupError):
        os.kill(target, signal.SIGKILL)
    ended(process, place / "killed", LINGER * 2)
    deadline = time.monotonic() + LINGER
    while (left := alive(below)) and time.monotonic() < deadline:
        time.sleep(0.05)
    if left:
        end_all(process.pid)
        for pid in left:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
    expect(not left, f"{len(left)} processes of {ranks} ranks were left, {LINGER:g} s after a kill of "
                     f"{'mpirun' if target == process.pid else 'a rank'}")  # fmt: skip
    how = "had ended" if resumed.outcome(out) == "done" else resumed.go_on(study, out, ranks, place)
    resumed.expect_whole(name, ranks, out)
    return how
