"""Studies whose values, keys and bytes are changed at random: `check`, and what passes it runs.

What ends with a result has finite numbers in history.csv; all else is a message, in time.
"""

from __future__ import annotations

import copy
import datetime
import os
import random
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from fracsim.errors import Exit
from fracsim.meshes import parameters

from .corpus import STUDIES, Data, history
from .trial import Ended, call, expect

VALUES: list[Any] = [
    0, 1, -1, 2, 3, 7, 100, -100, 10**6, 2**31, 2**63 - 1, -(2**63), 0.0, -0.0, 0.5, 1e-3, 1e-12, 1e-300, 5e-324, 1e12,
    1e300, -1e300, float("inf"), float("-inf"), float("nan"), "", "x", "xyz", "left", "nothing", "a" * 300,
    "\x1b[31mred",
    "../up", "/dev/null", "/dev/zero", ".", "\u202e", "explicit", "rigid", "quasi-static", "free", True, False, [], {},
    [[]], [0.0], [1.0, 0.0], [0.0, 0.0, 0.0], [[0.0, 0.0], [1.0, 1.0]], ["x"] * 3, {"time": [0.0], "value": [0.0]},
    {"time": [0.0, 1.0], "value": [0.0, 1e9]}, {"box": [[0.0, 0.0], [1.0, 1.0]]}, {"x": 1}, datetime.date(2020, 1, 1),
    [1e300] * 3, [float("nan")] * 2, list(range(50)),
]  # fmt: skip
KEYS = ["", "x", "h", "size", "step", "end", "young", "energy", "strength", "radius", "name", "on", "fix", "file",
        "like",
        "order", "thickness", "velocity", "friction", "mass", "a.b", "ключ", "k" * 300, "every", "fields", "scheme",
        "copies", "gravity", "displacement", "pressure", "force", "point", "axis", "spin", "hinge", "guide", "hollow",
        "cap", "passes", "crumbs", "branching", "law", "unilateral", "until", "breaking_step", "restitution", "look",
        "cut", "checkpoint", "interval", "count", "seed", "modulus", "plane", "snes_rtol",
        "ksp_type", "pc_type"]  # fmt: skip
WALL = 1.0  # s that a run may take before it ends by its own limit


def attack(number: int, chance: random.Random, place: Path) -> str:
    """One study."""
    os.chdir(place)
    parameters.MAX_CELLS = 20_000  # type: ignore[misc]  # else a small h is a mesh that takes minutes, by right
    name = chance.choice(sorted(STUDIES))
    path = place / "study.toml"
    path.write_bytes(mutated(STUDIES[name], chance))
    checked = call("check", path).expect(Exit.DONE, Exit.BAD_INPUT)
    _has_message(checked)
    if checked.code:
        # a run refuses it as well, and writes nothing
        ran = call("run", path, "-o", place / "out", "--wall-limit", WALL).expect(Exit.BAD_INPUT)
        expect(not (place / "out").exists(), "refused, and yet wrote something")
        return "refused"
    ran = call("run", path, "-o", place / "out", "--wall-limit", WALL)
    ran.expect(Exit.DONE, Exit.BAD_INPUT, Exit.NOT_CONVERGED, Exit.STOPPED)
    _has_message(ran)
    if ran.code == Exit.DONE:
        _is_finite(place / "out")
    return {0: "ran", 2: "refused by run alone", 3: "did not converge", 4: "reached its wall limit"}[ran.code]


def _has_message(ended: Ended) -> None:
    """What does not end well says so in one line of bearable length, without codes for terminals."""
    if ended.code:
        lines = [line for line in ended.said.splitlines() if line.startswith("fracsim: ")]
        expect(lines, f"exit {ended.code} without a message: {ended.said[-500:]}")
    expect("\x1b" not in ended.said, f"escape codes: {ended.said[-500:]!a}")
    expect("PETSC ERROR" not in ended.said, f"PETSc's words: {ended.said[-1500:]}")


def _is_finite(out: Path) -> None:
    for name, values in history(out).items():
        expect(not np.isinf(values).any(), f"{name} is infinite in history.csv")
        expect(name.startswith(("tip_", "gap_")) or not np.isnan(values).any(), f"{name} is nan in history.csv")


def mutated(data: Data, chance: random.Random) -> bytes:
    """A study, changed in one to three places; one of six times as bytes."""
    data = copy.deepcopy(data)
    for _ in range(chance.choice((1, 1, 1, 2, 2, 3))):
        _change(data, chance)
    try:
        text = tomli_w.dumps(data).encode()
    except (TypeError, ValueError):  # what TOML cannot say
        return mutated(data | {"title": "again"} if isinstance(data, dict) else {}, chance)
    return _bytes_changed(text, chance) if chance.random() < 1 / 6 else text


def _places(node: Any) -> list[tuple[Any, Any]]:
    """All (container, key) below a node."""
    keys: list[Any] = list(node) if isinstance(node, dict) else list(range(len(node))) if isinstance(node, list) else []
    found = [(node, key) for key in keys]
    for key in keys:
        found += _places(node[key])
    return found


def _change(data: Data, chance: random.Random) -> None:
    places = _places(data)
    container, key = chance.choice(places)
    value = container[key]
    kind = chance.randrange(10)
    if kind < 4 and isinstance(value, int | float) and not isinstance(value, bool):
        by = chance.choice((-1.0, 10.0 ** chance.uniform(-12, 12), 10.0 ** chance.uniform(-1, 1), 1 + 1e-9))
        container[key] = value * by if isinstance(value, float) else int(min(max(value * by, -(2**62)), 2**62))
    elif kind < 6:
        container[key] = copy.deepcopy(chance.choice(VALUES))
    elif kind == 6:
        del container[key]
    elif kind == 7 and isinstance(container, dict):
        container[chance.choice(KEYS)] = copy.deepcopy(chance.choice(VALUES))
    elif kind == 8:
        other, place = chance.choice(places)
        container[key] = copy.deepcopy(other[place])
    elif isinstance(value, list):
        container[key] = value[:-1] if chance.random() < 0.5 else value + value[: chance.randint(1, 3)]
    else:
        from_other = STUDIES[chance.choice(sorted(STUDIES))]
        table = chance.choice(sorted(from_other))
        data[table] = copy.deepcopy(from_other[table])


def _bytes_changed(text: bytes, chance: random.Random) -> bytes:
    at = chance.randrange(len(text) + 1)
    match chance.randrange(5):
        case 0:
            return text[:at]
        case 1:
            return text[:at] + bytes([chance.randrange(256)]) + text[at + 1 :]
        case 2:
            return text[:at] + chance.randbytes(chance.randint(1, 20)) + text[at:]
        case 3:
            end = chance.randrange(at, len(text) + 1)
            return text[:at] + text[end:]
        case _:
            return text.replace(b"\n", chance.choice((b"\r\n", b"\r", b"\0", b" ")))
