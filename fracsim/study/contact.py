"""[[obstacle]] and [contact]: what the body cannot pass through."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from .values import Finite, Flag, Name, NonNegative, OverTime, Positive, StudyTable, TimeTable, Vector

# shape -> (keys that it needs, keys that it may have)
OF_SHAPE: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "plane": (("normal",), ()),
    "sphere": (("radius",), ("hollow",)),
    "capsule": (("radius", "length", "axis"), ()),
    "cylinder": (("radius", "length", "axis"), ("rounding", "hollow")),
    "box": (("size",), ("rounding", "hollow")),
    "mesh": (("file",), ("scale",)),
}
GEOMETRY = ("normal", "radius", "length", "axis", "size", "rounding", "hollow", "file", "scale")


FREE = ("spin", "hinge", "guide")  # of a free obstacle alone


class HingeSettings(StudyTable):
    """What a free obstacle turns about: a point, in 3D an axis through it."""

    point: Vector  # m
    axis: Vector | None = None  # 3D


class ObstacleSettings(StudyTable):
    """[[obstacle]]: a rigid shape that is held, or driven by a displacement or a velocity; free where it has a mass."""

    name: Name
    shape: Literal["plane", "sphere", "capsule", "cylinder", "box", "mesh"]
    at: Vector  # its centre, a point of the plane, or where the file has its origin, at t = 0, m
    normal: Vector | None = None  # of a plane, out of the half space behind it
    radius: Positive | None = None  # m
    length: Positive | None = None  # m; of a capsule between the centres of its round ends
    axis: Vector | None = None
    size: Annotated[list[Positive], Field(min_length=2, max_length=3)] | None = None  # m, of a box
    rounding: Positive | None = None  # m, of the edges; default 5 % of the smallest radius or half side
    file: Path | None = None  # of a mesh: a closed surface of triangles (STL, OBJ, PLY, ...)
    scale: Positive | None = None  # of a mesh: metres for each unit of length of the file; default 1
    hollow: Flag = False  # the body is inside: a bowl, a container
    displacement: OverTime[Vector] | None = None  # m
    velocity: OverTime[Vector] | None = None  # m/s; of a free obstacle at the start
    mass: Positive | None = None  # kg (2D: of material.thickness, or of 1 m): it moves freely
    density: Positive | None = None  # kg/m^3, in place of the mass
    # rad/s at the start, if free; of a mesh that is held or driven all along, about `at`
    spin: Annotated[list[Finite], Field(min_length=1, max_length=3)] | None = None
    hinge: HingeSettings | None = None  # free to turn about it
    guide: Annotated[str, Field(pattern="^[xyz]+$")] | None = None  # free to move along these axes, without turning
    friction: NonNegative = 0.0  # Coulomb's coefficient

    @model_validator(mode="after")
    def _fits_its_shape(self) -> ObstacleSettings:
        needed, allowed = OF_SHAPE[self.shape]
        given = [key for key in GEOMETRY if getattr(self, key) not in (None, False)]
        if missing := [key for key in needed if key not in given]:
            raise ValueError(f'shape = "{self.shape}" needs {" and ".join(missing)}')
        if beyond := [key for key in given if key not in (*needed, *allowed)]:
            raise ValueError(f'shape = "{self.shape}" has no {beyond[0]}; remove it')
        if self.displacement is not None and self.velocity is not None:
            raise ValueError("give displacement or velocity, not both")
        return self

    @model_validator(mode="after")
    def _is_free_or_not(self) -> ObstacleSettings:
        if not self.is_free:
            given = [key for key in FREE if getattr(self, key) is not None]
            if given and not (self.shape == "mesh" and given == ["spin"]):
                raise ValueError(f"{given[0]} is for an obstacle that moves freely: give mass or density, or remove it")
            return self
        if self.mass is not None and self.density is not None:
            raise ValueError("give mass or density, not both")
        if self.shape == "plane":
            raise ValueError("a plane is a half space without end, so it cannot move freely: remove mass and density")
        if self.hollow:
            raise ValueError(f"a hollow {self.shape} has walls without thickness, so it cannot move freely: hold it")
        if self.displacement is not None:
            raise ValueError("it is driven by displacement and, with a mass, free: give one or the other")
        if isinstance(self.velocity, TimeTable):
            raise ValueError("the velocity of a free obstacle is the one it starts with: give one vector, not a table")
        return self

    @model_validator(mode="after")
    def _is_held_in_one_way(self) -> ObstacleSettings:
        if self.hinge is not None and self.guide is not None:
            raise ValueError("give hinge or guide, not both")
        if self.hinge is not None and self.velocity is not None:
            raise ValueError("on a hinge its velocity follows from the spin: give spin alone")
        if self.guide is not None and self.spin is not None:
            raise ValueError("along a guide it does not turn: remove spin")
        return self

    @property
    def is_free(self) -> bool:
        """Whether it moves by itself."""
        return self.mass is not None or self.density is not None

    @property
    def geometry(self) -> dict[str, Any]:
        """What is given of the shape."""
        return {key: value for key in GEOMETRY if (value := getattr(self, key)) is not None}


class ContactSettings(StudyTable):
    """[contact]: of the body and its pieces with themselves; and how obstacles act."""

    # false: obstacles alone; "pieces": not the cracks inside a piece, nor crumbs that have lost their last whole cell
    itself: Flag | Literal["pieces"] = True
    friction: NonNegative = 0.0  # Coulomb's coefficient of the body with itself
    distance: Positive | None = None  # m, gap from which on it acts; default 3 % of the mean edge, obstacles 5 %
    stiffness: Positive | None = None  # Pa; default 0.3 of Young's modulus, obstacles a tenth
    restitution: Annotated[Finite, Field(ge=0, lt=1)] | None = None  # of rigid bodies; default 0
    contact_time: Positive | None = None  # s that a blow on a rigid body lasts; default: Hertz's, from its speed
    creep: Positive | None = None  # m/s, slip that passes for sticking; default 1e-3 of the size, 0.05 of the speed
