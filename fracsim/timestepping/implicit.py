"""Implicit steps: a nonlinear solve, then the passes of fracture, each of which may solve the step again."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from ..mechanics.balance import Balance
from ..mesh.parallel import sum_over_ranks
from ..solvers.newton import SolveResult
from ..solvers.nonlinear_solver import NonlinearSolver
from .energy_balance import released_state
from .protocols import FractureProtocol, PassResultProtocol, PlasticFlowProtocol
from .state import State
from .stepper import BalanceStepper, StepSizes

Values = npt.NDArray[np.float64]


class ImplicitStepper(BalanceStepper):
    """Steps of a scheme with inertia that solves for the displacement."""

    def __init__(
        self,
        balance: Balance,
        sizes: StepSizes,
        flow: PlasticFlowProtocol,
        breaking: FractureProtocol,
        solver: NonlinearSolver,
    ) -> None:
        super().__init__(balance, sizes, flow, breaking)
        self.solver = solver

    def set_stop_request(self, stop_requested: Callable[[], bool]) -> None:
        """Ask `abandons` (collective) between Newton iterations whether the step is to be abandoned."""
        self.solver.set_stop_request(stop_requested)

    def failure_counts(self) -> dict[str, int]:
        """Counts by name of what failed on the way, over all ranks (collective)."""
        return super().failure_counts() | {"linear_failures": self.solver.linear_failures}

    def _recalled(self) -> None:
        super()._recalled()
        self._tell_solver()

    def _tell_solver(self) -> None:
        """Tell the solver of the damage that there is, whenever that came about."""
        pattern = self.breaking.broken_edge_patterns
        torn = pattern is not None and sum_over_ranks(self.comm, np.count_nonzero(pattern))[0] > 0
        self.solver.edges_broke(None if torn else 0)

    def discard_unsaved_data(self) -> None:
        """Forget tangent, preconditioner, factors, and what earlier solves have told of the next one (collective)."""
        self.balance.clear_search()
        self.solver.rebuild()
        self._tell_solver()

    def _attempt(self, state: State, dt: float) -> SolveResult:
        return self._solve(state, dt, self._guess(state, dt))

    def _solve(self, state: State, dt: float, guess: Values) -> SolveResult:
        began = time.perf_counter()
        self._begin(state, dt)
        result = self.solver.solve(guess)
        self.phases["solve"] += time.perf_counter() - began
        return result

    def _guess(self, state: State, dt: float) -> Values:
        """Where the body would go by itself."""
        return np.asarray(state.u + (1 - self.balance.scheme.alpha_f) * dt * state.v)

    def _passes(self, state: State, dt: float, solve: SolveResult) -> tuple[SolveResult, int, float]:
        """Break, solve the step again from its start, until nothing new breaks or the passes are used up.

        Where the weakened body has no solution the last one stands, and the next step takes up what is out of balance.
        """
        broken, released = 0, 0.0
        for _ in range((self.breaking.max_passes or UNLIMITED) - 1):
            solved = self.balance.u.x.array[: self.balance.owned_dof_count].copy()
            _, v, a = self._arrive(state, dt)
            self._let_flow()
            self.breaking.set_rates(v, a)
            result = self._broken_in(dt)
            if not result.broken_edges:
                self._return_to(solved, state, dt)
                break
            broken, released = broken + result.broken_edges, released + result.released_energy
            self._damage_changed(result)
            again = self._attempt(state, dt)
            solve = SolveResult(
                True,
                solve.newton_iterations + again.newton_iterations,
                solve.krylov_iterations + again.krylov_iterations,
                "",
            )
            if not again.converged:
                self.failures.unbalanced_steps += 1
                self._return_to(solved, state, dt)
                break
        return solve, broken, released

    def _return_to(self, solved: Values, state: State, dt: float) -> None:
        """The solution of the step once more."""
        self._begin(state, dt)
        self.balance.set_displacement(solved)
        self.balance.update_reactions()

    def _released(self, end: State, solved: Values, result: PassResultProtocol) -> State:
        return released_state(self.balance, end, solved, result.previous_damage, self.solver.linear_response)

    def _damage_changed(self, result: PassResultProtocol) -> None:
        super()._damage_changed(result)
        if result.broken_edges:
            self.solver.edges_broke(result.broken_edges)


UNLIMITED = 10_000  # passes: there is no body with more left to break in one step
