"""Outlines from text files: area and groups of what fills them, and no preferred directions."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cases import STRIP, changed
from fracsim.errors import InputError
from fracsim.meshes.data import MeshError
from fracsim.meshes.directions import preferred_directions
from fracsim.meshes.random_points.outline_file import fill_outline, read_outline
from fracsim.meshes.topology import signed_measures
from fracsim.study.check import check_study
from fracsim.study.mesh_source import build_mesh
from fracsim.study.reader import load_study, validate

# an L of 2 x 2 without its upper right quarter, with a square hole of 0.2; closed by hand, with a remark
L = """
# metres
0, 0, foot
2 0 toe
2, 1
1, 1
1, 2, head
0, 2
0, 0

0.4, 0.4, hole
0.6, 0.4, hole
0.6, 0.6, hole
0.4, 0.6, hole
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    (tmp_path / "l.csv").write_text(L)
    return tmp_path / "l.csv"


def test_what_is_drawn_is_filled(path: Path) -> None:
    drawn = read_outline(path)
    mesh = fill_outline(drawn, 0.1)
    measures = signed_measures(mesh.points, mesh.cells)
    assert (measures > 0).all() and measures.sum() == pytest.approx(3 - 0.04, rel=1e-12)
    assert drawn.area == pytest.approx(2.96) and drawn.cells_estimate(0.1) == pytest.approx(len(mesh.cells), rel=0.15)
    lengths = {
        name: np.linalg.norm(np.diff(mesh.points[edges], axis=1), axis=2).sum()
        for name, edges in mesh.facet_groups.items()
    }
    assert lengths == pytest.approx({"outline": 8.8, "foot": 2.0, "toe": 1.0, "head": 1.0, "hole": 0.8}, rel=1e-12)
    half = fill_outline(read_outline(path, scale=0.5), 0.05)
    np.testing.assert_allclose(half.points, mesh.points / 2, atol=1e-12)


def test_it_has_no_preferred_directions(path: Path) -> None:
    mesh = fill_outline(read_outline(path), 0.05)
    assert preferred_directions(mesh)["directions"] < 1.35
    sides = mesh.points[mesh.cells] - mesh.points[np.roll(mesh.cells, 1, axis=1)]
    lengths = np.linalg.norm(sides, axis=2)
    assert 0.5 * 0.05 < np.median(lengths) < 1.1 * 0.05 and lengths.max() < 1.6 * 0.05


def test_a_study_has_it(path: Path) -> None:
    data = changed(STRIP, boundary=[{"on": "foot", "fix": "xy"}], probe=[{"name": "grip", "on": "hole"}])
    data["mesh"] = {"outline": str(path), "h": 0.1}
    study = validate(data, "test.toml")
    lines = "\n".join(check_study(study))
    assert "groups outline, foot, toe, head, hole" in lines and "size        2 x 2 m" in lines
    assert len(build_mesh(study.mesh).cells) > 600
    (path.parent / "s.toml").write_text('title = "t"\n[mesh]\noutline = "l.csv"\nh = 0.1\n[material]\nyoung = 1.0\n'
                                        "poisson = 0.3\ndensity = 1.0\n[time]\nstep = 1.0\nend = 1.0\n")  # fmt: skip
    assert load_study(path.parent / "s.toml").mesh.outline == path  # beside the study


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0 0\n1 0\n", "a polygon needs three corners or more"),
        ("0 0\n1 zero\n1 1\n", "line 2: write `x, y` or `x, y, group`"),
        ("0 0\n1 1\n1 0\n0 1\n", "the outline meets itself"),
        ("", "three corners"),
    ],
)
def test_what_is_no_outline_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "o.csv").write_text(text)
    with pytest.raises(MeshError, match=message):
        fill_outline(read_outline(tmp_path / "o.csv"), 0.2)


def test_keys_beside_it_are_checked(path: Path) -> None:
    for keys, message in (
        ({}, "mesh.h = None"), ({"h": 0.1, "holes": 1}, "mesh.holes is not a known key beside mesh.outline"),
        ({"h": 0.1, "seed": 0.5}, "mesh.seed = 0.5"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=message):
            build_mesh(validate(changed(STRIP) | {"mesh": {"outline": str(path)} | keys}, "test.toml").mesh)
