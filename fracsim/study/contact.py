"""Schema of [[obstacle]] and [contact]."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from .values import Finite, Flag, Name, NonNegative, OverTime, Positive, StudyTable, TimeTable, Vector, key

# shape -> (required keys, optional keys)
SHAPE_KEYS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "plane": (("normal",), ()),
    "sphere": (("radius",), ("hollow",)),
    "capsule": (("radius", "length", "axis"), ()),
    "cylinder": (("radius", "length", "axis"), ("rounding", "hollow")),
    "box": (("size",), ("rounding", "hollow")),
    "mesh": (("file",), ("scale",)),
}
GEOMETRY = ("normal", "radius", "length", "axis", "size", "rounding", "hollow", "file", "scale")
FREE = ("spin", "hinge", "guide")  # keys of free obstacles


class HingeSettings(StudyTable):
    """Hinge of a free obstacle: a point, in 3D an axis through it."""

    point: Vector = key("A point of the axis of rotation.", "m", example=[0.0, 0.0, 0.5])
    axis: Vector | None = key("Direction of the axis, in 3D.", default=None, example=[0.0, 1.0, 0.0])


class ObstacleSettings(StudyTable):
    """A rigid obstacle that the body cannot penetrate.

    It is fixed, driven by a displacement or velocity, or free with a mass.
    """

    name: Name = key(
        "Name in the columns of history.csv: contact_NAME_x (force on it), gap_NAME, work_NAME, ...", example="hammer"
    )
    shape: Literal["plane", "sphere", "capsule", "cylinder", "box", "mesh"] = key(
        "plane (`normal`), sphere (`radius`), capsule or cylinder (`radius`, `length`, `axis`), box (`size`), or a "
        "closed surface from a file (`file`, 3D).",
        example="sphere",
    )  # fmt: skip
    at: Vector = key(
        "Position at t = 0: the centre, a point of the plane, or the origin of the file.", "m", example=[0.0, 0.0, 0.5]
    )
    normal: Vector | None = key(
        "Normal of a plane, out of the half space behind it.", default=None, example=[0.0, 0.0, 1.0]
    )
    radius: Positive | None = key("Radius of a sphere, capsule or cylinder.", "m", default=None, example=0.05)
    length: Positive | None = key(
        "Length of a cylinder; of a capsule between the centres of its ends.", "m", default=None, example=0.2
    )
    axis: Vector | None = key("Axis of a capsule or cylinder.", default=None, example=[0.0, 1.0, 0.0])
    size: Annotated[list[Positive], Field(min_length=2, max_length=3)] | None = key(
        "Side lengths of a box.", "m", default=None, example=[0.1, 0.1, 0.2]
    )
    rounding: Positive | None = key(
        "Radius of the edges of a box or cylinder.", "m", default=None, example=0.005,
        otherwise="5 % of the smallest radius or half side",
    )  # fmt: skip
    file: Path | None = key(
        "Path of a closed surface of triangles (STL, OBJ, PLY, ...).", default=None, example="hammer.stl"
    )
    scale: Positive | None = key(
        "Metres per unit of length of the file.", "m", default=None, example=1e-3, otherwise="1"
    )
    hollow: Flag = key("The body is inside a sphere, cylinder or box.", default=False, example=True)
    displacement: OverTime[Vector] | None = key(
        "Prescribed displacement.", "m", default=None,
        example={"time": [0.0, 0.1], "value": [[0.0, 0.0, 0.0], [0.0, 0.0, -0.02]]},
    )  # fmt: skip
    velocity: OverTime[Vector] | None = key(
        "Prescribed velocity; of a free obstacle its velocity at the start.",
        "m/s",
        default=None,
        example=[0.0, 0.0, -3.0],
    )
    mass: Positive | None = key(
        "Mass of an obstacle that moves freely; in 2D of `material.thickness`.", "kg", default=None, example=2.0
    )
    density: Positive | None = key("Density, in place of the mass.", "kg/m^3", default=None, example=7800.0)
    spin: Annotated[list[Finite], Field(min_length=1, max_length=3)] | None = key(
        "Angular velocity: of a free obstacle at the start (one number in 2D and on a hinge); of a fixed or driven "
        "obstacle from a file at all times, about `at`.",
        "rad/s", default=None, example=[0.0, 0.0, 1.0],
    )  # fmt: skip
    hinge: HingeSettings | None = key("Axis about which a free obstacle turns.", default=None)
    guide: Annotated[str, Field(pattern="^[xyz]+$")] | None = key(
        "Axes along which a free obstacle moves without rotation.", default=None, example="z"
    )
    friction: NonNegative = key("Coulomb's coefficient of friction.", default=0.0, example=0.3)

    @model_validator(mode="after")
    def _has_the_keys_of_its_shape(self) -> ObstacleSettings:
        needed, allowed = SHAPE_KEYS[self.shape]
        present = [name for name in GEOMETRY if getattr(self, name) not in (None, False)]
        if missing := [name for name in needed if name not in present]:
            raise ValueError(f'shape = "{self.shape}" needs {" and ".join(missing)}')
        if excess := [name for name in present if name not in (*needed, *allowed)]:
            raise ValueError(f'shape = "{self.shape}" has no {excess[0]}; remove it')
        if self.displacement is not None and self.velocity is not None:
            raise ValueError("give displacement or velocity, not both")
        return self

    @model_validator(mode="after")
    def _keys_of_free_obstacles(self) -> ObstacleSettings:
        if not self.is_free:
            present = [name for name in FREE if getattr(self, name) is not None]
            if present and not (self.shape == "mesh" and present == ["spin"]):
                raise ValueError(
                    f"{present[0]} is for an obstacle that moves freely: give mass or density, or remove it"
                )
            return self
        # from here on the obstacle is free
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
    def _one_constraint(self) -> ObstacleSettings:
        if self.hinge is not None and self.guide is not None:
            raise ValueError("give hinge or guide, not both")
        if self.hinge is not None and self.velocity is not None:
            raise ValueError("on a hinge its velocity follows from the spin: give spin alone")
        if self.guide is not None and self.spin is not None:
            raise ValueError("along a guide it does not turn: remove spin")
        return self

    @property
    def is_free(self) -> bool:
        """True if the obstacle has a mass or density."""
        return self.mass is not None or self.density is not None

    @property
    def geometry(self) -> dict[str, Any]:
        """Keys of the shape that are given."""
        return {name: value for name in GEOMETRY if (value := getattr(self, name)) is not None}


class ContactSettings(StudyTable):
    """Contact of the body with itself and of its fragments with each other.

    The table also has the parameters of contact with obstacles and of rigid bodies.
    """

    itself: Flag | Literal["pieces"] = key(
        'true: the body with itself. "pieces": fragments with each other, without cracks inside a fragment and nodes '
        'without an unsplit cell, in a fraction of the time. false: obstacles only.',
        default=True, example="pieces",
    )  # fmt: skip
    friction: NonNegative = key("Coulomb's coefficient of the body with itself.", default=0.0, example=0.3)
    distance: Positive | None = key(
        "Gap below which contact acts. Obstacles that start nearer are moved back.", "m", default=None, example=1e-4,
        otherwise="3 % of the mean edge, at most half the least gap at rest; for obstacles 5 %",
    )  # fmt: skip
    stiffness: Positive | None = key(
        "Contact stiffness. It is raised where a gap falls below 0.3 % of the distance.",
        "Pa", default=None, example=1e5,
        otherwise="0.3 of Young's modulus, for obstacles a tenth of it",
    )  # fmt: skip
    restitution: Annotated[Finite, Field(ge=0, lt=1)] | None = key(
        "Coefficient of restitution of rigid bodies.", default=None, example=0.2, otherwise="0"
    )
    contact_time: Positive | None = key(
        "Duration of an impact on a rigid body.", "s", default=None, example=1e-3, otherwise="Hertz's contact time"
    )
    creep: Positive | None = key(
        "Sliding speed below which friction counts as sticking.", "m/s", default=None, example=1e-3,
        otherwise="1e-3 of the body's size per second, or per run if that is longer; at least 0.05 of the speed of "
        "fragments, and of the largest sliding speed at an obstacle",
    )  # fmt: skip
