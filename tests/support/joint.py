"""Modules of checks in one start: `mpirun -n 2 python -m mpi4py -m support.joint FOLDER support.rolling ...`."""

from __future__ import annotations

import gc
import sys
from importlib import import_module
from pathlib import Path

from mpi4py import MPI

from .ranks import target_of


def main(folder: str, modules: list[str]) -> None:
    """What `main(path)` of each saves, one after another."""
    for module in modules:
        import_module(module).main(str(target_of(module, MPI.COMM_WORLD.size, Path(folder))))
        gc.collect()  # what frees communicators, on all ranks at once


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
