"""Ranks that wait for the first one sleep, and lend it their cores.

All others analyse what was struck when they are asked to; for most of a run they have nothing to do. A rank that waits
in MPI spins. These look for a message a thousand times a second, and a second thread of rank 0 goes where they would
be.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any, Self

from mpi4py import MPI

PAUSE = 1e-3  # s
TOLD, LENT = 1, 2  # tags


class Helper:
    """A second thread."""

    def __init__(self, cores: set[int]) -> None:
        """On some of these cores."""
        self._thread = ThreadPoolExecutor(1, initializer=os.sched_setaffinity, initargs=(0, cores))

    def both(self, mine: Callable[[], Any], other: Callable[[], Any]) -> tuple[Any, Any]:
        """Do both at once, the second in that thread: what gives the interpreter free."""
        others = self._thread.submit(other)
        try:
            own = mine()
        finally:
            wait([others])
        return own, others.result()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._thread.shutdown()


def tell(comm: MPI.Comm, message: Any) -> None:
    """All others, on rank 0."""
    for request in [comm.isend(message, rank, TOLD) for rank in range(1, comm.size)]:
        request.wait()


def told(comm: MPI.Comm) -> Any:
    """What rank 0 says next."""
    while not comm.iprobe(source=0, tag=TOLD):
        time.sleep(PAUSE)
    return comm.recv(source=0, tag=TOLD)


def lend(comm: MPI.Comm) -> None:
    """On all others, before they wait."""
    comm.send((MPI.Get_processor_name(), _cores()), 0, LENT)


def lent(comm: MPI.Comm) -> Helper | None:
    """On rank 0: a thread on cores of others on this machine; None where nobody waits there."""
    offers = [comm.recv(source=rank, tag=LENT) for rank in range(1, comm.size)]
    near = [cores for name, cores in offers if name == MPI.Get_processor_name()]
    cores = set[int]().union(*near)
    return Helper(cores) if len(cores | _cores()) > 1 and near else None


def _cores() -> set[int]:
    """That this process may be on; none where the system does not tell."""
    return os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set()
