"""File summary.json: outcome, totals and timings of a run, over all of its restarts."""

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
from .atomic_write import replace_text, write_on_root


class ResourceMeter:
    """Resources that a run has used: wall and processor time, time by phase, memory, and failed solves.

    Attributes:
        setup_seconds: time of the set-up since the start or restart, s.
        output_seconds: time spent on output since the start or restart, s.
    """

    def __init__(self, comm: MPI.Comm, stepper: Stepper, began: float | None) -> None:
        """Start the clock.

        Args:
            comm: the ranks of the run.
            stepper: its counters and times are read.
            began: `time.perf_counter()` at the start of the work on the scene; None: now.
        """
        self._comm, self._stepper = comm, stepper
        self._began = time.perf_counter() if began is None else began
        self._cpu_began = time.process_time()
        self.setup_seconds, self.output_seconds = 0.0, 0.0
        self._earlier: dict[str, Any] = {"trouble": {}, "wall": 0.0, "cpu": 0.0, "memory": 0.0, "seconds": {}}

    def start_stepping(self) -> None:
        """Record the end of the set-up. Processor time counts from here."""
        self.setup_seconds = time.perf_counter() - self._began
        self._cpu_began = time.process_time()

    def read_totals(self) -> dict[str, Any]:
        """Totals over all restarts, times in s and memory in MiB (collective); also for `from_checkpoint`."""
        earlier = self._earlier
        # processor time hardly depends on other work of the machine
        cpu, memory = sum_over_ranks(self._comm, [time.process_time() - self._cpu_began, _peak_memory()])
        seconds = {"setup": self.setup_seconds, **self._stepper.phases, "output": self.output_seconds}
        return {
            "trouble": _sum_by_name(earlier["trouble"], self._stepper.failure_counts()),
            "wall": earlier["wall"] + time.perf_counter() - self._began,
            "cpu": earlier["cpu"] + float(cpu),
            "memory": max(earlier["memory"], float(memory)),
            "seconds": _sum_by_name(seconds, earlier["seconds"]),
        }

    def from_checkpoint(self, monitors: dict[str, Any]) -> None:
        """Continue from the totals of `read_totals`."""
        self._earlier = {name: monitors[name] for name in self._earlier}


# Events despite which a run continued. A step that was halved and then succeeded is not among them.
_EVENT_TEXTS = {
    "unbalanced_steps": ("step", "that ended out of balance, for the body weakened by a break had no solution"),
    "rough_solutions": (
        "step",
        "with |r| above 1e-4 of the forces, as the first guess was off by far more (smaller steps have better guesses)",
    ),
    "linear_failures": ("linear solve", "without a solution, taken as no correction"),
    "cells_not_finite": ("cell", "crushed flat, with a stress that is no number and counts as none"),
}


def irregular_event_text(trouble: dict[str, int]) -> str:
    """Sentence about the counters of trouble, by name; empty if all are 0."""
    phrases = [
        f"{count} {noun}{'s' if count > 1 else ''} {words}"
        for name, (noun, words) in _EVENT_TEXTS.items()
        if (count := trouble.get(name, 0))
    ]
    return f"the run went on in spite of {'; '.join(phrases)} (counted in summary.json)" if phrases else ""


def _sum_by_name[Number: (int, float)](first: dict[str, Number], second: dict[str, Number]) -> dict[str, Number]:
    """Sums of the values with the same name."""
    return {name: first.get(name, 0) + second.get(name, 0) for name in dict.fromkeys([*first, *second])}


def write_summary(comm: MPI.Comm, folder: Path, summary: dict[str, Any]) -> None:
    """Write summary.json as a whole. Raises CannotWrite (collective)."""
    path = folder / "summary.json"
    write_on_root(comm, path, lambda: replace_text(path, json.dumps(summary, indent=2) + "\n"))


def print_notes(comm: MPI.Comm, notes: list[str]) -> None:
    """Print notes to stderr on rank 0, each on one line."""
    for note in notes if comm.rank == 0 else ():
        print(f"fracsim: note: {one_line(note)}", file=sys.stderr)


def _peak_memory() -> float:
    """Largest resident memory of this process so far, MiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
