"""surface.pvd with one VTU file a time in surface/, and pieces.csv: for ParaView, and valid after every frame."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ...mechanics.surface_data import SurfaceData
from ..atomic_write import append, replace_text
from ..file_ownership import FRAME
from .body_surface import Frame
from .collection import Entry, collection_text, read_entries
from .fragment_table import Fragments
from .vtu import grid_of, grid_of_elements, update_vtu, write_vtu

Values = npt.NDArray[np.float64]


class SurfaceFiles:
    """Appends frames to surface.pvd and pieces.csv.

    Attributes:
        times: s of the frames that are there.
    """

    def __init__(self, folder: Path, dim: int, resume_at: float | None = None, *, turning: bool = False) -> None:
        """`resume_at`: keep the frames up to this time (s); `turning`: pieces are rigid, and how they are turned is
        told."""
        self._folder, self._pvd, self._csv = folder, folder / "surface.pvd", folder / "pieces.csv"
        self._columns = columns(dim, turning=turning)
        self._entries = self._kept(resume_at) if resume_at is not None and self._pvd.exists() else []
        self._last: dict[str, tuple[SurfaceData, str]] = {}  # what was drawn beside the body, and its file
        rows = self._kept_rows() if self._entries else []
        (folder / "surface").mkdir(parents=True, exist_ok=True)
        keep = {entry.file for entry in self._entries}
        for entry in self._entries:
            update_vtu(folder / entry.file)
        self._write_pvd()
        replace_text(self._csv, _csv_text([self._columns, *rows]))
        self._with_rows = len({row[0] for row in rows})  # frames in pieces.csv
        for path in (folder / "surface").glob("*.vtu"):
            if FRAME.fullmatch(path.name) and f"surface/{path.name}" not in keep:
                path.unlink()

    @property
    def times(self) -> list[float]:
        return [entry.t for entry in self._entries if not entry.part]

    @property
    def counts(self) -> dict[str, int]:
        """Frames in each file."""
        return {self._pvd.name: len(self.times), self._csv.name: self._with_rows}

    def write(self, frame: Frame, beside: dict[str, SurfaceData] | None = None) -> Path:
        """The VTUs first, then the files that name them; `beside`: by the names of obstacles."""
        number = len(self.times)
        body = Entry(frame.t, f"surface/surface_{number:06d}.vtu")
        write_vtu(self._folder / body.file, grid_of(frame))
        others = [(name, self._drawn(name, drawn, number)) for name, drawn in (beside or {}).items()]
        append(self._csv, _csv_text(_rows(frame.t, frame.pieces)).encode())
        self._with_rows += 1
        self._entries += [body, *(Entry(frame.t, file, part, name) for part, (name, file) in enumerate(others, 1))]
        self._write_pvd()
        return self._folder / body.file

    def _drawn(self, name: str, drawn: SurfaceData, number: int) -> str:
        """The file of what stands beside the body: the last one for as long as it does not move."""
        before, file = self._last.get(name, (None, ""))
        if before is None or not np.array_equal(before.points, drawn.points):
            file = f"surface/obstacle_{name}_{number:06d}.vtu"
            write_vtu(self._folder / file, grid_of_elements(drawn.points, drawn.triangles, drawn.segments))
            self._last[name] = drawn, file
        return file

    def _write_pvd(self) -> None:
        replace_text(self._pvd, collection_text(self._entries))

    def _kept(self, until: float) -> list[Entry]:
        entries = read_entries(self._pvd)
        return [each for each in entries if each.t <= until * (1 + 1e-9) and (self._folder / each.file).exists()]

    def _kept_rows(self) -> list[list[str]]:
        """Whole rows of the frames that are kept."""
        times = {f"{t:.12g}" for t in self.times}
        if not self._csv.exists():
            return []
        with self._csv.open(newline="") as file:
            rows = list(csv.reader(file))[1:]
        return [row for row in rows if len(row) == len(self._columns) and row[0] in times]


def _csv_text(rows: list[list[str]]) -> str:
    text = io.StringIO()
    csv.writer(text).writerows(rows)
    return text.getvalue()


def columns(dim: int, *, turning: bool = False) -> list[str]:
    """Columns of pieces.csv; `turning`: with the orientation of rigid pieces."""
    axes = "xyz"[:dim]
    vectors = [f"{what}_{axis}" for what in ("centre", "velocity") for axis in axes]
    spin = [f"spin_{axis}" for axis in ("xyz" if dim == 3 else "z")]
    turn = [*(f"turn_{axis}" for axis in "xyz"), *(f"quaternion_{part}" for part in "wxyz")] if turning else []
    return ["time", "piece", "nodes", "mass", "volume", *vectors, *spin, *turn, "dust"]


def _rows(t: float, pieces: Fragments) -> list[list[str]]:
    turn = [] if pieces.turn is None else [pieces.turn, quaternions(pieces.turn)]
    dust = pieces.nodes == 1
    values = np.column_stack([pieces.mass, pieces.volume, pieces.centre, pieces.velocity, pieces.spin, *turn, dust])
    return [
        [f"{t:.12g}", str(pieces.name[piece]), str(pieces.nodes[piece]), *(f"{value:.12g}" for value in values[piece])]
        for piece in np.argsort(pieces.name)
    ]


def quaternions(turn: Values) -> Values:
    """(p, 4) unit quaternions w, x, y, z, w >= 0, of rotation vectors (p, 3), rad: (cos a/2, sin(a/2) n)."""
    half = np.linalg.norm(turn, axis=1, keepdims=True) / 2
    vector = turn / 2 * np.sinc(half / np.pi)
    made = np.concatenate([np.cos(half), vector], axis=1)
    return np.asarray(np.where(made[:, :1] < 0, -made, made))
