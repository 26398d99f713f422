"""Schema of [time], [[probe]] and [output]."""

from __future__ import annotations

import math
from dataclasses import MISSING, fields
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

from pydantic import Discriminator, Field, PrivateAttr, Tag, create_model, field_validator, model_validator

from ..forms.schemes import SCHEMES, BackwardEuler, Scheme
from .boundary_conditions import Selector
from .plugins import or_plugin
from .values import Finite, Flag, Name, NonNegative, OverTime, Positive, Seconds, StudyTable, TimeTable, Vector, key


class StopCriterion(StudyTable):
    """End of the run before `end`, when a load has fallen from its peak."""

    drop: Annotated[Finite, Field(gt=0, lt=1)] = key(
        "Share of the peak that the load has lost. With [fracture] it counts once an edge has broken; with cohesive "
        "cracks in quasi-static steps at once.", example=0.8,
    )  # fmt: skip
    of: str | None = key(
        "Name of a probe that records a reaction, or of an obstacle.", default=None, example="grip",
        otherwise="the only probe or obstacle",
    )  # fmt: skip
    above: NonNegative = key("Peaks below this force are ignored.", "N", default=0.0, example=10.0)


class BaseTimeSettings(StudyTable):
    """Time scheme and steps."""

    scheme: str = key(
        "Time scheme (`fracsim list`), or the name of a [plug-in](python.md#plug-ins).",
        default="generalized-alpha",
        example="generalized-alpha",
    )
    step: OverTime[Seconds] = key(
        "Time step; a table gives it for a step that begins at that time. An upper bound for explicit steps.", "s",
        example=5e-3,
    )  # fmt: skip
    end: Seconds = key("End of the run.", "s", example=0.4)
    adapt: Flag = key("Halve a step that fails, and lengthen steps again after easy ones.", default=True, example=False)
    smallest: Seconds | None = key(
        "Smallest step after halving.", "s", default=None, example=1e-5, otherwise="`time.step` / 1024"
    )
    breaking_step: Seconds | None = key(
        "A longer step in which edges break is repeated with half the length.", "s", default=None, example=1e-4
    )
    until: StopCriterion | None = key("Ends the run before `end`.", default=None)
    mass: Literal["lumped", "consistent"] = key("Mass matrix.", default="lumped", example="consistent")

    # time scheme of the user; None: that of `scheme`
    _user_scheme: Scheme | None = PrivateAttr(default=None)

    @property
    def scheme_object(self) -> Scheme:
        """The time scheme with its parameters."""
        return self._user_scheme or self.scheme_class(**self.scheme_parameters)

    def with_scheme(self, scheme: Scheme) -> BaseTimeSettings:
        """Returns the settings with a time scheme of the user."""
        settings = self.model_copy()
        settings._user_scheme = scheme
        return settings

    @property
    def scheme_class(self) -> type[Scheme]:
        """Class of the scheme."""
        if self._user_scheme is not None:
            return type(self._user_scheme)
        return SCHEMES.get(self.scheme, BackwardEuler)  # of a plug-in until it is made

    @property
    def max_step(self) -> float:
        """Longest step, s."""
        return max(self.step.value) if isinstance(self.step, TimeTable) else self.step

    @property
    def min_step(self) -> float:
        """Shortest step of the study, s."""
        return min(self.step.value) if isinstance(self.step, TimeTable) else self.step

    @property
    def has_constant_steps(self) -> bool:
        """True if all steps are equal, except those that fail or break edges. Explicit steps depend on the body."""
        return not isinstance(self.step, TimeTable) and (self.scheme_class.implicit or self.scheme == "rigid")

    @property
    def scheme_parameters(self) -> dict[str, float]:
        """Parameters of the scheme; the table has those of all schemes."""
        return {field.name: getattr(self, field.name) for field in fields(self.scheme_class)}

    @model_validator(mode="after")
    def _check_steps(self) -> BaseTimeSettings:
        if self.max_step > self.end:
            raise ValueError(f"step = {self.max_step:g} s is longer than the run: end = {self.end:g} s")
        if self.smallest is not None and self.smallest > self.min_step:
            raise ValueError(f"smallest = {self.smallest:g} s is longer than step = {self.min_step:g} s")
        if self.scheme == "rigid" and isinstance(self.step, TimeTable):
            raise ValueError('step of scheme = "rigid" is one number: bodies move by one step from start to end')
        if self.breaking_step is not None:
            self._check_breaking_step(self.breaking_step)
        self._check_other_parameters()
        self.scheme_object.check_parameters()
        if not self.scheme_class.implicit and self.mass == "consistent":
            raise ValueError('mass = "consistent" is for implicit schemes; explicit steps need mass = "lumped"')
        return self

    def _check_other_parameters(self) -> None:
        """Refuse parameters of other schemes; study.toml of a run has their defaults."""
        for name, owner in SCHEMES.items():
            for parameter in fields(owner):
                value = getattr(self, parameter.name)
                if parameter.name not in self.scheme_parameters and value != parameter.default:
                    raise ValueError(
                        f'{parameter.name} = {value:g} is of scheme = "{name}" and does nothing with '
                        f'scheme = "{self.scheme}": remove it, or choose that scheme'
                    )

    def _check_breaking_step(self, step: float) -> None:
        if not self.scheme_class.implicit:
            raise ValueError(f'breaking_step is for implicit and quasi-static steps, not scheme = "{self.scheme}"')
        smallest = self.smallest or self.min_step / 1024
        if not smallest <= step <= self.max_step:
            raise ValueError(
                f"breaking_step = {step:g} s must lie between smallest = {smallest:g} s and step = {self.max_step:g} s"
            )


