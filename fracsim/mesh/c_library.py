"""C functions for loops that array code is too slow for: compilation, loading, and checked arguments.

A C file is compiled at its first use and kept in the folder of compiled kernels (library_cache): once, for any number
of ranks. Its own text declares the arguments. `const double *x` takes a contiguous array of float64, `double *x` one
that may be written to as well, and any other array is refused with a message. Compilation is at run time, and not with
the wheel, since most sources take macros or FFCx's kernels that are known only then, and since code for the machine's
own instructions is up to 1.6 times as fast.
"""

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
from .library_cache import (
    exclusive_access,
    is_complete,
    is_disk_full,
    library_folder,
    print_note,
    private_umask,
    write_digest,
)

LANES = 4  # numbers at a time: doubles in a vector register of AVX2
# square roots set no errno, and operations on the three components of a vector are vectorised; both within IEEE 754
FAST_FLAGS = ["-fno-math-errno", "-fvect-cost-model=unlimited"]
# a product is rounded before it is added, as in array code: no fused multiply-add
SEPARATE_ROUNDING_FLAGS = ["-ffp-contract=off"]
# flags that only GCC has; left out where the compiler refuses them, as Clang does
GCC_FLAGS = ["-fvect-cost-model=unlimited"]


@cache
def load_library(source: Path, *, separate_rounding: bool = False) -> ctypes.CDLL:
    """Library of the functions of a C file, compiled where it is not in the cache.

    Args:
        source: path of the C file.
        separate_rounding: whether sums of products agree with array code to the last digit.

    Raises:
        InputError: if no compiler takes the file.
        CannotWrite: if the library cannot be stored.
    """
    flags = FAST_FLAGS + (SEPARATE_ROUNDING_FLAGS if separate_rounding else [])
    return compile_library(source.stem, source.read_text(encoding="utf-8"), flags)


def compile_library(name: str, text: str, more: list[str]) -> ctypes.CDLL:
    """Library of the functions of C source text, compiled where it is not in the cache (not collective).

    The first process that asks compiles, others wait for it.

    Args:
        name: part of the file's name.
        text: C source.
        more: flags beside those of FFCx's kernels.

    Raises:
        InputError: if no compiler takes the text.
        CannotWrite: if the library cannot be stored.
    """
    compiler = os.environ.get("CC") or sysconfig.get_config_var("CC") or "cc"
    command = [*shlex.split(compiler), "-std=c17", *machine_flags(), *more, "-shared", "-fPIC"]
    tag = hashlib.sha256(f"{command} {text}".encode()).hexdigest()[:16]
    folder = library_folder()
    file = folder / f"fracsim_{name}_{tag}.so"
    try:
        if not is_complete(file):
            with exclusive_access(folder, file.name):
                # another process may have compiled it meanwhile
                if not is_complete(file):
                    if file.exists():
                        print_note(f"the library {file} was damaged; it is compiled once more")
                    _compile(command, name, text, file)
        return declare_signatures(_load(command, name, text, file), text)
    except OSError as error:
        raise CannotWrite(
            f"the folder of compiled kernels {folder} cannot be used: {error}; name another one, such as "
            f"XDG_CACHE_HOME=/scratch/me"
        ) from None


def _compile(command: list[str], name: str, text: str, file: Path) -> None:
    """Compile a library; only the whole of it, and its digest, are left in the folder."""
    with private_umask(), tempfile.TemporaryDirectory(dir=file.parent) as scratch:
        source, output = Path(scratch) / f"{name}.c", Path(scratch) / file.name
        source.write_text(text, encoding="utf-8")
        try:
            _run([*command, str(source), "-o", str(output), "-lm"])
        except InputError:
            portable = [flag for flag in command if flag not in GCC_FLAGS]
            if portable == command:
                raise
            _run([*portable, str(source), "-o", str(output), "-lm"])
        output.replace(file)
        write_digest(file)


def _load(command: list[str], name: str, text: str, file: Path) -> ctypes.CDLL:
    """Load an undamaged library, compiled once more where the system refuses it."""
    with suppress(OSError):
        return ctypes.CDLL(str(file))
    # undamaged by its digest, and yet of another machine or system
    print_note(f"the library {file} cannot be loaded; it is compiled once more")
    _compile(command, name, text, file)
    try:
        return ctypes.CDLL(str(file))
    except OSError as error:
        raise InputError(
            f"the library {file} cannot be loaded: {error}; if {file.parent} is on a file system that runs no programs "
            f"(noexec), name another folder: XDG_CACHE_HOME=/scratch/me"
        ) from None


# names of libraries that could not be compiled in this process
_unavailable: list[str] = []


def compile_on_all_ranks(comm: MPI.Comm, name: str, text: str, more: list[str]) -> ctypes.CDLL | None:
    """Library as by `compile_library`, the same on all ranks; None if it cannot be had on one of them (collective).

    None without a compiler, with one note a job: the caller then does the same work by DOLFINx, more slowly.
    """
    library = _try_to_compile(comm, name, text, more)
    first = comm.allreduce(comm.rank if isinstance(library, Exception) else comm.size, op=MPI.MIN)
    if first == comm.size:
        return library
    if comm.rank == first and not _unavailable:
        print(f"fracsim: note: this run takes longer than it could: {library}", file=sys.stderr)
    _unavailable.append(name)
    return None


@mpi_jit_decorator  # type: ignore[untyped-decorator]
def _try_to_compile(name: str, text: str, more: list[str]) -> ctypes.CDLL | Exception:
    # rank 0 compiles first, then all others load; so an error is returned and not raised, which would stop rank 0 alone
    try:
        return compile_library(name, text, more)
    except (FracsimError, OSError) as error:
        return error


