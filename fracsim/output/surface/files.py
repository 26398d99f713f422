"""surface.pvd with one VTU file a time in surface/, and pieces.csv: for ParaView, and valid after every frame."""

from __future__ import annotations

import csv
import io
import re
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..fields_file import TENSOR, padded
from ..own_files import FRAME
from ..writing import append, replace_text
from .fragments import Fragments
from .frame import Frame

_HEAD = '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n  <Collection>\n'
_TAIL = "  </Collection>\n</VTKFile>\n"
_ENTRY = re.compile(r'timestep="([^"]+)" file="([^"]+)"')
_TRIANGLE, _LINE = 5, 3  # VTK's numbers


class SurfaceFiles:
    """Appends frames to surface.pvd and pieces.csv.

    Attributes:
        times: s of the frames that are there.
    """

    def __init__(self, folder: Path, dim: int, resume_at: float | None = None) -> None:
        """`resume_at`: keep the frames up to this time (s)."""
        self._folder, self._pvd, self._csv = folder, folder / "surface.pvd", folder / "pieces.csv"
        self._columns = columns(dim)
        self._entries = self._kept(resume_at) if resume_at is not None and self._pvd.exists() else []
        rows = self._kept_rows() if self._entries else []
        (folder / "surface").mkdir(parents=True, exist_ok=True)
        keep = {name for _, name in self._entries}
        self._write_pvd()
        replace_text(self._csv, _csv_text([self._columns, *rows]))
        for path in (folder / "surface").glob("surface_*.vtu"):
            if FRAME.fullmatch(path.name) and f"surface/{path.name}" not in keep:
                path.unlink()

    @property
    def times(self) -> list[float]:
        return [t for t, _ in self._entries]

    def write(self, frame: Frame) -> Path:
        """The VTU first, then the files that name it."""
        name = f"surface/surface_{len(self._entries):06d}.vtu"
        write_vtu(self._folder / name, frame)
        append(self._csv, _csv_text(_rows(frame.t, frame.pieces)).encode())
        self._entries.append((frame.t, name))
        self._write_pvd()
        return self._folder / name

    def _write_pvd(self) -> None:
        entries = (f'    <DataSet timestep="{t:.12g}" file="{name}"/>\n' for t, name in self._entries)
        replace_text(self._pvd, _HEAD + "".join(entries) + _TAIL)

    def _kept(self, until: float) -> list[tuple[float, str]]:
        entries = read_collection(self._pvd)
        return [(t, name) for t, name in entries if t <= until * (1 + 1e-9) and (self._folder / name).exists()]

    def _kept_rows(self) -> list[list[str]]:
        """Whole rows of the frames that are kept."""
        times = {f"{t:.12g}" for t in self.times}
        if not self._csv.exists():
            return []
        with self._csv.open(newline="") as file:
            rows = list(csv.reader(file))[1:]
        return [row for row in rows if len(row) == len(self._columns) and row[0] in times]


def read_collection(pvd: Path) -> list[tuple[float, str]]:
    """(time in s, file relative to the folder) of every frame of a surface.pvd."""
    return [(float(t), name) for t, name in _ENTRY.findall(pvd.read_text())]


def _csv_text(rows: list[list[str]]) -> str:
    text = io.StringIO()
    csv.writer(text).writerows(rows)
    return text.getvalue()


def columns(dim: int) -> list[str]:
    """Columns of pieces.csv."""
    axes = "xyz"[:dim]
    vectors = [f"{what}_{axis}" for what in ("centre", "velocity") for axis in axes]
    spin = [f"spin_{axis}" for axis in ("xyz" if dim == 3 else "z")]
    return ["time", "piece", "nodes", "mass", "volume", *vectors, *spin]


def _rows(t: float, pieces: Fragments) -> list[list[str]]:
    values = np.column_stack([pieces.mass, pieces.volume, pieces.centre, pieces.velocity, pieces.spin])
    return [
        [f"{t:.12g}", str(pieces.name[piece]), str(pieces.nodes[piece]), *(f"{value:.12g}" for value in values[piece])]
        for piece in np.argsort(pieces.name)
    ]


def write_vtu(path: Path, frame: Frame) -> None:
    """One unstructured grid of triangles and segments, data appended and compressed (VTK's own writer).

    Through memory: VTK on a full disk prints what it thinks of it and does not say why.
    """
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter

    writer = vtkXMLUnstructuredGridWriter()
    writer.WriteToOutputStringOn()
    writer.SetInputData(_grid(frame))
    writer.SetDataModeToAppended()
    writer.SetCompressionLevel(1)  # level 5 is half as fast and saves 4 %
    if not writer.Write():
        raise OSError("VTK cannot write it")
    path.write_text(writer.GetOutputString())


def _grid(frame: Frame) -> Any:
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonCore import vtkPoints, vtkStringArray
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkUnstructuredGrid

    def array(values: npt.NDArray[np.generic], name: str = "") -> Any:
        made = numpy_to_vtk(np.ascontiguousarray(padded(values)), deep=True)
        made.SetName(name)
        for i, axes in enumerate(TENSOR if made.GetNumberOfComponents() == len(TENSOR) else ()):
            made.SetComponentName(i, axes)  # ParaView would take them for xx yy zz xy yz xz
        return made

    grid, points, cells = vtkUnstructuredGrid(), vtkPoints(), vtkCellArray()
    points.SetData(array(frame.points))
    grid.SetPoints(points)
    sizes = np.repeat([3, 2], [len(frame.triangles), len(frame.segments)])
    offsets = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    corners = np.concatenate([frame.triangles.ravel(), frame.segments.ravel()]).astype(np.int64)
    cells.SetData(numpy_to_vtkIdTypeArray(offsets, deep=True), numpy_to_vtkIdTypeArray(corners, deep=True))
    grid.SetCells(array(np.where(sizes == 3, _TRIANGLE, _LINE).astype(np.uint8)), cells)
    for name, values in frame.at_points.items():
        grid.GetPointData().AddArray(array(values, name))
    for name, values in frame.at_elements.items():
        grid.GetCellData().AddArray(array(values, name))
    names = vtkStringArray()
    names.SetName("origins")
    for origin in frame.origins:
        names.InsertNextValue(origin)
    grid.GetFieldData().AddArray(names)
    return grid
