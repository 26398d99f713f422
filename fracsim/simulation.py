"""Python interface: load a study, run it, or take its steps one by one (docs/python.md).

    import fracsim

    output = fracsim.run("bar-2d", out="out/bar-2d")
    with fracsim.Simulation("bar-2d") as simulation:
        while not simulation.ended:
            simulation.step()

Every call is collective: all ranks of the communicator make it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from .process import import_dolfinx, import_outside

# A script that imports this module takes no settings of PETSc or DOLFINx from the working folder, as the command does.
import_outside("mpi4py.MPI")
import_dolfinx()

from dolfinx import fem  # noqa: E402
from dolfinx.mesh import Mesh  # noqa: E402
from mpi4py import MPI  # noqa: E402

from .deformable_run import Run, run_study, wants_smooth  # noqa: E402
from .errors import InputError  # noqa: E402
from .mesh.ghost_exchange import with_ghosts  # noqa: E402
from .mesh.given_mesh import GivenMesh, NamedTags  # noqa: E402
from .mesh.parallel import failing_together  # noqa: E402
from .meshes.data import MeshData  # noqa: E402
from .meshes.parameters import Builder  # noqa: E402
from .output.fields_file import pad_to_3d  # noqa: E402
from .output.fracture_log import FractureLog  # noqa: E402
from .output.frame_files import FieldEvaluator, surface_output  # noqa: E402
from .output.history import History  # noqa: E402
from .report.run_output import RunOutput, as_folder  # noqa: E402
from .scene import Scene, build_scene  # noqa: E402
from .simulation_inputs import Overrides, StudySource, load, prepare_inputs  # noqa: E402
from .study.reader import find_study  # noqa: E402
from .timestepping.state import State  # noqa: E402

if TYPE_CHECKING:
    from .output.surface.body_surface import SurfaceFrame
    from .output.surface.surface_output import SurfaceOutput

__all__ = ["Simulation", "load", "run"]

Values = npt.NDArray[np.float64]


def run(
    study: StudySource,
    out: str | Path,
    *,
    overrides: Overrides = (),
    restart: bool = False,
    overwrite: bool = False,
    wall_limit: float | None = None,
    comm: MPI.Intracomm | None = None,
    **parts: Any,
) -> RunOutput:
    """Run a study to its end, as `fracsim run` does, and return the output folder (collective).

    Args:
        study: as for `load`.
        out: output folder.
        overrides: as for `load`.
        restart: continue from the checkpoint in the folder.
        overwrite: replace a run in the folder that could be continued.
        wall_limit: wall time after which the run stops with a checkpoint, s.
        comm: communicator of the run; None: that of `mesh`, or MPI.COMM_WORLD.
        parts: mesh, facets, regions, energy, criterion, edge_law, scheme, terms and boundary, as for `Simulation`.

    Raises:
        InputError: study, mesh, physics or folder cannot be used.
        NotConverged, Stopped, CannotWrite: the run ended early; the message says how to continue.
    """
    folder = as_folder(out, "out")
    if wall_limit is not None and not (isinstance(wall_limit, int | float) and 0 <= wall_limit < math.inf):
        raise InputError(f"wall_limit = {wall_limit!r}: give a number of seconds, 0 or more, or None for no limit")
    body = prepare_inputs(study, overrides, comm, **parts)
    source = find_study(study) if isinstance(study, str) else study if isinstance(study, Path) else None
    with failing_together(body.comm):
        run_study(
            body.comm, body.study, folder, restart=restart, overwrite=overwrite, wall_limit=wall_limit, source=source,
            build=partial(build_scene, given=body.arrays, physics=body.physics),
        )  # fmt: skip
    body.comm.Barrier()
    return RunOutput(folder)


class Simulation:
    """A deformable body that breaks, step by step; with an output folder if one is given.

    A mesh that is handed over is gathered on rank 0, renumbered (nodes by their coordinates) and distributed anew
    without ghost cells. `mesh` is the mesh of the program. `node_numbers` and `cell_numbers` are the map from its nodes
    and cells to those of the mesh that was handed over.

    Attributes:
        study: that is simulated.
        comm: communicator.
        scene: objects of the program, without a promise to stay as they are.
        state: present state: arrays `u`, `v`, `a` of the owned dofs, time `t`, number of steps `step`.
    """

    def __init__(
        self,
        study: StudySource,
        out: str | Path | None = None,
        *,
        overrides: Overrides = (),
        restart: bool = False,
        overwrite: bool = False,
        comm: MPI.Intracomm | None = None,
        mesh: Mesh | MeshData | Builder | None = None,
        facets: NamedTags | None = None,
        regions: NamedTags | None = None,
        energy: Any = None,
        criterion: Any = None,
        edge_law: Any = None,
        scheme: Any = None,
        terms: Sequence[Any] = (),
        boundary: Sequence[Mapping[str, Any]] = (),
    ) -> None:
        """Build the body at t = 0, or at the checkpoint of a restart (collective).

        Args:
            study: as for `load`. With `mesh` its tables need no [mesh].
            out: output folder, written as `run` does; None: nothing is written.
            overrides: as for `load`.
            restart: continue from the checkpoint in the folder.
            overwrite: replace a run in the folder that could be continued.
            comm: communicator; None: that of `mesh`, or MPI.COMM_WORLD.
            mesh: straight triangles or tetrahedra in m: a mesh of DOLFINx on any number of ranks; or a `MeshData` of
                fracsim.meshes, or an object whose `build()` returns one on rank 0.
            facets: tags of facets, and the tag of each group: `(tags, {"left": 1, "right": 2})`.
            regions: tags of cells, and the tag of each region: `(tags, {"crust": 7})`.
            energy: object with `psi(F)`, J/m^3, F (3, 3); or a class or function that makes one of its arguments
                `mu`, `lmbda` (Pa) and `mesh`, or some of them.
            criterion: function `load(stress, edges, strength)` with arrays (n, d, d), (n, k, d) and (n, k), which
                returns loads (n, k); an edge breaks at 1.
            edge_law: function of loads (n,) from 1 on that returns integrities (n,), 1 whole to 0 broken.
            scheme: implicit time scheme (forms.schemes.Scheme), or its class; in place of `time.scheme`.
            terms: classes or functions that make a `fracsim.Term` of a `TermInputs` (`u`, `domain`, `stress`, `mass`).
            boundary: entries as in [[boundary]], whose displacement, traction, force or pressure is a function of t
                (s), or of t and x (n, d); for a displacement with `components`, such as "x".

        Raises:
            InputError: study, mesh, physics or folder cannot be used; the message names what and why.
        """
        folder = None if out is None else as_folder(out, "out")
        body = prepare_inputs(
            study, overrides, comm, mesh, facets, regions, energy=energy, criterion=criterion, edge_law=edge_law,
            scheme=scheme, terms=terms, boundary=boundary,
        )  # fmt: skip
        self.comm, self.study, self._given = body.comm, body.study, body.numbers
        self._has_numbers = isinstance(mesh, Mesh)
        if self.study.time.scheme == "rigid":
            raise InputError('time.scheme = "rigid" moves many bodies, which Simulation does not: use fracsim.run')
        if restart and out is None:
            raise InputError("restart continues from the checkpoint in a folder: give out=...")
        self._closed = False
        self._functions: dict[str, fem.Function] = {}
        self._surface: SurfaceOutput | None = None
        self._columns: dict[str, list[float]] = {}
        with failing_together(self.comm):
            self.scene: Scene = build_scene(self.comm, self.study, given=body.arrays, physics=body.physics)
        self._run: Run | None = None
        try:
            if folder is not None:
                self._run = Run(self.scene, folder, restart=restart, overwrite=overwrite)
                self._breaks, self._history = self._run.breaks, self._run.history
                if self.state.step == 0:
                    self._run.write_frame()
            else:
                self._state = self.scene.start()
                self._breaks = FractureLog(self.scene.balance.stress, self.scene.fracture)
                self._history = History(self.comm, None, self.scene.probes.columns, thickness=self.study.thickness)
        except BaseException:
            if self.comm.size == 1:  # a rank that failed alone would wait for the others here
                self.scene.destroy()
            raise

    # --- steps ---

    @property
    def state(self) -> State:
        """Present state. It is never written to."""
        return self._state if self._run is None else self._run.state

    @property
    def t(self) -> float:
        """Present time, s."""
        return self.state.t

    @property
    def ended(self) -> bool:
        """Whether the study is at its end."""
        return self.scene.ended(self.state) if self._run is None else self._run.ended

    def step(self) -> dict[str, float]:
        """Take a step and return its row of history.csv by column (collective).

        With an output folder the row, and a frame if one is due, are written.

        Raises:
            NotConverged: the step failed; `state` is that before it.
            InputError: the study is at its end.
        """
        self._check_open()
        if self.scene.ended(self.state):
            end = self.study.time.end
            raise InputError(f"the simulation is at its end, time.end = {end:g} s: step while not simulation.ended")
        with failing_together(self.comm):
            self._advance()
        for name in self._functions:
            self._update_function(name)
        row = {name: float(value) for name, value in self._history.last_row.items()}
        for name, value in row.items():
            self._columns.setdefault(name, []).append(value)
        return row

    def _advance(self) -> None:
        if self._run is not None:
            self._run.step()
            self._run.write_due_frame()
            return
        self._state, report = self.scene.stepper.advance(self._state)
        if report.broken:
            self._breaks.record_breaks(self._state.t)
        self._history.append(self._state, report, self._breaks.counts, self.scene.probes())

    def run(self) -> None:
        """Take all steps to the end of the study (collective). With an output folder progress is shown on stderr.

        Raises:
            NotConverged, Stopped, CannotWrite: the message says how to continue.
        """
        self._check_open()
        if self._run is not None:
            with failing_together(self.comm):
                self._run()
            for name in self._functions:
                self._update_function(name)
        while not self.ended:
            self.step()

    @property
    def history(self) -> dict[str, Values]:
        """Columns of history.csv by name, (steps,) each, of the steps that `step` has taken."""
        return {name: np.array(values) for name, values in self._columns.items()}

    # --- fields ---

    @property
    def mesh(self) -> Mesh:
        """Mesh of DOLFINx, without ghost cells; coordinates are those at rest, m."""
        return self.scene.domain.mesh

    @property
    def displacement(self) -> fem.Function:
        """Displacement, m: one function of DOLFINx, whose values follow the steps."""
        return self._function("displacement")

    @property
    def velocity(self) -> fem.Function:
        """Velocity, m/s: one function of DOLFINx, whose values follow the steps."""
        return self._function("velocity")

    @property
    def damage(self) -> fem.Function:
        """Share of broken edges of each cell, 0 to 1 (DG0): one function of DOLFINx, whose values follow the steps."""
        return self._function("damage")

    def _function(self, name: str) -> fem.Function:
        if name not in self._functions:
            domain = self.scene.domain
            space = domain.scalar_cell_space if name == "damage" else domain.space
            self._functions[name] = fem.Function(space, name=name)
            self._update_function(name)
        return self._functions[name]

    def _update_function(self, name: str) -> None:
        """Set the values of a function to those of the state (collective)."""
        values, fracture = self._functions[name].x.array, self.scene.fracture
        if name == "damage":
            if fracture is not None:
                graph = fracture.graph
                values[: self.scene.domain.cell_count] = graph.broken[graph.cell_edges].mean(axis=1)
        else:
            owned = self.state.u if name == "displacement" else self.state.v
            values[:] = with_ghosts(self.scene.domain, owned)

    @property
    def node_numbers(self) -> npt.NDArray[np.int64]:
        """(owned nodes,) number of each node in `geometry.input_global_indices` of the mesh that was handed over.

        Node i has the dofs d i to d i + d - 1 of `displacement`. A midside node has -1. InputError without such a mesh;
        collective.
        """
        numbering, original = self.scene.domain.input_numbering, self._need_given()
        return numbering.gather_corners.scatter(None if original is None else original.nodes + 1) - 1

    @property
    def cell_numbers(self) -> npt.NDArray[np.int64]:
        """(owned cells,) number of each cell in `topology.original_cell_index` of the mesh that was handed over.

        InputError without such a mesh; collective.
        """
        original = self._need_given()
        return self.scene.domain.input_numbering.gather_cells.scatter(None if original is None else original.cells)

    def _need_given(self) -> GivenMesh | None:
        if not self._has_numbers:
            raise InputError("only a mesh of DOLFINx that was handed over has numbers of its own; give mesh=...")
        return self._given

    # --- fragments and surface ---

    def fragments(self) -> dict[str, Values]:
        """Return columns of pieces.csv by name, a row per fragment (collective).

        They are piece, nodes, mass (kg), volume (m^3), centre_x (m), velocity_x (m/s), spin_z (rad/s) and so on. The
        number `piece` stays with a fragment as long as its surface is looked at at each break.
        """
        from .output.surface.vtk_files import fragment_values

        # the same on all ranks
        return fragment_values(self._surface_frame().fragments)

    def surface(self) -> Any:
        """Return the split surface now (pyvista.PolyData) on rank 0, None on the other ranks (collective).

        It is closed around every fragment. Cells have `piece`, `origin`, `age` and the cell fields of output.fields.
        """
        frame = self._surface_frame().gather()
        if frame is None:
            return None
        import pyvista

        parts = [(frame.segments, "lines"), (frame.triangles, "faces")]
        cells = {name: np.insert(part, 0, part.shape[1], axis=1).ravel() for part, name in parts if len(part)}
        surface = pyvista.PolyData(pad_to_3d(frame.points), **cells)
        for name, values in frame.point_fields.items():
            surface.point_data[name] = pad_to_3d(values)
        for name, values in frame.element_fields.items():
            # of the triangles, then of the segments: VTK has lines first
            surface.cell_data[name] = np.roll(pad_to_3d(values), len(frame.segments), axis=0)
        surface.field_data["origins"] = frame.origins
        return surface

    def _surface_frame(self) -> SurfaceFrame:
        """Return the part of the split surface that this rank has (collective)."""
        self._check_open()
        balance, study = self.scene.balance, self.study
        if self._surface is None:
            self._surface = surface_output(
                None, balance, self._breaks, None, None, study.thickness, smooth=wants_smooth(study)
            )
            self._evaluate = FieldEvaluator(balance.stress, study.output.fields or [], self.scene.fracture)
        return self._surface.make_frame(self.state, self._evaluate(self.state, self._breaks.fragments))

    # --- checkpoint and end ---

    def checkpoint(self) -> Path:
        """Write a checkpoint to the output folder and return its path (collective).

        `Simulation(study, out, restart=True)` and `fracsim run --restart` continue from it, on any number of ranks.
        """
        self._check_open()
        if self._run is None:
            raise InputError("a checkpoint needs an output folder: Simulation(study, out=...)")
        return self._run.checkpoint()

    def close(self) -> None:
        """Close the files and free the memory of PETSc's objects (collective). It may be called again."""
        if self._closed:
            return
        self._closed = True
        if self._run is not None:
            self._run.close()
        self.scene.destroy()

    def _check_open(self) -> None:
        if self._closed:
            raise InputError("the simulation is closed; make a new one to go on")

    def __enter__(self) -> Simulation:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        # after an error on one rank a collective call would wait for the others
        if kind is None or self.comm.size == 1:
            self.close()
