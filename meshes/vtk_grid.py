"""Unstructured grids of VTK as arrays: checked, joined from pieces, sorted into blocks of cells."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from .data import Indices, Points
from .file_text import refuse_file
from .mesh_conversion import Block

Array = npt.NDArray[Any]

VTK, HDF, EXODUS = "VTK", "VTKHDF", "Exodus"
# Ending -> format
ENDINGS = {
    **dict.fromkeys((".vtk", ".vtu", ".vtp", ".pvtu"), VTK),
    **dict.fromkeys((".vtkhdf", ".hdf", ".hdf5", ".h5"), HDF),
    **dict.fromkeys((".e", ".ex2", ".exo", ".exii", ".g", ".gen"), EXODUS),
}
ADVICE = {
    VTK: "an unstructured grid or polygons, as VTK legacy (.vtk) or XML (.vtu, .vtp, .pvtu); save it again, for "
    "example in ParaView by File > Save Data as .vtu",
    HDF: "an unstructured grid of VTKHDF; save it again, for example in ParaView by File > Save Data as .vtu",
    EXODUS: 'Exodus II in netCDF, classic or HDF5; export it again, for example in Cubit by `export mesh "part.exo"`',
}


# Cell type of VTK (vtkCellType.h) -> cell type, and its number of nodes; 0: any
KINDS: dict[int, tuple[str, int]] = {
    1: ("vertex", 1), 2: ("vertex", 0), 3: ("line", 2), 4: ("polyline", 0), 5: ("triangle", 3), 7: ("polygon", 0),
    8: ("quad", 4), 9: ("quad", 4), 10: ("tetra", 4), 11: ("hexahedron", 8), 12: ("hexahedron", 8), 13: ("wedge", 6),
    14: ("pyramid", 5), 15: ("penta_prism", 10), 16: ("hexa_prism", 12), 21: ("line3", 3), 22: ("triangle6", 6),
    23: ("quad8", 8), 24: ("tetra10", 10), 25: ("hexahedron20", 20), 26: ("wedge15", 15), 27: ("pyramid13", 13),
    28: ("quad9", 9), 29: ("hexahedron27", 27), 30: ("quad6", 6), 31: ("wedge12", 12), 32: ("wedge18", 18),
    33: ("hexahedron24", 24), 34: ("triangle7", 7), 35: ("line4", 4), 37: ("pyramid19", 19), 42: ("polyhedron", 0),
    68: ("VTK_LAGRANGE_CURVE", 0), 69: ("VTK_LAGRANGE_TRIANGLE", 0), 70: ("VTK_LAGRANGE_QUADRILATERAL", 0),
    71: ("VTK_LAGRANGE_TETRAHEDRON", 0), 72: ("VTK_LAGRANGE_HEXAHEDRON", 0), 73: ("VTK_LAGRANGE_WEDGE", 0),
}  # fmt: skip


# Pixels and voxels have their nodes in the order of their axes: columns of the nodes of quads and hexahedra
AXIS_ORDERED = {8: [0, 1, 3, 2], 11: [0, 1, 3, 2, 4, 5, 7, 6]}


def refuse_vtk(path: Path, reason: str) -> NoReturn:
    """Raises MeshError: why the file could not be read, and what is supported of its format."""
    refuse_file(path, reason, supported_vtk(path))


def supported_vtk(path: Path) -> str:
    """The end of a message: what is supported of the format of a file, and how to write it."""
    return f"Supported: {ADVICE[ENDINGS[path.suffix.lower()]]}."


@dataclass
class Grid:
    """An unstructured grid in arrays.

    Attributes:
        points: (n, 3).
        types: (m,) of vtkCellType.
        offsets: (m + 1,) index in `connectivity` of the first node of each cell.
        connectivity: node numbers of all cells.
        cell_data: name -> array with a row for each cell.
        point_data: name -> array with a row for each point.
        pieces: number of points of each piece that the grid was written in.
    """

    points: Points
    types: Array
    offsets: Indices
    connectivity: Indices
    cell_data: dict[str, Array]
    point_data: dict[str, Array]
    pieces: list[int]


def grid_arrays(path: Path, data: Any, pieces: list[int], cells: int | None) -> Grid:
    """The arrays of a data set of VTK.

    Args:
        path: the file, for messages.
        data: the vtkDataSet that a reader returned.
        pieces: number of points of each piece, as the file declares.
        cells: number of cells that the file declares; None: it declares none, and sizes are not compared.

    Raises:
        MeshError: other sizes than declared, an index out of range, or no cells.
    """
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonDataModel import vtkDataSet, vtkUnstructuredGrid

    if not isinstance(data, vtkDataSet) or not data.GetNumberOfPoints():
        refuse_vtk(path, "it holds no points")
    if cells is not None and (data.GetNumberOfPoints(), data.GetNumberOfCells()) != (sum(pieces), cells):
        refuse_vtk(
            path,
            f"it declares {sum(pieces)} points and {cells} cells, of which {data.GetNumberOfPoints()} and "
            f"{data.GetNumberOfCells()} could be read; it was cut off or damaged",
        )
    grid = data if isinstance(data, vtkUnstructuredGrid) else _unstructured(data)
    if not grid.GetNumberOfCells():
        refuse_vtk(path, "it holds no cells")
    offsets = vtk_to_numpy(grid.GetCells().GetOffsetsArray()).astype(np.int64)
    connectivity = vtk_to_numpy(grid.GetCells().GetConnectivityArray()).astype(np.int64)
    points = vtk_to_numpy(grid.GetPoints().GetData()).astype(np.float64)
    types = vtk_to_numpy(grid.GetCellTypesArray())
    if (
        len(offsets) != len(types) + 1
        or offsets[0] != 0
        or offsets[-1] != len(connectivity)
        or np.any(np.diff(offsets) < 0)
    ):
        refuse_vtk(path, f"the offsets of its {len(types)} cells do not fit its list of {len(connectivity)} nodes")
    if len(connectivity) and not (connectivity.min() >= 0 and connectivity.max() < len(points)):
        wrong = int(connectivity[(connectivity < 0) | (connectivity >= len(points))][0])
        refuse_vtk(path, f"a cell has the node {wrong} of {len(points)} nodes (0 is the first)")
    cell_data = _arrays(grid.GetCellData(), len(types))
    return Grid(points, types, offsets, connectivity, cell_data, _arrays(grid.GetPointData(), len(points)), pieces)


def _unstructured(data: Any) -> Any:
    """Polygons or a structured grid as an unstructured grid, strips of triangles as triangles."""
    from vtkmodules.vtkCommonDataModel import vtkPolyData
    from vtkmodules.vtkFiltersCore import vtkAppendFilter, vtkTriangleFilter

    if isinstance(data, vtkPolyData) and data.GetNumberOfStrips():
        triangles = vtkTriangleFilter()
        triangles.SetInputData(data)
        triangles.Update()
        data = triangles.GetOutput()
    join = vtkAppendFilter()
    join.SetInputData(data)
    join.Update()
    return join.GetOutput()


def _arrays(data: Any, count: int) -> dict[str, Array]:
    """Arrays of numbers or strings by name, with one row for each of `count` cells or points."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkDataArray, vtkStringArray

    arrays: dict[str, Array] = {}
    for i in range(data.GetNumberOfArrays()):
        array = data.GetAbstractArray(i)
        if array.GetNumberOfTuples() != count:
            continue
        name = vtk_text(array.GetName()) or f"array-{i + 1}"
        if isinstance(array, vtkStringArray) and array.GetNumberOfComponents() == 1:
            arrays[name] = np.array([vtk_text(array.GetValue(j)).strip() for j in range(count)], np.str_)
        elif isinstance(array, vtkDataArray) and array.GetDataTypeAsString() != "bit":
            values = vtk_to_numpy(array)
            arrays[name] = values[:, 0] if values.ndim == 2 and values.shape[1] == 1 else values
    return arrays


