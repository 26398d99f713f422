"""The shapes of obstacles as the engine knows them; rounded edges are sharp there, and what a file has is a union of
convex parts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..contact.shape_base import frame_about, unit_vector
from ..contact.shapes import Capsule, HalfSpace, RoundedBox, RoundedCylinder, Shape, Sphere
from ..errors import InputError

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Primitive:
    """About its reference point.

    Attributes:
        kind: plane, sphere, capsule, cylinder, box or hull.    size: (3,) half sizes and radii as MuJoCo has them, m.
        turn: (3, 3) from the axes of the kind, whose own axis or normal is z.
        extent: half the size of the thing, m; infinite of a plane.    corners: (n, 3) of a hull, m.
        friction: Coulomb's coefficient, of what moves freely; None: that of what it is a part of.
    """

    kind: str
    size: tuple[float, float, float]
    turn: Values
    extent: float
    corners: Values | None = None
    friction: float | None = None

    @property
    def span(self) -> Values:
        """(k, 3) points the farthest of which is as far as it reaches, m."""
        if self.corners is not None:
            return self.corners
        x, y, z = self.size
        return np.array([[x + y, 0.0, 0.0] if self.kind == "capsule" else [x, y, z]])


def primitives(shape: Shape, name: str) -> list[Primitive]:
    """The parts of an obstacle of that name. InputError for one that the engine does not have."""
    from ..contact.triangle_mesh_shape import TriangleMeshShape

    if not isinstance(shape, TriangleMeshShape):
        return [primitive(shape, name)]
    from .convex_decomposition import Solid as Enclosed
    from .convex_decomposition import convex_parts

    extent = float(np.ptp(shape.points, axis=0).min()) / 2
    parts = convex_parts(Enclosed.of(shape.points, shape.triangles).filled)
    return [Primitive("hull", (0.0, 0.0, 0.0), np.eye(3), extent, corners) for corners in parts]


def primitive(shape: Shape, name: str) -> Primitive:
    """Of an obstacle of that name. InputError for one that the engine does not have."""
    if shape.dim != 3:
        raise InputError(f'{name} has {shape.dim} dimensions: time.scheme = "rigid" is for bodies in space')
    if not shape.convex:
        raise InputError(f'{name} is hollow, which time.scheme = "rigid" does not have: build it of boxes or planes')
    upright = np.eye(3)
    match shape:
        case HalfSpace():
            return Primitive("plane", (0.0, 0.0, 1.0), frame_about(unit_vector(shape.direction)), np.inf)
        case Sphere():
            return Primitive("sphere", (shape.radius, 0.0, 0.0), upright, shape.radius)
        case Capsule():
            long = (shape.radius, shape.length / 2, 0.0)
            return Primitive("capsule", long, frame_about(unit_vector(shape.axis)), shape.radius)
        case RoundedCylinder():
            long = (shape.radius, shape.length / 2, 0.0)
            return Primitive(
                "cylinder", long, frame_about(unit_vector(shape.axis)), min(shape.radius, shape.length / 2)
            )
        case RoundedBox():
            x, y, z = (side / 2 for side in shape.size)
            return Primitive("box", (x, y, z), upright, min(x, y, z))
    raise InputError(f'{name}: time.scheme = "rigid" has no {shape.kind}')
