"""Page docs/study-file.md, written from the schema: `python3 -m fracsim.study.documentation docs/study-file.md`.

Descriptions, units, defaults and examples of keys are those of `fracsim.study.values.key`. The allowed values of a key
are derived from its type. The same descriptions make the JSON schema for editors that complete and check keys
(`fracsim schema`). What depends on several keys is checked by the program alone.
"""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from annotated_types import Ge, Gt, Le, Len, Lt, MaxLen, MinLen
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from . import BoxSelector, ColourSettings, PlaneSelector, Study, TimeTable
from .body import SOURCE_KEYS, SourceKey
from .error_messages import models_in
from .values import OverTime

INTRODUCTION = """# Study file

<!-- Written by `make study-file` from the schema in fracsim/study; do not edit. -->

A study is one TOML file in SI units. `[mesh]`, `[material]` and `[time]` are required. A table that is absent costs
nothing: without `[fracture]` there is no damage field, no graph and no average. Unknown keys are refused, with the
nearest known key and all of the table. `fracsim check` validates a study without solving.

- Numbers are finite, at most 1e50 in magnitude; those that must be positive are at least 1e-50.
- A value over time is a constant or a table `{ time = [..], value = [..] }`, linear between its times and constant
  outside.
- Paths are relative to the study file.
- `--set table.key=value` overrides any key, entries of lists by their number: `--set boundary.0.pressure=2e4`.

## A complete study

```toml
"""
KEYS = """```

## All keys

"required" stands for a key without a default. An empty default means that the key may be left out.
"""
SOLVER = """PETSc options that are data. Options that load code, name files or open viewers are refused. Options that
print, such as `ksp_monitor`, take true."""
# a study whose keys are explained in the first section of the page
EXAMPLE: dict[str, Any] = {
    "title": "A bar pulled apart",
    "mesh": {"builder": "box", "size": [0.4, 0.1, 0.1], "h": 0.02, "pattern": "unstructured"},
    "material": {"energy": "neo-hookean", "young": 1e5, "poisson": 0.35, "density": 300.0},
    "fracture": {"strength": 3e4, "approach": "chi", "radius": 0.03, "kernel": "linear"},
    "damping": {"mass": 5.0},
    "boundary": [
        {"on": "left", "fix": "xyz"},
        {
            "on": "right",
            "displacement": {"time": [0.0, 0.4], "value": [[0.0, "free", 0.0], [0.2, "free", 0.0]]},
        },
    ],
    "load": {"gravity": [0.0, 0.0, -9.81]},
    "time": {"scheme": "generalized-alpha", "step": 5e-3, "end": 0.4, "mass": "lumped"},
    "solver": {"ksp_rtol": 1e-6},
    "probe": [{"name": "grip", "on": "right"}],
    "output": {"interval": 0.02, "fields": ["damage", "chi", "von_mises", "piece"]},
}
# keys of the example that are no keys of the schema: parameters of the builder, options of PETSc
COMMENTS = {
    "mesh.size": "Side lengths of the builder box. [m]",
    "mesh.h": "Cell size. [m]",
    "mesh.pattern": "Pattern of the builder box: unstructured has random points, without preferred directions.",
    "solver.ksp_rtol": "Relative tolerance of the linear solver.",
}
LINK = re.compile(r" \(\[[^]]*\]\([^)]*\)\)")  # a link in parentheses


@dataclass(frozen=True)
class Key:
    """Documentation of one key.

    Attributes:
        path: `table.key`.
        default: as in a study file; "required", or empty.
        unit, values, meaning, example: texts of the row.
    """

    path: str
    default: str
    unit: str
    values: str
    meaning: str
    example: str

    @property
    def row(self) -> str:
        """Row of a Markdown table."""
        example = f"`{self.example}`" if self.example else ""
        cells = (f"`{self.path}`", self.default, self.unit, self.values, self.meaning, example)
        return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


def study_file_page() -> str:
    """Returns the page as Markdown."""
    return INTRODUCTION + "\n".join(_commented(EXAMPLE)) + "\n" + KEYS + "".join(_sections())


def study_keys() -> list[Key]:
    """Returns the documentation of all keys of a study, in the order of the page."""
    return [entry for table in _tables() for entry in table.keys]


@dataclass(frozen=True)
class _Table:
    """A section of the page: heading, description and keys of one table of the study."""

    heading: str
    description: str
    keys: list[Key]