def vtk_text(name: str | bytes | None) -> str:
    """A string of VTK, which Python may have got as bytes."""
    return name.decode("latin-1") if isinstance(name, bytes) else name or ""


def appended_grids(grids: list[Grid]) -> Grid:
    """Several grids as one, with the arrays that all of them have."""
    firsts = np.cumsum([0, *(len(grid.points) for grid in grids)])
    ends = np.cumsum([0, *(len(grid.connectivity) for grid in grids)])
    offsets = [grid.offsets[1:] + end for grid, end in zip(grids, ends, strict=False)]

    def common(data: list[dict[str, Array]]) -> dict[str, Array]:
        names = [name for name in data[0] if all(name in arrays for arrays in data)]
        names = [name for name in names if len({arrays[name].shape[1:] for arrays in data}) == 1]
        return {name: np.concatenate([arrays[name] for arrays in data]) for name in names}

    return Grid(
        np.concatenate([grid.points for grid in grids]),
        np.concatenate([grid.types for grid in grids]),
        np.concatenate([[0], *offsets]),
        np.concatenate([grid.connectivity + first for grid, first in zip(grids, firsts, strict=False)]),
        common([grid.cell_data for grid in grids]),
        common([grid.point_data for grid in grids]),
        [count for grid in grids for count in grid.pieces],
    )


