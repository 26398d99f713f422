"""What Blender shows of a file: python3 blender_reader.py FILE TARGET.json, with `bpy` of PyPI.

The target has the base colours of the materials, the range of frames, the materials of each mesh, and at each of its
first frames the boxes of the meshes that are shown, in Blender's axes (z upwards, m).
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import bpy


def base_colour(material: Any) -> list[float]:
    return [*material.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value][:3]


def boxes() -> dict[str, list[list[float]]]:
    """Name of each mesh that is shown -> its least and largest coordinates at the frame of the scene."""
    found, graph = {}, bpy.context.evaluated_depsgraph_get()
    for each in bpy.data.objects:
        evaluated = each.evaluated_get(graph)
        if each.type != "MESH" or min(evaluated.matrix_world.to_scale()) < 0.5:
            continue
        mesh = evaluated.to_mesh()
        points = [evaluated.matrix_world @ vertex.co for vertex in mesh.vertices]
        if points:
            found[each.name] = [[pick(point[axis] for point in points) for axis in range(3)] for pick in (min, max)]
        evaluated.to_mesh_clear()
    return found


def main(file: str, target: str, frames: int = 8) -> None:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    if file.endswith(".glb"):
        bpy.ops.import_scene.gltf(filepath=file)
    elif file.endswith(".obj"):
        bpy.ops.wm.obj_import(filepath=file, forward_axis="Y", up_axis="Z")
    else:
        bpy.ops.wm.usd_import(filepath=file)
    scene = bpy.context.scene
    found: dict[str, Any] = {
        "colours": {material.name: base_colour(material) for material in bpy.data.materials},
        "range": [scene.frame_start, scene.frame_end, scene.render.fps],
        "materials": {
            each.name: [slot.material.name for slot in each.material_slots]
            for each in bpy.data.objects
            if each.type == "MESH"
        },
        "boxes": [],
    }
    for frame in range(frames):
        scene.frame_set(frame)
        found["boxes"].append(boxes())
    Path(target).write_text(json.dumps(found))


if __name__ == "__main__":
    main(*sys.argv[1:])
