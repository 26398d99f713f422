"""Callbacks of PETSc's objects that do not keep the owner of these objects alive.

Python's garbage collector does not see references held by PETSc. An object that owns a PETSc solver and is called back
by it would never be freed, nor would the communicators of the solver, whose number MPI limits.
"""

from __future__ import annotations

import gc
import itertools
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, cast
from weakref import proxy

from mpi4py import MPI
from petsc4py import PETSc

from .policy import DEFAULT_POLICY

if TYPE_CHECKING:
    from types import MethodType

_scenes = itertools.count(1)


def weak_callback[**P, R](method: Callable[P, R]) -> Callable[P, R]:
    """Return a function that calls a bound method and does not keep its object alive; ReferenceError without it."""
    bound = cast("MethodType", method)
    return cast("Callable[P, R]", partial(bound.__func__, proxy(bound.__self__)))


class ApplyContext:
    """Context of a PETSc preconditioner that is applied by its owner.

    Attributes:
        apply: weak callback of the owner's method.
    """

    def __init__(self, apply: Callable[[PETSc.PC, PETSc.Vec, PETSc.Vec], None]) -> None:
        """Take a bound method of the owner."""
        self.apply = weak_callback(apply)


def collect_dropped_scenes(comm: MPI.Comm) -> None:
    """Free scenes that were dropped without `destroy`, once in several scenes (collective).

    Python collects garbage by the number of its own objects, not of communicators. On several ranks PETSc keeps freed
    objects until all ranks free them together.
    """
    if next(_scenes) % DEFAULT_POLICY.scenes_between_collections == 0:
        # The contexts of matrices are freed in the first pass, and what they hold in the second.
        for _ in range(2):
            gc.collect()
            PETSc.garbage_cleanup(comm)
