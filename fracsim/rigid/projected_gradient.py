"""Coulomb's law at many contacts by accelerated projected gradients, in C (projected_gradient.c).

Equations: docs/theory.md#motion-and-contact-of-rigid-bodies.
"""

from __future__ import annotations

import ctypes
from ctypes import c_double, c_int64
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..mesh.c_library import Float64, Int64, load_library, struct_pointer
from .contact_points import Contacts

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
SOURCE = Path(__file__).with_suffix(".c")


class _System(ctypes.Structure):
    """The struct of projected_gradient.c."""

    _fields_ = (("count", c_int64), ("bodies", c_int64), ("contact", Float64),
                ("pairs", Int64), ("mass", Float64), ("inertia", Float64))  # fmt: skip


@dataclass(frozen=True)
class ProjectedGradientSolver:
    """Coulomb's law at k contacts of n bodies, by accelerated projected gradients.

    p  <-  P_K(q - D^-1 (u(q) + (r / dt + mu |u_t|) n)),   q = p + beta (p - p_before)

    beta is Nesterov's factor. It is reset for the contacts of a body on which p reverses (H. Mazhar et al. 2015;
    B. O'Donoghue, E. Candes 2015). D bounds J M^-1 J^T, so that no step is too long whatever the masses are: with the
    rows J of a contact of a body and w = tr J M^-1 J^T,

    J M^-1 J^T <= D = sum over bodies of lambda w,   lambda the largest eigenvalue of M^-1 sum J^T J / w   (6, 6)

    lambda is at most the number of contacts of the body (R. Tonge et al. 2012) and mostly half of it.

    Attributes:
        contact_rows: (k, 19) axes, arms of the two bodies, u_0 with r / dt, friction.
        pairs: (k, 2) bodies; n for prescribed obstacles.
        inverse_mass: (n,) 1 / kg.
        inverse_inertia: (n, 3, 3) in the axes of space.
    """

    contact_rows: Values
    pairs: Ints
    inverse_mass: Values
    inverse_inertia: Values

    @classmethod
    def assemble(
        cls, contacts: Contacts, free: Values, approach_rate: Values, mass: Values, inverse_inertia: Values
    ) -> ProjectedGradientSolver:
        """Return the system of contacts.

        Args:
            contacts: k of them.
            free: (k, 3) u_0, m/s.
            approach_rate: (k,) r / dt, m/s.
            mass: (n,) kg.
            inverse_inertia: (n, 3, 3) in the axes of space.
        """
        count = len(contacts)
        rows: Values = np.empty((count, 19))
        rows[:, :9], rows[:, 15:18], rows[:, 18] = contacts.axes.reshape(count, 9), free, contacts.friction
        rows[:, 9:15] = contacts.arms.reshape(count, 6)
        rows[:, 15] += approach_rate
        pairs = np.ascontiguousarray(np.minimum(contacts.pairs, len(mass)))
        return cls(rows, pairs, 1 / mass, np.ascontiguousarray(inverse_inertia))

    def solve(self, tolerance: float, max_iterations: int, start: Values) -> tuple[Values, float]:
        """Return the impulses (k, 3), N s, that second bodies receive, along the axes of the contacts, and their error.

        The error is that of the velocities, m/s; 0 if it is within the tolerance.

        Args:
            tolerance: accepted error of velocities, m/s.
            max_iterations: largest number of iterations.
            start: (k, 3) impulses to start from, N s.
        """
        p = np.array(start, order="C")
        error = load_library(SOURCE).solve(self._struct, c_double(tolerance), c_int64(max_iterations), p)
        if error < 0:
            raise MemoryError(f"no room for {len(p)} contacts")
        return p, float(error)

    def error(self, impulses: Values) -> float:
        """Return the error of the velocities with impulses (k, 3), m/s: D times what an iteration changes them by."""
        return self.solve(0.0, 1, impulses)[1]

    def velocity_changes(self, impulses: Values) -> Values:
        """Return the changes of velocity and spin (n, 6) by impulses (k, 3)."""
        changes: Values = np.empty((len(self.inverse_mass) + 1, 6))
        load_library(SOURCE).velocity_changes(self._struct, np.ascontiguousarray(impulses), changes)
        return changes[:-1]

    def diagonal_bounds(self) -> Values:
        """Return the diagonal D (k,)."""
        d: Values = np.empty(len(self.contact_rows))
        if load_library(SOURCE).diagonal_bounds(self._struct, d):
            raise MemoryError(f"no room for {len(d)} contacts")
        return d

    @cached_property
    def _struct(self) -> Any:
        """The system for C; its arrays live as long as this object."""
        arrays = map(struct_pointer, (self.contact_rows, self.pairs, self.inverse_mass, self.inverse_inertia))
        return ctypes.byref(_System(len(self.contact_rows), len(self.inverse_mass), *arrays))


def project_on_cones(p: Values, mu: Values) -> Values:
    """Return the closest points (k, 3) to p (k, 3) in the cones |p_t| <= mu p_n, `mu` (k,)."""
    projected = np.array(p, order="C")
    load_library(SOURCE).project_on_cones(c_int64(len(mu)), projected, mu)
    return projected
