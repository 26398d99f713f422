"""Frames of a run: where their data are, and their geometry as original boundary and crack faces.

The two parts have normals of their own, so that shading is not smooth across the edge between them.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

from ...errors import InputError
from ...meshes.plain_files import check_readable, find_external_data
from ...output.fields_file import read_field
from ...output.surface.vtk_files import PvdEntry, read_pvd, reorder_tensors

Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class FilmTiming:
    """Timing of films.

    Attributes:
        max_pictures_per_frame: largest mean number of pictures per frame. Frames at irregular times could need more.
        time_tolerance: relative error of times, as a share of the time between two pictures.
    """

    max_pictures_per_frame: int = 4
    time_tolerance: float = 1e-6


FILM_TIMING = FilmTiming()
# degrees between facets from which shading is not smooth
_SHARP_ANGLE = 35.0


@dataclass(frozen=True)
class FrameSource:
    """Files of a frame.

    Attributes:
        t: time, s.
        file: VTU file of the surface, or fields.h5.
        index: number of the frame in fields.h5; -1 for a VTU file.
        obstacle_files: VTU files of the obstacles.
        obstacle_names: names of the obstacles.
    """

    t: float
    file: Path
    index: int
    obstacle_files: tuple[Path, ...] = ()
    obstacle_names: tuple[str, ...] = ()

    @property
    def folder(self) -> Path:
        """Output folder of the run."""
        return self.file.parent if self.index >= 0 else self.file.parent.parent


def find_frames(folder: Path) -> list[FrameSource]:
    """Frames of surface.pvd, or else of fields.h5, in an output folder. Raises InputError if there are none."""
    check_readable(folder / "fields.h5")  # refused even where the surface is drawn
    return surface_frames(folder) or field_frames(folder)


def surface_frames(folder: Path) -> list[FrameSource]:
    """Frames of the body in surface.pvd, each with the obstacles at its time; none without the file."""
    pvd = folder / "surface.pvd"
    check_readable(pvd)
    entries = read_pvd(pvd) if pvd.exists() else []
    obstacles: dict[float, list[PvdEntry]] = {}
    for entry in entries:
        if entry.part:
            obstacles.setdefault(entry.t, []).append(entry)
    frames = []
    for body in (entry for entry in entries if not entry.part):
        parts = obstacles.get(body.t, [])
        files, names = tuple(folder / part.file for part in parts), tuple(part.name for part in parts)
        frames.append(FrameSource(body.t, folder / body.file, -1, files, names))
    return frames


def field_frames(folder: Path) -> list[FrameSource]:
    """Frames of fields.h5. Raises InputError if there are none."""
    h5 = folder / "fields.h5"
    check_readable(h5)
    if not h5.exists():
        raise InputError(f"{folder} has no surface.pvd and no fields.h5: it is not the output folder of a run")
    with _read_hdf5(h5) as file:
        if name := find_external_data(file):
            raise InputError(f"{h5} has the data of '{name}' in another file, which no run of fracsim does")
        times = [float(file["frames"][name].attrs["time"]) for name in sorted(file["frames"])]
    if not times:
        raise InputError(f"{h5} has no frame yet")
    return [FrameSource(t, h5, index) for index, t in enumerate(times)]


def _read_hdf5(path: Path) -> Any:
    """Open a file for reading without a lock, which would end a run that writes to it. Raises InputError."""
    try:
        return h5py.File(path, locking=False)
    except OSError as error:
        raise InputError(f"{path} cannot be read, or is being written: {error}; try again") from None


def film_interval(times: Sequence[float]) -> float:
    """Simulated time between two pictures of a film, s.

    The interval is the median of the times between frames. It is longer if the film would have many more pictures than
    there are frames.

    Args:
        times: times of the frames, s.
    """
    if len(times) < 2:
        return 1.0
    shortest = (times[-1] - times[0]) / (FILM_TIMING.max_pictures_per_frame * len(times))
    return max(float(np.median(np.diff(times))), shortest)


def film_repetitions(times: Sequence[float]) -> npt.NDArray[np.int64]:
    """Number (frames,) of pictures of a film that show each frame.

    Pictures are evenly spaced in simulated time and show the nearest frame.

    Args:
        times: times of the frames, s.
    """
    frame_times, interval = np.asarray(times, float), film_interval(times)
    tolerance = FILM_TIMING.time_tolerance
    count = math.ceil((frame_times[-1] - frame_times[0]) / interval - tolerance) + 1
    pictures = frame_times[0] + interval * np.arange(count)
    nearest = np.searchsorted((frame_times[1:] + frame_times[:-1]) / 2, pictures - tolerance * interval)
    return np.bincount(nearest, minlength=len(frame_times))


def load_grid(frame: FrameSource) -> Any:
    """Grid of pyvista with displaced points and all fields of a frame."""
    import pyvista

    for path in (frame.file, *frame.obstacle_files):
        check_readable(path)
    if frame.index < 0:
        grid = pyvista.read(frame.file)
        reorder_tensors(grid)
        if "age" in grid.cell_data and "origin" in grid.cell_data:
            # NaN gives the original boundary a colour of its own
            grid.cell_data["age"] = np.where(is_crack(grid), grid.cell_data["age"], np.nan)
        return grid
    with _read_hdf5(frame.file) as file:
        stored = file["frames"][sorted(file["frames"])[frame.index]]
        cells = file["cells"][()]
        types = {3: "TRIANGLE", 4: "TETRA", 6: "QUADRATIC_TRIANGLE", 10: "QUADRATIC_TETRA"}  # by nodes per cell
        cell_type = pyvista.CellType[types[cells.shape[1]]]
        grid = pyvista.UnstructuredGrid({cell_type: cells}, file["points"][()] + stored["displacement"][()])
        for name, data in stored.items():
            (grid.point_data if data.attrs["centre"] == "Node" else grid.cell_data)[name] = read_field(data)
    return grid


def read_study(folder: Path) -> dict[str, Any]:
    """Tables of study.toml in an output folder; empty if it cannot be read."""
    try:
        check_readable(folder / "study.toml")
        return tomllib.loads((folder / "study.toml").read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError):
        return {}


def plane_normals(study: dict[str, Any]) -> dict[str, Any]:
    """Normals (3,) of the obstacles that are planes, by name."""
    planes = [obstacle for obstacle in study.get("obstacle", []) if obstacle.get("shape") == "plane"]
    return {
        plane["name"]: np.array(plane["normal"], float) for plane in planes if "normal" in plane and "name" in plane
    }


# --- geometry ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FrameParts:
    """Parts of a frame to draw, as grids of pyvista.

    Attributes:
        boundary: surface that was the boundary; None if there is none.
        crack: crack faces; None if there are none.
        outline: lines around a body in 2D; None in 3D and for a mesh.
    """

    boundary: Any
    crack: Any
    outline: Any

    @property
    def surfaces(self) -> list[Any]:
        """Boundary and crack faces, as far as there are any."""
        return [part for part in (self.boundary, self.crack) if part is not None]


def frame_parts(grid: Any) -> FrameParts:
    """Parts of a split surface. Of a mesh the surface of the less damaged cells, which shows the crack open."""
    import pyvista

    if "origin" not in grid.cell_data:
        if "damage" in grid.cell_data:
            intact = np.flatnonzero(grid.cell_data["damage"] < 0.5)
            grid = grid.extract_cells(intact) if len(intact) else grid
        return FrameParts(grid.extract_surface(), None, None)
    is_line = np.asarray(grid.celltypes) == pyvista.CellType.LINE
    crack = is_crack(grid)
    if is_line.any():
        return FrameParts(_extract_triangles(grid, ~is_line), None, grid.extract_cells(np.flatnonzero(is_line)))
    return FrameParts(_extract_triangles(grid, ~crack), _extract_triangles(grid, crack), None)


def is_crack(grid: Any) -> Flags:
    """Mask (elements,) of the crack faces of a split surface."""
    names = list(grid.field_data["origins"]) if "origins" in grid.field_data else []
    return np.asarray(grid.cell_data["origin"]) == (names.index("crack") if "crack" in names else -1)


def _extract_triangles(grid: Any, mask: Flags) -> Any:
    """Surface of the triangles in `mask` (elements,), with their data; None if there are none."""
    import pyvista

    if not mask.any():
        return None
    corners = np.asarray(grid.cell_connectivity)
    # PyVista 0.45 and later; before that it is `offset`
    offsets = grid.cell_offsets if hasattr(grid, "cell_offsets") else grid.offset
    offset = np.asarray(offsets)[:-1][mask]
    used, renumbered = np.unique(corners[offset[:, None] + np.arange(3)], return_inverse=True)
    surface = pyvista.PolyData.from_regular_faces(np.asarray(grid.points)[used], renumbered.reshape(-1, 3))
    for name, data in grid.point_data.items():
        surface.point_data[name] = np.asarray(data)[used]
    for name, data in grid.cell_data.items():
        surface.cell_data[name] = np.asarray(data)[mask]
    return surface


def with_normals(surface: Any) -> Any:
    """Surface with a normal at each point. Points on sharp edges are split, so that the edges stay visible."""
    shaded = surface.compute_normals(
        cell_normals=False,
        split_vertices=True,
        feature_angle=_SHARP_ANGLE,
        consistent_normals=False,
        auto_orient_normals=False,
    )
    return shaded if shaded.n_points else surface


def without_single_nodes(grid: Any) -> Any:
    """Grid without the elements of single-node fragments."""
    if "dust" not in grid.cell_data or not np.any(grid.cell_data["dust"]):
        return grid
    remaining = grid.extract_cells(np.flatnonzero(np.asarray(grid.cell_data["dust"]) == 0))
    remaining.field_data["origins"] = list(grid.field_data["origins"])
    return remaining


def displace(grid: Any, explode: float, magnify: float) -> Any:
    """Grid with magnified displacements and separated fragments. Reference points are added as "rest", m.

    Args:
        grid: grid of pyvista.
        explode: displacement of the fragments away from the centre, as a share of their distance from it.
        magnify: factor of the displacements.
    """
    if "displacement" in grid.point_data:
        grid.point_data["rest"] = np.asarray(grid.points, float) - np.asarray(grid.point_data["displacement"])
    if magnify != 1.0 and "displacement" in grid.point_data:
        grid.points = np.asarray(grid.points, float) + (magnify - 1) * np.asarray(grid.point_data["displacement"])
    if explode and "piece" in grid.point_data:
        grid.points = explode_fragments(np.asarray(grid.points, float), grid.point_data["piece"], explode)
    return grid


def explode_fragments(points: Values, fragment: npt.NDArray[np.integer], share: float) -> Values:
    """Points (n, 3) with each fragment moved away from the centre of the body.

    Args:
        points: positions (n, 3), m.
        fragment: name (n,) of the fragment of each point.
        share: displacement as a share of the distance between the two centres.
    """
    names, of_point = np.unique(fragment, return_inverse=True)
    counts = np.bincount(of_point)[:, None]
    centres = np.stack([np.bincount(of_point, column) for column in points.T], axis=1) / counts
    body_centre = (points.min(axis=0) + points.max(axis=0)) / 2
    return np.asarray(points + share * (centres - body_centre)[of_point]) if len(names) > 1 else points
