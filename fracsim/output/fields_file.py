"""fields.xdmf with fields.h5: the computational mesh in time, one grid a time with every field on it.

Written by rank 0 in the order of the input mesh, so that the files do not depend on the partition. One grid per time
(DOLFINx's own writer makes one per field) lets ParaView warp by displacement and colour by damage at once.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import InputError
from ..meshes.data import MeshData
from ..meshes.plain_files import data_elsewhere, replacing
from .atomic_write import ROOM, append, hdf5_file, hdf5_there, replace_text

Values = npt.NDArray[np.float64]
TENSOR = ("xx", "yy", "zz", "xy", "yz", "xz")  # of a symmetric tensor in VTK's order, as ParaView names it
EARLIER_TENSOR = ("xx", "xy", "xz", "yy", "yz", "zz")  # the order in files without the attribute COMPONENTS
COMPONENTS = "components"  # attribute of a symmetric tensor in fields.h5: the names of its columns
# XDMF's own Tensor6 has another order, by which ParaView's older reader fills 9 columns. A Matrix is read as it lies.
# It has one row: that reader takes the last dimension for the columns of the array in VTK 9.3, the last two in VTK 9.7.
_KINDS = {1: "Scalar", 3: "Vector", len(TENSOR): "Matrix"}
_CELLS = {3: "Triangle", 4: "Tetrahedron", 6: "Triangle_6", 10: "Tetrahedron_10"}  # by their nodes
_NAMES = np.bytes_(" ".join(TENSOR))
_TAIL = "    </Grid>\n  </Domain>\n</Xdmf>\n"
_HEAD = (
    '<?xml version="1.0"?>\n<Xdmf Version="3.0">\n  <Domain>\n'
    '    <Grid Name="fields" GridType="Collection" CollectionType="Temporal">\n'
)


@dataclass(frozen=True)
class Field:
    """One field of a frame: an array of rows in input order (None on ranks other than 0); `centre` is Node or Cell."""

    name: str
    centre: str
    values: Any


class FieldsFile:
    """Appends frames; the XML is closed after each, so that the file can be opened while the run goes on."""

    def __init__(self, folder: Path, mesh: MeshData, resume_at: float | None = None) -> None:
        """`resume_at`: keep the frames up to this time (s). InputError where they cannot be read."""
        self.xdmf, self.h5 = folder / "fields.xdmf", folder / "fields.h5"
        self._mesh = mesh
        self.times: list[float] = []
        grids = ""
        if resume_at is not None and self.h5.exists():
            grids = self._resume(resume_at)
        else:
            self._begin()
        replace_text(self.xdmf, _HEAD + grids + _TAIL)

    def _begin(self) -> None:
        size = 2 * self._mesh.points.nbytes + self._mesh.cells.nbytes + 3 * ROOM
        with replacing(self.h5) as new, hdf5_file(new, size, begin=True) as file:
            file["points"] = padded(self._mesh.points)
            file["cells"] = self._mesh.cells.astype(np.int32)
            file.create_group("frames")

    def _resume(self, until: float) -> str:
        """The XML of the frames that stay; where some go, a file without them takes the place of the old one."""
        times = read_times(self.h5)
        kept = [name for name, t in times.items() if t <= until * (1 + 1e-12)]
        with hdf5_there(self.h5) as file:
            earlier = any(_has_earlier_order(data) for name in kept for data in file["frames"][name].values())
        shared = self.h5.stat().st_nlink > 1  # a backup by hard links stays as it is
        if earlier or shared or len(kept) < len(times):
            self._keep(kept)
        with hdf5_there(self.h5) as file:
            return "".join(self._again(name, file["frames"][name]) for name in kept)

    def _keep(self, kept: list[str]) -> None:
        """A file of these frames alone takes the place of the file, with tensors in the order of TENSOR."""
        size = self.h5.stat().st_size
        with replacing(self.h5) as new, hdf5_there(self.h5) as old, hdf5_file(new, size, begin=True) as file:
            for name in ("points", "cells"):
                old.copy(name, file)
            frames = file.create_group("frames")
            for name in kept:
                old.copy(old["frames"][name], frames, name)
                for data in filter(_has_earlier_order, frames[name].values()):
                    data[...] = read_values(data)
                    data.attrs[COMPONENTS] = _NAMES

    def _again(self, name: str, frame: Any) -> str:
        fields = [Field(key, data.attrs["centre"], data[()]) for key, data in frame.items()]
        return self._grid(name, float(frame.attrs["time"]), fields)

    def write(self, t: float, fields: list[Field]) -> None:
        """Append the fields at time t (s). Vectors and symmetric tensors may have their 2D number of components.

        Raises OSError where there is no room, with the frames before it as they were.
        """
        fields = [Field(field.name, field.centre, padded(field.values)) for field in fields]
        name = f"{len(self.times):06d}"
        with hdf5_file(self.h5, ROOM + sum(field.values.nbytes + ROOM for field in fields)) as file:
            frame = file["frames"].create_group(name)
            frame.attrs["time"] = t
            for field in fields:
                data = frame.create_dataset(field.name, data=field.values)
                data.attrs["centre"] = field.centre
                if is_tensor(field.values):
                    data.attrs[COMPONENTS] = _NAMES
        append(self.xdmf, (self._grid(name, t, fields) + _TAIL).encode(), over=len(_TAIL))

    def _grid(self, name: str, t: float, fields: list[Field]) -> str:
        """The XML of one frame, which counts from now on."""
        self.times.append(t)
        attributes = "".join(self._attribute(name, field) for field in fields)
        kind = _CELLS[self._mesh.cells.shape[1]]
        return (
            f'      <Grid Name="body" GridType="Uniform">\n        <Time Value="{t:.12g}"/>\n'
            f'        <Topology TopologyType="{kind}" NumberOfElements="{len(self._mesh.cells)}">'
            f"{self._item('cells', self._mesh.cells.shape, 'Int')}</Topology>\n"
            f'        <Geometry GeometryType="XYZ">{self._item("points", (len(self._mesh.points), 3))}</Geometry>\n'
            f"{attributes}      </Grid>\n"
        )

    def _attribute(self, frame: str, field: Field) -> str:
        shape = field.values.shape
        kind = _KINDS[shape[1] if len(shape) > 1 else 1]
        number = "Int" if field.values.dtype.kind == "i" else "Float"
        if is_tensor(field.values):
            shape = (shape[0], 1, shape[1])
        item = self._item(f"frames/{frame}/{field.name}", shape, number, field.values.itemsize)
        head = f'<Attribute Name="{field.name}" AttributeType="{kind}" Center="{field.centre}">'
        return f"        {head}{item}</Attribute>\n"

    def _item(self, path: str, shape: tuple[int, ...], number: str = "Float", size: int = 0) -> str:
        precision = size or (4 if number == "Int" else 8)
        dimensions = " ".join(map(str, shape))
        return (
            f'<DataItem Dimensions="{dimensions}" NumberType="{number}" Precision="{precision}" Format="HDF">'
            f"{self.h5.name}:/{path}</DataItem>"
        )


def check_whole(h5: Path) -> None:
    """InputError where a fields.h5 that is to be appended to is a link, or has data in other files."""
    wrong = "is a link, not a file" if h5.is_symlink() else ""
    if not wrong:
        try:
            with hdf5_there(h5) as file:
                if name := data_elsewhere(file):
                    wrong = f"has the data of '{name}' in another file"
        except (OSError, RuntimeError):
            return  # read_times says what is wrong
    if wrong:
        raise InputError(f"--restart: {h5} {wrong}; move it away to go on without its frames")


def read_times(h5: Path) -> dict[str, float]:
    """Name -> time (s) of every frame of a fields.h5. InputError where it cannot be read."""
    try:
        with hdf5_there(h5) as file:
            return {name: float(file["frames"][name].attrs["time"]) for name in sorted(file["frames"])}
    except (OSError, KeyError, RuntimeError) as error:
        raise InputError(f"--restart: cannot read {h5} ({error}); move it away to go on without its frames") from None


def is_tensor(values: Any) -> bool:
    """Whether an array has the rows of a symmetric tensor."""
    return len(values.shape) == 2 and values.shape[1] == len(TENSOR)


def _has_earlier_order(data: Any) -> bool:
    return is_tensor(data) and COMPONENTS not in data.attrs


def read_values(data: Any) -> npt.NDArray[np.generic]:
    """The values of a data set of fields.h5, tensors in the order of TENSOR whichever version wrote them."""
    values: npt.NDArray[np.generic] = data[()]
    return from_earlier(values) if _has_earlier_order(data) else values


def from_earlier(values: npt.NDArray[np.generic]) -> npt.NDArray[np.generic]:
    """(n, 6) symmetric tensors in the order of EARLIER_TENSOR -> in that of TENSOR."""
    return values[:, [EARLIER_TENSOR.index(name) for name in TENSOR]]


def padded(values: npt.NDArray[np.generic]) -> npt.NDArray[np.generic]:
    """Vectors of 2 components with a third that is zero: what ParaView's filters take."""
    if values.ndim == 2 and values.shape[1] == 2:
        return np.pad(values, ((0, 0), (0, 1)))
    return values
