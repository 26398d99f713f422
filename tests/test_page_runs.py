"""The commands of fracsim on the pages run as printed, in their order, and end without an error.

`make gallery` and `make figures` run those of the gallery and of the figures of the papers, and draw their pictures;
test_tutorials.py runs those of the tutorials, test_batch.py the scripts of jobs. Containers and pip are on other pages.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from fracsim.errors import Exit
from fracsim.study.catalogue import catalogue
from test_page_commands import PAGES, ROOT, code_lines

ELSEWHERE = ("gallery", "paper-figures", "tutorials", "batch", "install")
COMMAND = r"(?:\./env )?((?:mpirun -n \d+ )?fracsim .*|python3 -m fracsim\..*)"
# What the pages take as the user's own, and how it is made.
FILES = {
    "mine.toml": "fracsim new mine.toml --from bar-2d",
    "part.toml": "fracsim new part.toml --from bar-2d",
    "out/mine": "fracsim run mine.toml -o out/mine",
    "out/a": "fracsim run bar-2d -o out/a",
    "out/b": "fracsim run bar-2d --set mesh.h=0.02 -o out/b",
}
LONG = " --wall-limit 300"  # s
CURVE = "motion_grip_x,reaction_grip_x\n0.0,0.0\n0.01,100.0\n"
SURFACE = """
import pyvista
pyvista.read("body.vtu").extract_surface().triangulate().clean().save("mine.stl")
"""


def page_commands(page: Path) -> list[str]:
    """Commands in the code of a page, without comments."""
    lines = code_lines(page.read_text(encoding="utf-8"))
    return [re.split(r"\s{2,}# ", match.group(1))[0].strip() for line in lines if (match := re.match(COMMAND, line))]


def is_run_here(page: Path) -> bool:
    return page.stem not in ELSEWHERE and bool(page_commands(page))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], None]:
    """Run a command in one folder of all pages, once, after what it needs."""
    folder, done = tmp_path_factory.mktemp("pages"), set[str]()
    (folder / "test.csv").write_text(CURVE, encoding="utf-8")

    def execute(command: str) -> None:
        if command in done:
            return
        done.add(command)
        for word in shlex.split(command)[2:]:
            name = word.removeprefix("out/")
            if (folder / word).exists() or f"-o {word}" in command:
                continue
            if (ROOT / word).is_file():  # readers run the command in the root folder of the repository
                (folder / word).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(ROOT / word, folder / word)
            elif word in FILES:
                execute(FILES[word])
            elif word.startswith("out/") and name in catalogue()["studies"]:
                execute(f"fracsim run {name}")
        if command.startswith("fracsim new"):  # the page has used the user's study before it says how one begins
            (folder / command.split()[2]).unlink(missing_ok=True)
        if "mine.stl" in command and not (folder / "mine.stl").exists():
            execute("fracsim mesh struck-figure -o body.vtu")
            subprocess.run([sys.executable, "-c", SURFACE], cwd=folder, check=True, timeout=100)
        if "--restart" in command:  # of a run that was stopped
            stopped = command.replace("--restart", "--wall-limit 8").split()
            assert subprocess.run(stopped, cwd=folder, capture_output=True, timeout=100).returncode == Exit.STOPPED
        # a long run is stopped, which is no error; its later frames are not drawn on the pages
        limit = LONG if command.startswith("fracsim run") and "--wall-limit" not in command else ""
        process = subprocess.Popen(
            ["bash", "-c", f"exec {command}{limit}"], cwd=folder, text=True, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, start_new_session=True, env=os.environ | {"BROWSER": "true"},
        )  # fmt: skip
        served = command.startswith("fracsim view") and "-o" not in command
        printed = ""
        try:
            if served:
                assert process.stdout is not None
                printed = process.stdout.readline()
                os.killpg(process.pid, signal.SIGINT)
            printed += process.communicate(timeout=1500)[0]
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
        assert process.returncode in ((Exit.DONE, Exit.STOPPED) if limit else (Exit.DONE,)), (
            f"{command}\n{printed[-2000:]}"
        )
        assert not served or "http://" in printed, printed

    return execute


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("page", [page for page in PAGES if is_run_here(page)], ids=lambda page: page.stem)
def test_the_commands_of_a_page_run(page: Path, run: Callable[[str], None]) -> None:
    for command in page_commands(page):
        run(command)


def test_most_pages_with_commands_are_run() -> None:
    """README, studies, output, running and others: a page whose code is written otherwise would be missed."""
    commands = [command for page in PAGES if is_run_here(page) for command in page_commands(page)]
    assert len(commands) > 90 and {"fracsim run loaf", "mpirun -n 2 fracsim run loaf"} <= set(commands)
