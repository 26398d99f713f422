"""Output of the split surface in a run: values are gathered, and rank 0 builds and writes the surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ...fracture.edge_history import EdgeHistory
from ...mechanics.material_fields import PerCell
from ...mechanics.term_protocols import OutputSurfaces, SurfaceSeparator
from ...mesh.domain import Domain
from ...mesh.parallel import gather
from ...timestepping.state import State
from ..atomic_write import write_on_root
from ..fields_file import Field
from ..result_checks import InterpenetrationMonitor
from .body_surface import BodySurface, SurfaceFrame
from .vtk_files import SurfaceFiles

Values = npt.NDArray[np.float64]


class SurfaceOutput:
    """Writer of surface.pvd and pieces.csv of a run with deformable bodies.

    Attributes:
        record: time and position of each break; None without fracture.
        surface_and_files: surface and its files on rank 0, None on the other ranks; no files without a folder.
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
            passing: monitor of interpenetration, in a study without contact between fragments.
            smooth: draw cracks smooth.
            resume_at: keep the frames up to this time, s; None: a new run.
            precision: of points and fields, "single" or "double".

        Raises:
            CannotWrite: a file cannot be written.
        """
        self._domain, self.record, self._separators = domain, record, apart
        self._obstacle_terms, self._interpenetration = beside, passing
        cell_density = domain.input_numbering.gather_cells(
            np.broadcast_to(np.asarray(density, float), domain.cell_count)
        )
        broken = self.record.gather_broken() if self.record is not None else None

        mesh = domain.input_mesh

        def open_files() -> tuple[BodySurface, SurfaceFiles | None]:
            assert mesh is not None and cell_density is not None
            files = None if folder is None else SurfaceFiles(folder, domain.dim, resume_at, precision=precision)
            surface = BodySurface(mesh, cell_density, smooth=smooth)
            if broken is not None and files is not None and resume_at is not None:
                edges, history = broken
                surface.replay_fragment_names(surface.skeleton.edge_values(edges, history[:, 0]), files.times)
            return surface, files

        self._corner_displacement: Any = None  # (N, d) of the last surface, m (rank 0)
        self._path = (folder or Path()) / "surface.pvd"
        self.surface_and_files = write_on_root(domain.comm, self._path, open_files)

    def make_frame(self, state: State, fields: list[Field]) -> SurfaceFrame | None:
        """Split surface of a state on rank 0, None on the other ranks (collective).

        Args:
            state: present state.
            fields: fields of fields.xdmf; the surface has those of the cells.
        """
        domain, d = self._domain, self._domain.dim
        gathered: list[Any] = [
            domain.input_numbering.gather_nodes(values.reshape(-1, d)) for values in (state.u, state.v)
        ]
        pattern = domain.input_numbering.gather_cells(self.record.graph.pattern) if self.record is not None else None
        broken = self.record.gather_broken() if self.record is not None else None
        cell_fields = self._gather_cell_fields(fields)
        for term in self._separators:
            term.gather_separation()

        def make() -> SurfaceFrame:
            assert self.surface_and_files is not None
            surface, _ = self.surface_and_files
            u, v = self._corner_values(gathered)
            self._corner_displacement = u
            broken_at = cut = None
            if broken is not None and pattern is not None:
                edges, history = broken
                broken_at, cut = (surface.skeleton.edge_values(edges, column) for column in history.T)
                surface.update(pattern, cut)
            corrections = [term.separate_surface for term in self._separators]
            return surface.make_frame(state.t, u, v, broken_at=broken_at, fields=cell_fields, corrections=corrections)

        return write_on_root(domain.comm, self._path, make)

    def write_frame(self, state: State, fields: list[Field]) -> None:
        """Write a frame at the time of the state, if there is none yet (collective).

        Args:
            state: present state.
            fields: fields of fields.xdmf; the surface has those of the cells.

        Raises:
            CannotWrite: a file cannot be written.
        """
        opened = self.surface_and_files
        has_frame = opened is not None and opened[1] is not None and state.t in opened[1].times
        if self._domain.comm.bcast(has_frame):
            return
        frame = self.make_frame(state, fields)

        def write() -> None:
            assert frame is not None and opened is not None and opened[1] is not None
            drawn = {
                name: data for term in self._obstacle_terms for name, data in term.output_surfaces(state.t).items()
            }
            opened[1].write_frame(frame, drawn)
            if self._interpenetration is not None:
                self._interpenetration.record_frame(state.t, opened[0], self._corner_displacement)

        write_on_root(self._domain.comm, self._path, write)

    def _gather_cell_fields(self, fields: list[Field]) -> list[Field]:
        """Cell fields in the order of the input mesh on rank 0, 0 in cells that have no element (collective)."""
        domain = self._domain
        # in 2D triangles cover the body
        has_element = domain.facets.boundary_sides.any(axis=1) | (domain.dim == 2)
        if self.record is not None:
            has_element |= self.record.graph.pattern != 0
        cells, owned = np.flatnonzero(has_element), [field for field in fields if field.centre == "Cell"]
        parts = gather(domain.comm, (domain.input_numbering.cells[cells], [field.values[cells] for field in owned]))
        if parts is None:
            return []
        result, cell_count = [], domain.mesh.topology.index_map(domain.dim).size_global
        for number, field in enumerate(owned):
            values = np.zeros((cell_count, *field.values.shape[1:]), field.values.dtype)
            for index, rows in parts:
                values[index] = rows[number]
            result.append(replace(field, values=values))
        return result

    def _corner_values(self, gathered: list[Any]) -> list[Any]:
        """Nodal values at the corners of quadratic cells only: the surface has straight cells (rank 0)."""
        midside_nodes = self._domain.midside_nodes
        return gathered if midside_nodes is None else [values[: midside_nodes.points] for values in gathered]
