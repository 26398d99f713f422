"""Values of every numeric key that are finite and absurd, or no numbers: one message, or a run.

`check` is tried with a seventh of them in `make test`, with all of them in `make test-all`, where runs are as well.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from mpi4py import MPI

from cases import BAR, changed
from fracsim.deformable_run import run_study
from fracsim.errors import FracsimError, InputError
from fracsim.study import Study, TimeTable
from fracsim.study.check import check_study
from fracsim.study.reader import validate
from support.absurd import BASES, Data, absurd, from_files, leaves, mutated, of_builders
from test_readme import keys_of, models_in


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Data]:
    return from_files(tmp_path_factory.mktemp("files"))


PARTS = 8
FILES = ("file", "soft file", "surface", "outline", "shell")


def test_the_studies_have_every_numeric_key(files: dict[str, Data]) -> None:
    """By the schema: what holds numbers, or lists of them, or values over time."""
    have = set()
    for data in (BASES | files).values():
        for at in leaves(data):
            names = [str(part) for part in at if not isinstance(part, int)]
            if names[:2] == ["material", "crust"]:
                names[1] = "NAME"
            have.add(".".join(name for name in names if name not in ("time", "value") or name == names[0]))
    numeric = {key for key in dict(keys_of(Study)) if is_numeric(key)}
    assert numeric <= have, numeric - have


def is_numeric(key: str) -> bool:
    """Whether a key of the schema may hold a number that is no flag."""
    models: list[Any] = [Study]
    for part in key.split("."):
        fields = [model.model_fields[name] for model in models for name in model.model_fields
                  if name == ("regions" if part == "NAME" else part)]  # fmt: skip
        models = [each for field in fields for each in models_in(field.annotation)]
    return key not in ("mesh.order", "solver") and any(holds_numbers(field.annotation) for field in fields)


def holds_numbers(annotation: Any) -> bool:
    if annotation in (int, float):
        return True
    if isinstance(annotation, type) and issubclass(annotation, TimeTable):
        return True
    inner = annotation.__value__ if hasattr(annotation, "__value__") else None
    return any(holds_numbers(each) for each in get_args(annotation)) or (inner is not None and holds_numbers(inner))


@pytest.mark.parametrize("share", [7, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", [*BASES, *FILES, "builders"])
def test_check_answers_every_value(name: str, share: int, files: dict[str, Data]) -> None:
    """In one sentence or with what will be built, without an overflow; a seventh of the values, or all of them."""
    bases = list(of_builders().values()) if name == "builders" else [(BASES | files)[name]]
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        for base in bases:
            check_study(validate(base, name))
            for what, data in absurd(base, share):
                try:
                    check_study(validate(data, "test.toml"))
                except InputError as error:
                    assert str(error).count("\n") == 0 and len(str(error)) < 1100, what


# what once hung, ended in a traceback or a warning of NumPy, or went on with no numbers
ONCE: dict[str, tuple[Data, tuple[str | int, ...], float]] = {
    "a spin of 1e9 rad/s hung": (BASES["rigid"], ("body", 0, "spin", 2), 1e9),
    "so did the spin after a blow": (BASES["rigid"], ("body", 0, "velocity", 2), -1e30),
    "a tip in the middle of a cell": (BASES["sheet"], ("crack", 0, "segment", 1, 1), -1.0),
    "a short normal": (BASES["strip"], ("boundary", 0, "on", "normal", 0), 1e-300),
    "all cells broken": (BASES["strip"], ("initial", "spin", 0), 1e9),
    "friction without slip": (BASES["explicit"], ("initial", "velocity", 0), 0.0),
    "a body out of sight": (BASES["bar"], ("initial", "velocity", 1), 1e30),
    "an obstacle at 1e9 m/s": (BASES["explicit"], ("obstacle", 1, "velocity", 2), -1e9),
    "an obstacle at -1e300": (BASES["bar"], ("obstacle", 1, "at", 2), -1e300),
    "an obstacle at -1e30": (BASES["explicit"], ("obstacle", 1, "at", 2), -1e30),
}  # fmt: skip


def ends_well(data: Data, folder: Path) -> str:
    """Run for a second at most: "done", or the message."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        try:
            summary = run_study(MPI.COMM_SELF, validate(data, "test.toml"), folder, overwrite=True, wall_limit=1.0)
        except FracsimError as error:
            assert str(error).count("\n") == 0
            return str(error)
    assert np.isfinite([summary["external_work"], summary["dissipated"]]).all()
    return str(summary["outcome"])


