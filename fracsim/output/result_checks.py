"""Monitors of a run: energy gain, inverted cells, interpenetrating fragments, and the drop of a load.

Each monitor records steps or frames, continues after a restart, and writes its part of summary.json. At the end it
gives a sentence if the result is doubtful.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..mechanics.stress import Stress
from ..mesh.parallel import sum_over_ranks
from ..meshes.data import format_point
from ..meshes.topology import determinants
from ..timestepping.state import State
from ..timestepping.stepper import StepReport

if TYPE_CHECKING:
    from ..fracture.fracture_pass import FracturePass
    from .surface.body_surface import BodySurface

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class CheckTolerances:
    """Thresholds of the monitors.

    Attributes:
        negligible_strain: energies below Y V strain^2 are round-off, as in a body at rest.
        relative_energy_gain: share of the largest energy or work that a run may gain, or lose if the scheme conserves
            energy. Time steps that are long compared with elastic waves gain a little.
        single_step_share: a single step is named if it gained at least this share of the total gain.
        min_jacobian: a cell with det F below this counts as inverted.
        min_tension: share of the largest stress below which a principal stress is round-off.
        cells_per_part: cells whose Jacobians are computed at a time.
    """

    negligible_strain: float = 3e-8
    relative_energy_gain: float = 0.05
    single_step_share: float = 0.5
    min_jacobian: float = 1e-6
    min_tension: float = 1e-9
    cells_per_part: int = 16_000


CHECK_TOLERANCES = CheckTolerances()


class EnergyBalanceMonitor:
    """Largest rise of the energy balance elastic + kinetic + dissipated - work above its least earlier value.

    A gain drives motion that no load causes. Projected strains at large strains gain energy, and so do second-order
    schemes if the tangent is not positive, or if many edges break at once. A loss is the purpose of a scheme that
    dissipates numerically. Other schemes lose energy in steps that are too long for their forces, breaks and impacts.

    Attributes:
        rise: largest gain, J.
        fall: largest loss, J.
        scale: largest energy or absolute work so far, J.
        floor: gains below this are not reported, J.
        All four are per metre of thickness in 2D.
    """

    def __init__(self, *, at_rest: bool, floor: float = 0.0, thickness: float = 1.0) -> None:
        """Start without any step.

        Args:
            at_rest: the body starts without energy; otherwise the end of the first step is the reference.
            floor: gains below this are not reported, J.
            thickness: thickness of a 2D body, m; 1 in 3D.
        """
        self._thickness = thickness
        self._min_balance = 0.0 if at_rest else float("inf")
        self._max_balance = -self._min_balance
        self.rise, self.fall, self.scale, self.floor = 0.0, 0.0, 0.0, floor
        self._balance = self._min_balance
        self._max_step_gain, self._max_gain_time = 0.0, 0.0

    def record_step(self, report: StepReport, state: State) -> None:
        """Record a finished step."""
        energy = report.kinetic + report.elastic
        balance = energy + state.dissipated - state.work
        if balance - self._balance > self._max_step_gain:
            self._max_step_gain, self._max_gain_time = balance - self._balance, state.t
        self._balance, self._min_balance = balance, min(self._min_balance, balance)
        self._max_balance = max(self._max_balance, balance)
        self.rise = max(self.rise, balance - self._min_balance)
        self.fall = max(self.fall, self._max_balance - balance)
        self.scale = max(self.scale, energy, abs(state.work))

    def to_checkpoint(self) -> dict[str, float]:
        """Values for `from_checkpoint`."""
        return {
            "energy_rise": self.rise, "energy_scale": self.scale, "energy_least": self._min_balance,
            "energy_balance": self._balance, "energy_most": self._max_step_gain, "energy_time": self._max_gain_time,
            "energy_fall": self.fall, "energy_greatest": self._max_balance,
        }  # fmt: skip

    def from_checkpoint(self, monitors: dict[str, float]) -> None:
        """Restore the values of `to_checkpoint`."""
        self.rise, self.scale, self._min_balance = (monitors[f"energy_{name}"] for name in ("rise", "scale", "least"))
        # checkpoints of earlier versions lack these
        self.fall = monitors.get("energy_fall", 0.0)
        self._max_balance = monitors.get("energy_greatest", float("-inf"))
        self._balance = monitors.get("energy_balance", float("inf"))
        self._max_step_gain = monitors.get("energy_most", 0.0)
        self._max_gain_time = monitors.get("energy_time", 0.0)

    def note(self, scheme: str, *, conserves: bool = False) -> str:
        """Sentence about a gain, or a loss of a scheme that conserves energy, above the tolerance; otherwise empty.

        Args:
            scheme: key time.scheme.
            conserves: the scheme has no numerical dissipation (`conserves_energy`).
        """
        limit = max(CHECK_TOLERANCES.relative_energy_gain * self.scale, self.floor)
        if self.rise <= limit and self.fall > limit and conserves:
            return (
                f"{self.fall * self._thickness:.3g} J of the energy is neither stored nor dissipated, "
                f"{self.fall / self.scale:.0%} of all that was at play: forces change too much within a step; "
                "try a shorter time.step"
            )
        if self.rise <= limit:
            return ""
        one_step = ""
        if self._max_step_gain >= CHECK_TOLERANCES.single_step_share * self.rise:
            share = min(self._max_step_gain / self.rise, 1.0)
            one_step = f" ({share:.0%} of it in the step to t = {self._max_gain_time:g} s)"
        alternative = "" if scheme in {"backward-euler", "quasi-static"} else 'time.scheme = "backward-euler", or '
        return (
            f"the body gained {self.rise * self._thickness:.3g} J of energy from nowhere{one_step}, "
            f"{self.rise / self.scale:.0%} of all that was at play: its motion is not to be trusted; "
            f"try {alternative}a shorter time.step"
        )


def negligible_energy(stress: Stress) -> float:
    """Energy Y V strain^2 of the body at the negligible strain, J, with Young's modulus Y and volume V (collective)."""
    domain = stress.domain
    stiffness = float(sum_over_ranks(domain.comm, np.sum(stress.material.young * domain.volumes))[0])
    return stiffness * CHECK_TOLERANCES.negligible_strain**2


