"""Signals that a run heeds, at a random moment: exit 4 and a checkpoint, or nothing that was begun; then the same."""

from __future__ import annotations

import os
import random
import signal
import time
from contextlib import suppress
from pathlib import Path

from fracsim.errors import Exit

from . import resumed
from .corpus import RUNS, write
from .trial import ended, expect, started, words

prepare = resumed.prepare
HEEDED = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGXCPU, signal.SIGQUIT)
INTERRUPTED = 130  # by SIGINT before a run begins
FIRST = 0.3  # s in which Python itself begins, which then ends as processes do


def attack(number: int, chance: random.Random, place: Path) -> str:
    """One run, on one rank: what mpirun does with signals is its own matter."""
    name, which = chance.choice(sorted(RUNS)), chance.choice(HEEDED)
    study, out = write(place / "study.toml", RUNS[name]), place / "out"
    process = started(words("run", study, "-o", out), place / "stopped")
    waited = chance.uniform(FIRST, 4.0)
    time.sleep(waited)
    with suppress(ProcessLookupError):
        os.kill(process.pid, which)
    done = ended(process, place / "stopped", 40.0)
    expect("Traceback" not in done.said, f"{which.name} after {waited:.2f} s: {done.said[-1000:]}")
    if done.code == Exit.STOPPED:
        begun = (out / "history.csv").exists()
        expect(which.name in done.said, f"{which.name} is not named: {done.said[-500:]}")
        expect(not begun or (out / "checkpoint" / "state.h5").exists(), f"no checkpoint after {which.name}")
    elif done.code != Exit.DONE:
        # before it could listen
        expect(done.code in (-which, INTERRUPTED) and not (out / "history.csv").exists(),
               f"exit {done.code} after {which.name} at {waited:.2f} s: {done.said[-800:]}")  # fmt: skip
    how = "had ended" if resumed.outcome(out) == "done" else resumed.go_on(study, out, 1, place)
    resumed.expect_whole(name, 1, out)
    return how
