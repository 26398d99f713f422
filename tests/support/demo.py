"""The demo on a coarse mesh, and what docs/output.md tells users of ParaView to do with it."""

from __future__ import annotations

import re
from pathlib import Path

from mpi4py import MPI

from fracsim.deformable_run import run_study
from fracsim.study.reader import load_study

OUTPUT_PAGE = Path(__file__).parents[2] / "docs" / "output.md"
COARSE = ["mesh.h=0.025", "time.step=0.01", "fracture.radius=0.025", "output.interval=0.15", "output.picture=false"]


def run_demo(folder: Path) -> None:
    """The loaf, torn in two, in `folder`."""
    run_study(MPI.COMM_SELF, load_study("loaf", COARSE), folder)


def threshold_damage() -> float:
    """The damage up to which the threshold of the page keeps cells."""
    found = re.search(r"\*Threshold\*\s+`damage` from 0 to ([0-9.]+)", OUTPUT_PAGE.read_text())
    assert found is not None
    return float(found.group(1).rstrip("."))