class InvertedCellMonitor:
    """Least Jacobian J = det F of the undamaged cells over the frames of a run.

    No body turns inside out. Some energies (stvk, corotated) admit J <= 0, and a prescribed motion can force it. The
    result then balances all forces but has no physical meaning. Cells with broken edges may invert, and the linear
    energy does not depend on J: neither is checked.

    Attributes:
        min_jacobian: least J so far, 1 at rest.
        inverted_count: largest number of inverted cells in a frame.
        first_time: time of the first frame with an inverted cell, s.
    """

    def __init__(self, stress: Stress, fracture: FracturePass | None = None) -> None:
        """Start at rest; `fracture` has the damaged cells."""
        self._stress, self._domain = stress, stress.domain
        self._graph = fracture.graph if fracture is not None else None
        self.min_jacobian, self.inverted_count, self.first_time = 1.0, 0, 0.0

    @cached_property
    def _reference(self) -> Values:
        """Determinants (cells,) of the edge vectors at rest, m^d."""
        nodes, cell_nodes = self._domain.nodes, self._domain.cell_nodes
        return _edge_determinants(lambda cells: nodes[cell_nodes[cells]], np.arange(len(cell_nodes)))

    def record_frame(self, t: float) -> None:
        """Record the present deformation at time t in s (collective)."""
        if self._stress.material.energy.linear:
            return
        domain = self._domain
        cells = np.arange(domain.cell_count) if self._graph is None else np.flatnonzero(~self._graph.damaged)
        J = _edge_determinants(self._stress.cell_corners, cells) / self._reference[cells]
        self.min_jacobian = min(self.min_jacobian, domain.comm.allreduce(float(J.min(initial=np.inf)), op=MPI.MIN))
        inverted = int(sum_over_ranks(domain.comm, np.count_nonzero(CHECK_TOLERANCES.min_jacobian >= J))[0])
        if inverted and not self.inverted_count:
            self.first_time = t
        self.inverted_count = max(self.inverted_count, inverted)

    def to_checkpoint(self) -> dict[str, float]:
        """Values for `from_checkpoint`."""
        return {
            "smallest_J": self.min_jacobian, "inverted_cells": self.inverted_count, "inverted_since": self.first_time,
        }  # fmt: skip

    def from_checkpoint(self, monitors: dict[str, Any]) -> None:
        """Restore the values of `to_checkpoint`."""
        self.min_jacobian, self.inverted_count = monitors["smallest_J"], monitors["inverted_cells"]
        self.first_time = monitors["inverted_since"]

    def note(self, energy: str) -> str:
        """Sentence about inverted cells, empty if there were none; `energy` is the key material.energy."""
        if not self.inverted_count:
            return ""
        remedy = "no body can follow that motion" if energy == "neo-hookean" else 'energy = "neo-hookean" resists that'
        cells = "cell is" if self.inverted_count == 1 else "cells are"
        return (
            f"{self.inverted_count} unbroken {cells} crushed flat or turned inside out (first seen at "
            f"t = {self.first_time:g} s, smallest J = {self.min_jacobian:.2g}): the result is not to be trusted from "
            f"there on; {remedy}"
        )


