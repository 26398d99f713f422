"""Functions in C, for loops that arrays are too slow for: compiled once, and kept where FFCx keeps its kernels."""

from __future__ import annotations

import ctypes
import hashlib
import os
import re
import shlex
import subprocess
import sys
import sysconfig
import tempfile
from contextlib import suppress
from ctypes import POINTER, c_double, c_float, c_int, c_int32, c_int64, c_uint8, c_void_p
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from dolfinx.jit import mpi_jit_decorator
from mpi4py import MPI

from ..errors import CannotWrite, FracsimError, InputError
from .library_cache import alone, is_whole, library_folder, no_room, not_for_others, note, put_seal

# roots set no errno, and what is done to three numbers alike is done at once: 0.65 of the time, within IEEE's rules
FAST_FLAGS = ["-fno-math-errno", "-fvect-cost-model=unlimited"]
# a product is rounded before it is added to, as it is in arrays
SEPARATE_ROUNDING_FLAGS = ["-ffp-contract=off"]
# that a compiler may not have: Clang
GCC_FLAGS = ["-fvect-cost-model=unlimited"]


@cache
def load_library(source: Path, *, separate_rounding: bool = False) -> ctypes.CDLL:
    """The functions of a C file; `as_arrays`: sums of products come to the last digit to what arrays make of them."""
    return compile_library(
        source.stem, source.read_text(), FAST_FLAGS + (SEPARATE_ROUNDING_FLAGS if separate_rounding else [])
    )


def compile_library(name: str, text: str, more: list[str]) -> ctypes.CDLL:
    """The functions of C, with the flags of FFCx's kernels and `more`, and the types of their arguments. InputError
    where no compiler takes it.

    Not collective: the first process that asks compiles, others wait for it.
    """
    compiler = os.environ.get("CC") or sysconfig.get_config_var("CC") or "cc"
    command = [*shlex.split(compiler), "-std=c17", *machine_flags(), *more, "-shared", "-fPIC"]
    tag = hashlib.sha256(f"{command} {text}".encode()).hexdigest()[:16]
    folder = library_folder()
    file = folder / f"fracsim_{name}_{tag}.so"
    if not is_whole(file):
        with alone(folder, file.name):
            if not is_whole(file):  # no other process has compiled it meanwhile
                if file.exists():
                    note(f"the library {file} was damaged; it is compiled once more")
                _compile(command, name, text, file)
    return declare_signatures(_loaded(command, name, text, file), text)


def _compile(command: list[str], name: str, text: str, file: Path) -> None:
    """Compile a library; nothing but the whole of it, and its seal, is left in the folder."""
    with not_for_others(), tempfile.TemporaryDirectory(dir=file.parent) as scratch:
        source, fresh = Path(scratch) / f"{name}.c", Path(scratch) / file.name
        source.write_text(text)
        try:
            _run([*command, str(source), "-o", str(fresh), "-lm"])
        except InputError:
            plain = [each for each in command if each not in GCC_FLAGS]
            if plain == command:
                raise
            _run([*plain, str(source), "-o", str(fresh), "-lm"])
        fresh.replace(file)
        put_seal(file)


def _loaded(command: list[str], name: str, text: str, file: Path) -> ctypes.CDLL:
    """A whole library, compiled once more where it cannot be loaded all the same."""
    with suppress(OSError):
        return ctypes.CDLL(str(file))
    note(f"the library {file} cannot be loaded; it is compiled once more")
    _compile(command, name, text, file)
    try:
        return ctypes.CDLL(str(file))
    except OSError as error:
        raise InputError(
            f"the library {file} cannot be loaded: {error}; if {file.parent} is on a file system that runs no programs "
            f"(noexec), name another folder: XDG_CACHE_HOME=/scratch/me"
        ) from None


_told: list[str] = []  # functions that were not there


def compile_on_all_ranks(comm: MPI.Comm, name: str, text: str, more: list[str]) -> ctypes.CDLL | None:
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
        return compile_library(name, text, more)
    except (FracsimError, OSError) as error:
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


# --- arguments ------------------------------------------------------------------------------------------------------

_NUMBERS: dict[str, Any] = {
    "double": c_double, "float": c_float, "int64_t": c_int64, "int32_t": c_int32, "int": c_int, "uint8_t": c_uint8,
}  # fmt: skip
_OF_ARRAY: dict[Any, Any] = {np.dtype(bool): c_uint8} | {np.dtype(each): each for each in _NUMBERS.values()}
Float64, Float32, Int64, Int32, Uint8 = (POINTER(each) for each in (c_double, c_float, c_int64, c_int32, c_uint8))

# a function that other files can call: its result, its name, its arguments
_FUNCTION = re.compile(r"^(\w+ \*?)(\w+)\(([^(){};]*)\)\s*\{", re.MULTILINE)


def declare_signatures(code: ctypes.CDLL, text: str) -> ctypes.CDLL:
    """A library whose functions take what their C says: pointers to numbers of one kind are made by `at`."""
    for result, name, arguments in _FUNCTION.findall(text):
        if hasattr(code, name):  # what the preprocessor has left
            function = getattr(code, name)
            function.argtypes = [_type_of(each) for each in arguments.split(",")]
            function.restype = None if result.strip() == "void" else _type_of(result)
    return code


def _type_of(declaration: str) -> Any:
    """Of an argument, as `const double *restrict x`; pointers to structures are not told apart."""
    words = declaration.replace("*", " * ").split()
    number = _NUMBERS.get(next(word for word in words if word != "const"))
    if number is None:
        return c_void_p
    return POINTER(number) if "*" in words else number


def unchecked_function(code: ctypes.CDLL, name: str, *first: Any) -> Any:
    """A function of a library that checks no argument, 0.5 us a call less: for levels of few nodes, with arguments that
    were made before. Those that every call begins with are checked here."""
    checked, unchecked = getattr(code, name), code[name]
    for kind, each in zip(checked.argtypes, first, strict=False):
        kind.from_param(each)
    unchecked.restype = checked.restype
    return unchecked


def at(values: npt.NDArray[Any]) -> Any:
    """Where a contiguous array begins, as an argument; it lives as long as this. ValueError of any other array."""
    try:
        # a tenth of the time of ctypes.data_as
        return ctypes.byref(_OF_ARRAY[values.dtype].from_buffer(values))
    except (TypeError, ValueError, KeyError):  # what may not be written to, has no entries, or cannot be handed over
        return struct_pointer(values)


def struct_pointer(values: npt.NDArray[Any]) -> Any:
    """The same for a structure to hold, the fields of which are Float64, Int32, ..."""
    if values.dtype not in _OF_ARRAY or not values.flags.c_contiguous:
        raise ValueError(
            f"an array {values.shape} of {values.dtype} with strides {values.strides} cannot be handed to C: it is to "
            f"be contiguous, and of one of {', '.join(map(str, _OF_ARRAY))}"
        )
    number = _OF_ARRAY[values.dtype]
    if values.size and values.flags.writeable:
        return ctypes.pointer(number.from_buffer(values))
    place: Any = ctypes.cast(values.ctypes.data, POINTER(number))
    place.array = values
    return place


def _run(command: list[str]) -> None:
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        said, failed = done.stderr.strip(), done.returncode != 0
    except OSError as error:
        said, failed = str(error), True
    folder = Path(command[-2]).parents[1]
    if failed and ("No space left" in said or no_room(folder)):
        raise CannotWrite(f"no room to compile in {folder}: {said}; make room, or name another XDG_CACHE_HOME")
    if failed:
        raise InputError(f"`{' '.join(command)}` failed: {said}; install a C compiler, or name yours in CC")
