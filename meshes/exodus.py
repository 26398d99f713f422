"""Exodus II files, by VTK's reader.

A file is netCDF, classic or HDF5. The netCDF library reads zeros beyond the end of a classic file; so the length of the
file is compared with its header ("NetCDF Classic Format Specification", Unidata; CDF-1, CDF-2 and CDF-5).
"""

from __future__ import annotations

import mmap
import re
import struct
from pathlib import Path
from typing import Any

import numpy as np

from .cell_sets import add_to_set
from .data import Indices, Points
from .mesh_conversion import Block, MeshFileContents
from .plain_files import HDF5_SIGNATURE, find_external_data
from .vtk_grid import blocks_of_cells, grid_arrays, refuse_vtk, vtk_text


def read_exodus(path: Path, head: bytes) -> MeshFileContents:
    """The grid of an Exodus file: element blocks as sets of cells, side sets as sets of facets, node sets.

    `head`: the first bytes of the file.
    """
    _check_netcdf(path, head)
    try:
        from vtkmodules.vtkIOExodus import vtkExodusIIReader
    except ImportError:
        refuse_vtk(path, "this build of VTK has no reader of Exodus (vtkIOExodus)")
    reader = vtkExodusIIReader()
    if not reader.CanReadFile(str(path)):
        refuse_vtk(path, "it is netCDF without the arrays of Exodus")
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
        refuse_vtk(path, "it has no element block")
    points: Points = np.zeros((0, 3))
    blocks: list[Block] = []
    names: list[str] = []  # of each block of cells
    point_sets: dict[str, Indices] = {}
    # index of each kind of object in the output (vtkExodusIIReader), and the name of objects without one
    for index, kind, word in zip((0, 4, 7), kinds, ("block", "side", "nodes"), strict=True):
        for i in range(reader.GetNumberOfObjects(kind)):
            name = _name(reader, kind, i, word)
            grid = _object(reader.GetOutput(), index, i)
            declared = reader.GetNumberOfEntriesInObject(kind, i)
            read = 0 if grid is None else grid.GetNumberOfCells()
            if kind == vtkExodusIIReader.ELEM_BLOCK and read != declared:
                refuse_vtk(path, f"its element block '{name}' declares {declared} cells, of which {read} could be read")
            if not read:
                continue
            arrays = grid_arrays(path, grid, [], None)
            if word == "nodes":
                point_sets[name] = np.union1d(point_sets.get(name, []), arrays.connectivity).astype(np.int64)
                continue
            if word == "block":
                points = arrays.points
            for block in blocks_of_cells(path, arrays.types, arrays.offsets, arrays.connectivity)[0]:
                names.append(name)
                blocks.append(block)
    declared = reader.GetTotalNumberOfNodes()
    if len(points) != declared:
        refuse_vtk(path, f"it declares {declared} nodes, of which {len(points)} could be read")
    sets: dict[str, list[Indices]] = {}
    for i, (name, block) in enumerate(zip(names, blocks, strict=True)):
        add_to_set(sets, blocks, name, i, np.arange(len(block.nodes)))
    notes = _unused_note(reader)
    if repeated := [name for name in point_sets if name in sets]:
        notes += (f"Node sets not used, because a block or a side set has the same name: {', '.join(repeated)}.",)
    return MeshFileContents(points, blocks, sets, point_sets, notes=notes)


def _name(reader: Any, kind: int, i: int, word: str) -> str:
    """The name of a block or set; without one `word` and its number."""
    name = vtk_text(reader.GetObjectName(kind, i)).strip()
    return name if name and not re.match(r"Unnamed (block|set) ID: ", name) else f"{word}-{reader.GetObjectId(kind, i)}"


def _object(output: Any, index: int, i: int) -> Any:
    """The grid of object i of the kind at an index of the reader's output; None if it is not there."""
    group = output.GetBlock(index) if index < output.GetNumberOfBlocks() else None
    return group.GetBlock(i) if group is not None and i < group.GetNumberOfBlocks() else None