def untested_balance_note(solver: dict[str, Any], *, is_linear: bool) -> str:
    """Sentence on steps of one linear solve, after which r(u) = 0 is not tested; empty without such steps.

    Args:
        solver: PETSc options of the study.
        is_linear: whether forces are linear in the displacement.
    """
    if is_linear or solver.get("snes_type") != "ksponly":
        return ""
    return (
        'with solver.snes_type = "ksponly" a step is one linear solve, and its balance of forces was not tested: '
        'compare a run with the default, "newtonls"'
    )


def unbroken_note(fracture: FracturePass) -> str:
    """Sentence on how far a body in which no edge has broken is from its strength, empty otherwise (collective).

    It names the cell with the largest ratio of the first principal stress to the least strength of an edge.
    """
    graph, domain = fracture.graph, fracture.stress.domain
    strength = getattr(fracture.criterion, "strength", None)  # a criterion of a user may have none
    if strength is None:
        return ""
    from ..fracture.principal_stress import first_principal_stress, symmetric_tensors

    weakened, initial = graph.integrity < 1, fracture.initial_cuts
    if initial is not None:
        weakened &= np.isnan(initial)
    if sum_over_ranks(domain.comm, np.count_nonzero(weakened))[0]:
        return ""
    tensors = fracture.evaluate_undamaged_stress()[0]
    size = domain.comm.allreduce(float(np.max(np.abs(tensors), initial=0.0)), op=MPI.MAX)
    stress = first_principal_stress(symmetric_tensors(tensors, domain.dim))
    ratio = stress / strength.minimum_in(np.arange(domain.cell_count))
    centres = domain.nodes[domain.cell_nodes].mean(axis=1)
    # a rank without cells has no row
    rows = [
        (float(ratio[cell]), float(stress[cell]), centres[cell].tolist()) for cell in np.lexsort((stress, ratio))[-1:]
    ]
    largest, pascal, point = max(row for rows_of_rank in domain.comm.allgather(rows) for row in rows_of_rank)
    if pascal <= CHECK_TOLERANCES.min_tension * size:
        return "nothing broke, and no cell is in tension at the end"
    return (
        f"nothing broke: at the end the largest principal stress of a cell is {pascal:.3g} Pa, {largest:.2g} of the "
        f"strength, at {format_point(point)} (docs/faq.md#nothing-breaks)"
    )


