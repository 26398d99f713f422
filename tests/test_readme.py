"""The README tells the truth: its study runs, its commands and files exist."""

from __future__ import annotations

import csv
import itertools
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from mpi4py import MPI
from pydantic import BaseModel

from cases import fracsim
from fracsim.output.fields_file import read_times
from fracsim.report.pictures.frames import Shot, load
from fracsim.run import Run, run_study
from fracsim.scene import build_scene
from fracsim.studies import gallery
from fracsim.study import Study, TimeTable
from fracsim.study.check import check_study
from fracsim.study.mesh_source import BESIDE, NEEDED
from fracsim.study.reader import load_study, validate
from support.demo import readme_damage, run_demo

ROOT = Path(__file__).parent.parent
TEXT = (ROOT / "README.md").read_text()


def test_the_study_in_the_readme_runs(tmp_path: Path) -> None:
    """As printed, with what its comments offer, cut to four steps on a coarse mesh."""
    printed = re.search(r"```toml\n(.*?)```", TEXT, re.DOTALL)
    assert printed is not None
    data = tomllib.loads(printed.group(1))
    check_study(validate(data, "README"))
    data["mesh"]["h"], data["time"]["end"] = 0.05, 0.02
    data["fracture"] |= tomllib.loads(
        "heterogeneity = { modulus = 8.0, seed = 1 }\nfibre = { direction = [1, 0, 0], ratio = 2 }"
    )
    data["output"] |= {"surface": True, "cut": "forces", "picture": False}
    Run(build_scene(MPI.COMM_SELF, validate(data, "README")), tmp_path)()
    named = set(re.findall(r"^\| `([a-z_]+\.[a-z0-9]+|checkpoint/)", TEXT, re.MULTILINE))
    written = {path.name for path in tmp_path.iterdir()}
    assert {"history.csv", "pieces.csv", "surface.pvd", "summary.json", "study.toml"} <= named & written


def regions(folder: Path, upper: float) -> tuple[int, int]:
    """Parts that hang together of the cells of damage up to `upper`, and the most pieces in one of them, by VTK."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkFiltersCore import vtkConnectivityFilter, vtkThreshold

    threshold, connectivity = vtkThreshold(), vtkConnectivityFilter()
    h5 = folder / "fields.h5"
    threshold.SetInputData(load(Shot(0.0, h5, len(read_times(h5)) - 1)))
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
def test_the_threshold_in_the_readme_opens_the_crack(case: str, tmp_path: Path) -> None:
    """By VTK's own filter, in 3D and 2D: no part that is left has two pieces. At 0.5 the demo's crack stays shut."""
    folder = tmp_path / "out"
    if case == "demo":
        run_demo(folder)
        assert regions(folder, 0.5) == (1, 2)
    else:
        over = ["mesh.h=0.02", 'output.fields=["damage", "piece"]', "output.picture=false", "output.interval=0.3"]
        run_study(MPI.COMM_SELF, load_study("bar-2d", over), folder)
    count, pieces = regions(folder, readme_damage())
    assert count >= 2 and pieces == 1


def test_the_lines_of_python_in_the_readme_step_as_the_command_does(tmp_path: Path) -> None:
    """Exactly as printed; every row has the numbers of the history.csv that the command printed below them writes."""
    printed = re.search(r"```python\n(.*?)```\n\nThese are the numbers of `fracsim (.*?)`", TEXT, re.DOTALL)
    assert printed is not None
    names: dict[str, Any] = {}
    exec(printed.group(1), names)
    assert len(printed.group(1).splitlines()) <= 10
    result = fracsim(*printed.group(2).split(), "--set", "output.picture=false", "-o", tmp_path / "out")
    assert result.returncode == 0, result.stderr
    with (tmp_path / "out" / "history.csv").open(newline="") as file:
        written = list(csv.DictReader(file))
    columns = ["time", "elastic", "kinetic", "dissipated", "broken_edges", *names["scene"].probes.names]
    broken = list(itertools.accumulate(row[4] for row in names["rows"]))
    assert broken[-1] == np.count_nonzero(names["broken"]) > 0
    assert (names["chi"] < 1).any() and len(names["u"]) == len(names["scene"].balance.reactions) / 2
    for row, count, line in zip(names["rows"], broken, written, strict=True):
        found = [float(line[name]) for name in columns]  # which in another process may part in their last digit
        np.testing.assert_allclose([*row[:4], count, *row[5:]], found, rtol=1e-10, atol=1e-14)


def keys_of(model: type[BaseModel], path: str = "") -> Iterator[tuple[str, Any]]:
    """Every key that holds a value, as `table.key`, and its default; "needed" where it has none."""
    for name, field in model.model_fields.items():
        key = f"{path}NAME" if name == "regions" else f"{path}{name}"
        inner = [each for each in models_in(field.annotation) if not issubclass(each, TimeTable)]
        if not inner or key in ("boundary.on", "probe.on", "output.look"):  # a name, or a table
            yield key, "needed" if field.is_required() else field.get_default(call_default_factory=True)
        for each in dict.fromkeys(inner):
            yield from keys_of(each, f"{key}.")


def models_in(annotation: Any) -> list[type[BaseModel]]:
    """Tables that a value may be."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    inner = [found for each in get_args(annotation) for found in models_in(each)]
    return inner or (models_in(annotation.__value__) if hasattr(annotation, "__value__") else [])


