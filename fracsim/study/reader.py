"""Read a study file into a `Study`, override values, and write it back with all defaults."""

from __future__ import annotations

import hashlib
import os
import tomllib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from ..errors import InputError
from ..meshes.plain_files import MISSING, unreadable_reason
from ..studies import folder as packaged_studies
from . import MeshSettings, ObstacleSettings, Study
from .error_messages import validation_message
from .mesh_source import find_builder

_PATH_KEYS: dict[type[BaseModel], list[str]] = {
    kind: [key for key, field in kind.model_fields.items() if field.annotation == Path | None]
    for kind in (MeshSettings, ObstacleSettings)
}
# ending of a file beside a mesh file with most of its data
_FILES_BESIDE = {".xdmf": ".h5", ".xmf": ".h5", ".ele": ".node", ".node": ".ele"}
_TOO_DEEP = "lists or tables are nested too deeply; a study needs five levels or so"


def find_study(name: str) -> Path:
    """Returns the path of a study: a path is returned unchanged, a name becomes that of the packaged study."""
    path = Path(name)
    packaged = packaged_studies() / (name if name.endswith(".toml") else f"{name}.toml")
    # os.path.isfile, unlike Path.is_file, accepts a name that is too long; `-o bar-2d` makes a folder bar-2d
    is_path = os.path.isfile(path) or path.parent != Path() or not os.path.isfile(packaged)
    return path if is_path else packaged


def packaged_study_text(name: str) -> str:
    """Text of a packaged study. InputError if there is none of this name."""
    path = packaged_studies() / f"{name.removesuffix('.toml')}.toml"
    if path.parent != packaged_studies() or not path.is_file():
        names = [path.stem for path in packaged_studies().glob("*.toml")]
        near = get_close_matches(name, names, n=1)
        raise InputError(
            f"no packaged study is called {name}" + (f"; did you mean {near[0]}?" if near else "; see fracsim list")
        )
    return path.read_text(encoding="utf-8")


def load_study(study: str | Path | Mapping[str, Any], overrides: Sequence[str] | Mapping[str, Any] = ()) -> Study:
    """Returns a validated study.

    Args:
        study: path of a study file, name of a packaged study, or the tables of a study with paths relative to the
            working folder.
        overrides: `key.path=value` with values in TOML, or values by `key.path`.

    Raises:
        InputError: with one message on the first error.
    """
    _check_types(study, overrides)
    if isinstance(study, Mapping):
        data, name = deepcopy(dict(study)), "study"
    else:
        path = find_study(study) if isinstance(study, str) else study
        data, name = _parse(path), str(path)
        # paths of the file are relative to it, those of --set to the working folder
        _resolve_paths(data, path.parent)
    for override in overrides if not isinstance(overrides, Mapping) else ():
        _apply_override(data, override)
    for key, value in overrides.items() if isinstance(overrides, Mapping) else ():
        _set_value(data, key, value, key)
    _resolve_paths(data, Path())
    _check_whole_numbers(data)
    return validate(data, name)


def _check_types(study: Any, overrides: Any) -> None:
    """Raise InputError if the arguments of `load_study` are of other types; Python does not check them."""
    if not isinstance(study, str | os.PathLike | Mapping):
        raise InputError(
            f"study is {study!r}: give the path of a study file, the name of a packaged study, or a dict of tables"
        )
    is_list = isinstance(overrides, Sequence) and not isinstance(overrides, str)
    if not (is_list or isinstance(overrides, Mapping)) or not all(isinstance(key, str) for key in overrides):
        raise InputError(
            f'overrides are {overrides!r}: give values by key, as in {{"mesh.h": 0.02}}, or texts, as in '
            '["mesh.h=0.02"]'
        )


def validate(data: dict[str, Any], name: str) -> Study:
    """Returns the study of a table.

    Args:
        data: the tables of a study file; paths are relative to the working folder.
        name: of the study, for the message.

    Raises:
        InputError: with a message on the first error.
    """
    try:
        return Study.model_validate(data)
    except ValidationError as error:
        raise InputError(f"{name}: {validation_message(error.errors())}") from None


def study_text(study: Study, comments: Iterable[str] = ()) -> str:
    """Returns the study as TOML with all defaults, after lines of comments."""
    import tomli_w

    data = study.model_dump(mode="json", exclude_none=True)
    # regions are tables inside [material], parameters of a builder keys of [mesh]
    data["material"] |= data["material"].pop("regions")
    data["mesh"] |= _builder_parameters(study)
    return "".join(f"# {line}\n" for line in comments) + tomli_w.dumps(data)


def input_file_lines(study: Study, digests: dict[Path, str] | None = None) -> list[str]:
    """Returns a line `file KEY: SHA-256` for each mesh and obstacle file of a study, for study.toml.

    `digests`: of files that other studies have as well, which are read once; it is added to.

    The HDF5 file beside an XDMF file and the nodes of TetGen count too. Other files that a file names (`*INCLUDE`,
    pieces of .pvtu) are not read.

    Raises:
        InputError: a file cannot be read.
    """
    digest_of = {} if digests is None else digests
    for key, path in (files := list(_input_files(study))):
        if path not in digest_of:
            digest_of[path] = _file_digest(key, path)
    return [f"file {key}: {digest_of[path]}" for key, path in files]


