"""Where the two sides of a new crack stand for contact: apart by a gap, so that no barrier acts as an edge breaks.

A gap of twice the distance of the barrier, itself 3 % of an edge, leaves no pair within it on meshes of gmsh, whichever
edges break, and room for a state of strain of about 1 %. With more strain, or slivers: Pairs.crowded.

Every copy goes towards the mean of the nodes that it follows, so far that all walls of the crack at it recede by half
the gap along their normals; the boundary of the body keeps its place. (A fixed share of the edge
leaves walls that are aslant to their edge nearer to each other: half of the gap on a lattice, a fifth on worse
meshes.) A point with one copy is a tip, where the sides meet, and stays.

Equations: docs/theory.md#new-crack-faces.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..mesh.split_surface.closed_surface import SplitSurface
from ..mesh.split_surface.entity_numbering import CRACK

Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

MOST = 0.4  # of the way to the nodes: what slivers allow


def offset_crack_faces(made: SplitSurface, gap: float) -> Values:
    """(n, d) reference places, m, whose opposite walls are `gap` m apart, where the shape of the cells allows it."""
    start = made.parents.start
    arm = np.add.reduceat(made.parents.arm, start[:-1], axis=0) / np.diff(start)[:, None]
    length = np.linalg.norm(arm, axis=1)
    outward = arm / np.where(length > 0, length, 1.0)[:, None]
    cosine = _least_cosine(made, outward)
    far = np.where(cosine > 0, 0.5 * gap / np.where(cosine > 0, cosine, 1.0), np.inf)
    back = np.where(_is_tip(made.points), 0.0, np.minimum(far, MOST * length))
    result: Values = made.points - back[:, None] * outward
    return result


def _least_cosine(made: SplitSurface, outward: Values) -> Values:
    """(n,) the least cosine between `outward` (n, d) and the normals of the crack's walls at each point; inf: none."""
    corners = made.elements[made.origin == CRACK]
    cosine = np.einsum("ekj,ej->ek", outward[corners], unit_normals(made.points[corners]))
    least = np.full(len(outward), np.inf)
    np.minimum.at(least, corners, cosine)
    return least


def unit_normals(corners: Values) -> Values:
    """(m, d) unit normals, outwards, of segments or triangles (m, d, d)."""
    side = corners[:, 1:] - corners[:, :1]
    normal = np.cross(side[:, 0], side[:, 1]) if side.shape[1] == 2 else side[:, 0, ::-1] * [1.0, -1.0]
    size = np.linalg.norm(normal, axis=1, keepdims=True)
    result: Values = normal / np.where(size > 0, size, 1.0)
    return result


def _is_tip(points: Values) -> Flags:
    """(n,) whether no other point is at the same place."""
    _, place, count = np.unique(points, axis=0, return_inverse=True, return_counts=True)
    return count[place.ravel()] == 1
