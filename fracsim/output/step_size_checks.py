"""Monitors of the step size: strain that a scheme adds to cells that rotate, and peaks of tables within a step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from ..mechanics.stress import Stress
from ..mechanics.time_functions import TimeFunction
from ..mesh.domain import owned_input_cells
from ..mesh.small_matrices import inverse_transpose
from ..meshes.topology import determinants
from ..timestepping.state import State

if TYPE_CHECKING:
    from ..fracture.fracture_pass import FracturePass

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class StepSizeTolerances:
    """Thresholds of the monitors of the step size.

    Attributes:
        rotation_strain: strain from rotation in a step from which it is noted, without a strength.
        rotation_stress: share of the strength from which the stress of that strain is noted.
        rotation_cells: cells that are looked at for it, at most.
        missed_peak: share of the largest value of a table over time from which a peak within a step is noted.
    """

    rotation_strain: float = 1e-3
    rotation_stress: float = 0.1
    rotation_cells: int = 20_000
    missed_peak: float = 0.1


STEP_SIZE_TOLERANCES = StepSizeTolerances()


class RotationStrainMonitor:
    """Largest strain that a scheme adds to cells that rotate, and its stress as a share of their strength.

    Where forces balance at (1 - alpha_f) u_{n+1} + alpha_f u_n, a cell that rotates by an angle theta in a step is
    shortened there. At the end of the step it is longer by alpha_f (1 - alpha_f) theta^2 / 2. At most
    `STEP_SIZE_TOLERANCES.rotation_cells` cells are looked at, the same on any number of ranks.

    Attributes:
        largest: strain over the strain from which it is noted, the strain, share of the strength (0: without
            fracture), angle in rad and time in s; zeros at the start.
    """

    def __init__(self, stress: Stress, fracture: FracturePass | None, alpha_f: float) -> None:
        """Start without any frame; `alpha_f`: weight of the start of a step in the balance of forces."""
        self._stress, self._fracture, self._factor = stress, fracture, alpha_f * (1 - alpha_f) / 2
        # a criterion of a user may have none
        self._strength = None if fracture is None else getattr(fracture.criterion, "strength", None)
        domain, limit = stress.domain, STEP_SIZE_TOLERANCES.rotation_cells
        interval = -(-domain.mesh.topology.index_map(domain.dim).size_global // limit)
        self._sample = np.flatnonzero(owned_input_cells(domain.mesh) % interval == 0)
        self._velocity, self._dt, self._cells = fem.Function(domain.space), 0.0, self._sample
        self.largest = (0.0,) * 5

    def record_step(self, state: State, dt: float) -> None:
        """Record the velocity at the end of a step of dt in s."""
        self._velocity.x.array[: len(state.v)], self._dt = state.v, dt

    def record_frame(self, t: float) -> None:
        """Record the rotation of cells that carried stress at the frame before, at time t in s (collective)."""
        domain, cells = self._stress.domain, self._cells
        if self._fracture is not None:
            self._cells = self._sample[~self._fracture.graph.split[self._sample]]
        self._velocity.x.scatter_forward()
        velocities = self._velocity.x.array.reshape(-1, domain.dim)[domain.cell_nodes[cells]]
        corners = self._stress.cell_corners(cells)
        edges, rates = (values[:, 1:] - values[:, :1] for values in (corners, velocities))
        solid = determinants(edges.transpose(1, 2, 0)) != 0
        # transposes of grad v
        gradient = np.einsum("nkj,nki->nji", inverse_transpose(edges[solid]), rates[solid])
        skew = (gradient - gradient.transpose(0, 2, 1)) / 2
        angle = self._dt * np.sqrt(np.sum(skew**2, axis=(1, 2)) / 2)
        strain = self._factor * angle**2
        share, excess = np.zeros(len(strain)), strain / STEP_SIZE_TOLERANCES.rotation_strain
        if self._strength is not None:
            cells = cells[solid]
            young = np.broadcast_to(self._stress.material.young, domain.cell_count)[cells]
            share = young * strain / self._strength.minimum_in(cells)
            excess = share / STEP_SIZE_TOLERANCES.rotation_stress
        figures = np.stack([excess, strain, share, angle, np.full(len(angle), t)], axis=1)
        # a rank without cells has no row
        rows = [tuple(figures[cell].tolist()) for cell in np.argsort(excess)[-1:]]
        self.largest = max(
            [self.largest, *(row for rows_of_rank in domain.comm.allgather(rows) for row in rows_of_rank)]
        )

    def to_checkpoint(self) -> dict[str, Any]:
        """Values for `from_checkpoint`."""
        return {"rotation_strain": list(self.largest)}

    def from_checkpoint(self, monitors: dict[str, Any]) -> None:
        """Restore the values of `to_checkpoint`."""
        self.largest = tuple(monitors.get("rotation_strain", self.largest))

    def summary(self) -> dict[str, Any]:
        """Return nothing: it has no part of summary.json."""
        return {}

    def notes(self) -> list[str]:
        """Sentence about strain that comes from rotation, if it is large."""
        excess, strain, share, angle, t = self.largest
        if excess < 1:
            return []
        stress = f", a stress of {share:.2g} of the strength, which may break them" if share else ""
        return [
            f"cells rotated by {angle:.2g} rad in the step to t = {t:g} s: the scheme stretches them by "
            f"{self._factor:.2g} of its square, a strain of {strain:.2g}{stress}; "
            'try time.scheme = "newmark" or "backward-euler", or a shorter time.step'
        ]


class MissedPeakMonitor:
    """Largest peak of a table over time that lies within a step, beyond the values at both of its ends.

    Forces are balanced once per step: such a peak does not act on the body.
    """

    def __init__(self, tables: dict[str, tuple[Values, TimeFunction]], end: float) -> None:
        """Start without any step.

        Args:
            tables: times (n,), s, and function of time by key.
            end: end of the run, s.
        """
        self._tables = []
        for key, (times, function) in tables.items():
            within = times[(times > 0) & (times < end)]
            corners = np.array([function(t) for t in [0.0, *within, end]])
            if (scale := float(np.abs(corners).max())) > 0:
                self._tables.append((key, within, corners[1:-1], function, scale))
        # key, time in s, step in s, share of the largest value
        self._largest: tuple[str, float, float, float] = ("", 0.0, 0.0, 0.0)

    def record_step(self, t: float, dt: float) -> None:
        """Record a finished step of dt (s) that ends at t (s)."""
        for key, times, corners, function, scale in self._tables:
            inner = (times > t - dt) & (times < t)
            if not inner.any():
                continue
            ends = np.array([function(t - dt), function(t)])
            beyond = np.maximum(corners[inner] - ends.max(axis=0), ends.min(axis=0) - corners[inner]).max(axis=1)
            share, peak_time = float(beyond.max()) / scale, float(times[inner][beyond.argmax()])
            if share > self._largest[3]:
                self._largest = key, peak_time, dt, share

    def to_checkpoint(self) -> dict[str, Any]:
        """Values for `from_checkpoint`."""
        return {"missed_peak": list(self._largest)}

    def from_checkpoint(self, monitors: dict[str, Any]) -> None:
        """Restore the values of `to_checkpoint`."""
        self._largest = tuple(monitors.get("missed_peak", self._largest))

    def summary(self) -> dict[str, Any]:
        """Part of summary.json: none."""
        return {}

    def notes(self) -> list[str]:
        """Sentence on the largest peak that no step ended at, if there is one."""
        key, t, dt, share = self._largest
        if share < STEP_SIZE_TOLERANCES.missed_peak:
            return []
        return [
            f"{key} has a peak at t = {t:g} s within a step of {dt:g} s, and {share:.0%} of its largest value did not "
            "act: take a shorter time.step, or a table of steps with this time"
        ]
