"""How the process of a command begins and ends: what no run needs is not imported, and nothing is taken apart that goes
with the process anyway. A tenth of what a small job takes, or less."""

from __future__ import annotations

import atexit
import gc
import importlib
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any, NoReturn


@contextmanager
def kept_out(name: str, stand_in: ModuleType | None = None) -> Iterator[None]:
    """While it lasts, importing a module finds nothing (or the stand-in), unless it is there already."""
    absent = name not in sys.modules
    if absent:
        sys.modules[name] = stand_in  # type: ignore[assignment]
    try:
        yield
    finally:
        if absent:
            del sys.modules[name]


def import_dolfinx() -> None:
    """DOLFINx without dolfinx.utils, which is there for those who ask for it.

    It is for callers of PETSc from Numba, and parses C declarations as it is imported: a parser, a lexer and their
    regular expressions, 0.04 s.
    """
    if "dolfinx" in sys.modules:
        return
    name = "dolfinx.utils"
    with kept_out(name, ModuleType(name)):
        dolfinx = importlib.import_module("dolfinx")
    del dolfinx.utils


def begin_work() -> None:
    """Look for garbage from here on where it has not been, but not in what imports made: it stays."""
    if not gc.isenabled():
        gc.freeze()
        gc.enable()


def leave(code: Any) -> NoReturn:
    """End the process as sys.exit does, but for taking apart all modules and objects, which frees their memory bit by
    bit (0.04 s of a small job)."""
    if not isinstance(code, int) or threading.active_count() > 1:
        sys.exit(code)
    atexit._run_exitfuncs()
    try:
        sys.stdout.flush()
        sys.stderr.flush()
    except (OSError, ValueError):  # no one reads any more: the interpreter has its own words for that
        sys.exit(code)
    _finalize()
    os._exit(code)


def _finalize() -> None:
    """What Py_Finalize has called for PETSc and MPI, in this order (collective)."""
    if "petsc4py.PETSc" in sys.modules:
        from petsc4py import PETSc

        PETSc._finalize()
    if "mpi4py.MPI" in sys.modules:
        from mpi4py import MPI

        if not MPI.Is_finalized():
            MPI.Finalize()
