"""Files fields.xdmf and fields.h5: the computational mesh in time, with one XDMF grid per time and all fields on it.

All ranks compress them in the order of the input mesh (compressed_rows) and rank 0 writes them, so that the files do
not depend on the partition. With one grid per time (DOLFINx's writer makes one per field) ParaView can warp by
displacement and colour by damage at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import InputError
from ..meshes.plain_files import atomic_replacement, find_external_data
from .atomic_write import HDF5_OVERHEAD_BYTES, append_bytes, open_hdf5, replace_text, writable_hdf5
from .compressed_rows import COMPRESSION_LEVEL, ROWS_PER_CHUNK, CompressedField

Values = npt.NDArray[np.float64]
# symmetric tensor, in the order of VTK and ParaView
TENSOR_COMPONENTS = ("xx", "yy", "zz", "xy", "yz", "xz")
# order in files without COMPONENTS_ATTRIBUTE
EARLIER_TENSOR_COMPONENTS = ("xx", "xy", "xz", "yy", "yz", "zz")
# attribute of a symmetric tensor in fields.h5: names of its columns
COMPONENTS_ATTRIBUTE = "components"
# XDMF's own Tensor6 has another order, and ParaView's older reader expands it to 9 columns. A Matrix is read unchanged.
# It has one row: that reader takes the last dimension for the columns in VTK 9.3, the last two in VTK 9.7.
_ATTRIBUTE_TYPES = {1: "Scalar", 3: "Vector", len(TENSOR_COMPONENTS): "Matrix"}
# by nodes per cell
_TOPOLOGY_TYPES = {3: "Triangle", 4: "Tetrahedron", 6: "Triangle_6", 10: "Tetrahedron_10"}
_COMPONENT_NAMES = np.bytes_(" ".join(TENSOR_COMPONENTS))
_TAIL = "    </Grid>\n  </Domain>\n</Xdmf>\n"
_HEAD = (
    '<?xml version="1.0"?>\n<Xdmf Version="3.0">\n  <Domain>\n'
    '    <Grid Name="fields" GridType="Collection" CollectionType="Temporal">\n'
)


@dataclass(frozen=True)
class Field:
    """One field of a frame.

    Attributes:
        name: name of the field.
        centre: "Node" or "Cell".
        values: array with a row per owned node or cell; for BodySurface, of all in the order of the input mesh.
    """

    name: str
    centre: str
    values: Any


class FieldsFile:
    """Writer of fields.xdmf and fields.h5. The XML is complete after each frame and can be opened during the run.

    Attributes:
        xdmf, h5: the two files.
        times: times of the frames, s.
    """

    def __init__(
        self, folder: Path, points: CompressedField, cells: CompressedField, resume_at: float | None = None
    ) -> None:
        """Open the files.

        Args:
            folder: output folder.
            points: (n, 3) nodes of the input mesh, m.
            cells: (m, k) nodes of its cells.
            resume_at: keep the frames up to this time, s; None: a new run.

        Raises:
            InputError: the frames of the earlier run cannot be read.
            OSError: the files cannot be written.
        """
        self.xdmf, self.h5 = folder / "fields.xdmf", folder / "fields.h5"
        self._points_shape, self._cells_shape = points.shape, cells.shape
        self.times: list[float] = []
        grids = ""
        if resume_at is not None and self.h5.exists():
            grids = self._resume(resume_at)
        else:
            self._create(points, cells)
        replace_text(self.xdmf, _HEAD + grids + _TAIL)

    def _create(self, *mesh: CompressedField) -> None:
        """Create fields.h5 with the mesh and without frames."""
        size = HDF5_OVERHEAD_BYTES + sum(map(_stored_bytes, mesh))
        with atomic_replacement(self.h5) as temporary, writable_hdf5(temporary, size, new=True) as file:
            for field in mesh:
                _create_compressed(file, field)
            file.create_group("frames")

    def _resume(self, until: float) -> str:
        """XML of the frames up to the time `until` in s. If later frames exist, fields.h5 is replaced without them."""
        times = read_frame_times(self.h5)
        remaining = [name for name, t in times.items() if t <= until * (1 + 1e-12)]
        with open_hdf5(self.h5) as file:
            earlier = any(_has_earlier_order(data) for name in remaining for data in file["frames"][name].values())
        # a backup made with hard links shares the file, which must then not be changed in place
        shared = self.h5.stat().st_nlink > 1
        if earlier or shared or len(remaining) < len(times):
            self._rewrite(remaining)
        with open_hdf5(self.h5) as file:
            return "".join(self._stored_grid(name, file["frames"][name]) for name in remaining)

    def _rewrite(self, names: list[str]) -> None:
        """Replace fields.h5 by a file with these frames only, and with tensors in the order of `TENSOR_COMPONENTS`."""
        size = self.h5.stat().st_size
        with (
            atomic_replacement(self.h5) as temporary,
            open_hdf5(self.h5) as old,
            writable_hdf5(temporary, size, new=True) as file,
        ):
            for name in ("points", "cells"):
                old.copy(name, file)
            frames = file.create_group("frames")
            for name in names:
                old.copy(old["frames"][name], frames, name)
                for data in filter(_has_earlier_order, frames[name].values()):
                    data[...] = read_field(data)
                    data.attrs[COMPONENTS_ATTRIBUTE] = _COMPONENT_NAMES

    def _stored_grid(self, name: str, frame: Any) -> str:
        """XML of a frame that is in fields.h5."""
        fields = [CompressedField(key, data.attrs["centre"], data.shape, data.dtype) for key, data in frame.items()]
        return self._grid(name, float(frame.attrs["time"]), fields)

    def append_frame(self, t: float, fields: list[CompressedField]) -> None:
        """Append a frame.

        Args:
            t: time, s.
            fields: fields of the frame.

        Raises:
            OSError: the disk is full; the earlier frames are unchanged.
        """
        name = f"{len(self.times):06d}"
        size = HDF5_OVERHEAD_BYTES + sum(map(_stored_bytes, fields))
        with writable_hdf5(self.h5, size) as file:
            frame = file["frames"].create_group(name)
            frame.attrs["time"] = t
            for field in fields:
                data = _create_compressed(frame, field)
                data.attrs["centre"] = field.centre
                if is_tensor(field):
                    data.attrs[COMPONENTS_ATTRIBUTE] = _COMPONENT_NAMES
        append_bytes(self.xdmf, (self._grid(name, t, fields) + _TAIL).encode(), over=len(_TAIL))

    def _grid(self, name: str, t: float, fields: list[CompressedField]) -> str:
        """XML of one frame; its time is added to `times`."""
        self.times.append(t)
        attributes = "".join(self._attribute(name, field) for field in fields)
        nodes = self._data_item("points", self._points_shape)
        topology = _TOPOLOGY_TYPES[self._cells_shape[1]]
        return (
            f'      <Grid Name="body" GridType="Uniform">\n        <Time Value="{t:.12g}"/>\n'
            f'        <Topology TopologyType="{topology}" NumberOfElements="{self._cells_shape[0]}">'
            f"{self._data_item('cells', self._cells_shape, 'Int')}</Topology>\n"
            f'        <Geometry GeometryType="XYZ">{nodes}</Geometry>\n'
            f"{attributes}      </Grid>\n"
        )

    def _attribute(self, frame: str, field: CompressedField) -> str:
        """XML of one field."""
        shape = field.shape
        kind = _ATTRIBUTE_TYPES[shape[1] if len(shape) > 1 else 1]
        number = "Int" if field.dtype.kind == "i" else "Float"
        if is_tensor(field):
            shape = (shape[0], 1, shape[1])
        item = self._data_item(f"frames/{frame}/{field.name}", shape, number, field.dtype.itemsize)
        head = f'<Attribute Name="{field.name}" AttributeType="{kind}" Center="{field.centre}">'
        return f"        {head}{item}</Attribute>\n"

    def _data_item(self, path: str, shape: tuple[int, ...], number: str = "Float", size: int = 0) -> str:
        """XML that refers to a data set of fields.h5; `size`: bytes of a number, 0 for the default."""
        precision = size or (4 if number == "Int" else 8)
        dimensions = " ".join(map(str, shape))
        return (
            f'<DataItem Dimensions="{dimensions}" NumberType="{number}" Precision="{precision}" Format="HDF">'
            f"{self.h5.name}:/{path}</DataItem>"
        )


def check_self_contained(h5: Path) -> None:
    """Raise InputError if a fields.h5 to continue is a symbolic link or refers to data in other files."""
    problem = "is a link, not a file" if h5.is_symlink() else ""
    if not problem:
        try:
            with open_hdf5(h5) as file:
                if name := find_external_data(file):
                    problem = f"has the data of '{name}' in another file"
        except (OSError, RuntimeError):
            # read_frame_times reports an unreadable file
            return
    if problem:
        raise InputError(f"--restart: {h5} {problem}; move it away to go on without its frames")


def read_frame_times(h5: Path) -> dict[str, float]:
    """Time in s of each frame of a fields.h5, by the name of the frame. Raises InputError if it cannot be read."""
    try:
        with open_hdf5(h5) as file:
            return {name: float(file["frames"][name].attrs["time"]) for name in sorted(file["frames"])}
    except (OSError, KeyError, RuntimeError) as error:
        raise InputError(f"--restart: cannot read {h5} ({error}); move it away to go on without its frames") from None


def is_tensor(values: Any) -> bool:
    """True if an array or field has the shape (n, 6) of symmetric tensors."""
    return len(values.shape) == 2 and values.shape[1] == len(TENSOR_COMPONENTS)


def _has_earlier_order(data: Any) -> bool:
    """True for a tensor that an earlier version wrote, in the order of `EARLIER_TENSOR_COMPONENTS`."""
    return is_tensor(data) and COMPONENTS_ATTRIBUTE not in data.attrs


def read_field(data: Any) -> npt.NDArray[np.generic]:
    """Values of a data set of fields.h5, tensors in the order of `TENSOR_COMPONENTS` whichever version wrote them."""
    values: npt.NDArray[np.generic] = data[()]
    return reorder_earlier_tensor(values) if _has_earlier_order(data) else values


def reorder_earlier_tensor(values: npt.NDArray[np.generic]) -> npt.NDArray[np.generic]:
    """Symmetric tensors (n, 6) in the order of `EARLIER_TENSOR_COMPONENTS`, put in that of `TENSOR_COMPONENTS`."""
    return values[:, [EARLIER_TENSOR_COMPONENTS.index(name) for name in TENSOR_COMPONENTS]]


def rounded(values: npt.NDArray[np.generic], precision: str) -> npt.NDArray[np.generic]:
    """Values as they are written: real numbers in single precision, unless `precision` is "double"."""
    if precision == "double" or values.dtype != np.float64:
        return values
    # beyond 3e38, which no viewer draws, they are infinite
    with np.errstate(over="ignore"):
        return values.astype(np.float32)


def _create_compressed(group: Any, field: CompressedField) -> Any:
    """New data set of an HDF5 group."""
    data = group.create_dataset(field.name, field.shape, field.dtype, **_filters(field.shape))
    for number, chunk in enumerate(field.chunks):
        data.id.write_direct_chunk((number * data.chunks[0], *(0 for _ in field.shape[1:])), chunk)
    return data


def _filters(shape: tuple[int, ...]) -> dict[str, Any]:
    """Chunks and filters of a data set; those of `RowCompressor`."""
    chunks = (max(min(shape[0], ROWS_PER_CHUNK), 1), *shape[1:])
    return {"chunks": chunks, "shuffle": True, "compression": "gzip", "compression_opts": COMPRESSION_LEVEL}


def _stored_bytes(field: CompressedField) -> int:
    """Bytes that a field takes in the file."""
    # HDF5 needs 128 bytes to find a chunk.
    return HDF5_OVERHEAD_BYTES + sum(len(chunk) + 128 for chunk in field.chunks)


def pad_to_3d(values: npt.NDArray[np.generic]) -> npt.NDArray[np.generic]:
    """Vectors (n, 2) with a third component 0, which ParaView's filters need; other arrays unchanged."""
    if values.ndim == 2 and values.shape[1] == 2:
        return np.pad(values, ((0, 0), (0, 1)))
    return values
