"""What ParaView shows of what is written, by its own readers and the names in its menus, against closed forms."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import paraview_reader
from support.strained import strained, stress

pytestmark = pytest.mark.slow

XDMF_READERS = ("Xdmf3ReaderS", "Xdmf3ReaderT", "XDMFReader", "OpenDataFile")


@pytest.fixture(scope="module")
def evenly(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run of a body that is strained evenly."""
    folder = tmp_path_factory.mktemp("strained") / "out"
    strained(folder)
    return folder


def shown(file: Path, reader: str, target: Path, time: float = -1.0) -> dict[str, Any]:
    """What ParaView says of a file."""
    try:
        result = paraview_reader.pvpython(paraview_reader.__file__, file, reader, str(time), target)
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
        assert low == pytest.approx(value, rel=1e-9) and high == pytest.approx(value, rel=1e-9), name


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
