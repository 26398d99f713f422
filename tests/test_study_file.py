"""Study files: overriding values, and writing the study as it was run."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import pytest
import tomli_w
from pydantic import BaseModel

from cases import BAR, STRIP, changed, study, write_study
from fracsim.errors import InputError
from fracsim.studies import folder
from fracsim.study import Study
from fracsim.study.mesh_source import find_builder
from fracsim.study.reader import find_study, load_study, study_text, validate

pytestmark = pytest.mark.any_release

Data = dict[str, Any]


def loaded(tmp_path: Path, *overrides: str, base: Data = BAR) -> Study:
    return load_study(write_study(tmp_path / "study.toml", base), overrides)


# --- --set ----------------------------------------------------------------------------------------------------------


def test_set_overrides_scalars_and_makes_tables(tmp_path: Path) -> None:
    found = loaded(tmp_path, "time.end=0.5", "load.gravity=[0, 0, -9.81]", "title=a word", "material.energy=stvk")
    assert found.time.end == 0.5
    assert found.load is not None and found.load.gravity == [0, 0, -9.81]
    assert found.title == "a word"
    assert found.material.energy == "stvk"


def test_set_overrides_entries_of_lists(tmp_path: Path) -> None:
    found = loaded(tmp_path, "boundary.0.fix=x", "boundary.1.velocity.0=0.5", "probe.0.on=left", "mesh.size.2=0.5")
    assert found.boundary[0].fix == "x"
    assert found.boundary[1].velocity == [0.5, 0.0, 0.0]
    assert found.probe[0].on == "left"
    assert found.mesh.parameters["size"] == [1.0, 0.25, 0.5]


def test_set_takes_whole_tables_and_every_toml_type(tmp_path: Path) -> None:
    found = loaded(
        tmp_path,
        'boundary.1={on = "top", pressure = {time = [0, 1], value = [0, 2.5]}}',
        "time.adapt=false",
        "output.every=7",
        'output.fields=["stress"]',
        "solver.snes_max_it=3",
        "solver.ksp_type=cg",
        "fracture.strength=inf",
    )
    assert found.boundary[1].on == "top" and found.boundary[1].pressure.value == [0, 2.5]  # type: ignore[union-attr]
    assert (found.time.adapt, found.output.every, found.output.fields) == (False, 7, ["stress"])
    assert found.solver == {"snes_max_it": 3, "ksp_type": "cg"}
    assert found.fracture is not None and found.fracture.strength == float("inf")


def test_the_last_set_counts(tmp_path: Path) -> None:
    assert loaded(tmp_path, "time.end=1.0", "time.end=2.0").time.end == 2.0


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("time.end", "--set time.end: write key.path=value, for example --set time.step=1e-3"),
        ("=3", "--set =3: write key.path=value"),
        ("time..end=3", "--set time..end=3: write key.path=value"),
        ("boundary.7.fix=x", "--set boundary.7.fix=x: 7 is not an entry; there are 2, counted from 0"),
        ("boundary.left.fix=x", "left is not an entry"),
        ("title.end=3", "--set title.end=3: title is a value, not a table"),
        ("time.ennd=3", "time.ennd is not a known key; did you mean end?"),
        ("tmie.end=3", "tmie is not a known key; did you mean time?"),
        ("time.end=soon", 'time.end = "soon": must be a number'),
        ("time.end=2024-01-01", "time.end = "),
    ],
)
def test_set_refuses(tmp_path: Path, override: str, message: str) -> None:
    with pytest.raises(InputError) as refusal:
        loaded(tmp_path, override)
    assert message in str(refusal.value)


# --- writing --------------------------------------------------------------------------------------------------------

EVERYTHING: Data = changed(
    STRIP,
    material={"stiff": {"young": 1e7, "strength": float("inf")}, "energy": "linear", "plane": "stress"},
    fracture={"strength": float("inf"), "radius": 0.1},
    damping={"mass": 1.0},
    boundary=[
        {"on": "left", "fix": "xy"},
        {"on": {"box": [[0, 0], [0.1, 0.2]]}, "displacement": {"time": [0, 1], "value": [[0, "free"], [1e-3, "free"]]}},
        {"on": {"point": [1, 0], "normal": [1, 0], "within": 0.01}, "pressure": {"time": [0, 1], "value": [0, -5]}},
        {"on": "top", "traction": [0, 1e3]},
    ],
    load={"gravity": [0, -9.81], "body_force": {"time": [0.0, 2.0], "value": [[0, 0], [1, 1]]}},
    initial={"velocity": [1, 0], "spin": [2.0]},
    time={"scheme": "newmark", "smallest": 1e-5, "adapt": False},
    solver={"ksp_type": "cg", "snes_max_it": 7, "ksp_rtol": 1e-8, "pc_gamg_reuse_interpolation": True},
    probe=[{"name": "a", "on": {"box": [[0, 0], [1, 1]]}, "record": "displacement"}, {"name": "b", "point": [0, 0]}],
    output={"every": 3, "checkpoint": 60.0},
)


@pytest.mark.parametrize("data", [BAR, STRIP, EVERYTHING], ids=["bar", "strip", "everything"])
def test_the_written_study_is_the_study(tmp_path: Path, data: Data) -> None:
    first = validate(data, "test.toml")
    path = tmp_path / "study.toml"
    path.write_text(study_text(first, ["fracsim: 0.1", "ranks: 2"]))
    again = load_study(path)
    # the builder's defaults are written out as well: the same builder, with more of its parameters named
    assert find_builder(again.mesh) == find_builder(first.mesh)
    assert again.model_copy(update={"mesh": first.mesh}) == first
    assert path.read_text().startswith("# fracsim: 0.1\n# ranks: 2\n")
    assert study_text(again) == study_text(first)


@pytest.mark.usefixtures("little_built")
@pytest.mark.parametrize("path", sorted(folder().glob("*.toml")), ids=lambda path: path.stem)
def test_studies_of_the_package_survive_being_written(tmp_path: Path, path: Path) -> None:
    from fracsim.study.check import check_study

    first = load_study(path)
    (tmp_path / "study.toml").write_text(study_text(first))
    again = load_study(tmp_path / "study.toml")
    assert again.model_copy(update={"mesh": first.mesh}) == first
    assert check_study(again) == check_study(first)


def test_every_default_is_written() -> None:
    import tomllib

    data = tomllib.loads(study_text(study(STRIP)))
    assert data["time"] == {
        "scheme": "generalized-alpha", "step": 0.005, "end": 0.05, "adapt": True, "mass": "lumped",
        "beta": 0.25, "gamma": 0.5, "rho": 0.8
    }  # fmt: skip
    assert data["fracture"] == {
        "strength": 2e4, "approach": "chi", "radius": 0.0, "kernel": "linear", "tie_break": 1e-6, "crumbs": True,
        "unilateral": False, "branching": False, "law": "griffith", "criterion": "normal-stress", "edge_law": "brittle",
    }  # fmt: skip
    assert "plasticity" not in data
    data = tomllib.loads(study_text(study(STRIP, plasticity={"yield_stress": 1e4})))
    assert data["plasticity"] == {
        "yield_stress": 1e4, "measure": "von-mises", "flow_rate": float("inf"), "hardening": 0.0,
        "update": "extrapolated",
    }  # fmt: skip
    assert data["mesh"]["pattern"] == "structured"
    assert data["material"]["plane"] == "strain"


def test_mesh_files_are_looked_for_beside_the_study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lines = ["mesh = {file = 'part.msh'}", "material = {young = 1, poisson = 0, density = 1}"]
    (tmp_path / "study.toml").write_text("\n".join(["title = 'x'", *lines, "time = {step = 1, end = 1}"]))
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert load_study(Path("../study.toml")).mesh.file == tmp_path / "part.msh"
    # what is given on the command line is looked for where the command is given
    assert load_study(Path("../study.toml"), ["mesh.file=other.msh"]).mesh.file == Path("other.msh").resolve()


def paths_of(kind: Any, name: str = "") -> Iterator[str]:
    """Keys of a table and of those in it that are paths, by the types that the schema gives."""
    for key, field in kind.model_fields.items():
        whole, todo = f"{name}.{key}" if name else key, [field.annotation]
        while todo:
            if (each := todo.pop()) is Path:
                yield whole
            elif isinstance(each, type) and issubclass(each, BaseModel):
                yield from paths_of(each, whole)
            todo += get_args(each)


def test_every_path_is_looked_for_beside_the_study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All keys of the schema that hold a path; the file that is read is the one beside the study."""
    keys = sorted(set(paths_of(Study)))
    assert keys == ["mesh.file", "mesh.outline", "mesh.shell", "mesh.surface", "obstacle.file"]
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    for key in keys:
        table, last = key.split(".")
        given: dict[str, Any] = {"title": "x", "material": {"young": 1, "poisson": 0, "density": 1}}
        given |= {"time": {"step": 1, "end": 1}, "mesh": {"builder": "box", "size": [1.0, 1.0, 1.0], "h": 1.0}}
        if table == "mesh":
            given["mesh"] = {last: "part"}
            given["time"]["scheme"] = "rigid" if last == "shell" else "newmark"
        else:
            given["obstacle"] = [{"name": "it", "shape": "mesh", "at": [0.0, 0.0, 9.0], last: "part"}]
        (tmp_path / "study.toml").write_text(tomli_w.dumps(given))
        loaded = load_study(Path("../study.toml"))
        found = loaded.mesh if table == "mesh" else loaded.obstacle[0]
        assert getattr(found, last) == tmp_path / "part", key


