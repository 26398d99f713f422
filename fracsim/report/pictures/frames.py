"""The frames of a run: where their data are, and what its study says of how they look."""

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
from ...meshes.plain_files import check_readable, data_elsewhere
from ...output.fields_file import read_field
from ...output.surface.vtk_files import PvdEntry, read_pvd, reorder_tensors
from .frame_geometry import is_crack

KINDS = {3: "TRIANGLE", 4: "TETRA", 6: "QUADRATIC_TRIANGLE", 10: "QUADRATIC_TETRA"}  # of cells, by their nodes


LONGER = 4  # pictures of a film, at most, to a frame
CLOSE = 1e-6  # of the time between two pictures: by so much they may be off


@dataclass(frozen=True)
class FrameSource:
    """A frame to draw: where its data are."""

    t: float
    file: Path
    index: int  # of the frame in fields.h5, -1: a VTU of the surface
    obstacle_files: tuple[Path, ...] = ()  # VTUs of the obstacles
    obstacle_names: tuple[str, ...] = ()  # of the obstacles

    @property
    def folder(self) -> Path:
        """Of the run."""
        return self.file.parent if self.index >= 0 else self.file.parent.parent


def find_frames(folder: Path) -> list[FrameSource]:
    """Frames of surface.pvd, or else of fields.h5. InputError where there are none."""
    pvd, h5 = folder / "surface.pvd", folder / "fields.h5"
    check_readable(pvd)
    check_readable(h5)
    if pvd.exists():
        shots = _of_surface(folder, read_pvd(pvd))
        if shots:
            return shots
    if not h5.exists():
        raise InputError(f"{folder} has no surface.pvd and no fields.h5: it is not the output folder of a run")
    with h5py.File(h5) as file:
        if name := data_elsewhere(file):
            raise InputError(f"{h5} has the data of '{name}' in another file, which no run of fracsim does")
        times = [float(file["frames"][name].attrs["time"]) for name in sorted(file["frames"])]
    if not times:
        raise InputError(f"{h5} has no frame yet")
    return [FrameSource(t, h5, index) for index, t in enumerate(times)]


def film_interval(times: Sequence[float]) -> float:
    """Simulated time between two pictures of a film of frames at these times, s: the median of what lies between them,
    or more where a film would have many more pictures than there are frames."""
    if len(times) < 2:
        return 1.0
    return max(float(np.median(np.diff(times))), (times[-1] - times[0]) / (LONGER * len(times)))


def film_repetitions(times: Sequence[float]) -> npt.NDArray[np.int64]:
    """(frames,) how many pictures of a film show each frame: pictures are evenly spaced in simulated time, and show the
    frame that is nearest."""
    at, interval = np.asarray(times, float), film_interval(times)
    pictures = at[0] + interval * np.arange(math.ceil((at[-1] - at[0]) / interval - CLOSE) + 1)
    return np.bincount(np.searchsorted((at[1:] + at[:-1]) / 2, pictures - CLOSE * interval), minlength=len(at))


def _of_surface(folder: Path, entries: list[PvdEntry]) -> list[FrameSource]:
    beside: dict[float, list[PvdEntry]] = {}
    for entry in entries:
        if entry.part:
            beside.setdefault(entry.t, []).append(entry)
    bodies = [entry for entry in entries if not entry.part]
    shots = []
    for each in bodies:
        others = beside.get(each.t, [])
        files, names = tuple(folder / other.file for other in others), tuple(other.name for other in others)
        shots.append(FrameSource(each.t, folder / each.file, -1, files, names))
    return shots


def load_grid(shot: FrameSource) -> Any:
    """The frame as a grid of displaced points with its fields."""
    import pyvista

    for path in (shot.file, *shot.obstacle_files):
        check_readable(path)
    if shot.index < 0:
        grid = pyvista.read(shot.file)
        reorder_tensors(grid)
        if "age" in grid.cell_data and "origin" in grid.cell_data:
            # in a picture what is no crack has a colour of its own
            grid.cell_data["age"] = np.where(is_crack(grid), grid.cell_data["age"], np.nan)
        return grid
    with h5py.File(shot.file) as file:
        frame = file["frames"][sorted(file["frames"])[shot.index]]
        cells = file["cells"][()]
        kind = pyvista.CellType[KINDS[cells.shape[1]]]
        grid = pyvista.UnstructuredGrid({kind: cells}, file["points"][()] + frame["displacement"][()])
        for name, data in frame.items():
            (grid.point_data if data.attrs["centre"] == "Node" else grid.cell_data)[name] = read_field(data)
    return grid


def read_study(folder: Path) -> dict[str, Any]:
    """What study.toml says, as it stands there; nothing where there is none."""
    try:
        check_readable(folder / "study.toml")
        return tomllib.loads((folder / "study.toml").read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError):
        return {}


def plane_normals(study: dict[str, Any]) -> dict[str, Any]:
    """Names of obstacles that are planes -> their normals."""
    found = [each for each in study.get("obstacle", []) if each.get("shape") == "plane"]
    return {each["name"]: np.array(each["normal"], float) for each in found if "normal" in each and "name" in each}
