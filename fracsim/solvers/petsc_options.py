"""PETSc options of one solver: given under a prefix of its own, checked, and taken out of the database again."""

from __future__ import annotations

import ctypes
import difflib
import itertools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from weakref import finalize

from petsc4py import PETSc

from ..errors import InputError

PetscOptions = dict[str, bool | int | float | str]

# what a misspelt option is compared with
COMMON = (
    "snes_type", "snes_rtol", "snes_atol", "snes_stol", "snes_max_it", "snes_max_funcs", "snes_monitor",
    "snes_converged_reason", "snes_linesearch_type", "snes_linesearch_max_it", "snes_linesearch_monitor",
    "ksp_type", "ksp_rtol", "ksp_atol", "ksp_max_it", "ksp_monitor", "ksp_converged_reason", "ksp_gmres_restart",
    "pc_type", "sub_pc_type", "pc_factor_mat_solver_type", "pc_gamg_threshold", "pc_gamg_agg_nsmooths", "pc_gamg_type",
    "pc_gamg_aggressive_coarsening", "pc_hypre_type", "mg_levels_ksp_type", "mg_levels_ksp_max_it", "mg_levels_pc_type",
)  # fmt: skip

_prefixes = itertools.count()
PETSc.Options()["options_left"] = "false"  # what PETSc would say at the end is checked here at the start
# or products with several vectors would sum in another order where these happen to lie side by side in memory
PETSc.Options()["vec_mdot_use_gemv"] = "false"
_library = ctypes.CDLL(PETSc.__file__)  # petsc4py 3.22 does not wrap PetscOptionsUsed


class PetscOptionSet:
    """The options of one SNES, in the database while this object lives: multigrid reads its levels' at every set-up."""

    def __init__(self, options: PetscOptions) -> None:
        self.prefix = f"fracsim{next(_prefixes)}_"
        self._keys: list[str] = []
        self._removal = finalize(self, _remove, self.prefix, self._keys)
        self._removal.atexit = False  # PETSc has ended by then
        self.change(options)

    def change(self, options: PetscOptions) -> None:
        """Other values, or more options, for what is set up from now on."""
        database = PETSc.Options()
        for key, value in options.items():
            database[self.prefix + key] = str(value).lower() if isinstance(value, bool) else str(value)
        self._keys.extend(key for key in options if key not in self._keys)

    def check(self, given: PetscOptions, set_up: Callable[[], None]) -> None:
        """InputError for an option that PETSc does not look up; `set_up` makes it look up those of inner solvers."""
        if not self._unused(given):
            return
        call_petsc(set_up)
        for key in self._unused(given):
            near = difflib.get_close_matches(key, COMMON, n=1, cutoff=0.6)
            hint = f"did you mean {near[0]}?" if near else "see PETSc's manual pages of SNES, KSP and PC"
            raise InputError(f"solver.{key} is not an option that PETSc looks up here; {hint}")

    def _unused(self, keys: PetscOptions) -> list[str]:
        return [key for key in keys if not _is_used(self.prefix + key)]

    def remove(self) -> None:
        """Take the options out of the database."""
        self._removal()


def _remove(prefix: str, keys: list[str]) -> None:
    database = PETSc.Options()
    for key in keys:
        database.delValue(prefix + key)


def call_petsc(call: Callable[[], None]) -> None:
    """Run what reads options; a value that PETSc refuses becomes an InputError."""
    try:
        call()
    except PETSc.Error as error:
        message = str(error).splitlines()[-1].split("] ", 1)[-1]
        raise InputError(f"[solver]: PETSc refuses an option: {message}") from None


@contextmanager
def option_errors(given: PetscOptions) -> Iterator[None]:
    """What PETSc refuses only once it solves becomes an InputError, where the study has given options."""
    try:
        yield
    except PETSc.Error as error:
        cause: BaseException | None = error
        while isinstance(cause, PETSc.Error):
            error, cause = cause, cause.__cause__
        if cause is not None or not given:  # one of our own, raised in a callback
            raise
        message = str(error).splitlines()[-1].split("] ", 1)[-1]
        options = ", ".join(f"{key} = {value}" for key, value in given.items())
        raise InputError(
            f"[solver]: PETSc cannot solve with {options}: {message}; leave out what it does not go with"
        ) from None


def _is_used(name: str) -> bool:
    flag = ctypes.c_int(0)
    _library.PetscOptionsUsed(None, name.encode(), ctypes.byref(flag))
    return bool(flag.value)
