"""Errors of validation as one sentence: the key, its value, and what is allowed."""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterable, Sequence
from typing import Any, get_args

from pydantic import BaseModel

from . import Study

# sentences for the error types of pydantic; other types keep its text
_SENTENCES = {
    "bool_type": "must be true or false",
    "dataclass_type": "must be a table",
    "dict_type": "must be a table",
    "float_type": "must be a number",
    "int_type": "must be a whole number",
    "list_type": "must be a list",
    "model_attributes_type": "must be a table",
    "model_type": "must be a table",
    "path_type": "must be a text in quotes",
    "string_too_long": "must have {max_length} letters or fewer",
    "string_type": "must be a text in quotes",
    "too_long": "must have {max_length} or fewer entries",
    "too_short": "must have {min_length} or more entries",
    "tuple_type": "must be a list",
}
_PATTERNS = {
    "^#[0-9a-fA-F]{6}$": 'must be a colour as "#rrggbb"',
    "^[xyz]+$": 'must name components, such as "xyz" or "x"',
    "^[A-Za-z][A-Za-z0-9-]*$": "must be letters, digits and -, a letter first",
}


def validation_message(errors: Sequence[Any], table: str = "") -> str:
    """Returns the first error as a sentence, all missing keys in one.

    An unknown key precedes a missing one, since it is usually the missing key with a typing error.

    Args:
        errors: of a pydantic ValidationError.
        table: path of the table that was validated, if it is not the whole study.
    """
    error = next((error for error in errors if error["type"] == "extra_forbidden"), errors[0])
    location, where = _location(error["loc"]), _key(error, table)
    if error["type"] == "extra_forbidden":
        return unknown_key_message(where, _known_keys(location[:-1]))
    if error["type"] == "missing":
        # a key may be missing in one type of a value alone
        missing = [_key(entry, table) for entry in errors if entry["type"] == "missing" and not _in_union(entry)]
        if _in_union(error) or len(missing) == 1:
            return f"{where} is missing; {_owner(location)} needs it{_meaning(location)}"
        return f"{', '.join(missing[:-1])} and {missing[-1]} are missing; the study needs them"
    if error["type"] == "value_error":
        return f"{where}: {error['ctx']['error']}" if where else str(error["ctx"]["error"])
    return f"{where} = {_show(error['input'])}: {_sentence(error)}"


def unknown_key_message(where: str, known: Iterable[str]) -> str:
    """Returns a sentence on an unknown key, with the nearest known key, and all known keys of its table."""
    keys = sorted(set(known))
    near = difflib.get_close_matches(where.rpartition(".")[2], keys, n=1, cutoff=0.6)
    hint = f"did you mean {near[0]}? Known" if near else "known"
    return f"{where} is not a known key; {hint} here: {', '.join(keys)}"


def _key(error: Any, table: str) -> str:
    """Path of the key of an error; `table`: path of the table that was validated, if it is not the whole study."""
    location = _location(error["loc"])
    return ".".join(map(str, [table, *location] if table else location))


def _in_union(error: Any) -> bool:
    """Whether an error is one of several for a value that may have several types."""
    return any(str(part).startswith("<") for part in error["loc"])


def _location(parts: Sequence[Any]) -> list[Any]:
    """Path of an error in the file: without the tags of unions and the field of the regions."""
    keys = [part for part in parts if not str(part).startswith("<")]
    return [keys[0], *keys[2:]] if keys[:2] == ["material", "regions"] else keys


def _owner(location: list[Any]) -> str:
    return f"the table [{'.'.join(map(str, location[:-1]))}]" if location[:-1] else "every study"


def _sentence(error: Any) -> str:
    kind, context = error["type"], error.get("ctx", {})
    if kind in _SENTENCES:
        return _SENTENCES[kind].format(**context)
    if kind == "string_pattern_mismatch":
        return _PATTERNS[context["pattern"]]
    if context.get("expected") == "'free'":
        return 'must be a number or "free"'
    # other types of errors: the text of pydantic, in the words of the messages above
    text = str(error["msg"]).removeprefix("Input ").replace("should be", "must be")
    if kind == "literal_error" and isinstance(error["input"], str):
        allowed = context["expected"].replace(" or ", ", ").replace("'", "").split(", ")
        near = difflib.get_close_matches(error["input"], allowed, n=1, cutoff=0.65)
        return f"{text}; did you mean {near[0]}?" if near else text
    return text


def _show(value: Any) -> str:
    text = json.dumps(value, default=str).replace("NaN", "nan").replace("Infinity", "inf")
    return text if len(text) <= 60 else text[:57] + "..."


def _meaning(location: list[Any]) -> str:
    """Example and meaning of a required key of a table; empty for a table."""
    from .documentation import toml

    fields = [
        model.model_fields[location[-1]] for model in _tables_at(location[:-1]) if location[-1] in model.model_fields
    ]
    if not fields or not fields[0].examples:
        return ""
    text = f". Example: {location[-1]} = {toml(fields[0].examples[0])}. Meaning: {fields[0].description}"
    return text.removesuffix(".")


def _known_keys(location: list[Any]) -> list[str]:
    """Known keys of the table at a path of the study file."""
    return [key for model in _tables_at(location) for key in model.model_fields if key != "regions"]


def _tables_at(location: list[Any]) -> list[type[BaseModel]]:
    """Models of the tables that may be at a path of the study file."""
    models: list[type[BaseModel]] = [Study]
    for part in location:
        fields = [model.model_fields for model in models]
        selected = [field.get(part, field.get("regions")) for field in fields]
        inner = [model for field in selected if field is not None for model in models_in(field.annotation)]
        # an index of a list keeps the table of its entries
        models = inner or models
    return models


def models_in(annotation: Any) -> list[type[BaseModel]]:
    """Returns the tables that a value of a type may be."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    inner = [model for argument in get_args(annotation) for model in models_in(argument)]
    return inner or (models_in(annotation.__value__) if hasattr(annotation, "__value__") else [])
