"""Callbacks of PETSc's objects that do not keep the owner of these objects alive.

Python's garbage collector does not see references held by PETSc. An object that owns a PETSc solver and is called back
by it would never be freed, nor would the communicators of the solver, whose number MPI limits.
"""

from __future__ import annotations

import gc
import itertools
from collections.abc import Callable
from weakref import WeakMethod

from mpi4py import MPI
from petsc4py import PETSc

from .policy import DEFAULT_POLICY

_scenes = itertools.count(1)


def weak_callback[**P, R](method: Callable[P, R]) -> Callable[P, R]:
    """Return a function that calls a bound method as long as the object of the method exists."""
    reference, name = WeakMethod(method), getattr(method, "__qualname__", "a method")

    def call(*args: P.args, **named: P.kwargs) -> R:
        bound = reference()
        if bound is None:
            raise ReferenceError(f"{name} is called after its owner has gone")
        return bound(*args, **named)

    return call


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
