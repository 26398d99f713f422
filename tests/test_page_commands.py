"""Commands on the pages and in the comments of the studies have options that exist and values that are allowed."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer

from fracsim.cli import app
from fracsim.report.sweep import sweep_cases
from fracsim.study.catalogue import catalogue
from fracsim.study.check import check_study
from fracsim.study.reader import find_study, load_study

pytestmark = pytest.mark.any_release

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
STUDIES = sorted((ROOT / "studies").glob("*.toml"))
LAUNCHERS = r"^(?:\S*=\S+ )*(?:\./env )?(?:mpirun -n \d+ |srun --mpi=pmix )?(fracsim .*)"


def code_lines(text: str) -> Iterator[str]:
    """Lines of the code of a page, with continued lines joined."""
    code = "\n".join(re.findall(r"^(?: {4}|\t)(.*)$", text, re.MULTILINE))
    for block in (code, *re.findall(r"```(?:bash|sh)?\n(.*?)```", text, re.DOTALL)):
        yield from block.replace("\\\n", " ").splitlines()


def command_lines(text: str) -> Iterator[str]:
    """Commands of fracsim in the code of a page."""
    for line in code_lines(text):
        if found := re.match(LAUNCHERS, line.strip()):
            yield found.group(1)


def comment_lines(study: Path) -> Iterator[str]:
    """Commands of fracsim, and settings of the study, in its comments; two spaces separate words on the result."""
    text = "\n".join(re.findall(r"^#\s*(.*)$", study.read_text(encoding="utf-8"), re.MULTILINE))
    for line in text.replace("\\\n", " ").splitlines():
        if line.startswith(("fracsim ", "--set ")):
            command = re.split(r"\s{2,}", line)[0]
            yield command if command.startswith("fracsim") else f"fracsim run {study.stem} {command}"


def is_redirection(word: str) -> bool:
    return word in (">", "|")


def parsed(line: str) -> tuple[str, dict[str, Any]]:
    """Name of the command of a line and its parameters, as the command line reads them."""
    words = shlex.split(line, comments=True)[1:]
    words = words[: next((index for index, word in enumerate(words) if is_redirection(word)), None)]
    group: Any = typer.main.get_command(app)
    command = group.commands[words[0]]
    return words[0], command.make_context(words[0], words[1:]).params


def check_command(line: str) -> None:
    """Raise an error unless the command would be accepted; studies and meshes of the user are not read."""
    name, parameters = parsed(line)
    study, settings = parameters.get("study"), parameters.get("set_") or []
    if name == "show" or (settings and study in catalogue()["studies"]):
        find_study(str(study))
        cases = [case.overrides for case in sweep_cases(settings, Path())] if name == "sweep" else [settings]
        for case in cases:
            if not any("mine." in setting for setting in case):
                check_study(load_study(find_study(str(study)), case))


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_commands_of_a_page_are_accepted(page: Path) -> None:
    for line in command_lines(page.read_text(encoding="utf-8")):
        check_command(line)


@pytest.mark.parametrize("study", STUDIES, ids=lambda path: path.stem)
def test_commands_in_the_comments_of_a_study_are_accepted(study: Path) -> None:
    for line in comment_lines(study):
        check_command(line)


def test_there_are_commands() -> None:
    assert sum(len(list(command_lines(page.read_text()))) for page in PAGES) > 150
    assert sum(len(list(comment_lines(study))) for study in STUDIES) > 40


@pytest.mark.parametrize(
    "line", ["fracsim run loaf --fast", "fracsim run loaf --set mesh.g=1", "fracsim render out/a --dark"]
)
def test_a_wrong_command_is_noticed(line: str) -> None:
    with pytest.raises(Exception, match=r"fast|mesh\.g|dark"):
        check_command(line)
