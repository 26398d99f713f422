"""Pictures, sheets and films of runs, drawn off-screen: the split surface if there is one, otherwise the mesh."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from ctypes import CDLL, CFUNCTYPE, byref, c_char_p, c_int, c_uint, c_void_p
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ...errors import InputError
from ...meshes.plain_files import atomic_replacement_of_all, check_replaceable
from .camera import ViewBounds, body_motion, centred, merge_bounds, moved, view_bounds
from .colour_maps import merge_ranges
from .frames import FrameSource, film_interval, film_repetitions, find_frames
from .picture_options import PictureOptions
from .renderer import Renderer, field_range

Pixels = npt.NDArray[np.uint8]
FILM_SUFFIXES = (".gif", ".mp4")
# size of a picture on a sheet, as a share of a single picture
_SHEET_SCALE = 0.5
# pixels between the pictures of a sheet
SHEET_GAP = 8
# least and largest number of pictures per second of a film
_RATE_LIMITS = 1, 120


@dataclass(frozen=True)
class FilmOptions:
    """Frames and timing of a film.

    Attributes:
        fps: pictures per second.
        frames: "" for all frames, or "FIRST:END" as a slice of Python, such as "0:30".
        speed: simulated seconds per second of the film, in place of `fps`; 0: not given.
    """

    fps: int = 12
    frames: str = ""
    speed: float = 0.0

    def select(self, frames: list[FrameSource]) -> list[FrameSource]:
        """Frames of the film. Raises InputError if there are none."""
        try:
            first, end = (int(part) if part else None for part in (self.frames or ":").split(":"))
        except ValueError:
            raise InputError(
                f"--frames {self.frames}: must be the first frame and the one after the last: 0:30"
            ) from None
        if not (selected := frames[first:end]):
            raise InputError(f"--frames {self.frames}: the run has {len(frames)} frames, counted from 0, none of these")
        return selected

    def rate(self, times: Sequence[float]) -> float:
        """Pictures per second of a film of frames at these times, s. Raises InputError if a film has no such rate."""
        if not self.speed:
            return self.fps
        interval = film_interval(times)
        low, high = (fps * interval for fps in _RATE_LIMITS)
        if not low <= self.speed <= high:
            raise InputError(
                f"--speed {self.speed:g}: must be {low:.3g} to {high:.3g} here, as frames are {interval:.3g} s "
                f"apart and a film has {_RATE_LIMITS[0]} to {_RATE_LIMITS[1]} pictures a second"
            )
        return self.speed / interval


@contextmanager
def virtual_display() -> Iterator[None]:
    """Display for VTK: the present one, an Xvfb server that ends with the context, or EGL, which needs none.

    Raises:
        InputError: there is none of them, for VTK would end the process.
    """
    if os.environ.get("DISPLAY"):
        yield
        return
    xvfb = shutil.which("Xvfb")
    if xvfb is None:
        if not has_egl():
            raise InputError(
                "pictures need a display, Xvfb, or EGL: install one of them, on Debian and Ubuntu by apt-get install "
                "libegl1, or set output.picture = false"
            )
        os.environ.setdefault("VTK_DEFAULT_OPENGL_WINDOW", "vtkEGLRenderWindow")
        yield
        return
    read, write = os.pipe()
    command = [xvfb, "-displayfd", str(write), "-screen", "0", "1600x1200x24", "-nolisten", "tcp"]
    quiet = subprocess.DEVNULL
    # in "/": Xvfb looks for keyboard files in its working folder
    server = subprocess.Popen(command, pass_fds=[write], stdout=quiet, stderr=quiet, cwd="/")
    os.close(write)
    try:
        with os.fdopen(read) as pipe:
            os.environ["DISPLAY"] = f":{pipe.readline().strip()}"
        yield
    finally:
        os.environ.pop("DISPLAY", None)
        server.terminate()
        server.wait()


def has_egl() -> bool:
    """Return whether EGL has a device that draws without a display, as VTK asks for."""
    try:
        egl = CDLL("libEGL.so.1")
    except OSError:
        return False
    egl.eglGetProcAddress.restype, egl.eglGetProcAddress.argtypes = c_void_p, [c_char_p]
    address = egl.eglGetProcAddress(b"eglQueryDevicesEXT")
    count = c_int()
    return bool(
        address and CFUNCTYPE(c_uint, c_int, c_void_p, c_void_p)(address)(0, None, byref(count)) and count.value
    )


def render(
    folder: Path | Sequence[Path],
    target: Path | None = None,
    options: PictureOptions | None = None,
    *,
    frame: int = -1,
    sheet: str = "",
    film: FilmOptions | None = None,
) -> Path:
    """Draw frames of a run and return the path of what was written.

    Pictures of a film are evenly spaced in simulated time; those in a folder are the frames.

    Args:
        folder: output folder. Several folders: that frame of each, side by side.
        target: a .png for one picture or a sheet, a .gif or .mp4 for a film, a name without suffix for a folder of
            pictures; None: last.png in the (first) output folder.
        options: options of the pictures.
        frame: number of the frame, -1 for the last.
        sheet: number of frames on a sheet, or which, as in "0,18,-1".
        film: frames and timing of a film.

    Raises:
        InputError: there is no such frame, or the options do not fit.
    """
    folders = [folder] if isinstance(folder, Path) else list(folder)
    target, options = target or folders[0] / "last.png", options or PictureOptions()
    options.view_direction()
    if target.suffix not in ("", ".png", *FILM_SUFFIXES):
        raise InputError(f"-o {target}: pictures are .png, films .gif or .mp4, and a name without a suffix is a folder")
    if target.suffix:
        # before anything is drawn
        check_replaceable(target)
    run_frames = [find_frames(run) for run in folders]
    is_picture, film = target.suffix == ".png", film or FilmOptions()
    if is_picture and film.frames:
        raise InputError(f"--frames {film.frames}: of a film or a folder of pictures; a picture has --frame or --sheet")
    if film.speed and target.suffix not in FILM_SUFFIXES:
        raise InputError(f"--speed {film.speed:g}: of a film; give its file, .mp4 or .gif, with -o")
    if is_picture:
        frames = select_frames(run_frames, folders, frame, sheet)
    elif sheet or len(folders) > 1:
        raise InputError(f"-o {target}: a sheet, or pictures of several runs, is a .png")
    else:
        frames = film.select(run_frames[0])
    is_film = target.suffix in FILM_SUFFIXES
    times = [source.t for source in frames]
    repetitions = film_repetitions(times) if is_film else np.ones(len(frames), int)
    rate = film.rate(times)
    frames = [source for source, count in zip(frames, repetitions, strict=True) if count]
    repetitions = repetitions[repetitions > 0]
    if len(frames) > 1:
        options = replace(options, fine=options.fine and is_picture)
    if is_picture and len(frames) > 1:
        width, height = options.size
        options = replace(options, size=(round(_SHEET_SCALE * width), round(_SHEET_SCALE * height)))
    with virtual_display():
        pictures = _render_frames(frames, options, titled=len(folders) > 1)
        target.parent.mkdir(parents=True, exist_ok=True)
        if is_picture:
            _save_png(target, tile_pictures(list(pictures)))
        else:
            repeated = zip(pictures, repetitions, strict=True)
            _save_film(target, (picture for picture, count in repeated for _ in range(count)), rate)
    return target


def select_frames(
    run_frames: list[list[FrameSource]], folders: list[Path], frame: int, sheet: str
) -> list[FrameSource]:
    """Frames of a picture: one of each run, or those of a sheet of one run.

    Args:
        run_frames: frames of each run.
        folders: output folders, for messages.
        frame: number of the frame, -1 for the last.
        sheet: "", number of frames on a sheet, or which.

    Raises:
        InputError: there is no such frame.
    """
    for frames, folder in zip(run_frames, folders, strict=True):
        if not -len(frames) <= frame < len(frames):
            raise InputError(f"--frame {frame}: {folder} has {len(frames)} frames, counted from 0 (-1 is the last)")
    if not sheet:
        return [frames[frame] for frames in run_frames]
    if len(run_frames) > 1:
        raise InputError("--sheet: frames of one run; give one folder")
    frames = run_frames[0]
    try:
        numbers = [int(part) for part in sheet.split(",")]
    except ValueError:
        raise InputError(f"--sheet {sheet}: must be how many frames, or which: 0,18,-1") from None
    if len(numbers) == 1:
        if numbers[0] < 1:
            raise InputError(f"--sheet {sheet}: must be 1 or more")
        count = min(numbers[0], len(frames))
        spaced = np.rint(np.linspace(0, len(frames) - 1, count)).astype(int)
        numbers = np.unique(spaced).tolist() if count > 1 else [-1]
    if wrong := [number for number in numbers if not -len(frames) <= number < len(frames)]:
        raise InputError(f"--sheet {sheet}: {folders[0]} has {len(frames)} frames, counted from 0, and no {wrong[0]}")
    return [frames[number] for number in numbers]


def _render_frames(frames: Sequence[FrameSource], options: PictureOptions, *, titled: bool) -> Iterator[Pixels]:
    """Pictures of frames, from one camera position and with one range of colours.

    Args:
        frames: the frames.
        options: options of the pictures.
        titled: the title is the name of the run.
    """
    views = _frame_views(frames, options)
    limits = options.limits or merge_ranges([field_range(frame, options.colour) for frame in frames])
    if options.floor and views[0].is_flat:
        raise InputError("--floor: a body in 2D has none")
    with Renderer(options, views[0], limits, frames[0].folder) as renderer:
        for frame, view in zip(frames, views, strict=True):
            yield renderer.render_frame(frame, view, frame.folder.name if titled else None)


def _frame_views(frames: Sequence[FrameSource], options: PictureOptions) -> list[ViewBounds]:
    """Bounds that the camera shows of each frame: those of all frames, or of the first one moved with the body."""
    if options.follow:
        first = view_bounds(frames[0], options)
        motions = [body_motion(frame, options) for frame in frames]
        return [moved(first, motion - motions[0], options) for motion in motions]
    view = merge_bounds([view_bounds(frame, options) for frame in frames])
    if options.target is not None:
        view = centred(view, np.array(options.target), options)
    return [view] * len(frames)


def tile_pictures(pictures: Sequence[Pixels]) -> Pixels:
    """Sheet of pictures of equal size: up to three in one row, more in a grid that is about square."""
    columns = len(pictures) if len(pictures) <= 3 else math.ceil(math.sqrt(len(pictures)))
    height, width, _ = pictures[0].shape
    rows = math.ceil(len(pictures) / columns)
    sheet = np.full(
        (rows * (height + SHEET_GAP) - SHEET_GAP, columns * (width + SHEET_GAP) - SHEET_GAP, 3), 255, np.uint8
    )
    for number, picture in enumerate(pictures):
        y, x = (height + SHEET_GAP) * (number // columns), (width + SHEET_GAP) * (number % columns)
        sheet[y : y + height, x : x + width] = picture
    return sheet


def _save_png(target: Path, pixels: Pixels) -> None:
    """Write a PNG as a whole, since a viewer may show the previous one."""
    from PIL import Image

    with atomic_replacement_of_all(target) as temporary:
        Image.fromarray(pixels).save(temporary, "PNG", optimize=True)


def _save_film(target: Path, pictures: Iterator[Pixels], fps: float) -> None:
    """Write pictures as a film, or as PNGs to a folder if `target` has no suffix."""
    if target.suffix:
        with atomic_replacement_of_all(target) as temporary, _FilmWriter(temporary, fps) as append:
            for picture in pictures:
                append(picture)
        return
    target.mkdir(parents=True, exist_ok=True)
    for number, picture in enumerate(pictures):
        _save_png(target / f"frame_{number:06d}.png", picture)


class _FilmWriter:
    """Writer of a film. The sides of an MP4 are made even, as its codec requires."""

    def __init__(self, target: Path, fps: float) -> None:
        import imageio.v2

        settings: dict[str, Any] = {"duration": 1000 / fps, "loop": 0}
        if target.suffix == ".mp4":
            try:
                import imageio_ffmpeg  # noqa: F401
            except ImportError:
                message = (
                    f"-o {target.name}: films in MP4 need imageio-ffmpeg (pip install imageio-ffmpeg); .gif does not"
                )
                raise InputError(message) from None
            settings = {"fps": fps, "codec": "libx264", "quality": 8, "macro_block_size": 2}
        self._file = imageio.v2.get_writer(str(target), **settings)

    def __enter__(self) -> Callable[[Pixels], None]:
        return self._file.append_data

    def __exit__(self, *_: object) -> None:
        self._file.close()
