"""Monitors of a run: doubtful results, an early end, and resources used.

A monitor exists only if the study needs it. Monitors continue after a restart, write a part of summary.json, and print
notes at the end.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol, cast

from .forms.schemes import conserves_energy
from .output.result_checks import (
    EnergyBalanceMonitor,
    InvertedCellMonitor,
    negligible_energy,
    unbroken_note,
    untested_balance_note,
)
from .output.run_folder import software_versions
from .output.summary import ResourceMeter, irregular_event_text
from .study.conditions import tabulated_conditions
from .study.quadratic_checks import corner_contact_note

if TYPE_CHECKING:
    from .output.contact_checks import (
        IntersectionMonitor,
        ObstacleContactMonitor,
        ObstacleOverlapMonitor,
        SelfContactTerm,
    )
    from .output.history import History
    from .output.result_checks import InterpenetrationMonitor, LoadDropMonitor
    from .output.step_size_checks import MissedPeakMonitor, RotationStrainMonitor
    from .scene import Scene
    from .study import Study
    from .timestepping.state import State
    from .timestepping.stepper import StepReport


class Monitor(Protocol):
    """Monitor that only some runs have."""

    def to_checkpoint(self) -> dict[str, Any]:
        """Return what a checkpoint stores (collective)."""

    def from_checkpoint(self, monitors: dict[str, Any]) -> None:
        """Restore what `to_checkpoint` returned."""

    def summary(self) -> dict[str, Any]:
        """Return a part of summary.json (rank 0)."""


# Names in every checkpoint of a deformable body.
CHECKPOINT_MONITORS = {
    *("smallest_J", "inverted_cells", "inverted_since", "energy_rise", "energy_scale", "energy_least"),
    *("peak_reactions", "trouble", "wall", "cpu", "memory", "seconds"),
}


class RunMonitors:
    """All monitors of a run.

    Attributes:
        history: rows of history.csv, with the peaks of its columns.
        meter: time and memory used.
        inverted: cells that are crushed or inverted.
        energy_balance: energy that appears or is lost without work.
        contact_monitor: contact of obstacles with the body; None without obstacles.
        obstacle_overlap: overlap of obstacles with one another; None without several obstacles, one of them free.
        interpenetration: of fragments; None without a surface.
        intersections: of facets in contact of the body with itself; None without it, and in explicit steps.
        rotation: strain from rotation in a step; None with schemes that add none.
        missed_peak: peaks of tables over time within a step; None without such tables.
        load_drop: ends the run when the load has dropped; None without `time.until`.
    """

    def __init__(self, scene: Scene, history: History, meter: ResourceMeter) -> None:
        """Make the monitors that the study needs (collective)."""
        study, stress = scene.study, scene.balance.stress
        self._study, self._fracture, self.history, self.meter = study, scene.fracture, history, meter
        self._is_linear = scene.balance.linear
        self.inverted = InvertedCellMonitor(stress, scene.fracture)
        floor = negligible_energy(stress)
        self.energy_balance = EnergyBalanceMonitor(at_rest=study.starts_at_rest, floor=floor, thickness=study.thickness)
        self.contact_monitor, self.obstacle_overlap = _obstacle_monitors(scene)
        self.interpenetration, self.load_drop = _interpenetration_monitor(study), _load_drop_monitor(study)
        self.intersections, self.rotation = _intersection_monitor(scene), _rotation_monitor(scene)
        self.missed_peak = missed_peak_monitor(scene.study, scene.domain.dim)
        of_contact = (self.contact_monitor, self.obstacle_overlap, self.interpenetration, self.intersections)
        optional = (*of_contact, self.load_drop, self.rotation, self.missed_peak)
        self._optional: list[Monitor] = [monitor for monitor in optional if monitor is not None]

    @property
    def load_dropped(self) -> bool:
        """Return whether the load has dropped so far that the run ends."""
        return self.load_drop is not None and self.load_drop.has_dropped

    def record_step(self, state: State, report: StepReport, figures: dict[str, float], broken: int) -> None:
        """Record a step (collective); `figures`: values of the probes; `broken`: number of broken edges."""
        if self.contact_monitor is not None:
            self.contact_monitor.record_step(state, report.dt, figures)
        if self.load_drop is not None:
            self.load_drop.record_step(state.t, figures, broken)
        if self.rotation is not None:
            self.rotation.record_step(state, report.dt)
        if self.missed_peak is not None:
            self.missed_peak.record_step(state.t, report.dt)
        self.energy_balance.record_step(report, state)

    def record_frame(self, t: float) -> None:
        """Record a frame (collective)."""
        self.inverted.record_frame(t)
        if self.obstacle_overlap is not None:
            self.obstacle_overlap.record_frame(t)
        if self.intersections is not None:
            self.intersections.record_frame(t)
        if self.rotation is not None:
            self.rotation.record_frame(t)

    def to_checkpoint(self) -> dict[str, Any]:
        """Return what a checkpoint stores (collective)."""
        result: dict[str, Any] = self.inverted.to_checkpoint() | self.energy_balance.to_checkpoint()
        result |= {"peak_reactions": self.history.reaction_peaks, "worked": self.history.obstacle_work}
        for monitor in self._optional:
            result |= monitor.to_checkpoint()
        return result | self.meter.read_totals()

    def from_checkpoint(self, saved: dict[str, Any]) -> None:
        """Restore what `to_checkpoint` returned."""
        monitors: list[Any] = [self.inverted, self.energy_balance, self.meter, *self._optional]
        for monitor in monitors:
            monitor.from_checkpoint(saved)
        self.history.reaction_peaks |= saved["peak_reactions"]
        self.history.obstacle_work |= saved.get("worked", {})

    def summary(self) -> dict[str, Any]:
        """Return the part of summary.json (collective)."""
        used = self.meter.read_totals()
        return {
            **used["trouble"], "smallest_J": self.inverted.min_jacobian,
            "inverted_cells": self.inverted.inverted_count, "peak_reactions": self.history.reaction_peaks,
            "seconds": {key: round(value, 4) for key, value in used["seconds"].items()},
            "wall": round(used["wall"], 3), "cpu": round(used["cpu"], 4), "peak_memory_MiB": round(used["memory"], 1),
            **{name: value for monitor in self._optional for name, value in monitor.summary().items()},
            "ranks": self.history.comm.size, "versions": software_versions(self.history.comm),
        }  # fmt: skip

    def notes(self, *, done: bool) -> list[str]:
        """Return notes on doubtful results (collective); `done`: the run came to its end."""
        energy, time = self._study.material.energy, self._study.time
        trouble = irregular_event_text(self.meter.read_totals()["trouble"])
        untested = untested_balance_note(self._study.solver, is_linear=self._is_linear)
        corners = corner_contact_note(self._study)
        balance = self.energy_balance.note(time.scheme, conserves=conserves_energy(time.scheme_object))
        of_all = (trouble, untested, corners, self.inverted.note(energy), balance)
        notes = [note for note in of_all if note]
        if done and self._fracture is not None and (unbroken := unbroken_note(self._fracture)):
            notes.append(unbroken)
        if self.contact_monitor is not None:
            notes += self.contact_monitor.notes(done=done)
        if self.obstacle_overlap is not None:
            notes += self.obstacle_overlap.notes()
        if self.interpenetration is not None:
            notes += self.interpenetration.notes(implicit=time.scheme_class.implicit)
        if self.intersections is not None:
            notes += self.intersections.notes()
        if self.rotation is not None:
            notes += self.rotation.notes()
        if self.missed_peak is not None:
            notes += self.missed_peak.notes()
        return notes


def wants_surface(study: Study) -> bool:
    """Return whether the split surface is written; by default with fracture or obstacles."""
    if study.output.surface is None:
        return study.fracture is not None or bool(study.obstacle)
    return study.output.surface


def _obstacle_monitors(scene: Scene) -> tuple[ObstacleContactMonitor | None, ObstacleOverlapMonitor | None]:
    """Return the monitors of obstacles; None for those that the study does not need."""
    obstacles = scene.study.obstacle
    if not obstacles:
        return None, None
    from .contact.penalty_obstacle_pairs import VerletRigidObstacles
    from .contact.rigid_obstacles import RigidObstacles
    from .output.contact_checks import ObstacleContactMonitor, ObstacleOverlapMonitor

    (motion,) = (term for term in scene.balance.terms if isinstance(term, RigidObstacles))
    contact_monitor = ObstacleContactMonitor(scene.domain, motion.contacts)
    moves_freely = isinstance(motion, VerletRigidObstacles) and len(obstacles) > 1
    return contact_monitor, ObstacleOverlapMonitor(motion) if moves_freely else None


def _interpenetration_monitor(study: Study) -> InterpenetrationMonitor | None:
    """Return the monitor of interpenetration, if there is a surface."""
    if not wants_surface(study):
        return None
    from .output.result_checks import InterpenetrationMonitor

    return InterpenetrationMonitor(in_contact=study.contact.itself if study.contact is not None else False)


def _intersection_monitor(scene: Scene) -> IntersectionMonitor | None:
    """Return the monitor of facets that intersect, if the body is in contact with itself in implicit steps."""
    study = scene.study
    if study.contact is None or not study.contact.itself or not study.time.scheme_class.implicit:
        return None
    from .output.contact_checks import IntersectionMonitor

    (term,) = [term for term in scene.balance.terms if term.name == "contact"]
    return IntersectionMonitor(cast("SelfContactTerm", term))


def _rotation_monitor(scene: Scene) -> RotationStrainMonitor | None:
    """Return the monitor of strain from rotation, if forces balance between the ends of a step."""
    stress, alpha_f = scene.balance.stress, scene.balance.scheme.alpha_f
    if not 0 < alpha_f < 1 or stress.energy.linear:
        return None
    from .output.step_size_checks import RotationStrainMonitor

    return RotationStrainMonitor(stress, scene.fracture, alpha_f)


def missed_peak_monitor(study: Study, dim: int) -> MissedPeakMonitor | None:
    """Return the monitor of peaks within a step, if a load or a motion has a table over time."""
    tables = tabulated_conditions(study, dim)
    if not tables:
        return None
    from .output.step_size_checks import MissedPeakMonitor

    return MissedPeakMonitor(tables, study.time.end)


def _load_drop_monitor(study: Study) -> LoadDropMonitor | None:
    """Return the monitor that ends the run after a drop of the load."""
    if (until := study.time.until) is None:
        return None
    from .output.result_checks import LoadDropMonitor

    fracture, inertia = study.fracture, study.time.scheme_class.inertia
    # cohesive cracks carry load long before their edges break; without inertia nothing else makes it drop
    breaks = fracture is not None and (fracture.law != "cohesive" or inertia)
    return LoadDropMonitor(study.monitored_load, until.drop, until.above, breaks=breaks)
