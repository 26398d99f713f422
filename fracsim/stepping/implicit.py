"""Advancing in time: attempt a step, halve it where the solve fails, grow it back after easy ones."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ..errors import NotConverged
from ..mechanics.balance import Equilibrium, driven
from ..mechanics.time_functions import of_size
from ..mesh.ranks import total
from ..study import Initial, Time
from .energy_book import acting, work_done
from .newton import Outcome, Solver
from .state import State
from .stress_release import release

Values = npt.NDArray[np.float64]

EASY_STEPS = 4  # steps in a row without trouble before a halved step is doubled again


@dataclass(frozen=True)
class Report:
    """A step that was taken: what history.csv says of it (sums over ranks)."""

    dt: float
    outcome: Outcome
    broken: int
    kinetic: float
    elastic: float
    seconds: float


class Stepper:
    """Moves a `State` forward by one step of the study's scheme, with the fracture pass at its end."""

    def __init__(self, equations: Equilibrium, solver: Solver | None, timing: Time, fracture: Any = None) -> None:
        self.equations, self.solver, self.timing, self.fracture = equations, solver, timing, fracture
        self.smallest = timing.smallest or timing.step / 1024
        self.passes = fracture.passes if fracture is not None else 1
        self.comm = equations.domain.comm
        self._lumped = timing.mass == "lumped" and equations.scheme.inertia
        self.flow: Any = None  # fracsim.mechanics.return_mapping.Flow of a body that yields
        self._before: Values | None = None  # displacement a step ago, to extrapolate a quasi-static load path
        self.failed = 0  # attempts that did not converge
        self.phases = {"solve": 0.0, "fracture": 0.0, "energies": 0.0}

    def start(self, initial: Initial | None) -> State:
        """The state at t = 0: at rest, or with the initial velocity, and in a dynamic study M a = f."""
        equations = self.equations
        n = len(equations.mass)
        state = State(np.zeros(n), np.zeros(n), np.zeros(n), dt=self.timing.step)
        if initial is not None:
            state.v = initial_velocity(equations, initial)
        self.settle(state)
        return state

    def settle(self, state: State) -> None:
        """Loads, reactions, damping forces and accelerations that belong to the state's displacement and velocity."""
        equations = self.equations
        equations.hold(state.t, state.u, state.v)
        unbalanced = equations.internal_force() - equations.applied_force()
        if (drag := equations.viscous_force()) is not None:
            state.drag = drag
            unbalanced = unbalanced + drag
        if equations.scheme.remembers:
            state.a = equations.inertia.solve(-unbalanced, equations.free)
        state.forces = equations.applied_force() + np.where(equations.free, 0.0, unbalanced)

    def advance(self, state: State) -> Report:
        """Take one step, as large as state.dt allows. Raises NotConverged at the smallest step."""
        began = time.perf_counter()
        while True:
            dt = self._fit(state)
            outcome = self._attempt(state, dt)
            if outcome.converged:
                break
            self.failed += 1
            self._halve(state, dt, outcome)
        outcome, broken, released = self._break_and_solve_again(state, dt, outcome)
        return self._accept(state, dt, outcome, began, broken, released)

    def _break_and_solve_again(self, state: State, dt: float, outcome: Outcome) -> tuple[Outcome, int, float]:
        """All passes of a step but its last: break, solve the step again from its start, until nothing new breaks.

        Returns the solve with all iterations counted, the edges broken and the energy released on this rank, J. Where
        the weakened body does not converge, the last solution stands and the next step takes up what is out of balance.
        """
        broken, released = 0, 0.0
        for _ in range(self.passes - 1):
            x = self.equations.u.x.array[: len(state.u)].copy()
            self._arrive(state, dt)
            self._flow()
            result = self.fracture()
            if self.flow is not None:
                self.flow.undo()  # from the start of the step again
            if not result.broken:
                self._return_to(x, state, dt)
                break
            broken, released = broken + result.broken, released + result.released
            assert self.solver is not None
            self.solver.damage_changed()
            again = self._attempt(state, dt)
            outcome = Outcome(True, outcome.newton + again.newton, outcome.krylov + again.krylov, "")
            if not again.converged:
                self.failed += 1
                self._return_to(x, state, dt)
                break
        return outcome, broken, released

    def _return_to(self, x: Values, state: State, dt: float) -> None:
        """The solved x of the step once more."""
        equations = self.equations
        equations.begin(state.t + dt, dt, state.u, state.v, state.a)
        equations.displace(x)
        equations.update_reactions()

    def _fit(self, state: State) -> float:
        """The step to take: no further than the end, and no sliver left over before it."""
        left = self.timing.end - state.t
        return left if left < state.dt * (1 + 1e-9) else state.dt

    def _attempt(self, state: State, dt: float) -> Outcome:
        began = time.perf_counter()
        equations = self.equations
        equations.begin(state.t + dt, dt, state.u, state.v, state.a)
        assert self.solver is not None
        outcome = self.solver.solve(self._guess(state, dt))
        self.phases["solve"] += time.perf_counter() - began
        return outcome

    def _guess(self, state: State, dt: float) -> Values:
        """Where the body would go by itself; in a quasi-static study the last increment once more."""
        if self.equations.scheme.inertia:
            return state.u + (1 - self.equations.scheme.alpha_f) * dt * state.v
        if self._before is None:
            return state.u
        return state.u + (state.u - self._before) * (dt / self._last_dt)

    def _halve(self, state: State, dt: float, outcome: Outcome) -> None:
        if self._before is not None and not self.equations.scheme.inertia:
            self._before = None  # the extrapolated guess may be what failed: try again from where the body is
            return
        state.easy = 0
        if not self.timing.adapt or dt / 2 < self.smallest:
            floor = "time.adapt is off" if not self.timing.adapt else f"the smallest step is {self.smallest:g} s"
            raise NotConverged(
                f"no solution at t = {state.t + dt:g} s with a step of {dt:g} s ({floor}). {outcome.reason}. "
                f"Last good time: {state.t:g} s"
            )
        state.dt = dt / 2

    def _accept(
        self, state: State, dt: float, outcome: Outcome, began: float, broken_before: int, released_before: float
    ) -> Report:
        equations = self.equations
        old, before = state.u, state.v
        solved, forces = equations.u.x.array[: len(old)].copy(), acting(equations, self._lumped)
        state.u, state.v, state.a = self._arrive(state, dt)
        self._before, self._last_dt = old, dt
        state.t, state.step = state.t + dt, state.step + 1
        work, viscous = work_done(equations, state, state.u - old, before, *forces, lumped=self._lumped)
        flowed = self._flow()
        broken, released, elastic = self._break(state, solved)
        broken, released = broken + broken_before, released + released_before + flowed
        if not equations.scheme.inertia:
            # what is neither stored nor moving is gone: releases, and the body's relaxation after them
            released, viscous = work - (elastic - state.elastic), 0.0
        state.elastic = elastic
        kinetic = equations.kinetic_energy(state.v) if equations.scheme.inertia else 0.0
        sums = total(self.comm, np.array([work, viscous + released, kinetic, elastic]))
        state.work += float(sums[0])
        state.dissipated += float(sums[1])
        self._grow(state)
        return Report(dt, outcome, broken, float(sums[2]), float(sums[3]), time.perf_counter() - began)

    def _arrive(self, state: State, dt: float) -> tuple[Values, Values, Values]:
        """(u, v, a) at the end of the step; forces and reactions are brought there where they were balanced inside."""
        equations = self.equations
        x = equations.u.x.array[: len(state.u)].copy()
        u, v, a = equations.scheme.finish(dt, x, state.u, state.v, state.a)
        if equations.scheme.rings:
            v[equations.held], a[equations.held] = driven(dt, *(each[equations.held] for each in (u, state.u, state.v)))
        if equations.scheme.alpha_f:
            if self.flow is not None:
                self.flow.begin(dt)
            equations.hold(state.t + dt, u, v, a)
            equations.update_reactions()
        return u, v, a

    def _flow(self) -> float:
        """Let the body flow, once it has arrived; returns the energy lost to it on this rank, J."""
        if self.flow is None:
            return 0.0
        began = time.perf_counter()
        lost: float = self.flow()
        self.phases["plasticity"] = self.phases.get("plasticity", 0.0) + time.perf_counter() - began
        return lost

    def _break(self, state: State, solved: Values) -> tuple[int, float, float]:
        """(edges broken, energy released, elastic energy left) of the step; the energies on this rank, J.

        `solved`: (owned dofs,) displacement at which the step's forces balance.
        """
        began = time.perf_counter()
        if self.fracture is None:
            elastic = self.equations.elastic_energy() if self.flow is None else self.flow.stored
            self.phases["energies"] += time.perf_counter() - began
            return 0, 0.0, elastic
        damage = self.equations.internal.damage() if self.equations.scheme.remembers else []
        result = self.fracture()
        if result.broken:
            self._release(state, solved, damage)
        self.phases["fracture"] += time.perf_counter() - began
        return result.broken, result.released, result.elastic

    def _release(self, state: State, solved: Values, damage: list[Values]) -> None:
        release(self.equations, self.solver, state, solved, damage)
        if self.solver is not None:
            self.solver.damage_changed()

    def _grow(self, state: State) -> None:
        state.easy += 1
        if state.dt < self.timing.step and state.easy >= EASY_STEPS:
            state.dt = min(2 * state.dt, self.timing.step)
            state.easy = 0


def initial_velocity(equations: Equilibrium, initial: Initial) -> Values:
    """(owned dofs,) v = velocity + spin x (X - centre of mass), m/s."""
    domain = equations.domain
    d = domain.dim
    X = domain.nodes[: domain.node_count]
    v = np.zeros_like(X)
    if initial.velocity is not None:
        v += of_size(initial.velocity, d, "initial.velocity")
    if initial.spin is not None:
        spin = of_size(initial.spin, 1 if d == 2 else 3, "initial.spin")
        mass = equations.mass.reshape(-1, d)[:, :1]
        sums = total(domain.comm, np.concatenate([(mass * X).sum(axis=0), mass.sum(axis=0)]))
        arm = X - sums[:d] / sums[d]
        v += np.cross(spin, arm) if d == 3 else spin * np.column_stack([-arm[:, 1], arm[:, 0]])
    return v.reshape(-1)