def _input_files(study: Study) -> Iterator[tuple[str, Path]]:
    """Pairs of the dotted key and the path of each mesh and obstacle file."""
    tables = [("mesh", study.mesh), *((f"obstacle.{i}", entry) for i, entry in enumerate(study.obstacle))]
    for name, table in tables:
        for key in _PATH_KEYS[MeshSettings if name == "mesh" else ObstacleSettings]:
            if (path := getattr(table, key)) is None:
                continue
            yield f"{name}.{key}", path
            beside = path.with_suffix(_FILES_BESIDE.get(path.suffix.lower(), path.suffix))
            if beside != path and beside.is_file():
                yield f"{name}.{key} ({beside.suffix})", beside


def _file_digest(key: str, path: Path) -> str:
    """SHA-256 of the contents of a file. InputError if it cannot be read."""
    if wrong := unreadable_reason(path):
        raise InputError(f"{key}: {path} {wrong}")
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{key}: cannot read {path}: {error.strerror}") from None


def add_missing_defaults(values: dict[str, Any]) -> dict[str, Any]:
    """Returns the tables of an earlier version with the defaults of keys that this version has added.

    Tables that are not a valid study are returned unchanged.
    """
    try:
        return tomllib.loads(study_text(validate(deepcopy(values), "")))
    except InputError:
        return values


def _builder_parameters(study: Study) -> dict[str, Any]:
    builder = find_builder(study.mesh)
    return {} if builder is None else {key: value for key, value in asdict(builder).items() if value is not None}


def _parse(path: Path) -> dict[str, Any]:
    if (wrong := unreadable_reason(path)) == MISSING:
        raise InputError(f"there is no study file {path}; `fracsim list` shows those that come with fracsim")
    if wrong:
        raise InputError(f"the study file {path} {wrong}")
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read the study file {path}: {error}") from None
    try:
        return tomllib.loads(text)
    except ValueError as error:
        # also for a number with thousands of digits
        raise InputError(f"{path} is not TOML: {error}") from None
    except RecursionError:
        raise InputError(f"{path}: {_TOO_DEEP}") from None


def _check_whole_numbers(value: Any, key: str = "") -> None:
    """Raises InputError for a whole number beyond TOML's 64 bits; in hexadecimal it may be too long for Python."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for part, item in items:
        _check_whole_numbers(item, f"{key}.{part}" if key else str(part))
    if isinstance(value, int) and value.bit_length() > 63:
        raise InputError(
            f"{key} is a whole number of {value.bit_length()} bits; TOML has 64: write 1e30 for 10 to the 30"
        )


def _resolve_paths(data: dict[str, Any], folder: Path) -> None:
    """Make the paths of mesh and obstacles absolute: relative to the study file, with --set to the working folder."""
    obstacles = data.get("obstacle")
    entries = obstacles if isinstance(obstacles, list) else []
    tables: list[tuple[str, type[BaseModel], Any]] = [("mesh", MeshSettings, data.get("mesh"))]
    tables += [(f"obstacle.{i}", ObstacleSettings, entry) for i, entry in enumerate(entries)]
    for name, kind, table in tables:
        for key in _PATH_KEYS[kind]:
            if isinstance(table, dict) and isinstance(table.get(key), str):
                if not table[key].isprintable():
                    raise InputError(f"{name}.{key} = {table[key]!a}: a path has no control characters")
                table[key] = str((folder / table[key]).resolve())


def _apply_override(data: dict[str, Any], override: str) -> None:
    """Set a value `key.path=value` in the tables of a study. InputError if the path is invalid."""
    key, equals, text = override.partition("=")
    if not equals or not all(key.strip().split(".")):
        raise InputError(f"--set {override}: write key.path=value, for example --set time.step=1e-3")
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except ValueError:
        # text without quotes
        value = text
    except RecursionError:
        raise InputError(f"--set {key.strip()}: {_TOO_DEEP}") from None
    _set_value(data, key, value, override)


def _set_value(data: dict[str, Any], key: str, value: Any, override: str) -> None:
    """Set the value of a key `table.key`; `override`: for the message."""
    *path, last = key.strip().split(".")
    container: Any = data
    for part in path:
        container = _descend(container, part, override)
    if isinstance(container, list):
        container[_index(container, last, override)] = value
    else:
        container[last] = value


def _descend(container: Any, part: str, override: str) -> Any:
    """The table or list inside another one; a missing table is added."""
    inner = (
        container[_index(container, part, override)] if isinstance(container, list) else container.setdefault(part, {})
    )
    if not isinstance(inner, dict | list):
        raise InputError(f"--set {override}: {part} is a value, not a table")
    return inner


def _index(entries: list[Any], part: str, override: str) -> int:
    """Index of an entry of a list. InputError if there is none."""
    if part not in map(str, range(len(entries))):
        raise InputError(f"--set {override}: {part} is not an entry; there are {len(entries)}, counted from 0")
    return int(part)
