"""A frame of a run in all files that have frames: fields.xdmf, and the split surface where it is wanted."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ..mechanics.balance import Balance
from ..timestepping.state import State
from .atomic_write import written
from .fields import Frames
from .fields_file import Field, FieldsFile
from .fracture_log import Breaks

if TYPE_CHECKING:
    from ..fracture.fracture_pass import Breaking
    from .interpenetration_check import Passing
    from .surface.surface_output import SurfaceOutput


class FrameFiles:
    """Writes frames.

    Attributes:
        surface: the split surface; None where it is not wanted.    fields: fields.xdmf on rank 0, None elsewhere.
    """

    def __init__(
        self,
        folder: Path,
        balance: Balance,
        breaking: Breaking | None,
        breaks: Breaks,
        *,
        fields: list[str],
        surface: bool,
        smooth: bool = False,
        passing: Passing | None = None,
        resume_at: float | None = None,
        thickness: float = 1.0,
    ) -> None:
        """`fields`: by the names of output.fields; `smooth`: cracks are drawn so; `passing`: watches
        pieces that nothing keeps apart; `resume_at`: keep the frames up to this time, s; `thickness`: m, of a 2D body
        (collective).

        Raises CannotWrite.
        """
        stress = balance.stress
        self._comm, self._path, self._breaks = stress.domain.comm, folder / "fields.xdmf", breaks
        self._values, source = Frames(stress, fields, breaking), stress.domain.mesh_of_nodes()
        self.fields = written(self._comm, self._path, lambda: FieldsFile(folder, source, resume_at) if source else None)
        self.surface = None
        if surface:
            self.surface = _surface(folder, balance, breaks, passing, resume_at, thickness, smooth=smooth)

    @property
    def counts(self) -> dict[str, int]:
        """Frames in each file (rank 0; none elsewhere)."""
        if self.fields is None:
            return {}
        surface = {} if self.surface is None or self.surface.made is None else self.surface.made[1].counts
        return {"fields.h5": len(self.fields.times), **surface}

    def write(self, state: State) -> None:
        """A frame at the time of the state, where there is none yet. Raises CannotWrite (collective)."""
        fields = self._values(state, self._breaks.pieces)
        written(self._comm, self._path, lambda: self._write_fields(state.t, fields))
        if self.surface is not None:
            self.surface.write(state, fields)

    def _write_fields(self, t: float, fields: list[Field]) -> None:
        if self.fields is not None and t not in self.fields.times:
            self.fields.write(t, fields)


def _surface(
    folder: Path,
    balance: Balance,
    breaks: Breaks,
    passing: Passing | None,
    resume_at: float | None,
    thickness: float,
    *,
    smooth: bool,
) -> SurfaceOutput:
    """The split surface: imported, built and kept only where it is wanted."""
    from .surface.surface_output import SurfaceOutput

    density, terms = balance.stress.material.density * thickness, balance.terms
    return SurfaceOutput(
        folder, balance.domain, density, breaks.record, passing=passing, resume_at=resume_at, smooth=smooth,
        apart=[term.separate_surface for term in terms if term.separates_surface],
        beside=[term for term in terms if term.has_output_surfaces],
    )  # fmt: skip
