"""Output of the split surface in a run: each rank builds the part of its cells, and all ranks compress the file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem

from ...fracture.edge_history import EdgeHistory
from ...mechanics.inertia import corner_mass_fraction
from ...mechanics.jit import compile_form
from ...mechanics.material_fields import PerCell
from ...mechanics.term_protocols import OutputSurfaces, SurfaceSeparator
from ...mesh.domain import Domain
from ...mesh.ghost_exchange import sum_at_nodes, with_ghosts
from ...mesh.split_surface.mesh_part import RankCells
from ...meshes.topology import signed_measures
from ...timestepping.state import State
from ..atomic_write import write_on_root
from ..fields_file import Field
from ..result_checks import InterpenetrationMonitor
from .body_surface import BodySurface, MidsideMotion, SurfaceFrame
from .vtk_files import SurfaceFiles

Rows = npt.NDArray[Any]
Values = npt.NDArray[np.float64]


class RankValues:
    """Values on the entities of the cells of this rank; nothing is gathered.

    Attributes:
        part: these cells.
    """

    def __init__(self, domain: Domain) -> None:
        """Number the entities of the cells of this rank (collective)."""
        self._domain, self.part = domain, RankCells(domain)

    def of_nodes(self, values: Values) -> Values:
        """Rows (N, d) of the corners of cells, from values of the dofs that this rank owns (collective)."""
        d = self._domain.dim
        owned = np.asarray(values[: self._domain.node_count * d])
        return with_ghosts(self._domain, owned).reshape(-1, d)[self.part.nodes]

    def of_cells(self, values: Rows) -> Rows:
        """Rows (C, ...) of values (cells, ...) of the cells of this rank."""
        return np.asarray(values[self.part.cells])

    def of_drawn_cells(self, values: Rows, drawn: npt.NDArray[np.bool_]) -> Rows:
        """Rows (C, ...) as of_cells, right for cells with flags `drawn` (cells,) alone."""
        result = np.zeros_like(values)
        rows = np.flatnonzero(drawn[self.part.cells])
        result[rows] = values[self.part.cells[rows]]
        return result

    def of_broken_edges(self, history: EdgeHistory) -> tuple[Values, Values]:
        """Break times and cut positions (E,) of the edges, NaN for intact ones."""
        skeleton, broken = self.part.skeleton, np.flatnonzero(history.graph.broken)
        ends = self.part.part_node[history.graph.edge_nodes[broken]]
        # a rank may have ghost edges that none of its cells has
        in_part = np.flatnonzero((ends >= 0).all(axis=1))
        keys, rows = ends[in_part], broken[in_part]
        return (
            skeleton.edge_values(keys, history.break_times[rows]),
            skeleton.edge_values(keys, history.cut_positions[rows]),
        )


class MidsideMasses:
    """Lumped masses of the midside nodes that this rank owns, with quadratic displacement."""

    def __init__(self, domain: Domain, part: RankCells, density: PerCell) -> None:
        """Sum the masses (collective); `density`: kg/m^3 (2D: kg/m^2)."""
        self._domain, middles = domain, domain.cell_midside_nodes
        volume = signed_measures(domain.nodes, domain.cell_nodes)
        corner, of_edge = corner_mass_fraction(domain), middles.of_edges
        # the rest of the mass of a cell, in equal parts
        share = (1 - (domain.dim + 1) * corner) / of_edge.shape[1] * density * volume
        mass = sum_at_nodes(domain, of_edge, share[:, None])[:, 0]
        is_owned = middles.nodes < domain.node_count
        self._nodes, self._ends = middles.nodes[is_owned], part.part_node[middles.ends[is_owned]]
        self._mass, self._corner_share = mass[self._nodes], (domain.dim + 1) * corner

    def motion(self, state: State) -> MidsideMotion:
        """Masses and motion of the midside nodes in a state."""
        u, v = (of_dofs.reshape(-1, self._domain.dim)[self._nodes] for of_dofs in (state.u, state.v))
        x = self._domain.nodes[self._nodes] + u
        return MidsideMotion(self._ends, self._mass, x, v, self._corner_share)


def _curved_volumes(domain: Domain) -> Values:
    """Volumes (cells,), m^3 (2D: m^2), of cells with curved edges; the surface has straight ones."""
    volumes = fem.Function(domain.scalar_cell_space)
    form = compile_form(ufl.TestFunction(domain.scalar_cell_space) * ufl.dx(domain=domain.mesh))
    fem.assemble_vector(volumes.x.array, form)
    return np.asarray(volumes.x.array[: domain.cell_count])


class SurfaceOutput:
    """Writer of surface.pvd and pieces.csv of a run with deformable bodies.

    Attributes:
        record: time and position of each break; None without fracture.
        surface: surface of the part of the mesh that this rank has.
        files: files on rank 0; None on the other ranks, and without a folder.
    """

    def __init__(
        self,
        folder: Path | None,
        domain: Domain,
        density: PerCell,
        record: EdgeHistory | None,
        *,
        apart: Sequence[SurfaceSeparator] = (),
        beside: Sequence[OutputSurfaces] = (),
        passing: InterpenetrationMonitor | None = None,
        smooth: bool = False,
        resume_at: float | None = None,
        precision: str = "single",
    ) -> None:
        """Open the files (collective).

        Args:
            folder: output folder; None: surfaces are made, and none is written.
            domain: distributed mesh.
            density: mass density, kg/m^3 (2D: kg/m^2).
            record: history of broken edges, in a study with fracture. On a restart it is that of the checkpoint.
            apart: terms that keep the drawn surface apart.
            beside: terms with obstacles to draw.
            passing: monitor of interpenetration.
            smooth: draw cracks smooth.
            resume_at: keep the frames up to this time, s; None: a new run.
            precision: of points and fields, "single" or "double".

        Raises:
            CannotWrite: a file cannot be written.
        """
        self._domain, self.record, self._separators = domain, record, apart
        self._obstacle_terms, self._interpenetration, self._precision = beside, passing, precision
        self._path = (folder or Path()) / "surface.pvd"
        self._values = RankValues(domain)
        if domain.has_curved_cells:
            density = density * _curved_volumes(domain) / domain.volumes
        cell_density = self._values.of_cells(np.broadcast_to(np.asarray(density, float), domain.cell_count))
        self.files = None
        if folder is not None:
            self.files = write_on_root(
                domain.comm, self._path, lambda: SurfaceFiles(folder, domain.dim, resume_at, precision=precision)
            )
        times = domain.comm.bcast([] if self.files is None or resume_at is None else self.files.times)
        self.surface = BodySurface(self._values.part, cell_density, smooth=smooth)
        self._midside = MidsideMasses(domain, self._values.part, density) if domain.order == 2 else None
        if record is not None and times:
            self.surface.replay_fragment_names(self._values.of_broken_edges(record)[0], times)

    def make_frame(self, state: State, fields: list[Field]) -> SurfaceFrame:
        """Part of the split surface of a state (collective).

        Args:
            state: present state.
            fields: fields of fields.xdmf; the surface has those of the cells.
        """
        values, record = self._values, self.record
        u, v = (values.of_nodes(of_dofs) for of_dofs in (state.u, state.v))
        broken_at = None
        if record is not None:
            broken_at, cut = values.of_broken_edges(record)
            self.surface.update(values.of_cells(record.graph.pattern), cut)
        drawn = self._cells_with_elements()
        cell_fields = [
            replace(field, values=values.of_drawn_cells(field.values, drawn))
            for field in fields
            if field.centre == "Cell"
        ]
        corrections = [partial(term.separate_surface, u=state.u, t=state.t) for term in self._separators]
        midside = None if self._midside is None else self._midside.motion(state)
        return self.surface.make_frame(
            state.t, u, v, broken_at=broken_at, fields=cell_fields, corrections=corrections, midside=midside
        )

    def _cells_with_elements(self) -> npt.NDArray[np.bool_]:
        """Flags (cells,) of the cells of this rank that have elements of the surface."""
        # in 2D triangles cover the body
        has_element: npt.NDArray[np.bool_] = np.any(
            self._domain.facets.boundary_sides | (self._domain.dim == 2), axis=1
        )
        if self.record is not None:
            has_element |= self.record.graph.pattern != 0
        return has_element

    def write_frame(self, state: State, fields: list[Field]) -> None:
        """Write a frame at the time of the state, if there is none yet (collective).

        Args:
            state: present state.
            fields: fields of fields.xdmf; the surface has those of the cells.

        Raises:
            CannotWrite: a file cannot be written.
        """
        files, comm = self.files, self._domain.comm
        if comm.bcast(files is not None and state.t in files.times):
            return
        frame = self.make_frame(state, fields)
        grid = frame.compress(self._precision)

        def write() -> None:
            assert files is not None
            drawn = {
                name: data for term in self._obstacle_terms for name, data in term.output_surfaces(state.t).items()
            }
            files.write_frame(frame, drawn, grid)

        write_on_root(comm, self._path, write)
        if self._interpenetration is not None:
            self._interpenetration.record_frame(state.t, self.surface, self._values.of_nodes(state.u))
