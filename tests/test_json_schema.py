"""JSON schema of study files: an independent validator accepts the packaged studies and refuses mistakes."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fastjsonschema
import pytest

from cases import fracsim
from fracsim.errors import Exit
from fracsim.studies import folder
from fracsim.study.documentation import study_schema

pytestmark = pytest.mark.any_release

NAMES = sorted(path.stem for path in folder().glob("*.toml"))


@pytest.fixture(scope="module")
def validate() -> Callable[[Any], Any]:
    valid: Callable[[Any], Any] = fastjsonschema.compile(study_schema())
    return valid


@pytest.mark.parametrize("name", NAMES)
def test_packaged_studies_are_valid(validate: Callable[[Any], Any], name: str) -> None:
    validate(tomllib.loads((folder() / f"{name}.toml").read_text()))


@pytest.mark.parametrize(
    ("table", "key", "value"),
    [("mesh", "order", 3), ("time", "sptep", 1e-3), ("material", "poisson", 0.5), ("fracture", "strength", -1.0)],
)
def test_mistakes_are_refused(validate: Callable[[Any], Any], table: str, key: str, value: Any) -> None:
    data = tomllib.loads((folder() / "loaf.toml").read_text())
    data[table][key] = value
    with pytest.raises(fastjsonschema.JsonSchemaException):
        validate(data)


def test_keys_have_descriptions_and_units() -> None:
    material = study_schema()["$defs"]["MaterialSettings"]["properties"]
    assert material["young"]["unit"] == "Pa" and material["density"]["unit"] == "kg/m^3"
    assert all(entry.get("description") for entry in material.values())


def test_the_command_prints_json() -> None:
    done = fracsim("schema")
    assert done.returncode == Exit.DONE and json.loads(done.stdout) == json.loads(json.dumps(study_schema()))


def test_a_new_study_is_a_packaged_one(tmp_path: Path) -> None:
    shown = fracsim("show", "loaf").stdout
    assert shown == (folder() / "loaf.toml").read_text()
    target = tmp_path / "mine.toml"
    assert fracsim("new", target, "--from", "loaf").returncode == Exit.DONE
    assert target.read_text() == f"#:schema fracsim.schema.json\n{shown}"
    assert fracsim("check", target).returncode == Exit.DONE
    again = fracsim("new", target, "--from", "loaf")
    assert again.returncode == Exit.BAD_INPUT and f"{target} exists" in again.stderr


def test_an_unknown_packaged_study_is_refused() -> None:
    done = fracsim("show", "loef")
    assert done.returncode == Exit.BAD_INPUT
    assert done.stderr == "fracsim: no packaged study is called loef; did you mean loaf?\n"
