"""Rigid surfaces as one binary glTF 2.0 file, with keyframes where they move (Khronos, ISO/IEC 12113:2022)."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .export_surfaces import MATERIALS, RigidTrack, Surface, linear_colours, material_roughness
from .pictures.picture_options import MaterialLook

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
