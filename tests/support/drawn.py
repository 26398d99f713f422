"""Drawn surfaces of whole meshes at a displacement."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fracsim.mesh.split_surface.closed_surface import SplitSurface
from fracsim.mesh.split_surface.drawn_surface import DrawnSurface, SharedPoints, gradients_of_copies
from fracsim.mesh.split_surface.entity_numbering import EntityNumbering
from fracsim.mesh.split_surface.mesh_part import WholeMesh
from fracsim.mesh.split_surface.surface_numbering import number_whole_surface


def drawn_at(
    skeleton: EntityNumbering,
    pattern: npt.NDArray[np.integer],
    split: SplitSurface,
    u: npt.NDArray[np.float64],
) -> DrawnSurface:
    """The split surface of a whole mesh at nodal displacements u (N, d)."""
    part, whole = WholeMesh(skeleton), number_whole_surface(len(split.points), len(split.elements), 0)
    shared, gradients = SharedPoints(part, split, whole), gradients_of_copies(part, pattern, split)
    return DrawnSurface.at_displacement(part, pattern, split, whole, shared, gradients, u)
