"""VTK's readers, in a process of their own: legacy and XML files, VTKHDF, Exodus.

A damaged file can crash VTK's readers, or make them ask for any amount of memory: that process has limits of time and
of memory. What VTK says of an error is the message. Each file is compared with the sizes that it declares.
"""

from __future__ import annotations

import base64
import mmap
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NoReturn

import numpy as np
import numpy.typing as npt

from .data import Indices, MeshError, Points
from .mesh_conversion import Block, MeshFileContents
from .netcdf_size import missing_bytes
from .plain_files import HDF5_SIGNATURE, find_external_data, unreadable_reason_beside
from .tags import tag_sets
from .text_rows import decode_text

Array = npt.NDArray[Any]

VTK, HDF, EXODUS = "VTK", "VTKHDF", "Exodus"
ENDINGS = {
    **dict.fromkeys((".vtk", ".vtu", ".vtp", ".pvtu"), VTK),
    **dict.fromkeys((".vtkhdf", ".hdf", ".hdf5", ".h5"), HDF),
    **dict.fromkeys((".e", ".ex2", ".exo", ".exii", ".g", ".gen"), EXODUS),
}
SECONDS, SECONDS_PER_MB = 60, 2  # of a reader, on a machine that has other work as well
MAX_WORDS = 300  # characters of what VTK says
DUPLICATE = 1  # bit of vtkGhostType: a cell that another piece has as well

# Cell types of VTK (vtkCellType.h): meshio's name, and the number of nodes where it is fixed.
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
# Pixels and voxels have their nodes in the order of their axes; quads and hexahedra go around.
AROUND = {8: [0, 1, 3, 2], 11: [0, 1, 3, 2, 4, 5, 7, 6]}


def read_with_vtk(path: Path) -> MeshFileContents:
    """Everything in a file of VTK's or an Exodus file.

    Raises:
        MeshError: the file is damaged, of another kind, or names a file that may not be read.
    """
    from .time_limit import read_with_time_limit

    seconds = SECONDS + SECONDS_PER_MB * path.stat().st_size / 1e6
    return read_with_time_limit(path, _read, "VTK's reader", seconds, _supported(path))


def _refuse(path: Path, why: str) -> NoReturn:
    raise MeshError(f"Mesh file '{path}' could not be read: {why}. {_supported(path)}")


def _supported(path: Path) -> str:
    """What is read of the format of a file, and how to write it: the end of a message."""
    ending = path.suffix.lower()
    advice = {
        VTK: "an unstructured grid or polygons, as VTK legacy (.vtk) or XML (.vtu, .vtp, .pvtu); save it again, for "
        "example in ParaView by File > Save Data as .vtu",
        HDF: "an unstructured grid of VTKHDF; save it again, for example in ParaView by File > Save Data as .vtu",
        EXODUS: "Exodus II in netCDF, classic or HDF5; export it again, for example in Cubit by `export mesh "
        '"part.exo"`',
    }[ENDINGS[ending]]
    return f"Supported: {advice}."


def _read(path: Path) -> MeshFileContents:
    """What `read_with_vtk` returns, in this process."""
    from vtkmodules.vtkCommonCore import vtkOutputWindow, vtkStringOutputWindow

    words = vtkStringOutputWindow()
    vtkOutputWindow.SetInstance(words)
    with path.open("rb") as file:
        head = file.read(len(HDF5_SIGNATURE))
    kind = ENDINGS[path.suffix.lower()]
    try:
        if kind == EXODUS:
            contents = _exodus(path, head)
        elif kind == HDF or head == HDF5_SIGNATURE:
            contents = _contents(path, [_hdf_grid(path)])
        elif path.suffix.lower() == ".pvtu":
            contents = _contents(path, _parallel_grids(path))
        else:
            contents = _contents(path, [_vtk_grid(path)])
    except MeshError:
        _refuse_errors(path, _text(words.GetOutput()))  # says more, as a rule
        raise
    except MemoryError:
        _refuse(path, "it asks for more memory than a file of its size can need; it is damaged")
    _refuse_errors(path, _text(words.GetOutput()))
    warnings = _messages(_text(words.GetOutput()), "Warning")
    notes = (f"VTK's reader warns: {'; '.join(warnings)[:MAX_WORDS]}.",) if warnings else ()
    return replace(contents, notes=contents.notes + notes)


