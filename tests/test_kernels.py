"""Kernels: compiled once; what a killed compilation leaves behind does not stop later runs."""

from __future__ import annotations

import os
import shutil
import time
from pathlib import Path
from typing import Any

import basix.ufl
import pytest
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI

from fracsim.errors import InputError
from fracsim.mechanics import jit
from fracsim.mesh.dolfinx_compat import coordinate_element
from support.damaged import DAMAGES, damage


def test_an_abandoned_compilation_is_done_again(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A C file without its library, as a killed process leaves it, older than anyone waits."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    options: dict[str, Any] = {"cache_dir": tmp_path / "fenics"}
    monkeypatch.setattr(jit, "library_folder", lambda: tmp_path / "fenics")
    monkeypatch.setattr(jit, "jit_options", lambda: options | {"timeout": 1})
    square = mesh.create_unit_square(MPI.COMM_SELF, 1, 1)
    form = fem.Constant(square, 3.14159) * ufl.SpatialCoordinate(square)[0] ** 3 * ufl.dx
    jit.compile_form(form)
    for path in (tmp_path / "fenics").iterdir():
        if path.suffix == ".c":
            os.utime(path, (0, time.time() - 2 * jit.PATIENCE))
        else:
            path.unlink()
    assert fem.assemble_scalar(jit.compile_form(form)) == pytest.approx(3.14159 / 4)


def test_one_that_is_under_way_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A young C file belongs to a process that compiles."""
    monkeypatch.setattr(jit, "library_folder", lambda: tmp_path)
    (tmp_path / "libffcx_forms_0.c").touch()
    assert not jit._clear_abandoned()
    assert (tmp_path / "libffcx_forms_0.c").exists()


def test_a_kernel_is_looked_for_once(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """What a process has loaded it finds without the folder that it came from; another form is not taken for it."""
    monkeypatch.setattr(jit, "jit_options", lambda: {"cache_dir": tmp_path / "a", "cffi_extra_compile_args": ["-O0"]})
    square = mesh.create_unit_square(MPI.COMM_SELF, 1, 1)
    x = ufl.SpatialCoordinate(square)
    for power in (4, 5):
        for _ in range(2):  # compiled, then loaded
            jit.compile_form(x[0] ** power * ufl.dx)
    (tmp_path / "a").rename(tmp_path / "b")
    for power in (4, 5):
        found = fem.assemble_scalar(jit.compile_form(x[0] ** power * ufl.dx))
        assert found == pytest.approx(1 / (power + 1))
    assert not list((tmp_path / "a").glob("*"))


def test_a_mesh_makes_its_cell_once() -> None:
    """What FFCx is told of the element is what it is told of Basix's own, so that both are one kernel."""
    for dim, shape in ((2, "triangle"), (3, "tetrahedron")):
        element, other = coordinate_element(dim), basix.ufl.element("Lagrange", shape, 1, shape=(dim,))
        assert element == other and repr(element) == repr(other) and hash(element) == hash(other)
        assert element.cell is element.cell and element.cell == other.cell


def test_an_expression_is_known_again(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Whatever labels ufl.variable has given since: one library for all scenes of a process, and the same slope."""
    monkeypatch.setattr(jit, "jit_options", lambda: {"cache_dir": tmp_path, "cffi_extra_compile_args": ["-O0"]})
    square = mesh.create_unit_square(MPI.COMM_SELF, 1, 1)
    x = ufl.SpatialCoordinate(square)
    for _ in range(2):
        variable = ufl.variable(x)
        slope = ufl.diff(ufl.inner(variable, variable), variable)
        values = jit.CellExpression(MPI.COMM_SELF, square, slope, 2)()
        assert sorted(values.ravel()) == pytest.approx([2 / 3, 2 / 3, 4 / 3, 4 / 3])  # 2 x of two thirds of the square
    assert len(list(tmp_path.glob("*.c"))) == 1


@pytest.fixture
def cubic(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    """Where a form has been compiled, and what compiles it in another folder: int x^3 over a unit square."""

    def compile_in(folder: Path) -> float:
        options = {"cache_dir": folder, "cffi_extra_compile_args": ["-O0"], "timeout": 3}
        monkeypatch.setattr(jit, "jit_options", lambda: options)
        monkeypatch.setattr(jit, "library_folder", lambda: folder)
        square = mesh.create_unit_square(MPI.COMM_SELF, 1, 1)
        return float(fem.assemble_scalar(jit.compile_form(ufl.SpatialCoordinate(square)[0] ** 3 * ufl.dx)))

    assert compile_in(tmp_path / "whole") == pytest.approx(0.25)
    return tmp_path / "whole", compile_in


def test_a_damaged_kernel_is_compiled_once_more(cubic: Any, capfd: pytest.CaptureFixture[str]) -> None:
    """Cut at any length, empty, other bytes, gone, its C file cut: the right number, and a note that names it."""
    whole, compile_in = cubic
    for number, kind in enumerate([*DAMAGES, "gone", "source", "without seal"]):
        folder = whole.with_name(f"damaged-{number}")
        shutil.copytree(whole, folder)
        (library,) = folder.glob("*.so")
        if kind == "gone":
            library.unlink()
        elif kind == "source":
            damage(next(folder.glob("*.c")), "half")
        else:
            damage(library, "half" if kind == "without seal" else kind)
        if kind == "without seal":  # as caches from before have it
            next(folder.glob("*.sha256")).unlink()
        assert compile_in(folder) == pytest.approx(0.25), kind
        assert library.name.split(".")[0] in capfd.readouterr().err, kind
        assert next(folder.glob("*.so")).read_bytes()[:4] == b"\x7fELF"


def test_a_whole_kernel_is_loaded_without_a_word(cubic: Any, capfd: pytest.CaptureFixture[str]) -> None:
    """Also of a cache from before, without a digest, which it then has."""
    whole, compile_in = cubic
    for seals in (True, False):
        folder = whole.with_name(f"copy-{seals}")
        shutil.copytree(whole, folder)
        if not seals:
            next(folder.glob("*.sha256")).unlink()
        written = {path.name: path.stat().st_mtime_ns for path in folder.glob("*.so")}
        assert compile_in(folder) == pytest.approx(0.25)
        assert {path.name: path.stat().st_mtime_ns for path in folder.glob("*.so")} == written
        assert len(list(folder.glob("*.sha256"))) == 1
        assert not capfd.readouterr().err


def test_a_kernel_that_others_may_write_is_refused(cubic: Any) -> None:
    """What to do stands in the message."""
    whole, compile_in = cubic
    for suffix in (".so", ".c"):
        folder = whole.with_name(f"open{suffix}")
        shutil.copytree(whole, folder)
        (path,) = folder.glob(f"*{suffix}")
        path.chmod(0o666)
        with pytest.raises(InputError, match=r"may be written by others .mode 666.*chmod -R go-w"):
            compile_in(folder)


def test_without_a_compiler_there_is_a_message(cubic: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """And none of setuptools' errors."""
    whole, compile_in = cubic
    monkeypatch.setenv("CC", "no-compiler")
    with pytest.raises(InputError, match="install a C compiler, or name yours in CC"):
        compile_in(whole.with_name("empty"))
