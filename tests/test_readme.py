"""README and pages tell the truth: their studies run, their commands, files and keys exist."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, get_args

import numpy as np
import pytest
from mpi4py import MPI
from pydantic import BaseModel, TypeAdapter

from fracsim.deformable_run import Run, run_study
from fracsim.output.fields_file import read_frame_times
from fracsim.report.pictures.frames import FrameSource, load_grid
from fracsim.scene import build_scene
from fracsim.studies import gallery, paper_figures
from fracsim.studies.picture_page import draw_commands
from fracsim.study import Study, TimeTable
from fracsim.study.body import SOURCE_KEYS
from fracsim.study.check import check_study
from fracsim.study.documentation import study_file_page, study_keys, toml
from fracsim.study.reader import load_study, validate
from support.demo import run_demo, threshold_damage

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
FILES_NAMED_IN = {page: (ROOT / page).read_text() for page in ("README.md", "docs/output.md")}


@pytest.mark.parametrize("page", ["README.md", "docs/study-file.md"])
def test_the_study_of_a_page_runs(page: str, tmp_path: Path) -> None:
    """As printed, with scatter and fibres, for four steps on a coarse mesh; its files are those that the pages name."""
    printed = re.search(r"```toml\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)
    assert printed is not None
    data = tomllib.loads(printed.group(1))
    check_study(validate(data, page))
    data["mesh"]["h"], data["time"]["end"] = 0.05, 0.02
    data["fracture"] |= tomllib.loads(
        "heterogeneity = { modulus = 8.0, seed = 1 }\nfibre = { direction = [1, 0, 0], ratio = 2 }"
    )
    data["output"] = data.get("output", {}) | {"surface": True, "cut": "forces", "picture": False}
    Run(build_scene(MPI.COMM_SELF, validate(data, page)), tmp_path)()
    written = {path.name for path in tmp_path.iterdir()}
    for text in FILES_NAMED_IN.values():
        named = set(re.findall(r"^\| `([a-z_]+\.[a-z0-9]+|checkpoint/)", text, re.MULTILINE))
        assert {"history.csv", "pieces.csv", "surface.pvd", "summary.json", "study.toml"} <= named & written


def test_the_readme_is_short() -> None:
    """Everything else has a page, to which it links."""
    text = FILES_NAMED_IN["README.md"]
    printed = re.search(r"```toml\n(.*?)```", text, re.DOTALL)
    assert printed is not None and len(printed.group(1).splitlines()) <= 10
    assert len(text.splitlines()) <= 250
    linked = set(re.findall(r"\(docs/([\w-]+\.md)", text))
    assert linked == {path.name for path in DOCS.glob("*.md")}


def regions(folder: Path, upper: float) -> tuple[int, int]:
    """Parts that hang together of the cells of damage up to `upper`, and the most pieces in one of them, by VTK."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkFiltersCore import vtkConnectivityFilter, vtkThreshold

    threshold, connectivity = vtkThreshold(), vtkConnectivityFilter()
    h5 = folder / "fields.h5"
    threshold.SetInputData(load_grid(FrameSource(0.0, h5, len(read_frame_times(h5)) - 1)))
    threshold.SetInputArrayToProcess(0, 0, 0, 1, "damage")  # array 0 of input 0, on cells
    threshold.SetLowerThreshold(0.0)
    threshold.SetUpperThreshold(upper)
    connectivity.SetInputConnection(threshold.GetOutputPort())
    connectivity.SetExtractionModeToAllRegions()
    connectivity.ColorRegionsOn()
    connectivity.Update()
    data = connectivity.GetOutput().GetPointData()
    region, piece = (vtk_to_numpy(data.GetArray(name)) for name in ("RegionId", "piece"))
    return int(region.max()) + 1, max(len(np.unique(piece[region == k])) for k in range(region.max() + 1))


@pytest.mark.parametrize("case", ["demo", "bar-2d"])
def test_the_threshold_of_the_page_on_output_opens_the_crack(case: str, tmp_path: Path) -> None:
    """By VTK's own filter, in 3D and 2D: no part that is left has two pieces. At 0.5 the demo's crack stays shut."""
    folder = tmp_path / "out"
    if case == "demo":
        run_demo(folder)
        assert regions(folder, 0.5) == (1, 2)
    else:
        over = ["mesh.h=0.02", 'output.fields=["damage", "piece"]', "output.picture=false", "output.interval=0.3"]
        run_study(MPI.COMM_SELF, load_study("bar-2d", over), folder)
    count, pieces = regions(folder, threshold_damage())
    assert count >= 2 and pieces == 1


def keys_of(model: type[BaseModel], path: str = "") -> Iterator[tuple[str, Any]]:
    """Every key that holds a value, as `table.key`, and its default; "required" where it has none."""
    for name, field in model.model_fields.items():
        key = f"{path}NAME" if name == "regions" else f"{path}{name}"
        inner = [each for each in models_in(field.annotation) if not issubclass(each, TimeTable)]
        if not inner or key in ("boundary.on", "probe.on", "output.look"):  # a name, or a table
            yield key, "required" if field.is_required() else field.get_default(call_default_factory=True)
        for each in dict.fromkeys(inner):
            yield from keys_of(each, f"{key}.")


