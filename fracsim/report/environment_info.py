"""The machine_info and the program_versions, for the foot of a page: nothing that tells whose they are."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PROGRAM_PACKAGES = ("fenics-dolfinx", "petsc4py", "mpi4py", "numpy", "scipy")


def machine_info() -> dict[str, str]:
    """Processor, cores that may be used, memory, system."""
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    try:
        system = platform.freedesktop_os_release()["PRETTY_NAME"]
    except (OSError, KeyError):
        system = platform.system()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {"processor": _processor(), "cores": str(cores), "memory": f"{memory:.0f} GiB", "system": system}


def program_versions() -> dict[str, str]:
    """Versions of what computes, as far as it is installed; nothing heavy is imported."""
    from .. import __version__

    found = {"fracsim": __version__, "python": platform.python_version()}
    for name in PROGRAM_PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.machine()
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.machine()
