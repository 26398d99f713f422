"""Obstacles by the name that a user writes: half space, sphere, capsule, box, cylinder."""

from __future__ import annotations

from .ball import Capsule, Sphere
from .box import Box
from .cylinder import Cylinder
from .plane import Plane
from .shape import Shape

SHAPES: dict[str, type[Shape]] = {
    "plane": Plane, "sphere": Sphere, "capsule": Capsule, "box": Box, "cylinder": Cylinder,
}  # fmt: skip

__all__ = ["SHAPES", "Box", "Capsule", "Cylinder", "Plane", "Shape", "Sphere"]