def _refuse_errors(path: Path, said: str) -> None:
    """Refuse a file with errors or warnings, but for the warning that its version is newer than the reader."""
    errors = _messages(said, "ERROR") + [item for item in _messages(said, "Warning") if "higher than" not in item]
    if errors:
        _refuse(path, f"VTK's reader says: {'; '.join(errors)[:MAX_WORDS].rstrip('.')}")


def _messages(said: str, kind: str) -> list[str]:
    """What VTK said of a kind, each once, without the places in VTK's source."""
    text = r"(?:Generic )?" + kind + r": In .*?, line \d+\n(?:\w+ \((?:0x)?[0-9a-fA-F]+\): ?)?(.*?)\n\n"
    result = [" ".join(item.split()) for item in re.findall(text, said + "\n\n", re.DOTALL)]
    if not result and kind in said:
        result = [" ".join(said.split())]
    messages = [item.rstrip(".") for item in result if not item.startswith("Algorithm vtk")]  # that repeats what failed
    return list(dict.fromkeys(messages or result))


# --- grids of VTK ---------------------------------------------------------------------------------------------------


@dataclass
class _Grid:
    """An unstructured grid in arrays.

    Attributes:
        points: (n, 3).    types: (m,) of vtkCellType.    offsets: (m + 1,) into connectivity.
        cell_data, point_data: name -> an array with a row for each cell, each point.
        pieces: numbers of points of the pieces that it was written in.
    """

    points: Points
    types: Array
    offsets: Indices
    connectivity: Indices
    cell_data: dict[str, Array]
    point_data: dict[str, Array]
    pieces: list[int]


