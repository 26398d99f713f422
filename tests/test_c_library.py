"""Functions in C are compiled once, whoever asks first, and say what is wrong where they cannot be."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from ctypes import Structure, c_int, c_int64
from pathlib import Path

import numpy as np
import pytest

from fracsim.errors import CannotWrite, InputError
from fracsim.mesh import c_library, library_cache
from support.damaged import DAMAGES, damage


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where libraries go, and nothing is there yet."""
    made = tmp_path / "cache"
    monkeypatch.setattr(library_cache, "get_options", lambda: {"cache_dir": made})
    c_library.load_library.cache_clear()
    return made


def test_a_file_is_compiled_once_and_anew_where_it_changes(folder: Path, tmp_path: Path) -> None:
    """The second time no compiler is asked for; another text is another library; nothing else is left there."""
    source = tmp_path / "twice.c"
    source.write_text("int twice(int n) { return 2 * n; }\n")
    assert c_library.load_library(source).twice(c_int(21)) == 42
    c_library.load_library.cache_clear()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(c_library.subprocess, "run", lambda *_, **__: pytest.fail("compiled again"))
        assert c_library.load_library(source).twice(c_int(4)) == 8
    source.write_text("int twice(int n) { return n + n + 1; }\n")
    c_library.load_library.cache_clear()
    assert c_library.load_library(source).twice(c_int(4)) == 9
    assert sorted(path.suffix for path in folder.iterdir()) == [".lock", ".sha256", ".sha256", ".so", ".so"]


@pytest.mark.parametrize("text, compiler, said", [("int twice(", "", "error"), ("", "no-compiler", "No such file")])
def test_what_cannot_be_compiled_says_why(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str, compiler: str, said: str
) -> None:
    """The command, what it said, and what to do; nothing is left of it."""
    monkeypatch.setenv("CC", compiler)
    source = tmp_path / "twice.c"
    source.write_text(text)
    with pytest.raises(InputError, match=f"twice.c.*{said}.*install a C compiler"):
        c_library.load_library(source)
    assert [path.name for path in folder.iterdir()] == ["fracsim.lock"]


TWICE = "int twice(int n)\n{\n    return 2 * n;\n}\n"


@pytest.fixture
def twice(folder: Path, tmp_path: Path) -> Path:
    """A C file that has been compiled."""
    source = tmp_path / "twice.c"
    source.write_text(TWICE)
    assert c_library.load_library(source).twice(21) == 42
    c_library.load_library.cache_clear()
    return source


@pytest.fixture
def copied(folder: Path, twice: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Path]:
    """A library of that file in another folder, which is used from then on: dlopen gives one of the same path that the
    process has already, whatever the file is now."""

    def copy(name: str) -> Path:
        other = folder.with_name(name.replace(" ", "-"))
        shutil.copytree(folder, other)
        monkeypatch.setattr(library_cache, "get_options", lambda: {"cache_dir": other})
        c_library.load_library.cache_clear()
        return next(other.glob("*.so"))

    return copy


@pytest.mark.parametrize("seal", [True, False])
def test_a_damaged_library_is_compiled_once_more(
    copied: Callable[[str], Path], twice: Path, capfd: pytest.CaptureFixture[str], seal: bool
) -> None:
    """The note names the file; without a digest beside it what is cut is known by its end."""
    for kind in DAMAGES if seal else [kind for kind in DAMAGES if kind != "flipped"]:
        library = copied(kind)
        damage(library, kind)
        if not seal:
            library.with_suffix(".sha256").unlink()
        assert c_library.load_library(twice).twice(21) == 42, kind
        assert f"{library} was damaged; it is compiled once more" in capfd.readouterr().err, kind
        assert library_cache.is_complete(library)


