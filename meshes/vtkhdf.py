"""Meshes in VTKHDF with each array in one piece of the file, so that any process reads any rows of it.

The group VTKHDF has an unstructured grid of the cells of the body, then the facets of groups, and for each of them the
number of its region or group (CellData/group; 0: none). The data set group_names has the names of numbers from 1 on.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .data import Indices, MeshError, Points
from .plain_files import HDF5_SIGNATURE, find_external_data, unreadable_reason
from .time_limit import read_with_time_limit
from .vtk_grid import ENDINGS, HDF

# types of VTK of the cells, and of their facets, by dimension
CELL_TYPES = {2: (5, 3), 3: (10, 5)}
NAMES = "group_names"
_COUNTS = ("NumberOfPoints", "NumberOfCells", "NumberOfConnectivityIds")
_ARRAYS = {"Points": "<f8", "Connectivity": "<i8", "Offsets": "<i8", "Types": "|u1"}


# --- writing --------------------------------------------------------------------------------------------------------


def write_vtkhdf(
    path: Path, points: Points, blocks: Sequence[Indices], tags: Sequence[Indices], names: list[str]
) -> None:
    """Write a mesh.

    Args:
        path: new file.
        points: (n, 3) [m].
        blocks: (k, d + 1) cells of the body, then (k, d) facets.
        tags: (k,) numbers of the groups of each block, from 1 on; 0: none.
        names: of the groups.
    """
    import h5py

    dim = blocks[0].shape[1] - 1
    types = [np.full(len(nodes), CELL_TYPES[dim][nodes.shape[1] == dim], np.uint8) for nodes in blocks]
    sizes = np.concatenate([np.full(len(nodes), nodes.shape[1], np.int64) for nodes in blocks])
    connectivity = np.concatenate([nodes.ravel() for nodes in blocks])
    with h5py.File(path, "w") as file:
        group = file.create_group("VTKHDF")
        group.attrs["Version"] = np.array([1, 0], np.int64)
        group.attrs.create("Type", np.bytes_("UnstructuredGrid"))
        for name, count in zip(_COUNTS, (len(points), len(sizes), len(connectivity)), strict=True):
            group[name] = np.array([count], np.int64)
        offsets = np.concatenate([np.zeros(1, np.int64), np.cumsum(sizes)])
        arrays: list[npt.NDArray[Any]] = [points, connectivity, offsets, np.concatenate(types)]
        for (name, kind), values in zip(_ARRAYS.items(), arrays, strict=True):
            group.create_dataset(name, data=values.astype(kind, copy=False))
        group.create_dataset("CellData/group", data=np.concatenate(tags).astype("<i4"))
        if names:
            file[NAMES] = np.array([name.encode() for name in names])


# --- names of groups ------------------------------------------------------------------------------------------------


def read_group_names(file: Any) -> dict[int, str]:
    """Names of the groups of an open h5py.File by their numbers; none in files of other programs."""
    names = file.get(NAMES)
    if names is None or names.ndim != 1 or names.dtype.kind != "S":
        return {}
    return {number: name.decode(errors="replace") for number, name in enumerate(names[()], start=1) if name}


# --- arrays in one piece --------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FileArray:
    """Rows of numbers that lie in a file in one piece.

    Attributes:
        path: the file.
        offset: of the first byte.
        dtype: type of NumPy.
        shape: rows and columns.
    """

    path: Path
    offset: int
    dtype: str
    shape: tuple[int, ...]

    def __len__(self) -> int:
        """Number of rows."""
        return self.shape[0]

    def read(self, first: int, last: int) -> npt.NDArray[Any]:
        """Rows `first` to `last`, exclusive. Raises OSError or ValueError if the file has been cut off."""
        width = int(np.prod(self.shape[1:], dtype=int))
        start = self.offset + first * width * np.dtype(self.dtype).itemsize
        values = np.fromfile(self.path, self.dtype, (last - first) * width, offset=start)
        return values.reshape(last - first, *self.shape[1:])


@dataclass(frozen=True)
class FileMesh:
    """A mesh in a file of which any rows can be read.

    Attributes:
        dim: 2 or 3.
        cell_count: number of cells of the body, which come first.
        points, connectivity, offsets, types: arrays of VTKHDF.
        tags: number of the group of each cell and facet; None: there is none.
        names: of the numbers of groups.
    """

    dim: int
    cell_count: int
    points: FileArray
    connectivity: FileArray
    offsets: FileArray
    types: FileArray
    tags: FileArray | None
    names: dict[int, str]

    @property
    def facet_count(self) -> int:
        """Number of facets in groups."""
        return len(self.types) - self.cell_count

    def read_rows(self, first: int, last: int, *, facets: bool = False) -> tuple[Indices, Indices] | None:
        """Nodes (k, d + 1) and tags (k,) of cells `first` to `last`, or (k, d) of facets; None if some are others.

        Raises OSError or ValueError if the file has been cut off.
        """
        width, before = self.dim + 1 - facets, self.cell_count if facets else 0
        start = before * (self.dim + 1)
        nodes = self.connectivity.read(start + first * width, start + last * width).reshape(-1, width)
        offsets = self.offsets.read(before + first, before + last + 1)
        types = self.types.read(before + first, before + last)
        right = np.array_equal(offsets, start + width * np.arange(first, last + 1))
        if not right or not np.all(types == CELL_TYPES[self.dim][facets]):
            return None
        tags = np.zeros(last - first) if self.tags is None else self.tags.read(before + first, before + last)
        return nodes, tags.astype(np.int64)


def find_file_mesh(path: Path) -> FileMesh | None:
    """Where the arrays of a mesh lie in a file as `write_vtkhdf` writes it; None of any other file."""
    if ENDINGS.get(path.suffix.lower()) != HDF or unreadable_reason(path):
        return None
    with path.open("rb") as file:
        if file.read(len(HDF5_SIGNATURE)) != HDF5_SIGNATURE:
            return None
    try:
        return read_with_time_limit(path, _file_mesh, "h5py")
    except MeshError:  # damaged: the reader of whole files says so
        return None


def _file_mesh(path: Path) -> FileMesh | None:
    """The mesh of `find_file_mesh`, found in this process."""
    import h5py

    with _other_files_pass(), h5py.File(path) as file:
        group, cell_data = file["VTKHDF"], file["VTKHDF"].get("CellData", {})
        allowed = {*_COUNTS, *_ARRAYS}
        if find_external_data(file) or group.attrs["Type"] != b"UnstructuredGrid" or set(cell_data) - {"group"}:
            return None
        if set(group) - {"CellData"} != allowed or {*file} - {"VTKHDF", NAMES}:
            return None
        point_count, row_count, node_count = (int(group[name][()].item()) for name in _COUNTS)
        size = path.stat().st_size
        arrays = {name: _file_array(path, size, group[name], kind) for name, kind in _ARRAYS.items()}
        tags = None if "group" not in cell_data else _file_array(path, size, cell_data["group"], "<i4")
        points, connectivity, offsets, types = arrays.values()
        first_type = int(group["Types"][0])
        dim = next((dim for dim, kinds in CELL_TYPES.items() if kinds[0] == first_type), 0)
        shapes = (point_count, 3), (node_count,), (row_count + 1,), (row_count,)
        if not dim or tuple(array.shape for array in arrays.values()) != shapes:
            return None
        if tags is not None and tags.shape != (row_count,):
            return None
        # m cells and k facets: m + k rows with (d + 1) m + d k nodes
        cells = node_count - dim * row_count
        names = read_group_names(file)
        if 0 < cells <= row_count:
            return FileMesh(dim, cells, points, connectivity, offsets, types, tags, names)
    return None


def _file_array(path: Path, size: int, data: Any, kind: str) -> FileArray:
    """Where a data set lies in a file of a size in bytes. Raises ValueError if it is not in one piece."""
    offset = data.id.get_offset()
    if data.chunks is not None or offset is None or data.dtype.str != kind or offset + data.nbytes > size:
        raise ValueError(data.name)
    return FileArray(path, offset, kind, data.shape)


@contextmanager
def _other_files_pass() -> Iterator[None]:
    """Context that ends quietly at whatever h5py and NumPy raise on a file of another form."""
    try:
        yield
    except (OSError, KeyError, ValueError, TypeError, AttributeError, RuntimeError, IndexError):
        return