def _tables() -> Iterator[_Table]:
    """All tables of a study, in the order of the schema."""
    plain = ("title", "terms", "loads")
    yield _Table("Top level", "", [_key(name, Study.model_fields[name]) for name in plain])
    for name, field in Study.model_fields.items():
        models = models_in(field.annotation)
        heading = f"[[{name}]]" if "list" in str(field.annotation) else f"[{name}]"
        if models:
            keys = list(_keys_of(models[0], f"{name}."))
            if name == "mesh":
                keys += _source_keys()
            yield _Table(heading, _description(models[0]), keys)
        elif name not in plain:
            yield _Table(heading, SOLVER if name == "solver" else "", [_key(name, field)])


def _sections() -> Iterator[str]:
    for table in _tables():
        yield f"\n### {table.heading}\n\n"
        if table.description:
            yield f"{table.description}\n\n"
        yield "| key | default | unit | values | meaning | example |\n|---|---|---|---|---|---|\n"
        yield from (f"{entry.row}\n" for entry in table.keys)


def _keys_of(model: type[BaseModel], path: str) -> Iterator[Key]:
    """The keys of a table, and of the tables inside it."""
    for name, field in model.model_fields.items():
        inner = [kind for kind in models_in(field.annotation) if not issubclass(kind, TimeTable)]
        key = f"{path}NAME" if name == "regions" else f"{path}{name}"
        if not inner or _has_plain_value(inner):
            yield _key(key, field)
        for kind in inner:
            yield from _keys_of(kind, f"{key}.")


def _has_plain_value(models: Iterable[type[BaseModel]]) -> bool:
    """True for keys that hold a name or a table: selectors and colours."""
    return any(issubclass(kind, BoxSelector | PlaneSelector | ColourSettings) for kind in models)


def _key(path: str, field: FieldInfo) -> Key:
    extra = field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}
    meaning, otherwise = field.description or "", extra.get("otherwise", "")
    if otherwise:
        meaning += f" Left out: {otherwise}."
    default = "required" if field.is_required() else _default(field.get_default(call_default_factory=True))
    example = field.examples[0] if field.examples else None
    values = allowed_values(Annotated[field.annotation, *field.metadata] if field.metadata else field.annotation)
    return Key(path, default, str(extra.get("unit", "")), values, meaning, "" if example is None else toml(example))


def _source_keys() -> list[Key]:
    """Keys of [mesh] that belong to a kind of source."""
    sources: dict[str, list[str]] = {}
    entries: dict[str, SourceKey] = {}
    for source, keys in SOURCE_KEYS.items():
        for name, entry in keys.items():
            sources.setdefault(name, []).append(f"`{source}`")
            entries[name] = entry
    return [
        Key(
            f"mesh.{name}", "required" if entry.required else _default(entry.default), entry.unit, _kind(entry),
            f"With {', '.join(sources[name])}: {entry.description}", toml(entry.example),
        )
        for name, entry in entries.items()
    ]  # fmt: skip


def _kind(entry: SourceKey) -> str:
    return "true, false" if entry.boolean else "whole number > 0" if entry.integer else "number > 0"


def _default(value: Any) -> str:
    return "" if value is None else toml(value).strip('"')


def toml(value: Any) -> str:
    """Returns a value as it stands in a study file."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {toml(item)}" for key, item in value.items()) + " }" if value else "{}"
    if isinstance(value, list):
        return f"[{', '.join(map(toml, value))}]"
    if isinstance(value, float):
        return _number(value)
    return json.dumps(value)


def _number(value: float) -> str:
    if value in (float("inf"), 0.0):
        return f"{value:g}" if value else "0"
    if 1e-3 <= abs(value) < 1e4:
        return f"{value:g}" if value % 1 else f"{value:.1f}"
    digits, exponent = f"{value:.6e}".split("e")
    return f"{digits.rstrip('0').rstrip('.')}e{int(exponent)}"


def allowed_values(annotation: Any, bounds: tuple[Any, ...] = ()) -> str:
    """Returns the values of a type in words: "number > 0", "linear, constant", "2 or 3 numbers"."""
    origin, arguments = get_origin(annotation), get_args(annotation)
    if origin is OverTime:
        return f"{allowed_values(arguments[0])}, or over time"
    if origin is Annotated:
        return allowed_values(arguments[0], (*_flat(arguments[1:]), *bounds))
    if origin in (Union, UnionType):
        return " or ".join(dict.fromkeys(allowed_values(part) for part in arguments if part is not NoneType))
    if origin is Literal:
        return ", ".join(str(value).lower() if isinstance(value, bool) else str(value) for value in arguments)
    if origin is list:
        return _list(allowed_values(arguments[0]), bounds)
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return {BoxSelector: "box", PlaneSelector: "plane"}.get(annotation, "table")
    if annotation is bool:
        return "true, false"
    words = {int: "whole number", float: "number", str: "text", Path: "path"}.get(annotation, "table")
    return f"{words}{_range(bounds)}"


def _flat(metadata: Iterable[Any]) -> Iterator[Any]:
    """Metadata of a type; that of pydantic's Field is inside of it."""
    for entry in metadata:
        yield from entry.metadata if isinstance(entry, FieldInfo) else (entry,)