@cache
def machine_flags() -> list[str]:
    """Compiler flags for the machine's own instructions, of FFCx's kernels and of C files.

    A digest of the CPU's features is among the flags, and so in the name of what is compiled. A home folder shared by
    different machines therefore never gives a library to one that cannot run it.
    """
    try:
        cpu = next(
            line
            for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
            if line.startswith(("flags", "Features"))
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
_NUMBER_OF_DTYPE: dict[Any, Any] = {np.dtype(bool): c_uint8} | {np.dtype(kind): kind for kind in _NUMBERS.values()}
Float64, Float32, Int64, Int32, Uint8 = (POINTER(kind) for kind in (c_double, c_float, c_int64, c_int32, c_uint8))

# a function that other files can call: result, name, arguments
_FUNCTION = re.compile(r"^(\w+ \*?)(\w+)\(([^(){};]*)\)\s*\{", re.MULTILINE)


class ArrayArgument:
    """Argument type of a pointer to numbers: takes a contiguous array of their type (an entry of ctypes' `argtypes`).

    Attributes:
        name: function and argument, for messages.    writable: whether the function may write to the array.
    """

    def __init__(self, name: str, number: Any, *, writable: bool) -> None:
        self.name, self.writable = name, writable
        self._number, self._pointer = number, POINTER(number)
        self._dtypes = tuple(dtype for dtype, kind in _NUMBER_OF_DTYPE.items() if kind is number)

    def from_param(self, value: Any) -> Any:
        """Pointer to the first entry of an array, checked; pointers of the same type pass (called by ctypes)."""
        if not isinstance(value, np.ndarray):
            return self._pointer.from_param(value)
        if value.dtype in self._dtypes:
            try:
                # a tenth of the time of ctypes.data_as; takes contiguous, writable arrays that are not empty
                return ctypes.byref(self._number.from_buffer(value))
            except (TypeError, ValueError):
                pass  # looked at below
            if value.flags.c_contiguous and (value.flags.writeable or not self.writable):
                return ctypes.cast(value.ctypes.data, self._pointer)
        raise ValueError(
            f"{self.name} takes a contiguous {'writable ' * self.writable}array of {self._dtypes[-1]}, and not one of "
            f"{value.dtype}, shape {value.shape}, strides {value.strides}{', read-only' * (not value.flags.writeable)}"
        )


def declare_signatures(code: ctypes.CDLL, text: str) -> ctypes.CDLL:
    """The library itself, with types of arguments and results as its C text declares them."""
    for result, name, arguments in _FUNCTION.findall(text):
        # a function that the preprocessor removed is not in the library
        if hasattr(code, name):
            function = getattr(code, name)
            function.argtypes = [_type_of(argument, name) for argument in arguments.split(",")]
            function.restype = None if result.strip() == "void" else _type_of(result)
    return code


def _type_of(declaration: str, function: str = "") -> Any:
    """Type of ctypes of a declaration such as `const double *restrict x`; any pointer to a structure is a void one."""
    words = re.findall(r"\w+|\*", declaration)
    number = _NUMBERS.get(next(word for word in words if word != "const"))
    if number is None:
        return c_void_p
    if "*" not in words:
        return number
    return ArrayArgument(f"{function}({words[-1]})", number, writable=words[0] != "const") if function else number


def unchecked_function(code: ctypes.CDLL, name: str, *first: Any) -> Any:
    """Function of a library that checks no argument: 0.5 us less a call, for arrays of few entries.

    Args:
        code: library.
        name: of the function.
        first: arguments that every call begins with, made by `array_pointer`; they are checked here, once.
    """
    checked, unchecked = getattr(code, name), code[name]
    for kind, argument in zip(checked.argtypes, first, strict=False):
        kind.from_param(argument)
    unchecked.restype = checked.restype
    return unchecked


def array_pointer(values: npt.NDArray[Any]) -> Any:
    """Pointer to the first entry of a contiguous array, to be passed many times; it lives as long as this.

    Raises:
        ValueError: if the array is not contiguous, or its type has no pointer.
    """
    try:
        return ctypes.byref(_NUMBER_OF_DTYPE[values.dtype].from_buffer(values))
    except (TypeError, ValueError, KeyError):
        # read-only, empty, not contiguous, or of another type
        return struct_pointer(values)


def struct_pointer(values: npt.NDArray[Any]) -> Any:
    """Pointer to the first entry of a contiguous array, for a field of a structure (Float64, Int32, ...).

    Raises:
        ValueError: if the array is not contiguous, or its type has no pointer.
    """
    if values.dtype not in _NUMBER_OF_DTYPE or not values.flags.c_contiguous:
        raise ValueError(
            f"an array {values.shape} of {values.dtype} with strides {values.strides} cannot be handed to C: it is to "
            f"be contiguous, and of one of {', '.join(map(str, _NUMBER_OF_DTYPE))}"
        )
    number = _NUMBER_OF_DTYPE[values.dtype]
    if values.size and values.flags.writeable:
        return ctypes.pointer(number.from_buffer(values))
    pointer: Any = ctypes.cast(values.ctypes.data, POINTER(number))
    # keeps the array alive as long as the pointer
    pointer.array = values
    return pointer


def _run(command: list[str]) -> None:
    """Run a compiler; InputError with what it printed if it fails, CannotWrite if the disk is full."""
    try:
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        message, failed = result.stderr.strip(), result.returncode != 0
    except OSError as error:
        message, failed = str(error), True
    folder = Path(command[-2]).parents[1]
    if failed and ("No space left" in message or is_disk_full(folder)):
        raise CannotWrite(f"no room to compile in {folder}: {message}; make room, or name another XDG_CACHE_HOME")
    if failed:
        raise InputError(f"`{' '.join(command)}` failed: {message}; install a C compiler, or name yours in CC")
