"""summary.json: outcome, totals and timings of a run, over all of its restarts."""

from __future__ import annotations

import json
import resource
import sys
import time
from pathlib import Path
from typing import Any

from mpi4py import MPI

from ..errors import one_line
from ..mesh.parallel import sum_over_ranks
from ..timestepping.stepper import Stepper
from .atomic_write import replace_text, written


class Meter:
    """What a run has used so far: seconds by phase, wall and processor time, memory, steps that failed.

    Attributes:
        setup, output: s of this part of the run.
    """

    def __init__(self, comm: MPI.Comm, stepper: Stepper, began: float | None) -> None:
        """`began`: when the work on the scene began (perf_counter), now where it is None."""
        self._comm, self._stepper = comm, stepper
        self._began = time.perf_counter() if began is None else began
        self._cpu_began = time.process_time()
        self.setup, self.output = 0.0, 0.0
        self._earlier: dict[str, Any] = {"trouble": {}, "wall": 0.0, "cpu": 0.0, "memory": 0.0, "seconds": {}}

    def begin_steps(self) -> None:
        """The set-up is over."""
        self.setup = time.perf_counter() - self._began
        self._cpu_began = time.process_time()

    def read(self) -> dict[str, Any]:
        """Of all parts of the run, for `restore` and for summary.json; s and MiB (collective)."""
        earlier = self._earlier
        # of all ranks: processor time hardly feels other work
        cpu, memory = sum_over_ranks(self._comm, [time.process_time() - self._cpu_began, _peak_memory()])
        seconds = {"setup": self.setup, **self._stepper.phases, "output": self.output}
        return {
            "trouble": _sum(earlier["trouble"], self._stepper.failure_counts()),
            "wall": earlier["wall"] + time.perf_counter() - self._began,
            "cpu": earlier["cpu"] + float(cpu),
            "memory": max(earlier["memory"], float(memory)),
            "seconds": _sum(seconds, earlier["seconds"]),
        }

    def restore(self, monitors: dict[str, Any]) -> None:
        """Go on from what `read` gave."""
        self._earlier = {name: monitors[name] for name in self._earlier}


# what a run went on in spite of; a step that was halved and then taken is no trouble
_TROUBLE = {
    "unbalanced_steps": "steps that ended out of balance, for the body weakened by a break had no solution",
    "linear_failures": "linear solves that failed and were taken as no correction",
    "cells_not_finite": "cells crushed flat, whose stress was no number and counted as none",
}


def trouble_in_words(trouble: dict[str, int]) -> str:
    """One sentence; empty where nothing was wrong."""
    found = [f"{trouble[name]} {words}" for name, words in _TROUBLE.items() if trouble.get(name)]
    return f"the run went on in spite of {'; '.join(found)} (counted in summary.json)" if found else ""


def _sum[Number: (int, float)](first: dict[str, Number], second: dict[str, Number]) -> dict[str, Number]:
    """Sums by name."""
    return {name: first.get(name, 0) + second.get(name, 0) for name in dict.fromkeys([*first, *second])}


def write_summary(comm: MPI.Comm, folder: Path, summary: dict[str, Any]) -> None:
    """Write summary.json in one go. Raises CannotWrite (collective)."""
    path = folder / "summary.json"
    written(comm, path, lambda: replace_text(path, json.dumps(summary, indent=2) + "\n"))


def say(comm: MPI.Comm, notes: list[str]) -> None:
    """Tell the user, once."""
    for note in notes if comm.rank == 0 else ():
        print(f"fracsim: note: {one_line(note)}", file=sys.stderr)


def _peak_memory() -> float:
    """MiB of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
