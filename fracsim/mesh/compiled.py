"""Functions in C, for loops that arrays are too slow for: compiled once, and kept where FFCx keeps its kernels."""

from __future__ import annotations

import ctypes
import hashlib
import os
import shlex
import subprocess
import sys
import sysconfig
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import numpy.typing as npt
from dolfinx.jit import get_options, mpi_jit_decorator
from mpi4py import MPI

from ..errors import InputError

# roots set no errno, and what is done to three numbers alike is done at once: 0.65 of the time, within IEEE's rules
FASTER = ["-fno-math-errno", "-fvect-cost-model=unlimited"]
# a product is rounded before it is added to, as it is in arrays
AS_ARRAYS = ["-ffp-contract=off"]


@cache
def library(source: Path, *, as_arrays: bool = False) -> ctypes.CDLL:
    """The functions of a C file; `as_arrays`: sums of products come to the last digit to what arrays make of them."""
    return built(source.stem, source.read_text(), FASTER + (AS_ARRAYS if as_arrays else []))


def built(name: str, text: str, more: list[str]) -> ctypes.CDLL:
    """The functions of C, with the flags of FFCx's kernels and `more`. InputError where no compiler takes it.

    Not collective: processes that compile the same at once each put a whole library in the place of the other's.
    """
    compiler = os.environ.get("CC") or sysconfig.get_config_var("CC") or "cc"
    command = [*shlex.split(compiler), "-std=c17", *machine_flags(), *more, "-shared", "-fPIC"]
    tag = hashlib.sha256(f"{command} {text}".encode()).hexdigest()[:16]
    folder = Path(get_options()["cache_dir"])
    made = folder / f"fracsim_{name}_{tag}.so"
    if not made.exists():
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            source, fresh = Path(scratch) / f"{name}.c", Path(scratch) / made.name
            source.write_text(text)
            _run([*command, str(source), "-o", str(fresh), "-lm"])
            fresh.replace(made)
    return ctypes.CDLL(str(made))


_told: list[str] = []  # functions that were not there


def built_together(comm: MPI.Comm, name: str, text: str, more: list[str]) -> ctypes.CDLL | None:
    """The same on all ranks; None where there is no compiler that takes it on one of them, which is told once: FFCx's
    kernels may be there from before, and others do the same without it, later (collective)."""
    made = _tried(comm, name, text, more)
    first = comm.allreduce(comm.rank if isinstance(made, Exception) else comm.size, op=MPI.MIN)
    if first == comm.size:
        return made
    if comm.rank == first and not _told:
        print(f"fracsim: note: this run takes longer than it could: {made}", file=sys.stderr)
    _told.append(name)
    return None


@mpi_jit_decorator  # type: ignore[misc]
def _tried(name: str, text: str, more: list[str]) -> ctypes.CDLL | Exception:
    try:
        return built(name, text, more)
    except (InputError, OSError) as error:
        return error


@cache
def machine_flags() -> list[str]:
    """Flags for the machine's own instructions: 1.6 x faster tangents of the neo-Hookean energy than -O2.

    The CPU's name goes into the flags, by which what is compiled is known again, so that a home directory shared by
    different machines never hands it to one that cannot run it.
    """
    try:
        cpu = next(
            line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith(("flags", "Features"))
        )
    except (OSError, StopIteration):
        cpu = os.uname().machine
    tag = hashlib.sha256(cpu.encode()).hexdigest()[:8]
    # cffi asks for -std=c17, which forbids fused multiply-add; without it GCC 14 has been seen not to end on a tangent
    return ["-O3", "-march=native", "-ffp-contract=fast", "-g0", f"-DFRACSIM_CPU=0x{tag}"]


def at(values: npt.NDArray[Any]) -> Any:
    """Where an array begins, which is to be contiguous; it lives as long as this."""
    try:
        return ctypes.byref(ctypes.c_char.from_buffer(values))  # a tenth of the time of ctypes.data_as
    except (TypeError, ValueError):  # what may not be written to, or has no entries
        return address(values)


def address(values: npt.NDArray[Any]) -> ctypes.c_void_p:
    """The same for a structure to hold."""
    place = ctypes.c_void_p(values.__array_interface__["data"][0])
    place.array = values  # type: ignore[attr-defined]
    return place


def _run(command: list[str]) -> None:
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        said, failed = done.stderr.strip(), done.returncode != 0
    except OSError as error:
        said, failed = str(error), True
    if failed:
        raise InputError(f"`{' '.join(command)}` failed: {said}; install a C compiler, or name yours in CC")
