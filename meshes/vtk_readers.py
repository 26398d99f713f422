"""VTK's readers in another process: legacy and XML files, VTKHDF, Exodus.

A damaged file can crash VTK's readers, or make them ask for any amount of memory: the process has limits of time and
memory. VTK's error messages become part of ours. VTK's readers may return part of a damaged file without an error: each
file is compared with the numbers of points and cells that it declares.
"""

from __future__ import annotations

import base64
import mmap
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np

from .cell_sets import tag_sets
from .data import MeshError
from .exodus import read_exodus
from .file_text import decode_text
from .mesh_conversion import MeshFileContents
from .plain_files import HDF5_SIGNATURE, find_external_data, unreadable_reason_beside
from .vtk_grid import (
    ENDINGS,
    EXODUS,
    HDF,
    Array,
    Grid,
    appended_grids,
    blocks_of_cells,
    grid_arrays,
    join_pieces,
    refuse_vtk,
    supported_vtk,
    vtk_text,
    without_ghosts,
)
from .vtkhdf import read_group_names

MAX_MESSAGE = 300  # characters of VTK's messages


def read_with_vtk(path: Path) -> MeshFileContents:
    """Points, cells and arrays of a file of VTK, or of an Exodus file.

    Raises:
        MeshError: the file is damaged, of another kind, or names a file that may not be read.
    """
    from .time_limit import read_with_time_limit

    # text is slow to read, and the machine may have other work
    advice = supported_vtk(path)
    return read_with_time_limit(path, _read, "VTK's reader", seconds_per_megabyte=2.0, advice=advice)


def _read(path: Path) -> MeshFileContents:
    """The contents of a file, read in this process."""
    from vtkmodules.vtkCommonCore import vtkOutputWindow, vtkStringOutputWindow

    messages = vtkStringOutputWindow()
    vtkOutputWindow.SetInstance(messages)
    with path.open("rb") as file:
        head = file.read(len(HDF5_SIGNATURE))
    kind = ENDINGS[path.suffix.lower()]
    # files of VTKHDF may have the ending .vtk
    try:
        if kind == EXODUS:
            contents = read_exodus(path, head)
        elif kind == HDF or head == HDF5_SIGNATURE:
            grid, names = _hdf_grid(path)
            contents = _contents(path, [grid], names)
        elif path.suffix.lower() == ".pvtu":
            contents = _contents(path, _parallel_grids(path))
        else:
            contents = _contents(path, [_vtk_grid(path)])
    except MeshError:
        _refuse_errors(path, vtk_text(messages.GetOutput()))  # tells more, as a rule
        raise
    except MemoryError:
        refuse_vtk(path, "it asks for more memory than a file of its size can need; it is damaged")
    _refuse_errors(path, vtk_text(messages.GetOutput()))
    warnings = _messages(vtk_text(messages.GetOutput()), "Warning")
    notes = (f"VTK's reader warns: {'; '.join(warnings)[:MAX_MESSAGE]}.",) if warnings else ()
    return replace(contents, notes=contents.notes + notes)


def _refuse_errors(path: Path, output: str) -> None:
    """Raise MeshError if VTK's output has errors or warnings, except that the version of the file is newer."""
    warnings = [message for message in _messages(output, "Warning") if "higher than" not in message]
    if errors := _messages(output, "ERROR") + warnings:
        refuse_vtk(path, f"VTK's reader says: {'; '.join(errors)[:MAX_MESSAGE].rstrip('.')}")


def _messages(output: str, kind: str) -> list[str]:
    """The distinct messages of a kind ("ERROR" or "Warning") in VTK's output, without their places in its source."""
    pattern = r"(?:Generic )?" + kind + r": In .*?, line \d+\n(?:\w+ \((?:0x)?[0-9a-fA-F]+\): ?)?(.*?)\n\n"
    texts = [" ".join(text.split()) for text in re.findall(pattern, output + "\n\n", re.DOTALL)]
    if not texts and kind in output:
        texts = [" ".join(output.split())]
    # "Algorithm vtk..." only repeats that the reader failed
    messages = [text.rstrip(".") for text in texts if not text.startswith("Algorithm vtk")]
    return list(dict.fromkeys(messages or texts))


