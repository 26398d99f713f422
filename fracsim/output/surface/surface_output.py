"""The split surface in a run: gathers, builds on rank 0, writes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ...fracture.edge_history import EdgeRecord
from ...mechanics.material_fields import PerCell
from ...mechanics.term import Term
from ...mesh.domain import Domain
from ...timestepping.state import State
from ..atomic_write import written
from ..fields_file import Field
from ..interpenetration_check import Passing
from .body_surface import Apart, Surface
from .vtk_files import SurfaceFiles

Values = npt.NDArray[np.float64]


class SurfaceOutput:
    """Writes surface.pvd and pieces.csv of a run.

    Attributes:
        record: when and where edges broke; None where the study has no fracture.
        made: the surface and its files on rank 0, None elsewhere.
    """

    def __init__(
        self,
        folder: Path,
        domain: Domain,
        density: PerCell,
        record: EdgeRecord | None,
        *,
        apart: Sequence[Apart] = (),
        beside: Sequence[Term] = (),
        passing: Passing | None = None,
        smooth: bool = False,
        resume_at: float | None = None,
    ) -> None:
        """Open the files (collective). The run notes breaks in the record; a restart reads it from the checkpoint.

        `beside`: terms that are drawn with the body.    `passing`: where nothing keeps its pieces apart.
        `smooth`: cracks are drawn so.
        """
        self._domain, self.record, self._apart, self._beside, self._passing = domain, record, apart, beside, passing
        everywhere = domain.gather_cells(np.broadcast_to(np.asarray(density, float), domain.cell_count))
        broken = self.record.gathered() if self.record is not None else None

        def begin() -> tuple[Surface, SurfaceFiles]:
            assert domain.source is not None
            files = SurfaceFiles(folder, domain.dim, resume_at)
            surface = Surface(domain.source, everywhere, smooth=smooth)  # type: ignore[arg-type]
            if broken is not None and resume_at is not None:
                surface.replay(surface.skeleton.of_edges(broken[0], broken[1][:, 0]), files.times)
            return surface, files

        self._path = folder / "surface.pvd"
        self.made = written(domain.comm, self._path, begin)

    def write(self, state: State, fields: list[Field]) -> None:
        """A frame at the time of the state, with the fields of fields.xdmf. Raises CannotWrite (collective)."""
        domain, d = self._domain, self._domain.dim
        gathered: list[Any] = [domain.gather_nodes(each.reshape(-1, d)) for each in (state.u, state.v)]
        pattern = domain.gather_cells(self.record.graph.pattern) if self.record is not None else None
        broken = self.record.gathered() if self.record is not None else None

        def work() -> None:
            assert self.made is not None
            surface, files = self.made
            if state.t in files.times:
                return
            at_corners, nodal = self._of_points(gathered, fields)
            at = cut = None
            if broken is not None and pattern is not None:
                at, cut = (surface.skeleton.of_edges(broken[0], column) for column in broken[1].T)
                surface.update(pattern, cut)
            beside = {name: drawn for term in self._beside for name, drawn in term.output_surfaces(state.t).items()}
            files.write(surface.at(state.t, *at_corners, broken_at=at, fields=nodal, apart=self._apart), beside)
            if self._passing is not None:
                self._passing.look(state.t, surface, at_corners[0])

        written(domain.comm, self._path, work)

    def _of_points(self, gathered: list[Any], fields: list[Field]) -> tuple[list[Any], list[Field]]:
        """Nodal values without those in the middles of edges: the surface is that of straight cells (rank 0)."""
        source = self._domain.source
        if self._domain.midside_nodes is None or source is None:
            return gathered, fields
        count = len(source.points)
        nodal = [replace(each, values=each.values[:count]) if each.centre == "Node" else each for each in fields]
        return [each[:count] for each in gathered], nodal
