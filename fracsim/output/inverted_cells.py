"""Cells that are turned inside out: looked for at every frame, told at the end."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..mechanics.stress import Stress
from ..mesh.parallel import sum_over_ranks

if TYPE_CHECKING:
    from ..fracture.fracture_pass import Breaking

FLAT = 1e-6  # a cell with no more than this share of its volume left is none


class InvertedCells:
    """The least J = det F of the whole cells, over the frames of a run.

    No body turns inside out. An energy that lets it (stvk, corotated), or a boundary that forces it, leads to an answer
    that balances all forces and is none all the same; so it has to be said. Cells with broken edges may lie in any way,
    and the linear energy does not know of J.

    Attributes:
        least: smallest J so far, 1 at rest.
        count: cells that are flat or turned, at the worst frame.
        since: s of the first such frame.
    """

    def __init__(self, stress: Stress, fracture: Breaking | None = None) -> None:
        """`fracture`: what breaks, which knows the damaged cells."""
        self._stress, self._domain = stress, stress.domain
        self._graph = fracture.graph if fracture is not None else None
        self.least, self.count, self.since = 1.0, 0, 0.0

    def look(self, t: float) -> None:
        """Note the present deformation, at t s (collective)."""
        if self._stress.material.energy.linear:
            return
        domain = self._domain
        cells = np.arange(domain.cell_count) if self._graph is None else np.flatnonzero(~self._graph.damaged)
        rest = domain.nodes[domain.cell_nodes[cells]]
        J = _spanned(self._stress.cell_corners(cells)) / _spanned(rest)
        self.least = min(self.least, domain.comm.allreduce(float(J.min(initial=np.inf)), op=MPI.MIN))
        turned = int(sum_over_ranks(domain.comm, np.count_nonzero(J <= FLAT))[0])
        if turned and not self.count:
            self.since = t
        self.count = max(self.count, turned)

    def monitors(self) -> dict[str, float]:
        """What a restart goes on from, for `restore`."""
        return {"smallest_J": self.least, "inverted_cells": self.count, "inverted_since": self.since}

    def restore(self, monitors: dict[str, Any]) -> None:
        """Go on from `monitors`."""
        self.least, self.count = monitors["smallest_J"], monitors["inverted_cells"]
        self.since = monitors["inverted_since"]

    def note(self, energy: str) -> str:
        """A sentence where there were any; `energy` is that of the study."""
        if not self.count:
            return ""
        remedy = "no body can follow that motion" if energy == "neo-hookean" else 'energy = "neo-hookean" resists that'
        cells = "cell is" if self.count == 1 else "cells are"
        return (
            f"{self.count} unbroken {cells} crushed flat or turned inside out (first seen at t = {self.since:g} s, "
            f"smallest J = {self.least:.2g}): the result is not to be trusted from there on; {remedy}"
        )


def _spanned(corners: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """(n,) det of the edge vectors from the first of the (n, d + 1, d) corners."""
    return np.asarray(np.linalg.det(corners[:, 1:] - corners[:, :1]))
