"""Files of the split surface: surface.pvd, one VTU file per frame in surface/, and pieces.csv.

ParaView can open them after every frame. In surface.pvd part 0 of a time is the body, and the others are obstacles.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ...errors import InputError
from ...mesh.split_surface.surface_numbering import number_whole_surface
from ...meshes.plain_files import atomic_replacement, check_readable, create
from ..atomic_write import append_bytes, replace_text
from ..fields_file import EARLIER_TENSOR_COMPONENTS, TENSOR_COMPONENTS, reorder_earlier_tensor, rounded
from ..file_ownership import FRAME_FILE_PATTERN
from .vtu_file import CompressedGrid, GridCompressor

if TYPE_CHECKING:
    from ...mechanics.term_protocols import SurfaceData
    from .body_surface import SurfaceFrame
    from .fragment_table import FragmentTable

Ints = npt.NDArray[np.integer]
Values = npt.NDArray[np.float64]

BODY_NAME = "body"
# folder of the VTU files in the output folder
SURFACE_FOLDER = "surface/"
_PVD_HEAD = '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n  <Collection>\n'
_PVD_TAIL = "  </Collection>\n</VTKFile>\n"
_PVD_ENTRY = re.compile(r'timestep="([^"]+)"(?: part="(\d+)" name="([^"]+)")? file="([^"]+)"')
# more than the XML before the data takes
_VTU_HEAD_BYTES = 1 << 16


class SurfaceFiles:
    """Writer of surface.pvd and pieces.csv.

    Attributes:
        times: times of the frames, s.
        frame_counts: number of frames in each file.
    """

    def __init__(
        self,
        folder: Path,
        dim: int,
        resume_at: float | None = None,
        *,
        turning: bool = False,
        precision: str = "single",
    ) -> None:
        """Open the files.

        Args:
            folder: output folder.
            dim: dimension of the body.
            resume_at: keep the frames up to this time, s; None: a new run.
            turning: write the rotation of rigid fragments.
            precision: of points and fields, "single" or "double".

        Raises:
            OSError: the files cannot be written.
        """
        self._folder, self._pvd, self._csv = folder, folder / "surface.pvd", folder / "pieces.csv"
        self._columns, self._precision = fragment_columns(dim, turning=turning), precision
        self._entries = self._earlier_entries(resume_at) if resume_at is not None and self._pvd.exists() else []
        # obstacle -> its last data, their file
        self._last_obstacles: dict[str, tuple[SurfaceData, str]] = {}
        rows = self._earlier_rows() if self._entries else []
        (folder / "surface").mkdir(parents=True, exist_ok=True)
        listed = {entry.file for entry in self._entries}
        for entry in self._entries:
            update_tensor_order(folder / entry.file)
        self._write_pvd()
        replace_text(self._csv, _csv_text([self._columns, *rows]))
        self._csv_frames = len({row[0] for row in rows})
        for path in (folder / "surface").glob("*.vtu"):
            if FRAME_FILE_PATTERN.fullmatch(path.name) and f"surface/{path.name}" not in listed:
                path.unlink()

    @property
    def times(self) -> list[float]:
        """Times of the frames, s."""
        return [entry.t for entry in self._entries if not entry.part]

    @property
    def frame_counts(self) -> dict[str, int]:
        """Number of frames in each file."""
        return {self._pvd.name: len(self.times), self._csv.name: self._csv_frames}

    def write_frame(
        self,
        frame: SurfaceFrame,
        obstacles: dict[str, SurfaceData] | None = None,
        grid: CompressedGrid | None = None,
    ) -> Path:
        """Write a frame and return the path of its VTU file.

        Args:
            frame: surface of the body.
            obstacles: data of the obstacles by name.
            grid: the frame, compressed by all ranks that have parts of it; None: this rank has the whole surface.

        Raises:
            OSError: the files cannot be written.
        """
        # VTU files come before the files that refer to them
        number = len(self.times)
        body = PvdEntry(frame.t, f"surface/surface_{number:06d}.vtu")
        grid = frame.compress(self._precision) if grid is None else grid
        assert grid is not None
        grid.write(self._folder / body.file)
        drawn = [(name, self._write_obstacle(name, data, number)) for name, data in (obstacles or {}).items()]
        append_bytes(self._csv, _csv_text(_csv_rows(frame.t, frame.fragments)).encode())
        self._csv_frames += 1
        self._entries += [body, *(PvdEntry(frame.t, file, part, name) for part, (name, file) in enumerate(drawn, 1))]
        self._write_pvd()
        return self._folder / body.file

    def _write_obstacle(self, name: str, data: SurfaceData, number: int) -> str:
        """File of an obstacle; the previous file if the obstacle has not moved."""
        previous, file = self._last_obstacles.get(name, (None, ""))
        if previous is None or not np.array_equal(previous.points, data.points):
            file = f"surface/obstacle_{name}_{number:06d}.vtu"
            counts = len(data.points), len(data.triangles), len(data.segments)
            compressor = GridCompressor(number_whole_surface(*counts), data.triangles, data.segments)
            grid = compressor(rounded(data.points, self._precision), {}, {})
            assert grid is not None
            grid.write(self._folder / file)
            self._last_obstacles[name] = data, file
        return file

    def _write_pvd(self) -> None:
        replace_text(self._pvd, pvd_text(self._entries))

    def _earlier_entries(self, until: float) -> list[PvdEntry]:
        """Entries of surface.pvd up to the time `until` in s whose files exist."""
        entries = read_pvd(self._pvd)
        return [entry for entry in entries if entry.t <= until * (1 + 1e-9) and (self._folder / entry.file).exists()]

    def _earlier_rows(self) -> list[list[str]]:
        """Complete rows of pieces.csv that belong to the earlier frames."""
        times = {f"{t:.12g}" for t in self.times}
        if not self._csv.exists():
            return []
        with self._csv.open(newline="", encoding="utf-8") as file:
            rows = list(csv.reader(file))[1:]
        return [row for row in rows if len(row) == len(self._columns) and row[0] in times]


# --- pieces.csv -------------------------------------------------------------------------------------------------------


def _csv_text(rows: list[list[str]]) -> str:
    text = io.StringIO()
    csv.writer(text).writerows(rows)
    return text.getvalue()


def fragment_columns(dim: int, *, turning: bool = False) -> list[str]:
    """Columns of pieces.csv.

    Args:
        dim: dimension of the body.
        turning: with the rotation of rigid fragments.
    """
    axes = "xyz"[:dim]
    vectors = [f"{quantity}_{axis}" for quantity in ("centre", "velocity") for axis in axes]
    spin = [f"spin_{axis}" for axis in ("xyz" if dim == 3 else "z")]
    turn = [*(f"turn_{axis}" for axis in "xyz"), *(f"quaternion_{part}" for part in "wxyz")] if turning else []
    return ["time", "piece", "nodes", "mass", "volume", *vectors, *spin, *turn, "dust"]


def fragment_values(fragments: FragmentTable) -> dict[str, Values]:
    """Columns of pieces.csv but the time, by name, in the order of the names of the fragments."""
    rotation = [] if fragments.rotation is None else [fragments.rotation, rotation_quaternions(fragments.rotation)]
    values = np.column_stack([
        fragments.name, fragments.nodes, fragments.mass, fragments.volume, fragments.centre, fragments.velocity,
        fragments.spin, *rotation, fragments.nodes == 1,
    ])[np.argsort(fragments.name)]  # fmt: skip
    columns = fragment_columns(fragments.centre.shape[1], turning=bool(rotation))
    return dict(zip(columns[1:], values.T, strict=True))


def _csv_rows(t: float, fragments: FragmentTable) -> list[list[str]]:
    """Rows of pieces.csv at time t in s, in the order of the names of the fragments."""
    # numbers below 1e12 are whole in 12 digits
    return [
        [f"{t:.12g}", *(f"{value:.12g}" for value in row)]
        for row in zip(*fragment_values(fragments).values(), strict=True)
    ]


def rotation_quaternions(rotation: Values) -> Values:
    """Unit quaternions (p, 4) w, x, y, z with w >= 0 of rotation vectors (p, 3) in rad: (cos a/2, sin(a/2) n)."""
    half_angle = np.linalg.norm(rotation, axis=1, keepdims=True) / 2
    vector = rotation / 2 * np.sinc(half_angle / np.pi)
    quaternion = np.concatenate([np.cos(half_angle), vector], axis=1)
    return np.asarray(np.where(quaternion[:, :1] < 0, -quaternion, quaternion))


# --- surface.pvd ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PvdEntry:
    """VTU file in surface.pvd.

    Attributes:
        t: time, s.
        file: path relative to the output folder.
        part: 0 for the body, others for obstacles.
        name: name of the part.
    """

    t: float
    file: str
    part: int = 0
    name: str = BODY_NAME


def pvd_text(entries: Iterable[PvdEntry]) -> str:
    """Text of surface.pvd. With obstacles the parts of a time become named blocks of one data set."""
    entries = list(entries)
    has_blocks = any(entry.part for entry in entries)
    return _PVD_HEAD + "".join(_pvd_line(entry, has_blocks) for entry in entries) + _PVD_TAIL


def _pvd_line(entry: PvdEntry, has_blocks: bool) -> str:
    part = f'part="{entry.part}" name="{entry.name}" ' if has_blocks else ""
    return f'    <DataSet timestep="{entry.t:.12g}" {part}file="{entry.file}"/>\n'


def read_pvd(pvd: Path) -> list[PvdEntry]:
    """Entries of a surface.pvd. Raises InputError if it refers to a file that no run writes."""
    check_readable(pvd)
    matches = _PVD_ENTRY.findall(pvd.read_text(encoding="utf-8"))
    for *_, file in matches:
        # VTK chooses its reader by the suffix, and would read any file
        if not (file.startswith(SURFACE_FOLDER) and FRAME_FILE_PATTERN.fullmatch(file.removeprefix(SURFACE_FOLDER))):
            raise InputError(f"{pvd} names the file {file}, which no run of fracsim writes")
    return [PvdEntry(float(t), file, int(part or 0), name or BODY_NAME) for t, part, name, file in matches]


def read_body_frames(pvd: Path) -> list[tuple[float, str]]:
    """Pairs (time in s, file relative to the output folder) of all frames of the body."""
    return [(entry.t, entry.file) for entry in read_pvd(pvd) if not entry.part]


# --- VTU files of earlier versions ------------------------------------------------------------------------------------


def write_vtu(path: Path, grid: Any) -> None:
    """Write an unstructured grid of VTK as a VTU file. Raises OSError."""
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter

    writer = vtkXMLUnstructuredGridWriter()
    # through memory: on a full disk VTK prints a message of its own and gives no reason
    writer.WriteToOutputStringOn()
    writer.SetInputData(grid)
    writer.SetDataModeToAppended()
    # raw data take a third of the time of base64
    writer.EncodeAppendedDataOff()
    if not writer.Write():
        raise OSError("VTK cannot write it")
    # bytes if the output is not valid text
    data = writer.GetOutputString()
    with create(path) as file:
        file.write(data if isinstance(data, bytes) else data.encode())


def reorder_tensors(grid: Any) -> bool:
    """Reorder tensors of an earlier version to `TENSOR_COMPONENTS`; returns True if there were any.

    Their component names give the order in which an earlier version wrote them.
    """
    from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy

    changed = False
    for data in (grid.GetPointData(), grid.GetCellData()):
        arrays = [data.GetArray(number) for number in range(data.GetNumberOfArrays())]
        for array in arrays:
            names = tuple(array.GetComponentName(number) for number in range(array.GetNumberOfComponents()))
            if names == EARLIER_TENSOR_COMPONENTS:
                reordered = numpy_to_vtk(reorder_earlier_tensor(vtk_to_numpy(array)), deep=True)
                reordered.SetName(array.GetName())
                for column, axes in enumerate(TENSOR_COMPONENTS):
                    reordered.SetComponentName(column, axes.upper())
                # replaces the array of that name
                data.AddArray(reordered)
                changed = True
    return changed


def update_tensor_order(path: Path) -> None:
    """Rewrite a VTU file of an earlier version with tensors in the order of `TENSOR_COMPONENTS`. Raises OSError."""
    with path.open("rb") as file:
        if f'ComponentName1="{EARLIER_TENSOR_COMPONENTS[1]}"'.encode() not in file.read(_VTU_HEAD_BYTES):
            return
    from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridReader

    reader = vtkXMLUnstructuredGridReader()
    reader.SetFileName(str(path))
    reader.Update()
    if reorder_tensors(reader.GetOutput()):
        with atomic_replacement(path) as temporary:
            write_vtu(temporary, reader.GetOutput())
