"""Runs that are exported: a bar in three pieces, and a bar that breaks on a floor as rigid pieces."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from mpi4py import MPI

from fracsim.deformable_run import run_study
from fracsim.output.surface.body_surface import BodySurface
from fracsim.output.surface.vtk_files import SurfaceFiles
from fracsim.study import Study

from .solids import lattice, patterns, separated

PIECES = (0, 1, 2)


def broken_bar(folder: Path) -> Path:
    """A bar of 6 x 1 x 1 m, whole at first, then in three pieces that lie far away from the origin."""
    mesh = lattice(6, 1, 1)
    surface, files = BodySurface(mesh, 1.0), SurfaceFiles(folder, 3)
    x, none = mesh.points, np.zeros_like(mesh.points)
    files.write_frame(surface.make_frame(0.0, none, none))
    part = np.searchsorted([2.5, 3.5], x[:, 0])
    surface.update(patterns(surface.skeleton, separated(surface.skeleton, part)))
    apart = np.array([[0.0, 0, 0], [0.5, 0.25, 0], [40.0, 0, 8.0]])[part]
    files.write_frame(surface.make_frame(1.0, apart, none))
    (folder / "study.toml").write_text('[output]\nlook = "bread"\n')
    return folder


def dropped_bar(folder: Path) -> Path:
    """A bar that falls askew on a floor, breaks there and goes on as rigid pieces."""
    tables = {
        "title": "dropped", "mesh": {"builder": "box", "size": [0.6, 0.2, 0.2], "h": 0.1},
        "material": {"energy": "linear", "young": 1e10, "poisson": 0.2, "density": 2000.0},
        "fracture": {"strength": 3e5, "kernel": "neighbours"}, "brittle": {"surfaces": 4}, "contact": {"friction": 0.4},
        "load": {"gravity": [0.0, 0.0, -9.81]},
        "body": [{"position": [0.0, 0.0, 0.05], "rotation": [0.0, -0.1, 0.0], "velocity": [0.0, 0.0, -4.0]}],
        "obstacle": [{"name": "floor", "shape": "plane", "at": [0.0] * 3, "normal": [0.0, 0.0, 1.0], "friction": 0.5}],
        "time": {"scheme": "rigid", "step": 2e-3, "end": 0.06}, "output": {"every": 5, "picture": False},
    }  # fmt: skip
    run_study(MPI.COMM_SELF, Study.model_validate(tables), folder)
    return folder
