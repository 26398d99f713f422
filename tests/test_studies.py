"""Every study of the package takes a few steps on a coarse mesh, as do the variants that its comments offer."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
from mpi4py import MPI

from fracsim.deformable_run import Run, run_study
from fracsim.meshes import BUILDERS
from fracsim.meshes.topology import boundary_facets
from fracsim.scene import build_scene
from fracsim.studies import folder
from fracsim.study.check import check_study
from fracsim.study.reader import load_study

STUDIES = sorted(folder().glob("*.toml"))
# study -> its cell size for a run of a second or so
COARSE = {
    "bar-2d": ["mesh.h=0.02"],
    "bent-bar": ["mesh.h=0.01"],
    "bowl": ["mesh.count=8"],
    "brazilian": ["mesh.h=0.03"],
    "branching": ["mesh.h=0.003"],
    "bread": ["mesh.h=0.02"],
    "charpy": ["mesh.h=0.002", "mesh.h_notch=0.0006"],
    "charpy-3d": ["mesh.h=0.005", "mesh.h_notch=0.0015"],
    "charpy-3d-ductile": ["mesh.h=0.005", "mesh.h_notch=0.0015"],
    "charpy-klst": ["mesh.h=0.001", "mesh.h_notch=0.0003"],
    "cylinder": ["mesh.h=0.01"],
    "doormat": ["mesh.h=0.025"],
    "dropped-vase": ["mesh.h=0.015"],
    "granite-cylinder": ["mesh.h=0.03"],
    "hammered-figure": ["mesh.h=0.015"],
    "hammered-vase": ["mesh.h=0.015"],
    "izod": ["mesh.h=0.002", "mesh.h_notch=0.0006"],
    "izod-3d": ["mesh.h=0.005", "mesh.h_notch=0.0015"],
    "izod-3d-ductile": ["mesh.h=0.005", "mesh.h_notch=0.0015"],
    "jelly-figure": ["mesh.h=0.015"],
    "kalthoff": ["mesh.h=0.005"],
    "l-panel": ["mesh.h=0.1", "mesh.h_corner=0.05"],
    "loaf": ["mesh.h=0.02"],
    "notched-bar": ["mesh.h=0.002", "mesh.h_notch=0.0003"],
    "notched-shear": ["mesh.h=0.0001"],
    "platens": ["mesh.h=0.01"],
    "punched-slab": ["mesh.h=0.015"],
    "rigid-dropped-vase": ["mesh.h=0.02"],
    "rigid-figure": ["mesh.h=0.015"],
    "rigid-boats": ["mesh.h=0.5", "body.0.copies=[1,1,2]"],
    "rigid-ornament": ["mesh.h=0.01"],
    "rigid-ornaments": ["mesh.h=0.012", "body.0.copies=[1,2,1]"],
    "rigid-rods": ["mesh.h=0.01"],
    "rigid-slab": ["mesh.h=0.025"],
    "rigid-vase": ["mesh.h=0.015"],
    "rigid-wall": ["mesh.h=0.15"],
    "struck-figure": ["mesh.h=0.015"],
    "struck-vase": ["mesh.h=0.012"],
    "table-loaf": ["mesh.h=0.02"],
    "wall": ["mesh.h=0.15"],
}
QUIET = ["output.picture=false"]


def offered(path: Path) -> list[list[str]]:
    """The --set options of each comment line at the head of a study."""
    head = [line for line in path.read_text().splitlines() if line.startswith("#")]
    return [found for line in head if (found := re.findall(r"--set (\S+)", line))]


def steps(path: Path, overrides: list[str], count: int, out: Path) -> dict[str, Any]:
    """The summary of a run of so many steps."""
    timing = load_study(path, overrides).time
    short = [*overrides, *QUIET, f"time.end={count * timing.step!r}"]
    return run_study(MPI.COMM_SELF, load_study(path, short), out / "out")


@pytest.mark.parametrize("path", STUDIES, ids=lambda path: path.stem)
def test_a_coarse_version_runs(path: Path, tmp_path: Path) -> None:
    summary = steps(path, COARSE[path.stem], 3, tmp_path)
    assert summary["outcome"] == "done" and summary["steps"] == 3 and not summary.get("steps_failed")
    assert np.isfinite(summary["external_work"])


@pytest.mark.usefixtures("little_built")
@pytest.mark.parametrize("path", STUDIES, ids=lambda path: path.stem)
def test_what_the_comments_offer_is_valid(path: Path) -> None:
    for options in offered(path):
        assert "cells" in check_study(load_study(path, options))[0]


def test_full_sizes_are_those_of_the_paper() -> None:
    """M22's table 2: cell counts within a tenth."""
    wanted = {
        "doormat": [234_400],
        "jelly-figure": [159_100],
        "loaf": [620_600],
        "struck-figure": [4_700, 41_100],
        "struck-vase": [23_700, 38_800],
    }
    for name, counts in wanted.items():
        path = folder() / f"{name}.toml"
        sizes = [options for options in offered(path) if any("mesh.h=" in option for option in options)]
        lines = [check_study(load_study(path, options))[0] for options in sizes]
        found = [
            int(match[1].replace(",", "")) for line in lines if (match := re.search(r"about ([\d,]+) cells", line))
        ]
        assert sorted(found) == pytest.approx(counts, rel=0.1), name


@pytest.mark.parametrize("approach", ["chi", "edge"])
def test_the_strip_by_both_approaches(approach: str, tmp_path: Path) -> None:
    """One study serves both: the edge form needs a linear energy. Both break at the same time of the loading."""
    options = ["mesh.h=0.03", "material.energy=linear", f"fracture.approach={approach}", "time.end=0.14", *QUIET]
    summary = Run(build_scene(MPI.COMM_SELF, load_study(folder() / "bar-2d.toml", options)), tmp_path)()
    assert summary["broken_edges"] > 0 and summary["steps_failed"] == 0


def test_the_blow_lands_on_a_surface_of_ones_own(tmp_path: Path) -> None:
    """The [mesh] of a study is replaced as a whole, and the box of the blow finds the facets of the new body."""
    mesh = BUILDERS["figure"](h=0.014).build()
    meshio.Mesh(mesh.points, [("triangle", boundary_facets(mesh.cells))]).write(tmp_path / "own.stl")
    own = f'mesh={{surface="{tmp_path}/own.stl", h=0.015}}'
    summary = steps(folder() / "struck-figure.toml", [own], 4, tmp_path / "out")
    assert summary["outcome"] == "done" and summary["external_work"] > 0
