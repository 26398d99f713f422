"""The glossary defines what files and keys call things: columns, fields, schemes, figures of summary.json."""

from __future__ import annotations

import ast
import dataclasses
import re
from pathlib import Path

import fracsim
from fracsim.forms.schemes import SCHEMES
from fracsim.output.history import HISTORY_COLUMNS
from fracsim.study.time_and_output import FIELDS
from fracsim.timestepping.stepper import FailureCounts

ROOT = Path(__file__).parent.parent
TEXT = (ROOT / "docs" / "glossary.md").read_text()
ROWS = [row.strip("| ").split(" | ") for row in TEXT.split("\n## ")[0].splitlines() if row.startswith("| ")][1:]
CODE = set(re.findall(r"`([\w-]+)`", TEXT))


def keys_of_summaries() -> set[str]:
    """Literal keys of the dictionaries in functions that give summary.json its figures."""
    package, keys = Path(fracsim.__file__).parent, set()
    for name in ("deformable_run.py", "rigid_run.py", "monitors.py"):
        for function in ast.walk(ast.parse((package / name).read_text())):
            if isinstance(function, ast.FunctionDef) and function.name in ("_summary", "summary"):
                dicts = [node for node in ast.walk(function) if isinstance(node, ast.Dict)]
                keys |= {key.value for each in dicts for key in each.keys if isinstance(key, ast.Constant)}
    assert len(keys) > 15
    return {str(key) for key in keys}


def test_terms_are_in_alphabetical_order() -> None:
    terms = [re.sub(r"[`$\\*]", "", row[0]).lower() for row in ROWS]
    assert len(terms) > 100 and terms == sorted(terms) and len(set(terms)) == len(terms)


def test_rows_have_a_meaning() -> None:
    """A sentence at least, and four columns: term, unit, meaning, section."""
    assert not [row for row in re.findall(r"^\|.*$", TEXT.split("\n## ")[0], re.MULTILINE) if row.count("|") != 5]
    meanings = re.findall(r"^\| [^|]+ \| [^|]*\| ([^|]+) \|", TEXT.split("\n## ")[0], re.MULTILINE)[1:]
    assert len(meanings) == len(ROWS) and not [each for each in meanings if not each.endswith(".")]


def test_columns_fields_and_figures_are_defined() -> None:
    """All names that files of the output folder have."""
    trouble = {field.name for field in dataclasses.fields(FailureCounts)}
    names = {*HISTORY_COLUMNS, *FIELDS, *SCHEMES, *trouble, *keys_of_summaries()}
    assert not names - CODE


def test_words_of_older_code_have_the_word_of_the_field() -> None:
    """One row a word; those that users met in output are mapped."""
    rows = re.findall(r"^\| (.*) \| (.*) \|$", TEXT.split("\n## ")[1], re.MULTILINE)[1:]
    words = " ".join(left for left, _ in rows)
    assert len(rows) > 30 and len({left for left, _ in rows}) == len(rows)
    assert all(word in words for word in ("crumbs", "dust", "tethers", "skin", "walls", "pieces", "memory", "struck"))