def _edge_determinants(corners_of: Callable[[Ints], Values], cells: Ints) -> Values:
    """Determinants (n,) of the edge vectors from the first of the corners (k, d + 1, d) of cells (n,), m^d."""
    # Parts stay in the cache: the corners of a million cells take 100 MB.
    parts = np.array_split(cells, len(cells) // CHECK_TOLERANCES.cells_per_part + 1)
    edges = (corners[:, 1:] - corners[:, :1] for corners in map(corners_of, parts))
    return np.concatenate([determinants(vectors.transpose(1, 2, 0)) for vectors in edges])


class InterpenetrationMonitor:
    """First frame in which fragments interpenetrate.

    Later frames are not checked, nor is a body of one fragment.

    Attributes:
        first_overlap: time in s, place in m, and names of the two fragments; empty if there was no overlap.
    """

    def __init__(self, *, in_contact: bool | Literal["pieces"] = False) -> None:
        """Start without any frame; `in_contact`: the key contact.itself."""
        self._in_contact = in_contact
        self.first_overlap: dict[str, Any] = {}

    def record_frame(self, t: float, surface: BodySurface, u: Values) -> None:
        """Record a frame at time t in s (collective over the ranks with parts of the surface).

        Args:
            t: time, s.
            surface: surface of the body, with its fragments.
            u: nodal displacement (N, d), m.
        """
        if self.first_overlap or surface.split.fragment_count == 1:
            return
        from ..mesh.interpenetration import RankNodes, find_interpenetration

        part = surface.part
        cells, is_owned = surface.skeleton.cells[surface.undamaged_cells], part.owner == part.comm.rank
        if self._in_contact == "pieces":
            # nodes without an undamaged cell have no contact
            is_loose = np.ones(len(is_owned), np.int64)
            is_loose[cells] = 0
            is_owned &= part.least(is_loose) == 0
        nodes = RankNodes(part.comm, part.node_numbers, is_owned)
        overlap = find_interpenetration(surface.skeleton.points + u, cells, surface.split.node_fragment, nodes)
        if overlap is not None:
            names = sorted(int(surface.fragment_names[fragment]) for fragment in overlap.fragments)
            self.first_overlap = {"time": t, "place": list(overlap.position), "pieces": names}

    def to_checkpoint(self) -> dict[str, Any]:
        """Values for `from_checkpoint`."""
        return {"passed_through": self.first_overlap}

    def from_checkpoint(self, monitors: dict[str, Any]) -> None:
        """Restore the values of `to_checkpoint`."""
        self.first_overlap = monitors.get("passed_through", {})

    def summary(self) -> dict[str, Any]:
        """Part of summary.json; empty if there was no overlap."""
        return self.to_checkpoint() if self.first_overlap else {}

    def notes(self, *, implicit: bool) -> list[str]:
        """Sentence about an overlap, if there was one (rank 0); `implicit`: the time scheme is implicit."""
        if not self.first_overlap:
            return []
        first, second = self.first_overlap["pieces"]
        if self._in_contact:
            spite, remedy = " in spite of [contact]", "a shorter time.step may help"
        else:
            table = "a [contact] table" if implicit else "[contact] with an implicit scheme"
            spite, remedy = "", f"{table} keeps them apart"
        return [
            f"pieces {first} and {second} pass through each other{spite}, first seen at "
            f"t = {self.first_overlap['time']:g} s near {format_point(self.first_overlap['place'])}; {remedy}"
        ]


class LoadDropMonitor:
    """Drop of the force on a probed group or an obstacle from its peak: the end of a test on a testing machine.

    Attributes:
        name: name of the probe or obstacle.
        drop_fraction: relative drop from the peak that ends the run.
        min_peak: lower peaks do not count, N.
        peak: largest force so far, also as edges broke within a step, N.
        peak_time: time of the peak, s.
        last_load: force in the last step, N.
        has_dropped: True if the force has dropped far enough.
    """

    def __init__(self, name: str, drop: float, above: float, *, breaks: bool) -> None:
        """Start without any step.

        Args:
            name: name of the probe or obstacle.
            drop: relative drop from the peak that ends the run.
            above: lower peaks do not count, N.
            breaks: a drop before the first broken edge does not count.
        """
        self.name, self.drop_fraction, self.min_peak, self._breaks = name, drop, above, breaks
        self.peak, self.last_load, self.peak_time, self.has_dropped = 0.0, 0.0, 0.0, False

    def record_step(self, t: float, figures: dict[str, float], broken: int) -> None:
        """Record a finished step.

        Args:
            t: time, s.
            figures: columns of history.csv by name.
            broken: number of broken edges so far.
        """
        self.last_load = max(self._force(figures, kind) for kind in ("reaction", "contact"))
        largest = max(self.last_load, self._force(figures, "onset"))
        if largest > self.peak:
            self.peak, self.peak_time = largest, t
        fallen = self.last_load <= (1 - self.drop_fraction) * self.peak and self.peak > self.min_peak
        self.has_dropped = fallen and (broken > 0 or not self._breaks)

    def _force(self, figures: dict[str, float], kind: str) -> float:
        """Magnitude of the force in the columns `kind`_NAME_x, ..., N; 0 if there are none."""
        prefix = f"{kind}_{self.name}_"
        return float(np.linalg.norm([value for name, value in figures.items() if name.startswith(prefix)]))

    def to_checkpoint(self) -> dict[str, Any]:
        """Values for `from_checkpoint`."""
        return {"load_peak": [self.peak, self.peak_time], "load_fallen": self.has_dropped}

    def from_checkpoint(self, monitors: dict[str, Any]) -> None:
        """Restore the values of `to_checkpoint`."""
        self.peak, self.peak_time = monitors.get("load_peak", (0.0, 0.0))
        self.has_dropped = monitors.get("load_fallen", False)

    def summary(self) -> dict[str, Any]:
        """Part of summary.json: peak of the load in N, its time in s, and whether the drop ended the run."""
        return {
            "load": {"of": self.name, "peak": self.peak, "peak_time": self.peak_time, "ended_the_run": self.has_dropped}
        }
