"""[solver]: PETSc options that are data. A study never runs code or touches a file other than its own.

PETSc takes classes of Python, shared libraries and files from the values of some options, at any prefix of an inner
solver, and by the mere presence of some others. A list of what is forbidden has to follow PETSc; the shape of key and
value needs not: a value is a number or plain words, so that no path, no address and no viewer with a target fits.
"""

from __future__ import annotations

import json
import re
from typing import Annotated, Any

from pydantic import BeforeValidator

Options = dict[str, bool | int | float | str]

_KEY = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,99}")
_VALUE = re.compile(r"[A-Za-z0-9_.,+-]{0,200}")
# words of keys whose mere presence names, writes or reads a file, or loads code: pc_mg_dump_binary, pc_bddc_save, ...
_KEY_WORDS = {
    "python", "dll", "library", "exec", "script", "file", "filename", "files", "dir", "dirname", "directory", "tmpdir",
    "path", "template", "dump", "load", "save", "history", "options", "machine", "port", "ports", "server",
}  # fmt: skip
# ends of values, as PETSc compares them: code, and viewers that write to a file of a name of their own or to a socket
_CODE = ("python", "shell")
_TARGETS = (
    "adios", "binary", "cgns", "draw", "exodusii", "glvis", "hdf5", "mathematica", "matlab", "pyvista", "saws",
    "socket", "string", "vtk", "vtu",
)  # fmt: skip
_SPEAKS = {"view", "monitor", "reason"}  # words of keys that print


def _is_setting(value: Any) -> Any:
    if not isinstance(value, bool | int | float | str):
        raise ValueError(f"{_short(repr(value))} is not a PETSc option, which is a number, a text, true or false")
    return value


OptionValue = Annotated[bool | int | float | str, BeforeValidator(_is_setting)]


def check_options(options: Options) -> None:
    """ValueError that names the first option which would load code or name a file."""
    for key, value in options.items():
        if (
            wrong := _wrong_key(key)
            or _wrong_value(str(value))
            or _wrong_kind(key, str(value))
            or _wrong_share(key, value)
        ):
            raise ValueError(f"solver.{_short(key)} = {_short(json.dumps(value))}: {wrong}")


def expand_print_options(options: Options) -> Options:
    """The options as PETSc reads them: `ksp_monitor = true` is a bare `-ksp_monitor`, and with false there is none."""
    printing = {key for key in options if _SPEAKS & set(key.split("_"))}
    kept = {key: value for key, value in options.items() if key not in printing or value is not False}
    return {key: "" if key in printing and value is True else value for key, value in kept.items()}


def _short(text: str) -> str:
    return text if len(text) <= 60 else f"{text[:57]}..."


def _wrong_key(key: str) -> str:
    if not _KEY.fullmatch(key):
        return "a PETSc option is named by letters, digits and _ (no - before it), a letter first"
    if _KEY_WORDS & set(key.lower().split("_")):
        return "options of [solver] neither load code nor read or write files; remove it"
    return ""


def _wrong_kind(key: str, text: str) -> str:
    """Of a preconditioner in which PETSc crashes where nothing is known of its fields."""
    wrong = key.endswith("pc_type") and text == "fieldsplit"
    return (
        "fieldsplit needs fields, and there is one; choose another, for example gamg, hypre, ilu or lu" if wrong else ""
    )


def _wrong_share(key: str, value: bool | int | float | str) -> str:
    """Of a tolerance that a Krylov method is to reach: none gets to 0."""
    try:
        inside = isinstance(value, bool) or 0 < float(value) < 1
    except ValueError:
        inside = False
    return "" if key != "ksp_rtol" or inside else "a share of the residual, above 0 and below 1, for example 1e-6"


def _wrong_value(text: str) -> str:
    ends = [part.lower() for part in text.split(",")]
    if any(end.endswith(_CODE) for end in ends):
        return "options of [solver] load no code, as types python and shell do; choose one of PETSc's own"
    if not _VALUE.fullmatch(text) or any(end.endswith(_TARGETS) for end in ends):
        return (
            "a value is a number, true, false or words of letters, digits and _.,+- that name neither a file nor a "
            "viewer; monitors and views print where they are set to true"
        )
    return ""
