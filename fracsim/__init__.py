"""Fracture on the edges of a finite element mesh: implicit, parallel, without remeshing.

The public functions of Python are the names of `__all__` (docs/python.md). Importing the package is light: no dolfinx,
no gmsh, no pyvista. A name is imported when it is used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .mechanics.term import Term
    from .report.run_output import RunOutput, open_run
    from .simulation import Simulation, load, run

__version__ = "0.1.0"
__all__ = ["RunOutput", "Simulation", "Term", "load", "open_run", "run"]

_MODULES = {
    "RunOutput": "report.run_output",
    "Simulation": "simulation",
    "Term": "mechanics.term",
    "load": "simulation",
    "open_run": "report.run_output",
    "run": "simulation",
}


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used (PEP 562)."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_MODULES[name]}", __name__), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
