"""What is raised on one rank and must be raised on all: each line of the answer is what this rank caught."""

import sys
from collections.abc import Callable
from threading import Lock

import numpy as np
from mpi4py import MPI

from fracsim.mechanics.jit import compile_collectively
from fracsim.mesh.parallel import from_root, on_root

comm = MPI.COMM_WORLD


class Unsendable(Exception):
    """An exception that cannot be pickled."""

    def __init__(self) -> None:
        super().__init__("has a lock")
        self.lock = Lock()


def fails(error: BaseException) -> Callable[[], None]:
    def work() -> None:
        raise error

    return work


def fails_on_one() -> int:
    """A kernel that the last rank alone cannot load, after the collective part of a compilation."""
    comm.barrier()
    if comm.rank == comm.size - 1:
        raise RuntimeError("the library cannot be loaded")
    return 1


caught = []
for attempt in (
    lambda: on_root(comm, fails(OSError(28, "No space left on device"))),
    lambda: from_root(comm, fails(KeyError("gone"))),
    lambda: on_root(comm, fails(SystemExit(4))),
    lambda: on_root(comm, fails(Unsendable())),
    lambda: compile_collectively(comm, fails_on_one),
):
    try:
        attempt()
        caught.append("nothing")
    except BaseException as error:
        caught.append(f"{type(error).__name__}: {error}")
    comm.barrier()
everywhere = comm.gather(caught)
if everywhere is not None:
    np.savez(sys.argv[1], caught=np.array(everywhere))
