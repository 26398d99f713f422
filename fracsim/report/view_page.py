"""Page with a run in 3D (`fracsim view`): one HTML file, or served on this machine while the run goes on.

Arrays of integers are stored as differences, byte by byte, deflated and in base64. Positions are whole multiples of a
step. A frame holds what differs from the frame before it, so that frames can be added while a run goes on.
"""

from __future__ import annotations

import base64
import json
import sys
import webbrowser
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from threading import Lock
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np
import numpy.typing as npt

from ..errors import InputError
from ..meshes.plain_files import atomic_replacement
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


HOST, PORT = "127.0.0.1", 8750
# bytes of a page that a browser takes seconds to open
LARGE_PAGE = 50_000_000
# trimesh brings three.js (MIT licence) in the template of its own viewer, in front of that viewer's code
_TEMPLATE, _BEGIN, _END = "resources/templates/viewer.zip", "<script>", "var camera,controls"


def write_view(folder: Path, target: Path) -> Path:
    """Write a run as one HTML file, which needs nothing else, and return its path.

    Raises:
        InputError: the folder is not the output of a run, or a package is missing.
    """
    if target.suffix != ".html":
        raise InputError(f"-o {target}: the page is an .html file: -o {folder.name}.html")
    page = page_text(json.dumps(PackedRun(folder).to_json()))
    with atomic_replacement(target) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return target


def page_text(data: str) -> str:
    """Page with the data of a run as JSON; "null" if it is to ask the server for them."""
    page = files(__package__).joinpath("view.html").read_text(encoding="utf-8")
    # "<" could end the element that holds the data, or begin a comment in it
    return page.replace("THREE_JS", _three_js()).replace("DATA_OF_THE_RUN", data.replace("<", "\\u003c"))


def _three_js() -> str:
    """Source of three.js. Raises InputError if trimesh is missing or has it no more."""
    try:
        with zipfile.ZipFile(str(files("trimesh").joinpath(_TEMPLATE))) as archive:
            text = archive.read(archive.namelist()[0]).decode()
        return text[text.index(_BEGIN) + len(_BEGIN) : text.index(_END)]
    except (ImportError, OSError, ValueError, zipfile.BadZipFile):
        raise InputError("view: this one needs three.js, which trimesh brings: pip install fracsim[files]") from None


class ViewServer(ThreadingHTTPServer):
    """Server of the page of one run, for this machine alone. It has the page and its data, and no file."""

    daemon_threads = True

    def __init__(self, folder: Path, is_running: Callable[[], bool], port: int = PORT) -> None:
        """Open a port: this one, or any if it is in use.

        Args:
            folder: output folder of the run.
            is_running: returns whether the run goes on.
            port: number of the port.

        Raises:
            InputError: the folder is not the output of a run, or a package is missing.
        """
        self._run, self._is_running, self._lock = PackedRun(folder), is_running, Lock()
        self.page = page_text("null").encode()
        try:
            super().__init__((HOST, port), _Handler)
        except OSError:
            super().__init__((HOST, 0), _Handler)

    @property
    def address(self) -> str:
        """Address of the page."""
        return f"http://{HOST}:{self.server_port}/"

    def data(self, first: int, generation: int) -> bytes:
        """Data from frame `first` on, of the frames of a generation; all data if the run began again since."""
        running = self._is_running()
        with self._lock:
            data = self._run.to_json(first, running=running)
            if data["generation"] != generation:
                data = self._run.to_json(running=running)
        return json.dumps(data).encode()


class _Handler(BaseHTTPRequestHandler):
    """Answers to a browser on this machine."""

    server: ViewServer

    def do_GET(self) -> None:
        """Answer with the page or its data."""
        path, query = urlsplit(self.path).path, parse_qs(urlsplit(self.path).query)
        # another host name would be a page of the network that was led here
        if self.headers.get("Host", "").partition(":")[0] not in (HOST, "localhost"):
            self.send_error(403)
        elif path == "/":
            self._answer("text/html; charset=utf-8", self.server.page)
        elif path == "/data.json":
            numbers = [query.get(name, ["0"])[0] for name in ("first", "generation")]
            if not all(number.isdecimal() for number in numbers):
                self.send_error(400)
                return
            try:
                self._answer("application/json", self.server.data(*map(int, numbers)))
            except (InputError, OSError, KeyError) as error:  # a frame may be half written
                self.send_error(503, explain=str(error))
        else:
            self.send_error(404)

    def _answer(self, kind: str, body: bytes) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        """Print nothing."""


def serve_view(folder: Path, is_running: Callable[[], bool]) -> None:
    """Serve the page until the user interrupts it, and open it in the browser; see `ViewServer`."""
    with ViewServer(folder, is_running) as server:
        try:
            print(f"{folder} is shown at {server.address} until you press Ctrl-C", flush=True)
            webbrowser.open(server.address)
            server.serve_forever()
        except KeyboardInterrupt:
            print(file=sys.stderr)
