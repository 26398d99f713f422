"""A run that goes on, beside one that was stopped and resumed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from fracsim.run import Run
from fracsim.scene import build_scene

from .scenes import make_study


def going_stopped_resumed(tables: dict[str, Any], path: Path, before: int, after: int) -> tuple[Run, Run, Run]:
    """One run after `before` + `after` steps, one that was stopped after `before`, and what resumed it; on one rank."""

    def begun(folder: str, *, restart: bool = False) -> Run:
        return Run(build_scene(MPI.COMM_SELF, make_study(**tables)), path / folder, restart=restart)

    going, stopped = begun("going"), begun("stopped")
    _step((going, stopped), before)
    stopped.checkpoint()
    again = begun("stopped", restart=True)
    _step((going, again), after)
    return going, stopped, again


def assert_alike(again: Run, going: Run, tolerance: float) -> None:
    """The same cracks, and the same energies and forces to a tolerance."""
    assert again.breaks.figures == going.breaks.figures
    for name in ("work", "dissipated", "elastic"):
        assert getattr(again.state, name) == pytest.approx(getattr(going.state, name), rel=tolerance)
    np.testing.assert_allclose(again.scene.probes(), going.scene.probes(), atol=tolerance)


def _step(runs: tuple[Run, Run], count: int) -> None:
    for run in runs:
        for _ in range(count):
            run.step()
