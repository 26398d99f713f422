"""Steppers: a state goes in, the next state comes out, with a report.

    state = stepper.start()
    state, report = stepper.advance(state)

`BalanceStepper` has the parts of a step that all schemes share: a step is attempted, and reduced if it fails; then the
body flows and breaks, and the energies are summed.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from ..errors import StepAborted
from ..mechanics.balance import Balance
from ..solvers.newton import SolveResult
from .energy_balance import (
    NonFiniteState,
    StepEnergies,
    add_step_energies,
    balanced_forces,
    release_during_step,
    softening_work,
    step_work,
)
from .inelastic_update import (
    DamageListener,
    FractureProtocol,
    InelasticUpdate,
    PassResultProtocol,
    PlasticFlowProtocol,
    StepTooLong,
)
from .state import State
from .step_sizes import StepSizes

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class StepReport:
    """Report of a step for history.csv; numbers are sums over the ranks.

    Attributes:
        dt: size of the step, s.
        solve: result of the nonlinear solves.
        broken: number of edges that broke.
        kinetic: kinetic energy at the end of the step, J.
        elastic: stored energy at the end of the step, J.
        seconds: wall time, s.
    """

    dt: float
    solve: SolveResult
    broken: int
    kinetic: float
    elastic: float
    seconds: float


@dataclass(frozen=True)
class EarlierPasses:
    """Fracture passes of a step before its last one.

    Attributes:
        solve: result of the nonlinear solves, with all iterations.
        broken: number of edges that broke.
        released: energy released on this rank, J.
        start_fields: damage fields at the start of the step, if it was solved with the damage of these passes. The
            energy that they release is then that at the end of the step, and `released` does not count.
    """

    solve: SolveResult
    broken: int = 0
    released: float = 0.0
    start_fields: list[Values] | None = None

    def followed_by(self, result: PassResultProtocol) -> EarlierPasses:
        """Return these passes and one more."""
        broken, released = self.broken + result.broken_edges, self.released + result.released_energy
        return replace(self, broken=broken, released=released)


@dataclass
class FailureCounts:
    """Numbers of failures that did not end the run.

    Attributes:
        steps_failed: attempts that did not converge and were repeated in another way.
        unbalanced_steps: steps that ended out of balance, since the body weakened by a break had no solution.
        steps_retaken: steps that were repeated with a smaller size, since edges broke in them.
        rough_solutions: steps whose |r| is above 1e-4 of the forces, since that of the first guess was far larger.
    """

    steps_failed: int = 0
    unbalanced_steps: int = 0
    steps_retaken: int = 0
    rough_solutions: int = 0


class StepTimer:
    """Wall time of the phases of steps.

    Attributes:
        seconds: s, by name of the phase.
    """

    def __init__(self) -> None:
        self.seconds = {"solve": 0.0, "fracture": 0.0, "energies": 0.0}

    @contextmanager
    def measure(self, phase: str) -> Iterator[None]:
        """Add the time of the block to a phase."""
        began = time.perf_counter()
        try:
            yield
        finally:  # a pass that calls for a shorter step counts, too
            self.seconds[phase] = self.seconds.get(phase, 0.0) + time.perf_counter() - began


class Stepper(Protocol):
    """Interface of a stepper.

    Attributes:
        failures: numbers of failures on this rank.
        onset_reactions: (owned dofs,) reactions at which edges broke in the last step, N: those of its first
            equilibrium, or of its last one if the body weakens gradually; None: steps are not solved again after edges
            broke, or there was none yet.
    """

    failures: FailureCounts
    onset_reactions: Values | None

    @property
    def phases(self) -> dict[str, float]:
        """Wall time, s, by name of the phase."""

    def failure_counts(self) -> dict[str, int]:
        """Return the numbers of failures that did not end the run by name, over all ranks (collective)."""

    def start(self, velocity: Values | None = None) -> State:
        """Return the state at t = 0, at rest or with a velocity (owned dofs,), m/s (collective)."""

    def with_forces(self, state: State) -> State:
        """Return the state with the forces and accelerations of its displacement and velocity (collective)."""

    def from_checkpoint(self, state: State) -> State:
        """Return the state of a checkpoint, whose damage and plastic strain the body has read (collective)."""

    def discard_unsaved_data(self) -> None:
        """Discard what a checkpoint does not hold, so that the run continues as one that resumes (collective)."""

    def advance(self, state: State) -> tuple[State, StepReport]:
        """Take one step, as large as state.dt allows (collective).

        Raises:
            NotConverged: the smallest step fails.
            StepAborted: the run is to stop.
        """

    def set_stop_request(self, stop_requested: Callable[[], bool]) -> None:
        """Ask `stop_requested` (collective) within long steps whether the step is to be aborted."""


class BalanceStepper:
    """Base of explicit, implicit and quasi-static steppers.

    Attributes:
        balance: balance of forces.
        sizes: bounds of the step size.
        inelastic: plastic flow, fracture and history variables.
        failures: numbers of failures.
    """

    onset_reactions: Values | None = None

    def __init__(
        self,
        balance: Balance,
        sizes: StepSizes,
        flow: PlasticFlowProtocol,
        fracture: FractureProtocol,
        listener: DamageListener,
    ) -> None:
        self.balance, self.sizes = balance, sizes
        self.inelastic = InelasticUpdate(balance, flow, fracture, sizes, listener)
        self.failures = FailureCounts()
        self._timer = StepTimer()

    @property
    def phases(self) -> dict[str, float]:
        """Wall time, s, by name of the phase."""
        return self._timer.seconds

    def failure_counts(self) -> dict[str, int]:
        """Return the numbers of failures by name, over all ranks (collective)."""
        return asdict(self.failures) | {"cells_not_finite": self.inelastic.nonfinite_cells()}

    # --- states between steps ---

    def start(self, velocity: Values | None = None) -> State:
        """Return the state at t = 0: at rest, or with a velocity, and with inertia M a = f."""
        n = self.balance.owned_dof_count
        v = np.zeros(n) if velocity is None else velocity
        return self.with_forces(State(np.zeros(n), v, np.zeros(n), dt=self.sizes.step))

    def with_forces(self, state: State) -> State:
        """Return the state with loads, reactions, damping forces and acceleration of its displacement and velocity."""
        balance, free = self.balance, self.balance.motion.free_dofs
        balance.evaluate_at(state.t, state.u, state.v)
        applied, damping, a = balance.energies.applied_forces(), balance.energies.damping_forces(), state.a
        unbalanced = balance.stress.assemble_forces() - applied
        if damping is not None:
            unbalanced = unbalanced + damping
        if balance.scheme.carries_acceleration:
            a = balance.mass.solve(-unbalanced, free)
        forces = applied + np.where(free, 0.0, unbalanced)
        return replace(state, a=a, forces=forces, damping=damping, history=self.inelastic.snapshot())

    def from_checkpoint(self, state: State) -> State:
        """Return the state of a checkpoint, whose damage and plastic strain the body has read."""
        return self.inelastic.from_checkpoint(state)

    def discard_unsaved_data(self) -> None:
        """Do nothing: a step depends on its state alone."""

    # --- a step ---

    def set_stop_request(self, stop_requested: Callable[[], bool]) -> None:
        """Do nothing: steps without a system of equations are short."""

    def advance(self, state: State) -> tuple[State, StepReport]:
        """Take one step, as large as state.dt allows.

        Raises:
            NotConverged: the smallest step fails.
            StepAborted: the run is to stop; the body is that of `state` again.
        """
        try:
            return self._advance(state)
        except StepAborted:
            self.inelastic.restore(state)
            raise

    def _advance(self, state: State) -> tuple[State, StepReport]:
        began, spent = time.perf_counter(), SolveResult(False, 0, 0, "")
        self.inelastic.restore_damage(state)
        while True:
            dt = self._next_step(state)
            spent = solve = self._attempt(state, dt).with_iterations_of(spent)
            if not solve.converged:
                self.failures.steps_failed += 1
                state = self._ease(state, dt, solve)
                continue
            self.failures.rough_solutions += solve.is_rough
            try:
                return self._finish(state, dt, solve, began)
            except StepTooLong:
                self.failures.steps_retaken += 1
                state = self.sizes.reduce_for_fracture(state, dt)
                self.inelastic.restore_damage(state)
            except NonFiniteState:
                self.failures.steps_failed += 1
                self.inelastic.restore_damage(state)
                # Plastic flow and history variables of the terms are restored, too.
                self.inelastic.begin_step(state, dt)
                state = self._ease(state, dt, SolveResult(False, 0, 0, "What the step ends with is not finite"))

    def _next_step(self, state: State) -> float:
        """Return the size of the next step, s (collective)."""
        return self.sizes.next_step(state)

    def _attempt(self, state: State, dt: float) -> SolveResult:
        """Solve the step of dt (s); the balance is left at the last iterate, also without convergence (collective)."""
        raise NotImplementedError

    def _ease(self, state: State, dt: float, failed: SolveResult) -> State:
        """Return the state from which a failed step of dt (s) is repeated, by default with half of it.

        Raises:
            NotConverged: the step cannot be made any easier.
        """
        return self.sizes.reduce(state, dt, failed)

    # --- its end ---

    def _finish(self, state: State, dt: float, solve: SolveResult, began: float) -> tuple[State, StepReport]:
        """Complete the step, let the body flow and break, and sum the energies (collective)."""
        passes = self._repeat_with_fracture(state, dt, solve)
        balance, lumped = self.balance, self.balance.mass.is_diagonal and self.balance.scheme.inertia
        solved, acting = balance.u.x.array[: balance.owned_dof_count].copy(), balanced_forces(balance, lumped=lumped)
        u, v, a = self._complete_step(state, dt)
        work, viscous = step_work(balance, state, u, v, *acting, lumped=lumped)
        forces, damping = acting
        end = replace(state, u=u, v=v, a=a, t=state.t + dt, step=state.step + 1, forces=forces, damping=damping)
        lost = viscous + self._flow()
        if passes.start_fields is None:
            lost += passes.released
        else:
            lost += release_during_step(balance, state, u, solved, passes.start_fields)
        end, result = self._break_edges(end, solved, dt)
        lost += result.released_energy
        if (softened := self.inelastic.fracture.softened_fields) is not None:
            # Explicit steps find forces before they soften cells.
            work, _ = step_work(balance, state, u, v, end.forces, damping, lumped=lumped)
            lost -= softening_work(balance, state, u, solved, softened)
        energies = StepEnergies(work, lost, result.elastic_energy)
        return self._close_step(end, dt, passes.solve, began, result.broken_edges + passes.broken, energies)

    def _repeat_with_fracture(self, state: State, dt: float, solve: SolveResult) -> EarlierPasses:
        """Carry out all fracture passes of the step but the last, each followed by a solve; by default none."""
        return EarlierPasses(solve)

    def _complete_step(self, state: State, dt: float) -> tuple[Values, Values, Values]:
        """Return u, v and a at the end of the step, where the balance is evaluated as well (collective)."""
        balance, scheme, owned = self.balance, self.balance.scheme, self.balance.motion.owned_dofs
        balance.accept_step()
        x = balance.u.x.array[: balance.owned_dof_count].copy()
        u, v, a = scheme.complete_step(dt, x, state.u, state.v, state.a)
        if scheme.carries_acceleration:
            a = balance.carried_acceleration(dt, a)
        prescribed = scheme.prescribed_dof_rates(dt, u[owned], state.u[owned], state.v[owned])
        if prescribed is not None:
            v[owned], a[owned] = prescribed
        if scheme.alpha_f:
            # Forces were balanced within the step.
            self.inelastic.flow.begin_step(dt)
            balance.evaluate_at(state.t + dt, u, v, a)
            balance.update_reactions()
        return u, v, a

    def _flow(self) -> float:
        """Let the body flow; return the dissipated energy on this rank, J."""
        flow = self.inelastic.flow
        if flow.elastic_energy is None:
            return flow()
        with self._timer.measure("plasticity"):
            return flow()

    def _break_edges(self, end: State, solved: Values, dt: float) -> tuple[State, PassResultProtocol]:
        """Carry out the last fracture pass; return the state with the forces after it, and its result (collective).

        Args:
            end: state at the end of the step.
            solved: (owned dofs,) displacement at which the forces of the step balance, m.
            dt: step, s.
        """
        inelastic = self.inelastic
        with self._timer.measure(inelastic.fracture.phase):
            inelastic.fracture.set_rates(end.v, end.a)
            result = inelastic.fracture_pass(dt)
            if result.previous_damage:
                end = self._release(end, solved, dt, result)
            inelastic.damage_changed(result)
        return end, result

    def _release(self, end: State, solved: Values, dt: float, result: PassResultProtocol) -> State:
        """Return the state with the forces and the acceleration after a pass of a step of dt (s) (collective)."""
        raise NotImplementedError

    def _close_step(
        self, end: State, dt: float, solve: SolveResult, began: float, broken: int, energies: StepEnergies
    ) -> tuple[State, StepReport]:
        """Return the end of the step with its energies, history variables and the size of the next step (collective).

        Raises:
            NonFiniteState: the state or its energies are not finite.
        """
        end, kinetic, elastic = add_step_energies(self.balance, end, energies)
        end = self.sizes.grow(self.inelastic.with_snapshot(end), broken)
        return end, StepReport(dt, solve, broken, kinetic, elastic, time.perf_counter() - began)
