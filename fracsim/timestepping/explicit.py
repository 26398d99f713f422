"""Explicit steps: central differences with a lumped mass, no system of equations, and a stable step.

Equations: docs/theory.md#time-integration, docs/theory.md#stable-time-step.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..mechanics.balance import Balance
from ..solvers.newton import SolveResult
from .energy_balance import StepEnergies, released_state
from .inelastic_update import FractureProtocol, PassResultProtocol, PlasticFlowProtocol
from .stable_time_step import EXPLICIT_STEP_POLICY, StableTimeStep, cell_frequencies
from .state import State
from .step_sizes import StepSizes
from .stepper import BalanceStepper, StepReport

Values = npt.NDArray[np.float64]


class ExplicitStepper(BalanceStepper):
    """Stepper of central differences (forms.schemes); the step of the study is an upper bound."""

    # u, v and a at the end of the attempted step
    _end_of_step: tuple[Values, Values, Values]

    def __init__(
        self, balance: Balance, sizes: StepSizes, flow: PlasticFlowProtocol, fracture: FractureProtocol
    ) -> None:
        self._stable_step = StableTimeStep(balance)
        super().__init__(balance, sizes, flow, fracture, self._stable_step)

    def with_forces(self, state: State) -> State:
        """Return the state with its forces, acceleration and frequencies of cells."""
        # The damage may have been changed since the last step, as by a restart.
        self._stable_step.edges_broke(None)
        return replace(super().with_forces(state), frequencies=cell_frequencies(self.balance.stress))

    def from_checkpoint(self, state: State) -> State:
        """Return the state of a checkpoint, whose damage and plastic strain the body has read (collective)."""
        state = super().from_checkpoint(state)
        # The stable step depends on where obstacles are at this time.
        self.balance.evaluate_at(state.t, state.u, state.v)
        return state

    def _next_step(self, state: State) -> float:
        return self._stable_step.next_step(state, self.sizes)

    def _attempt(self, state: State, dt: float) -> SolveResult:
        """Evaluate u from v and a at the start of the step, then a from the forces at u (collective)."""
        with self._timer.measure("solve"):
            balance, owned = self.balance, self.balance.motion.owned_dofs
            half = state.v + dt / 2 * state.a
            u = state.u + dt * half
            u[owned] = balance.motion.displacements_at(state.t + dt)[: len(owned)]
            half[owned] = (u[owned] - state.u[owned]) / dt
            # The rates of the scheme, (u - u_n) / dt, are the velocity at the middle of the step.
            self.inelastic.begin_step(state, dt)
            balance.set_displacement(u)
            unbalanced = balance.update_forces()
            # Mass damping takes the velocity at the end of the step, which makes it second order.
            damped_mass = balance.mass.lumped * (1 + self._stable_step.mass_damping * dt / 2)
            a: Values = np.asarray(-unbalanced / damped_mass, np.float64)
            a[owned] = 0.0
            self._end_of_step = u, half + dt / 2 * a, a
        finite = self.balance.domain.comm.allreduce(bool(np.isfinite(unbalanced).all()), op=MPI.LAND)
        return SolveResult(finite, 0, 0, "" if finite else "Forces are not finite any more: the step is too large")

    def _complete_step(self, state: State, dt: float) -> tuple[Values, Values, Values]:
        self.balance.accept_step()
        return self._end_of_step

    def _release(self, end: State, solved: Values, dt: float, result: PassResultProtocol) -> State:
        released = released_state(self.balance, end, solved, result.previous_damage, None)
        if self.inelastic.fracture.softened_fields is None:
            return released
        # Cells that soften in the course of a step have the forces of its end in the second half of it.
        return replace(released, v=end.v + dt / 2 * (released.a - end.a))

    def _close_step(
        self, end: State, dt: float, solve: SolveResult, began: float, broken: int, energies: StepEnergies
    ) -> tuple[State, StepReport]:
        """Return the end of the step, from time to time with the frequencies of the cells in their present shape."""
        if end.step % EXPLICIT_STEP_POLICY.update_interval == 0:
            end = replace(end, frequencies=cell_frequencies(self.balance.stress))
        return super()._close_step(end, dt, solve, began, broken, energies)
