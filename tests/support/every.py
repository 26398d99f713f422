"""What is compared between ranks, by one start: `mpirun -n 2 python -m mpi4py -m support.every OUT.npz`."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from mpi4py import MPI

from . import driven, hinged, parting, quadratic, shattered, tearing, thrown, tip_rows, torn


def main(path: str) -> None:
    """All checks; rank 0 saves. Files of surfaces lie beside the arrays."""
    found = torn.compared(Path(path).with_suffix("")) | shattered.compared() | driven.compared() | tearing.compared()
    found |= quadratic.compared() | parting.compared() | thrown.compared() | hinged.compared()
    found |= tip_rows.compared(Path(path).with_suffix(".tips"))
    if MPI.COMM_WORLD.rank == 0:
        np.savez(path, **found)


if __name__ == "__main__":
    main(sys.argv[1])
