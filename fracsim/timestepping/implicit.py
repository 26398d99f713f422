"""Implicit steps with inertia: a nonlinear solve, then fracture passes, each of which may be followed by a solve."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from ..mechanics.balance import Balance
from ..solvers.newton import SolveResult
from ..solvers.nonlinear_solver import NonlinearSolver
from .energy_balance import released_state
from .inelastic_update import FractureProtocol, PassResultProtocol, PlasticFlowProtocol
from .state import State
from .step_sizes import StepSizes
from .stepper import BalanceStepper, EarlierPasses

Values = npt.NDArray[np.float64]


class ImplicitStepper(BalanceStepper):
    """Stepper of a scheme with inertia that solves for the displacement.

    Attributes:
        solver: solves r(u) = 0 of a step.
    """

    def __init__(
        self,
        balance: Balance,
        sizes: StepSizes,
        flow: PlasticFlowProtocol,
        fracture: FractureProtocol,
        solver: NonlinearSolver,
    ) -> None:
        super().__init__(balance, sizes, flow, fracture, solver)
        self.solver = solver

    def set_stop_request(self, stop_requested: Callable[[], bool]) -> None:
        """Ask `stop_requested` (collective) between Newton iterations whether the step is to be aborted."""
        self.solver.set_stop_request(stop_requested)

    def failure_counts(self) -> dict[str, int]:
        """Return the numbers of failures by name, over all ranks (collective)."""
        return super().failure_counts() | {"linear_failures": self.solver.linear_failures}

    def discard_unsaved_data(self) -> None:
        """Discard tangent, preconditioner, factors and estimates from earlier solves (collective)."""
        self.balance.clear_search()
        self.solver.rebuild()
        self.inelastic.tell_listener()

    def _attempt(self, state: State, dt: float) -> SolveResult:
        return self._solve(state, dt, self._guess(state, dt))

    def _solve(self, state: State, dt: float, guess: Values) -> SolveResult:
        """Begin the step and solve it from a guess (owned dofs,), m (collective)."""
        with self._timer.measure("solve"):
            self.inelastic.begin_step(state, dt)
            return self.solver.solve(guess)

    def _guess(self, state: State, dt: float) -> Values:
        """Return the displacement of motion at constant velocity, (owned dofs,), m."""
        return np.asarray(state.u + (1 - self.balance.scheme.alpha_f) * dt * state.v)

    def _repeat_with_fracture(self, state: State, dt: float, solve: SolveResult) -> EarlierPasses:
        """Break edges and solve the step again, until no edge breaks or no passes are left.

        Each solve begins at the last solution. If the weakened body has no solution, the last solution stays, and the
        next step starts out of balance.
        """
        inelastic, fracture, passes = self.inelastic, self.inelastic.fracture, EarlierPasses(solve)
        start_fields = [damage.x.array.copy() for damage in self.balance.stress.damage_fields]
        for _ in range(inelastic.max_passes - 1):
            solved = self._solution()
            _, v, a = self._complete_step(state, dt)
            self._flow()
            with self._timer.measure(fracture.phase):
                fracture.set_rates(v, a)
                if fracture.softens_gradually:
                    self.balance.set_displacement(solved)
                before = fracture.snapshot()
                result = inelastic.fracture_pass(dt)
            if not (result.broken_edges or fracture.softens_gradually):
                # The last pass of the step repeats this one.
                fracture.restore(before)
                self._return_to(solved, state, dt)
                break
            inelastic.damage_changed(result)
            passes = passes.followed_by(result)
            if not result.previous_damage:
                self._return_to(solved, state, dt)
                break
            again = self._solve(state, dt, solved)
            passes = replace(passes, solve=passes.solve.with_iterations_of(again))
            if not again.converged:
                self.failures.unbalanced_steps += 1
                self._return_to(solved, state, dt)
                return passes
        # Backward Euler's method damps the motion that a break sets off: its end is not where the energy was released.
        if passes.broken and self.balance.scheme.carries_acceleration and not fracture.softens_gradually:
            return replace(passes, start_fields=start_fields)
        return passes

    def _solution(self) -> Values:
        """Return a copy of the displacement of the balance, (owned dofs,), m."""
        return self.balance.u.x.array[: self.balance.owned_dof_count].copy()

    def _return_to(self, solved: Values, state: State, dt: float) -> None:
        """Restore the solution `solved` (owned dofs,), m, of the step (collective)."""
        self.inelastic.begin_step(state, dt)
        self.balance.set_displacement(solved)
        self.balance.update_reactions()

    def _release(self, end: State, solved: Values, dt: float, result: PassResultProtocol) -> State:
        # Released over many steps, forces excite no fast motion: M^-1 f keeps the energy balance exact.
        response = None if self.inelastic.fracture.releases_gradually else self.solver.linear_response
        return released_state(self.balance, end, solved, result.previous_damage, response)
