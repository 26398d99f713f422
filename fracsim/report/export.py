"""Export of the surfaces of a run for Blender, Houdini and others (`fracsim export`), from the files of the run.

USD has all frames in one file, and so has GLB if the bodies are rigid; otherwise there is a file per frame. PLY is
written by trimesh, USD by usd-core. GLB is binary glTF 2.0 (Khronos, ISO/IEC 12113:2022).
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import InputError
from ..meshes.plain_files import atomic_replacement_of_all
from .export_surfaces import (
    MATERIALS,
    RigidTrack,
    RigidTracks,
    Surface,
    join_surfaces,
    linear_colours,
    material_colours,
    material_roughness,
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


# --- binary glTF ---

Array = npt.NDArray[Any]
_FLOAT, _UNSIGNED_INT = 5126, 5125
_VERTICES, _INDICES = 34962, 34963
_HEADER = struct.Struct("<4sIII4s")


def write_glb(
    path: Path, tracks: list[RigidTrack], keys: list[float], look: MaterialLook, extras: dict[str, Any]
) -> None:
    """Write a node for each track, with y upwards, in m.

    A node that does not have all frames has the scale 0 in the others.

    Args:
        path: the file.
        tracks: surfaces and their motion.
        keys: times of the frames in the animation, s. Of one frame there is no animation.
        look: colours.
        extras: further data of the scene.
    """
    file = _GlbFile(look)
    for track in tracks:
        file.add_track(track, keys)
    file.document["scenes"] = [{"nodes": [*range(len(tracks))], "extras": extras}]
    path.write_bytes(file.to_bytes())


class _GlbFile:
    """Parts of a file: the JSON document, and the binary data of its accessors."""

    def __init__(self, look: MaterialLook) -> None:
        colours, roughness = linear_colours(look), material_roughness(look)
        materials = [
            {
                "name": name,
                "pbrMetallicRoughness": {
                    "baseColorFactor": [*colour, 1.0],
                    "metallicFactor": 0.0,
                    "roughnessFactor": share,
                },
            }
            for name, colour, share in zip(MATERIALS, colours, roughness, strict=True)
        ]
        self.document: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "fracsim"}, "scene": 0, "scenes": [], "nodes": [], "meshes": [],
            "materials": materials, "accessors": [], "bufferViews": [],
        }  # fmt: skip
        self._data = bytearray()
        self._channels: list[dict[str, Any]] = []
        self._samplers: list[dict[str, Any]] = []
        # keys of an animation -> accessor
        self._key_accessors: dict[tuple[float, ...], int] = {}

    def add_track(self, track: RigidTrack, keys: list[float]) -> None:
        """Add a node with its mesh and its motion."""
        node = len(self.document["nodes"])
        translation, rotation = _upright(np.array(track.translation)), _gltf_quaternions(np.array(track.rotation))
        self.document["nodes"].append({
            "name": track.surface.name, "mesh": self._add_mesh(track.surface),
            "translation": translation[0].tolist(), "rotation": rotation[0].tolist(),
        })  # fmt: skip
        if len(keys) == 1:
            return
        present = [keys[frame] for frame in track.frames]
        if track.moves:
            self._add_channel(node, "translation", present, translation, "VEC3")
            self._add_channel(node, "rotation", present, rotation, "VEC4")
        if len(present) < len(keys):
            times = (
                [keys[0]] * (track.first > 0) + [keys[track.first]] + keys[track.frames.stop : track.frames.stop + 1]
            )
            shown = [0.0] * (track.first > 0) + [1.0] + [0.0] * (track.frames.stop < len(keys))
            self._add_channel(node, "scale", times, np.repeat(shown, 3).reshape(-1, 3), "VEC3", "STEP")

    def _add_mesh(self, surface: Surface) -> int:
        """Add a mesh with a primitive for each material."""
        primitives = []
        for material in map(int, np.unique(surface.material)):
            points, normals, triangles = surface.split_corners(material)
            position = self._add_accessor(_upright(points), "VEC3", _VERTICES, bounds=True)
            attributes = {"POSITION": position, "NORMAL": self._add_accessor(_upright(normals), "VEC3", _VERTICES)}
            indices = self._add_accessor(triangles.astype(np.uint32).reshape(-1, 1), "SCALAR", _INDICES)
            primitives.append({"attributes": attributes, "indices": indices, "material": material})
        self.document["meshes"].append({"name": surface.name, "primitives": primitives})
        return len(self.document["meshes"]) - 1

    def _add_channel(
        self, node: int, path: str, keys: list[float], values: Array, kind: str, how: str = "LINEAR"
    ) -> None:
        """Add keyframes of a property of a node."""
        times = tuple(keys)
        if times not in self._key_accessors:
            self._key_accessors[times] = self._add_accessor(np.array(keys).reshape(-1, 1), "SCALAR", bounds=True)
        output = self._add_accessor(values, kind)
        self._channels.append({"sampler": len(self._samplers), "target": {"node": node, "path": path}})
        self._samplers.append({"input": self._key_accessors[times], "output": output, "interpolation": how})

    def _add_accessor(self, values: Array, kind: str, target: int = 0, *, bounds: bool = False) -> int:
        """Add an array (n, columns) of floats, or of unsigned integers, and return its number."""
        array = values if values.dtype == np.uint32 else values.astype(np.float32)
        view = {"buffer": 0, "byteOffset": len(self._data), "byteLength": array.nbytes}
        self.document["bufferViews"].append(view | ({"target": target} if target else {}))
        self._data += array.tobytes()
        accessor: dict[str, Any] = {
            "bufferView": len(self.document["bufferViews"]) - 1, "count": len(array), "type": kind,
            "componentType": _UNSIGNED_INT if array.dtype == np.uint32 else _FLOAT,
        }  # fmt: skip
        if bounds:
            accessor |= {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
        self.document["accessors"].append(accessor)
        return len(self.document["accessors"]) - 1

    def to_bytes(self) -> bytes:
        """Contents of the file: a header, the JSON document, the binary data."""
        document = self.document | {"buffers": [{"byteLength": len(self._data)}]}
        if self._channels:
            document["animations"] = [{"name": "run", "channels": self._channels, "samplers": self._samplers}]
        text = json.dumps(document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        length = _HEADER.size + len(text) + 8 + len(self._data)
        head = _HEADER.pack(b"glTF", 2, length, len(text), b"JSON")
        return head + text + struct.pack("<I4s", len(self._data), b"BIN\0") + bytes(self._data)


def _upright(vectors: Array) -> Array:
    """Vectors (n, 3) with z upwards in the axes of glTF, with y upwards."""
    return np.column_stack([vectors[:, 0], vectors[:, 2], -vectors[:, 1]])


def _gltf_quaternions(quaternions: Array) -> Array:
    """Quaternions (n, 4) x, y, z, w in the axes of glTF, of quaternions w, x, y, z with z upwards."""
    return np.column_stack([_upright(quaternions[:, 1:]), quaternions[:, 0]])
