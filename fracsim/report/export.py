"""Export of the surfaces of a run for Blender, Houdini and others (`fracsim export`), from the files of the run.

USD has all frames in one file, and so has GLB if the bodies are rigid; otherwise there is a file per frame. PLY is
written by trimesh, USD by usd-core.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..meshes.plain_files import atomic_replacement_of_all
from .export_glb import write_glb
from .export_surfaces import (
    MATERIALS,
    RigidTracks,
    Surface,
    join_surfaces,
    linear_colours,
    material_colours,
    read_fragments,
    read_obstacles,
)
from .export_usd import UsdFile
from .pictures.frames import FILM_TIMING, FrameSource, film_interval, find_frames, plane_normals, read_study
from .pictures.picture_options import MaterialLook, material_look

EXPORT_FORMATS = ("ply", "obj", "glb", "usd")
# frames of the run per second when programs play it, whatever the simulated time between them
FRAMES_PER_SECOND = 24.0


def export_surfaces(
    folder: Path, kind: str, target: Path | None = None, *, frame: int | None = None, dust: bool = True, look: str = ""
) -> list[Path]:
    """Write all frames, or one, to files and return their paths.

    Args:
        folder: output folder of the run.
        kind: one of `EXPORT_FORMATS`.
        target: folder of the files; None: export in the output folder.
        frame: number of the frame, -1 for the last; None: all.
        dust: with single-node fragments.
        look: see `material_look`; "": that of the study.

    Raises:
        InputError: the run has no split surface, or no such frame; or a package is missing.
    """
    if kind not in EXPORT_FORMATS:
        raise InputError(f"--format {kind}: must be one of {', '.join(EXPORT_FORMATS)}")
    frames = find_frames(folder)
    if frames[0].index >= 0:
        raise InputError(f"{folder} has no surface.pvd: set output.surface = true in the study, and run it again")
    if frame is not None and not -len(frames) <= frame < len(frames):
        raise InputError(f"--frame {frame}: {folder} has {len(frames)} frames, counted from 0 (-1 is the last)")
    numbers = list(range(len(frames))) if frame is None else [frame % len(frames)]
    if target is None and (folder / "export").is_symlink():
        raise InputError(f"{folder / 'export'} is a link: name the folder for the files with -o")
    target = target or folder / "export"
    study = read_study(folder)
    scene = _Scene(
        folder.resolve().name, frames, [*plane_normals(study)], dust,
        material_look(look or study.get("output", {}).get("look", "plain")),
        study.get("time", {}).get("scheme") == "rigid",
    )  # fmt: skip
    target.mkdir(parents=True, exist_ok=True)
    if kind == "usd":
        _import("pxr.Usd", "usd-core")
        return [_replace(target / f"{scene.name}.usdc", lambda path: scene.write_usd(path, numbers))]
    if kind == "glb" and scene.rigid and frame is None:
        return [_replace(target / f"{scene.name}.glb", lambda path: scene.write_glb(path, numbers))]
    paths = [target / f"{scene.name}_{number:06d}.{kind}" for number in numbers]
    write = {"ply": scene.write_ply, "obj": scene.write_obj, "glb": scene.write_glb}[kind]
    return [_replace(path, partial(write, numbers=[number])) for path, number in zip(paths, numbers, strict=True)]


def _replace(path: Path, write: Callable[[Path], None]) -> Path:
    """Path of a file that `write` writes; an earlier one stays if that fails."""
    with atomic_replacement_of_all(path) as temporary:
        write(temporary)
    return path


def _import(name: str, package: str) -> Any:
    """Module of an optional package. Raises InputError if the package is not installed."""
    try:
        return import_module(name)
    except ImportError:
        raise InputError(f"--format: this one needs {package} (pip install {package})") from None


@dataclass(frozen=True)
class _Scene:
    """What is exported.

    Attributes:
        name: name of the run.
        frames: all frames of the run.
        planes: names of the obstacles that are planes.
        dust: with single-node fragments.
        look: colours.
        rigid: the bodies are rigid.
    """

    name: str
    frames: list[FrameSource]
    planes: list[str]
    dust: bool
    look: MaterialLook
    rigid: bool

    def write_usd(self, path: Path, numbers: list[int]) -> None:
        """Write frames: rigid surfaces with a transform each, a deforming body as one mesh that changes."""
        times, interval = self._times(numbers)
        codes = [t / interval for t in times]
        codes = [round(code) if abs(code - round(code)) < FILM_TIMING.time_tolerance else code for code in codes]
        file, tracks = UsdFile(path, codes, interval, FRAMES_PER_SECOND, self.look), RigidTracks()
        for index, number in enumerate(numbers):
            fragments = read_fragments(self.frames[number], self.dust)
            tracks.add_frame([*(fragments if self.rigid else []), *read_obstacles(self.frames[number], self.planes)])
            if not self.rigid:
                names = [int(fragment.name.split("_")[1]) for fragment in fragments]
                piece = np.repeat(names, [len(fragment.triangles) for fragment in fragments])
                file.add_body_frame(index, join_surfaces(fragments), piece)
        for track in tracks.tracks:
            file.add_track(track)
        file.save()

    def write_glb(self, path: Path, numbers: list[int]) -> None:
        """Write frames of rigid surfaces, or one frame."""
        tracks = RigidTracks()
        for number in numbers:
            tracks.add_frame(self._surfaces(number))
        times, interval = self._times(numbers)
        keys = [(t - times[0]) / interval / FRAMES_PER_SECOND for t in times]
        extras: dict[str, Any] = {"time": times[0]}
        if len(keys) > 1:
            extras |= {"simulated_seconds_per_second": interval * FRAMES_PER_SECOND}
        write_glb(path, tracks.tracks, keys, self.look, extras)

    def write_ply(self, path: Path, numbers: list[int]) -> None:
        """Write the fragments of a frame as one surface in double precision, with the time in s as a comment."""
        trimesh, body = _import("trimesh", "trimesh"), join_surfaces(read_fragments(self.frames[numbers[0]], self.dust))
        colours = material_colours(self.look)[body.material]
        mesh = trimesh.Trimesh(body.points, body.triangles, face_colors=colours, process=False)
        head, data = mesh.export(file_type="ply", vertex_normal=False).split(b"\nelement", 1)
        path.write_bytes(head + f"\ncomment t = {self.frames[numbers[0]].t:.9g} s\nelement".encode() + data)

    def write_obj(self, path: Path, numbers: list[int]) -> None:
        """Write an object for each surface of a frame, and its materials in a file .mtl beside it."""
        materials = path.with_name(f"{self.name}.mtl")
        named = zip(MATERIALS, linear_colours(self.look), strict=True)
        text = "".join("newmtl {}\nKd {:.6f} {:.6f} {:.6f}\n".format(name, *colour) for name, colour in named)
        materials.write_text(text, encoding="utf-8")
        lines = ["# m", f"# t = {self.frames[numbers[0]].t:.9g} s", f"mtllib {materials.name}"]
        first, first_normal = 1, 1
        for surface in self._surfaces(numbers[0]):
            lines += _obj_lines(surface, first, first_normal)
            first, first_normal = first + len(surface.points), first_normal + 3 * len(surface.triangles)
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")

    def _surfaces(self, number: int) -> list[Surface]:
        """Fragments and obstacles of a frame."""
        return [*read_fragments(self.frames[number], self.dust), *read_obstacles(self.frames[number], self.planes)]

    def _times(self, numbers: list[int]) -> tuple[list[float], float]:
        """Times of frames, s, and the interval between two pictures of the whole run, s."""
        return [self.frames[number].t for number in numbers], film_interval([frame.t for frame in self.frames])


def _obj_lines(surface: Surface, first: int, first_normal: int) -> list[str]:
    """Lines of an object; its points and normals have numbers from `first` and `first_normal` on."""
    lines = [f"o {surface.name}"]
    lines += ["v {:.9g} {:.9g} {:.9g}".format(*point) for point in surface.points]
    lines += ["vn {:.5g} {:.5g} {:.5g}".format(*normal) for normal in surface.normals.reshape(-1, 3)]
    corners = np.stack([surface.triangles + first, np.arange(surface.triangles.size).reshape(-1, 3) + first_normal], 2)
    for material in np.unique(surface.material):
        lines += [f"g {surface.name}_{MATERIALS[material]}", f"usemtl {MATERIALS[material]}"]
        faces = corners[surface.material == material].reshape(-1, 6)
        lines += ["f {}//{} {}//{} {}//{}".format(*face) for face in faces]
    return lines
