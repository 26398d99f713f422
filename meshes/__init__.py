"""Meshes as plain arrays with named groups: builders, files, closed surfaces to fill, and checks.

    BUILDERS["box"](size=(1.0, 1.0, 4.0), h=0.1).build()    a body by its name
    read_mesh("part.msh")                                   a mesh from file
    fill_surface("part.stl", h=0.01)                        tetrahedra inside a closed surface
    check_mesh(mesh)                                        named or mended, before anything is solved

Importing this needs NumPy only: gmsh and meshio are imported by what uses them, on the process that uses them.
"""

from __future__ import annotations

from .box import Box
from .cylinder import Cylinder, Disk
from .data import MeshData, MeshError
from .loaf import Loaf
from .notched_bar import NotchedBar
from .notched_plate import NotchedPlate
from .parameters import Builder

BUILDERS: dict[str, type[Builder]] = {
    "box": Box,
    "cylinder": Cylinder,
    "disk": Disk,
    "loaf": Loaf,
    "notched-bar": NotchedBar,
    "notched-plate": NotchedPlate,
}

__all__ = ["BUILDERS", "Builder", "MeshData", "MeshError"]