@pytest.mark.parametrize("name", ONCE)
def test_what_once_went_wrong(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And nothing is written beside the output folder."""
    base, at, value = ONCE[name]
    monkeypatch.chdir(tmp_path)
    assert ends_well(mutated(base, at, value), tmp_path / "out")
    assert {path.name for path in tmp_path.iterdir()} <= {"out"}


def test_a_spin_of_an_obstacle_is_bounded_as_well() -> None:
    """Its rotation was no number then, and the end PETSc's traceback."""
    with pytest.raises(InputError, match=r"obstacle\.1\.spin turns it by 1e\+27 rad in a step of 0\.001 s; at most"):
        validate(mutated(BASES["bar"], ("obstacle", 1, "spin", 0), 1e30), "test.toml")


@pytest.mark.parametrize(("at", "value"), [
    (("obstacle", 3, "velocity", 0), 1e30), (("obstacle", 2, "displacement", "value", 1, 0), 1e30),
])  # fmt: skip
def test_the_motion_of_a_driven_obstacle_is_bounded_as_well(at: tuple[str | int, ...], value: float) -> None:
    """The path of the body past it was bounded for minutes, before the wall limit was looked at."""
    with pytest.raises(InputError, match=r"moves it by 1e\+27 m in a step of 0\.001 s; at most 1e\+06 m are followed"):
        validate(mutated(BASES["bar"], at, value), "test.toml")


def test_the_initial_spin_of_a_body_is_bounded_as_well() -> None:
    """Its path past obstacles was bounded for minutes, before the wall limit was looked at."""
    with pytest.raises(InputError, match=r"initial\.spin turns it by 1e\+27 rad in a step of 0\.001 s; at most"):
        validate(mutated(BASES["bar"], ("initial", "spin", 0), 1e30), "test.toml")


def test_a_spin_beyond_what_is_followed_is_one_message() -> None:
    with pytest.raises(
        InputError, match=r"body\.0\.spin turns it by 2e\+06 rad in a step of 0\.002 s; at most 1000 rad"
    ):
        validate(mutated(BASES["rigid"], ("body", 0, "spin", 2), 1e9), "test.toml")


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"material": {"young": 1e300}}, "material.young: 1e+300 is out of reach; allowed are -1e+50 to 1e+50"),
        ({"material": {"density": 1e-300}}, "material.density: 1e-300 is out of reach; allowed are 1e-50 to 1e+50"),
        ({"mesh": {"h": 1e-300}}, "h = 1e-300 m is out of reach; take 1e-30 m or more"),
        ({"load": {"gravity": [0.0, 0.0, -1e300]}}, "load.gravity.2: -1e+300 is out of reach"),
        ({"fracture": {"strength": 1e300}}, "fracture.strength: 1e+300 is out of reach"),
    ],
)
def test_what_is_out_of_reach_is_told_with_what_is_allowed(tables: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError) as refusal:
        check_study(validate(changed(BAR, **tables), "test.toml"))
    assert message in str(refusal.value)


def every_run() -> Iterator[str]:
    yield from (*BASES, *FILES)


def test_a_body_that_is_too_small_for_an_obstacle_is_refused(files: dict[str, Data], tmp_path: Path) -> None:
    """Its motion was searched in 2^30 pieces: minutes, in which no wall limit was looked at."""
    message = ends_well(mutated(files["soft file"], ("mesh", "scale"), 1e-30), tmp_path / "out")
    assert re.match(r"obstacle\.0, block: edges of the body are 6\.88e-32 m long, those of the obstacle", message)


@pytest.mark.slow
@pytest.mark.parametrize("part", range(PARTS))
@pytest.mark.parametrize("name", every_run())
def test_a_run_ends_well_with_every_value(name: str, part: int, files: dict[str, Data], tmp_path: Path) -> None:
    """Some 3,000 of them, which take ten minutes or so together; each part has a time limit of its own."""
    for what, data in islice(absurd((BASES | files)[name]), part, None, PARTS):
        if "ksp_rtol = 0.0" in what:
            continue
        try:
            validate(data, "test.toml")
        except InputError:
            continue
        with warnings.catch_warnings():
            warnings.simplefilter("error", RuntimeWarning)
            assert ends_well(data, tmp_path / "out"), what
