"""Run of rigid bodies, on rank 0. The output folder is that of other runs, without fields.xdmf."""

from __future__ import annotations

import contextlib
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from .errors import CannotWrite, NotConverged, StepAborted, Stopped
from .meshes.data import mesh_fingerprint
from .monitors import missed_peak_monitor
from .output.atomic_write import write_on_root
from .output.checkpoint_file import (
    CHECKPOINT_LIMITS,
    CheckpointNotes,
    StoredCheckpoint,
    check_mesh,
    check_names,
    checkpoint_path,
    describe_last_checkpoint,
    read_checkpoint_file,
    restart_error,
    write_checkpoint_file,
)
from .output.history import History, history_columns, read_earlier_rows
from .output.interrupt import InterruptHandler
from .output.progress import ProgressReporter, ProgressState
from .output.rigid_frames import RigidFrames
from .output.run_folder import (
    FrameSchedule,
    check_text_files,
    early_end_notes,
    make_output_folder,
    missing_frame_notes,
    software_versions,
)
from .output.summary import print_notes, write_summary
from .rigid.rigid_stepper import RigidReport
from .scene.rigid_scene import RigidScene

if TYPE_CHECKING:
    from collections.abc import Callable

    from .rigid.instances import Instances

ROOT_COMM = MPI.COMM_SELF
# Names in a checkpoint: of numbers, of monitors, of monitors that earlier versions did not store, and of arrays that
# only broken or dented bodies have.
CLOCK_NAMES = ("t", "step", "work", "start")
MONITOR_NAMES = {"blows", "loads", "frames"}
LATER_MONITOR_NAMES = {"effort", "contact_errors", "missed_peak"}
OPTIONAL_ARRAYS = ("broken", "cut", "starts", "starts_of", "shape_of", "shape_points", "shape_yields")
ARRAYS_OF_ONE_LENGTH = (
    ("broken", "cut"), ("starts", "starts_of"), ("shape_of", "shape_points", "shape_yields"),
    ("overlap.names", "overlap.parts", "overlap.depth"), ("known.names", "known.quiet", "known.borne"),
    ("known.pairs", "known.pushed"), ("known.on", "known.where", "known.gave", "known.spread"),
)  # fmt: skip


