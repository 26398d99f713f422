"""All that a run watches from step to step: what makes its result doubtful, what ends it early, what it has used.

Each is there only where it can tell anything. They go on with a restart, have their part of summary.json, and say their
sentences at the end.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol, cast

from .output.result_checks import EnergyGainMonitor, InvertedCellMonitor, negligible_energy
from .output.run_folder import software_versions
from .output.summary import ResourceMeter, describe_trouble

if TYPE_CHECKING:
    from .output.contact_checks import ObstacleContact, ObstacleContactMonitor, ObstacleOverlapMonitor
    from .output.history import History
    from .output.result_checks import InterpenetrationMonitor, LoadDropMonitor
    from .scene import Scene
    from .study import Study
    from .timestepping.state import State
    from .timestepping.stepper import StepReport


class Monitor(Protocol):
    """Something that is watched in some runs only."""

    def to_checkpoint(self) -> dict[str, Any]:
        """What a restart goes on from, for `restore` (collective)."""

    def from_checkpoint(self, monitors: dict[str, Any]) -> None:
        """Go on from `monitors`."""

    def summary(self) -> dict[str, Any]:
        """Its part of summary.json (rank 0)."""


# What every checkpoint of a deformable body says of the run so far.
CHECKPOINT_MONITORS = {
    *("smallest_J", "inverted_cells", "inverted_since", "energy_rise", "energy_scale", "energy_least"),
    *("peak_reactions", "trouble", "wall", "cpu", "memory", "seconds"),
}


class RunMonitors:
    """What is watched.

    Attributes:
        history: with the peaks of its columns.    meter: what the run has used.
        inverted: cells crushed or turned inside out.    gained: energy from nowhere.
        meetings: of obstacles with the body.    overlapping: of obstacles with one another.
        passing: of pieces through each other.    drop: of the load; each of these four None where there is none.
    """

    def __init__(self, scene: Scene, history: History, meter: ResourceMeter) -> None:
        """(collective)"""
        study, stress = scene.study, scene.balance.stress
        self._study, self.history, self.meter = study, history, meter
        self.inverted = InvertedCellMonitor(stress, scene.fracture)
        floor = negligible_energy(stress)
        self.energy_gain = EnergyGainMonitor(at_rest=study.starts_at_rest, floor=floor, thickness=study.thickness)
        self.contact_monitor, self.obstacle_overlap = _of_obstacles(scene)
        self.interpenetration, self.load_drop = _passing(study), _load_drop(study)
        those = (self.contact_monitor, self.obstacle_overlap, self.interpenetration, self.load_drop)
        self._others: list[Monitor] = [each for each in those if each is not None]

    @property
    def load_dropped(self) -> bool:
        """Whether the load has fallen as far as ends the run."""
        return self.load_drop is not None and self.load_drop.has_dropped

    def record_step(self, state: State, report: StepReport, figures: dict[str, float], broken: int) -> None:
        """Note a step; `figures`: what was probed in it; `broken`: edges so far (collective)."""
        if self.contact_monitor is not None:
            self.contact_monitor.record_step(state, report.dt, figures)
        if self.load_drop is not None:
            self.load_drop.record_step(state.t, figures, broken)
        self.energy_gain.record_step(report, state)

    def record_frame(self, t: float) -> None:
        """Note what is looked at in frames alone (collective)."""
        self.inverted.record_frame(t)
        if self.obstacle_overlap is not None:
            self.obstacle_overlap.record_frame(t)

    def to_checkpoint(self) -> dict[str, Any]:
        """For a checkpoint (collective)."""
        watched: dict[str, Any] = self.inverted.to_checkpoint() | self.energy_gain.to_checkpoint()
        watched |= {"peak_reactions": self.history.reaction_peaks, "worked": self.history.obstacle_work}
        for monitor in self._others:
            watched |= monitor.to_checkpoint()
        return watched | self.meter.read_totals()

    def from_checkpoint(self, saved: dict[str, Any]) -> None:
        """Go on from those of a checkpoint."""
        watched: list[Any] = [self.inverted, self.energy_gain, self.meter, *self._others]
        for each in watched:
            each.from_checkpoint(saved)
        self.history.reaction_peaks |= saved["peak_reactions"]
        self.history.obstacle_work |= saved.get("worked", {})

    def summary(self) -> dict[str, Any]:
        """Their part of summary.json (collective)."""
        used = self.meter.read_totals()
        return {
            **used["trouble"], "smallest_J": self.inverted.min_jacobian,
            "inverted_cells": self.inverted.inverted_count, "peak_reactions": self.history.reaction_peaks,
            "seconds": {key: round(value, 4) for key, value in used["seconds"].items()},
            "wall": round(used["wall"], 3), "cpu": round(used["cpu"], 4), "peak_memory_MiB": round(used["memory"], 1),
            **{name: found for each in self._others for name, found in each.summary().items()},
            "ranks": self.history.comm.size, "versions": software_versions(self.history.comm),
        }  # fmt: skip

    def notes(self, *, done: bool) -> list[str]:
        """Sentences on what makes the result doubtful; `done`: the run came to its end (collective)."""
        energy, time = self._study.material.energy, self._study.time
        trouble = describe_trouble(self.meter.read_totals()["trouble"])
        notes = [note for note in (trouble, self.inverted.note(energy), self.energy_gain.note(time.scheme)) if note]
        if self.contact_monitor is not None:
            notes += self.contact_monitor.notes(done=done)
        if self.obstacle_overlap is not None:
            notes += self.obstacle_overlap.notes()
        if self.interpenetration is not None:
            notes += self.interpenetration.notes(implicit=time.scheme_class.implicit)
        return notes


def wants_surface(study: Study) -> bool:
    """Whether the split surface is written: as the study says, or where something breaks or stands in the way."""
    if study.output.surface is None:
        return study.fracture is not None or bool(study.obstacle)
    return study.output.surface


def _of_obstacles(scene: Scene) -> tuple[ObstacleContactMonitor | None, ObstacleOverlapMonitor | None]:
    """Where there are any; that they lie in one another, where one of several moves freely."""
    obstacles = scene.study.obstacle
    if not obstacles:
        return None, None
    from .contact.obstacle_term import ObstacleTerm
    from .output.contact_checks import ObstacleContactMonitor, ObstacleOverlapMonitor

    terms = [term for term in scene.balance.terms if term.name in ("obstacles", "solids")]
    meetings = ObstacleContactMonitor(cast("list[ObstacleContact]", terms))
    watched = [term for term in terms if isinstance(term, ObstacleTerm)]
    if not watched or len(obstacles) == 1 or not any(each.is_free for each in obstacles):
        return meetings, None
    return meetings, ObstacleOverlapMonitor(watched[0])


def _passing(study: Study) -> InterpenetrationMonitor | None:
    """Where nothing keeps pieces apart, and their surface is made anyway."""
    if not wants_surface(study) or (study.contact is not None and study.contact.itself):
        return None
    from .output.result_checks import InterpenetrationMonitor

    return InterpenetrationMonitor()


def _load_drop(study: Study) -> LoadDropMonitor | None:
    """What ends the run early."""
    if (until := study.time.until) is None:
        return None
    from .output.result_checks import LoadDropMonitor

    return LoadDropMonitor(study.monitored_load, until.drop, until.above, breaks=study.fracture is not None)
