"""Akantu as a separate process; environment variable AKANTU_PYTHON names its Python.

    python3.11 -m venv DIR && DIR/bin/pip install akantu scipy && export AKANTU_PYTHON=DIR/bin/python

Its wheel (5.0.7) is for Python 3.8 to 3.11 and includes a serial MUMPS. Akantu receives mesh, constrained dofs and
nodal forces, and assembles stiffness and mass itself.
"""

from __future__ import annotations

import json
import subprocess
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from . import working_python

VARIABLE = "AKANTU_PYTHON"
ABSENT = f"Akantu is not installed here ({VARIABLE} names no Python that can import it)."
WORKER = Path(__file__).with_name("akantu_worker.py")
MIDPOINT_CORNERS = {2: ((0, 1), (1, 2), (2, 0)), 3: ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))}  # of its middles
Values = npt.NDArray[np.float64]


@cache
def akantu_python() -> str | None:
    """Python that can import Akantu; None if there is none."""
    return working_python(VARIABLE, "import akantu")


def problem_arrays(scene: Any, step: float) -> dict[str, Any]:
    """A linear scene on one rank as arrays: constrained dofs stay 0, `force` (N) is that at the end."""
    domain, balance, study = scene.domain, scene.balance, scene.study
    rest, size = np.zeros(balance.owned_dof_count), domain.dim
    balance.evaluate_at(study.time.end, rest, rest)
    held = np.zeros(balance.owned_dof_count, bool)
    held[balance.motion.owned_dofs] = True
    force = np.where(held, 0.0, -balance.update_forces())
    material = study.material
    return {
        "points": domain.nodes, "cells": akantu_cell_nodes(domain), "held": held.reshape(-1, size),
        "force": force.reshape(-1, size), "step": step, "plane_stress": material.plane == "stress" and size == 2,
        "young": material.young, "poisson": material.poisson, "density": material.density,
    }  # fmt: skip


def akantu_cell_nodes(domain: Any) -> npt.NDArray[np.int64]:
    """Nodes (cells, n) in Akantu's order: positive volume, edge midpoints after corners."""
    from ....mesh.simplices import local_edges

    size, cells = domain.dim, np.asarray(domain.all_cell_nodes, np.int64)
    ours = np.sort(local_edges(size), axis=1)

    def middle(a: int, b: int) -> int:
        return size + 1 + int(np.flatnonzero((ours == sorted((a, b))).all(axis=1))[0])

    def row(turned: list[int]) -> list[int]:
        if cells.shape[1] == size + 1:
            return turned
        return turned + [middle(turned[a], turned[b]) for a, b in MIDPOINT_CORNERS[size]]

    straight = list(range(size + 1))
    corners = domain.nodes[cells[:, : size + 1]]
    inside_out = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0
    return np.where(inside_out[:, None], cells[:, row([1, 0, *straight[2:]])], cells[:, row(straight)])


class AkantuProcess:
    """A body in an Akantu process.

    Attributes:
        wall, cpu: seconds of each step.
    """

    def __init__(self, problem: dict[str, Any], folder: Path) -> None:
        """Start the process on a problem; `folder` is for the files exchanged.

        Raises:
            RuntimeError: Akantu is not installed.
        """
        python = akantu_python()
        if python is None:
            raise RuntimeError(ABSENT)
        self.wall: list[float] = []
        self.cpu: list[float] = []
        self._result = folder / "akantu-result.npz"
        np.savez(folder / "akantu-problem.npz", **problem)
        command = [python, "-I", str(WORKER), str(folder / "akantu-problem.npz"), str(self._result)]
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def step(self, share: float) -> None:
        """Advance by a step to this share of the load."""
        assert self._process.stdin is not None and self._process.stdout is not None
        print(share, file=self._process.stdin, flush=True)
        for line in self._process.stdout:
            if line.startswith("{"):
                seconds = json.loads(line)
                self.wall.append(seconds["wall"])
                self.cpu.append(seconds["cpu"])
                return
        raise RuntimeError(f"Akantu ended with code {self._process.wait()}")

    def end(self) -> Values:
        """End the process and return its displacement (nodes, d), m."""
        self._process.communicate()
        if self._process.returncode:
            raise RuntimeError(f"Akantu ended with code {self._process.returncode}")
        with np.load(self._result) as results:
            return np.asarray(results["displacement"], np.float64)
