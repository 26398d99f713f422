"""Output folder of a run, for Python: history, frames and fragments as arrays and meshes, read when asked for."""

from __future__ import annotations

import base64
import csv
import html
import os
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, overload

import numpy as np
import numpy.typing as npt

from ..errors import InputError
from ..meshes.plain_files import check_readable
from .pictures.frames import FrameSource, field_frames, load_grid, read_study, surface_frames
from .runs import Columns, RunData, is_run, read_run

Values = npt.NDArray[np.float64]


class FrameSequence(Sequence[Any]):
    """Frames of a run, in the order of time. A frame is read when it is asked for.

    Attributes:
        times: (frames,) times of the frames, s.
    """

    def __init__(self, sources: list[FrameSource]) -> None:
        """`sources`: files of the frames."""
        self._sources = sources
        self.times: Values = np.array([source.t for source in sources])

    def __len__(self) -> int:
        return len(self._sources)

    @overload
    def __getitem__(self, index: int) -> Any: ...

    @overload
    def __getitem__(self, index: slice) -> FrameSequence: ...

    def __getitem__(self, index: int | slice) -> Any:
        """Return the grid of a frame (pyvista), or the sequence of a slice."""
        if isinstance(index, slice):
            return FrameSequence(self._sources[index])
        if not -len(self) <= index < len(self):
            raise IndexError(f"there is no frame {index}: the run has {len(self)}, from 0 to {len(self) - 1}")
        return load_grid(self._sources[index])


class RunOutput:
    """Output folder of a run. Every file is read once, when its content is first asked for.

    Attributes:
        folder: output folder.
    """

    def __init__(self, folder: str | Path) -> None:
        """Raise InputError if the folder has no study.toml and no history.csv."""
        self.folder = as_folder(folder, "folder")
        if not is_run(self.folder):
            raise InputError(
                f"{self.folder} is not the output folder of a run: it has no study.toml with a history.csv; "
                'fracsim.run("bar-2d", out="out/bar-2d") makes one'
            )

    @cached_property
    def _files(self) -> RunData:
        return read_run(self.folder, self.folder.name)

    @property
    def study(self) -> dict[str, Any]:
        """Tables of study.toml."""
        return read_study(self.folder)

    @property
    def history(self) -> dict[str, Values]:
        """Columns of history.csv by name, (steps,) each; in SI units, see docs/output.md."""
        return self._files.history

    @property
    def summary(self) -> dict[str, Any]:
        """Contents of summary.json; empty while the run goes on, or if it was killed."""
        return self._files.summary

    @property
    def outcome(self) -> str:
        """Outcome of the run: done, not converged, stopped, could not write, or unfinished."""
        return self._files.outcome

    @cached_property
    def pieces(self) -> dict[str, Values]:
        """Columns of pieces.csv by name, a row per fragment and frame. Without surface output InputError."""
        return _read_columns(self.folder / "pieces.csv", "output.surface = true writes it")

    @cached_property
    def tips(self) -> dict[str, Values]:
        """Columns of tips.csv by name, a row per crack tip and step. Without a fracture energy InputError."""
        return _read_columns(self.folder / "tips.csv", "a study with fracture.energy writes it")

    @cached_property
    def frames(self) -> FrameSequence:
        """Frames of fields.xdmf: the displaced mesh with its fields, pyvista.UnstructuredGrid each."""
        return FrameSequence(field_frames(self.folder))

    @cached_property
    def surfaces(self) -> FrameSequence:
        """Frames of surface.pvd: the split surface, pyvista.UnstructuredGrid each; none without surface output."""
        return FrameSequence(surface_frames(self.folder))

    def __repr__(self) -> str:
        return f"RunOutput({str(self.folder)!r}): {self.outcome}, {len(self.history['step'])} steps"

    def _repr_html_(self) -> str:
        """Return title, outcome and last picture for a notebook."""
        names = ("outcome", "steps", "time", "broken_edges", "pieces", "wall")
        rows = "".join(
            f"<tr><td>{name}</td><td>{html.escape(f'{self.summary[name]:.6g}' if name != 'outcome' else self.outcome)}"
            "</td></tr>"
            for name in names
            if name in self.summary
        )
        text = f"<b>{html.escape(str(self.study.get('title', self.folder.name)))}</b><table>{rows}</table>"
        picture = self.folder / "last.png"
        if picture.is_file():
            encoded = base64.b64encode(picture.read_bytes()).decode()
            text += f'<img src="data:image/png;base64,{encoded}" style="max-width: 640px">'
        return text


def open_run(folder: str | Path) -> RunOutput:
    """Return the output of a run in a folder, which may still go on. Raises InputError if there is none."""
    return RunOutput(folder)


def as_folder(path: str | Path, name: str) -> Path:
    """Return the path of a folder. Raises InputError if it is none; `name`: of the argument."""
    if not isinstance(path, str | os.PathLike):
        raise InputError(f'{name} is {path!r}: give the path of a folder, as in {name}="out/bar-2d"')
    return Path(path)


def _read_columns(path: Path, source: str) -> dict[str, Values]:
    """Return the columns of a CSV file of numbers. Raises InputError; `source`: what writes such a file."""
    if not path.is_file():
        raise InputError(f"{path} does not exist: {source}")
    check_readable(path)
    with path.open(newline="", encoding="utf-8") as file:
        header, *rows = list(csv.reader(file)) or [[]]
    try:
        table = np.array([row for row in rows if len(row) == len(header)], float).reshape(-1, len(header))
    except ValueError as error:
        raise InputError(f"{path} is not a table of numbers: {error}") from None
    return Columns(path.name, zip(header, table.T, strict=True))
