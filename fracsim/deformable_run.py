"""Run of a study: steps a scene to its end and writes the output folder."""

from __future__ import annotations

import contextlib
import sys
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from mpi4py import MPI

from .errors import CannotWrite, InputError, NotConverged, StepAborted, Stopped, one_line
from .mesh.parallel import abort_unless_all_failed, from_root, on_root, sum_over_ranks
from .monitors import CHECKPOINT_MONITORS, RunMonitors, wants_surface
from .output.atomic_write import write_on_root
from .output.checkpoint import read_checkpoint, write_checkpoint
from .output.checkpoint_file import (
    CheckpointNotes,
    checkpoint_path,
    describe_last_checkpoint,
    read_notes,
    restart_error,
)
from .output.fracture_log import FractureLog
from .output.frame_files import FrameFiles
from .output.history import History, history_columns
from .output.interrupt import InterruptHandler
from .output.lock import FolderLock, lock_checked_folder
from .output.progress import ProgressReporter, ProgressState
from .output.run_folder import (
    FrameSchedule,
    check_continuable,
    check_output_folder,
    early_end_notes,
    make_output_folder,
    missing_frame_notes,
    software_versions,
)
from .output.summary import ResourceMeter, print_notes, write_summary
from .process import import_outside
from .scene import Scene, build_scene
from .study import Study
from .study.conditions import condition_notes, initial_cracks
from .study.plugins import collect_physics, physics_lines
from .study.reader import add_missing_defaults, input_file_lines, study_text
from .timestepping.stepper import StepReport

if TYPE_CHECKING:
    from collections.abc import Callable

    from .output.crack_length import CrackExtent
    from .output.tip_file import TipFile


