"""[[obstacle]] and [contact]: what the body cannot pass through."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from .values import Flag, InTime, NonNegative, Positive, Table, Vector

# shape -> (keys that it needs, keys that it may have)
OF_SHAPE: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "plane": (("normal",), ()),
    "sphere": (("radius",), ("hollow",)),
    "capsule": (("radius", "length", "axis"), ()),
    "cylinder": (("radius", "length", "axis"), ("rounding", "hollow")),
    "box": (("size",), ("rounding", "hollow")),
}
GEOMETRY = ("normal", "radius", "length", "axis", "size", "rounding", "hollow")


class Obstacle(Table):
    """[[obstacle]]: a rigid shape that is held, or driven by a displacement or a velocity."""

    name: Annotated[str, Field(pattern="^[A-Za-z][A-Za-z0-9-]*$")]
    shape: Literal["plane", "sphere", "capsule", "cylinder", "box"]
    at: Vector  # its centre, or a point of the plane, at t = 0, m
    normal: Vector | None = None  # of a plane, out of the half space behind it
    radius: Positive | None = None  # m
    length: Positive | None = None  # m; of a capsule between the centres of its round ends
    axis: Vector | None = None
    size: Annotated[list[Positive], Field(min_length=2, max_length=3)] | None = None  # m, of a box
    rounding: Positive | None = None  # m, of the edges; default 5 % of the smallest radius or half side
    hollow: Flag = False  # the body is inside: a bowl, a container
    displacement: InTime[Vector] | None = None  # m
    velocity: InTime[Vector] | None = None  # m/s
    friction: NonNegative = 0.0  # Coulomb's coefficient

    @model_validator(mode="after")
    def _fits_its_shape(self) -> Obstacle:
        needed, allowed = OF_SHAPE[self.shape]
        given = [key for key in GEOMETRY if getattr(self, key) not in (None, False)]
        if missing := [key for key in needed if key not in given]:
            raise ValueError(f'shape = "{self.shape}" needs {" and ".join(missing)}')
        if beyond := [key for key in given if key not in (*needed, *allowed)]:
            raise ValueError(f'shape = "{self.shape}" has no {beyond[0]}; remove it')
        if self.displacement is not None and self.velocity is not None:
            raise ValueError("give displacement or velocity, not both")
        return self

    @property
    def geometry(self) -> dict[str, Any]:
        """What is given of the shape."""
        return {key: value for key in GEOMETRY if (value := getattr(self, key)) is not None}


class Contact(Table):
    """[contact]: of the body and its pieces with themselves; and how obstacles act."""

    itself: Flag = True  # false: obstacles alone
    friction: NonNegative = 0.0  # Coulomb's coefficient of the body with itself
    distance: Positive | None = None  # m, gap from which on it acts; default 3 % of the mean edge, obstacles 5 %
    stiffness: Positive | None = None  # Pa; default 3 % of Young's modulus, obstacles a tenth
    creep: Positive | None = None  # m/s, slip that passes for sticking; default 1e-3 of the body's size a second
