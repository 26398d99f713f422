"""The README tells the truth: its study runs, its commands and files exist."""

from __future__ import annotations

import csv
import itertools
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from cases import fracsim
from fracsim.output.fields_file import read_times
from fracsim.report.pictures.shots import Shot, load
from fracsim.run import Run, run_study
from fracsim.scene import build_scene
from fracsim.study.check import check_study
from fracsim.study.file import load_study, validate
from support.demo import readme_damage, run_demo

ROOT = Path(__file__).parent.parent
TEXT = (ROOT / "README.md").read_text()
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


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


def test_files_that_the_pages_name_exist() -> None:
    """Source files, pictures and other pages, with the headings that links go to."""
    for page in PAGES:
        text = page.read_text()
        for name in re.findall(r"`((?:fracsim|forms|meshes|studies|tests)/[\w/]+\.py)`", text):
            assert (ROOT / name).exists(), name
        for name, _, heading in (link.partition("#") for link in re.findall(r"\]\(([^):]+)\)", text)):
            assert (page.parent / name).exists(), (page.name, name)
            headings = [
                re.sub(r"[^\w -]", "", line).lower().replace(" ", "-")
                for line in re.findall(r"^#+ (.*)$", (page.parent / name).read_text(), re.MULTILINE)
            ] if heading else []  # fmt: skip
            assert not heading or heading in headings, (page.name, heading)