def test_a_folder_is_not_the_packaged_study_of_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """`run bar-2d -o bar-2d` makes a folder of that name; a file of that name is what was meant."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bar-2d").mkdir()
    packaged = find_study("bar-2d")
    assert packaged.is_file() and packaged.name == "bar-2d.toml" and load_study("bar-2d").title.startswith("A 2D bar")
    (tmp_path / "loaf").write_text("title = 1")
    assert find_study("loaf") == Path("loaf")
    for name in ("there/is/none", "nothing"):
        assert find_study(name) == Path(name)


@pytest.mark.parametrize(
    ("scheme", "key", "value", "owner"),
    [
        ("generalized-alpha", "gamma", 0.6, "newmark"),
        ("newmark", "rho", 0.5, "generalized-alpha"),
        ("backward-euler", "rho", 0.5, "generalized-alpha"),
        ("explicit", "beta", 0.3, "newmark"),
        ("quasi-static", "rho", 0.0, "generalized-alpha"),
    ],
)
def test_a_parameter_of_another_scheme_is_refused(scheme: str, key: str, value: float, owner: str) -> None:
    """It would do nothing. Its default is accepted: study.toml of a run has it."""
    with pytest.raises(InputError, match=f'{key} = .* is of scheme = "{owner}" and does nothing with'):
        study(STRIP, time={"scheme": scheme, key: value})
    study(
        STRIP, time={"scheme": owner, "beta": 0.4, key: value} if owner == "newmark" else {"scheme": owner, key: value}
    )
