"""Types of the values of keys: numbers in SI units, vectors, functions of time, and `key`, which documents a key."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, Any, Literal

# The search for plugins in all packages and the check of schemas by pydantic take a tenth of a second.
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
os.environ.setdefault("PYDANTIC_SKIP_VALIDATING_CORE_SCHEMAS", "1")

from annotated_types import Ge, Gt, Len, Lt
from pydantic import (
    AfterValidator,
    AllowInfNan,
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Strict,
    StringConstraints,
    Tag,
    model_validator,
)
from pydantic_core.core_schema import no_info_plain_validator_function

# Strict: "3" is not accepted for 3, nor true for 1. Tags of unions are in <>: they name no key of the file.
# No Field() in types: it would be shared by all keys of a type, and the default of one would become that of all.
# Bounds of given numbers in any unit: products of a few of them stay within double precision.
MAX_MAGNITUDE, MIN_POSITIVE = 1e50, 1e-50


def _not_too_large(value: float) -> float:
    # types that do not accept inf refuse it themselves
    if abs(value) > MAX_MAGNITUDE and not math.isinf(value):
        raise ValueError(f"{value:g} is out of reach; allowed are {-MAX_MAGNITUDE:g} to {MAX_MAGNITUDE:g}")
    return value


def _not_too_small(value: float) -> float:
    if 0 < value < MIN_POSITIVE:
        raise ValueError(f"{value:g} is out of reach; allowed are {MIN_POSITIVE:g} to {MAX_MAGNITUDE:g}")
    return value


Finite = Annotated[float, Strict(), AllowInfNan(False), AfterValidator(_not_too_large)]
# bounds stand before validators: otherwise the JSON schema is without them
Positive = Annotated[
    float, Strict(), AllowInfNan(False), Gt(0), AfterValidator(_not_too_large), AfterValidator(_not_too_small)
]
NonNegative = Annotated[float, Strict(), AllowInfNan(False), Ge(0), AfterValidator(_not_too_large)]
# may be inf: never breaks, never yields, yields at once
Unbounded = Annotated[float, Strict(), Gt(0), AfterValidator(_not_too_small), AfterValidator(_not_too_large)]
Strength = Unbounded  # Pa
Poisson = Annotated[float, Strict(), AllowInfNan(False), Gt(-1), Lt(0.5)]
Seed = Annotated[int, Strict(), Ge(0)]
Flag = Annotated[bool, Strict()]
Vector = Annotated[list[Finite], Len(2, 3)]
# Letters of the name of an obstacle or probe, which is part of names of files (255 letters), columns and arrays.
Name = Annotated[str, StringConstraints(pattern="^[A-Za-z][A-Za-z0-9-]*$", max_length=64)]


def _within_reach(time: float) -> float:
    """Check that divisions by the square of a time stay within double precision."""
    if not 1e-30 <= time <= 1e30:
        raise ValueError(f"{time:g} s is out of reach; allowed are 1e-30 to 1e30 s")
    return time


Seconds = Annotated[float, Strict(), AllowInfNan(False), Gt(0), AfterValidator(_within_reach)]


def _kind(value: Any) -> str:
    """Tag of a component of a motion."""
    return "<word>" if isinstance(value, str) else "<number>"


Component = Annotated[
    Annotated[Finite, Tag("<number>")] | Annotated[Literal["free"], Tag("<word>")], Discriminator(_kind)
]
Motion = Annotated[list[Component], Len(2, 3)]


class StudyTable(BaseModel):
    """Base of the tables of a study file. Unknown keys are refused, values cannot be changed."""

    model_config = ConfigDict(extra="forbid", frozen=True, ser_json_inf_nan="constants", defer_build=True)


def key(
    description: str,
    unit: str = "",
    *,
    default: Any = ...,
    example: Any = None,
    otherwise: str = "",
    factory: Callable[[], Any] | None = None,
) -> Any:
    """Declare a key of the study file with its documentation.

    The page docs/study-file.md is written from it, and a JSON schema has the same texts.

    Args:
        description: one or more sentences on the meaning of the key.
        unit: of its values; empty where they have none.
        default: of the key; without one the key is required.
        example: a valid value.
        otherwise: what applies if a key whose default is None is left out.
        factory: makes the default, where it is a list or a table.
    """
    options: dict[str, Any] = {"default": default} if factory is None else {"default_factory": factory}
    return Field(
        description=description,
        examples=[] if example is None else [example],
        json_schema_extra={"unit": unit, "otherwise": otherwise},
        **options,
    )


class _DeferredSchema:
    """Marks a table whose validator is built when a study has the table.

    Building the validators of all tables takes as long as reading a study.
    """

    def __get_pydantic_core_schema__(self, source: type[BaseModel], handler: Any) -> Any:
        def json_schema(_: Any, describe: Any) -> Any:
            """JSON schema of the table, whose validator is built for it."""
            source.model_rebuild()
            return describe(source.__pydantic_core_schema__)

        metadata = {"pydantic_js_functions": [json_schema]}
        return no_info_plain_validator_function(source.model_validate, metadata=metadata)


if TYPE_CHECKING:
    type Deferred[Model] = Model
else:
    type Deferred[Model] = Annotated[Model, _DeferredSchema()]


class TimeTable[Value](StudyTable):
    """Values at increasing times, linear in between and constant outside."""

    time: Annotated[list[Finite], Len(1)] = key("Increasing times.", "s", example=[0.0, 0.4])
    value: list[Value] = key("One value for each time.")

    @model_validator(mode="after")
    def _increasing(self) -> TimeTable[Value]:
        if len(self.time) != len(self.value):
            raise ValueError(f"{len(self.time)} times but {len(self.value)} values; give one value for each time")
        if any(b <= a for a, b in zip(self.time, self.time[1:], strict=False)):
            raise ValueError("times must increase")
        return self


def _shape(value: Any) -> str:
    """Tag of a value that may be constant or tabulated."""
    return "<table>" if isinstance(value, dict | TimeTable) else "<constant>"


if TYPE_CHECKING:
    type OverTime[Value] = Value | TimeTable[Value]
else:
    type OverTime[Value] = Annotated[
        Annotated[Value, Tag("<constant>")] | Annotated[TimeTable[Value], Tag("<table>")], Discriminator(_shape)
    ]
