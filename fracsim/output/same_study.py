"""What may change on a restart: how long, in what steps and with which solver a study runs, and what it writes.

Everything else is the body, its load or the law it follows, of which half a run would be of one kind and half of
another. The mesh is compared by its nodes, cells and groups, not by its keys: a file may have moved.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ..errors import InputError

FREE = (
    "title", "time.step", "time.end", "time.adapt", "time.smallest", "time.breaking_step", "time.until", "solver",
    "output", "mesh",
)  # fmt: skip
# tables that may come or go while nothing has broken or flowed, which the checkpoint is asked for; with the key of a
# region that comes and goes with them
LATE = {"fracture": "strength", "plasticity": "yield_stress", "brittle": ""}
_SAID = 4  # keys that a message names


def check_same_study(path: Path, then: dict[str, Any], now: dict[str, Any]) -> None:
    """InputError where the study of a checkpoint (`then`, at `path`) is not the one that is to go on.

    Both as they stand in study.toml, every default written out.
    """
    found = list(differences(then, now))
    if not found:
        return
    more = f"; and {len(found) - _SAID} more" if len(found) > _SAID else ""
    raise InputError(
        f"--restart: {path} is of another study: {'; '.join(found[:_SAID])}{more}. Only time.step, time.end, "
        "time.adapt, time.smallest, time.breaking_step, time.until, [solver], [output] and the title may change; put "
        "the others back, or run without --restart in another folder"
    )


def differences(then: dict[str, Any], now: dict[str, Any]) -> Iterator[str]:
    """A phrase for each key that may not differ and does."""
    old, new = dict(_leaves(then)), dict(_leaves(now))
    moved = _moved(then, now)
    orders = [each["mesh"].get("order", 1) for each in (then, now)]  # all else of it is compared by what it makes
    if orders[0] != orders[1]:
        yield f"mesh.order was {orders[0]}, is {orders[1]}"
    for key in dict.fromkeys([*old, *new]):
        if old.get(key) != new.get(key) and not _within(key, FREE) and not _of_moved(key, moved):
            yield f"{key} was {_said(old, key)}, is {_said(new, key)}"


def _moved(then: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """Tables of LATE that only one of the studies has; brittle surfaces come and go with [fracture] alone."""
    moved = [name for name in LATE if (name in then) != (name in now)]
    return [name for name in moved if name != "brittle" or "fracture" in moved]


def _of_moved(key: str, moved: list[str]) -> bool:
    table, _, last = key.rpartition(".")
    return _within(key, moved) or (table.startswith("material.") and last in [LATE[name] for name in moved])


def _within(key: str, names: list[str] | tuple[str, ...]) -> bool:
    return any(key == name or key.startswith(f"{name}.") for name in names)


def _leaves(value: Any, key: str = "") -> Iterator[tuple[str, Any]]:
    """(dotted key, value) of a TOML document; entries of lists of tables by their number. An empty list is no key:
    tables that an earlier version did not know are empty."""
    if value == []:
        return
    if isinstance(value, list) and value and isinstance(value[0], dict):
        value = dict(enumerate(value))
    if not isinstance(value, dict):
        yield key, value
        return
    for name, inner in value.items():
        yield from _leaves(inner, f"{key}.{name}" if key else str(name))


def _said(values: dict[str, Any], key: str) -> str:
    if key not in values:
        return "absent"
    value = values[key]
    return f'"{value}"' if isinstance(value, str) else str(value)
