"""The README tells the truth: its study runs, its commands and files exist."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from mpi4py import MPI

from fracsim.run import Run
from fracsim.scene import build_scene
from fracsim.study.check import check_study
from fracsim.study.file import validate

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


def test_files_that_the_readme_names_exist() -> None:
    """Source files and pictures."""
    for name in re.findall(r"`((?:fracsim|forms|meshes|studies|tests)/[\w/]+\.py)`", TEXT) + re.findall(
        r"\((docs/[^)]+)\)", TEXT
    ):
        assert (ROOT / name).exists(), name
