"""What code and pages refer to exists: sections of the theory, headings of pages, files of the repository."""

from __future__ import annotations

import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

pytestmark = pytest.mark.any_release

ROOT = Path(__file__).parent.parent
SOURCES = ("fracsim", "forms", "meshes", "studies", "tests")
THEORY = ROOT / "docs" / "theory.md"
PAGES = [
    *(ROOT / f"{name}.md" for name in ("README", "CHANGELOG", "CONTRIBUTING")),
    *sorted((ROOT / "docs").glob("*.md")),
]
CODE = [path for room in SOURCES for kind in ("*.py", "*.c", "*.toml") for path in sorted((ROOT / room).rglob(kind))]
# a page of docs/ in a comment or docstring, with the heading that is meant
MENTION = re.compile(r"\bdocs/([\w-]+\.md)(?:#([\w-]+))?")
LINK = re.compile(r"\]\(([^):\s]+)\)")
FILE = re.compile(r"`((?:fracsim|forms|meshes|studies|tests|docs)/[\w/.-]*\w/?)`")


def anchor(heading: str) -> str:
    """The anchor that GitHub gives a heading: lower case, no punctuation, hyphens for spaces."""
    plain = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading)
    return re.sub(r"[^\w -]", "", plain).strip().lower().replace(" ", "-")


@cache
def anchors(page: Path) -> list[str]:
    """Anchors of all headings of a page, in order; lines in blocks of code are no headings."""
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)
    return [anchor(heading) for heading in re.findall(r"^#+ (.*)$", text, re.MULTILINE)]


def broken_mentions(text: str) -> Iterator[str]:
    """Mentions of pages of docs/ that do not exist, or have no such heading."""
    for name, heading in MENTION.findall(text):
        page = ROOT / "docs" / name
        if not page.exists() or (heading and heading not in anchors(page)):
            yield f"docs/{name}#{heading}"


def broken_links(text: str, page: Path) -> Iterator[str]:
    """Links of a page to files or headings that do not exist."""
    for link in LINK.findall(text):
        name, _, heading = link.partition("#")
        target = page.parent / name if name else page
        if not target.exists() or (heading and heading not in anchors(target.resolve())):
            yield link


def broken_files(text: str) -> Iterator[str]:
    """Files and folders of the repository, in backquotes, that do not exist."""
    yield from (name for name in FILE.findall(text) if not (ROOT / name).exists())


@pytest.mark.parametrize(
    ("text", "found"),
    [("docs/theory.md#" + "contact-law", 1), ("docs/" + "theories.md", 1), ("docs/theory.md#contact", 0)],
)
def test_a_wrong_mention_is_found(text: str, found: int) -> None:
    assert len(list(broken_mentions(text))) == found


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("[a](theory.md#nothing)", 1), ("[a](nothing.md)", 1), ("[a](../fracsim/nothing.py)", 1), ("[a](#nothing)", 1),
        ("[a](#contact) [b](../fracsim/deformable_run.py) [c](https://example.org/x#y) [d](fracture.md)", 0),
    ],
)  # fmt: skip
def test_a_wrong_link_is_found(text: str, found: int) -> None:
    assert len(list(broken_links(text, THEORY))) == found


def test_a_wrong_file_is_found() -> None:
    assert list(broken_files("`fracsim/errors.py`, `fracsim/nothing.py`, `fracsim/mesh`, `forms/nothing/`")) == [
        "fracsim/nothing.py", "forms/nothing/",
    ]  # fmt: skip


def test_code_refers_to_pages_and_sections_that_exist() -> None:
    """And many parts of it refer to the theory, so that the reader of an equation finds its source."""
    broken = {path.relative_to(ROOT): found for path in CODE if (found := list(broken_mentions(path.read_text())))}
    assert not broken
    referring = [path for path in CODE if "docs/theory.md#" in path.read_text()]
    assert len(referring) > 50


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.name)
def test_pages_refer_to_what_exists(page: Path) -> None:
    """Links and mentions of all pages; files that a page names, except in the history of changes."""
    text = page.read_text()
    assert not list(broken_links(text, page))
    assert not list(broken_mentions(text))
    assert page.name == "CHANGELOG.md" or not list(broken_files(text))


def test_no_reference_to_a_text_outside_the_repository() -> None:
    """The notes from which the theory was made are not in the repository: nothing refers to them by their name."""
    outside = re.compile("METHOD" + r"(?:\.md)?[ ,)]*(?:section|sec\.|\d)|METHOD" + r"\.md")
    assert not [str(path) for path in [*CODE, *PAGES[2:]] if outside.search(path.read_text())]


def test_sections_of_the_theory_have_one_anchor_and_their_sources() -> None:
    assert len(set(anchors(THEORY))) == len(anchors(THEORY))
    sections = re.split(r"^## ", THEORY.read_text(), flags=re.MULTILINE)[1:]
    assert len(sections) > 20
    assert not [section.split("\n")[0] for section in sections if "\nSources: " not in section]


def test_sections_of_the_theory_are_referred_to_by_code() -> None:
    """But for what no single line of code does: notation, the head of a group of sections, what is still open."""
    used = {heading for path in CODE for name, heading in MENTION.findall(path.read_text()) if name == THEORY.name}
    assert set(anchors(THEORY)) - used == {"theory", "notation", "solver", "open-questions"}


def test_abbreviations_of_papers_are_spelled_out_once() -> None:
    """With author, year and title, before any other use."""
    text = THEORY.read_text()
    for short, author, year in (("M22", "Mandal", "2022"), ("B07", "Bao", "2007")):
        first = text.index(short)
        assert text[first - 2 : first + 5] == f"**{short}**"
        assert author in text[first : first + 40] and year in text[first : first + 120]
