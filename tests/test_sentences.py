"""Sentences of README and pages are short enough to be read once."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

pytestmark = pytest.mark.any_release

ROOT = Path(__file__).parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
NOT_PROSE = ("    ", "|", "#", "!", "<")


def sentences(text: str) -> list[str]:
    """Sentences of a page without code, tables, headings and pictures; a formula or a piece of code is one word."""
    text = re.sub(r"```.*?```|\$\$.*?\$\$", "", text, flags=re.S)
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)
    text = re.sub(r"`[^`]*`|\$[^$]*\$", "X", text)
    paragraphs = [block for block in re.split(r"\n\s*\n", text) if not block.startswith(NOT_PROSE)]
    items = [item for block in paragraphs for item in re.split(r"\n(?=\s*(?:[-*]|\d+\.) )", block)]
    return [part for item in items for part in re.split(r"(?<=[.!?:;])\s+(?=[A-Z*(])", " ".join(item.split()))]


def words(sentence: str) -> int:
    return len([word for word in sentence.split() if re.search(r"\w", word)])


def test_sentences_are_found_and_counted() -> None:
    page = "# Title\n\nOne two `a b` three. Four\nfive $x$.\n\n    code\n\n- an item of\n  five words\n- two words\n"
    assert [words(each) for each in sentences(page)] == [4, 3, 5, 2]


def test_no_sentence_of_the_pages_is_longer_than_forty_words() -> None:
    long = [f"{page.name}: {each}" for page in PAGES for each in sentences(page.read_text()) if words(each) > 40]
    assert not long, "\n".join(long)


def test_the_mean_sentence_of_each_page_has_at_most_twenty_words() -> None:
    for page in PAGES:
        counts = [count for each in sentences(page.read_text()) if (count := words(each)) > 1]
        assert sum(counts) / len(counts) <= 20, page.name
