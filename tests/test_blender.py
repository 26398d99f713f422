"""Exported files in the programs that users open them with: Blender, and Khronos' validator of glTF."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista

from fracsim.output.surface.vtk_files import read_body_frames
from fracsim.report.export import export_surfaces
from programs import gltf_issues, opened_in_blender, run_in_blender
from support.exported import broken_bar, dropped_bar

pytestmark = pytest.mark.slow

# colours of the look plain, #b4bac4 and #e0762b, and of planes, #e6dfd0, in linear light
COLOURS = {"skin": [0.4564, 0.4910, 0.5520], "inside": [0.7454, 0.1812, 0.0242], "plane": [0.7913, 0.7379, 0.6308]}


@pytest.fixture(scope="module")
def rigid(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("mujoco")
    return dropped_bar(tmp_path_factory.mktemp("rigid") / "out")


@pytest.fixture(scope="module")
def deforming(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return broken_bar(tmp_path_factory.mktemp("bar"))


def boxes_of(run: Path) -> list[Any]:
    """Least and largest coordinates of the body at each frame, by VTK."""
    files = [run / file for _, file in read_body_frames(run / "surface.pvd")]
    return [np.array(pyvista.read(file).bounds).reshape(3, 2).T for file in files]


def assert_boxes(found: dict[str, Any], run: Path) -> None:
    """All that is shown but the floor has the box of the body, frame by frame."""
    for shown, wanted in zip(found["boxes"], boxes_of(run), strict=False):
        parts = np.array([box for name, box in shown.items() if name != "floor"])
        box = np.array([parts[:, 0].min(axis=0), parts[:, 1].max(axis=0)])
        np.testing.assert_allclose(box, wanted, atol=1e-5)


@pytest.mark.parametrize("kind", ["glb", "usd"])
def test_rigid_pieces_in_blender(kind: str, rigid: Path, tmp_path: Path) -> None:
    """An object a shape, skin and inside on one mesh, z upwards, and keyframes at Blender's frames 0, 1, ..."""
    pytest.importorskip("pxr")
    (file,) = export_surfaces(rigid, kind, tmp_path)
    found = opened_in_blender(file, tmp_path / "found.json")
    names = set(found["materials"])
    assert "floor" in names and {"piece_000000", "piece_000001"} <= names
    assert found["materials"]["floor"] == ["plane"] and found["materials"]["piece_000001"] == ["skin", "inside"]
    for name, colour in COLOURS.items():
        assert found["colours"][name] == pytest.approx(colour, abs=1e-4)
    assert_boxes(found, rigid)
    assert found["range"][2] == 24
    if kind == "usd":
        assert found["range"][:2] == [0, len(boxes_of(rigid)) - 1]


def test_a_deforming_body_in_blender(deforming: Path, tmp_path: Path) -> None:
    """Skin and inside are an object each, whose meshes change from frame to frame."""
    pytest.importorskip("pxr")
    (file,) = export_surfaces(deforming, "usd", tmp_path)
    found = opened_in_blender(file, tmp_path / "found.json")
    assert found["materials"] == {"skin": ["skin"], "inside": ["inside"]} and found["range"][:2] == [0, 1]
    assert [set(shown) for shown in found["boxes"][:2]] == [{"skin"}, {"skin", "inside"}]
    assert_boxes(found, deforming)


@pytest.mark.parametrize("kind", ["glb", "obj"])
def test_a_frame_in_blender(kind: str, deforming: Path, tmp_path: Path) -> None:
    file = export_surfaces(deforming, kind, tmp_path, frame=1)[0]
    found = opened_in_blender(file, tmp_path / "found.json")
    assert set(found["materials"]) == {f"piece_{n:06d}" for n in range(3)}
    assert all(set(names) == {"skin", "inside"} for names in found["materials"].values())
    parts = np.array([*found["boxes"][0].values()])
    np.testing.assert_allclose([parts[:, 0].min(axis=0), parts[:, 1].max(axis=0)], boxes_of(deforming)[1], atol=1e-5)


def test_glb_passes_the_validator(rigid: Path, deforming: Path, tmp_path: Path) -> None:
    files = [*export_surfaces(rigid, "glb", tmp_path), *export_surfaces(deforming, "glb", tmp_path)]
    for file in files:
        issues = gltf_issues(file)
        assert (issues["numErrors"], issues["numWarnings"]) == (0, 0), issues["messages"]


def test_the_script_of_the_page_makes_a_scene(deforming: Path, tmp_path: Path) -> None:
    pytest.importorskip("pxr")
    page = (Path(__file__).parents[1] / "docs" / "blender.md").read_text()
    found = re.search(r"```python\n(.*?)```", page, re.DOTALL)
    assert found is not None
    target = tmp_path / "out/loaf/export"
    target.mkdir(parents=True)
    export_surfaces(deforming, "usd", target)[0].rename(target / "loaf.usdc")
    run_in_blender(found.group(1), tmp_path)
    assert (tmp_path / "loaf.blend").stat().st_size > 10_000
