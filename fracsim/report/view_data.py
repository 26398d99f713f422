"""Frames, fragments and history of a run as JSON for the page of `fracsim view`.

Arrays of integers are stored as differences, byte by byte, deflated and in base64. Positions are whole multiples of a
step. A frame holds what differs from the frame before it, so that frames can be added while a run goes on.
"""

from __future__ import annotations

import base64
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import InputError
from .compare import column_unit
from .pictures.colour_maps import COMPONENT_NAMES, HIDDEN, UNITS
from .pictures.frames import FrameSource, find_frames, frame_parts, load_grid, plane_normals, with_normals
from .pictures.picture_options import material_look
from .pictures.surroundings import OBSTACLE_COLOUR, PLANE_COLOUR, obstacle_surface
from .run_output import RunOutput

Ints = npt.NDArray[np.integer]
Values = npt.NDArray[np.float64]
# positions per diagonal of the first frame
_STEPS = 2**13
# values of a field beyond these percentages have the colours of the ends
_SHOWN_PERCENT = (0.5, 99.5)
# number of a value that is missing; others are 0 to 127 in the range of the frame
_MISSING = 128
_DIGITS = 6


@dataclass
class _Part:
    """Last state of a part that has been packed: its triangles or lines (k, 3 or 2), and positions (3, n) in steps."""

    elements: Ints
    positions: Ints


# source of a frame, and the time at which its file was written
type _Mark = tuple[FrameSource, int]


class PackedRun:
    """Frames of a run, which are packed once each.

    Attributes:
        generation: number of times that the frames had to be packed anew, because a run began again.
        frames: packed frames.
    """

    def __init__(self, folder: Path) -> None:
        """Raise InputError if the folder is not the output of a run."""
        self._folder, self.generation = folder, 0
        RunOutput(folder)
        self._clear()

    def _clear(self) -> None:
        self.frames: list[dict[str, Any]] = []
        self._marks: list[_Mark] = []
        self._parts: dict[str, _Part] = {}
        # file of each obstacle as of the last frame
        self._obstacles: dict[str, Path] = {}
        self._origin, self._step = np.zeros(3), 1.0

    def to_json(self, first: int = 0, *, running: bool = False) -> dict[str, Any]:
        """Data of the page with the frames from `first` on; `running`: the run goes on."""
        run = RunOutput(self._folder)
        self._pack_new_frames()
        look = material_look(run.study.get("output", {}).get("look", "plain"))
        history = {name: [_short(value) for value in column] for name, column in run.history.items()}
        return {
            "title": run.study.get("title", self._folder.name), "outcome": "running" if running else run.outcome,
            "generation": self.generation, "step": self._step, "origin": self._origin.tolist(), "first": first,
            "frames": [frame | {"pieces": table} for frame, table in
                       zip(self.frames[first:], self._fragments(run)[first:], strict=True)],
            "history": history, "units": UNITS | {name: column_unit(name) for name in history},
            "colours": {"skin": look.boundary_colour, "inside": look.crack_colour, "obstacle": OBSTACLE_COLOUR,
                        "plane": PLANE_COLOUR, "backdrop": look.backdrop},
            "planes": [*plane_normals(run.study)],
        }  # fmt: skip

    def _pack_new_frames(self) -> None:
        """Pack the frames that have been written since the last call."""
        try:
            sources = find_frames(self._folder)
        except InputError:
            if self._marks:
                raise
            return  # none is written yet
        marks = [_mark(source) for source in sources]
        if marks[: len(self._marks)] != self._marks:
            self._clear()
            self.generation += 1
        for source, mark in zip(sources[len(self._marks) :], marks[len(self._marks) :], strict=True):
            parts, obstacles = self._parts.copy(), self._obstacles.copy()
            try:
                self.frames.append(self._pack_frame(source))
            except BaseException:
                self._parts, self._obstacles = parts, obstacles
                raise
            self._marks.append(mark)

    def _pack_frame(self, source: FrameSource) -> dict[str, Any]:
        grid = load_grid(source)
        if not self._marks:
            box = np.asarray(grid.bounds).reshape(3, 2)
            self._origin, self._step = box.mean(axis=1), float(np.linalg.norm(np.diff(box))) / _STEPS or 1.0
        parts = frame_parts(grid)
        named = {"skin": parts.boundary, "inside": parts.crack, "outline": parts.outline}
        packed = {name: self._pack_part(name, part) for name, part in named.items() if part is not None}
        for name, file in zip(source.obstacle_names, source.obstacle_files, strict=True):
            key = f"obstacle {name}"
            packed[key] = {} if self._obstacles.get(name) == file else self._pack_part(key, obstacle_surface(file))
            self._obstacles[name] = file
        return {"t": source.t, "parts": packed}

    def _pack_part(self, name: str, part: Any) -> dict[str, Any]:
        """Packed part: its elements if they changed, its positions, and its fields."""
        if name != "outline":
            part = part.triangulate()
        elements = np.asarray(part.cell_connectivity if name == "outline" else part.regular_faces).reshape(
            -1, 2 if name == "outline" else 3
        )
        positions = np.rint((np.asarray(part.points, float) - self._origin) / self._step).astype(np.int32).T
        before, packed = self._parts.get(name), dict[str, Any]()
        if before is None or not np.array_equal(before.elements, elements):
            packed["topology"] = _pack_topology(name, part, elements)
            packed["points"] = _pack_integers(positions)
        else:
            packed["points"] = _pack_integers(positions - before.positions)
        self._parts[name] = _Part(elements, positions)
        if name in ("skin", "inside"):
            packed["fields"] = {field: _pack_field(values) for field, values in _fields(part, elements).items()}
        return packed

    def _fragments(self, run: RunOutput) -> list[dict[str, list[float | None]] | None]:
        """Number, mass in kg and speed in m/s of the fragments of each frame; None if the run has no table of them."""
        try:
            table = run.pieces
        except InputError:
            return [None] * len(self.frames)
        speed = np.linalg.norm([column for name, column in table.items() if name.startswith("velocity_")], axis=0)
        columns = {"piece": table["piece"], "mass": table["mass"], "speed": speed}
        times = np.array([float(f"{frame['t']:.12g}") for frame in self.frames])
        rows = [np.flatnonzero(table["time"] == t) for t in times]
        return [{name: [_short(value) for value in column[row]] for name, column in columns.items()} for row in rows]