def without_ghosts(grid: Grid, notes: list[str]) -> Grid:
    """The grid without ghost cells, which are copies of cells of other pieces."""
    keep = grid.cell_data["vtkGhostType"] & 1 == 0  # bit vtkDataSetAttributes::DUPLICATECELL
    if np.all(keep):
        return grid
    notes.append(f"{np.count_nonzero(~keep)} ghost cells, copies of cells of other pieces, are left out.")
    sizes = np.diff(grid.offsets)
    return Grid(
        grid.points,
        grid.types[keep],
        np.concatenate([[0], np.cumsum(sizes[keep])]),
        grid.connectivity[np.repeat(keep, sizes)],
        {name: values[keep] for name, values in grid.cell_data.items()},
        grid.point_data,
        grid.pieces,
    )


def join_pieces(path: Path, grid: Grid, notes: list[str]) -> None:
    """Merge the points that pieces have in common: those with the same global number, else at the same place.

    The pieces of a distributed mesh meet in nodes that each of them has.
    """
    piece = np.repeat(np.arange(len(grid.pieces)), grid.pieces)
    ids = next((grid.point_data[key] for key in ("GlobalPointIds", "GlobalNodeId") if key in grid.point_data), None)
    keys = grid.points + 0.0 if ids is None else ids.reshape(len(grid.points), -1)
    _, first, number = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    number = number.ravel()
    if len(np.unique(np.stack([number, piece]), axis=1)[0]) < len(number):
        refuse_vtk(
            path,
            f"it is in {len(grid.pieces)} pieces, and nodes of one piece coincide, so that it is not clear which nodes "
            "of the others are the same; merge the pieces in the program that wrote it, or write GlobalPointIds",
        )
    if joined := len(number) - len(first):
        grid.points, grid.connectivity = grid.points[first], number[grid.connectivity].astype(np.int64)
        grid.point_data = {name: values[first] for name, values in grid.point_data.items()}
        notes.append(
            f"{joined} nodes that {len(grid.pieces)} pieces have in common were joined, by their "
            f"{'places' if ids is None else 'global numbers'}."
        )


def blocks_of_cells(
    path: Path, types: Array, offsets: Indices, connectivity: Indices
) -> tuple[list[Block], list[Indices | slice]]:
    """Blocks of cells of one type and number of nodes, and the indices of their cells in the file."""
    sizes = np.diff(offsets)
    if len(types) and np.all(types == types[0]) and np.all(sizes == sizes[0]):
        groups: list[tuple[int, int, Any]] = [(int(types[0]), int(sizes[0]), slice(None))]  # without a copy
    else:
        groups = list(_groups(types, sizes))
    blocks: list[Block] = []
    members: list[Indices | slice] = []
    for type_, size, cells in groups:
        kind, nodes = KINDS.get(type_, (f"VTK cell type {type_}", 0))
        if nodes and nodes != size:
            refuse_vtk(path, f"a cell of the kind {kind} has {size} nodes instead of {nodes}")
        if isinstance(cells, slice):
            rows = connectivity.reshape(-1, size)
        else:
            rows = connectivity[offsets[cells][:, None] + np.arange(size)]
        blocks.append(Block(kind, rows[:, AXIS_ORDERED[type_]] if type_ in AXIS_ORDERED else rows))
        members.append(cells)
    return blocks, members


def _groups(types: Array, sizes: Indices) -> Iterator[tuple[int, int, Indices]]:
    """Type, number of nodes and cells of each block, in the order of their first cells."""
    keys = sizes * 256 + types
    distinct, first = np.unique(keys, return_index=True)
    for key in distinct[np.argsort(first)]:
        cells = np.flatnonzero(keys == key)
        yield int(types[cells[0]]), int(sizes[cells[0]]), cells
