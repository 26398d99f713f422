"""Reading a study file into a `Study`, with messages a user can act on; writing it back with every default."""

from __future__ import annotations

import os
import tomllib
from collections.abc import Iterable, Sequence
from copy import deepcopy
from dataclasses import asdict
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from ..errors import InputError
from ..meshes.plain_files import MISSING, wrong_with
from ..studies import folder as packaged_studies
from . import MeshSettings, ObstacleSettings, Study
from .error_messages import validation_message
from .mesh_source import find_builder

_PATHS: dict[type[BaseModel], list[str]] = {
    kind: [key for key, field in kind.model_fields.items() if field.annotation == Path | None]
    for kind in (MeshSettings, ObstacleSettings)
}
_TOO_DEEP = "lists or tables are nested too deeply; a study needs five levels or so"


def find_study(name: str) -> Path:
    """A path as it is, or the file of the packaged study of that name."""
    path = Path(name)
    packaged = packaged_studies() / (name if name.endswith(".toml") else f"{name}.toml")
    # os.path.isfile, unlike Path.is_file, does not mind a name that is too long; `-o bar-2d` makes a folder bar-2d
    named = os.path.isfile(path) or path.parent != Path() or not os.path.isfile(packaged)
    return path if named else packaged


def load_study(study: str | Path, overrides: Sequence[str] = ()) -> Study:
    """Read a study file, or the packaged study of that name, override (`key.path=value`) and validate.

    Raises InputError with one message.
    """
    path = find_study(study) if isinstance(study, str) else study
    data = _parse(path)
    _anchor(data, path.parent)
    for override in overrides:
        _apply(data, override)
    _anchor(data, Path())
    _check_whole_numbers(data)
    return validate(data, str(path))


def validate(data: dict[str, Any], name: str) -> Study:
    """Build the Study; the first thing that is wrong becomes the message."""
    try:
        study = Study.model_validate(data)
    except ValidationError as error:
        raise InputError(f"{name}: {validation_message(error.errors())}") from None
    return study


def study_text(study: Study, comments: Iterable[str] = ()) -> str:
    """The study as TOML with every default written out, `comments` first."""
    import tomli_w

    data = study.model_dump(mode="json", exclude_none=True)
    data["material"] |= data["material"].pop("regions")
    data["mesh"] |= _builder_parameters(study)
    return "".join(f"# {line}\n" for line in comments) + tomli_w.dumps(data)


def add_missing_defaults(values: dict[str, Any]) -> dict[str, Any]:
    """What `study_text` of an earlier version wrote, with the defaults of keys that it did not know; as it is, where it
    is no study of this one."""
    try:
        return tomllib.loads(study_text(validate(deepcopy(values), "")))
    except InputError:
        return values


def _builder_parameters(study: Study) -> dict[str, Any]:
    builder = find_builder(study.mesh)
    return {} if builder is None else {key: value for key, value in asdict(builder).items() if value is not None}


def _parse(path: Path) -> dict[str, Any]:
    if (wrong := wrong_with(path)) == MISSING:
        raise InputError(f"there is no study file {path}; `fracsim list` shows those that come with fracsim")
    if wrong:
        raise InputError(f"the study file {path} {wrong}")
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read the study file {path}: {error}") from None
    try:
        return tomllib.loads(text)
    except ValueError as error:  # also of a number with thousands of digits
        raise InputError(f"{path} is not TOML: {error}") from None
    except RecursionError:
        raise InputError(f"{path}: {_TOO_DEEP}") from None


def _check_whole_numbers(value: Any, key: str = "") -> None:
    """InputError for one beyond TOML's 64 bits: in hexadecimal they may have more digits than Python prints."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for part, each in inner:
        _check_whole_numbers(each, f"{key}.{part}" if key else str(part))
    if isinstance(value, int) and value.bit_length() > 63:
        raise InputError(
            f"{key} is a whole number of {value.bit_length()} bits; TOML has 64: write 1e30 for 10 to the 30"
        )


def _anchor(data: dict[str, Any], folder: Path) -> None:
    """Files of the body and of obstacles are looked for beside the study file (those given with --set: in the working
    folder)."""
    obstacles = data.get("obstacle")
    entries = obstacles if isinstance(obstacles, list) else []
    tables: list[tuple[str, type[BaseModel], Any]] = [("mesh", MeshSettings, data.get("mesh"))]
    tables += [(f"obstacle.{i}", ObstacleSettings, each) for i, each in enumerate(entries)]
    for name, kind, table in tables:
        for key in _PATHS[kind]:
            if isinstance(table, dict) and isinstance(table.get(key), str):
                if not table[key].isprintable():
                    raise InputError(f"{name}.{key} = {table[key]!a}: a path has no control characters")
                table[key] = str((folder / table[key]).resolve())


def _apply(data: dict[str, Any], override: str) -> None:
    key, equals, text = override.partition("=")
    if not equals or not all(key.strip().split(".")):
        raise InputError(f"--set {override}: write key.path=value, for example --set time.step=1e-3")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except ValueError:
        value = text
    except RecursionError:
        raise InputError(f"--set {key.strip()}: {_TOO_DEEP}") from None
    *path, last = key.strip().split(".")
    place: Any = data
    for part in path:
        place = _descend(place, part, override)
    if isinstance(place, list):
        place[_index(place, last, override)] = value
    else:
        place[last] = value


def _descend(place: Any, part: str, override: str) -> Any:
    inner = place[_index(place, part, override)] if isinstance(place, list) else place.setdefault(part, {})
    if not isinstance(inner, dict | list):
        raise InputError(f"--set {override}: {part} is a value, not a table")
    return inner


def _index(place: list[Any], part: str, override: str) -> int:
    if part not in map(str, range(len(place))):
        raise InputError(f"--set {override}: {part} is not an entry; there are {len(place)}, counted from 0")
    return int(part)
