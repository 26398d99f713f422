"""Spheres, capsules and cylinders of builders: unbroken bodies collide as these, and not as their polyhedral meshes.

The mass of such a body is that of its mesh. Its centre is that of the round solid, and its second moments are those of
the solid per volume, times the volume of the mesh, so that it rolls as the solid does:

    sphere    S = r^2/5 1
    cylinder  S = r^2/4 (1 - a a^T) + L^2/12 a a^T
    capsule   the sum over a cylinder, and half spheres whose centres of volume are 3 r/8 beyond its ends

with the radius r, the length L and the axis a; S = int x x^T dV / V about the centre of the solid. The fragments of a
body that breaks are those of its mesh, with the same momenta (Bodies.with_momenta_of).
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from ..contact.shape_base import frame_about
from ..mesh.split_surface.polyhedron_moments import PolyhedronMoments
from ..meshes.data import MeshData
from ..meshes.parameters import RoundSolid
from ..meshes.topology import boundary_facets
from .obstacles import COLLISION_SHAPES, Part, PrimitiveShape, cylinder_parts

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class RoundShape:
    """Round solid in the axes of a mesh whose boundary nodes lie on its surface.

    Attributes:
        solid: kind and sizes, m.
    """

    solid: RoundSolid

    @classmethod
    def of_mesh(cls, mesh: MeshData, solid: RoundSolid | None) -> RoundShape | None:
        """Return the shape of the `solid` of a builder; None if there is none or a boundary node is not on it."""
        if solid is None:
            return None
        shape, boundary = cls(solid), np.unique(boundary_facets(mesh.cells))
        deviation = float(np.abs(shape.distance(mesh.points[boundary])).max()) / solid.radius
        if deviation <= COLLISION_SHAPES.max_round_deviation:
            return shape
        print(
            f"fracsim: note: boundary nodes are up to {deviation:.2g} radii off the {solid.kind} of the builder; "
            "bodies collide as convex polyhedra",
            file=sys.stderr,
        )
        return None

    @property
    def axis(self) -> Values:
        """Unit vector (3,) along the axis."""
        return np.eye(3)[self.solid.along]

    def distance(self, x: Values) -> Values:
        """Return the distances (n,), m, of points x (n, 3) from the surface, negative inside.

        Beyond the edges of a cylinder they are those from its side or from the planes of its ends.
        """
        arm = x - self.solid.centre
        along = arm @ self.axis
        across = np.linalg.norm(arm - along[:, None] * self.axis, axis=1)
        beyond = np.abs(along) - self.solid.length / 2
        if self.solid.kind == "cylinder":
            return np.asarray(np.maximum(beyond, across - self.solid.radius))
        return np.hypot(across, np.maximum(beyond, 0.0)) - self.solid.radius

    @property
    def second_moments(self) -> Values:
        """S (3, 3), m^2: second moments about the centre of the solid per volume."""
        r, length = self.solid.radius, self.solid.length
        along, across = length**2 / 12, r**2 / 4
        if self.solid.kind != "cylinder":
            share = length / (length + 4 * r / 3)
            of_ends = r**2 / 5 + length**2 / 4 + 3 * length * r / 8
            along, across = share * along + (1 - share) * of_ends, share * across + (1 - share) * r**2 / 5
        return np.asarray(across * np.eye(3) + (along - across) * np.outer(self.axis, self.axis))

    def moments(self, volume: Values) -> PolyhedronMoments:
        """Return the moments of a body of the `volume` (1,), m^3, of its mesh."""
        return PolyhedronMoments(volume, np.array([self.solid.centre]), volume * self.second_moments[None])

    @cached_property
    def collision_parts(self) -> list[Part]:
        """The shapes that collide, relative to the centre of the solid."""
        solid, r = self.solid, self.solid.radius
        size = (r, 0.0, 0.0) if solid.kind == "sphere" else (r, solid.length / 2, 0.0)
        exact = PrimitiveShape(solid.kind, size, frame_about(self.axis), r)
        return [*cylinder_parts(exact)] if solid.kind == "cylinder" else [exact]

    @property
    def plane_corners(self) -> Values:
        """Corners (k, 3), m, that may touch a plane beside the contacts that MuJoCo finds."""
        hulls = [part.corners for part in self.collision_parts if isinstance(part, PrimitiveShape)]
        return np.concatenate([np.empty((0, 3)), *(corners for corners in hulls if corners is not None)])
