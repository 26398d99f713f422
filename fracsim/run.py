"""A run: steps a scene to its end and writes the output folder."""

from __future__ import annotations

import json
import resource
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from .errors import NotConverged, Stopped
from .mesh.bodies import bodies_of
from .mesh.ranks import end_unless_all_failed, on_root, total
from .output.checkpoint import read_checkpoint, write_checkpoint
from .output.energy_gain import Gained
from .output.fields import Frames
from .output.fields_file import FieldsFile
from .output.folder import OutputClock, make_folder, versions
from .output.history import History
from .output.interrupt import Interrupt
from .output.inverted_cells import Inverted
from .output.progress import Progress
from .scene import Scene, build_scene
from .study import Study
from .study.file import study_text

if TYPE_CHECKING:
    from .fracture.record import EdgeRecord
    from .mesh.pieces import Pieces
    from .output.surface.output import SurfaceOutput


class Run:
    """Steps a scene to its end and writes the output folder."""

    def __init__(
        self,
        scene: Scene,
        folder: Path,
        *,
        restart: bool = False,
        wall_limit: float | None = None,
        began: float | None = None,
    ) -> None:
        """Start or resume; makes the output folder. `began`: when the work on the scene began (perf_counter)."""
        self.scene, self.folder, self.comm = scene, folder, scene.domain.comm
        self._interrupt = Interrupt(self.comm, wall_limit)
        self.state = scene.start()
        self.record = self._make_record()
        if restart:
            stress = scene.balance.stress
            state = read_checkpoint(folder, scene.domain, self.state, stress, self.record, self._surfaces)
            self.state = scene.stepper.resume(state)
        self._prepare(restart)
        self._damage = self._count_damage()
        self.output_seconds = 0.0
        self._began = time.perf_counter() if began is None else began

    @property
    def _graph(self) -> Any:
        return self.scene.fracture.graph if self.scene.fracture is not None else None

    @property
    def _surfaces(self) -> Any:
        return brittle_surfaces(self.scene.fracture)

    # --- set-up ---

    def _prepare(self, restart: bool) -> None:
        study, step = self.scene.study, self.state.step if restart else None
        on_root(self.comm, lambda: make_folder(self.folder, self._resolved(), restart))
        root = self.comm.rank == 0
        self.history = History(self.folder / "history.csv" if root else None, self.scene.probes.names, step)
        names = study.output.fields if study.output.fields is not None else default_fields(study)
        self.frames = Frames(self.scene.balance.stress, names, self.scene.fracture)
        self.inverted = Inverted(self.scene.balance.stress, self.scene.fracture)
        self.gained = Gained(at_rest=study.initial is None and not restart)
        source = self.scene.domain.source
        self.fields = FieldsFile(self.folder, source, self.state.t if restart else None) if source is not None else None
        self._open_surface(restart)
        self._clock = OutputClock(study.output, study.time)
        self._clock.wrote(self.state)
        self._bodies = int(self.comm.bcast(bodies_of(source)[0] if source is not None else None))

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

    def _resolved(self) -> str:
        return study_text(self.scene.study, [f"{key}: {value}" for key, value in versions(self.comm).items()])

    # --- the loop ---

    def __call__(self) -> dict[str, Any]:
        """Run to the end; returns what summary.json says. Raises NotConverged or Stopped after a checkpoint."""
        self._setup_seconds = time.perf_counter() - self._began
        self._cpu_began = time.process_time()
        progress = Progress(self.comm, self.scene.study)
        try:
            with self._interrupt, progress:
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

    def _finish(self, outcome: str) -> dict[str, Any]:
        """summary.json; only on ways out that all ranks take, since it sums over them."""
        summary = self._summary(outcome)
        self.history.close()
        if self.comm.rank == 0:
            for note in (self.inverted.note(self.scene.study.material.energy), self.gained.note()):
                if note:
                    print(f"fracsim: note: {note}", file=sys.stderr)
            (self.folder / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
            if self.scene.study.output.picture:
                _draw(self.folder)
        return summary

    def _loop(self, progress: Progress) -> None:
        state, end = self.state, self.scene.study.time.end
        if state.step == 0:
            self._write_frame()
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
        if self.fields is not None and self.state.t not in self.fields.times:
            self.fields.write(self.state.t, fields)
        if self.surface is not None:
            self.surface.write(self.state, fields)
        self._clock.wrote(self.state)
        self.output_seconds += time.perf_counter() - began

    def _checkpoint(self) -> Path:
        began = time.perf_counter()
        path = write_checkpoint(
            self.folder, self.scene.domain, self.state, self.scene.balance.stress, self.record, self._surfaces
        )
        self.output_seconds += time.perf_counter() - began
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
        state, stepper, domain = self.state, self.scene.stepper, self.scene.domain
        broken, split, pieces = self._figures()
        sizes = total(self.comm, np.array([domain.node_count, domain.cell_count]))
        memory = total(self.comm, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)[0]
        cpu = total(self.comm, time.process_time() - self._cpu_began)[0]  # of all ranks, s: hardly feels other work
        seconds = {"setup": self._setup_seconds, **stepper.phases, "output": self.output_seconds}
        return {
            "title": self.scene.study.title, "outcome": outcome, "time": state.t, "steps": state.step,
            "steps_failed": stepper.trouble.steps_failed, "nodes": int(sizes[0]), "cells": int(sizes[1]),
            "broken_edges": broken, "split_cells": split, "pieces": pieces,
            "smallest_J": self.inverted.least, "inverted_cells": self.inverted.count,
            "external_work": state.work, "dissipated": state.dissipated, "peak_reactions": self.history.peaks,
            "seconds": {key: round(value, 4) for key, value in seconds.items()},
            "wall": round(time.perf_counter() - self._began, 3), "cpu": round(float(cpu), 4),
            "peak_memory_MiB": round(float(memory), 1),
            "ranks": self.comm.size, "versions": versions(self.comm),
        }  # fmt: skip


def brittle_surfaces(breaking: Any) -> Any:
    """What starts surfaces, where the study has [brittle]; None elsewhere."""
    return breaking.criterion if breaking is not None and hasattr(breaking.criterion, "starts") else None


def default_fields(study: Study) -> list[str]:
    """Fields of a study that names none."""
    return ["damage", "von_mises"] if study.fracture is not None else ["von_mises"]


def run_study(
    comm: MPI.Comm, study: Study, folder: Path, *, restart: bool = False, wall_limit: float | None = None
) -> dict[str, Any]:
    """Build, run, draw the last frame; returns the summary (collective)."""
    began = time.perf_counter()
    scene = build_scene(comm, study)
    if scene.domain.source is not None:
        for note in scene.domain.source.notes:
            print(f"fracsim: note: {note}", file=sys.stderr)
    try:
        return Run(scene, folder, restart=restart, wall_limit=wall_limit, began=began)()
    finally:
        scene.destroy()


def _draw(folder: Path) -> None:
    """A picture of the last frame; a machine that cannot draw loses the picture, not the run."""
    from .report.picture import render

    try:
        render(folder)
    except (ImportError, OSError, RuntimeError) as error:
        print(f"fracsim: no picture drawn: {error}", file=sys.stderr)