class Run:
    """Scene and its output folder: `run()` steps to the end, `run.step()` takes one step.

    Attributes:
        scene: that is stepped.
        folder: output folder.
        comm: ranks of the run.
        state: present state.
        history: rows of history.csv.
        frames: fields and surface.
        breaks: log of the edges that broke.
        front: extent of the cracks; None without [[crack]] and fracture energy.
        tips: rows of tips.csv; None if cracks have no release rate.
        monitors: doubtful results, an early end, resources used.
        interrupt: signals and the limit of wall time.
    """

    def __init__(
        self,
        scene: Scene,
        folder: Path,
        *,
        restart: bool = False,
        overwrite: bool = False,
        wall_limit: float | None = None,
        interrupt: InterruptHandler | None = None,
        progress: ProgressReporter | None = None,
        began: float | None = None,
    ) -> None:
        """Check the input, then make the output folder (collective).

        Args:
            scene: to be stepped.
            folder: output folder.
            restart: continue from the checkpoint in the folder.
            overwrite: replace a run in the folder that could be continued.
            wall_limit: s from now; None: no limit.
            interrupt: handler that is in use already, in place of the limit.
            progress: reporter that is in use already; None: a new one.
            began: time.perf_counter() as the work on the scene began; None: now.

        Raises:
            InputError: folder or checkpoint do not fit.
            Stopped: a signal came before anything was written.
        """
        self.scene, self.folder, self.comm = scene, folder, scene.domain.comm
        self.interrupt = interrupt or InterruptHandler(self.comm, wall_limit)
        self._progress = progress or ProgressReporter(first=self.comm.rank == 0, end=scene.study.time.end)
        versions = [f"{key}: {value}" for key, value in software_versions(self.comm).items()]
        files = from_root(self.comm, lambda: input_file_lines(scene.study))
        self._text = study_text(scene.study, [*versions, *scene.physics.lines, *files])
        self._meter = ResourceMeter(self.comm, scene.stepper, began)
        self._forgets = False  # a checkpoint was written: the next step depends on what is in it alone
        stress, by_forces = scene.balance.stress, scene.study.output.cut == "forces"
        self._lock = FolderLock(folder)
        check = partial(_check, folder, scene.study, self._text, restart=restart, overwrite=overwrite)
        try:
            with self.interrupt:
                on_root(self.comm, lambda: lock_checked_folder(self._lock, check))
                self.state = scene.start()
                self.breaks = FractureLog(stress, scene.fracture, cut_by_forces=by_forces)
                notes = self._resume() if restart else None
                self.interrupt.check_setup_signals()
                self._prepare(notes, check)
        except BaseException:
            self._lock.release()
            raise

    def _resume(self) -> CheckpointNotes:
        """Restore the state of the checkpoint; return its notes (collective). Raises InputError."""
        scene, breaks, notes = self.scene, self.breaks, from_root(self.comm, lambda: read_notes(self.folder))
        earlier, lines = physics_lines(notes.study), self.scene.physics.lines
        if earlier != lines:
            raise InputError(
                f"--restart: the run was with {'; '.join(earlier) or 'built-in physics'}, and is to go on with "
                f"{'; '.join(lines) or 'built-in physics'}: give it the same, or run without --restart"
            )
        if missing := sorted(CHECKPOINT_MONITORS - notes.monitors.keys()):
            raise restart_error(checkpoint_path(self.folder), f"notes/monitors has no {missing[0]}")
        state = read_checkpoint(self.folder, scene.domain, self.state, scene.balance, breaks.record, breaks.surfaces)
        breaks.apply_checkpoint()
        try:
            self.state = scene.stepper.from_checkpoint(state)
        except (ValueError, IndexError, TypeError) as error:  # histories of terms, whose arrays have any number of rows
            raise restart_error(checkpoint_path(self.folder), f"its arrays do not fit this study ({error})") from error
        asked = scene.study.model_dump(mode="json")["time"]["step"]
        if notes.study_tables()["time"]["step"] != asked:  # else the size of the last step goes on
            self.state = replace(self.state, dt=scene.study.time.max_step)
        return notes

    def _prepare(self, notes: CheckpointNotes | None, check: Callable[[], None]) -> None:
        """Open the output (collective); `notes`: of the checkpoint to continue from; `check`: of the output folder."""
        study, restart, folder = self.scene.study, notes is not None, self.folder
        step, t = (self.state.step, self.state.t) if restart else (None, None)
        self.front = self._crack_front()
        names = [*self.scene.probes.columns, *(self.front.columns if self.front is not None else [])]
        columns = history_columns(names)
        if step is not None:
            on_root(self.comm, lambda: check_continuable(folder, columns, step))
        on_root(self.comm, lambda: lock_checked_folder(self._lock, check, make=True))
        self.interrupt.has_output = True
        on_root(self.comm, lambda: make_output_folder(folder, self._text, restart=restart))
        self._saved_at = t  # s, of the last checkpoint
        self.history = History(self.comm, folder / "history.csv", names, step, study.thickness)
        self.tips = self._tip_file(step)
        self.monitors = RunMonitors(self.scene, self.history, self._meter)
        if notes is not None:
            self.monitors.from_checkpoint(notes.monitors)
            if self.front is not None:
                self.front.from_checkpoint(notes.monitors)
        self.frames = FrameFiles(
            folder, self.scene.balance, self.scene.fracture, self.breaks,
            fields=wanted_fields(study), surface=wants_surface(study), smooth=wants_smooth(study),
            passing=self.monitors.interpenetration, resume_at=t, thickness=study.thickness,
            precision=study.output.precision,
        )  # fmt: skip
        if notes is not None:
            had = notes.monitors["frames"]
            tip_notes = self.tips.notes if self.tips is not None else []
            early = early_end_notes(notes.study_tables(), study.time.end, self.state.t)
            print_notes(
                self.comm,
                [*early, *self.history.notes, *tip_notes, *missing_frame_notes(folder, had, self.frames.frame_counts)],
            )
        self._clock = FrameSchedule(study.output.every, study.frame_interval)
        self._clock.record_frame(self.state.t)
        self._has_summary = False
        self._frame_of: int | None = None  # the step of the last frame of this part of the run
        # it tells how the run ended, which is open again
        write_on_root(self.comm, folder / "summary.json", lambda: (folder / "summary.json").unlink(missing_ok=True))

    def _crack_front(self) -> CrackExtent | None:
        """Return the record of crack lengths and tips; None if cracks have no cut positions."""
        study = self.scene.study
        if study.fracture is None or not (study.crack or study.fracture.energy):
            return None
        from .output.crack_length import CrackExtent

        assert self.breaks.record is not None
        return CrackExtent(self.breaks.record, initial_cracks(study, self.scene.domain.dim))

    def _tip_file(self, resume_at: int | None) -> TipFile | None:
        """Open tips.csv (collective); None if cracks have no release rate."""
        record = self.scene.fracture.tip_record if self.scene.fracture is not None else None
        if record is None or self.front is None:
            return None
        from .output.tip_file import TipFile

        inertia = self.scene.balance.scheme.inertia
        return TipFile(self.folder / "tips.csv", record, self.front, inertia=inertia, resume_at=resume_at)

    @property
    def ended(self) -> bool:
        """Return whether the run is at the end of the study, or ended by `time.until`."""
        return self.scene.ended(self.state) or self.monitors.load_dropped

    # --- one step, one frame, one checkpoint ---

    def step(self) -> StepReport:
        """Take a step and write its row of history.csv, but no frame (collective).

        Raises NotConverged, CannotWrite, and StepAborted if the run is to stop; the state is then that before the step.
        """
        if self._forgets:
            self.scene.stepper.discard_unsaved_data()
            self._forgets = False
        self.interrupt.begin_step()
        self.state, report = self.scene.stepper.advance(self.state)
        began = time.perf_counter()
        if self.tips is not None:
            self.tips.append(self.state.step, self.state.t)
        if report.broken:
            self.record_breaks()
        probes = self.scene.probes()
        front = self.front.values if self.front is not None else ()
        self.history.append(self.state, report, self.breaks.counts, np.array([*probes, *front]))
        figures = {name: float(value) for name, value in zip(self.scene.probes.columns, probes, strict=True)}
        self.monitors.record_step(self.state, report, figures, self.breaks.counts[0])
        self._meter.output_seconds += time.perf_counter() - began
        return report

    def record_breaks(self) -> None:
        """Record edges that broke since the last step, in it or by hand (collective)."""
        self.breaks.record_breaks(self.state.t)
        if self.front is not None:
            self.front.update()
        if self.tips is not None:
            self.tips.update_cracks()

    def write_frame(self) -> None:
        """Write a frame of the present state, and check the cells (collective). Raises CannotWrite."""
        began = time.perf_counter()
        self.monitors.record_frame(self.state.t)
        self.frames.write_frame(self.state)
        self._clock.record_frame(self.state.t)
        self._frame_of = self.state.step
        self._meter.output_seconds += time.perf_counter() - began

    def write_due_frame(self) -> None:
        """Write a frame if one is due after the step, or the run has ended (collective). Raises CannotWrite."""
        if self.ended or self._clock.is_due(self.state.t, self.state.step):
            self.write_frame()

    def checkpoint(self) -> Path:
        """Write a checkpoint of the present state and return its path (collective).

        The run continues as a restarted one does. Raises CannotWrite, and NotConverged if the state is not finite.
        """
        began = time.perf_counter()
        domain, balance, breaks = self.scene.domain, self.scene.balance, self.breaks
        front = self.front.to_checkpoint() if self.front is not None else {}
        notes = CheckpointNotes(
            self._text, self.monitors.to_checkpoint() | front | {"frames": self.frames.frame_counts}
        )
        breaks.prepare_checkpoint()
        path = write_checkpoint(self.folder, domain, self.state, balance, notes, breaks.record, breaks.surfaces)
        self._saved_at, self._forgets = self.state.t, True
        self._meter.output_seconds += time.perf_counter() - began
        return path

    # --- to the end ---

    def __call__(self) -> dict[str, Any]:
        """Run to the end and return the contents of summary.json (collective).

        Raises NotConverged, Stopped or CannotWrite; the message says how to continue.
        """
        with self._lock, self._progress:
            return self._run_and_draw()

    def close(self) -> None:
        """Close the files of a run that was taken step by step; at its end write summary.json (collective)."""
        if self.ended and not self._has_summary:
            self._finish("done")
        self.history.close()
        self._lock.release()

    def _run_and_draw(self) -> dict[str, Any]:
        self._meter.start_stepping()
        try:
            with self.interrupt:
                summary = self._run()
        except CannotWrite as error:
            raise CannotWrite(f"{error}. {self._restart_advice()}") from None
        finally:
            self.history.close()
        if self.comm.rank == 0 and self.scene.study.output.picture:
            self._progress.set_stage("drawing the last frame")
            _draw(self.folder)
        return summary

    def _run(self) -> dict[str, Any]:
        """Take all steps; write a checkpoint if the run does not come to its end (collective)."""
        self.scene.stepper.set_stop_request(self.interrupt.must_abandon_step)
        try:
            try:
                self._loop()
            finally:
                self._progress.end_line()
        except (NotConverged, Stopped) as error:
            abort_unless_all_failed(self.comm, f"fracsim: {error}", int(error.exit_code))  # what follows is collective
            saved = self._save_last_checkpoint()
            self._finish("not converged" if isinstance(error, NotConverged) else "stopped")
            raise type(error)(f"{error}. {saved}") from None
        return self._finish("done")

    def _loop(self) -> None:
        self._progress.set_stage("the first step")
        if self.state.step == 0:
            self.write_frame()
        if reason := self.interrupt.received_signal():
            raise Stopped(f"stopped by {reason} before the first step, at t = {self.state.t:g} s")
        last, interval = time.monotonic(), self.scene.study.output.checkpoint
        while not self.ended:
            try:
                report = self.step()
            except StepAborted:
                raise self._stop_error("; the step that was under way begins anew") from None
            done = self.ended
            self.write_due_frame()
            self._report_progress(report)
            if interval is not None and self.comm.bcast(time.monotonic() - last > interval):
                self.checkpoint()
                last = time.monotonic()
            if not done and self.interrupt.stop_reason():
                raise self._stop_error()

    def _report_progress(self, report: StepReport) -> None:
        broken, _, pieces = self.breaks.counts
        details = f"Newton {report.solve.newton_iterations}  {report.seconds:.2g} s/step"
        self._progress.update(ProgressState(self.state.t, report.dt, self.state.step, broken, pieces, details))

    def _stop_error(self, more: str = "") -> Stopped:
        """Write a frame and return the error that ends the run at the present state (collective)."""
        if self._frame_of != self.state.step:
            self.write_frame()
        reason, t = self.interrupt.stop_reason(), self.state.t
        return Stopped(f"stopped by {reason} at t = {t:g} s after {self.state.step} steps{more}")

    def _finish(self, outcome: str) -> dict[str, Any]:
        """Write summary.json and return its contents (collective)."""
        summary = self._summary(outcome)
        write_summary(self.comm, self.folder, summary)
        self._has_summary = True
        print_notes(self.comm, self.monitors.notes(done=outcome == "done"))
        return summary

    def _summary(self, outcome: str) -> dict[str, Any]:
        state, domain, thick = self.state, self.scene.domain, self.scene.study.thickness
        broken, split, pieces = self.breaks.counts
        sizes = sum_over_ranks(self.comm, np.array([domain.node_count, domain.cell_count]))
        dust, dust_mass = self.breaks.count_single_nodes(
            self.scene.balance.stress.material.density * domain.volumes * thick
        )
        return {
            "title": self.scene.study.title, "outcome": outcome, "time": state.t, "steps": state.step,
            "nodes": int(sizes[0]), "cells": int(sizes[1]),
            "broken_edges": broken, "split_cells": split, "pieces": pieces, "dust": dust, "dust_mass": dust_mass,
            "external_work": state.work * thick, "dissipated": state.dissipated * thick, **self.monitors.summary(),
        }  # fmt: skip

    # --- where to go on from ---

    def _save_last_checkpoint(self) -> str:
        """Write a last checkpoint and return a sentence that names it; none if the state is not finite (collective)."""
        try:
            return f"Checkpoint: {self.checkpoint()}; go on with --restart"
        except NotConverged as error:
            return f"No checkpoint was written: {error}. {describe_last_checkpoint(self.folder, self._saved_at)}"

    def _restart_advice(self) -> str:
        """Return a sentence on how to continue after output failed: from a new checkpoint or the last one."""
        with contextlib.suppress(CannotWrite):
            write_summary(self.comm, self.folder, self._summary("could not write"))
        try:
            if self.history.last_step == self.state.step:  # a step without its row would leave a gap
                return self._save_last_checkpoint()
        except CannotWrite:
            pass
        return describe_last_checkpoint(self.folder, self._saved_at)


