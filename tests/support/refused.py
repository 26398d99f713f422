"""Command lines that are refused, one after another on all ranks: what each rank's process would end with and say."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from mpi4py import MPI

from cases import fracsim_here


def main(path: str) -> None:
    """Those of a JSON file beside the target; rank 0 saves (cases, ranks) exit codes and what was said."""
    lines: list[list[str]] = json.loads(Path(path).with_name("lines.json").read_text())
    done = [fracsim_here(*line) for line in lines]
    found = MPI.COMM_WORLD.gather(([each.returncode for each in done], [each.stderr + each.stdout for each in done]))
    if found is not None:
        codes, said = zip(*found, strict=True)
        np.savez(path, codes=np.transpose(codes), said=np.transpose(said))


if __name__ == "__main__":
    main(sys.argv[1])
