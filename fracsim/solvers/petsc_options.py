"""PETSc options of one solver: given under a prefix of its own, checked, and removed from the database again."""

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

# Options that are suggested for a misspelt one.
COMMON_OPTIONS = (
    "snes_type", "snes_rtol", "snes_atol", "snes_stol", "snes_max_it", "snes_max_funcs", "snes_monitor",
    "snes_converged_reason", "snes_linesearch_type", "snes_linesearch_max_it", "snes_linesearch_monitor",
    "ksp_type", "ksp_rtol", "ksp_atol", "ksp_max_it", "ksp_monitor", "ksp_converged_reason", "ksp_gmres_restart",
    "pc_type", "sub_pc_type", "pc_factor_mat_solver_type", "pc_gamg_threshold", "pc_gamg_agg_nsmooths", "pc_gamg_type",
    "pc_gamg_aggressive_coarsening", "pc_hypre_type", "mg_levels_ksp_type", "mg_levels_ksp_max_it", "mg_levels_pc_type",
)  # fmt: skip

_prefixes = itertools.count()
# Unused options are checked at the start instead of at the end.
PETSc.Options()["options_left"] = "false"
# Otherwise products with several vectors sum in an order that depends on whether these are adjacent in memory.
PETSc.Options()["vec_mdot_use_gemv"] = "false"
# petsc4py 3.22 does not wrap PetscOptionsUsed.
_library = ctypes.CDLL(PETSc.__file__)


class PetscOptionSet:
    """Options of one SNES.

    They stay in the database while this object lives, since multigrid reads them at every set-up.

    Attributes:
        prefix: of the options in the database.
    """

    def __init__(self, options: PetscOptions) -> None:
        self.prefix = f"fracsim{next(_prefixes)}_"
        self._keys: list[str] = []
        self._removal = finalize(self, _remove, self.prefix, self._keys)
        # PETSc has been finalised at exit.
        self._removal.atexit = False
        self.change(options)

    def change(self, options: PetscOptions) -> None:
        """Set or add options for the next set-up."""
        database = PETSc.Options()
        for key, value in options.items():
            database[self.prefix + key] = str(value).lower() if isinstance(value, bool) else str(value)
        self._keys.extend(key for key in options if key not in self._keys)

    def check(self, given: PetscOptions, set_up: Callable[[], None]) -> None:
        """Check that PETSc looks up all options `given`; `set_up` makes it look up those of inner solvers.

        Raises:
            InputError: an option is not looked up.
        """
        if not self._unused(given):
            return
        call_petsc(set_up)
        for key in self._unused(given):
            near = difflib.get_close_matches(key, COMMON_OPTIONS, n=1, cutoff=0.6)
            hint = f"did you mean {near[0]}?" if near else "see PETSc's manual pages of SNES, KSP and PC"
            raise InputError(f"solver.{key} is not an option that PETSc looks up here; {hint}")

    def _unused(self, keys: PetscOptions) -> list[str]:
        """Return the options that PETSc has not looked up yet."""
        return [key for key in keys if not _is_used(self.prefix + key)]

    def remove(self) -> None:
        """Remove the options from the database."""
        self._removal()


def _remove(prefix: str, keys: list[str]) -> None:
    """Remove options from the database."""
    database = PETSc.Options()
    for key in keys:
        database.delValue(prefix + key)


def call_petsc(call: Callable[[], None]) -> None:
    """Call a function that reads options.

    Raises:
        InputError: PETSc refuses a value.
    """
    try:
        call()
    except PETSc.Error as error:
        message = str(error).splitlines()[-1].split("] ", 1)[-1]
        raise InputError(f"[solver]: PETSc refuses an option: {message}") from None


@contextmanager
def stored_products(matrix: PETSc.Mat, max_dofs: int) -> Iterator[None]:
    """Let multigrid that is set up within the block form P^T (A P), with A P stored, for at most `max_dofs` dofs.

    PETSc forms P^T A P row by row on one rank, without storing A P; on several ranks it stores A P by default.
    """
    database, key = PETSc.Options(), "matptap_via"
    applies = matrix.getType() == "seqaij" and matrix.getSize()[0] <= max_dofs and not database.hasName(key)
    if applies:
        database[key] = "rap"
    try:
        yield
    finally:
        if applies:
            database.delValue(key)


@contextmanager
def option_errors(given: PetscOptions) -> Iterator[None]:
    """Turn errors of PETSc within the block into input errors, if the study has given options.

    Raises:
        InputError: PETSc cannot solve with the options.
    """
    try:
        yield
    except PETSc.Error as error:
        cause: BaseException | None = error
        while isinstance(cause, PETSc.Error):
            error, cause = cause, cause.__cause__
        # A cause that is no error of PETSc was raised in a callback.
        if cause is not None or not given:
            raise
        message = str(error).splitlines()[-1].split("] ", 1)[-1]
        options = ", ".join(f"{key} = {value}" for key, value in given.items())
        raise InputError(
            f"[solver]: PETSc cannot solve with {options}: {message}; leave out what it does not go with"
        ) from None


def _is_used(name: str) -> bool:
    """Return True if PETSc has looked up an option."""
    flag = ctypes.c_int(0)
    _library.PetscOptionsUsed(None, name.encode(), ctypes.byref(flag))
    return bool(flag.value)
