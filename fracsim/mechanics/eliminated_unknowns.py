"""Unknowns of terms, such as poses of rigid bodies, that Newton's method eliminates from each linear system.

A term with unknowns y of its own adds rows and columns to the linear system of an iteration:

    [ K    B ] [du]     [ r   ]
    [ B^T  D ] [dy] = - [ r_y ]

Static condensation: the iteration solves (K - B D^-1 B^T) du = -(r - B D^-1 r_y), then dy = -D^-1 (r_y + B^T du). In
the line search y moves along with u. So the system keeps its size, and each iteration is one of Newton's method for all
unknowns.

Equations: docs/theory.md#rigid-obstacles.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..mesh.parallel import sum_over_ranks
from .term import Term
from .term_protocols import EliminatingTerm, fulfilling

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class EliminationPolicy:
    """Tuned numbers of eliminated unknowns.

    Attributes:
        path_tolerance: distance of u from the path of a correction, in its largest component, up to which y moves
            along.
        short_step: fraction of a correction, in that which contact allows, below which y is solved for with u held.
            Where friction changes from slip to stick the line search takes steps of a hundredth: a rolling ball took
            218 iterations in 40 steps, and takes 93.
    """

    path_tolerance: float = 1e-6
    short_step: float = 0.1


POLICY = EliminationPolicy()


@dataclass(frozen=True)
class CorrectionPath:
    """Path of u in the line search of an iteration.

    Attributes:
        start: (owned dofs,) u at its start, m.
        change: (owned dofs,) correction, m.
        square: |change|^2 of all ranks, m^2.
        largest: largest component of the correction on all ranks, m.
    """

    start: Values
    change: Values
    square: float
    largest: float


class EliminatedUnknowns:
    """Unknowns of the terms of a balance beside u.

    Attributes:
        exist: whether any term has some.
        version: number of times that they were solved for.
    """

    def __init__(self, comm: MPI.Comm, terms: Iterable[Term]) -> None:
        self._comm, self._terms = comm, fulfilling(terms, EliminatingTerm)
        self._path: CorrectionPath | None = None
        self._allowed, self._fraction = 1.0, 1.0  # fractions of the correction: that contact allows, and of current u
        self.exist, self.version = bool(self._terms), 0

    def begin_solve(self) -> None:
        """Begin an attempt of Newton's method: y stays until the first correction."""
        self._path, self._allowed, self._fraction = None, 1.0, 1.0

    def begin_correction(self, u: Values, change: Values) -> None:
        """Compute the change of y that belongs to a correction of u, both (owned dofs,), m (collective)."""
        for term in self._terms:
            term.begin_correction(change)
        square = float(sum_over_ranks(self._comm, change @ change)[0])
        largest = self._comm.allreduce(float(np.abs(change).max(initial=0.0)), op=MPI.MAX)
        self._path, self._fraction = CorrectionPath(u.copy(), change, square, largest), 1.0

    def follow(self, u: Values) -> None:
        """Move y along with u (owned dofs,), m; y stays where u is not on the path of a correction (collective)."""
        if (path := self._path) is None or not path.square:
            return
        motion = np.where(path.change != 0, u - path.start, 0.0)
        fraction = float(sum_over_ranks(self._comm, motion @ path.change)[0]) / path.square
        offset = float(np.abs(motion - fraction * path.change).max(initial=0.0))
        if self._comm.allreduce(offset, op=MPI.MAX) <= POLICY.path_tolerance * path.largest:
            self._fraction = fraction
            for term in self._terms:
                term.move_along(fraction)

    def condensed_residual(self) -> Values | None:
        """(owned dofs,) sum of B D^-1 r_y at the current unknowns, N; None where it is zero (collective)."""
        parts = [part for term in self._terms if (part := term.condensed_residual()) is not None]
        return sum(parts[1:], parts[0]) if parts else None

    def allow(self, fraction: float) -> None:
        """Note the fraction of the correction that contact allows."""
        self._allowed = fraction

    def need_solution(self, *, solved: bool) -> bool:
        """Whether y is to be solved for with u held; `solved`: whether r = 0 for u (collective)."""
        if solved:
            return not all([term.unknowns_are_solved() for term in self._terms])
        return self._fraction < POLICY.short_step * self._allowed

    def solve(self) -> None:
        """Solve r_y = 0 with u held; y stays where there is no solution (collective)."""
        self.version += 1
        for term in self._terms:
            term.solve_unknowns()
