"""Energy balance of a step: work, dissipation and stored energy; forces and acceleration after fracture.

Equations: docs/theory.md#energy-balance, docs/theory.md#time-integration.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..mechanics.balance import Balance
from ..mechanics.term_protocols import SurfaceSeparator, fulfilling
from ..mesh.parallel import sum_over_ranks
from .state import State

Values = npt.NDArray[np.float64]


class NonFiniteState(Exception):
    """The state at the end of a step is not finite (on all ranks)."""


@dataclass(frozen=True)
class StepEnergies:
    """Energies of a step on this rank, J.

    Attributes:
        work: external work.
        dissipated: energy lost to fracture, plastic flow and damping.
        elastic: elastic energy of the body at the end of the step.
    """

    work: float
    dissipated: float
    elastic: float


def balanced_forces(balance: Balance, *, lumped: bool) -> tuple[Values, Values | None]:
    """Return loads and reactions, and damping forces, at the level where the step balances them, (owned dofs,), N.

    Args:
        balance: after the solve of a step.
        lumped: leave out the inertia of prescribed dofs, as `step_work` needs it with a lumped mass.
    """
    owned = balance.motion.owned_dofs
    forces = balance.energies.applied_forces()
    forces[owned] += balance.reactions[owned]
    if lumped:
        forces[owned] -= balance.mass.lumped[owned] * balance.rates()[1][owned]
    return forces, balance.energies.damping_forces()


def step_work(
    balance: Balance, start: State, u: Values, v: Values, forces: Values, damping: Values | None, *, lumped: bool
) -> tuple[float, float]:
    """Return external work and viscous dissipation of a step on this rank, J.

    Forces are linear in time. Those of this step belong to t + (1 - alpha_f) dt, those of the last one to t - alpha_f
    dt; their line is evaluated at t + dt/2.

    Args:
        balance: gives scheme, mass and prescribed dofs.
        start: state at the start of the step.
        u: displacement at its end, m.
        v: velocity at its end, m/s.
        forces: loads and reactions of this step, N.
        damping: its damping forces, N; None without damping.
        lumped: the work that moves prescribed dofs is the gain of their kinetic energy, since their velocity may jump.
    """
    # Forces at the end of a step of generalized-alpha balance nothing: the pressure of a nearly incompressible body is
    # wrong there by lambda |grad du|^2.
    late, owned, increment = balance.scheme.alpha_f, balance.motion.owned_dofs, u - start.u
    kinetic_gain = 0.0
    if lumped:
        kinetic_gain = 0.5 * float(balance.mass.lumped[owned] @ (v[owned] ** 2 - start.v[owned] ** 2))
    work = float(((0.5 + late) * forces + (0.5 - late) * start.forces) @ increment) + kinetic_gain
    viscous = 0.0
    if damping is not None:
        earlier = start.damping if start.damping is not None else 0.0
        viscous = float(((0.5 + late) * damping + (0.5 - late) * earlier) @ increment)
    return work, viscous


def add_step_energies(balance: Balance, end: State, step: StepEnergies) -> tuple[State, float, float]:
    """Return the state at the end of a step with its energies, and kinetic and stored energy, J (collective).

    Args:
        balance: its terms give their energies and work.
        end: state at the end of the step, with the energies of its start.
        step: energies of the step without those of the terms.

    Raises:
        NonFiniteState: the state or its energies are not finite.
    """
    _check_finite(balance.domain.comm, end)
    elastic = step.elastic
    elastic += sum(term.stored_energy() for term in balance.terms_with["stored_energy"] if term is not balance.stress)
    term_work, friction_loss = balance.energies.step_work()
    # Energy that contact stores because its stiffness rises, which does external work.
    stiffening_work = balance.contact.stiffen()
    work = step.work + term_work + stiffening_work
    dissipated, elastic = step.dissipated + friction_loss, elastic + stiffening_work
    kinetic = balance.energies.kinetic_energy(end.v) if balance.scheme.inertia else 0.0
    sums = sum_over_ranks(balance.domain.comm, np.array([work, dissipated, kinetic, elastic]))
    work, dissipated, kinetic, stored = map(float, sums)
    if not math.isfinite(work + dissipated + kinetic + stored):
        raise NonFiniteState
    end = replace(end, elastic=elastic, work=end.work + work, dissipated=end.dissipated + dissipated)
    return end, kinetic, stored


def _check_finite(comm: MPI.Comm, end: State) -> None:
    """Raise NonFiniteState if the squares of the values at the end of a step are not finite (collective)."""
    squares = sum(float(np.vdot(values, values)) for values in (end.u, end.v, end.a, end.forces))
    if not comm.allreduce(math.isfinite(squares), op=MPI.LAND):
        raise NonFiniteState


def softening_work(balance: Balance, start: State, u: Values, solved: Values, start_fields: Sequence[Values]) -> float:
    """Return the work, J, on this rank that forces did which softening took away in the course of a step (collective).

    The energy released at the displacement at the end is too large by it: forces decrease while cells open.

    Args:
        balance: at the end of the step.
        start: state at the start of the step.
        u: displacement at its end, (owned dofs,), m.
        solved: displacement at which the forces of the step balance, (owned dofs,), m.
        start_fields: damage fields at the start of the step.
    """
    # The share of `step_work` that the forces of this step have, which are those after softening.
    share = 0.5 + balance.scheme.alpha_f
    balance.set_displacement(solved)
    released = balance.stress.assemble_released_forces(start_fields)
    balance.set_displacement(u)
    return share * float(released @ (u - start.u))


def release_during_step(
    balance: Balance, start: State, u: Values, solved: Values, start_fields: Sequence[Values]
) -> float:
    """Return the energy, J, on this rank that damage released in a step that was solved with this damage (collective).

    Args:
        balance: at the end of the step.
        start: state at the start of the step.
        u: displacement at its end, (owned dofs,), m.
        solved: displacement at which the forces of the step balance, (owned dofs,), m.
        start_fields: damage fields at the start of the step.
    """
    stress = balance.stress
    fields = stress.exchange_damage(start_fields)
    stored = stress.stored_energy()
    stress.exchange_damage(fields)
    released = stored - stress.stored_energy()
    return released - softening_work(balance, start, u, solved, start_fields)


def released_state(
    balance: Balance,
    end: State,
    solved: Values,
    previous_damage: Sequence[Values],
    response: Callable[[Values], Values] | None,
) -> State:
    """Return the end of a step with the forces and the acceleration after its last fracture pass (collective).

    The acceleration changes by c_a (c_a M + K)^-1 f, f the forces that the pass released and K the tangent before
    it. This is M^-1 f for motion that steps resolve, with an error of second order, and almost 0 for motion that is
    much faster.

    Args:
        balance: at the end of the step.
        end: state before the release.
        solved: (owned dofs,) displacement at which the forces of the step balance, m. The end of a step of
            generalized-alpha is an extrapolation.
        previous_damage: damage fields before the pass.
        response: linear displacement response of a step to forces (owned dofs,), m; None: the acceleration changes by
            M^-1 f, as steps resolve all motion that the forces excite.
    """
    owned, forces = balance.motion.owned_dofs, end.forces.copy()
    reactions = balance.reactions[owned]
    balance.update_reactions()
    if not balance.scheme.carries_acceleration:
        forces[owned] += balance.reactions[owned] - reactions
        return replace(end, forces=forces)
    free = balance.motion.free_dofs
    if response is None:
        released = balance.stress.assemble_released_forces(previous_damage)
        change = balance.mass.solve(np.where(free, released, 0.0), free)
    else:
        balance.set_displacement(solved)
        released = balance.stress.assemble_released_forces(previous_damage)
        # K is that before the breaks. With K after them, or with M^-1 f, slivers and cells that are attached by one
        # edge begin to vibrate: the error of the energy balance was twice the energy where it is 1 % now.
        current = balance.stress.exchange_damage(previous_damage)
        if fulfilling(balance.terms, SurfaceSeparator):
            # New crack faces are apart at the end of the step, and may not be where its forces balance.
            balance.set_displacement(end.u)
        # The response leaves contact out: contact forces are not part of the acceleration that is carried on
        # (mechanics.contact_time_weights), and a break inside a body changes no resultant of them.
        change = balance.c_a * response(np.where(free, released, 0.0))
        balance.stress.exchange_damage(current)
        balance.set_displacement(end.u)
    forces[owned] -= released[owned]
    return replace(end, forces=forces, a=end.a + change)