def models_in(annotation: Any) -> list[type[BaseModel]]:
    """Tables that a value may be."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    inner = [found for each in get_args(annotation) for found in models_in(each)]
    return inner or (models_in(annotation.__value__) if hasattr(annotation, "__value__") else [])


def test_every_key_of_a_study_is_on_the_page_of_the_study_file() -> None:
    """With its default, and no other key; those beside the source of a mesh too."""
    page = (DOCS / "study-file.md").read_text()
    rows = re.findall(r"^\| `([\w.]+)` \| (.*?) ?\| ", page, re.MULTILINE)
    schema, written = dict(keys_of(Study)), dict(rows)
    beside = {f"mesh.{key}" for keys in SOURCE_KEYS.values() for key in keys}
    assert set(written) == set(schema) | beside and len(rows) == len(written)
    for key, default in schema.items():
        said = written[key].strip()
        if isinstance(default, float) and not isinstance(default, bool):
            assert float(said) == default, key
        elif isinstance(default, list):
            assert json.loads(said) == default, key
        else:
            assert said == ("" if default is None else str(default).lower() if default in (True, False) else
                            str(default)) or (said, default) == ("1", 1), key  # fmt: skip
    required = {f"mesh.{name}" for keys in SOURCE_KEYS.values() for name, entry in keys.items() if entry.required}
    assert {key for key in beside if written[key] == "required"} == required == {"mesh.h", "mesh.thickness"}


def test_the_page_of_the_study_file_is_written_from_the_schema() -> None:
    """`make study-file` writes it."""
    assert (DOCS / "study-file.md").read_text() == study_file_page()


def test_every_key_has_a_description_and_examples_are_valid() -> None:
    """Of its own type, one by one; a sentence ends with a full stop."""
    models, seen = [Study], set()
    while models:
        model = models.pop()
        if model in seen:
            continue
        seen.add(model)
        for name, field in model.model_fields.items():
            inner = [kind for kind in models_in(field.annotation) if not issubclass(kind, TimeTable)]
            models += inner
            assert (field.description or "").endswith("."), f"{model.__name__}.{name}"
            for example in field.examples or []:
                TypeAdapter(Annotated[field.annotation, *field.metadata] if field.metadata else field.annotation
                            ).validate_python(example)  # fmt: skip
    units = {entry.path: entry.unit for entry in study_keys()}
    assert (units["fracture.strength"], units["time.end"], units["material.density"]) == ("Pa", "s", "kg/m^3")


@pytest.mark.parametrize(
    ("value", "text"),
    [(3e4, "3e4"), (1e-6, "1e-6"), (300.0, "300.0"), (0.35, "0.35"), (float("inf"), "inf"), (True, "true"), (0.0, "0"),
     ({"a": [1, "b"]}, '{ a = [1, "b"] }'), (-2.5e7, "-2.5e7")],
)  # fmt: skip
def test_values_are_written_as_toml(value: Any, text: str) -> None:
    assert toml(value) == text and tomllib.loads(f"x = {text}")["x"] == value


def test_figures_of_the_gallery_are_those_of_its_page() -> None:
    """How many runs there are, and their seconds, added up: those of a picture of several shared among them."""
    found = re.search(r"(\d+) runs, (\d+) minutes of\s+processor time", (DOCS / "development.md").read_text())
    page, seconds = (DOCS / "gallery.md").read_text(), dict[str, float]()
    for entry in gallery.ENTRIES:
        part = page[page.index(f"## {entry.name}\n") :].split("\n## ")[0]
        assert f"![{entry.text}](gallery/{entry.name}." in part and f"\n{entry.text}" in part
        of_it = re.search(r" (\d+) s[.;]", part)
        for folder, arguments in entry.runs:
            assert f"./env fracsim run {arguments} -o out/gallery/{folder}\n" in part and of_it is not None
            seconds.setdefault(folder, float(of_it.group(1)) / len(entry.runs))
    assert found is not None and int(found.group(1)) == len(seconds)
    assert sum(seconds.values()) / 60 == pytest.approx(int(found.group(2)), rel=0.1)


def test_the_page_of_figures_has_the_commands_of_its_pictures() -> None:
    page = (DOCS / "paper-figures.md").read_text()
    for entry in paper_figures.ENTRIES:
        part = page[page.index(f"## {entry.name}\n") :].split("\n## ")[0]
        assert f"![{entry.text}](gallery/{entry.name}." in part and entry.remark in part
        for folder, arguments in entry.runs:
            assert f"./env fracsim run {arguments} -o out/gallery/{folder}\n" in part
        assert all(f"./env {command}\n" in part for command in draw_commands(entry, f"{entry.name}.png"))


def test_captions_of_the_gallery_are_what_the_pictures_show() -> None:
    """Times are those of the frames on the sheet; "by piece" is what is coloured."""
    timed, coloured = 0, 0
    for entry in gallery.ENTRIES:
        name, caption, render = entry.name, entry.text, entry.render
        assert "by piece" not in caption or "--field piece" in render, name
        coloured += "by piece" in caption
        times = re.search(r"((?:\d+, )+\d+ and \d+) ms", caption)
        sheet = re.search(r"--sheet ([\d,-]+)", render)
        if times is None or sheet is None:
            continue
        study, numbers = load_study(name), map(int, sheet.group(1).split(","))
        assert study.output.interval is not None
        last = round(study.time.end / study.output.interval)
        shown = [1e3 * study.output.interval * (n if n >= 0 else last + 1 + n) for n in numbers]
        assert [int(each) for each in re.findall(r"\d+", times.group(1))] == pytest.approx(shown), name
        timed += 1
    assert timed >= 3 and coloured >= 1