def wanted_fields(study: Study) -> list[str]:
    """Return the names of the fields of fields.xdmf; by default those of the stress and the damage."""
    if study.output.fields is not None:
        return study.output.fields
    return ["damage", "von_mises"] if study.fracture is not None else ["von_mises"]


def wants_smooth(study: Study) -> bool:
    """Return whether cracks are drawn smooth; by default with a look and without contact."""
    if study.output.cut is None:
        return study.output.look != "plain" and study.contact is None and not study.obstacle
    return study.output.cut == "smooth"


def run_study(
    comm: MPI.Comm,
    study: Study,
    folder: Path,
    *,
    restart: bool = False,
    overwrite: bool = False,
    wall_limit: float | None = None,
    source: Path | None = None,
    build: Callable[[MPI.Comm, Study, Callable[[str], None]], Scene] | None = None,
) -> dict[str, Any]:
    """Build the scene, run it, draw the last frame, and return the contents of summary.json (collective).

    Args:
        comm: ranks of the run.
        study: to be run.
        folder: output folder.
        restart: continue from the checkpoint in the folder.
        overwrite: replace a run in the folder that could be continued.
        wall_limit: s from now; None: no limit.
        source: study file, which must not be overwritten.
        build: builds the scene of a deformable body; None: `build_scene`.
    """
    began = time.perf_counter()
    print_notes(comm, study.frame_notes)
    if study.time.scheme == "rigid":
        print_notes(comm, condition_notes(study, 3))
        how = {"restart": restart, "overwrite": overwrite}
        return _run_rigid(comm, study, folder, wall_limit=wall_limit, source=source, **how)
    progress = ProgressReporter(first=comm.rank == 0, end=study.time.end)

    def stage(name: str) -> None:
        progress.set_stage(name)
        interrupt.check_setup_signals()

    with InterruptHandler(comm, wall_limit) as interrupt, FolderLock(folder) as lock, progress:
        check = partial(_check, folder, study, study_text(study), source, restart=restart, overwrite=overwrite)
        on_root(comm, lambda: lock_checked_folder(lock, check))  # at once, not after a mesh of minutes
        scene = (build or build_scene)(comm, study, stage)
        if notes := [*scene.domain.notes, *scene.balance.motion.notes]:
            progress.end_line()
            print_notes(comm, notes)
        try:
            options: dict[str, Any] = {"interrupt": interrupt, "progress": progress, "began": began}
            summary = Run(scene, folder, restart=restart, overwrite=overwrite, **options)()
        except BaseException:
            if comm.size == 1:  # a rank that failed alone would wait for the others here
                scene.destroy()
            raise
        scene.destroy()
        return summary


