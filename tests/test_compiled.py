"""Functions in C are compiled once, whoever asks first, and say what is wrong where they cannot be."""

from __future__ import annotations

from ctypes import c_int
from pathlib import Path

import pytest

from fracsim.errors import InputError
from fracsim.mesh import compiled


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where libraries go, and nothing is there yet."""
    made = tmp_path / "cache"
    monkeypatch.setattr(compiled, "get_options", lambda: {"cache_dir": made})
    compiled.library.cache_clear()
    return made


def test_a_file_is_compiled_once_and_anew_where_it_changes(folder: Path, tmp_path: Path) -> None:
    """The second time no compiler is asked for; another text is another library; nothing else is left there."""
    source = tmp_path / "twice.c"
    source.write_text("int twice(int n) { return 2 * n; }\n")
    assert compiled.library(source).twice(c_int(21)) == 42
    compiled.library.cache_clear()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiled.subprocess, "run", lambda *_, **__: pytest.fail("compiled again"))
        assert compiled.library(source).twice(c_int(4)) == 8
    source.write_text("int twice(int n) { return n + n + 1; }\n")
    compiled.library.cache_clear()
    assert compiled.library(source).twice(c_int(4)) == 9
    assert sorted(path.suffix for path in folder.iterdir()) == [".so", ".so"]


@pytest.mark.parametrize("text, compiler, said", [("int twice(", "", "error"), ("", "no-compiler", "No such file")])
def test_what_cannot_be_compiled_says_why(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, compiler: str, said: str
) -> None:
    """The command, what it said, and what to do; nothing is left of it."""
    monkeypatch.setenv("CC", compiler)
    source = tmp_path / "twice.c"
    source.write_text(text)
    with pytest.raises(InputError, match=f"twice.c.*{said}.*install a C compiler"):
        compiled.library(source)
    assert not list(folder.iterdir())
