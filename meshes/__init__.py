"""Meshes as plain arrays with named groups: builders, files, closed surfaces to fill, and checks.

    BUILDERS["box"](size=(1.0, 1.0, 4.0), h=0.1).build()    a body by its name
    read.read_mesh("part.msh")                              a mesh from file
    shell.read_shell("hull.stl", 0.002)                     a surface, open or closed, with a thickness
    fill.fill_surface("part.stl", h=0.01)                   tetrahedra inside a closed surface
    check.check_mesh(mesh)                                  named or mended, before anything is solved
    quality.mesh_quality(mesh)                              numbers that tell a good mesh from a bad one

Importing this needs NumPy only: gmsh, meshio and SciPy are imported when they are called, on the process that calls.
"""

from __future__ import annotations

from .builders.boat import Boat
from .builders.box import Box
from .builders.cylinder import Cylinder, Disk
from .builders.figure import Figure
from .builders.loaf import Loaf
from .builders.notched_bar import NotchedBar
from .builders.notched_plate import NotchedPlate
from .builders.ornament import Ornament
from .builders.plate_hole import PlateHole
from .builders.stones import Stones
from .builders.vase import Vase
from .data import MeshData, MeshError
from .parameters import Builder

BUILDERS: dict[str, type[Builder]] = {
    "boat": Boat,
    "box": Box,
    "cylinder": Cylinder,
    "disk": Disk,
    "figure": Figure,
    "loaf": Loaf,
    "notched-bar": NotchedBar,
    "notched-plate": NotchedPlate,
    "ornament": Ornament,
    "plate-hole": PlateHole,
    "stones": Stones,
    "vase": Vase,
}

__all__ = ["BUILDERS", "Builder", "MeshData", "MeshError"]
