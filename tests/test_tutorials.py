"""The tutorials run as printed: files and commands of a section, one after the other, in an empty folder."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from contextlib import chdir
from pathlib import Path

import pytest

from cases import fracsim
from fracsim.report.run_output import open_run

PAGE = (Path(__file__).parent.parent / "docs/tutorials.md").read_text(encoding="utf-8")
SECTIONS = {text.splitlines()[0]: text for text in PAGE.split("\n## ")[1:]}
# pictures of the page are drawn anew into this folder, if it is given
PICTURES = os.environ.get("TUTORIAL_PICTURES")


def run_section(title: str, folder: Path) -> None:
    """Write the files of a section, whose first line is a comment with their name, and run its commands."""
    steps = re.compile(r"```\w+\n# (\S+)\n(.*?)```|^    \./env ([^\n]*)$", re.MULTILINE | re.DOTALL)
    for name, content, command in steps.findall(SECTIONS[title]):
        if name:
            (folder / name).write_text(content, encoding="utf-8")
            continue
        program, *arguments = shlex.split(command)
        if program == "fracsim":
            with chdir(folder):
                result = fracsim(*arguments, timeout=300)
        else:
            assert program == "python3"
            result = subprocess.run(
                [sys.executable, *arguments], cwd=folder, capture_output=True, text=True, timeout=300
            )
        assert result.returncode == 0, f"{command}\n{result.stderr}"
    for picture in folder.glob("*.png") if PICTURES else ():
        shutil.copy(picture, PICTURES)


def test_a_part_and_its_test(tmp_path: Path) -> None:
    """The finest mesh is within 2 % of Howland's factor, and the coarsest one is not; as the page says."""
    run_section("A part and its test", tmp_path)
    by_hand = 45e6 * 0.05 * 0.006 / 3.13
    peaks = [open_run(tmp_path / f"out/h-{h}").summary["peak_reactions"]["reaction_grip_x"] for h in ("2", "1.4", "1")]
    assert peaks == pytest.approx([4852, 4599, 4352], rel=0.03)
    assert peaks[2] == pytest.approx(by_hand, rel=0.02) and peaks[0] > 1.1 * by_hand


@pytest.mark.slow
def test_a_mesh_to_shatter(tmp_path: Path) -> None:
    run_section("A mesh to shatter", tmp_path)
    pieces = {name: int(open_run(tmp_path / "out" / name).history["pieces"][-1]) for name in ("ring", "glass", "stone")}
    assert pieces["glass"] > pieces["ring"] > pieces["stone"] > 1, pieces
    assert all(int(open_run(tmp_path / "out" / name).history["pieces"][-1]) > 1 for name in ("stick", "bread"))
    assert (tmp_path / "ring.mp4").stat().st_size > 10_000 and list((tmp_path / "out/ring/export").glob("*.glb"))


def test_a_batch(tmp_path: Path) -> None:
    run_section("A batch", tmp_path)
    rows = (tmp_path / "out/sweep/sweep.csv").read_text().splitlines()
    assert len(rows) == 5 and (tmp_path / "out/sweep/report.html").is_file()
