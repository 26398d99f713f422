"""Parts of an installation: what is there, what lacks, and what to type."""

from __future__ import annotations

import importlib
import os
import platform
import shlex
import shutil
import subprocess
import sysconfig
from collections.abc import Callable
from dataclasses import dataclass

from . import __version__
from .errors import one_line


@dataclass(frozen=True)
class Part:
    """A part of the installation.

    Attributes:
        name: of the part.
        find: function that returns the version; its exception says what lacks.
        remedy: what to type if it lacks.
        needed: whether every run needs it.
    """

    name: str
    find: Callable[[], str]
    remedy: str
    needed: bool = True


def print_parts() -> bool:
    """Print a line for each part; return whether all that every run needs is there."""
    complete = True
    print(f"{'fracsim':16} {__version__}\n{'Python':16} {platform.python_version()}")
    for part in PARTS:
        try:
            print(f"{part.name:16} {one_line(part.find())}")
        except Exception as error:  # of any library that is damaged
            complete = complete and not part.needed
            print(f"{part.name:16} {'lacks' if part.needed else 'not there'}: {one_line(str(error))}; {part.remedy}")
    return complete


def _dolfinx() -> str:
    from .process import import_dolfinx

    import_dolfinx()
    return str(importlib.import_module("dolfinx").__version__)


def _petsc() -> str:
    from petsc4py import PETSc

    solvers = [name for name in ("mumps", "hypre") if PETSc.Sys.hasExternalPackage(name)]
    return ".".join(map(str, PETSc.Sys.getVersion())) + (f", with {' and '.join(solvers)}" if solvers else "")


def _mpi() -> str:
    from mpi4py import MPI

    launcher = shutil.which("mpirun")
    library = " ".join(MPI.Get_library_version().splitlines()[0].split(",")[0].split())
    return f"{library}; mpirun: {launcher or 'not in PATH'}"


def _compiler() -> str:
    command = shlex.split(os.environ.get("CC") or sysconfig.get_config_var("CC") or "cc")
    said = subprocess.run([*command, "--version"], capture_output=True, text=True, check=True).stdout
    return said.splitlines()[0]


def _headers() -> str:
    folders = [sysconfig.get_path("include"), *os.environ.get("C_INCLUDE_PATH", "").split(":")]
    for folder in folders:
        if os.path.isfile(os.path.join(folder, "Python.h")):
            return folder
    raise FileNotFoundError(f"no Python.h in {folders[0]}")


def _module(name: str) -> Callable[[], str]:
    """Function that imports a module and returns its version."""

    def find() -> str:
        module = importlib.import_module(name)
        return str(getattr(module, "__version__", "there"))

    return find


def _pictures() -> str:
    from .report.pictures.picture import has_egl

    windows = {"a display": bool(os.environ.get("DISPLAY")), "Xvfb": shutil.which("Xvfb") is not None, "EGL": has_egl()}
    if not any(windows.values()):
        raise OSError("no display, Xvfb or EGL")
    return "by " + next(name for name, exists in windows.items() if exists)


DOLFINX_REMEDY = "pip install fracsim[dolfinx], or start commands by ./env"
PARTS = (
    Part("DOLFINx", _dolfinx, DOLFINX_REMEDY),
    Part("PETSc", _petsc, DOLFINX_REMEDY),
    Part("MPI", _mpi, DOLFINX_REMEDY),
    Part("C compiler", _compiler, "apt-get install gcc libc6-dev, or name yours in CC"),
    Part("Python's headers", _headers, "apt-get install python3-dev"),
    Part(
        "gmsh",
        _module("gmsh"),
        "apt-get install libgl1 libglu1-mesa libxcursor1 libxft2 libxinerama1 libxrender1",
        False,
    ),
    Part("ipctk", _module("ipctk"), "contact needs it: pip install fracsim[contact]", False),
    Part("mujoco", _module("mujoco"), "rigid bodies need it: pip install fracsim[contact]", False),
    Part("PyVista", _module("pyvista"), "pictures need it: pip install pyvista", False),
    Part("pictures", _pictures, "apt-get install libegl1, or set output.picture = false", False),
)
