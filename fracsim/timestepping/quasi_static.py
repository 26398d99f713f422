"""Quasi-static steps: equilibrium and fracture passes in turn, until neither edges nor cells change.

Equations: docs/theory.md#quasi-static-steps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..solvers.newton import SolveResult
from .energy_balance import StepEnergies, balanced_forces
from .implicit import ImplicitStepper
from .inelastic_update import PassResultProtocol
from .state import State
from .stepper import StepReport

Values = npt.NDArray[np.float64]


@dataclass
class EquilibriumPath:
    """Path from equilibrium to equilibrium within a step, with its work and losses on this rank.

    Attributes:
        u: displacement of the last equilibrium, (owned dofs,), m.
        forces: loads and reactions there, N.
        damping: damping forces there, N; None without damping.
        out_of_balance: residual on free dofs there, N; None in equilibrium.
        work: external work since the start of the step, J.
        lost: dissipated energy since the start of the step, J.
    """

    u: Values
    forces: Values
    damping: Values | None
    out_of_balance: Values | None
    work: float = 0.0
    lost: float = 0.0

    def continue_to(self, u: Values, forces: Values, damping: Values | None) -> None:
        """Continue the path to another equilibrium; forces are linear along the way."""
        change = u - self.u
        self.work += float((self.forces + forces) @ change) / 2
        if damping is not None:
            before = self.damping if self.damping is not None else 0.0
            self.lost += float((before + damping) @ change) / 2
        if self.out_of_balance is not None:
            # The unbalanced forces decrease to 0 along the way.
            self.lost -= float(self.out_of_balance @ change) / 2
        self.u, self.forces, self.damping, self.out_of_balance = u, forces, damping, None

    def omit_first_equilibrium(self, start: State, obstacle_work: float) -> None:
        """Replace the work by that of forces that are linear between start and end of the step.

        A body that weakens gradually does not pass through the first equilibrium, whose damage is that of the start.
        The work of its forces beyond those of the weakened body is no external work, and is not lost.

        Args:
            start: state at the start of the step.
            obstacle_work: work of obstacles as evaluated at the first equilibrium, less that at the last one, J.
        """
        work = float((start.forces + self.forces) @ (self.u - start.u)) / 2
        self.lost -= self.work - work + obstacle_work
        self.work = work

    def set_unbalanced(self, reactions: Values, owned: npt.NDArray[np.int32], out_of_balance: Values) -> None:
        """Set loads and reactions of the dofs `owned`, and the residual of free dofs, after a pass."""
        self.forces = self.forces.copy()
        self.forces[owned] = reactions
        self.out_of_balance = out_of_balance


class QuasiStaticStepper(ImplicitStepper):
    """Stepper of load steps without inertia."""

    def start(self, velocity: Values | None = None) -> State:
        """Return the state at rest and without load: a load at t = 0 acts from the first step on."""
        state = super().start(velocity)
        return replace(state, forces=np.zeros_like(state.forces))

    def _guess(self, state: State, dt: float) -> Values:
        """Return the displacement extrapolated by the last increment, (owned dofs,), m."""
        if state.previous_increment is None:
            return state.u
        earlier, last = state.previous_increment
        return np.asarray(state.u + (state.u - earlier) * (dt / last))

    def _ease(self, state: State, dt: float, failed: SolveResult) -> State:
        """Return the state without extrapolation, which may be the reason of the failure; then with half of the step.

        Raises:
            NotConverged: the step cannot be made any easier.
        """
        if state.previous_increment is not None:
            return replace(state, previous_increment=None)
        return super()._ease(state, dt, failed)

    def _finish(self, state: State, dt: float, solve: SolveResult, began: float) -> tuple[State, StepReport]:
        """Break edges and solve in turn, until a pass changes nothing, or nothing that the solver would correct.

        Edges break abruptly at the first equilibrium, whose load the body carries. A body that weakens gradually
        carries that of the last one.
        """
        path = EquilibriumPath(state.u, state.forces, state.damping, state.out_of_balance)
        broken, released, flow_loss, limit = 0, 0.0, 0.0, self.inelastic.max_passes
        first_obstacle_work, is_gradual = 0.0, self.inelastic.fracture.weakens_gradually
        works_of_obstacles: list[list[float]] = []
        start, continues = state, self.inelastic.flow.continues
        for number in range(limit):
            self.balance.accept_step()
            if number == 0:
                self.onset_reactions = self.balance.reactions.copy()
                works_of_obstacles = self.balance.energies.works_of_obstacles()
                if is_gradual:
                    first_obstacle_work = self.balance.energies.obstacle_work()
            path.continue_to(self._solution(), *balanced_forces(self.balance, lumped=False))
            flow_loss = self._flow() + (flow_loss if continues else 0.0)
            result = self._fracture_pass(path, dt)
            broken, released = broken + result.broken_edges, released + result.released_energy
            if path.out_of_balance is None or number + 1 == limit:
                break
            if continues:
                start = self.inelastic.with_flow(start)
            again = self._solve(start, dt, path.u)
            solve = solve.with_iterations_of(again)
            if again.converged and (result.broken_edges or again.newton_iterations):
                continue
            if not again.converged:
                self.failures.unbalanced_steps += 1
                self._return_to(path.u, start, dt)
            flow_loss = self._flow() + (flow_loss if continues else 0.0)
            break
        if is_gradual:
            self.onset_reactions = self.balance.reactions.copy()
            path.omit_first_equilibrium(state, first_obstacle_work - self.balance.energies.obstacle_work())
        else:
            # obstacles have moved before the first equilibrium, and stand still as edges break
            self.balance.energies.replace_works_of_obstacles(works_of_obstacles)
        energies = StepEnergies(path.work, path.lost + (released + flow_loss), result.elastic_energy)
        return self._close_step(self._end(state, dt, path), dt, solve, began, broken, energies)

    def _end(self, state: State, dt: float, path: EquilibriumPath) -> State:
        """Return the state at the end of the path."""
        _, v, a = self.balance.scheme.complete_step(dt, path.u, state.u, state.v, state.a)
        return replace(
            state, u=path.u, v=v, a=a, t=state.t + dt, step=state.step + 1, forces=path.forces, damping=path.damping,
            previous_increment=(state.u, dt), out_of_balance=path.out_of_balance,
        )  # fmt: skip

    def _fracture_pass(self, path: EquilibriumPath, dt: float) -> PassResultProtocol:
        """Carry out a pass at the end of the path, and give the path what is out of balance after it (collective)."""
        inelastic, balance = self.inelastic, self.balance
        with self._timer.measure(inelastic.fracture.phase):
            result = inelastic.fracture_pass(dt)
            if result.broken_edges or balance.domain.comm.allreduce(result.largest_chi_loss, op=MPI.MAX) > 0:
                inelastic.damage_changed(result)
                residual = balance.update_forces().copy()
                owned, free = balance.motion.owned_dofs, balance.motion.free_dofs
                reactions = balance.energies.applied_forces()[owned] + residual[owned]
                path.set_unbalanced(reactions, owned, np.where(free, residual, 0.0))
        return result