def _mark(source: FrameSource) -> _Mark:
    """Mark of a frame, which differs if another run has written it. All frames of fields.h5 are in one file."""
    written = source.file.stat().st_mtime_ns if source.index < 0 else 0
    return source, written


def _pack_topology(name: str, part: Any, elements: Ints) -> dict[str, Any]:
    """Elements, and the fragment of each point. The skin is split at sharp edges; `split` has its points."""
    packed: dict[str, Any] = {}
    if "piece" in part.point_data:
        packed["piece"] = _pack_integers(np.asarray(part.point_data["piece"]))
    if name not in ("inside", "outline"):
        part = part.copy()
        part.clear_data()
        part.point_data["number"] = np.arange(part.n_points)
        shaded = with_normals(part)
        elements = np.asarray(shaded.regular_faces)
        packed["split"] = _pack_integers(np.asarray(shaded.point_data["number"]))
    return packed | {"elements": _pack_integers(elements)}


def _fields(part: Any, triangles: Ints) -> dict[str, Values]:
    """Scalars (n,) at the points, by field: magnitudes of vectors, components of tensors, means of cells."""
    fields = {}
    corners = triangles.reshape(-1)
    count = np.maximum(np.bincount(corners, minlength=part.n_points), 1)
    for data in (part.point_data, part.cell_data):
        for name, array in data.items():
            if name in (*HIDDEN, "piece", "region") or name.startswith("vtk"):
                continue
            for title, scalars in _scalars(name, np.asarray(array, float)):
                at_points = scalars
                if data is part.cell_data:
                    at_points = np.bincount(corners, np.repeat(scalars, 3), part.n_points) / count
                if np.isfinite(at_points).any():
                    fields[title] = at_points
    return fields


def _scalars(name: str, values: Values) -> list[tuple[str, Values]]:
    """Names and scalars (n,) that show an array (n,) or (n, components); none of an array of another shape."""
    if values.ndim == 1:
        return [(name, values)]
    components = COMPONENT_NAMES.get(values.shape[-1], ()) if values.ndim == 2 else ()
    if len(components) > 3:  # a tensor
        return [(f"{name}:{component}", values[:, column]) for column, component in enumerate(components)]
    return [(name, np.linalg.norm(values, axis=1))] if components else []


def _pack_field(values: Values) -> dict[str, Any]:
    """Values as 0 to 127 in a range that leaves out the extremes."""
    finite = np.isfinite(values)
    low, high = np.percentile(values[finite], _SHOWN_PERCENT)
    share = np.clip((values - low) / (high - low or 1.0), 0.0, 1.0)
    numbers = np.where(finite, np.rint(np.nan_to_num(share) * (_MISSING - 1)), _MISSING).astype(np.uint8)
    return {"range": [_short(low), _short(high)], "values": _encode(numbers.tobytes())}


def _pack_integers(values: Ints) -> str:
    """Differences of successive integers, their signs in the lowest bit, as four sequences of bytes."""
    flat = np.asarray(values, np.int32).reshape(-1)
    steps = np.diff(flat, prepend=np.int32(0))
    return _encode(((steps << 1) ^ (steps >> 31)).view(np.uint8).reshape(-1, 4).T.tobytes())


def _encode(data: bytes) -> str:
    return base64.b64encode(zlib.compress(data, 6)).decode()


def _short(value: float) -> float | None:
    """Value with six digits; None if it is not finite, for which JSON has no number."""
    return float(f"{value:.{_DIGITS}g}") if np.isfinite(value) else None
