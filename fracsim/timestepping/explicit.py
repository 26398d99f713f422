"""Explicit steps: no system, lumped mass, and a step that the body's fastest cell allows.

Equations: docs/theory.md#stable-time-step.
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..mechanics.balance import Balance
from ..mechanics.damping import Drag, Viscosity
from ..mechanics.stability_limit import SAFETY, stable_step
from ..solvers.newton import SolveResult
from .energy_balance import released_state
from .protocols import FractureProtocol, PassResultProtocol, PlasticFlowProtocol
from .stable_time_step import cell_frequencies, damaged_frequencies
from .state import State
from .stepper import BalanceStepper, StepReport, StepSizes

if TYPE_CHECKING:
    from .stable_time_step_damaged import DamagedCellFrequencies

Values = npt.NDArray[np.float64]

KINK = 3.0  # of the squares of frequencies that terms add: with omega dt above 1 a spring that takes hold gains energy
REFRESH = 20  # steps between two looks at the shape of the cells


class ExplicitStepper(BalanceStepper):
    """Central differences (forms.schemes.newmark); the study's step is an upper bound."""

    _arrival: tuple[Values, Values, Values]

    def __init__(
        self, balance: Balance, sizes: StepSizes, flow: PlasticFlowProtocol, breaking: FractureProtocol
    ) -> None:
        super().__init__(balance, sizes, flow, breaking)
        self._by_edges: DamagedCellFrequencies | None = None  # kept until edges break: a decomposition a damaged cell
        self._a, self._b = rayleigh_coefficients(balance)

    def _size(self, state: State) -> float:
        """The study's step, the stable one or what is left to the end or a frame, whichever is least (collective)."""
        assert state.frequencies is not None
        squares = damaged_frequencies(self.balance.stress, state.frequencies, self._of_edges())
        fastest = self.comm.allreduce(float(np.max(squares, initial=0.0)), op=MPI.MAX)
        added = sum(term.frequency_bound() for term in self.balance.terms)
        highest = float(np.sqrt(max(fastest + added, KINK * added)))
        stable = SAFETY * stable_step(highest, self._a, self._b)
        # equal steps to the end or the next frame rather than a sliver: rounding up never exceeds the bound
        dt = min(state.dt, stable, self.sizes.largest_step_at(state.t))
        left = min(self.sizes.end - state.t, self.sizes.time_to_frame(state.t, dt))
        return left / np.ceil(left / dt * (1 - 1e-9)) if left < 100 * dt else dt

    def _of_edges(self) -> DamagedCellFrequencies | None:
        """What broken edges make of their cells; None where damage has no integrity."""
        if self._by_edges is None and self.balance.stress.integrity is not None:
            from .stable_time_step_damaged import edge_frequencies

            self._by_edges = edge_frequencies(self.balance.stress)
        return self._by_edges

    def with_forces(self, state: State) -> State:
        """As any stepper; the body's damage may have been changed from outside before, as by a restart."""
        self._by_edges = None
        return replace(super().with_forces(state), frequencies=cell_frequencies(self.balance.stress))

    def _recalled(self) -> None:
        super()._recalled()
        self._by_edges = None

    def _attempt(self, state: State, dt: float) -> SolveResult:
        """u by v and a of the start, then a from the forces there."""
        began = time.perf_counter()
        balance, owned = self.balance, self.balance.motion.owned_dofs
        half = state.v + dt / 2 * state.a
        u = state.u + dt * half
        u[owned] = balance.motion.displacements_at(state.t + dt)[: len(owned)]
        half[owned] = (u[owned] - state.u[owned]) / dt
        self._begin(state, dt)  # rates of the step: (u - u_n) / dt is the velocity half-way
        balance.set_displacement(u)
        unbalanced = balance.update_forces()
        # mass damping at the velocity of the end, not of half-way: second order
        a: Values = np.asarray(-unbalanced / (balance.mass.lumped * (1 + self._a * dt / 2)), np.float64)
        a[owned] = 0.0
        self._arrival = u, half + dt / 2 * a, a
        self.phases["solve"] += time.perf_counter() - began
        finite = self.comm.allreduce(bool(np.isfinite(unbalanced).all()), op=MPI.LAND)
        return SolveResult(finite, 0, 0, "" if finite else "Forces are not finite any more: the step is too large")

    def _arrive(self, state: State, dt: float) -> tuple[Values, Values, Values]:
        self.balance.accept_step()
        return self._arrival

    def _booked(
        self, end: State, dt: float, solve: SolveResult, began: float, broken: int, elastic: float, work: float,
        lost: float,
    ) -> tuple[State, StepReport]:  # fmt: skip
        """With the frequencies of the cells in the shape that they have at the end, every `REFRESH` steps."""
        if end.step % REFRESH == 0:
            end = replace(end, frequencies=cell_frequencies(self.balance.stress))
        return super()._booked(end, dt, solve, began, broken, elastic, work, lost)

    def _released(self, end: State, solved: Values, result: PassResultProtocol) -> State:
        """Edges broke: from here on other cells set the step, too."""
        self._by_edges = None
        return released_state(self.balance, end, solved, result.previous_damage, None)


def rayleigh_coefficients(balance: Balance) -> tuple[float, float]:
    """(a in 1/s, b in s) of Rayleigh damping a M + b K."""
    a = sum(term.a for term in balance.terms if isinstance(term, Drag))
    return a, sum(term.b for term in balance.terms if isinstance(term, Viscosity))