def _keys_of_schemes() -> dict[str, Any]:
    """Returns key -> (type with its limits, default) for the parameters of all schemes.

    Raises:
        TypeError: if a parameter has no default, or two schemes give it different limits.
    """
    keys: dict[str, Any] = {}
    limits: dict[str, Any] = dict.fromkeys(BaseTimeSettings.model_fields)
    for scheme in SCHEMES.values():
        for parameter in fields(scheme):
            name, limit = parameter.name, (parameter.default, parameter.metadata)
            if parameter.default is MISSING:
                raise TypeError(f"{scheme.__name__}.{name} needs a default: [time] has it whichever the scheme is")
            if limits.setdefault(name, limit) != limit:
                raise TypeError(f"{scheme.__name__}.{name}: [time] has this key already, with other limits")
            keys[name] = Annotated[Finite, Field(**parameter.metadata)], parameter.default
    return keys


# mypy sees the common keys; the table that is validated also has the parameters of all schemes
if TYPE_CHECKING:
    TimeSettings = BaseTimeSettings
else:
    TimeSettings = create_model(
        "TimeSettings", __base__=BaseTimeSettings, __module__=__name__, __doc__=BaseTimeSettings.__doc__,
        scheme=(Annotated[Literal[tuple(SCHEMES)], or_plugin("schemes")], BaseTimeSettings.model_fields["scheme"]),
        **_keys_of_schemes(),
    )  # fmt: skip


class ProbeSettings(StudyTable):
    """A quantity that history.csv records in every step, at a point or over a group. Give either point or on."""

    name: Name = key(
        "Name in the columns of history.csv: reaction_NAME_x and motion_NAME_x (mean displacement) of a group, "
        "probe_NAME_x of a point, J_NAME_x of a contour.",
        example="grip",
    )  # fmt: skip
    point: Vector | None = key(
        "Position at rest; the nearest node is recorded.", "m", default=None, example=[0.4, 0.05, 0.05]
    )
    contour: Positive | None = key(
        "Radius around `point` of the ring of cells over which the J-integral is evaluated (quasi-static).", "m",
        default=None, example=0.01, otherwise="no J-integral",
    )  # fmt: skip
    on: Selector | None = key(
        "Name of a facet group, or a table that selects a box or a plane.", default=None, example="right"
    )
    record: Literal["displacement", "reaction"] | None = key(
        "Quantity.",
        default=None,
        example="displacement",
        otherwise="reaction and motion over `on`, displacement at `point`",
    )

    @model_validator(mode="after")
    def _one_place(self) -> ProbeSettings:
        if (self.point is None) == (self.on is None):
            raise ValueError("give either point or on")
        if self.point is not None and self.record == "reaction":
            raise ValueError("a reaction is summed over a group or selection: give on instead of point")
        if self.contour is not None and (self.point is None or self.record is not None):
            raise ValueError("contour is the radius of a J-integral around a point: give point, neither on nor record")
        return self

    @property
    def quantity(self) -> Literal["displacement", "reaction", "J"]:
        """The recorded quantity, with its default."""
        if self.contour is not None:
            return "J"
        return self.record or ("displacement" if self.point is not None else "reaction")


class FrameCount(NamedTuple):
    """Number of frames of a study without `output.every` and `output.interval`.

    Attributes:
        target: frames that are aimed at.
        minimum, maximum: bounds of a number of steps per frame that divides the number of constant steps, if any.
    """

    target: int = 50
    minimum: int = 34
    maximum: int = 75


FRAMES = FrameCount()


