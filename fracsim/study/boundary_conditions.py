"""Schema of [[boundary]], [load] and [initial], and of the selectors of nodes and facets."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Discriminator, Field, Tag, model_validator

from .values import Finite, Motion, OverTime, Positive, StudyTable, Vector, key


class BoxSelector(StudyTable):
    """Nodes inside a box. Loads act on facets all of whose nodes are inside."""

    box: Annotated[list[Vector], Field(min_length=2, max_length=2)] = key(
        "Lower and upper corner.", "m", example=[[0.0, 0.0], [0.1, 0.02]]
    )

    @model_validator(mode="after")
    def _corners_are_ordered(self) -> BoxSelector:
        lower, upper = self.box
        if any(a > b for a, b in zip(lower, upper, strict=False)):
            raise ValueError(f"box = {self.box}: give the lower corner first, then the upper one")
        return self


class PlaneSelector(StudyTable):
    """Nodes on a plane. Loads act on facets all of whose nodes are on it."""

    point: Vector = key("A point of the plane.", "m", example=[0.0, 0.05])
    normal: Vector = key("Normal of the plane, of any length.", example=[0.0, 1.0])
    within: Positive | None = key(
        "Greatest distance of a node from the plane.",
        "m",
        default=None,
        example=1e-6,
        otherwise="1e-6 of the body's size",
    )


def _selector(value: Any) -> str:
    """Tag of a selector in the union: a group's name, a box or a plane."""
    if isinstance(value, BoxSelector) or (isinstance(value, dict) and "box" in value):
        return "<box>"
    return "<plane>" if isinstance(value, dict | PlaneSelector) else "<group>"


Selector = Annotated[
    Annotated[str, Tag("<group>")] | Annotated[BoxSelector, Tag("<box>")] | Annotated[PlaneSelector, Tag("<plane>")],
    Discriminator(_selector),
]


class BoundarySettings(StudyTable):
    """A boundary condition on a facet group, a box or a plane.

    Give exactly one of fix, displacement, velocity, traction, force and pressure. Conditions that contradict each other
    at the same place are refused. Where two motions share some nodes only, the later one holds there, and a note says
    so.
    """

    on: Selector = key("Name of a facet group, or a table that selects a box or a plane.", example="left")
    fix: Annotated[str, Field(pattern="^[xyz]+$")] | None = key(
        "Components of the displacement that are held at zero.", default=None, example="xyz"
    )
    displacement: OverTime[Motion] | None = key(
        'Prescribed displacement. "free" leaves a component free.', "m", default=None,
        example={"time": [0.0, 0.4], "value": [[0.0, "free", 0.0], [0.2, "free", 0.0]]},
    )  # fmt: skip
    velocity: OverTime[Motion] | None = key(
        'Prescribed velocity. "free" leaves a component free.', "m/s", default=None, example=[0.5, "free", 0.0]
    )
    traction: OverTime[Vector] | None = key("Force per area at rest.", "Pa", default=None, example=[0.0, 0.0, -1e3])
    force: OverTime[Vector] | None = key(
        "Resultant force, distributed uniformly over the area at rest; in 2D on `material.thickness`.",
        "N", default=None,
        example=[0.0, 0.0, -100.0],
    )  # fmt: skip
    pressure: OverTime[Finite] | None = key(
        "Pressure that follows the surface; positive values push.", "Pa", default=None, example=1e4
    )

    @model_validator(mode="after")
    def _one_condition(self) -> BoundarySettings:
        if len(present := self._present()) != 1:
            kinds = ", ".join(CONDITIONS)
            raise ValueError(f"give exactly one of {kinds}; found {' and '.join(present) or 'none'}")
        return self

    def _present(self) -> list[str]:
        return [name for name in CONDITIONS if getattr(self, name) is not None]

    @property
    def kind(self) -> str:
        """Name of the condition, one of `CONDITIONS`."""
        return self._present()[0]


CONDITIONS = ("fix", "displacement", "velocity", "traction", "force", "pressure")
MOTIONS = ("fix", "displacement", "velocity")


class LoadSettings(StudyTable):
    """Forces on the volume of the body."""

    gravity: Vector | None = key("Acceleration of gravity.", "m/s^2", default=None, example=[0.0, 0.0, -9.81])
    body_force: OverTime[Vector] | None = key(
        "Force per volume at rest.", "N/m^3", default=None, example=[0.0, 0.0, -1e3]
    )


class InitialSettings(StudyTable):
    """Velocity at the start, v = velocity + spin x (X - centre of mass)."""

    velocity: Vector | None = key("Translational velocity.", "m/s", default=None, example=[0.0, 0.0, -2.0])
    spin: Annotated[list[Finite], Field(min_length=1, max_length=3)] | None = key(
        "Angular velocity about the centre of mass; one number in 2D.", "rad/s", default=None, example=[0.0, 0.0, 1.0]
    )
