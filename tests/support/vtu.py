"""Frames of surface.pvd as VTK's own reader gives them."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkCommonDataModel import vtkUnstructuredGrid
from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridReader

LINE, TRIANGLE = 3, 5


@dataclass(frozen=True)
class Drawn:
    """A frame at t, s: points (n, 3) m, segments (m, 2), triangles (k, 3), and how many pieces there are."""

    t: float
    points: npt.NDArray[np.float64]
    segments: npt.NDArray[np.int64]
    triangles: npt.NDArray[np.int64]
    pieces: int


def frames(folder: Path) -> list[Drawn]:
    """The body's own surface in all frames."""
    entries = ElementTree.parse(folder / "surface.pvd").iter("DataSet")
    files = [(float(each.attrib["timestep"]), each.attrib["file"]) for each in entries]
    return [_read(t, folder / file) for t, file in files if Path(file).name.startswith("surface_")]


def points_of(path: Path) -> npt.NDArray[np.float64]:
    """(n, 3) of a file, m."""
    return vtk_to_numpy(grid(path).GetPoints().GetData()).astype(float)


def grid(path: Path) -> vtkUnstructuredGrid:
    """A file."""
    reader = vtkXMLUnstructuredGridReader()
    reader.SetFileName(str(path))
    reader.Update()
    return reader.GetOutput()


def _read(t: float, path: Path) -> Drawn:
    drawn = grid(path)
    kind, cells = vtk_to_numpy(drawn.GetCellTypesArray()), drawn.GetCells()
    start, corner = vtk_to_numpy(cells.GetOffsetsArray()), vtk_to_numpy(cells.GetConnectivityArray())

    def of(which: int, width: int) -> npt.NDArray[np.int64]:
        return corner[start[:-1][kind == which][:, None] + np.arange(width)].astype(np.int64)

    points = vtk_to_numpy(drawn.GetPoints().GetData()).astype(float)
    pieces = len(np.unique(vtk_to_numpy(drawn.GetCellData().GetArray("piece"))))
    return Drawn(t, points, of(LINE, 2), of(TRIANGLE, 3), pieces)
