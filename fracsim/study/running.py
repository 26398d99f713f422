"""[time], [[probe]] and [output]: how a study is run, and what is kept of it."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator, model_validator

from .loading import Where
from .values import Finite, Flag, Positive, Seconds, Table, Vector


class Time(Table):
    """[time]: scheme and steps."""

    scheme: Literal["backward-euler", "newmark", "generalized-alpha", "explicit", "quasi-static"] = "generalized-alpha"
    step: Seconds  # s
    end: Seconds  # s
    adapt: Flag = True  # halve a step that fails, grow back after easy ones
    smallest: Seconds | None = None  # s; default step / 1024
    mass: Literal["lumped", "consistent"] = "lumped"
    beta: Annotated[Finite, Field(gt=0, le=0.5)] = 0.25  # Newmark
    gamma: Annotated[Finite, Field(ge=0.5, le=1)] = 0.5  # Newmark
    rho: Annotated[Finite, Field(ge=0, le=1)] = 0.8  # generalized-alpha: what is left of the fastest modes after a step

    @model_validator(mode="after")
    def _order(self) -> Time:
        if self.step > self.end:
            raise ValueError(f"step = {self.step:g} s is longer than the run: end = {self.end:g} s")
        if self.smallest is not None and self.smallest > self.step:
            raise ValueError(f"smallest = {self.smallest:g} s is longer than step = {self.step:g} s")
        if self.scheme == "newmark" and 4 * self.beta < self.gamma + 0.5 - 1e-12:
            raise ValueError("newmark is stable for every step where beta >= (gamma + 1/2) / 4; raise beta")
        if self.scheme == "explicit" and self.mass == "consistent":
            raise ValueError('mass = "consistent" is for implicit schemes; explicit steps need mass = "lumped"')
        return self


class Probe(Table):
    """[[probe]]: what history.csv records at a point (nearest node) or over a group."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9-]*$")]
    point: Vector | None = None  # m, reference configuration
    on: Where | None = None
    record: Literal["displacement", "reaction"] | None = None  # default: reaction over a group, displacement at a point

    @model_validator(mode="after")
    def _place(self) -> Probe:
        if (self.point is None) == (self.on is None):
            raise ValueError("give either point or on")
        if self.point is not None and self.record == "reaction":
            raise ValueError("a reaction is summed over a group or selection: give on instead of point")
        return self

    @property
    def quantity(self) -> str:
        """What is recorded."""
        return self.record or ("displacement" if self.point is not None else "reaction")


FIELDS = (
    "velocity",
    "damage",
    "chi",
    "piece",
    "stress",
    "von_mises",
    "energy_density",
    "strain",
    "region",
    "plastic_strain",
)
FRACTURE_FIELDS = ("damage", "chi", "piece")


class Output(Table):
    """[output]: what is written, and how often."""

    every: Annotated[int, Field(ge=1, strict=True)] | None = None  # steps
    interval: Positive | None = None  # s
    fields: list[Literal[FIELDS]] | None = None  # type: ignore[valid-type]
    surface: Flag | None = None  # the split surface and pieces.csv; default: where the study has [fracture]
    cut: Literal["middle", "forces"] = "middle"  # where broken edges are cut: in proportion to the nodal forces
    picture: Flag = True  # a PNG of the last frame
    checkpoint: Positive | None = None  # s of wall time between checkpoints; default: only where a run ends early

    @field_validator("fields")
    @classmethod
    def _each_once(cls, fields: list[str] | None) -> list[str] | None:
        if twice := [name for name in fields or [] if (fields or []).count(name) > 1]:
            raise ValueError(f'"{twice[0]}" is given twice; name each field once')
        return fields

    @model_validator(mode="after")
    def _one_clock(self) -> Output:
        if self.every is not None and self.interval is not None:
            raise ValueError("give every (in steps) or interval (in s), not both")
        return self
