"""Reading a study file into a `Study`, with messages a user can act on; writing it back with every default."""

from __future__ import annotations

import difflib
import json
import tomllib
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, get_args

from pydantic import BaseModel, ValidationError

from .errors import InputError
from .study import Study

# parts of a pydantic location that name a branch of a union, not a key of the file
_BRANCHES = {"constant", "table", "group", "box", "plane"}


def load_study(path: Path, overrides: Sequence[str] = ()) -> Study:
    """Read, override (`key.path=value`) and validate. Raises InputError with one message."""
    data = _parse(path)
    for override in overrides:
        _apply(data, override)
    return validate(data, str(path))


def validate(data: dict[str, Any], name: str) -> Study:
    """Build the Study; the first thing that is wrong becomes the message."""
    try:
        study = Study.model_validate(data)
    except ValidationError as error:
        raise InputError(f"{name}: {explain(error.errors()[0])}") from None
    return study


def study_text(study: Study, comments: Iterable[str] = ()) -> str:
    """The study as TOML with every default written out, `comments` first."""
    import tomli_w

    data = study.model_dump(mode="json", exclude_none=True)
    data["material"] |= data["material"].pop("regions")
    return "".join(f"# {line}\n" for line in comments) + tomli_w.dumps(_keep_infinity(data, study))


def _keep_infinity(data: dict[str, Any], study: Study) -> dict[str, Any]:
    # JSON has no infinity and pydantic writes null; TOML has one
    if study.fracture is not None and study.fracture.strength == float("inf"):
        data["fracture"]["strength"] = float("inf")
    return data


def _parse(path: Path) -> dict[str, Any]:
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise InputError(f"there is no study file {path}; `fracsim list` shows those that come with fracsim") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read the study file {path}: {error}") from None
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path} is not TOML: {error}") from None


def _apply(data: dict[str, Any], override: str) -> None:
    key, equals, text = override.partition("=")
    if not equals or not key:
        raise InputError(f"--set {override}: write key.path=value, for example --set time.step=1e-3")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = text
    *path, last = key.strip().split(".")
    place: Any = data
    for part in path:
        place = _descend(place, part, override)
    if isinstance(place, list):
        place[_index(place, last, override)] = value
    else:
        place[last] = value


def _descend(place: Any, part: str, override: str) -> Any:
    if isinstance(place, list):
        return place[_index(place, part, override)]
    inner = place.setdefault(part, {})
    if not isinstance(inner, dict | list):
        raise InputError(f"--set {override}: {part} is a value, not a table")
    return inner


def _index(place: list[Any], part: str, override: str) -> int:
    if not part.isdigit() or int(part) >= len(place):
        raise InputError(f"--set {override}: {part} is not an entry; there are {len(place)}, counted from 0")
    return int(part)


# --- messages -------------------------------------------------------------------------------------------------------


def explain(error: Any) -> str:
    """One sentence for one of pydantic's errors: the key, the value, what is allowed."""
    location = [part for part in error["loc"] if part not in _BRANCHES]
    where = ".".join(map(str, location))
    if error["type"] == "extra_forbidden":
        return _unknown(where, location[-1], _known_keys(location[:-1]))
    if error["type"] == "missing":
        return f"{where} is missing{_needed_in(location)}"
    message = _sentence(error["msg"])
    if error["type"] == "value_error":
        return f"{_table_name(location)}{message}"
    return f"{where} = {_show(error['input'])}: {message}"


def _unknown(where: str, key: Any, known: list[str]) -> str:
    near = difflib.get_close_matches(str(key), known, n=1, cutoff=0.5)
    hint = f"did you mean {near[0]}?" if near else f"known here: {', '.join(known)}"
    return f"{where} is not a known key; {hint}"


def _needed_in(location: list[Any]) -> str:
    return f"; the table [{'.'.join(map(str, location[:-1]))}] needs it" if location[:-1] else "; every study needs it"


def _table_name(location: list[Any]) -> str:
    return f"{'.'.join(map(str, location))}: " if location else ""


def _sentence(message: str) -> str:
    text = message.removeprefix("Value error, ").removeprefix("Input ")
    return text.replace("should be", "must be").replace("should match pattern '^[xyz]+$'", "must be made of x, y, z")


def _show(value: Any) -> str:
    text = json.dumps(value, default=str)
    return text if len(text) <= 60 else text[:57] + "..."


def _known_keys(location: list[Any]) -> list[str]:
    """The keys allowed at a place of the study file, found by walking the schema."""
    models: list[type[BaseModel]] = [Study]
    for part in location:
        if isinstance(part, int):
            continue
        inner = [m for model in models for m in _models_in(model.model_fields.get(part))]
        models = inner or [m for model in models for m in _models_in(model.model_fields.get("regions"))]
    return sorted({key for model in models for key in model.model_fields if key != "regions"})


def _models_in(field: Any) -> list[type[BaseModel]]:
    def walk(annotation: Any) -> list[type[BaseModel]]:
        if isinstance(annotation, type) and issubclass(annotation, BaseModel):
            return [annotation]
        inner = [found for argument in get_args(annotation) for found in walk(argument)]
        return inner or walk(annotation.__value__) if hasattr(annotation, "__value__") else inner

    return walk(field.annotation) if field is not None else []
