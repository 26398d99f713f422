"""A run: steps a scene to its end and writes the output folder."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from .errors import CannotWrite, NotConverged, Stopped
from .mesh.bodies import bodies_of
from .mesh.ranks import end_unless_all_failed, from_root, on_root, total
from .output.checkpoint import Notes, checkpoint_path, read_checkpoint, read_notes, write_checkpoint
from .output.energy_gain import EnergyGain, worth_telling
from .output.fields import Frames
from .output.fields_file import Field, FieldsFile
from .output.folder import OutputClock, check_folder, check_readable, make_folder, versions
from .output.history import History, history_columns
from .output.interrupt import Interrupt
from .output.inverted_cells import InvertedCells
from .output.progress import Progress
from .output.summary import Meter, Monitors, say, write_summary
from .output.writing import written
from .scene import Scene, build_scene
from .study import Study
from .study.file import study_text

if TYPE_CHECKING:
    from .fracture.record import EdgeRecord
    from .mesh.pieces import Pieces
    from .output.surface.output import SurfaceOutput

FRAMES = 50  # of a run whose study says neither every nor interval


class Run:
    """Steps a scene to its end and writes the output folder."""

    def __init__(
        self,
        scene: Scene,
        folder: Path,
        *,
        restart: bool = False,
        overwrite: bool = False,
        wall_limit: float | None = None,
        interrupt: Interrupt | None = None,
        began: float | None = None,
    ) -> None:
        """Start or resume; makes the output folder, once nothing stands in the way any more.

        `overwrite`: throw away a run there that could go on; `wall_limit`: s from now; `interrupt`: in its place, one
        that listens already; `began`: when the work on the scene began (perf_counter). Raises InputError, and Stopped
        where a signal came before anything was written.
        """
        self.scene, self.folder, self.comm = scene, folder, scene.domain.comm
        self._interrupt = interrupt or Interrupt(self.comm, wall_limit)
        self._text = study_text(scene.study, [f"{key}: {value}" for key, value in versions(self.comm).items()])
        self._meter = Meter(self.comm, scene.stepper, began)
        with self._interrupt:
            on_root(self.comm, lambda: _check(folder, scene.study, self._text, restart=restart, overwrite=overwrite))
            self.state = scene.start()
            self.record = self._make_record()
            notes = self._resume() if restart else None
            if reason := self._interrupt.signalled():
                raise Stopped(f"stopped by {reason} while the run was set up; nothing was written")
            self._prepare(notes)
        self._damage = self._count_damage()

    def _resume(self) -> Notes:
        """Take up the state of the checkpoint, and what it says beside it."""
        scene, notes = self.scene, from_root(self.comm, lambda: read_notes(self.folder))
        stress = scene.balance.stress
        state = read_checkpoint(self.folder, scene.domain, self.state, stress, self.record, self._surfaces)
        self.state = scene.stepper.resume(state)
        if notes.values()["time"]["step"] != scene.study.time.step:  # else the size of the last step goes on
            self.state = replace(self.state, dt=scene.study.time.step)
        return notes

    @property
    def _graph(self) -> Any:
        return self.scene.fracture.graph if self.scene.fracture is not None else None

    @property
    def _surfaces(self) -> Any:
        return brittle_surfaces(self.scene.fracture)

    # --- set-up ---

    def _prepare(self, notes: Notes | None) -> None:
        """Open the output, of a run that goes on where there are notes of it."""
        study, restart, folder = self.scene.study, notes is not None, self.folder
        step, t = (self.state.step, self.state.t) if restart else (None, None)
        names, columns = self.scene.probes.names, history_columns(self.scene.probes.names)
        if step is not None:
            on_root(self.comm, lambda: check_readable(folder, columns, step))
        self._interrupt.writing = True
        on_root(self.comm, lambda: make_folder(folder, self._text, restart=restart))
        self._saved_at = t  # s, of the last checkpoint
        self.history = History(self.comm, folder / "history.csv", names, step)
        fields = study.output.fields if study.output.fields is not None else default_fields(study)
        self.frames = Frames(self.scene.balance.stress, fields, self.scene.fracture)
        self.inverted = InvertedCells(self.scene.balance.stress, self.scene.fracture)
        self.gained = EnergyGain(at_rest=study.initial is None, floor=worth_telling(self.scene.balance.stress))
        self.monitors = Monitors(self.history, self.inverted, self.gained, self._meter)
        if notes is not None:
            self.monitors.restore(notes.monitors)
        source = self.scene.domain.source
        self.fields = self._written("fields.xdmf", lambda: FieldsFile(folder, source, t) if source else None)
        self._open_surface(restart)
        self._clock = OutputClock(study.output.every, study.output.interval or study.time.end / FRAMES)
        self._clock.wrote(self.state)
        self._bodies = int(self.comm.bcast(bodies_of(source)[0] if source is not None else None))
        # it tells how the run ended, which is open again
        self._written("summary.json", lambda: (folder / "summary.json").unlink(missing_ok=True))

    def _written[T](self, name: str, work: Callable[[], T]) -> T | None:
        return written(self.comm, self.folder / name, work)

    def _open_surface(self, restart: bool) -> None:
        """The split surface, where the study wants it: imported, built and kept only then."""
        self.surface: SurfaceOutput | None = None
        study, scene = self.scene.study, self.scene
        if study.output.surface is False or (study.output.surface is None and study.fracture is None):
            return
        from .output.surface.output import SurfaceOutput

        density, resume_at = scene.balance.stress.material.density, self.state.t if restart else None
        self.surface = SurfaceOutput(self.folder, scene.domain, density, self.record, resume_at=resume_at)

    def _make_record(self) -> EdgeRecord | None:
        if self._graph is None:
            return None
        from .fracture.record import EdgeRecord

        return EdgeRecord(self._graph)

    def _note_breaks(self) -> None:
        """Remember when and where the edges of this step broke."""
        if self.record is None:
            return
        by_forces = self.scene.study.output.cut == "forces"
        if self._surfaces is not None:  # a surface knows where it cuts
            self.record.note(self.state.t, self._surfaces.cut)
        else:
            self.record.note(self.state.t, self._cuts() if by_forces else None)

    def _cuts(self) -> npt.NDArray[np.float64]:
        """(edges,) cuts in inverse proportion to the nodal forces at the step's end (M22 fig. 12)."""
        from .fracture.record import cut_by_forces

        domain, graph = self.scene.domain, self._graph
        force = domain.with_ghosts(self.scene.balance.stress.force()).reshape(-1, domain.dim)
        ends = graph.edge_nodes
        swap = domain.node_input[ends[:, 0]] > domain.node_input[ends[:, 1]]
        return cut_by_forces(force, np.where(swap[:, None], ends[:, ::-1], ends))

    # --- the loop ---

    def __call__(self) -> dict[str, Any]:
        """Run to the end; returns what summary.json says. Raises NotConverged, Stopped or CannotWrite, with where to go
        on from."""
        self._meter.begin_steps()
        try:
            with self._interrupt:
                summary = self._run()
        except CannotWrite as error:
            raise CannotWrite(f"{error}. {self._rescued()}") from None
        finally:
            self.history.close()
        if self.comm.rank == 0 and self.scene.study.output.picture:
            _draw(self.folder)
        return summary

    def _run(self) -> dict[str, Any]:
        """The loop, and a checkpoint where it does not end well."""
        progress = Progress(self.comm, self.scene.study.time.end)
        try:
            with progress:
                self._loop(progress)
        except (NotConverged, Stopped) as error:
            end_unless_all_failed(self.comm, f"fracsim: {error}", int(error.exit_code))  # what follows is collective
            saved = self._saved()
            self._finish("not converged" if isinstance(error, NotConverged) else "stopped")
            raise type(error)(f"{error}. {saved}") from None
        return self._finish("done")

    def _saved(self) -> str:
        """Write a checkpoint on the way out and say where; one of a body that went astray would spoil the last good."""
        state = self.state
        finite = bool(np.isfinite(state.u).all() and np.isfinite(state.v).all())
        if not self.comm.allreduce(finite, op=MPI.LAND):
            return "No checkpoint was written: the state is not finite"
        return f"Checkpoint: {self._checkpoint()}; go on with --restart"

    def _rescued(self) -> str:
        """Where to go on from after output failed: a checkpoint of now where there is room for it, or the last one."""
        with contextlib.suppress(CannotWrite):
            write_summary(self.comm, self.folder, self._summary("could not write"))
        try:
            if self.history.step == self.state.step:  # a step without its row would leave a gap
                return self._saved()
        except CannotWrite:
            pass
        if self._saved_at is None:
            return "There is no checkpoint"
        path = checkpoint_path(self.folder)
        return f"The last good checkpoint: {path} at t = {self._saved_at:g} s; go on with --restart"

    def _finish(self, outcome: str) -> dict[str, Any]:
        """summary.json; only on ways out that all ranks take, since it sums over them."""
        summary = self._summary(outcome)
        write_summary(self.comm, self.folder, summary)
        say(self.comm, self.monitors.notes(self.scene.study.material.energy, self.scene.study.time.scheme))
        return summary

    def _loop(self, progress: Progress) -> None:
        state, end = self.state, self.scene.study.time.end
        if state.step == 0:
            self._write_frame()
        if reason := self._interrupt.signalled():
            raise Stopped(f"stopped by {reason} before the first step, at t = {state.t:g} s")
        last = time.monotonic()
        every = self.scene.study.output.checkpoint
        while state.t < end * (1 - 1e-12):
            state, report = self.scene.stepper.advance(state)
            self.state = state
            if report.broken:
                self._damage = self._count_damage()
                self._note_breaks()
            self.history.append(state, report, self._figures(), self.scene.probes())
            self.gained.look(report, state)
            done = state.t >= end * (1 - 1e-12)
            if done or self._clock.due(state):
                self._write_frame()
            progress.update(state, report, self._figures())
            if every is not None and self.comm.bcast(time.monotonic() - last > every):
                self._checkpoint()
                last = time.monotonic()
            if not done and (reason := self._interrupt.reason()):
                self._write_frame()
                raise Stopped(f"stopped by {reason} at t = {state.t:g} s after {state.step} steps")

    def _write_frame(self) -> None:
        began = time.perf_counter()
        fields = self.frames(self.state, self._damage[2])
        self.inverted.look(self.state.t)
        self._written("fields.xdmf", lambda: self._write_fields(fields))
        if self.surface is not None:
            self.surface.write(self.state, fields)
        self._clock.wrote(self.state)
        self._meter.output += time.perf_counter() - began

    def _write_fields(self, fields: list[Field]) -> None:
        if self.fields is not None and self.state.t not in self.fields.times:
            self.fields.write(self.state.t, fields)

    def _checkpoint(self) -> Path:
        began = time.perf_counter()
        notes = Notes(self._text, self.monitors.saved())
        path = write_checkpoint(
            self.folder, self.scene.domain, self.state, self.scene.balance.stress, notes, self.record, self._surfaces
        )
        self._saved_at = self.state.t
        self._meter.output += time.perf_counter() - began
        return path

    # --- figures ---

    def _count_damage(self) -> tuple[int, int, Pieces | None]:
        """(broken edges, split cells, pieces) over all ranks."""
        graph = self._graph
        if graph is None:
            return 0, 0, None
        from .mesh.pieces import find_pieces

        broken, split = total(self.comm, np.array([graph.broken_count, np.count_nonzero(graph.split)]))
        return int(broken), int(split), find_pieces(graph)

    def _figures(self) -> tuple[int, int, int]:
        broken, split, pieces = self._damage
        return broken, split, pieces.count if pieces is not None else self._bodies

    def _summary(self, outcome: str) -> dict[str, Any]:
        state, domain = self.state, self.scene.domain
        broken, split, pieces = self._figures()
        sizes = total(self.comm, np.array([domain.node_count, domain.cell_count]))
        return {
            "title": self.scene.study.title, "outcome": outcome, "time": state.t, "steps": state.step,
            "nodes": int(sizes[0]), "cells": int(sizes[1]),
            "broken_edges": broken, "split_cells": split, "pieces": pieces,
            "external_work": state.work, "dissipated": state.dissipated, **self.monitors.summary(),
        }  # fmt: skip