def _vtk_grid(path: Path) -> _Grid:
    """A legacy or XML file, by what it begins with."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        if data[:5] == b"# vtk":
            pieces, cells = _declared_legacy(data)
            from vtkmodules.vtkIOLegacy import vtkDataSetReader

            reader = vtkDataSetReader()
            reader.ReadAllScalarsOn()
            reader.ReadAllFieldsOn()
            if data.find(b"vtktypeint32") >= 0:  # as meshio writes it; VTK has another word for the same
                text = data[:].replace(b"vtktypeint32", b"int")
                reader.SetBinaryInputString(text, len(text))
                reader.ReadFromInputStringOn()
        elif kind := re.search(rb"<VTKFile\b[^>]*\btype\s*=\s*[\"'](\w*)", data[:4096]):
            pieces, cells = _declared_xml(data)
            _check_xml_sizes(path, data)
            from vtkmodules import vtkIOXML

            if kind[1] not in (b"UnstructuredGrid", b"PolyData"):
                _refuse(path, f"it holds data of the type {kind[1].decode()}")
            reader = getattr(vtkIOXML, f"vtkXML{kind[1].decode()}Reader")()
        else:
            _refuse(path, f"it begins with {data[:16]!a}, not as a file of VTK does")
    reader.SetFileName(str(path))
    reader.Update()
    return _checked(path, reader.GetOutput(), pieces, cells)


def _declared_legacy(data: Any) -> tuple[list[int], int | None]:
    """Numbers of points and of cells that a legacy file declares; none where its grid has no list of cells."""
    version = re.match(rb"# vtk DataFile Version (\d+)", data)
    flags = re.MULTILINE | re.IGNORECASE  # each search ends where it finds its word: files are large
    kind = re.search(rb"^DATASET[ \t]+(\w+)", data, flags)
    points = re.search(rb"^POINTS[ \t]+(\d+)", data, flags)
    polygons = kind is not None and kind[1].upper() == b"POLYDATA"
    words = rb"VERTICES|LINES|POLYGONS|TRIANGLE_STRIPS" if polygons else rb"CELLS"
    counts: dict[bytes, int] = {}
    for word in re.finditer(rb"^(" + words + rb"|CELL_DATA|POINT_DATA)[ \t]+(\d+)", data, flags):
        if word[1].upper().endswith(b"_DATA") or word[1].upper() in counts:
            break
        counts[word[1].upper()] = int(word[2])
        if not polygons:
            break
    offsets = version is not None and int(version[1]) >= 5  # declares offsets, one more than cells
    cells = sum(max(count - offsets, 0) for count in counts.values()) if counts else None
    return ([int(points[1])] if points else []), cells


def _declared_xml(data: Any) -> tuple[list[int], int | None]:
    """Numbers of points of each piece and of all cells that an XML file declares."""
    points, cells = [], 0
    end = data.find(b"<AppendedData")
    for piece in re.finditer(rb"<Piece\b([^>]*)>", data[:end] if end > 0 else data):
        numbers = {key: int(number) for key, number in re.findall(rb"(\w+)\s*=\s*[\"']\s*(\d+)\s*[\"']", piece[1])}
        points.append(numbers.get(b"NumberOfPoints", 0))
        cells += sum(numbers.get(b"NumberOf" + key, 0) for key in (b"Cells", b"Verts", b"Lines", b"Strips", b"Polys"))
    return points, cells


def _check_xml_sizes(path: Path, data: Any) -> None:
    """Refuse an XML file with arrays of points or cells that are longer than declared: VTK reads their beginning."""
    appended = re.search(rb"<AppendedData\b[^>]*>\s*_", data)
    text = data[: appended.start() if appended else len(data)]
    file = _xml_attributes(re.search(rb"<VTKFile\b[^>]*>", text))
    if appended:
        file["appended"] = _xml_attributes(appended).get("encoding", "base64")
    for piece in re.finditer(rb"<Piece\b[^>]*>", text):
        counts = _xml_attributes(piece)
        stop = text.find(b"</Piece>", piece.end())
        for section in _XML_SECTION.finditer(text, piece.end(), stop if stop > 0 else len(text)):
            word = decode_text(section[1])
            declared = int(counts.get(f"NumberOf{word}", "0").strip() or 0)
            end = text.find(b"</" + section[1], section.end())
            for tag in _XML_ARRAY.finditer(text, section.end(), end if end > 0 else len(text)):
                array = _xml_attributes(tag)
                if word != "Points" and array.get("Name") not in ("offsets", "types"):
                    continue
                if array.get("format") == "appended" and appended:
                    offset = array.get("offset", "")
                    begin = appended.end() + int(offset) if offset.isdigit() else len(data)
                    values = _xml_values(data[begin : begin + 64], array, file)
                else:
                    end_tag = tag.end() if tag[1] else text.find(b"<", tag.end())
                    values = _xml_values(text[tag.end() : end_tag], array, file)
                if values is not None and values > declared * (3 if word == "Points" else 1):
                    name = array.get("Name", word)
                    first = " (3 a point)" if word == "Points" else ""
                    _refuse(
                        path, f"it declares {declared} {word}, and its array '{name}' holds {values} numbers{first}"
                    )


_XML_SECTION = re.compile(rb"<(Points|Cells|Verts|Lines|Strips|Polys)>")
_XML_ARRAY = re.compile(rb"<DataArray\b[^>]*?(/?)>")


def _xml_attributes(tag: re.Match[bytes] | None) -> dict[str, str]:
    pairs = re.findall(rb"(\w+)\s*=\s*[\"']([^\"']*)[\"']", tag[0]) if tag else []
    return {decode_text(key): decode_text(value) for key, value in pairs}


def _xml_values(text: bytes, array: dict[str, str], file: dict[str, str]) -> int | None:
    """How many numbers an array of an XML file holds, by its text or by the sizes before its data; None: unknown.

    Sizes: the number of bytes; of compressed data the number of blocks, bytes of each and of a last, shorter one.
    """
    if array.get("format", "ascii") == "ascii":
        end = text.find(b"<")
        return len(text[: end if end >= 0 else len(text)].split())
    width = 8 if file.get("header_type") == "UInt64" else 4
    size = width * (3 if file.get("compressor") else 1)
    text = text.lstrip() if array["format"] == "binary" else text
    if array["format"] == "binary" or file.get("appended") == "base64":
        try:
            text = base64.b64decode(text[: -(-size // 3) * 4])
        except ValueError:
            return None  # refused by VTK
    order: Literal["big", "little"] = "big" if file.get("byte_order") == "BigEndian" else "little"
    sizes = [int.from_bytes(text[i : i + width], order) for i in range(0, size, width)]
    if len(text) < width:
        return None
    if len(sizes) == 3:
        blocks, block, last = sizes
        sizes = [(blocks - 1) * block + (last or block) if blocks else 0]
    bits = re.fullmatch(r"U?(?:Int|Float)(8|16|32|64)", array.get("type", ""))
    return sizes[0] * 8 // int(bits[1]) if bits else None


def _hdf_grid(path: Path) -> _Grid:
    import h5py

    try:
        with h5py.File(path) as file:
            if not isinstance(file.get("VTKHDF"), h5py.Group):
                _refuse(path, "it is HDF5 without the group 'VTKHDF'")
            if name := find_external_data(file):
                _refuse(path, f"the data of '{name}' lie in another file; save all in one")
            kind = file["VTKHDF"].attrs.get("Type", b"")
            kind = kind.decode(errors="replace") if isinstance(kind, bytes) else str(kind)
            if kind != "UnstructuredGrid":
                _refuse(path, f"it holds data of the type {kind or 'that it does not name'}")
            pieces = [int(count) for count in file["VTKHDF/NumberOfPoints"][()].ravel()]
            cells = int(file["VTKHDF/NumberOfCells"][()].sum())
            steps = int(file["VTKHDF/Steps"].attrs["NSteps"]) if "VTKHDF/Steps" in file else 1
    except MeshError:
        raise
    except (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError):
        _refuse(path, "it is no HDF5 file, or one that is damaged")
    if steps > 1:
        _refuse(path, f"it holds {steps} steps in time; save one of them")
    try:
        from vtkmodules.vtkIOHDF import vtkHDFReader
    except ImportError:
        _refuse(path, "this build of VTK has no reader of VTKHDF (vtkIOHDF)")
    reader = vtkHDFReader()
    reader.SetFileName(str(path))
    reader.Update()
    return _checked(path, reader.GetOutputDataObject(0), pieces, cells)


def _parallel_grids(path: Path) -> list[_Grid]:
    """The pieces that a .pvtu file names, plain files beside it."""
    from xml.etree import ElementTree

    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, ValueError, LookupError):
        _refuse(path, "it is no XML, or it is damaged")
    names = [piece.get("Source") for piece in root.iter("Piece")]
    if root.get("type") != "PUnstructuredGrid" or not names:
        _refuse(path, "it names no pieces of an unstructured grid")
    grids = []
    for name in names:
        wrong = unreadable_reason_beside(path, name) if name else "has no name"
        if not wrong and Path(str(name)).suffix.lower() != ".vtu":
            wrong = "is no .vtu"
        if wrong:
            _refuse(path, f"it names the file '{name or ''}', which {wrong}")
        grids.append(_vtk_grid(path.parent / str(name)))
    return grids


def _checked(path: Path, data: Any, pieces: list[int], cells: int | None) -> _Grid:
    """The arrays of a data set of VTK's, as many as the file declares and each index in range."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonDataModel import vtkDataSet, vtkUnstructuredGrid

    if not isinstance(data, vtkDataSet) or not data.GetNumberOfPoints():
        _refuse(path, "it holds no points")
    if cells is not None and (data.GetNumberOfPoints(), data.GetNumberOfCells()) != (sum(pieces), cells):
        _refuse(
            path,
            f"it declares {sum(pieces)} points and {cells} cells, of which {data.GetNumberOfPoints()} and "
            f"{data.GetNumberOfCells()} could be read; it was cut off or damaged",
        )
    grid = data if isinstance(data, vtkUnstructuredGrid) else _unstructured(data)
    if not grid.GetNumberOfCells():
        _refuse(path, "it holds no cells")
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
        _refuse(path, f"the offsets of its {len(types)} cells do not fit its list of {len(connectivity)} nodes")
    if len(connectivity) and not (connectivity.min() >= 0 and connectivity.max() < len(points)):
        wrong = int(connectivity[(connectivity < 0) | (connectivity >= len(points))][0])
        _refuse(path, f"a cell has the node {wrong} of {len(points)} nodes (0 is the first)")
    cell_data = _arrays(grid.GetCellData(), len(types))
    return _Grid(points, types, offsets, connectivity, cell_data, _arrays(grid.GetPointData(), len(points)), pieces)


