"""Two runs in one folder at about the same time: one is what it would be alone, the other ends with a message."""

from __future__ import annotations

import random
import time
from pathlib import Path

from fracsim.errors import Exit

from . import resumed
from .corpus import RUNS, write
from .trial import ended, expect, started, words

prepare = resumed.prepare


def attack(number: int, chance: random.Random, place: Path) -> str:
    """One pair; the second begins anew, goes on, or overwrites."""
    name, ranks = chance.choice(sorted(RUNS)), chance.choice((1, 1, 2))
    study, out = write(place / "study.toml", RUNS[name]), place / "out"
    how = chance.choice(([], ["--restart"], ["--overwrite"]))
    first = started(words("run", study, "-o", out, ranks=ranks), place / "first")
    time.sleep(chance.choice((0.0, chance.uniform(0.0, 3.0))))
    second = started(words("run", study, "-o", out, *how), place / "second")
    ends = [ended(process, place / said) for process, said in ((first, "first"), (second, "second"))]
    for each in ends:
        each.expect(Exit.DONE, Exit.BAD_INPUT)
    done = [each.code == Exit.DONE for each in ends]
    expect(any(done), f"neither ran: {ends[0].said[-400:]} | {ends[1].said[-400:]}")
    resumed.expect_whole(name, ranks if done[0] else 1, out)
    return "one after the other" if all(done) else f"the {'second' if done[0] else 'first'} was refused"