def _unused_note(reader: Any) -> tuple[str, ...]:
    """A note of the objects and results that are not used."""
    words = {"EDGE_BLOCK": "edge blocks", "FACE_BLOCK": "face blocks", "EDGE_SET": "edge sets",
             "FACE_SET": "face sets", "ELEM_SET": "element sets"}  # fmt: skip
    unused = []
    for key, word in words.items():
        if count := reader.GetNumberOfObjects(getattr(reader, key)):
            unused.append(f"{count} {word}")
    for key, word in (("NODAL", "nodes"), ("ELEM_BLOCK", "cells")):
        kind = getattr(reader, key)
        names = [vtk_text(reader.GetObjectArrayName(kind, i)) for i in range(reader.GetNumberOfObjectArrays(kind))]
        if names:
            unused.append(f"results on {word} ({', '.join(names)})")
    return (f"Not used: {', '.join(unused)}.",) if unused else ()


def _check_netcdf(path: Path, head: bytes) -> None:
    """Raise MeshError if the file is no netCDF, is shorter than its header says, or has data in other files."""
    if head == HDF5_SIGNATURE:
        import h5py

        try:
            with h5py.File(path) as file:
                elsewhere = find_external_data(file)
        except (OSError, KeyError, RuntimeError, ValueError):
            refuse_vtk(path, "its HDF5 is damaged")
        if elsewhere:
            refuse_vtk(path, f"the data of '{elsewhere}' lie in another file; save all in one")
    elif head[:3] == b"CDF" and head[3:4] in (b"\1", b"\2", b"\5"):
        missing = missing_bytes(path)
        if missing is None:
            refuse_vtk(path, "its netCDF header is damaged")
        if missing > 0:
            refuse_vtk(path, f"it is {missing} bytes shorter than its header says; it was cut off")
    else:
        refuse_vtk(path, f"it begins with {head!a}, not as netCDF does")


# --- netCDF classic -------------------------------------------------------------------------------------------------

_WIDTHS = {1: 1, 2: 1, 3: 2, 4: 4, 5: 4, 6: 8, 7: 1, 8: 2, 9: 4, 10: 8, 11: 8}  # bytes of a value, by its type


class _Header:
    """The header of a netCDF classic file, read from its beginning on.

    Attributes:
        at: offset of the next byte.
    """

    def __init__(self, data: mmap.mmap) -> None:
        self.data, self.at = data, 4
        self.version = data[3]

    def number(self, wide: bool) -> int:
        """The next unsigned integer, of 8 bytes if `wide`, else of 4."""
        (value,) = struct.unpack_from(">Q" if wide else ">I", self.data, self.at)
        self.at += 8 if wide else 4
        return int(value)

    def count(self) -> int:
        """The next number of elements."""
        return self.number(self.version == 5)

    def skip(self, size: int) -> None:
        """Pass over bytes that are padded to a multiple of four; struct.error beyond the end."""
        self.at += size + -size % 4
        if self.at > len(self.data):
            raise struct.error

    def entries(self) -> int:
        """The number of entries of the next list."""
        self.number(False)
        return self.count()

    def skip_attributes(self) -> None:
        """Pass over a list of attributes."""
        for _ in range(self.entries()):
            self.skip(self.count())
            kind = self.number(False)
            self.skip(_WIDTHS[kind] * self.count())


def missing_bytes(path: Path) -> int | None:
    """How many bytes a netCDF classic file is shorter than its header says, at most 0 if whole; None: no header."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        try:
            return _required_bytes(_Header(data)) - len(data)
        except (struct.error, KeyError, IndexError, OverflowError):
            return None


def _required_bytes(header: _Header) -> int:
    """Offset behind the last value; struct.error, KeyError or IndexError of a damaged header."""
    records = header.count()
    streaming = records == (2**64 - 1 if header.version == 5 else 2**32 - 1)
    lengths = []
    for _ in range(header.entries()):
        header.skip(header.count())
        lengths.append(header.count())
    header.skip_attributes()
    end, per_record = header.at, []  # offset and bytes of the variables that grow with the records
    for _ in range(header.entries()):
        header.skip(header.count())
        dimensions = [header.count() for _ in range(header.count())]
        header.skip_attributes()
        size = _WIDTHS[header.number(False)]
        header.count()  # vsize, which is not right for variables of 4 GiB and more
        begin = header.number(header.version != 1)
        shape = [lengths[i] for i in dimensions]
        for length in shape[1:] if shape and shape[0] == 0 else shape:
            size *= length
        if shape and lengths[dimensions[0]] == 0:  # the dimension of records
            per_record.append((begin, size))
        else:
            end = max(end, begin + size)
    step = per_record[0][1] if len(per_record) == 1 else sum(size + -size % 4 for _, size in per_record)
    if records and not streaming:
        end = max([end, *(begin + (records - 1) * step + size for begin, size in per_record)])
    return end
