"""Meshes as plain arrays with named groups: builders, readers, closed surfaces, and checks.

    BUILDERS["box"](size=(1.0, 1.0, 4.0), h=0.1).build()    a body by the name of its builder
    read.read_mesh("part.msh")                              a mesh from file
    shell.read_shell("hull.stl", 0.002)                     a surface, open or closed, with a thickness
    surfaces.fill.fill_surface("part.stl", h=0.01)          tetrahedra inside a closed surface
    check.check_mesh(mesh)                                  faults mended or refused
    quality.mesh_quality(mesh)                              quality measures
    vtkhdf.find_file_mesh("part.vtkhdf")                    arrays of a file, of which ranks read their shares

The package needs NumPy only; gmsh, meshio and SciPy are imported by the functions that use them.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from importlib import import_module
from typing import ClassVar

from .data import MeshData, MeshError
from .parameters import Builder


class _Builders(Mapping[str, type[Builder]]):
    """Builder classes by their names in studies, each imported on access."""

    classes: ClassVar[dict[str, str]] = {
        "boat": "boat.Boat",
        "box": "box.Box",
        "capsule": "sphere.SolidCapsule",
        "cylinder": "cylinder.Cylinder",
        "disk": "cylinder.Disk",
        "figure": "figure.Figure",
        "l-panel": "plates.LPanel",
        "loaf": "loaf.Loaf",
        "notched-bar": "notched_bar.NotchedBar",
        "notched-plate": "plates.NotchedPlate",
        "ornament": "ornament.Ornament",
        "plate-hole": "plates.PlateHole",
        "sphere": "sphere.SolidSphere",
        "stones": "stones.Stones",
        "vase": "vase.Vase",
    }

    def __getitem__(self, name: str) -> type[Builder]:
        module, kind = self.classes[name].split(".")
        builder: type[Builder] = getattr(import_module(f".builders.{module}", __name__), kind)
        return builder

    def __iter__(self) -> Iterator[str]:
        return iter(self.classes)

    def __len__(self) -> int:
        return len(self.classes)


BUILDERS = _Builders()

__all__ = ["BUILDERS", "Builder", "MeshData", "MeshError"]