def frame_interval(timing: BaseTimeSettings, output: OutputSettings) -> float:
    """Returns the simulated time between two frames, s; 0 if `output.every` counts steps.

    With constant steps it is a whole number of them, so that frames are evenly spaced and films run smoothly. An
    interval shorter than a step is kept, and steps are shortened.
    """
    if output.every is not None:
        return 0.0
    interval = output.interval or timing.end / FRAMES.target
    step = timing.max_step
    if not timing.has_constant_steps:
        return interval
    if output.interval is None:
        return _steps_per_frame(math.ceil(timing.end / step * (1 - 1e-9))) * step
    return round(interval / step) * step if interval > step else interval


def frame_notes(timing: BaseTimeSettings, output: OutputSettings) -> list[str]:
    """Returns a note if frames are not as far apart as the study asks."""
    interval = frame_interval(timing, output)
    # round-off of the division by the step is no difference
    if output.interval is None or abs(interval - output.interval) <= 1e-6 * interval:
        return []
    steps = round(interval / timing.max_step)
    return [
        f"output.interval = {output.interval:g} s is no multiple of time.step = {timing.max_step:g} s: "
        f"there is a frame every {interval:g} s, {steps} step{'s'[: steps != 1]}, so that they are evenly spaced"
    ]


def _steps_per_frame(steps: int) -> int:
    """Steps per frame for a number of constant steps: a divisor if there is one, near the target number of frames."""
    # with many steps the last frame is too little early to be seen
    if steps > 100 * FRAMES.target:
        return round(steps / FRAMES.target)
    candidates = range(math.ceil(steps / FRAMES.maximum), max(1, steps // FRAMES.minimum) + 1)
    return min(candidates, key=lambda count: (steps % count > 0, abs(math.log(steps / count / FRAMES.target))))


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


LOOKS = ("plain", "bread", "porcelain", "glass", "jade", "granite", "steel", "wood")
Colour = Annotated[str, Field(pattern="^#[0-9a-fA-F]{6}$")]


class ColourSettings(StudyTable):
    """Colours of pictures, as "#rrggbb"."""

    skin: Colour = key("Colour of the boundary at rest.", example="#b9712c")
    inside: Colour = key("Colour of crack faces.", example="#f0deb6")


def _look(value: Any) -> str:
    """Tag of a look."""
    return "<colours>" if isinstance(value, dict | ColourSettings) else "<name>"


class OutputSettings(StudyTable):
    """Files of the output folder, and the time between frames."""

    every: Annotated[int, Field(ge=1, strict=True)] | None = key(
        "Steps between frames, in place of `interval`.", default=None, example=10
    )
    interval: Positive | None = key(
        "Time between frames. With constant steps it is rounded to a whole number of them.",
        "s", default=None, example=0.02,
        otherwise="about 50 frames",
    )  # fmt: skip
    fields: list[Literal[FIELDS]] | None = key(  # type: ignore[valid-type]
        "Fields of fields.xdmf beside the displacement.", default=None, example=["damage", "chi", "von_mises", "piece"]
    )
    surface: Flag | None = key(
        "Write the split surface and pieces.csv.", default=None, example=True,
        otherwise="with [fracture] or an [[obstacle]]",
    )  # fmt: skip
    cut: Literal["middle", "forces", "smooth"] | None = key(
        "Position at which broken edges are cut in the split surface: the middle, in inverse proportion to nodal "
        "forces, or such that cracks are smooth.",
        default=None, example="smooth", otherwise="smooth with a `look` and without contact, else middle",
    )  # fmt: skip
    precision: Literal["single", "double"] = key(
        "Precision of points and fields in fields.h5 and surface.pvd: 7 or 16 digits.",
        default="single",
        example="double",
    )
    picture: Flag = key("Write last.png, a picture of the last frame.", default=True, example=False)
    look: Annotated[
        Annotated[Literal[LOOKS], Tag("<name>")]  # type: ignore[valid-type]
        | Annotated[ColourSettings, Tag("<colours>")],
        Discriminator(_look),
    ] = key("Colours of pictures, by material or given.", default="plain", example="porcelain")
    checkpoint: Positive | None = key(
        "Wall time between checkpoints.", "s", default=None, example=600.0, otherwise="only when a run ends early"
    )

    @field_validator("fields")
    @classmethod
    def _no_duplicates(cls, fields: list[str] | None) -> list[str] | None:
        if duplicates := [name for name in fields or [] if (fields or []).count(name) > 1]:
            raise ValueError(f'"{duplicates[0]}" is given twice; name each field once')
        return fields

    @model_validator(mode="after")
    def _one_interval(self) -> OutputSettings:
        if self.every is not None and self.interval is not None:
            raise ValueError("give every (in steps) or interval (in s), not both")
        return self
