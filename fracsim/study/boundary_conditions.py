"""[[boundary]], [load] and [initial], and the places that they act on."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Discriminator, Field, Tag, model_validator

from .values import Finite, Motion, OverTime, Positive, StudyTable, Vector


class BoxSelector(StudyTable):
    """Nodes inside a box (m)."""

    box: Annotated[list[Vector], Field(min_length=2, max_length=2)]

    @model_validator(mode="after")
    def _corners(self) -> BoxSelector:
        lower, upper = self.box
        if any(a > b for a, b in zip(lower, upper, strict=False)):
            raise ValueError(f"box = {self.box}: give the lower corner first, then the upper one")
        return self


class PlaneSelector(StudyTable):
    """Nodes on a plane, within `within` (m; default 1e-6 of the body's size)."""

    point: Vector
    normal: Vector
    within: Positive | None = None


def _selector(value: Any) -> str:
    """Tag of a place: a group's name, a box or a plane."""
    if isinstance(value, BoxSelector) or (isinstance(value, dict) and "box" in value):
        return "<box>"
    return "<plane>" if isinstance(value, dict | PlaneSelector) else "<group>"


Selector = Annotated[
    Annotated[str, Tag("<group>")] | Annotated[BoxSelector, Tag("<box>")] | Annotated[PlaneSelector, Tag("<plane>")],
    Discriminator(_selector),
]


class BoundarySettings(StudyTable):
    """[[boundary]]: one condition on a group of facets, a box or a plane. Give exactly one of the kinds."""

    on: Selector
    fix: Annotated[str, Field(pattern="^[xyz]+$")] | None = None  # components held at zero
    displacement: OverTime[Motion] | None = None  # m; "free" leaves a component alone
    velocity: OverTime[Motion] | None = None  # m/s
    traction: OverTime[Vector] | None = None  # Pa of the reference area
    force: OverTime[Vector] | None = (
        None  # N in all, spread evenly over the reference area; 2D: on `material.thickness`
    )
    pressure: OverTime[Finite] | None = None  # Pa, pushes where > 0, follows the surface

    @model_validator(mode="after")
    def _one_condition(self) -> BoundarySettings:
        if len(given := self._given()) != 1:
            kinds = ", ".join(CONDITIONS)
            raise ValueError(f"give exactly one of {kinds}; found {' and '.join(given) or 'none'}")
        return self

    def _given(self) -> list[str]:
        return [key for key in CONDITIONS if getattr(self, key) is not None]

    @property
    def kind(self) -> str:
        """Which of the conditions it is."""
        return self._given()[0]


CONDITIONS = ("fix", "displacement", "velocity", "traction", "force", "pressure")
MOTIONS = ("fix", "displacement", "velocity")


class LoadSettings(StudyTable):
    """[load]: forces on the whole body."""

    gravity: Vector | None = None  # m/s^2
    body_force: OverTime[Vector] | None = None  # N/m^3


class InitialSettings(StudyTable):
    """[initial]: velocity at the start, v = velocity + spin x (X - centre of mass)."""

    velocity: Vector | None = None  # m/s
    spin: Annotated[list[Finite], Field(min_length=1, max_length=3)] | None = None  # rad/s; one number in 2D