class RigidRun:
    """Scene of rigid bodies and its output folder; a call runs to the end.

    Attributes:
        scene: that is stepped.
        folder: output folder.
        text: of study.toml, without its head.
        state: present state.
        broken: number of broken edges.
        blows: number of blows.
        loads: number of loads.
        history: rows of history.csv.
        frames: surface files.
    """

    def __init__(
        self,
        scene: RigidScene,
        folder: Path,
        text: str,
        interrupt: InterruptHandler,
        *,
        restart: bool = False,
        progress: ProgressReporter | None = None,
    ) -> None:
        """Open the output folder.

        Args:
            scene: to be stepped.
            folder: output folder.
            text: of study.toml, without its head.
            interrupt: signals and the limit of wall time.
            restart: continue from the checkpoint in the folder.
            progress: reporter that is in use already; None: a new one.

        Raises:
            InputError: the checkpoint does not fit.
            CannotWrite: output failed.
        """
        self._progress = progress or ProgressReporter(first=True, end=scene.study.time.end)
        self.scene, self.folder, self._interrupt, self.text = scene, folder, interrupt, text
        self.state, self._began, self._cpu = scene.initial_state, time.perf_counter(), time.process_time()
        self.broken = self.blows = self.loads = 0
        # times, s, and errors of velocities, m/s, of steps in which contact did not converge
        self._contact_errors: list[tuple[float, float]] = []
        self._missed_peak = missed_peak_monitor(scene.study, 3)
        self._start = scene.initial_state.bodies.kinetic_energy
        # of the parts of the run before a restart
        self._effort_before: dict[str, Any] = {"analyses": 0, "wall": 0.0, "cpu": 0.0, "seconds": {}}
        arrays = self._resume() if restart else None
        step, t = (self.state.step, self.state.t) if arrays is not None else (None, None)
        # time of the last checkpoint, s
        self._saved_at = t
        names = [f"contact_{obstacle.name}_{axis}" for obstacle in scene.obstacles for axis in "xyz"]
        names += [f"work_{obstacle.name}" for obstacle in scene.obstacles] + scene.stepper.obstacles.columns()
        if step is not None:
            read_earlier_rows(folder / "history.csv", history_columns(names), step)
            check_text_files(folder)
        interrupt.has_output = True
        make_output_folder(folder, text, restart=restart)
        self.history = History(ROOT_COMM, folder / "history.csv", names, step)
        density = float(scene.study.material.density)
        self.frames = self._write(
            folder / "surface.pvd",
            lambda: RigidFrames(
                folder,
                scene.instance_mesh,
                scene.poses,
                density,
                scene.obstacles,
                t,
                precision=scene.study.output.precision,
            ),
        )
        if arrays is not None:
            self.frames.resume(arrays["broken_at"])
            self.broken = int(np.count_nonzero(np.isfinite(arrays["broken_at"])))
            self.history.obstacle_work |= dict(
                zip(self.history.obstacle_work, map(float, arrays["worked"]), strict=True)
            )
            missing = missing_frame_notes(folder, self._frame_counts, self.frames.files.frame_counts)
            print_notes(ROOT_COMM, [*self._early_end, *self.history.notes, *missing])
        self._clock = FrameSchedule(scene.study.output.every, scene.study.frame_interval)
        self._clock.record_frame(self.state.t)
        write_on_root(ROOT_COMM, folder / "summary.json", lambda: (folder / "summary.json").unlink(missing_ok=True))

    def _write[T](self, path: Path, work: Callable[[], T]) -> T:
        """Return the result of work that writes a file. Raises CannotWrite."""
        result = write_on_root(ROOT_COMM, path, work)
        assert result is not None
        return result

    def _resume(self) -> dict[str, npt.NDArray[Any]]:
        """Restore the state of the checkpoint; return its arrays. Raises InputError."""
        stored, stepper = read_checkpoint_file(self.folder), self.scene.stepper
        check_mesh(stored, mesh_fingerprint(self.scene.mesh))
        arrays, clock, earlier = stored.arrays, stored.clock, stored.notes.monitors
        _check_stored(stored, stepper.to_checkpoint(self.state), len(self.scene.obstacles), stepper.instances)
        self._start = float(clock["start"])
        try:
            self.state = stepper.from_checkpoint(arrays, float(clock["t"]), int(clock["step"]), float(clock["work"]))
        except (ValueError, IndexError, TypeError) as error:
            raise restart_error(stored.path, f"its arrays do not fit this study ({error})") from error
        if len(self.state.bodies) != len(stepper.body_names) or len(arrays["broken_at"]) != len(
            stepper.instances.damage()[1]
        ):
            raise restart_error(stored.path, "its bodies are not those that its broken edges leave")
        self._early_end = early_end_notes(stored.notes.study_tables(), self.scene.study.time.end, self.state.t)
        self.blows, self.loads, self._frame_counts = earlier["blows"], earlier["loads"], earlier["frames"]
        # an earlier version stored none of these
        self._effort_before |= earlier.get("effort", {})
        self._contact_errors = [(float(t), float(error)) for t, error in earlier.get("contact_errors", [])]
        if self._missed_peak is not None:
            self._missed_peak.from_checkpoint(earlier)
        return arrays

    # --- a step, a frame, a checkpoint ---

    def step(self) -> RigidReport:
        """Take a step and write its row of history.csv.

        Raises NotConverged, CannotWrite, and StepAborted if the run is to stop.
        """
        stepper = self.scene.stepper
        self._interrupt.begin_step()
        self.state, report = stepper.advance(self.state)
        if self._missed_peak is not None:
            self._missed_peak.record_step(self.state.t, self.scene.study.time.max_step)
        if report.broken:
            self.frames.record_breaks(stepper.instances.damage()[0], self.state.t)
        self.broken, self.blows, self.loads = (
            self.broken + report.broken, self.blows + report.blows, self.loads + report.loads
        )  # fmt: skip
        state, split = self.state, stepper.instances.split_cell_count
        if report.contact_error:
            self._contact_errors.append((state.t, report.contact_error))
        lost = self._start + state.work - report.kinetic_energy
        self.history.append_row([
            state.step, state.t, self.scene.study.time.max_step, report.kinetic_energy, 0.0, lost, state.work,
            self.broken, split, stepper.fragment_count, report.blows + report.loads, report.cg_iterations,
            report.seconds,
            *map(float, report.obstacle_forces.flat), *map(float, report.obstacle_work),
            *map(float, stepper.obstacles.readings(state.bodies)),
        ])  # fmt: skip
        return report

    def write_frame(self) -> None:
        """Write a frame of the present state. Raises CannotWrite."""
        state, instances = self.state, self.scene.stepper.instances
        damage, shapes = instances.damage(), instances.dented_shapes
        dented = {number: shape.points for number, shape in shapes.items()}
        path, placed = self.folder / "surface.pvd", self.scene.stepper.obstacles.placed_shapes(state.t, state.bodies)
        write_on_root(ROOT_COMM, path, lambda: self.frames.write_frame(state.t, state.bodies, *damage, dented, placed))
        self._clock.record_frame(state.t)

    def checkpoint(self) -> Path:
        """Write a checkpoint of the present state, which is finite, and return its path. Raises CannotWrite."""
        state, path = self.state, checkpoint_path(self.folder)
        arrays = self.scene.stepper.to_checkpoint(state) | {"broken_at": self.frames.broken_at}
        arrays["worked"] = np.array([*self.history.obstacle_work.values()])
        clock = {"t": state.t, "step": state.step, "work": state.work, "start": self._start}
        counts = {"blows": self.blows, "loads": self.loads, "frames": self.frames.files.frame_counts}
        counts |= {"effort": self._effort(), "contact_errors": self._contact_errors}
        if self._missed_peak is not None:
            counts |= self._missed_peak.to_checkpoint()
        notes = CheckpointNotes(self.text, counts)
        fingerprint = mesh_fingerprint(self.scene.mesh)
        write_on_root(ROOT_COMM, path, lambda: write_checkpoint_file(path, arrays, clock, fingerprint, notes))
        self._saved_at = state.t
        return path

    def _effort(self) -> dict[str, Any]:
        """Return the analyses and seconds of all parts of the run so far, as in summary.json."""
        before, phases = self._effort_before, self.scene.stepper.phases.seconds
        seconds = {name: round(before["seconds"].get(name, 0.0) + value, 4) for name, value in phases.items()}
        return {
            "analyses": before["analyses"] + self.scene.stepper.instances.analyses, "seconds": seconds,
            "wall": round(before["wall"] + time.perf_counter() - self._began, 3),
            "cpu": round(before["cpu"] + time.process_time() - self._cpu, 4),
        }  # fmt: skip

    # --- to the end ---

    def __call__(self) -> dict[str, Any]:
        """Run to the end and return the contents of summary.json. Raises NotConverged, Stopped, CannotWrite."""
        try:
            with self._progress:
                return self._run()
        except CannotWrite as error:
            raise CannotWrite(f"{error}. {self._restart_advice()}") from None
        finally:
            self.history.close()

    def _run(self) -> dict[str, Any]:
        """Take all steps; write a checkpoint if the run does not come to its end."""
        try:
            self._progress.set_stage("the first step")
            if self.state.step == 0:
                self.write_frame()
            try:
                self._loop()
            finally:
                self._progress.end_line()
        except (NotConverged, Stopped) as error:
            failed = isinstance(error, NotConverged)
            saved = self._save_last_checkpoint(failed=failed)
            self._finish("not converged" if failed else "stopped")
            raise type(error)(f"{error}. {saved}") from None
        return self._finish("done")

    def _save_last_checkpoint(self, *, failed: bool) -> str:
        """Write a last checkpoint and return a sentence that names it.

        After a step that `failed` none is written, since a blow in the step would be lost.
        """
        if not failed:
            return f"Checkpoint: {self.checkpoint()}; go on with --restart"
        last = describe_last_checkpoint(self.folder, self._saved_at)
        return f"No checkpoint was written: a blow in the step that failed would be lost. {last}"

    def _restart_advice(self) -> str:
        """Return a sentence on how to continue after output failed: from a new checkpoint or the last one."""
        with contextlib.suppress(CannotWrite):
            self._finish("could not write")
        try:
            # a step without its row would leave a gap
            if self.history.last_step == self.state.step:
                return self._save_last_checkpoint(failed=False)
        except CannotWrite:
            pass
        return describe_last_checkpoint(self.folder, self._saved_at)

    def _loop(self) -> None:
        """Take steps to the end of the study, with frames and checkpoints. Raises Stopped."""
        last, interval = time.monotonic(), self.scene.study.output.checkpoint
        while not self.scene.ended(self.state):
            try:
                report = self.step()
            except StepAborted:
                raise self._stop_error("; the step that was under way begins anew") from None
            done = self.scene.ended(self.state)
            if done or self._clock.is_due(self.state.t, self.state.step):
                self.write_frame()
            self._report_progress(report)
            if interval is not None and time.monotonic() - last > interval:
                self.checkpoint()
                last = time.monotonic()
            if not done and self._interrupt.stop_reason():
                raise self._stop_error()

    def _report_progress(self, report: RigidReport) -> None:
        """Print the progress of the run."""
        state, pieces, dt = self.state, self.scene.stepper.fragment_count, self.scene.study.time.max_step
        details = f"analyses {report.blows + report.loads}  {report.seconds:.2g} s/step"
        self._progress.update(ProgressState(state.t, dt, state.step, self.broken, pieces, details))

    def _stop_error(self, more: str = "") -> Stopped:
        """Return the error that ends the run at the present state."""
        reason, state = self._interrupt.stop_reason(), self.state
        return Stopped(f"stopped by {reason} at t = {state.t:g} s after {state.step} steps{more}")

    def _finish(self, outcome: str) -> dict[str, Any]:
        """Write summary.json and return its contents."""
        state, scene = self.state, self.scene
        kinetic = state.bodies.kinetic_energy
        summary = {
            "title": scene.study.title, "outcome": outcome, "time": state.t, "steps": state.step,
            "nodes": len(scene.mesh.points), "cells": len(scene.mesh.cells), "broken_edges": self.broken,
            "split_cells": scene.stepper.instances.split_cell_count, "pieces": scene.stepper.fragment_count,
            **self._count_single_nodes(),
            "external_work": state.work, "dissipated": self._start + state.work - kinetic,
            "blows": self.blows, "loads": self.loads, **self._effort(),
            "ranks": MPI.COMM_WORLD.size, "versions": software_versions(MPI.COMM_WORLD),
        }  # fmt: skip
        write_summary(ROOT_COMM, self.folder, summary)
        missed = self._missed_peak.notes() if self._missed_peak is not None else []
        print_notes(ROOT_COMM, [*contact_notes(self._contact_errors), *missed])
        return summary

    def _count_single_nodes(self) -> dict[str, float]:
        """Return the number of single-node fragments and their mass, kg."""
        nodes = np.bincount(self.scene.stepper.shapes.node_fragment, minlength=self.scene.stepper.fragment_count)
        single = np.flatnonzero(nodes == 1)
        return {"dust": len(single), "dust_mass": float(self.state.bodies.mass[single].sum())}