def test_every_key_of_a_study_is_on_the_page_of_keys() -> None:
    """With its default, and no other key; those beside the source of a mesh too."""
    page = (ROOT / "docs" / "keys.md").read_text()
    rows = re.findall(r"^\| `([\w.]+)` \| (.*?) ?\| \S", page, re.MULTILINE)
    schema, written = dict(keys_of(Study)), dict(rows)
    beside = {f"mesh.{key}" for keys in BESIDE.values() for key in keys}
    assert set(written) == set(schema) | beside and len(rows) == len(written)
    for key, default in schema.items():
        said = written[key].strip()
        if isinstance(default, float) and not isinstance(default, bool):
            assert float(said) == default, key
        else:
            assert said == ("" if default is None else str(default).lower() if default in (True, False) else
                            str(default)) or (said, default) == ("1", 1), key  # fmt: skip
    assert {key for key in beside if written[key] == "needed"} == {f"mesh.{name}" for name in NEEDED}


def test_figures_of_the_gallery_are_those_of_its_page() -> None:
    """How many runs there are, and their seconds, added up: those of a picture of several shared among them."""
    found = re.search(r"seconds of each: (\d+) runs, (\d+) minutes of\s+processor time", TEXT)
    page, seconds = (ROOT / "docs" / "gallery.md").read_text(), dict[str, float]()
    for entry in gallery.ENTRIES:
        part = page[page.index(f"## {entry.name}\n") :].split("\n## ")[0]
        assert f"![{entry.text}](gallery/{entry.name}." in part and f"\n{entry.text}" in part
        of_it = re.search(r" (\d+) s[.;]", part)
        for folder, arguments in entry.runs:
            assert f"./env fracsim run {arguments} -o out/gallery/{folder}\n" in part and of_it is not None
            seconds.setdefault(folder, float(of_it.group(1)) / len(entry.runs))
    assert found is not None and int(found.group(1)) == len(seconds)
    assert sum(seconds.values()) / 60 == pytest.approx(int(found.group(2)), rel=0.1)


def test_captions_of_the_readme_are_what_the_pictures_show() -> None:
    """Times are those of the frames on the sheet; "by piece" is what is coloured."""
    entries, timed, coloured = {entry.name: entry for entry in gallery.ENTRIES}, 0, 0
    for name, caption in re.findall(r"`([\w-]+)`: ([^|\n]*)", TEXT):
        if name not in entries:
            continue
        render = entries[name].render
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
