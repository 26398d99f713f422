"""Schema of [solver]: PETSc options that are data. A study cannot run code or open files of its own choice.

PETSc loads Python classes, shared libraries and files by the values of some options, with any prefix of an inner
solver, and by the presence of others. A list of forbidden options would have to follow PETSc. Therefore the form of
keys and values is limited: a value is a number or plain words, which excludes paths, addresses and viewers with a
target.
"""

from __future__ import annotations

import json
import os
import re
from typing import Annotated, Any

from pydantic import BeforeValidator

Options = dict[str, bool | int | float | str]

_KEY = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,99}")
_VALUE = re.compile(r"[A-Za-z0-9_.,+-]{0,200}")
# words of keys whose presence names, writes or reads a file, or loads code: pc_mg_dump_binary, pc_bddc_save, ...
_KEY_WORDS = {
    "python", "dll", "library", "exec", "script", "file", "filename", "files", "dir", "dirname", "directory", "tmpdir",
    "path", "template", "dump", "load", "save", "history", "options", "machine", "port", "ports", "server",
}  # fmt: skip
# endings of values, as PETSc compares them: code, and viewers that write to a file or socket of their own
_CODE = ("python", "shell")
_TARGETS = (
    "adios", "binary", "cgns", "draw", "exodusii", "glvis", "hdf5", "mathematica", "matlab", "pyvista", "saws",
    "socket", "string", "vtk", "vtu",
)  # fmt: skip
PLAIN = "plain"  # the one key of [solver] that is not PETSc's
PLAIN_VARIABLE = "FRACSIM_PLAIN"  # for tests: see docs/development.md
# words of keys that print
_PRINT_WORDS = {"view", "monitor", "reason"}


def _is_setting(value: Any) -> Any:
    if not isinstance(value, bool | int | float | str):
        raise ValueError(f"{_short(repr(value))} is not a PETSc option, which is a number, a text, true or false")
    return value


OptionValue = Annotated[bool | int | float | str, BeforeValidator(_is_setting)]


def check_options(options: Options) -> None:
    """Check that options are data.

    Raises:
        ValueError: with the first option that would load code or name a file, or that is invalid.
    """
    # the first reason that applies becomes the message
    for key, value in options.items():
        if (
            wrong := _key_error(key)
            or _value_error(str(value))
            or _preconditioner_error(key, str(value))
            or _tolerance_error(key, value)
            or _plain_error(key, value)
        ):
            raise ValueError(f"solver.{_short(key)} = {_short(json.dumps(value))}: {wrong}")


def uses_plain_solver(options: Options) -> bool:
    """Return whether PETSc and DOLFINx alone solve and assemble: `plain = true`.

    Without the key the environment variable FRACSIM_PLAIN decides, which also reaches processes that a test starts.
    """
    return options.get(PLAIN, os.environ.get(PLAIN_VARIABLE) == "1") is True


def without_plain(options: Options) -> Options:
    """Returns the options of PETSc alone."""
    return {name: value for name, value in options.items() if name != PLAIN}


def _plain_error(key: str, value: bool | int | float | str) -> str:
    return "true or false" if key == PLAIN and not isinstance(value, bool) else ""


def expand_print_options(options: Options) -> Options:
    """Returns the options as PETSc reads them: `ksp_monitor = true` becomes a bare `-ksp_monitor`, false removes it."""
    printing = {key for key in options if _PRINT_WORDS & set(key.split("_"))}
    active = {key: value for key, value in options.items() if key not in printing or value is not False}
    return {key: "" if key in printing and value is True else value for key, value in active.items()}


def _short(text: str) -> str:
    return text if len(text) <= 60 else f"{text[:57]}..."


def _key_error(key: str) -> str:
    if not _KEY.fullmatch(key):
        return "a PETSc option is named by letters, digits and _ (no - before it), a letter first"
    if _KEY_WORDS & set(key.lower().split("_")):
        return "options of [solver] neither load code nor read or write files; remove it"
    return ""


def _preconditioner_error(key: str, text: str) -> str:
    """Error text for a preconditioner with which PETSc crashes, since it has no fields; empty if valid."""
    wrong = key.endswith("pc_type") and text == "fieldsplit"
    return (
        "fieldsplit needs fields, and there is one; choose another, for example gamg, hypre, ilu or lu" if wrong else ""
    )


def _tolerance_error(key: str, value: bool | int | float | str) -> str:
    """Error text for a relative tolerance that no Krylov method reaches; empty if valid."""
    try:
        inside = isinstance(value, bool) or 0 < float(value) < 1
    except ValueError:
        inside = False
    return "" if key != "ksp_rtol" or inside else "a share of the residual, above 0 and below 1, for example 1e-6"


def _value_error(text: str) -> str:
    ends = [part.lower() for part in text.split(",")]
    if any(end.endswith(_CODE) for end in ends):
        return "options of [solver] load no code, as types python and shell do; choose one of PETSc's own"
    if not _VALUE.fullmatch(text) or any(end.endswith(_TARGETS) for end in ends):
        return (
            "a value is a number, true, false or words of letters, digits and _.,+- that name neither a file nor a "
            "viewer; monitors and views print where they are set to true"
        )
    return ""
