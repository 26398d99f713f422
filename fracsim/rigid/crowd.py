"""Impulses of a crowd of contacts: Coulomb's law for all of them at once.

    u = u_0 + J M^-1 J^T p,   K_mu = {|p_t| <= mu p_n},   K_mu  3  p  _|_  u + (r / dt + mu |u_t|) n

with the velocities u of the second thing beside the first after the step, u_0 of them without impulses p, and r the
distance that may be lost (G. De Saxce, Z.-Q. Feng 1991: with mu |u_t| it is Coulomb's law, without it a convex problem
that lifts what slips). It is solved by projections onto the cones,

    p  <-  P_K(q - D^-1 (u(q) + (r / dt + mu |u_t|) n)),   q = p + beta (p - p_before)

with Nesterov's beta, begun anew for the contacts of a body on which p turns back (H. Mazhar et al. 2015, ACM Trans.
Graph. 34; B. O'Donoghue, E. Candes 2015). Of a body with rows J of each contact, w = tr J M^-1 J^T,

    J M^-1 J^T <= D = sum over bodies of lambda w,   lambda the largest eigenvalue of M^-1 sum J^T J / w   (6, 6)

at most as many as it has contacts (R. Tonge et al. 2012) and mostly half of that: no step is too long, whatever bodies
weigh. lambda^64 is taken for the trace of the 64th power, at most 6 times as much, which is 3 % of lambda. Only
contacts that press, or that things would go through, are solved for: of what lies near in a heap fewer than half press.
Which these are is looked at again after LOOK, 2 LOOK, 4 LOOK iterations. Newton's method on the convex problem needs
factors of one great matrix each time, and which of a thousand hard contacts press it finds by trial.
Gauss and Seidel's sweeps cost as much as these iterations and leave up to four times the error after as many.

What is done to each contact in each iteration is in crowd.c, compiled where it is needed first: to one half of the
contacts and to the other, by one thread or by two.

Equations: docs/theory.md#motion-and-contact-of-rigid-bodies.
"""

from __future__ import annotations

import ctypes
from ctypes import c_double, c_int64, c_void_p
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..mesh.compiled import Float64, Int64, address, at, library
from .contacts import Contacts
from .waiting import Helper

SOURCE = Path(__file__).with_suffix(".c")
FEW = 1000  # contacts: fewer are not worth a second thread
Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


class _Crowd(ctypes.Structure):
    """As crowd.c has it."""

    _fields_ = (("count", c_int64), ("bodies", c_int64), ("contact", Float64),
                ("things", Int64), ("mass", Float64), ("inertia", Float64))  # fmt: skip


@dataclass(frozen=True)
class Crowd:
    """k contacts of n bodies.

    Attributes:
        contacts: (k, 19) axes, arms of the two things, u_0 with r / dt, friction.    things: (k, 2), n of all that
        stands.    mass: (n,) 1 / kg, inverse.    inertia: (n, 3, 3) likewise, in the axes of space.
    """

    contacts: Values
    things: Ints
    mass: Values
    inertia: Values

    @classmethod
    def of(cls, contacts: Contacts, free: Values, aim: Values, mass: Values, inverse: Values) -> Crowd:
        """Of contacts of bodies with masses (n,) kg and inverse inertia (n, 3, 3) in the axes of space; `free`: (k, 3)
        m/s, u_0; `aim`: (k,) m/s, r / dt."""
        count = len(contacts)
        rows: Values = np.empty((count, 19))
        rows[:, :9], rows[:, 15:18], rows[:, 18] = contacts.axes.reshape(count, 9), free, contacts.friction
        rows[:, 9:15] = contacts.arms.reshape(count, 6)
        rows[:, 15] += aim
        things = np.ascontiguousarray(np.minimum(contacts.things, len(mass)))
        return cls(rows, things, 1 / mass, np.ascontiguousarray(inverse))

    def impulses(self, enough: float, most: int, start: Values, helper: Helper | None = None) -> Values:
        """(k, 3) N s that second things receive, along the axes of the contacts; `enough`: m/s that velocities may be
        off by; `most`: of iterations; `start`: (k, 3) N s from where to go on; `helper`: a second thread, with which
        all comes out the same to the last digit."""
        p, loops = np.array(start, order="C"), _loops()
        now = c_void_p(loops.begun(self._given, c_double(enough), c_int64(most), at(p)))
        if not now:
            raise MemoryError(f"no room for {len(p)} contacts")
        if helper is not None and len(p) >= FEW:
            helper.both(lambda: loops.impulses(now), lambda: loops.help(now))
        else:
            loops.impulses(now)
        loops.finished(now)
        return p

    def gained(self, impulses: Values) -> Values:
        """(n, 6) velocities and spins that impulses (k, 3) give."""
        level: Values = np.empty((len(self.mass) + 1, 6))
        library(SOURCE).gained(self._given, at(np.ascontiguousarray(impulses)), at(level))
        return level[:-1]

    def bound(self) -> Values:
        """(k,) D."""
        d: Values = np.empty(len(self.contacts))
        if library(SOURCE).bound(self._given, at(d)):
            raise MemoryError(f"no room for {len(d)} contacts")
        return d

    @cached_property
    def _given(self) -> Any:
        """For C; the arrays are this crowd's, and stay as long as it."""
        arrays = map(address, (self.contacts, self.things, self.mass, self.inertia))
        return ctypes.byref(_Crowd(len(self.contacts), len(self.mass), *arrays))


def _loops() -> ctypes.CDLL:
    """The functions of crowd.c, one of which tells where something is."""
    return library(SOURCE)


def projected(p: Values, mu: Values) -> Values:
    """(k, 3) the nearest of each cone |p_t| <= mu p_n."""
    near = np.array(p, order="C")
    library(SOURCE).projected(c_int64(len(mu)), at(near), at(mu))
    return near
