"""Hexahedra, wedges and pyramids cut into tetrahedra, and quadrilaterals into triangles, so that neighbours agree.

Each quadrilateral is cut along the diagonal from its node of least number; so two cells cut their common face alike. A
cell is the union of the tetrahedra from its node of least number to the triangles of the faces without this node: six
for a hexahedron, three for a wedge, two for a pyramid. No point is added.

Source: J. Dompierre, P. Labbe, M.-G. Vallet, R. Camarero (1999), How to subdivide pyramids, prisms and hexahedra into
tetrahedra, 8th International Meshing Roundtable.
"""

from __future__ import annotations

import numpy as np

from .data import Indices, MeshError, Points, format_midpoint
from .topology import Floats, signed_measures

# Shape -> columns of the corners of its faces, normals outwards; corners in the order of VTK and Gmsh
FACES: dict[str, tuple[tuple[int, ...], ...]] = {
    "hexahedron": ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)),
    "wedge": ((0, 2, 1), (3, 4, 5), (0, 1, 4, 3), (1, 2, 5, 4), (2, 0, 3, 5)),
    "pyramid": ((0, 3, 2, 1), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
}
PLURALS = {"hexahedron": "hexahedra", "wedge": "wedges", "pyramid": "pyramids", "quad": "quadrilaterals"}


def split_quads(quads: Indices) -> tuple[Indices, Indices]:
    """Triangles (m, 3) of quadrilaterals (k, 4), with their orientation, and the quadrilateral of each triangle (m,).

    A quadrilateral with a node twice, a triangle written as one, gives one triangle.
    """
    return _without_repeats(np.stack(_halves(quads), axis=1).reshape(-1, 3), np.repeat(np.arange(len(quads)), 2))


def split_into_tetrahedra(shape: str, cells: Indices) -> tuple[Indices, Indices]:
    """Tetrahedra (m, 4) of cells (k, 8, 6 or 5) of a shape of FACES, and the cell of each, in rising order (m,).

    A cell with a node twice, such as a wedge written as a hexahedron, gives fewer tetrahedra. They are positive if the
    normals of the FACES of their cell point outwards.
    """
    tetrahedra, owners = [], []
    minimum = cells.argmin(axis=1)
    for apex in range(cells.shape[1]):
        chosen = np.flatnonzero(minimum == apex)
        for face in (face for face in FACES[shape] if apex not in face):
            corners = cells[chosen][:, face]
            for triangles in (corners,) if len(face) == 3 else _halves(corners):
                tetrahedra.append(np.column_stack([cells[chosen, apex], triangles]))
                owners.append(chosen)
    order = np.argsort(np.concatenate(owners), kind="stable")
    return _without_repeats(np.concatenate(tetrahedra)[order], np.concatenate(owners)[order])


def _halves(quads: Indices) -> tuple[Indices, Indices]:
    """The two triangles of each quadrilateral (k, 4), cut along the diagonal from its node of least number."""
    turned = np.take_along_axis(quads, (quads.argmin(axis=1)[:, None] + np.arange(4)) % 4, axis=1)
    return turned[:, [0, 1, 2]], turned[:, [0, 2, 3]]


def _without_repeats(simplices: Indices, owner: Indices) -> tuple[Indices, Indices]:
    """The simplices without those that have a node twice, and their owners."""
    whole = (np.diff(np.sort(simplices, axis=1), axis=1) != 0).all(axis=1)
    return simplices[whole], owner[whole]


def orient_simplices(
    shape: str, cells: Indices, parts: Indices, owner: Indices, points: Points, source: str
) -> Indices:
    """The simplices of cells, those of wedges with positive orientation.

    Args:
        shape: of the cells.
        cells: (k, c) corners.
        parts: (m, d + 1) simplices.
        owner: (m,) cell of each simplex.
        points: (n, d) [m].
        source: begins the message of an error.

    Raises:
        MeshError: a cell has positive and negative simplices.
    """
    measures = _measures(points, parts)
    positive = np.bincount(owner, measures > 0, minlength=len(cells)) > 0
    negative = np.bincount(owner, measures < 0, minlength=len(cells)) > 0
    twisted = np.flatnonzero(positive & negative)
    if len(twisted):
        raise MeshError(
            f"{source}: {len(twisted)} of {len(cells)} {PLURALS[shape]} are folded, concave or strongly warped, the "
            f"first near {format_midpoint(points, cells[twisted[0]])}, and cannot be cut into simplices. Mend these "
            f"cells (are their nodes in order?), or mesh the body with "
            f"{'triangles' if shape == 'quad' else 'tetrahedra'}."
        )
    if shape != "wedge":
        return parts
    # programs order the nodes of wedges in two ways
    return np.where(negative[owner][:, None], parts[:, [0, 1, 3, 2]], parts)


def _measures(points: Points, simplices: Indices) -> Floats:
    """(m,) signed areas or volumes; NaN of a simplex with a node out of range, which `check_mesh` refuses."""
    exist = ((simplices >= 0) & (simplices < len(points))).all(axis=1)
    measures = np.full(len(simplices), np.nan)
    measures[exist] = signed_measures(points, simplices[exist])
    return measures
