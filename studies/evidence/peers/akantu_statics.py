"""Akantu on the meshes of the linear static cases, with linear and quadratic cells: accuracy and processor time.

    python -m fracsim.studies.evidence.peers.akantu_statics --case cantilever --h 0.025 --order 1 -o figures.json

Writes the figures of precision/linear_statics.py and precision/brazilian_disk.py, and `seconds`: processor time of the
single solve with its assembly and factorisation.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from ..precision import brazilian_disk, linear_statics
from .akantu import AkantuProcess, Values, problem_arrays

CASES = ("cantilever", "plate", "disk")


def case_study(case: str, h: float, order: int) -> dict[str, Any]:
    """Study of a case with cells of size h and elements of some order."""
    if case == "disk":
        return brazilian_disk.pressed_disk(round(brazilian_disk.RADIUS / h), order)
    return linear_statics.STUDIES[case](h, order=order)


def case_figures(case: str, problem: dict[str, Any], u: Values) -> dict[str, float]:
    """Figures of the displacement (nodes, d), m, as the group precision measures them."""
    if case == "disk":
        frame = {"points": problem["points"], "cells": problem["cells"], "displacement": u}
        return brazilian_disk.centre_errors(frame | {"stress": plane_stress(problem, u)})
    work = float((problem["force"] * u).sum())
    end = (
        linear_statics.TRACTION * linear_statics.DEPTH**2
        if case == "cantilever"
        else linear_statics.PULL * linear_statics.SIDE
    )
    return {"deflection": work / end}


def plane_stress(problem: dict[str, Any], u: Values) -> Values:
    """Plane stress (cells, 4) xx, xy, yx, yy, Pa, from the corners of cells, exact for linear cells."""
    X, values = (item[problem["cells"][:, :3]] for item in (problem["points"], u))
    gradient = np.linalg.solve(X[:, 1:] - X[:, :1], values[:, 1:] - values[:, :1]).swapaxes(1, 2)
    strain = (gradient + gradient.swapaxes(1, 2)) / 2
    young, poisson = problem["young"], problem["poisson"]
    trace = poisson / (1 - poisson) * np.einsum("cii->c", strain)
    stress = young / (1 + poisson) * (strain + trace[:, None, None] * np.eye(2))
    return np.asarray(stress.reshape(-1, 4))


def main() -> None:
    """Solve one case and write the figures."""
    from mpi4py import MPI

    from ....scene import build_scene
    from ....study.reader import validate

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--case", choices=CASES, required=True)
    parser.add_argument("--h", type=float, required=True, help="cell size, m")
    parser.add_argument("--order", type=int, choices=(1, 2), default=1)
    parser.add_argument("-o", "--out", type=Path, required=True)
    given = parser.parse_args()
    study = case_study(given.case, given.h, given.order)
    problem = problem_arrays(build_scene(MPI.COMM_WORLD, validate(study, given.case)), 0.0)
    with tempfile.TemporaryDirectory() as folder:
        theirs = AkantuProcess(problem, Path(folder))
        theirs.step(1.0)
        u = theirs.end()
    figures = case_figures(given.case, problem, u)
    given.out.write_text(json.dumps(figures | {"seconds": theirs.cpu[0]}) + "\n")


if __name__ == "__main__":
    main()