def _run_rigid(
    comm: MPI.Comm,
    study: Study,
    folder: Path,
    *,
    restart: bool,
    overwrite: bool,
    wall_limit: float | None,
    source: Path | None,
) -> dict[str, Any]:
    """Run rigid bodies on rank 0; the other ranks analyse bodies (collective). The arguments are those of run_study."""
    from .rigid.parallel_analyses import send_to_workers
    from .scene.rigid_scene import build_rigid_scene, serve_rigid_analyses

    def work() -> dict[str, Any]:
        check = partial(_check, folder, study, study_text(study), source, restart=restart, overwrite=overwrite)
        lock_checked_folder(lock, check)
        from .rigid_run import RigidRun, print_mesh_notes

        progress.set_stage("building the bodies")
        scene = build_rigid_scene(study, comm, heed)
        interrupt.check_setup_signals()
        lock_checked_folder(lock, check, make=True)
        progress.end_line()
        print_mesh_notes(scene)
        versions = [f"{key}: {value}" for key, value in software_versions(comm).items()]
        text = study_text(study, [*versions, *collect_physics(study).lines, *input_file_lines(study)])
        summary = RigidRun(scene, folder, text, interrupt, restart=restart, progress=progress)()
        if study.output.picture:
            progress.set_stage("drawing the last frame")
            _draw(folder)
        return summary

    def first() -> dict[str, Any]:
        try:
            return work()
        finally:
            if comm.size > 1:
                send_to_workers(comm, None)

    def heed() -> None:
        if interrupt.must_abandon_step():
            raise StepAborted

    alone, progress = comm.size == 1, ProgressReporter(first=comm.rank == 0, end=study.time.end)
    with InterruptHandler(MPI.COMM_SELF, wall_limit, alone=alone) as interrupt, FolderLock(folder) as lock, progress:
        if comm.rank:
            serve_rigid_analyses(comm, heed)
        return from_root(comm, first)


def _check(
    folder: Path, study: Study, text: str, source: Path | None = None, *, restart: bool, overwrite: bool
) -> None:
    inputs = (
        source,
        study.mesh.file,
        study.mesh.surface,
        study.mesh.outline,
        study.mesh.shell,
        *(item.file for item in study.obstacle),
    )
    check_output_folder(
        folder, text, restart=restart, overwrite=overwrite, inputs=inputs, completed=add_missing_defaults,
        file_lines=partial(input_file_lines, study),
    )  # fmt: skip


def _draw(folder: Path) -> None:
    """Draw the last frame without supersampling; a failure is only reported."""
    try:
        import_outside("pyvista")
        from .report.pictures.picture import render
        from .report.pictures.picture_options import PictureOptions

        render(folder, options=PictureOptions(fine=False))
    except (ImportError, InputError, OSError, RuntimeError) as error:
        print(f"fracsim: no picture drawn: {one_line(str(error))}", file=sys.stderr)