@pytest.mark.parametrize("seal", [True, False])
def test_a_whole_library_is_loaded_without_a_word(
    copied: Callable[[str], Path], twice: Path, capfd: pytest.CaptureFixture[str], seal: bool
) -> None:
    """Also of a cache from before, without a digest, which it then has."""
    library = copied("whole")
    if not seal:
        library.with_suffix(".sha256").unlink()
    before = library.stat().st_ino
    assert c_library.load_library(twice).twice(21) == 42
    assert library.stat().st_ino == before
    assert library.with_suffix(".sha256").exists()
    assert not capfd.readouterr().err


def test_a_library_of_another_machine_is_compiled_once_more(
    copied: Callable[[str], Path], twice: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """Whole by its digest, and yet nothing that this machine loads."""
    library = copied("other")
    content = bytearray(library.read_bytes())
    content[0x12] = 0xB7  # e_machine: AArch64
    library.unlink()
    library.write_bytes(content)
    library_cache.write_digest(library)
    assert c_library.load_library(twice).twice(21) == 42
    assert f"{library} cannot be loaded; it is compiled once more" in capfd.readouterr().err


def test_what_others_may_write_is_refused(folder: Path, twice: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A library, the folder, and what belongs to someone else."""
    (library,) = folder.glob("*.so")
    library.chmod(0o775)
    with pytest.raises(InputError, match=f"{library} may be written by others .mode 775.*chmod -R go-w {folder}"):
        c_library.load_library(twice)
    library.chmod(0o755)
    folder.chmod(0o777)
    library_cache._checked_folder.cache_clear()
    with pytest.raises(InputError, match=f"{folder} may be written by others .mode 777"):
        c_library.load_library(twice)
    folder.chmod(0o755)
    if os.getuid() == 0:
        os.chown(library, 12345, -1)
    else:
        monkeypatch.setattr(library_cache.os, "getuid", lambda: 12345)
    with pytest.raises(InputError, match=r"belongs to user .*XDG_CACHE_HOME"):
        c_library.load_library(twice)


def test_a_cache_that_cannot_be_written_is_somewhere_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """In a private folder for temporary files, which a note names; where that is not private either, a message."""
    (tmp_path / "file").touch()
    monkeypatch.setattr(library_cache, "get_options", lambda: {"cache_dir": tmp_path / "file" / "fenics"})
    monkeypatch.setattr(library_cache.tempfile, "gettempdir", lambda: str(tmp_path))
    library_cache._checked_folder.cache_clear()
    other = tmp_path / f"fracsim-{os.getuid()}"
    assert library_cache.library_folder() == other
    assert f"kept in {other}: {tmp_path / 'file' / 'fenics'} cannot be written" in capfd.readouterr().err
    other.chmod(0o777)
    library_cache._checked_folder.cache_clear()
    with pytest.raises(InputError, match=f"{other} may be written by others"):
        library_cache.library_folder()
    library_cache._checked_folder.cache_clear()


def test_a_folder_that_becomes_unusable_is_a_message(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file system is read-only all of a sudden: no traceback, and the folder is named."""

    def refuse(**_: object) -> None:
        raise OSError(30, "Read-only file system")

    monkeypatch.setattr(c_library.tempfile, "TemporaryDirectory", refuse)
    source = tmp_path / "twice.c"
    source.write_text(TWICE)
    with pytest.raises(CannotWrite, match=f"{folder} cannot be used: .*Read-only file system; name another one"):
        c_library.load_library(source)


COMPILERS = [compiler for compiler in ("gcc", "clang") if shutil.which(compiler)]
PACKAGE = Path(c_library.__file__).parents[1]
SOURCES = sorted(PACKAGE.rglob("*.c"))
# sizes that sources are compiled for; simd_kernels.c needs a kernel of FFCx, and is compiled in test_simd_kernels
MACROS = {
    "block_matrix": ["-DD=3"], "psd_projection": ["-DN=9", "-DLANES=4"], "bcsr": ["-DR=3", "-DLANES=8"],
    "prolongation": ["-DR=3", "-DC=6"], "polar_rotation": ["-DD=3", "-DLANES=4"],
}  # fmt: skip


@pytest.mark.parametrize("compiler", COMPILERS)
def test_compilers_take_every_source(folder: Path, monkeypatch: pytest.MonkeyPatch, compiler: str) -> None:
    """GCC and Clang, as far as they are installed, compile all C files, and their functions are declared."""
    monkeypatch.setenv("CC", compiler)
    sources = [source for source in SOURCES if source.stem != "simd_kernels"]
    assert len(sources) > 10
    for source in sources:
        flags = c_library.FAST_FLAGS + MACROS.get(source.stem, [])
        code, text = c_library.compile_library(source.stem, source.read_text(), flags), source.read_text()
        names = [name for _, name, _ in c_library._FUNCTION.findall(text) if hasattr(code, name)]
        assert names and all(getattr(code, name).argtypes for name in names), source


@pytest.mark.ranks
def test_ranks_compile_once(tmp_path: Path) -> None:
    """Three ranks of a job that ask at once start the compiler once."""
    log, source = tmp_path / "log", tmp_path / "twice.c"
    source.write_text(TWICE)
    compiler = _compiler(tmp_path / "slow", f"echo started >>{log}\nsleep 1")
    code = (
        "from mpi4py import MPI; from fracsim.mesh.c_library import compile_on_all_ranks; from pathlib import Path; "
        f"code = compile_on_all_ranks(MPI.COMM_WORLD, 'twice', Path({str(source)!r}).read_text(), []); "
        "assert code.twice(21) == 42"
    )
    environment = os.environ | {"CC": compiler, "XDG_CACHE_HOME": str(tmp_path / "cache")}
    command = ["mpirun", "-n", "3", sys.executable, "-c", code]
    subprocess.run(command, env=environment, check=True, timeout=100)
    assert log.read_text().split() == ["started"]


def _compiler(at: Path, lines: str) -> str:
    """A compiler that does something before."""
    at.write_text(f'#!/bin/sh\n{lines}\nexec cc "$@"\n')
    at.chmod(0o755)
    return str(at)


def test_a_compiler_without_a_flag_compiles(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Clang has no -fvect-cost-model."""
    refuses = 'case "$*" in *-fvect-cost-model*) echo "error: unknown argument: -fvect-cost-model" >&2; exit 1;; esac'
    monkeypatch.setenv("CC", _compiler(tmp_path / "clang", refuses))
    source = tmp_path / "twice.c"
    source.write_text(TWICE)
    assert c_library.load_library(source).twice(21) == 42


def test_processes_that_ask_at_once_compile_once(tmp_path: Path) -> None:
    """Three of them, while the compiler takes its time: it is started once."""
    log, source = tmp_path / "log", tmp_path / "twice.c"
    source.write_text(TWICE)
    compiler = _compiler(tmp_path / "slow", f"echo started >>{log}\nsleep 1")
    load = "import mpi4py.MPI; from fracsim.mesh.c_library import load_library; from pathlib import Path"
    code = f"{load}; exit(load_library(Path({str(source)!r})).twice(21))"
    environment = os.environ | {"CC": compiler, "XDG_CACHE_HOME": str(tmp_path / "cache")}
    asking = [subprocess.Popen([sys.executable, "-c", code], env=environment) for _ in range(3)]
    assert [each.wait(60) for each in asking] == [42] * 3
    assert log.read_text().split() == ["started"]


# --- arguments ------------------------------------------------------------------------------------------------------

SUM = """#include <stdint.h>
typedef struct {
    const double *weights;
} Weights;

double sum(const Weights *w, int64_t n, const double *restrict values, uint8_t *done)
{
    double total = 0;
    for (int64_t i = 0; i < n; i++) total += w->weights[i] * values[i];
    *done = 1;
    return total;
}
"""


class _Weights(Structure):
    _fields_ = (("weights", c_library.Float64),)


def test_arrays_are_checked(folder: Path, tmp_path: Path) -> None:
    """Contiguous arrays of the declared type are taken, read-only ones where nothing is written; no others."""
    source = tmp_path / "sum.c"
    source.write_text(SUM)
    function, done = c_library.load_library(source).sum, np.zeros(1, bool)
    values, weights = np.arange(4.0), np.full(4, 2.0)
    values.flags.writeable = False
    given = ctypes.byref(_Weights(c_library.struct_pointer(weights)))
    assert function(given, 4, values, done) == 12.0
    assert done[0]
    assert function(given, 0, np.empty(0), done) == 0.0
    assert function(given, c_int64(4), c_library.array_pointer(values), c_library.array_pointer(done)) == 12.0
    strided, swapped = np.arange(8.0)[::2], np.arange(4.0).astype(">f8")
    for wrong in (strided, np.zeros((4, 4)).T[1:], swapped, np.zeros(4, complex)):
        for pointer_to in (c_library.array_pointer, c_library.struct_pointer):
            with pytest.raises(ValueError, match="cannot be handed to C"):
                pointer_to(wrong)
    message = r"argument 3: ValueError: sum\(values\) takes a contiguous array of float64, and not one of "
    for wrong, kind in (
        (strided, r"float64, shape \(4,\), strides \(16,\)"), (swapped, ">f8"), (np.arange(4), "int64"),
        (np.zeros(4, np.float32), "float32"),
    ):  # fmt: skip
        with pytest.raises(ctypes.ArgumentError, match=message + kind):
            function(given, 4, wrong, done)
    for wrong in (np.arange(4), np.zeros(4, np.float32)):
        with pytest.raises(ctypes.ArgumentError, match="argument 3"):
            function(given, c_int64(4), c_library.array_pointer(wrong), done)
        with pytest.raises(TypeError):
            _Weights(c_library.struct_pointer(wrong))


def test_read_only_arrays_are_not_written_to(folder: Path, tmp_path: Path) -> None:
    """An array that the function writes to has to be writable."""
    source = tmp_path / "sum.c"
    source.write_text(SUM)
    function, done, weights = c_library.load_library(source).sum, np.zeros(1, bool), np.full(4, 2.0)
    done.flags.writeable = False
    given = ctypes.byref(_Weights(c_library.struct_pointer(weights)))
    with pytest.raises(
        ctypes.ArgumentError, match=r"sum\(done\) takes a contiguous writable array of uint8.*read-only"
    ):
        function(given, 4, weights, done)
    assert not done[0]


def test_prepared_arguments_are_checked_once(folder: Path, tmp_path: Path) -> None:
    """Before the first call, which checks none."""
    source = tmp_path / "sum.c"
    source.write_text(SUM)
    code, done, weights = c_library.load_library(source), np.zeros(1, bool), np.full(4, 2.0)
    given = ctypes.byref(_Weights(c_library.struct_pointer(weights))), c_int64(4)
    prepared = c_library.unchecked_function(code, "sum", *given, c_library.array_pointer(weights))
    assert prepared(*given, c_library.array_pointer(weights), c_library.array_pointer(done)) == 16.0
    with pytest.raises(TypeError):
        c_library.unchecked_function(code, "sum", *given, c_library.array_pointer(np.arange(4)))


def test_every_function_in_c_is_declared() -> None:
    """What a library of the package gives to others is known with its arguments: none is called unchecked."""
    assert len(SOURCES) > 10
    for source in SOURCES:
        text = source.read_text()
        named = {name for _, name, _ in c_library._FUNCTION.findall(text)}
        opened = {
            line.split("(")[0].split()[-1].lstrip("*") for line in text.splitlines()
            if "(" in line and line[:1].isalpha() and not line.startswith(("static", "typedef", "INLINE"))
        }  # fmt: skip
        assert named == opened, source