def _range(bounds: Iterable[Any]) -> str:
    signs = {Gt: (">", "gt"), Ge: (">=", "ge"), Lt: ("<", "lt"), Le: ("<=", "le")}
    parts = [
        f"{signs[type(bound)][0]} {getattr(bound, signs[type(bound)][1]):g}" for bound in bounds if type(bound) in signs
    ]
    return f" {', '.join(parts)}" if parts else ""


def _list(item: str, bounds: Iterable[Any]) -> str:
    """Words for a list whose length is limited."""
    shortest = longest = None
    for bound in bounds:
        if isinstance(bound, Len | MinLen):
            shortest = bound.min_length
        if isinstance(bound, Len | MaxLen):
            longest = bound.max_length
    plural = f"entries ({item})"
    if item[0].isdigit():
        plural = "points"
    elif "number" in item:
        plural = item.replace("number", "numbers", 1)
    if longest is not None:
        return f"{longest} {plural}" if shortest == longest else f"{shortest} to {longest} {plural}"
    return f"{shortest} or more {plural}" if shortest else f"list of {plural}"


def _commented(study: dict[str, Any]) -> Iterator[str]:
    """Lines of a study in TOML, with the meaning of each key above its first use."""
    documented = {entry.path: entry for entry in study_keys()}
    explained: set[str] = set()
    for name, value in study.items():
        if not isinstance(value, dict | list):
            yield f"{name} = {toml(value)}"
            continue
        for entry in value if isinstance(value, list) else [value]:
            yield ""
            yield f"[[{name}]]" if isinstance(value, list) else f"[{name}]"
            for key, item in entry.items():
                if (path := f"{name}.{key}") not in explained:
                    explained.add(path)
                    yield from _comment(path, documented)
                yield f"{key} = {toml(item)}"


def _comment(path: str, documented: dict[str, Key]) -> Iterator[str]:
    text = COMMENTS.get(path)
    if text is None:
        entry = documented[path]
        text = LINK.sub("", entry.meaning.split(" Left out:")[0])
        text += f" [{entry.unit}]" if entry.unit else ""
    line = "#"
    for word in text.split():
        if len(line) + len(word) >= 100:
            yield line
            line = "#"
        line += f" {word}"
    yield line


def _description(model: type[BaseModel]) -> str:
    """Docstring of a table as one paragraph."""
    return " ".join((model.__doc__ or "").split())


# keys that [material] like supplies, by table
_SUPPLIED = {
    "MaterialSettings": ["young", "poisson", "density"],
    "FractureSettings": ["strength"],
    "PlasticitySettings": ["yield_stress"],
}


def study_schema() -> dict[str, Any]:
    """JSON schema (draft 2020-12) of a study file."""
    schema = Study.model_json_schema()
    for name, table in schema["$defs"].items():
        title = table.get("title", name)
        if "required" in table:
            table["required"] = [key for key in table["required"] if key not in _SUPPLIED.get(title, [])]
        if title == "FractureSettings":
            table["properties"]["energy"]["anyOf"].append({"const": True})  # that of [material] like
        if title == "MaterialSettings":
            table["anyOf"] = [{"required": ["like"]}, {"required": _SUPPLIED[title]}]
            # tables inside [material] are regions of the mesh
            table["additionalProperties"] = table["properties"].pop("regions")["additionalProperties"]
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | _without_infinity(schema)


def _without_infinity(part: Any) -> Any:
    """Part of a schema without infinite defaults and examples, which JSON cannot hold."""
    if isinstance(part, list):
        return [_without_infinity(item) for item in part if not _is_infinite(item)]
    if isinstance(part, dict):
        return {key: _without_infinity(item) for key, item in part.items() if not _is_infinite(item)}
    return part


def _is_infinite(value: Any) -> bool:
    return isinstance(value, float) and math.isinf(value)


if __name__ == "__main__":
    Path(sys.argv[1]).write_text(study_file_page(), encoding="utf-8")