def _unstructured(data: Any) -> Any:
    """Polygons and structured grids as an unstructured grid; strips of triangles are taken apart."""
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
    """Arrays by name, one row for each of `count` cells or points; arrays of strings too."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkDataArray, vtkStringArray

    arrays: dict[str, Array] = {}
    for i in range(data.GetNumberOfArrays()):
        array = data.GetAbstractArray(i)
        if array.GetNumberOfTuples() != count:
            continue
        name = _text(array.GetName()) or f"array-{i + 1}"
        if isinstance(array, vtkStringArray) and array.GetNumberOfComponents() == 1:
            arrays[name] = np.array([_text(array.GetValue(j)).strip() for j in range(count)], np.str_)
        elif isinstance(array, vtkDataArray) and array.GetDataTypeAsString() != "bit":
            values = vtk_to_numpy(array)
            arrays[name] = values[:, 0] if values.ndim == 2 and values.shape[1] == 1 else values
    return arrays


def _text(name: str | bytes | None) -> str:
    return name.decode("latin-1") if isinstance(name, bytes) else name or ""


# --- from grids to contents -----------------------------------------------------------------------------------------


def _contents(path: Path, grids: list[_Grid]) -> MeshFileContents:
    """Grids as one, with sets by their arrays."""
    notes: list[str] = []
    grid = grids[0] if len(grids) == 1 else _appended(grids)
    if "vtkGhostType" in grid.cell_data:
        grid = _without_ghosts(grid, notes)
    if len(grid.pieces) > 1:
        _join_pieces(path, grid, notes)
    blocks, members = _blocks(path, grid.types, grid.offsets, grid.connectivity)
    cell_data = {name: [values[part] for part in members] for name, values in grid.cell_data.items()}
    sets, used, said = tag_sets(cell_data, blocks, lambda tag, _: [f"tag-{tag}"])
    point_sets = {name: np.flatnonzero(values) for name, values in grid.point_data.items() if _marks(values)}
    hidden = ("vtkGhostType", "GlobalPointIds", "GlobalCellIds", "GlobalNodeId", "GlobalElementId")
    for where, names in (
        ("cell", [name for name in grid.cell_data if name not in (*used, *hidden)]),
        ("point", [name for name in grid.point_data if name not in (*point_sets, *hidden)]),
    ):
        if names:
            notes.append(f"Not used: the {where} arrays {', '.join(names)}.")
    return MeshFileContents(grid.points, blocks, sets, point_sets, notes=(*said, *notes))


def _marks(values: Array) -> bool:
    """Whether an array marks points: integers, 0 and 1, both of them."""
    return values.ndim == 1 and values.dtype.kind in "iu" and np.array_equal(np.unique(values), [0, 1])


def _blocks(
    path: Path, types: Array, offsets: Indices, connectivity: Indices
) -> tuple[list[Block], list[Indices | slice]]:
    """Cells of one type and one number of nodes each, and which of all cells they are, in the order of the file."""
    sizes = np.diff(offsets)
    if len(types) and np.all(types == types[0]) and np.all(sizes == sizes[0]):
        groups: list[tuple[int, int, Any]] = [(int(types[0]), int(sizes[0]), slice(None))]
    else:
        groups = list(_groups(types, sizes))
    blocks: list[Block] = []
    members: list[Indices | slice] = []
    for type_, size, cells in groups:
        kind, nodes = KINDS.get(type_, (f"VTK cell type {type_}", 0))
        if nodes and nodes != size:
            _refuse(path, f"a cell of the kind {kind} has {size} nodes instead of {nodes}")
        if isinstance(cells, slice):
            rows = connectivity.reshape(-1, size)
        else:
            rows = connectivity[offsets[cells][:, None] + np.arange(size)]
        blocks.append(Block(kind, rows[:, AROUND[type_]] if type_ in AROUND else rows))
        members.append(cells)
    return blocks, members


def _groups(types: Array, sizes: Indices) -> Iterator[tuple[int, int, Indices]]:
    """Type, number of nodes, and cells, in the order of the first cell of each."""
    keys = sizes * 256 + types
    distinct, first = np.unique(keys, return_index=True)
    for key in distinct[np.argsort(first)]:
        cells = np.flatnonzero(keys == key)
        yield int(types[cells[0]]), int(sizes[cells[0]]), cells


def _appended(grids: list[_Grid]) -> _Grid:
    """Grids one after another, with the arrays that all of them have."""
    firsts = np.cumsum([0, *(len(grid.points) for grid in grids)])
    ends = np.cumsum([0, *(len(grid.connectivity) for grid in grids)])
    offsets = [grid.offsets[1:] + end for grid, end in zip(grids, ends, strict=False)]

    def common(data: list[dict[str, Array]]) -> dict[str, Array]:
        names = [name for name in data[0] if all(name in item for item in data)]
        names = [name for name in names if len({item[name].shape[1:] for item in data}) == 1]
        return {name: np.concatenate([item[name] for item in data]) for name in names}

    return _Grid(
        np.concatenate([grid.points for grid in grids]),
        np.concatenate([grid.types for grid in grids]),
        np.concatenate([[0], *offsets]),
        np.concatenate([grid.connectivity + first for grid, first in zip(grids, firsts, strict=False)]),
        common([grid.cell_data for grid in grids]),
        common([grid.point_data for grid in grids]),
        [count for grid in grids for count in grid.pieces],
    )


def _without_ghosts(grid: _Grid, notes: list[str]) -> _Grid:
    """The grid without the cells that it has of other pieces."""
    keep = grid.cell_data["vtkGhostType"] & DUPLICATE == 0
    if np.all(keep):
        return grid
    notes.append(f"{np.count_nonzero(~keep)} ghost cells, copies of cells of other pieces, are left out.")
    sizes = np.diff(grid.offsets)
    return _Grid(
        grid.points,
        grid.types[keep],
        np.concatenate([[0], np.cumsum(sizes[keep])]),
        grid.connectivity[np.repeat(keep, sizes)],
        {name: values[keep] for name, values in grid.cell_data.items()},
        grid.point_data,
        grid.pieces,
    )


def _join_pieces(path: Path, grid: _Grid, notes: list[str]) -> None:
    """Give the points that pieces have in common one number: those of one global number, else of one place.

    The pieces of a mesh that was distributed meet in nodes that each of them has.
    """
    piece = np.repeat(np.arange(len(grid.pieces)), grid.pieces)
    ids = next((grid.point_data[key] for key in ("GlobalPointIds", "GlobalNodeId") if key in grid.point_data), None)
    keys = grid.points + 0.0 if ids is None else ids.reshape(len(grid.points), -1)
    _, first, number = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    number = number.ravel()
    if len(np.unique(np.stack([number, piece]), axis=1)[0]) < len(number):
        _refuse(
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


# --- Exodus ---------------------------------------------------------------------------------------------------------


def _exodus(path: Path, head: bytes) -> MeshFileContents:
    """Element blocks and element sets as sets of cells, side sets as sets of facets, node sets as sets of nodes."""
    _check_netcdf(path, head)
    try:
        from vtkmodules.vtkIOExodus import vtkExodusIIReader
    except ImportError:
        _refuse(path, "this build of VTK has no reader of Exodus (vtkIOExodus)")
    reader = vtkExodusIIReader()
    if not reader.CanReadFile(str(path)):
        _refuse(path, "it is netCDF without the arrays of Exodus")
    reader.SetFileName(str(path))
    reader.SetApplyDisplacements(False)
    reader.SetSqueezePoints(False)  # nodes keep their numbers in all blocks
    reader.UpdateInformation()
    kinds = (vtkExodusIIReader.ELEM_BLOCK, vtkExodusIIReader.SIDE_SET, vtkExodusIIReader.NODE_SET)
    for kind in kinds:
        for i in range(reader.GetNumberOfObjects(kind)):
            reader.SetObjectStatus(kind, i, 1)
    reader.Update()
    if not reader.GetNumberOfObjects(vtkExodusIIReader.ELEM_BLOCK):
        _refuse(path, "it has no element block")
    points: Points = np.zeros((0, 3))
    blocks: list[Block] = []
    owners: list[tuple[str, int]] = []
    point_sets: dict[str, Indices] = {}
    for position, (kind, word) in zip((0, 4, 7), zip(kinds, ("block", "side", "nodes"), strict=True), strict=True):
        for i in range(reader.GetNumberOfObjects(kind)):
            name = _exodus_name(reader, kind, i, word)
            grid = _member(reader.GetOutput(), position, i)
            declared = reader.GetNumberOfEntriesInObject(kind, i)
            read = 0 if grid is None else grid.GetNumberOfCells()
            if kind == vtkExodusIIReader.ELEM_BLOCK and read != declared:
                _refuse(path, f"its element block '{name}' declares {declared} cells, of which {read} could be read")
            if not read:
                continue
            arrays = _checked(path, grid, [], None)
            if word == "nodes":
                point_sets[name] = np.union1d(point_sets.get(name, []), arrays.connectivity).astype(np.int64)
                continue
            if word == "block":
                points = arrays.points
            for block in _blocks(path, arrays.types, arrays.offsets, arrays.connectivity)[0]:
                owners.append((name, len(blocks)))
                blocks.append(block)
    declared = reader.GetTotalNumberOfNodes()
    if len(points) != declared:
        _refuse(path, f"it declares {declared} nodes, of which {len(points)} could be read")
    sets: dict[str, list[Indices]] = {}
    for name, i in owners:
        members = sets.setdefault(name, [np.zeros(0, np.int64) for _ in blocks])
        members[i] = np.arange(len(blocks[i].nodes))
    notes = _exodus_unused(reader)
    if repeated := [name for name in point_sets if name in sets]:
        notes += (f"Node sets not used, because a block or a side set has the same name: {', '.join(repeated)}.",)
    return MeshFileContents(points, blocks, sets, point_sets, notes=notes)


def _exodus_name(reader: Any, kind: int, i: int, word: str) -> str:
    """The name of a block or set, or made from its number where it has none."""
    name = _text(reader.GetObjectName(kind, i)).strip()
    return name if name and not re.match(r"Unnamed (block|set) ID: ", name) else f"{word}-{reader.GetObjectId(kind, i)}"


def _member(output: Any, place: int, i: int) -> Any:
    group = output.GetBlock(place) if place < output.GetNumberOfBlocks() else None
    return group.GetBlock(i) if group is not None and i < group.GetNumberOfBlocks() else None


def _exodus_unused(reader: Any) -> tuple[str, ...]:
    """What an Exodus file has besides."""
    words = {"EDGE_BLOCK": "edge blocks", "FACE_BLOCK": "face blocks", "EDGE_SET": "edge sets",
             "FACE_SET": "face sets", "ELEM_SET": "element sets"}  # fmt: skip
    unused = []
    for key, word in words.items():
        if count := reader.GetNumberOfObjects(getattr(reader, key)):
            unused.append(f"{count} {word}")
    for key, word in (("NODAL", "nodes"), ("ELEM_BLOCK", "cells")):
        kind = getattr(reader, key)
        names = [_text(reader.GetObjectArrayName(kind, i)) for i in range(reader.GetNumberOfObjectArrays(kind))]
        if names:
            unused.append(f"results on {word} ({', '.join(names)})")
    return (f"Not used: {', '.join(unused)}.",) if unused else ()


def _check_netcdf(path: Path, head: bytes) -> None:
    """Refuse what is no netCDF, ends before its data do, or has data in other files."""
    if head == HDF5_SIGNATURE:
        import h5py

        try:
            with h5py.File(path) as file:
                elsewhere = find_external_data(file)
        except (OSError, KeyError, RuntimeError, ValueError):
            _refuse(path, "its HDF5 is damaged")
        if elsewhere:
            _refuse(path, f"the data of '{elsewhere}' lie in another file; save all in one")
    elif head[:3] == b"CDF" and head[3:4] in (b"\1", b"\2", b"\5"):
        missing = missing_bytes(path)
        if missing is None:
            _refuse(path, "its netCDF header is damaged")
        if missing > 0:
            _refuse(path, f"it is {missing} bytes shorter than its header says; it was cut off")
    else:
        _refuse(path, f"it begins with {head!a}, not as netCDF does")
