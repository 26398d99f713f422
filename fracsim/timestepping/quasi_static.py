"""Quasi-static steps: events of breaking and balance follow one another until neither edges nor cells change.

The books are of two sides that share nothing. Work is that of loads and reactions along the way, and stored energy is
the integral of psi. Lost is, of every event, what broken edges and fallen chi release where the body stands, and what
the body loses on its way to the new balance: the work of the forces that are out of balance, which die down to nothing,

    relaxed = - r . (u_after - u_before) / 2,     r the residual on free dofs as the event leaves it,

to second order of the way, exactly for a linear body.

Equations: docs/theory.md#quasi-static-steps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..solvers.newton import SolveResult
from .energy_balance import balanced_forces
from .implicit import UNLIMITED, ImplicitStepper
from .protocols import PassResultProtocol
from .state import State
from .stepper import StepReport

Values = npt.NDArray[np.float64]


@dataclass
class _Path:
    """The way from balance to balance within a step, and its books on this rank, J.

    Attributes:
        u, forces, drag: where it has come to.    out_of_balance: r on free dofs there; None: balanced.
    """

    u: Values
    forces: Values
    drag: Values | None
    out_of_balance: Values | None
    work: float = 0.0
    lost: float = 0.0

    def to(self, u: Values, forces: Values, drag: Values | None) -> None:
        """On to another balance."""
        change = u - self.u
        self.work += float((self.forces + forces) @ change) / 2
        if drag is not None:
            before = self.drag if self.drag is not None else 0.0
            self.lost += float((before + drag) @ change) / 2
        if self.out_of_balance is not None:
            self.lost -= float(self.out_of_balance @ change) / 2
        self.u, self.forces, self.drag, self.out_of_balance = u, forces, drag, None


class QuasiStaticStepper(ImplicitStepper):
    """Load stepping without inertia."""

    def start(self, velocity: Values | None = None) -> State:
        """At rest, and unloaded: a load that is there from the start on is put on in the first step."""
        state = super().start(velocity)
        return replace(state, forces=np.zeros_like(state.forces))

    def _guess(self, state: State, dt: float) -> Values:
        """The last increment once more."""
        if state.previous_increment is None:
            return state.u
        earlier, last = state.previous_increment
        return np.asarray(state.u + (state.u - earlier) * (dt / last))

    def _easier(self, state: State, dt: float, solve: SolveResult) -> State:
        """The extrapolated guess may be what failed: first try again from where the body is."""
        return (
            replace(state, previous_increment=None)
            if state.previous_increment is not None
            else super()._easier(state, dt, solve)
        )

    def _finish(self, state: State, dt: float, solve: SolveResult, began: float) -> tuple[State, StepReport]:
        """Break and balance in turn, until a pass changes nothing, or nothing that the solver would correct."""
        path = _Path(state.u, state.forces, state.drag, state.out_of_balance)
        broken, released, limit = 0, 0.0, self.breaking.max_passes or UNLIMITED
        for number in range(limit):
            self.balance.accept_step()
            path.to(self._solved(), *balanced_forces(self.balance, lumped=False))
            flowed = self._let_flow()
            result = self._pass(path, dt)
            broken, released = broken + result.broken_edges, released + result.released_energy
            if path.out_of_balance is None or number + 1 == limit:
                break
            again = self._solve(state, dt, path.u)
            solve = SolveResult(
                True,
                solve.newton_iterations + again.newton_iterations,
                solve.krylov_iterations + again.krylov_iterations,
                "",
            )
            if again.converged and (result.broken_edges or again.newton_iterations):
                continue
            if not again.converged:
                self.failures.unbalanced_steps += 1
                self._return_to(path.u, state, dt)
            flowed = self._let_flow()
            break
        end = self._arrived(state, dt, path)
        return self._booked(
            end, dt, solve, began, broken, result.elastic_energy, path.work, path.lost + (released + flowed)
        )

    def _solved(self) -> Values:
        return self.balance.u.x.array[: self.balance.owned_dof_count].copy()

    def _arrived(self, state: State, dt: float, path: _Path) -> State:
        """The end of the step."""
        _, v, a = self.balance.scheme.complete_step(dt, path.u, state.u, state.v, state.a)
        return replace(
            state, u=path.u, v=v, a=a, t=state.t + dt, step=state.step + 1, forces=path.forces, drag=path.drag,
            previous_increment=(state.u, dt), out_of_balance=path.out_of_balance,
        )  # fmt: skip

    def _pass(self, path: _Path, dt: float) -> PassResultProtocol:
        """A pass where the path has come to, and what it leaves out of balance there."""
        began = self.clock()
        result = self._broken_in(dt)
        if result.broken_edges or self.comm.allreduce(result.largest_chi_loss, op=MPI.MAX) > 0:
            self._damage_changed(result)
            balance = self.balance
            residual = balance.update_forces().copy()
            owned, free = balance.motion.owned_dofs, balance.motion.free_dofs
            path.forces = path.forces.copy()
            path.forces[owned] = balance.energies.applied_forces()[owned] + residual[owned]
            path.out_of_balance = np.where(free, residual, 0.0)
        self.phases[self.breaking.phase] += self.clock() - began
        return result
