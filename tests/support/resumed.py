"""A run that goes on, beside one that was stopped and resumed."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from fracsim.deformable_run import Run
from fracsim.scene import build_scene

from .scenes import make_study


def going_stopped_resumed(tables: dict[str, Any], path: Path, before: int, after: int) -> tuple[Run, int, Run]:
    """A run after `before` + `after` steps, how many edges were broken after `before`, and a run that went on from the
    checkpoint that the first one wrote there; on one rank."""

    def begun(folder: str, *, restart: bool = False) -> Run:
        return Run(build_scene(MPI.COMM_SELF, make_study(**tables)), path / folder, restart=restart)

    going = begun("going")
    _step(going, before)
    going.checkpoint()
    broken = going.breaks.counts[0]
    shutil.copytree(path / "going", path / "stopped")
    again = begun("stopped", restart=True)
    _step(going, after)
    _step(again, after)
    return going, broken, again


def assert_alike(again: Run, going: Run, tolerance: float) -> None:
    """The same cracks, and the same energies and forces to a tolerance."""
    assert again.breaks.counts == going.breaks.counts
    for name in ("work", "dissipated", "elastic"):
        assert getattr(again.state, name) == pytest.approx(getattr(going.state, name), rel=tolerance)
    np.testing.assert_allclose(again.scene.probes(), going.scene.probes(), atol=tolerance)


def _step(run: Run, count: int) -> None:
    for _ in range(count):
        run.step()
