"""Pictures, sheets and animations of runs, off-screen: their split surface where there is one, else their mesh.

A screen for VTK on machines that have none.
"""

from __future__ import annotations

import math
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ...errors import InputError
from ...meshes.plain_files import check_replaceable, replacing_all
from .camera import merge_bounds, view_bounds
from .colour_maps import merge_ranges
from .frames import FrameSource, film_repetitions, find_frames, read_study
from .picture_options import PictureOptions
from .renderer import Renderer, field_range

Pixels = npt.NDArray[np.uint8]
FILMS = (".gif", ".mp4")
FPS = 12
TILE = 0.5  # of the size of a picture: one of several on a sheet
GAP = 8  # pixels between pictures of a sheet


@contextmanager
def virtual_display() -> Iterator[None]:
    """The screen there is, or a virtual one that ends with the picture."""
    xvfb = shutil.which("Xvfb")
    if os.environ.get("DISPLAY") or xvfb is None:
        yield
        return
    read, write = os.pipe()
    command = [xvfb, "-displayfd", str(write), "-screen", "0", "1600x1200x24", "-nolisten", "tcp"]
    quiet = subprocess.DEVNULL
    # not in the working folder, where it looks for keyboards
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


def render(
    folder: Path | Sequence[Path],
    target: Path | None = None,
    look: PictureOptions | None = None,
    *,
    frame: int = -1,
    sheet: str = "",
    fps: int = FPS,
) -> Path:
    """Draw one frame as a PNG, or all of them as a GIF, an MP4 or, where `target` has no suffix, PNGs in a folder;
    returns what was written. Pictures of a film are evenly spaced in simulated time, those in a folder are the frames.

    Several folders: that frame of each, side by side.    `sheet`: so many frames of one folder, or which: "0,18,-1".
    """
    folders = [folder] if isinstance(folder, Path) else list(folder)
    target, look = target or folders[0] / "last.png", look or PictureOptions()
    look.view_direction()
    if target.suffix not in ("", ".png", *FILMS):
        raise InputError(f"-o {target}: pictures are .png, films .gif or .mp4, and a name without a suffix is a folder")
    if target.suffix:
        check_replaceable(target)  # before anything is drawn
    every = [find_frames(each) for each in folders]
    if target.suffix == ".png":
        shots = select_frames(every, folders, frame, sheet)
    elif sheet or len(folders) > 1:
        raise InputError(f"-o {target}: a sheet, or pictures of several runs, is a .png")
    else:
        shots = every[0]
    film = target.suffix in FILMS
    counts = film_repetitions([shot.t for shot in shots]) if film else np.ones(len(shots), int)
    shots, counts = [shot for shot, count in zip(shots, counts, strict=True) if count], counts[counts > 0]
    single = target.suffix == ".png"
    if len(shots) > 1:
        look = replace(look, fine=look.fine and single)
    if single and len(shots) > 1:
        look = replace(look, size=(round(TILE * look.size[0]), round(TILE * look.size[1])))
    with virtual_display():
        pictures = _shoot(shots, look, titled=len(folders) > 1)
        target.parent.mkdir(parents=True, exist_ok=True)
        if single:
            _save(target, tile_pictures(list(pictures)))
        else:
            _film(target, (each for each, n in zip(pictures, counts, strict=True) for _ in range(n)), fps)
    return target


def select_frames(every: list[list[FrameSource]], folders: list[Path], frame: int, sheet: str) -> list[FrameSource]:
    """The frames of a picture: one a folder, or those of a sheet."""
    for frames, folder in zip(every, folders, strict=True):
        if not -len(frames) <= frame < len(frames):
            raise InputError(f"--frame {frame}: {folder} has {len(frames)} frames, counted from 0 (-1 is the last)")
    if not sheet:
        return [frames[frame] for frames in every]
    if len(every) > 1:
        raise InputError("--sheet: frames of one run; give one folder")
    frames = every[0]
    try:
        which = [int(part) for part in sheet.split(",")]
    except ValueError:
        raise InputError(f"--sheet {sheet}: must be how many frames, or which: 0,18,-1") from None
    if len(which) == 1:
        if which[0] < 1:
            raise InputError(f"--sheet {sheet}: must be 1 or more")
        count = min(which[0], len(frames))
        which = np.unique(np.rint(np.linspace(0, len(frames) - 1, count)).astype(int)).tolist() if count > 1 else [-1]
    if wrong := [each for each in which if not -len(frames) <= each < len(frames)]:
        raise InputError(f"--sheet {sheet}: {folders[0]} has {len(frames)} frames, counted from 0, and no {wrong[0]}")
    return [frames[each] for each in which]


def _shoot(shots: Sequence[FrameSource], look: PictureOptions, *, titled: bool) -> Iterator[Pixels]:
    """All from one place, in one range of colours. `titled`: each by the name of its run."""
    scope = merge_bounds([view_bounds(shot, look) for shot in shots])
    limits = look.limits or merge_ranges([field_range(shot, look.colour) for shot in shots])
    if look.floor and scope.is_flat:
        raise InputError("--floor: a body in 2D has none")
    with Renderer(look, scope, limits, read_study(shots[0].folder)) as stage:
        for shot in shots:
            yield stage.render_frame(shot, shot.folder.name if titled else None)


def tile_pictures(pictures: Sequence[Pixels]) -> Pixels:
    """Up to three in a row, more of them in rows as long as there are."""
    columns = len(pictures) if len(pictures) <= 3 else math.ceil(math.sqrt(len(pictures)))
    height, width, _ = pictures[0].shape
    rows = math.ceil(len(pictures) / columns)
    sheet = np.full((rows * (height + GAP) - GAP, columns * (width + GAP) - GAP, 3), 255, np.uint8)
    for place, each in enumerate(pictures):
        y, x = (height + GAP) * (place // columns), (width + GAP) * (place % columns)
        sheet[y : y + height, x : x + width] = each
    return sheet


def _save(target: Path, pixels: Pixels) -> None:
    """Write a PNG in one go: a run may draw the same one, and someone may look at it."""
    from PIL import Image

    with replacing_all(target) as new:
        Image.fromarray(pixels).save(new, "PNG", optimize=True)


def _film(target: Path, pictures: Iterator[Pixels], fps: int) -> None:
    """All pictures, as the name says."""
    if target.suffix:
        with replacing_all(target) as new, _writer(new, fps) as append:
            for each in pictures:
                append(each)
        return
    target.mkdir(parents=True, exist_ok=True)
    for number, each in enumerate(pictures):
        _save(target / f"frame_{number:06d}.png", each)


class _writer:
    """A film as it is written; an MP4 has sides of even length, as its coding asks."""

    def __init__(self, target: Path, fps: int) -> None:
        import imageio.v2

        how: dict[str, Any] = {"duration": 1000 / fps, "loop": 0}
        if target.suffix == ".mp4":
            try:
                import imageio_ffmpeg  # noqa: F401
            except ImportError:
                message = (
                    f"-o {target.name}: films in MP4 need imageio-ffmpeg (pip install imageio-ffmpeg); .gif does not"
                )
                raise InputError(message) from None
            how = {"fps": fps, "codec": "libx264", "quality": 8, "macro_block_size": 2}
        self._file = imageio.v2.get_writer(str(target), **how)

    def __enter__(self) -> Callable[[Pixels], None]:
        return self._file.append_data

    def __exit__(self, *_: object) -> None:
        self._file.close()