def _vtk_grid(path: Path) -> Grid:
    """The grid of a legacy or XML file, which its first bytes tell apart."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        if data[:5] == b"# vtk":
            pieces, cells = declared_in_legacy(data)
            from vtkmodules.vtkIOLegacy import vtkDataSetReader

            reader = vtkDataSetReader()
            reader.ReadAllScalarsOn()
            reader.ReadAllFieldsOn()
            if data.find(b"vtktypeint32") >= 0:  # meshio's word for VTK's "int"
                text = data[:].replace(b"vtktypeint32", b"int")
                reader.SetBinaryInputString(text, len(text))
                reader.ReadFromInputStringOn()
        elif kind := re.search(rb"<VTKFile\b[^>]*\btype\s*=\s*[\"'](\w*)", data[:4096]):
            pieces, cells = declared_in_xml(data)
            check_xml_sizes(path, data)
            from vtkmodules import vtkIOXML

            if kind[1] not in (b"UnstructuredGrid", b"PolyData"):
                refuse_vtk(path, f"it holds data of the type {kind[1].decode()}")
            reader = getattr(vtkIOXML, f"vtkXML{kind[1].decode()}Reader")()
        else:
            refuse_vtk(path, f"it begins with {data[:16]!a}, not as a file of VTK does")
        reader.SetFileName(str(path))
        reader.Update()
        if data[:5] == b"# vtk" and (output := reader.GetOutput()) is not None:
            arrays = {"POINT_DATA": output.GetPointData(), "CELL_DATA": output.GetCellData()}
            check_legacy_arrays(path, data, {kind: items.GetNumberOfArrays() for kind, items in arrays.items()})
    return grid_arrays(path, reader.GetOutput(), pieces, cells)


def _hdf_grid(path: Path) -> tuple[Grid, dict[int, str]]:
    """The grid of a VTKHDF file, and the names of its groups by their numbers."""
    import h5py

    try:
        with h5py.File(path) as file:
            if not isinstance(file.get("VTKHDF"), h5py.Group):
                refuse_vtk(path, "it is HDF5 without the group 'VTKHDF'")
            if name := find_external_data(file):
                refuse_vtk(path, f"the data of '{name}' lie in another file; save all in one")
            kind = file["VTKHDF"].attrs.get("Type", b"")
            kind = kind.decode(errors="replace") if isinstance(kind, bytes) else str(kind)
            if kind != "UnstructuredGrid":
                refuse_vtk(path, f"it holds data of the type {kind or 'that it does not name'}")
            pieces = [int(count) for count in file["VTKHDF/NumberOfPoints"][()].ravel()]
            cells = int(file["VTKHDF/NumberOfCells"][()].sum())
            steps = int(file["VTKHDF/Steps"].attrs["NSteps"]) if "VTKHDF/Steps" in file else 1
            names = read_group_names(file)
    except MeshError:
        raise
    except (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError):
        refuse_vtk(path, "it is no HDF5 file, or one that is damaged")
    if steps > 1:
        refuse_vtk(path, f"it holds {steps} steps in time; save one of them")
    try:
        from vtkmodules.vtkIOHDF import vtkHDFReader
    except ImportError:
        refuse_vtk(path, "this build of VTK has no reader of VTKHDF (vtkIOHDF)")
    reader = vtkHDFReader()
    reader.SetFileName(str(path))
    reader.Update()
    return grid_arrays(path, reader.GetOutputDataObject(0), pieces, cells), names


def _parallel_grids(path: Path) -> list[Grid]:
    """The grids of the files that a .pvtu file names; they must be plain files in its folder."""
    from xml.etree import ElementTree

    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, ValueError, LookupError):
        refuse_vtk(path, "it is no XML, or it is damaged")
    names = [piece.get("Source") for piece in root.iter("Piece")]
    if root.get("type") != "PUnstructuredGrid" or not names:
        refuse_vtk(path, "it names no pieces of an unstructured grid")
    grids = []
    for name in names:
        wrong = unreadable_reason_beside(path, name) if name else "has no name"
        if not wrong and Path(str(name)).suffix.lower() != ".vtu":
            wrong = "is no .vtu"
        if wrong:
            refuse_vtk(path, f"it names the file '{name or ''}', which {wrong}")
        grids.append(_vtk_grid(path.parent / str(name)))
    return grids


def _contents(path: Path, grids: list[Grid], names: dict[int, str] | None = None) -> MeshFileContents:
    """Grids as one, with sets of cells and of points from their arrays; `names`: of the numbers of sets."""
    notes: list[str] = []
    names = names or {}
    grid = grids[0] if len(grids) == 1 else appended_grids(grids)
    if "vtkGhostType" in grid.cell_data:
        grid = without_ghosts(grid, notes)
    if len(grid.pieces) > 1:
        join_pieces(path, grid, notes)
    blocks, members = blocks_of_cells(path, grid.types, grid.offsets, grid.connectivity)
    cell_data = {name: [values[part] for part in members] for name, values in grid.cell_data.items()}
    sets, used, tag_notes = tag_sets(cell_data, blocks, lambda tag, _: [names.get(tag, f"tag-{tag}")])
    point_sets = {name: np.flatnonzero(values) for name, values in grid.point_data.items() if _is_mask(values)}
    hidden = ("vtkGhostType", "GlobalPointIds", "GlobalCellIds", "GlobalNodeId", "GlobalElementId")
    for kind, unused in (
        ("cell", [name for name in grid.cell_data if name not in (*used, *hidden)]),
        ("point", [name for name in grid.point_data if name not in (*point_sets, *hidden)]),
    ):
        if unused:
            notes.append(f"Not used: the {kind} arrays {', '.join(unused)}.")
    return MeshFileContents(grid.points, blocks, sets, point_sets, notes=(*tag_notes, *notes))


def _is_mask(values: Array) -> bool:
    """Whether an array marks points: its integers are 0 and 1, and both occur."""
    return values.ndim == 1 and values.dtype.kind in "iu" and np.array_equal(np.unique(values), [0, 1])


def declared_in_legacy(data: Any) -> tuple[list[int], int | None]:
    """Number of points and of cells that a legacy file declares; None of a grid without a list of cells."""
    version = re.match(rb"# vtk DataFile Version (\d+)", data)
    flags = re.MULTILINE | re.IGNORECASE
    kind = re.search(rb"^DATASET[ \t]+(\w+)", data, flags)
    points = re.search(rb"^POINTS[ \t]+(\d+)", data, flags)
    polygons = kind is not None and kind[1].upper() == b"POLYDATA"
    keywords = rb"VERTICES|LINES|POLYGONS|TRIANGLE_STRIPS" if polygons else rb"CELLS"
    counts: dict[bytes, int] = {}
    # a file may be large: the search ends at the last section that counts
    for match in re.finditer(rb"^(" + keywords + rb"|CELL_DATA|POINT_DATA)[ \t]+(\d+)", data, flags):
        keyword = match[1].upper()
        if keyword.endswith(b"_DATA") or keyword in counts:
            break
        counts[keyword] = int(match[2])
        if not polygons:
            break
    offsets = version is not None and int(version[1]) >= 5  # it declares offsets, one more than cells
    cells = sum(max(count - offsets, 0) for count in counts.values()) if counts else None
    return ([int(points[1])] if points else []), cells


_ATTRIBUTE = rb"SCALARS|VECTORS|NORMALS|TENSORS6?|TEXTURE_COORDINATES|COLOR_SCALARS|GLOBAL_IDS|PEDIGREE_IDS|EDGE_FLAGS"


def check_legacy_arrays(path: Path, data: Any, counts: dict[str, int]) -> None:
    """Raise MeshError if a legacy file declares more arrays than `counts` of them, by "POINT_DATA" and "CELL_DATA".

    VTK 9.7 ends without an error where the text of an array is cut off. The last array of a text has to be whole.
    """
    flags = re.MULTILINE | re.IGNORECASE
    heads = list(re.compile(rb"^(POINT_DATA|CELL_DATA)[ \t]+\d+[ \t]*\r?$", flags).finditer(data))
    for head, after in pairwise([*heads, None]):
        assert head is not None
        begin, end = head.end(), after.start() if after else len(data)
        attributes = re.compile(rb"^(?:" + _ATTRIBUTE + rb")[ \t]+(\S+)", flags).finditer(data, begin, end)
        fields = re.compile(rb"^FIELD[ \t]+\S+[ \t]+(\d+)[ \t]*\r?$", flags).finditer(data, begin, end)
        declared = len({match[1] for match in attributes}) + sum(int(match[1]) for match in fields)
        kind = head[1].decode().upper()
        if counts[kind] < declared:
            refuse_vtk(path, f"{kind} declares {declared} arrays, of which {counts[kind]} can be read; it is damaged")
    is_text = re.match(rb"(?:[^\n]*\n){2}ASCII\b", data)
    arrays = (
        list(re.compile(rb"^\S+[ \t]+(\d+)[ \t]+(\d+)[ \t]+[a-z_]+[ \t]*\r?$", flags).finditer(data)) if is_text else []
    )
    if arrays and len(data[arrays[-1].end() :].split()) < int(arrays[-1][1]) * int(arrays[-1][2]):
        refuse_vtk(path, f"its last array, {arrays[-1][0].decode(errors='replace').split()[0]}, is cut off")


def declared_in_xml(data: Any) -> tuple[list[int], int | None]:
    """Number of points of each piece, and of all cells, that an XML file declares."""
    points, cells = [], 0
    end = data.find(b"<AppendedData")
    for piece in re.finditer(rb"<Piece\b([^>]*)>", data[:end] if end > 0 else data):
        numbers = {key: int(number) for key, number in re.findall(rb"(\w+)\s*=\s*[\"']\s*(\d+)\s*[\"']", piece[1])}
        points.append(numbers.get(b"NumberOfPoints", 0))
        cells += sum(numbers.get(b"NumberOf" + key, 0) for key in (b"Cells", b"Verts", b"Lines", b"Strips", b"Polys"))
    return points, cells


def check_xml_sizes(path: Path, data: Any) -> None:
    """Raise MeshError if an array of points or cells is longer than declared; VTK would read its beginning."""
    appended = re.search(rb"<AppendedData\b[^>]*>\s*_", data)
    text = data[: appended.start() if appended else len(data)]
    file = _xml_attributes(re.search(rb"<VTKFile\b[^>]*>", text))
    if appended:
        file["appended"] = _xml_attributes(appended).get("encoding", "base64")
    for piece in re.finditer(rb"<Piece\b[^>]*>", text):
        counts = _xml_attributes(piece)
        stop = text.find(b"</Piece>", piece.end())
        for section in _XML_SECTION.finditer(text, piece.end(), stop if stop > 0 else len(text)):
            name = decode_text(section[1])
            declared = int(counts.get(f"NumberOf{name}", "0").strip() or 0)
            end = text.find(b"</" + section[1], section.end())
            for tag in _XML_ARRAY.finditer(text, section.end(), end if end > 0 else len(text)):
                array = _xml_attributes(tag)
                if name != "Points" and array.get("Name") not in ("offsets", "types"):
                    continue
                if array.get("format") == "appended" and appended:
                    offset = array.get("offset", "")
                    begin = appended.end() + int(offset) if offset.isdigit() else len(data)
                    values = _xml_values(data[begin : begin + 64], array, file)
                else:
                    end_tag = tag.end() if tag[1] else text.find(b"<", tag.end())
                    values = _xml_values(text[tag.end() : end_tag], array, file)
                if values is not None and values > declared * (3 if name == "Points" else 1):
                    per_point = " (3 a point)" if name == "Points" else ""
                    refuse_vtk(
                        path,
                        f"it declares {declared} {name}, and its array '{array.get('Name', name)}' holds {values} "
                        f"numbers{per_point}",
                    )


_XML_SECTION = re.compile(rb"<(Points|Cells|Verts|Lines|Strips|Polys)>")


_XML_ARRAY = re.compile(rb"<DataArray\b[^>]*?(/?)>")


def _xml_attributes(tag: re.Match[bytes] | None) -> dict[str, str]:
    pairs = re.findall(rb"(\w+)\s*=\s*[\"']([^\"']*)[\"']", tag[0]) if tag else []
    return {decode_text(key): decode_text(value) for key, value in pairs}


def _xml_values(text: bytes, array: dict[str, str], file: dict[str, str]) -> int | None:
    """How many numbers an array of an XML file holds; None: unknown.

    Numbers of text are counted. Binary data begin with their number of bytes, compressed data with the number of
    blocks, the bytes of a block and those of a last, shorter block.
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
            return None  # VTK refuses it
    order: Literal["big", "little"] = "big" if file.get("byte_order") == "BigEndian" else "little"
    sizes = [int.from_bytes(text[i : i + width], order) for i in range(0, size, width)]
    if len(text) < width:
        return None
    if len(sizes) == 3:
        blocks, block, last = sizes
        sizes = [(blocks - 1) * block + (last or block) if blocks else 0]
    bits = re.fullmatch(r"U?(?:Int|Float)(8|16|32|64)", array.get("type", ""))
    return sizes[0] * 8 // int(bits[1]) if bits else None
