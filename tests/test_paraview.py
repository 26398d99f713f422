"""What ParaView shows of what is written, by its own readers and the names in its menus, against closed forms."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from mpi4py import MPI

import paraview_reader
from cases import BAR, study
from fracsim.deformable_run import Run
from fracsim.scene import build_scene
from support.demo import run_demo, threshold_damage
from support.strained import strained, stress

pytestmark = pytest.mark.slow

XDMF_READERS = ("Xdmf3ReaderS", "Xdmf3ReaderT", "XDMFReader", "OpenDataFile")


@pytest.fixture(scope="module")
def evenly(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of a body that is strained evenly."""
    folder = tmp_path_factory.mktemp("strained") / "out"
    strained(folder)
    return folder


def shown(file: Path, reader: str, target: Path, *filters: tuple[str, dict[str, Any]]) -> dict[str, Any]:
    """What ParaView says of the last time of a file, and of what filters make of it."""
    try:
        result = paraview_reader.pvpython(paraview_reader.__file__, file, reader, "-1", json.dumps(filters), target)
    except FileNotFoundError:
        pytest.fail("there is no ParaView: run `make paraview` first, as `make test-all` does, or put pvpython in PATH")
    assert result.returncode == 0, result.stderr
    return json.loads(target.read_text())  # type: ignore[no-any-return]


def assert_stress(array: dict[str, tuple[float, float]]) -> None:
    """The six components have the names of what they are."""
    assert list(array) == ["XX", "YY", "ZZ", "XY", "YZ", "XZ"]
    wanted = stress()
    for name, (low, high) in array.items():
        value = wanted["XYZ".index(name[0]), "XYZ".index(name[1])]
        assert low == pytest.approx(value, rel=1e-6) and high == pytest.approx(value, rel=1e-6), name


@pytest.mark.parametrize("reader", XDMF_READERS)
def test_stress_has_the_right_names_in_every_reader(evenly: Path, reader: str, tmp_path: Path) -> None:
    found = shown(evenly / "fields.xdmf", reader, tmp_path / "shown.json")
    assert found["kind"] == "vtkUnstructuredGrid" and found["times"] == [0.0]
    assert_stress(found["arrays"]["Cell"]["stress"])
    assert list(found["arrays"]["Node"]["displacement"]) == ["X", "Y", "Z"]
    assert set(found["arrays"]["Cell"]) == {"stress", "von_mises", "region"}


def test_stress_has_the_right_names_on_the_surface(evenly: Path, tmp_path: Path) -> None:
    found = shown(evenly / "surface.pvd", "OpenDataFile", tmp_path / "shown.json")
    assert_stress(found["arrays"]["Cell"]["stress"])


# --- what docs/output.md tells users to do ---


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the demo on a coarse mesh."""
    folder = tmp_path_factory.mktemp("demo") / "out"
    run_demo(folder)
    return folder


def test_the_crack_of_the_demo_opens_as_the_readme_says(demo: Path, tmp_path: Path) -> None:
    """Warped by displacement, and thresholded: the cells that are left no longer hold together."""
    warp = ("WarpByVector", {"Vectors": ["POINTS", "displacement"]})
    threshold = (
        "Threshold",
        {"Scalars": ["CELLS", "damage"], "LowerThreshold": 0.0, "UpperThreshold": threshold_damage()},
    )
    whole = shown(demo / "fields.xdmf", "Xdmf3ReaderS", tmp_path / "whole.json", warp, ("Connectivity", {}))
    opened = shown(
        demo / "fields.xdmf", "Xdmf3ReaderS", tmp_path / "opened.json", warp, threshold, ("Connectivity", {})
    )
    assert whole["arrays"]["Cell"]["RegionId"] == {"": [0.0, 0.0]}
    assert opened["arrays"]["Cell"]["RegionId"][""][1] >= 1 and 0.7 * whole["cells"] < opened["cells"] < whole["cells"]


def test_the_surface_of_the_demo_has_the_colours_that_the_readme_names(demo: Path, tmp_path: Path) -> None:
    found = shown(demo / "surface.pvd", "OpenDataFile", tmp_path / "shown.json")
    assert {"piece", "origin", "age"} <= set(found["arrays"]["Cell"])
    assert found["arrays"]["Cell"]["piece"][""] == [0.0, 1.0]


def test_blocks_have_the_names_of_the_obstacles(tmp_path: Path) -> None:
    sphere = {"name": "hammer", "shape": "sphere", "radius": 0.1, "at": [0.5, 0.125, 0.6], "velocity": [0, 0, -0.1]}
    plane = {"name": "table", "shape": "plane", "at": [0, 0, -0.1], "normal": [0, 0, 1]}
    data = study(BAR, output={"surface": True}, obstacle=[sphere, plane])
    Run(build_scene(MPI.COMM_SELF, data), tmp_path / "out")()
    block = ("ExtractBlock", {"Selectors": ["/Root/hammer"]})
    found = shown(tmp_path / "out" / "surface.pvd", "OpenDataFile", tmp_path / "shown.json", block)
    assert found["blocks"] == ["body", "hammer", "table"] and found["cells"] > 100


def test_the_age_of_cracks_has_a_range_and_no_holes(demo: Path, tmp_path: Path) -> None:
    """From 0 on the skin to the oldest crack; an array of NaN has the range (1e299, -1e299), before anything breaks."""
    ages = shown(demo / "surface.pvd", "OpenDataFile", tmp_path / "shown.json")["arrays"]["Cell"]["age"][""]
    assert ages[0] == 0.0 and 0.1 < ages[1] < 0.45
    threshold = ("Threshold", {"Scalars": ["CELLS", "age"], "LowerThreshold": 0.0, "UpperThreshold": 1.0})
    whole, kept = (
        shown(demo / "surface.pvd", "OpenDataFile", tmp_path / "kept.json", *filters)["cells"]
        for filters in ((), (threshold,))
    )
    assert kept == whole  # no cell is left out, as those without a number would be
