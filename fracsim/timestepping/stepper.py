"""Advancing in time: a state goes in, the next one comes out, with what happened in between.

    state = stepper.start()
    state, report = stepper.advance(state)

`BalanceStepper` is what all schemes that step a balance of forces share. A step is attempted, halved where the solve
fails, and grows back after easy ones; then the body flows and breaks.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..errors import NotConverged, StepAborted
from ..mechanics.balance import Balance
from ..mechanics.time_functions import TabulatedFunction
from ..mesh.parallel import sum_over_ranks
from ..solvers.newton import SolveResult
from .energy_balance import balanced_forces, step_work
from .protocols import FractureProtocol, PassResultProtocol, PlasticFlowProtocol
from .state import State

Values = npt.NDArray[np.float64]

SAME = 1e-6  # of a step: times that are so close are the same
PASSED = 1e-5  # of an interval between frames: before its end by so much it has passed
EASY_STEPS = 4  # steps in a row without trouble before a halved step is doubled again


@dataclass(frozen=True)
class StepReport:
    """A step that was taken: what history.csv says of it (sums over ranks)."""

    dt: float
    solve: SolveResult
    broken: int
    kinetic: float
    elastic: float
    seconds: float


def count_intervals(t: float, interval: float) -> int:
    """How many whole intervals (s) have passed at time t (s)."""
    return math.floor(t / interval + PASSED)


@dataclass(frozen=True)
class StepSizes:
    """Sizes of steps, s: the largest, the end of the run, the smallest; `adapt`: halve a step that fails; `breaking`:
    the longest in which edges may break; `course`: the largest at a time, where it is not the same all the time;
    `frames`: of the intervals whose ends are ends of steps, too, where steps are no longer; 0: of none."""

    step: float
    end: float
    smallest: float
    adaptive: bool = True
    largest_fracture_step: float = math.inf
    schedule: TabulatedFunction | None = None
    frame_interval: float = 0.0

    def time_to_frame(self, t: float, dt: float) -> float:
        """From time t (s) to the next frame; inf where steps of dt (s) need not end there."""
        if self.frame_interval < dt * (1 - SAME):
            return math.inf
        return (count_intervals(t, self.frame_interval) + 1) * self.frame_interval - t

    def largest_step_at(self, t: float) -> float:
        """The largest step from time t (s) on: steps end where the course has a corner, or one would leap over it."""
        if self.schedule is None:
            return self.step
        later = self.schedule.times[self.schedule.times > t * (1 + 1e-9) + 1e-9 * self.smallest]
        return min(float(self.schedule(t)[0]), float(np.min(later - t, initial=math.inf)))


class StepTooLong(Exception):
    """Edges break in a step that is longer than such a step may be (on all ranks)."""


class NonFiniteState(Exception):
    """The state at the end of a step is not finite (on all ranks)."""


@dataclass
class FailureCounts:
    """What went wrong on the way without ending the run: counts over its steps.

    Attributes:
        steps_failed: attempts that did not converge, and were tried again otherwise.
        unbalanced_steps: steps that ended out of balance, for the body weakened by a break had no solution.
        steps_retaken: steps that were taken again, shorter, since edges broke in them.
    """

    steps_failed: int = 0
    unbalanced_steps: int = 0
    steps_retaken: int = 0


class Stepper(Protocol):
    """One way to get from a state to the next.

    Attributes:
        phases: seconds by what they were spent on.    trouble: counts of what failed on the way.
    """

    phases: dict[str, float]
    failures: FailureCounts

    def failure_counts(self) -> dict[str, int]:
        """What went wrong on the way without ending the run: counts by name, over all ranks (collective)."""

    def start(self, velocity: Values | None = None) -> State:
        """The state at t = 0, at rest or with a velocity (owned dofs,) in m/s (collective)."""

    def with_forces(self, state: State) -> State:
        """The state with the forces and accelerations that belong to its displacement and velocity (collective)."""

    def from_checkpoint(self, state: State) -> State:
        """The state of a checkpoint, with a body whose damage and flow were read from it (collective)."""

    def discard_unsaved_data(self) -> None:
        """Forget what a checkpoint does not hold, as a run that resumes from the checkpoint has done (collective)."""

    def advance(self, state: State) -> tuple[State, StepReport]:
        """Take one step, as large as state.dt allows (collective). Raises NotConverged at the smallest step, Abandoned
        where the run is to stop."""

    def set_stop_request(self, stop_requested: Callable[[], bool]) -> None:
        """Ask `abandons` (collective) inside long steps whether they are to be abandoned."""


class BalanceStepper:
    """What explicit, implicit and quasi-static steps share."""

    def __init__(
        self, balance: Balance, sizes: StepSizes, flow: PlasticFlowProtocol, breaking: FractureProtocol
    ) -> None:
        self.balance, self.sizes, self.flow, self.breaking = balance, sizes, flow, breaking
        self.comm = balance.domain.comm
        self.failures = FailureCounts()
        self.phases = {"solve": 0.0, "fracture": 0.0, "energies": 0.0}

    def failure_counts(self) -> dict[str, int]:
        """Counts by name of what failed on the way, over all ranks (collective)."""
        crushed = int(sum_over_ranks(self.comm, self.breaking.nonfinite_cells)[0])
        return asdict(self.failures) | {"cells_not_finite": crushed}

    # --- the state at the start ---

    def start(self, velocity: Values | None = None) -> State:
        """The state at t = 0: at rest, or with a velocity, and in a dynamic study M a = f."""
        n = self.balance.owned_dof_count
        v = np.zeros(n) if velocity is None else velocity
        return self.with_forces(State(np.zeros(n), v, np.zeros(n), dt=self.sizes.step))

    def with_forces(self, state: State) -> State:
        """Loads, reactions, damping forces and accelerations that belong to the state's displacement and velocity."""
        balance, free = self.balance, self.balance.motion.free_dofs
        balance.evaluate_at(state.t, state.u, state.v)
        applied, drag, a = balance.energies.applied_forces(), balance.energies.damping_forces(), state.a
        unbalanced = balance.stress.assemble_forces() - applied
        if drag is not None:
            unbalanced = unbalanced + drag
        if balance.scheme.carries_acceleration:
            a = balance.mass.solve(-unbalanced, free)
        forces = applied + np.where(free, 0.0, unbalanced)
        return replace(state, a=a, forces=forces, drag=drag, history=self._memory())

    def from_checkpoint(self, state: State) -> State:
        """The state of a checkpoint, with a body whose damage and flow were read from it."""
        balance = self.balance
        self.breaking.damage_restored()
        balance.set_displacement(state.u)
        self._recalled()
        balance.histories.from_checkpoint(state.history.get("saved", {}))
        return self.with_current_history(state)

    def discard_unsaved_data(self) -> None:
        """Forget what a checkpoint does not hold; here: nothing that a step depends on."""

    def with_current_history(self, state: State) -> State:
        """The state with the damage and the flow that the body has now, whoever brought them about."""
        return replace(state, history=self._memory())

    # --- a step ---

    def set_stop_request(self, stop_requested: Callable[[], bool]) -> None:
        """Steps without a system are short: nothing is asked inside them."""

    def advance(self, state: State) -> tuple[State, StepReport]:
        """Take one step, as large as state.dt allows. Raises NotConverged at the smallest step, Abandoned where the run
        is to stop."""
        try:
            return self._advance(state)
        except StepAborted:
            self._go_back(state)
            raise

    def _go_back(self, state: State) -> None:
        """Have the body as it was in a state (collective)."""
        self._recall(state)
        self._recall_flow_and_terms(state)
        self.balance.set_displacement(state.u)

    def _advance(self, state: State) -> tuple[State, StepReport]:
        began = time.perf_counter()
        self._recall(state)
        while True:
            dt = self._size(state)
            solve = self._attempt(state, dt)
            if not solve.converged:
                self.failures.steps_failed += 1
                state = self._easier(state, dt, solve)
                continue
            try:
                return self._finish(state, dt, solve, began)
            except StepTooLong:
                self.failures.steps_retaken += 1
                state = replace(state, dt=max(dt / 2, self.sizes.largest_fracture_step), easy=0)
                self._recall(state)
            except NonFiniteState:
                self.failures.steps_failed += 1
                self._recall(state)
                self._begin(state, dt)  # what flowed and what terms did in the step is undone, too
                state = self._easier(state, dt, SolveResult(False, 0, 0, "What the step ends with is not finite"))

    def _broken_in(self, dt: float) -> PassResultProtocol:
        """A pass of a step of dt s. Raises TooLong where edges break in it and it is longer than it may be then."""
        result = self.breaking()
        if result.broken_edges and dt > self.sizes.largest_fracture_step * (1 + 1e-9):
            raise StepTooLong
        return result

    def _memory(self) -> dict[str, object]:
        return {
            "damage": self.breaking.snapshot(),
            "flow": self.flow.snapshot(),
            "terms": self.balance.histories.snapshot(),
        }

    def _recall(self, state: State) -> None:
        if "damage" in state.history and self.breaking.restore(state.history["damage"]):
            self._recalled()

    def _recalled(self) -> None:
        """The body is damaged otherwise than it was: an earlier state is stepped once more."""
        self._tell_of_edges()
        self.balance.damage_changed()

    def _begin(self, state: State, dt: float) -> None:
        """The step begins, for the first time or once more: with what the body had flowed at its start, and terms as
        they were there."""
        self._recall_flow_and_terms(state)
        self.balance.begin_step(state.t + dt, dt, state.u, state.v, state.a)
        self.breaking.begin_step(state.t, dt)

    def _recall_flow_and_terms(self, state: State) -> None:
        if "flow" in state.history:
            self.flow.restore(state.history["flow"])
        if terms := state.history.get("terms"):
            self.balance.histories.restore(terms)

    def _size(self, state: State) -> float:
        """The step to take: no further than the end or the next frame, and no sliver left over before it."""
        left, dt = self.sizes.end - state.t, min(state.dt, self.sizes.largest_step_at(state.t))
        if left < dt * (1 + 1e-9):
            return left
        left = self.sizes.time_to_frame(state.t, dt)
        if abs(left - dt) <= SAME * dt or left >= 2 * dt * (1 - SAME):
            return dt
        return left if left < dt else left / 2

    def _attempt(self, state: State, dt: float) -> SolveResult:
        """Solve the step: the balance is left at what was found, whether that is a solution or not."""
        raise NotImplementedError

    def _easier(self, state: State, dt: float, solve: SolveResult) -> State:
        """The state from which to try again: half the step, down to the smallest."""
        sizes = self.sizes
        if not sizes.adaptive or dt / 2 < sizes.smallest:
            floor = "time.adapt is off" if not sizes.adaptive else f"the smallest step is {sizes.smallest:g} s"
            raise NotConverged(
                f"no solution at t = {state.t + dt:g} s with a step of {dt:g} s ({floor}). {solve.reason}. "
                f"Last good time: {state.t:g} s"
            )
        return replace(state, dt=dt / 2, easy=0)

    def _grown(self, state: State, broken: int) -> State:
        """After an easy step a halved one may double again."""
        if broken and self.sizes.largest_fracture_step < math.inf:
            return replace(state, easy=0)
        if state.dt < self.sizes.step and state.easy + 1 >= EASY_STEPS:
            return replace(state, dt=min(2 * state.dt, self.sizes.step), easy=0)
        return replace(state, easy=state.easy + 1)

    # --- its end ---

    @staticmethod
    def clock() -> float:
        """s, of a clock that times phases."""
        return time.perf_counter()

    def _finish(self, state: State, dt: float, solve: SolveResult, began: float) -> tuple[State, StepReport]:
        """Arrive at the end of the step, let the body flow and break, and book it."""
        solve, broken, released = self._passes(state, dt, solve)
        balance, lumped = self.balance, self.balance.mass.is_diagonal and self.balance.scheme.inertia
        solved, acted = balance.u.x.array[: balance.owned_dof_count].copy(), balanced_forces(balance, lumped=lumped)
        u, v, a = self._arrive(state, dt)
        work, viscous = step_work(balance, state, u, v, *acted, lumped=lumped)
        forces, drag = acted
        end = replace(state, u=u, v=v, a=a, t=state.t + dt, step=state.step + 1, forces=forces, drag=drag)
        flowed = self._let_flow()
        end, result = self._break(end, solved, dt)
        lost = viscous + (result.released_energy + released + flowed)
        return self._booked(end, dt, solve, began, result.broken_edges + broken, result.elastic_energy, work, lost)

    def _passes(self, state: State, dt: float, solve: SolveResult) -> tuple[SolveResult, int, float]:
        """All passes of the step but its last: the solve with all iterations counted, the edges that broke, and the
        energy that they released on this rank, J. Here: none."""
        return solve, 0, 0.0

    def _booked(
        self, end: State, dt: float, solve: SolveResult, began: float, broken: int, elastic: float, work: float,
        lost: float,
    ) -> tuple[State, StepReport]:  # fmt: skip
        """The end of the step with its energies; those given are of this rank, J."""
        balance = self.balance
        self._check_finite(end, work + lost + elastic)
        elastic += sum(term.stored_energy() for term in balance.terms if term is not balance.stress)
        worked, rubbed = balance.energies.step_work()
        stiffened = balance.contact.stiffen()
        work, lost, elastic = work + worked + stiffened, lost + rubbed, elastic + stiffened
        kinetic = balance.energies.kinetic_energy(end.v) if balance.scheme.inertia else 0.0
        work, lost, kinetic, total = map(float, sum_over_ranks(self.comm, np.array([work, lost, kinetic, elastic])))
        end = replace(
            end, elastic=elastic, work=end.work + work, dissipated=end.dissipated + lost, history=self._memory()
        )
        return self._grown(end, broken), StepReport(dt, solve, broken, kinetic, total, time.perf_counter() - began)

    def _check_finite(self, end: State, energies: float) -> None:
        """Raise NotFinite where the end of a step is not finite, or squares of it are not (collective)."""
        squares = sum(float(np.vdot(item, item)) for item in (end.u, end.v, end.a, end.forces))
        if not self.comm.allreduce(math.isfinite(squares + energies), op=MPI.LAND):
            raise NonFiniteState

    def _arrive(self, state: State, dt: float) -> tuple[Values, Values, Values]:
        """(u, v, a) at the end of the step; forces and reactions are brought there where they were balanced inside."""
        balance, scheme, owned = self.balance, self.balance.scheme, self.balance.motion.owned_dofs
        balance.accept_step()
        x = balance.u.x.array[: balance.owned_dof_count].copy()
        u, v, a = scheme.complete_step(dt, x, state.u, state.v, state.a)
        if scheme.carries_acceleration:
            a = balance.carried_acceleration(dt, a)
        if (led := scheme.prescribed_dof_rates(dt, u[owned], state.u[owned], state.v[owned])) is not None:
            v[owned], a[owned] = led
        if scheme.alpha_f:
            self.flow.begin_step(dt)
            balance.evaluate_at(state.t + dt, u, v, a)
            balance.update_reactions()
        return u, v, a

    def _let_flow(self) -> float:
        """Let the body flow, once it has arrived; returns the energy lost to it on this rank, J."""
        began = time.perf_counter()
        lost = self.flow()
        if self.flow.elastic_energy is not None:
            self.phases["plasticity"] = self.phases.get("plasticity", 0.0) + time.perf_counter() - began
        return lost

    def _break(self, end: State, solved: Values, dt: float) -> tuple[State, PassResultProtocol]:
        """A pass, and the state with the forces and the acceleration that it leaves.

        `solved`: (owned dofs,) displacement at which the forces of the step, of dt s, balance.
        """
        began = time.perf_counter()
        self.breaking.set_rates(end.v, end.a)
        result = self._broken_in(dt)
        if result.broken_edges:
            end = self._released(end, solved, result)
        self._damage_changed(result)
        self.phases[self.breaking.phase] += time.perf_counter() - began
        return end, result

    def _released(self, end: State, solved: Values, result: PassResultProtocol) -> State:
        """The state once what broke has let go."""
        raise NotImplementedError

    def _damage_changed(self, result: PassResultProtocol) -> None:
        """Cells lost stiffness: forms are bound once to the cells that are left."""
        if result.broken_edges:
            self._tell_of_edges()
        if result.cells_died:
            self.balance.damage_changed()

    def _tell_of_edges(self) -> None:
        if (pattern := self.breaking.broken_edge_patterns) is not None:
            self.balance.edges_broke(pattern)
