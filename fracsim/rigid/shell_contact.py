"""Contact of unbroken shells: every triangle with the thickness of the shell is a convex part, a prism.

A prism has sides that the shell does not have: what slides from one triangle to the next would run onto them. A contact
is one of the shell only if the direction d from the shell to the other body is a normal of the shell there, that is, if
the distance has a local minimum: no way from the contact within the shell leads closer to the other body,

    d . u <= tolerance

for the unit vectors u from an edge into the triangle beyond it, or from a node along all its edges. In a face d is its
normal. Contacts that are none of the shell are left out; the prisms beside them have the contact of the shell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from ..meshes.topology import edges_of
from .bodies import Bodies
from .contact_points import Contacts

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class ShellContactSettings:
    """Tolerances of contacts with prisms.

    Attributes:
        slope: largest d . u, the sine of an angle.
        edge_distance: thicknesses; contacts within this distance of an edge are contacts of the edge.
    """

    slope: float = 0.02
    edge_distance: float = 0.5


SETTINGS = ShellContactSettings()


@dataclass(frozen=True)
class ShellSurface:
    """Middle surface of an unbroken shell of m triangles and n nodes, relative to its centre of mass, in its own axes.

    Attributes:
        points: (n, 3) m.
        triangles: (m, 3) with consistent orientation.
        thickness: m.
        prisms: m arrays of corners (6, 3), m: the convex parts of the body, in the order of the triangles.
    """

    points: Values
    triangles: Ints
    thickness: float
    prisms: Sequence[Values]

    @cached_property
    def normals(self) -> Values:
        """Unit normals (m, 3) of the triangles."""
        a, b, c = np.moveaxis(self.points[self.triangles], 1, 0)
        return _unit_vectors(np.cross(b - a, c - a))

    @cached_property
    def outward(self) -> Values:
        """Unit vectors (m, 3, 3) in the triangles, out of them across the side from corner i to corner i + 1."""
        corners = self.points[self.triangles]
        return _unit_vectors(np.asarray(np.cross(np.roll(corners, -1, axis=1) - corners, self.normals[:, None]), float))

    @cached_property
    def beyond(self) -> Values:
        """Unit vectors (m, 3, 3) from the side i into the triangle beyond it; 0 where there is none."""
        sides = np.stack([self.triangles, np.roll(self.triangles, -1, axis=1)], axis=2).reshape(-1, 2)
        code = np.sort(sides, axis=1) @ [len(self.points), 1]
        order = np.argsort(code, kind="stable")
        first = np.flatnonzero(code[order][1:] == code[order][:-1])
        pairs = np.stack([order[first], order[first + 1]])
        outward, result = self.outward.reshape(-1, 3), np.zeros((len(code), 3))
        # seen from either of the two triangles at an edge
        result[pairs] = -outward[pairs[::-1]]
        return result.reshape(-1, 3, 3)

    @cached_property
    def along_edges(self) -> Values:
        """Unit vectors (n, k, 3) from each node along its edges, with 0 in unused places."""
        edges = edges_of(self.triangles)
        start, end = np.concatenate([edges, edges[:, ::-1]]).T
        order = np.argsort(start, kind="stable")
        start, end = start[order], end[order]
        column = np.arange(len(start)) - np.searchsorted(start, start)
        result: Values = np.zeros((len(self.points), int(column.max()) + 1, 3))
        result[start, column] = _unit_vectors(self.points[end] - self.points[start])
        return result

    def are_normals(self, triangle: Ints, direction: Values, point: Values) -> Flags:
        """Return (k,) flags of directions that are normals of the shell.

        Args:
            triangle: (k,) numbers of the triangles whose prisms touch.
            direction: (k, 3) unit vectors to the other body.
            point: (k, 3) on the surface of the prism, m.
        """
        lean = np.einsum("kij,kj->ki", self.outward[triangle], direction)
        corners = self.points[self.triangles[triangle]]
        distance = -np.einsum("kij,kij->ki", self.outward[triangle], point[:, None] - corners)
        # the prism touches with sides, or the node between two sides, that the direction leans to
        touches = (lean > SETTINGS.slope) & (distance < SETTINGS.edge_distance * self.thickness)
        leads_closer = np.einsum("kij,kj->ki", self.beyond[triangle], direction) > SETTINGS.slope
        result = ~np.any(touches & leads_closer, axis=1)
        rows, side = np.nonzero(touches & np.roll(touches, -1, axis=1))
        node = self.triangles[triangle[rows], (side + 1) % 3]
        along = np.einsum("kij,kj->ki", self.along_edges[node], direction[rows])
        result[rows] &= np.all(along <= SETTINGS.slope, axis=1)
        return result


def _unit_vectors(x: Values) -> Values:
    return np.asarray(x / np.linalg.norm(x, axis=-1, keepdims=True))


@dataclass(frozen=True)
class ShellContacts:
    """Which contacts between convex parts are contacts of shells.

    Attributes:
        surfaces: of n bodies, None for those that are no unbroken shells.
        rotation: (n, 3, 3) from the axes of the surfaces to those of the bodies at rest.
        first_geom: (n,) first geom of each body.
    """

    surfaces: Sequence[ShellSurface | None]
    rotation: Values
    first_geom: Ints

    @cached_property
    def _bodies_of_surface(self) -> list[tuple[ShellSurface, Flags]]:
        """Distinct surfaces, with flags (n + 1,) of their bodies; the last one stands for obstacles."""
        distinct = {id(surface): surface for surface in self.surfaces if surface is not None}
        owner = np.array([id(surface) for surface in self.surfaces] + [-1])
        return [(surface, owner == key) for key, surface in distinct.items()]

    def select(self, contacts: Contacts, bodies: Bodies) -> Contacts:
        """Return those of MuJoCo's contacts whose normals are normals of the shells that touch."""
        keep, count = np.ones(len(contacts), bool), len(self.surfaces)
        for surface, is_owner in self._bodies_of_surface:
            for side, sign in ((0, 1.0), (1, -1.0)):
                body = np.minimum(contacts.pairs[:, side], count)
                rows = np.flatnonzero(is_owner[body])
                body = body[rows]
                turn = bodies.rotation[body] @ self.rotation[body]
                direction = sign * contacts.axes[rows, 0]
                # contacts are half-way between the surfaces
                point = contacts.point[rows] - contacts.gap[rows, None] / 2 * direction - bodies.position[body]
                triangle = contacts.geoms[rows, side] - self.first_geom[body]
                in_shell = (np.einsum("kji,kj->ki", turn, vectors) for vectors in (direction, point))
                keep[rows] &= surface.are_normals(triangle, *in_shell)
        return contacts if np.all(keep) else contacts.select(np.flatnonzero(keep))
