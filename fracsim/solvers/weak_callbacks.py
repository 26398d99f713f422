"""Callbacks and contexts of PETSc's objects that do not keep the owner of these objects alive.

Python's garbage collector cannot look into PETSc: an object that owns a solver of PETSc and is called back by it would
never be freed, nor would the communicators of the solver, of which MPI has few.
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
    """A function that calls a bound method for as long as another one keeps the object of the method."""
    reference, name = WeakMethod(method), getattr(method, "__qualname__", "a method")

    def call(*args: P.args, **named: P.kwargs) -> R:
        bound = reference()
        if bound is None:
            raise ReferenceError(f"{name} is called after its owner has gone")
        return bound(*args, **named)

    return call


class ApplyContext:
    """The context of a preconditioner of PETSc that its owner applies."""

    def __init__(self, apply: Callable[[PETSc.PC, PETSc.Vec, PETSc.Vec], None]) -> None:
        """`apply`: a bound method of the owner."""
        self.apply = weak_callback(apply)


def collect_dropped_scenes(comm: MPI.Comm) -> None:
    """A scene is built: every so often, free what was dropped without `destroy` (collective).

    Python looks for garbage when its own objects have piled up, and knows nothing of communicators; on several ranks
    PETSc keeps what Python has freed until all of them free it together.
    """
    if next(_scenes) % DEFAULT_POLICY.scenes_between_collections == 0:
        for _ in range(2):  # contexts of matrices are freed with these, and hold others
            gc.collect()
            PETSc.garbage_cleanup(comm)
