"""Every required key of every table, taken out one at a time. Which keys those are is asked of the schema."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Iterator
from typing import Any

import pytest
from pydantic import BaseModel

from cases import STRIP, changed
from fracsim.errors import InputError
from fracsim.meshes import BUILDERS
from fracsim.study import Study, StudyTable
from fracsim.study.body import MeshSettings
from fracsim.study.check import check_study
from fracsim.study.reader import validate
from fracsim.study.rigid_bodies import BodySettings
from fracsim.study.values import TimeTable

pytestmark = pytest.mark.any_release

Data = dict[str, Any]
Path = tuple[str | int, ...]

# every table that there is, each with what it requires
FULL: Data = changed(
    STRIP,
    output={"look": {"skin": "#b9712c", "inside": "#f0deb6"}},
    material={"stiff": {"young": 1e7}},
    fracture={"heterogeneity": {"modulus": 5.0}, "fibre": {"direction": [1.0, 0.0]}},
    plasticity={"yield_stress": 1e4},
    brittle={"surfaces": 3, "grains": {"count": 4}},
    damping={"mass": 1.0},
    load={"gravity": [0.0, -9.81]},
    initial={"velocity": [1.0, 0.0]},
    contact={"friction": 0.2},
    crack=[{"segment": [[0.0, 0.0], [0.1, 0.1]]}, {"plane": {"point": [0.0, 0.1], "normal": [0.0, 1.0]}}],
    obstacle=[
        {"name": "floor", "shape": "plane", "at": [0.0, -1.0], "normal": [0.0, 1.0]},
        {
            "name": "bob",
            "shape": "sphere",
            "at": [0.0, 9.0],
            "radius": 1.0,
            "mass": 1.0,
            "hinge": {"point": [0.0, 12.0]},
        },
    ],
    time={"until": {"drop": 0.5, "of": "bob"}},
    boundary=[
        {"on": {"box": [[0, 0], [1, 1]]}, "fix": "xy"},
        {"on": {"point": [1, 0], "normal": [1, 0]}, "pressure": {"time": [0, 1], "value": [0, 1]}},
    ],
)


def tables(model: BaseModel, at: Path = ()) -> Iterator[tuple[Path, BaseModel]]:
    """Tables within a table, itself first, by their place in the study file."""
    yield at, model
    for name in type(model).model_fields:
        value, here = getattr(model, name), at if name == "regions" else (*at, name)
        inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
        for place, each in [(here, value), *((((*here, key)), each) for key, each in inner)]:
            if isinstance(each, BaseModel):
                yield from tables(each, place)


def kinds(model: type[BaseModel]) -> Iterator[type[BaseModel]]:
    for each in model.__subclasses__():
        yield each
        yield from kinds(each)


FOUND = list(tables(validate(FULL, "test.toml")))
REQUIRED = [(*at, key) for at, table in FOUND for key, field in type(table).model_fields.items() if field.is_required()]


def without(path: Path) -> Data:
    data = copy.deepcopy(FULL)
    place: Any = data
    for part in path[:-1]:
        place = place[part]
    del place[path[-1]]
    return data


def name_of(path: Path) -> str:
    return ".".join(map(str, path))


def test_the_study_has_every_table() -> None:
    """So that a new table comes into the test below."""
    there = {type(table) for _, table in FOUND}
    timed = {kind for kind in kinds(StudyTable) if issubclass(kind, TimeTable)}
    assert there & timed
    bases = {kind for kind in kinds(StudyTable) if kind.__subclasses__()}  # of tables
    rigid = {BodySettings}  # of studies that have no boundary
    assert {*kinds(StudyTable), MeshSettings} - bases - timed - there == rigid
    assert not any(field.is_required() for kind in rigid for field in kind.model_fields.values())
    assert {name_of(path) for path in REQUIRED} >= {"time.step", "time.end", "title", "boundary.1.pressure.time"}
    assert Study in there


@pytest.mark.parametrize("path", REQUIRED, ids=name_of)
def test_a_required_key_is_missed(path: Path) -> None:
    with pytest.raises(InputError) as refusal:
        validate(without(path), "test.toml")
    # a place without its box is taken for a plane
    missed = (*path[:-1], "point") if path[-1] == "box" else path
    assert f"test.toml: {name_of(missed)} is missing; " in str(refusal.value)


@pytest.mark.parametrize("builder", BUILDERS)
def test_builders_require_nothing(builder: str) -> None:
    """Or what they require is missed by its name."""
    kind: Any = BUILDERS[builder]
    none = dataclasses.MISSING
    needed = [each.name for each in dataclasses.fields(kind) if each.default is none and each.default_factory is none]
    data = changed(STRIP, boundary=[], probe=[]) | {"mesh": {"builder": builder}}
    if not needed:
        check_study(validate(data, "test.toml"))
        return
    with pytest.raises(InputError, match=f"^mesh.{needed[0]} is missing; the table "):
        check_study(validate(data, "test.toml"))
