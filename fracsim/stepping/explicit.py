"""Explicit steps: no system, lumped mass, and a step that the body's fastest cell allows."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..mechanics.balance import Equilibrium
from .frequencies import cell_frequencies, damaged_frequencies
from .implicit import Stepper
from .newton import Outcome
from .state import State

if TYPE_CHECKING:
    from .edge_frequencies import EdgeFrequencies

Values = npt.NDArray[np.float64]

SAFETY = 0.9  # of the stable step: the bound is that of linear elasticity on the current shape
REFRESH = 20  # steps between two looks at the shape of the cells


class ExplicitStepper(Stepper):
    """Central differences (forms.schemes.CentralDifference); the study's step is an upper bound."""

    _frequencies: Values | None = None
    _by_edges: EdgeFrequencies | None = None  # kept until edges break: a decomposition a damaged cell
    _arrival: tuple[Values, Values, Values]

    def _fit(self, state: State) -> float:
        """The study's step, the stable one or what is left to the end, whichever is least (collective)."""
        if self._frequencies is None or state.step % REFRESH == 0:
            self._frequencies = cell_frequencies(self.equations)
        squares = damaged_frequencies(self.equations, self._frequencies, self._of_edges())
        highest = float(np.sqrt(self.comm.allreduce(float(np.max(squares, initial=0.0)), op=MPI.MAX)))
        stable = SAFETY * stable_step(highest, self.equations)
        left = self.timing.end - state.t
        # equal steps to the end rather than a sliver: rounding up never exceeds the bound
        dt = min(state.dt, stable)
        return left / np.ceil(left / dt * (1 - 1e-9)) if left < 100 * dt else dt

    def _of_edges(self) -> EdgeFrequencies | None:
        """What broken edges make of their cells; None where damage has no integrity."""
        if self._by_edges is None and self.equations.integrity is not None:
            from .edge_frequencies import edge_frequencies

            self._by_edges = edge_frequencies(self.equations)
        return self._by_edges

    def settle(self, state: State) -> None:
        """As any stepper; the body's damage may have been changed from outside before, as by a restart."""
        self._by_edges = None
        super().settle(state)

    def _release(self, state: State, solved: Values, damage: list[Values]) -> None:
        """Edges broke: from here on other cells set the step, too."""
        self._by_edges = None
        super()._release(state, solved, damage)

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