def brittle_surfaces(breaking: Any) -> Any:
    """What starts surfaces, where the study has [brittle]; None elsewhere."""
    return breaking.criterion if breaking is not None and hasattr(breaking.criterion, "starts") else None


def default_fields(study: Study) -> list[str]:
    """Fields of a study that names none."""
    return ["damage", "von_mises"] if study.fracture is not None else ["von_mises"]


def run_study(
    comm: MPI.Comm,
    study: Study,
    folder: Path,
    *,
    restart: bool = False,
    overwrite: bool = False,
    wall_limit: float | None = None,
    source: Path | None = None,
) -> dict[str, Any]:
    """Build, run, draw the last frame; returns the summary (collective).

    `overwrite`: a run in the folder that could go on may be thrown away; `wall_limit`: s from now; `source`: the study
    file, which must not be written over.
    """
    began = time.perf_counter()
    with Interrupt(comm, wall_limit) as interrupt:
        # at once, not after a mesh of minutes
        on_root(comm, lambda: _check(folder, study, study_text(study), source, restart=restart, overwrite=overwrite))
        scene = build_scene(comm, study)
        if scene.domain.source is not None:
            say(comm, list(scene.domain.source.notes))
        try:
            return Run(scene, folder, restart=restart, overwrite=overwrite, interrupt=interrupt, began=began)()
        finally:
            scene.destroy()


def _check(
    folder: Path, study: Study, text: str, source: Path | None = None, *, restart: bool, overwrite: bool
) -> None:
    inputs = (source, study.mesh.file, study.mesh.surface)
    check_folder(folder, text, restart=restart, overwrite=overwrite, inputs=inputs)


def _draw(folder: Path) -> None:
    """A picture of the last frame; a machine that cannot draw loses the picture, not the run."""
    from .report.picture import render

    try:
        render(folder)
    except (ImportError, OSError, RuntimeError) as error:
        print(f"fracsim: no picture drawn: {error}", file=sys.stderr)
