"""VTU files of surfaces, through VTK's own writer."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ...meshes.plain_files import create, replacing
from ..fields_file import EARLIER_TENSOR, TENSOR, from_earlier, padded

if TYPE_CHECKING:
    from .body_surface import Frame

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.integer]

_TRIANGLE, _LINE = 5, 3  # VTK's numbers
_HEAD = 1 << 16  # bytes, more than the XML before the data takes


def write_vtu(path: Path, grid: Any) -> None:
    """One unstructured grid of triangles and segments, data appended and compressed (VTK's own writer).

    LZ4 and raw: a tenth of the time of zlib in base64, and no larger. Through memory: VTK on a full disk prints what it
    thinks of it and does not say why.
    """
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter

    writer = vtkXMLUnstructuredGridWriter()
    writer.WriteToOutputStringOn()
    writer.SetInputData(grid)
    writer.SetDataModeToAppended()
    writer.EncodeAppendedDataOff()
    writer.SetCompressorTypeToLZ4()
    if not writer.Write():
        raise OSError("VTK cannot write it")
    made = writer.GetOutputString()  # bytes, where they are no text
    with create(path) as file:
        file.write(made if isinstance(made, bytes) else made.encode())


def _array(values: npt.NDArray[np.generic], name: str = "") -> Any:
    from vtkmodules.util.numpy_support import numpy_to_vtk

    made = numpy_to_vtk(np.ascontiguousarray(padded(values)), deep=True)
    made.SetName(name)
    for i, axes in enumerate(TENSOR if made.GetNumberOfComponents() == len(TENSOR) else ()):
        made.SetComponentName(i, axes.upper())  # the names that ParaView gives to six columns, for other programs
    return made


def grid_of_elements(points: Values, triangles: Ints, segments: Ints) -> Any:
    """A grid of triangles, then segments."""
    from vtkmodules.util.numpy_support import numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkUnstructuredGrid

    grid, places, cells = vtkUnstructuredGrid(), vtkPoints(), vtkCellArray()
    places.SetData(_array(points))
    grid.SetPoints(places)
    sizes = np.repeat([3, 2], [len(triangles), len(segments)])
    offsets = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    corners = np.concatenate([triangles.ravel(), segments.ravel()]).astype(np.int64)
    cells.SetData(numpy_to_vtkIdTypeArray(offsets, deep=True), numpy_to_vtkIdTypeArray(corners, deep=True))
    grid.SetCells(_array(np.where(sizes == 3, _TRIANGLE, _LINE).astype(np.uint8)), cells)
    return grid


def grid_of(frame: Frame) -> Any:
    """The surface with its fields."""
    from vtkmodules.vtkCommonCore import vtkStringArray

    grid = grid_of_elements(frame.points, frame.triangles, frame.segments)
    for name, values in frame.at_points.items():
        grid.GetPointData().AddArray(_array(values, name))
    for name, values in frame.at_elements.items():
        grid.GetCellData().AddArray(_array(values, name))
    names = vtkStringArray()
    names.SetName("origins")
    for origin in frame.origins:
        names.InsertNextValue(origin)
    grid.GetFieldData().AddArray(names)
    return grid


def reorder_tensors(grid: Any) -> bool:
    """Put tensors of a grid of an earlier version, whose columns say their order, in that of TENSOR; whether there were
    some."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    found = False
    for data in (grid.GetPointData(), grid.GetCellData()):
        arrays = [data.GetArray(number) for number in range(data.GetNumberOfArrays())]
        for array in arrays:
            names = tuple(array.GetComponentName(number) for number in range(array.GetNumberOfComponents()))
            if names == EARLIER_TENSOR:
                data.AddArray(_array(from_earlier(vtk_to_numpy(array)), array.GetName()))  # in place of the old one
                found = True
    return found


def update_vtu(path: Path) -> None:
    """Write a file of an earlier version again, with tensors in the order of TENSOR. Raises OSError."""
    with path.open("rb") as file:
        if f'ComponentName1="{EARLIER_TENSOR[1]}"'.encode() not in file.read(_HEAD):
            return
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridReader

    reader = vtkXMLUnstructuredGridReader()
    reader.SetFileName(str(path))
    reader.Update()
    if reorder_tensors(reader.GetOutput()):
        with replacing(path) as new:
            write_vtu(new, reader.GetOutput())
