"""A body that is strained evenly, in the files of a run: its stress in closed form."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from cases import BAR, study
from fracsim.deformable_run import Run
from fracsim.scene import build_scene

# u = A X, with six unlike strains
A = 1e-3 * np.array([[3.0, 1.0, -0.5], [0.4, -2.0, 0.7], [0.9, -0.3, 1.5]])


def stress() -> npt.NDArray[np.float64]:
    """(3, 3) Pa, by Hooke's law: lambda tr(e) I + 2 mu e, e the symmetric part of A."""
    young, poisson = BAR["material"]["young"], BAR["material"]["poisson"]
    lmbda, mu = young * poisson / ((1 + poisson) * (1 - 2 * poisson)), young / (2 * (1 + poisson))
    strain = (A + A.T) / 2
    return np.asarray(lmbda * np.trace(strain) * np.eye(3) + 2 * mu * strain)


def strained(folder: Path) -> None:
    """A run with one frame, at u = A X, in `folder`."""
    fields = ["stress", "von_mises", "region"]
    scene = build_scene(MPI.COMM_SELF, study(BAR, output={"fields": fields, "surface": True}))
    run = Run(scene, folder)
    run.state = replace(run.state, u=(scene.domain.nodes @ A.T).ravel())
    scene.balance.set_displacement(run.state.u)
    run.write_frame()
    run.history.close()