def contact_notes(errors: list[tuple[float, float]]) -> list[str]:
    """Return a note on the steps in which contact did not converge.

    `errors`: times, s, and errors of velocities, m/s, of these steps.
    """
    if not errors:
        return []
    t, worst = max(errors, key=lambda step: step[1])
    steps = "1 step" if len(errors) == 1 else f"{len(errors)} steps"
    return [
        f"contact of rigid bodies did not converge in {steps}; velocities after the step to t = {t:g} s are off by "
        f"up to {worst:.2g} m/s: compare a run with a smaller time.step"
    ]


def print_mesh_notes(scene: RigidScene) -> None:
    """Print the notes on the mesh, such as what was repaired while it was read."""
    print_notes(ROOT_COMM, list(scene.mesh.notes))


def _check_stored(
    stored: StoredCheckpoint, initial: dict[str, npt.NDArray[Any]], obstacles: int, instances: Instances
) -> None:
    """Raise InputError if a checkpoint lacks a value, or has one of another shape or that is not finite.

    Args:
        stored: the checkpoint.
        initial: arrays that the run would store at its start.
        obstacles: number of obstacles.
        instances: of the mesh.
    """
    arrays, path = stored.arrays, stored.path
    expected = initial | {"broken_at": np.empty(0), "worked": np.zeros(obstacles)}
    check_names(arrays, set(expected), {*expected, *OPTIONAL_ARRAYS}, path)
    check_names(stored.clock, set(CLOCK_NAMES), set(CLOCK_NAMES), path)
    check_names(stored.notes.monitors, MONITOR_NAMES, MONITOR_NAMES | LATER_MONITOR_NAMES, path)
    bodies = len(arrays["body.mass"])
    for name, values in arrays.items():
        first = {"worked": (obstacles,)} | ({name: (bodies,)} if name.startswith("body.") else {})
        if values.ndim == 0:
            raise restart_error(path, f"{name} is one number")
        right = (*first.get(name, values.shape[:1]), *expected.get(name, values).shape[1:])
        if values.shape != right:
            raise restart_error(path, f"{name} has the shape {values.shape}, of this study it is {right}")
        if expected.get(name, values).dtype.kind == "i" and values.dtype.kind != "i":
            raise restart_error(path, f"{name} is not all whole numbers")
        # infinite: an overlap that was not measured; an edge that is not broken
        if name in ("overlap.depth", "broken_at"):
            values = np.where(values == np.inf, 0.0, values)
        # no number: cut in the middle
        elif name == "cut":
            values = np.nan_to_num(values)
        if not float(np.max(np.abs(values), initial=0.0)) < CHECKPOINT_LIMITS.magnitude:
            raise restart_error(path, f"{name} is not finite")
    for group in ARRAYS_OF_ONE_LENGTH:
        if len({len(arrays.get(name, ())) for name in group}) > 1:
            raise restart_error(path, f"{' and '.join(group)} do not belong together")
    limits = {"broken": len(instances) * instances.node_count, "starts_of": len(instances), "shape_of": len(instances)}
    for name, count in limits.items():
        numbers = arrays.get(name, np.empty(0, np.int64))
        if numbers.dtype.kind != "i" or np.any((numbers < 0) | (numbers >= count)):
            raise restart_error(path, f"{name} is not all from 0 to {count - 1}")
    if len(arrays.get("broken", ())) != np.count_nonzero(np.isfinite(arrays["broken_at"])):
        raise restart_error(path, "broken and broken_at do not belong together")
