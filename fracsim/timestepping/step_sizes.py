"""Size of time steps: its bounds, the times at which a step ends, reduction after failure and growth after success."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from ..errors import NotConverged
from ..mechanics.time_functions import TabulatedFunction
from ..solvers.newton import SolveResult
from .state import State


@dataclass(frozen=True)
class StepSizePolicy:
    """Tolerances and limits of the step size control."""

    # Share of a step. Two times that differ by less are equal.
    equal_times: float = 1e-6
    # Share of the interval between frames. A frame whose time is nearer than this counts as passed.
    frame_tolerance: float = 1e-5
    # Relative round-off of a sum of steps that is compared with an end time or a corner of the schedule.
    time_round_off: float = 1e-9
    # Successive steps without failure, after which a reduced step is doubled.
    steps_before_growth: int = 4


STEP_SIZE_POLICY = StepSizePolicy()


def count_intervals(t: float, interval: float) -> int:
    """Return the number of whole intervals (s) up to time t (s)."""
    return math.floor(t / interval + STEP_SIZE_POLICY.frame_tolerance)


@dataclass(frozen=True)
class StepSizes:
    """Bounds of the step size, s.

    Attributes:
        step: largest step.
        end: end time of the run.
        smallest: smallest step.
        adaptive: whether a step that fails is halved.
        largest_fracture_step: largest step in which edges may break.
        schedule: largest step as a function of time; None if it is constant.
        frame_interval: interval between frames. Steps that are no longer than this end at frames; 0: no step does.
    """

    step: float
    end: float
    smallest: float
    adaptive: bool = True
    largest_fracture_step: float = math.inf
    schedule: TabulatedFunction | None = None
    frame_interval: float = 0.0

    def time_to_frame(self, t: float, dt: float) -> float:
        """Return the time from t to the next frame, s; inf if steps of dt (s) need not end there."""
        if self.frame_interval < dt * (1 - STEP_SIZE_POLICY.equal_times):
            return math.inf
        return (count_intervals(t, self.frame_interval) + 1) * self.frame_interval - t

    def largest_step_at(self, t: float) -> float:
        """Return the largest step from time t (s). A step ends at a corner of the schedule rather than pass over it."""
        if self.schedule is None:
            return self.step
        round_off = STEP_SIZE_POLICY.time_round_off
        later = self.schedule.times[self.schedule.times > t * (1 + round_off) + round_off * self.smallest]
        return min(float(self.schedule(t)[0]), float(np.min(later - t, initial=math.inf)))

    def next_step(self, state: State) -> float:
        """Return the size of the next step, s. It ends at the next frame or at the end at the latest."""
        remaining, dt = self.end - state.t, min(state.dt, self.largest_step_at(state.t))
        if remaining < dt * (1 + STEP_SIZE_POLICY.time_round_off):
            return remaining
        remaining, tolerance = self.time_to_frame(state.t, dt), STEP_SIZE_POLICY.equal_times
        if abs(remaining - dt) <= tolerance * dt or remaining >= 2 * dt * (1 - tolerance):
            return dt
        # Two equal steps to the frame, so that no very short step is left over before it.
        return remaining if remaining < dt else remaining / 2

    def reduce(self, state: State, dt: float, failed: SolveResult) -> State:
        """Return the state with half of a step dt (s) that failed.

        Raises:
            NotConverged: the step size is fixed, or half of it is below the smallest.
        """
        if not self.adaptive or dt / 2 < self.smallest:
            floor = "time.adapt is off" if not self.adaptive else f"the smallest step is {self.smallest:g} s"
            raise NotConverged(
                f"no solution at t = {state.t + dt:g} s with a step of {dt:g} s ({floor}). {failed.reason}. "
                f"Last good time: {state.t:g} s"
            )
        return replace(state, dt=dt / 2, easy_steps=0)

    def reduce_for_fracture(self, state: State, dt: float) -> State:
        """Return the state with half of a step dt (s) in which edges broke, or with the largest fracture step."""
        return replace(state, dt=max(dt / 2, self.largest_fracture_step), easy_steps=0)

    def allows_fracture(self, dt: float) -> bool:
        """Return True if edges may break in a step of dt (s)."""
        return dt <= self.largest_fracture_step * (1 + STEP_SIZE_POLICY.time_round_off)

    def grow(self, state: State, broken_edges: int) -> State:
        """Return the state after a successful step: a reduced step is doubled after several of them."""
        if broken_edges and self.largest_fracture_step < math.inf:
            return replace(state, easy_steps=0)
        if state.dt < self.step and state.easy_steps + 1 >= STEP_SIZE_POLICY.steps_before_growth:
            return replace(state, dt=min(2 * state.dt, self.step), easy_steps=0)
        return replace(state, easy_steps=state.easy_steps + 1)
