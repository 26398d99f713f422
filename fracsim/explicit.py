"""Explicit steps: no system, lumped mass, and a step that the body's fastest cell allows."""

from __future__ import annotations

import time

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from .equilibrium import Equilibrium
from .frequencies import cell_frequencies, damaged_frequencies
from .solve import Outcome
from .state import State
from .stepping import Stepper

Values = npt.NDArray[np.float64]

SAFETY = 0.9  # of the stable step: the bound is that of linear elasticity on the current shape
REFRESH = 20  # steps between two looks at the shape of the cells


class ExplicitStepper(Stepper):
    """Central differences (forms.schemes.CentralDifference); the study's step is an upper bound."""

    _frequencies: Values | None = None
    _arrival: tuple[Values, Values, Values]

    def _fit(self, state: State) -> float:
        """The study's step, the stable one or what is left to the end, whichever is least (collective)."""
        if self._frequencies is None or state.step % REFRESH == 0:
            self._frequencies = cell_frequencies(self.equations)
        squares = damaged_frequencies(self.equations, self._frequencies)
        highest = float(np.sqrt(self.comm.allreduce(float(np.max(squares, initial=0.0)), op=MPI.MAX)))
        stable = SAFETY * stable_step(highest, self.equations)
        left = self.timing.end - state.t
        # equal steps to the end rather than a sliver: rounding up never exceeds the bound
        dt = min(state.dt, stable)
        return left / np.ceil(left / dt * (1 - 1e-9)) if left < 100 * dt else dt

    def _attempt(self, state: State, dt: float) -> Outcome:
        """u by v and a of the start, then a from the forces there."""
        began = time.perf_counter()
        equations, held = self.equations, self.equations.held
        half = state.v + dt / 2 * state.a
        u = state.u + dt * half
        u[held] = equations.motion.at(state.t + dt)[: len(held)]
        half[held] = (u[held] - state.u[held]) / dt
        equations.c_a, equations.c_v = equations.scheme.rates(dt)
        equations.hold(state.t + dt, u, half)
        if self.flow is not None:
            self.flow.begin(dt)
        unbalanced = equations.forces_in_balance()
        drag = equations.damping.mass if equations.damping is not None else 0.0
        # mass damping at the velocity of the end, not of half-way: second order
        a: Values = np.asarray(-unbalanced / (equations.mass * (1 + drag * dt / 2)), np.float64)
        a[held] = 0.0
        self._arrival = u, half + dt / 2 * a, a
        self.phases["solve"] += time.perf_counter() - began
        finite = self.comm.allreduce(bool(np.isfinite(unbalanced).all()), op=MPI.LAND)
        return Outcome(finite, 0, 0, "" if finite else "Forces are not finite any more: the step is too large")

    def _arrive(self, state: State, dt: float) -> tuple[Values, Values, Values]:
        return self._arrival


def stable_step(highest: float, equations: Equilibrium) -> float:
    """2/omega (sqrt(1 + xi^2) - xi) in s, xi = (a/omega + b omega)/2 of Rayleigh damping taken half a step late."""
    if highest == 0:
        return float("inf")
    damping = equations.damping
    xi = 0.0 if damping is None else (damping.mass / highest + damping.stiffness * highest) / 2
    return float(2 / highest * (np.sqrt(1 + xi**2) - xi))
