"""The half-notched beam of concrete bent step by step in the test's own process."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from fracsim.studies.evidence.cohesive_beam import DEPTH, THICKNESS, beam_study

from .scenes import Walk, make_scene

Values = npt.NDArray[np.float64]


def bend(
    folder: Path, cells: float, seed: int, sinks: float, steps: int, *, notch: bool, follow: Callable[[Walk], bool]
) -> tuple[Any, Walk, Values, Values]:
    """Bend `beam_study`; return the scene, its walk, deflection (n,), m, and load (n,), N.

    Args:
        folder, cells, seed, sinks, steps, notch: those of `beam_study`.
        follow: called after each step; false ends the run.
    """
    scene, walk = make_scene(**beam_study(folder, cells, seed, sinks, steps, notch=notch))
    top = np.argmin(np.hypot(*(scene.domain.nodes - [0.0, DEPTH]).T))
    way, load = [], []
    while not scene.ended(walk.state):
        walk.advance()
        way.append(walk.t * sinks)
        load.append(-THICKNESS * scene.balance.stress.assemble_forces().reshape(-1, 2)[top, 1])
        if not follow(walk):
            break
    return scene, walk, np.array(way), np.array(load)
