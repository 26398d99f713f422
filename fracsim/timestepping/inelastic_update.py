"""Plastic flow and fracture at the end of a step, their interfaces, and the history variables of the body."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..mechanics.balance import Balance
from ..mesh.parallel import sum_over_ranks
from .state import HistoryVariables, State
from .step_sizes import StepSizes

Values = npt.NDArray[np.float64]


class PassResultProtocol(Protocol):
    """Interface of the result of one fracture pass."""

    @property
    def broken_edges(self) -> int:
        """Number of edges that broke, on all ranks."""

    @property
    def largest_chi_loss(self) -> float:
        """Largest decrease of chi in a cell of this rank."""

    @property
    def released_energy(self) -> float:
        """Elastic energy released on this rank, J."""

    @property
    def elastic_energy(self) -> float:
        """Elastic energy left on this rank, J."""

    @property
    def cells_died(self) -> bool:
        """Whether chi of some cell of this rank fell to 0."""

    @property
    def previous_damage(self) -> list[Values]:
        """Copies of the damage fields before the pass, if it released forces on any rank."""


class FractureProtocol(HistoryVariables, Protocol):
    """Interface of the fracture of a body.

    Attributes:
        max_passes: largest number of passes in a step; None: until nothing changes.
        phase: name of the phase to which the time of a pass counts.
        weakens_gradually: damage grows with the load, so that a body at rest carries no load with less damage than that
            load gives; otherwise edges break at once.
        softens_gradually: cells soften in the course of a step with inertia, where its forces balance; otherwise
            energy is released at once, at the end of a step.
        softened_fields: damage fields at the start of the step, if cells softened in its course on any rank.
    """

    max_passes: int | None
    phase: str
    weakens_gradually: bool
    softens_gradually: bool
    softened_fields: list[Values] | None

    @property
    def releases_gradually(self) -> bool:
        """Whether split cells release their energy over many steps."""

    @property
    def nonfinite_cells(self) -> int:
        """Number of evaluations on this rank of cells whose stress was not finite."""

    @property
    def broken_edge_patterns(self) -> npt.NDArray[np.uint8] | None:
        """(cells,) broken edges of each cell, one bit each (mesh.edge_graph); None without edges."""

    def begin_step(self, t: float, dt: float) -> None:
        """Prepare the passes of a step of dt (s) from t (s); a step may begin repeatedly."""

    def set_rates(self, v: Values, a: Values) -> None:
        """Store velocity (owned dofs,), m/s, and acceleration, m/s^2, for the next pass."""

    def __call__(self) -> PassResultProtocol:
        """Carry out one pass at the present displacement (collective)."""

    def damage_restored(self) -> None:
        """Recompute the damage fields from edges and chi that were read from a checkpoint."""


class PlasticFlowProtocol(HistoryVariables, Protocol):
    """Interface of the plastic flow of a body.

    Attributes:
        elastic_energy: elastic energy of the undamaged body after the last flow, J, on this rank; None without flow.
        continues: a step that is solved again after a break continues from the flow before the break, which does not
            depend on time; else from the start of the step.
    """

    elastic_energy: float | None
    continues: bool

    def begin_step(self, dt: float) -> None:
        """Prepare the flow of a step of dt (s)."""

    def __call__(self) -> float:
        """Let the body flow at the present displacement; return the dissipated energy on this rank, J."""

    def edges_broke(self) -> None:
        """Note that other edges are broken than before (collective)."""


class NoPlasticFlow:
    """Plastic flow of an elastic body."""

    elastic_energy: float | None = None
    continues = False

    def begin_step(self, dt: float) -> None:
        """Do nothing."""

    def __call__(self) -> float:
        """Return 0: nothing is dissipated."""
        return 0.0

    def edges_broke(self) -> None:
        """Do nothing."""

    def snapshot(self) -> object:
        """Return None: there are no history variables."""
        return None

    def restore(self, saved: object) -> bool:
        """Return False: there are no history variables."""
        return False


@dataclass(frozen=True)
class ElasticPassResult:
    """Result of a pass on a body that does not break (`PassResultProtocol`).

    Attributes:
        elastic_energy: on this rank, J.
        broken_edges, largest_chi_loss, released_energy, cells_died, previous_damage: none.
    """

    elastic_energy: float
    broken_edges: int = 0
    largest_chi_loss: float = 0.0
    released_energy: float = 0.0
    cells_died: bool = False
    previous_damage: list[Values] = field(default_factory=list)


class NoFracture:
    """Fracture of a body that does not break: a pass evaluates the elastic energy."""

    max_passes: int | None = 1
    nonfinite_cells = 0
    phase = "energies"
    broken_edge_patterns = None
    weakens_gradually = False
    softens_gradually = False
    softened_fields: list[Values] | None = None
    releases_gradually = False

    def __init__(self, balance: Balance, flow: PlasticFlowProtocol | None = None) -> None:
        self._balance, self._flow = balance, flow or NoPlasticFlow()

    def begin_step(self, t: float, dt: float) -> None:
        """Do nothing."""

    def set_rates(self, v: Values, a: Values) -> None:
        """Do nothing."""

    def __call__(self) -> PassResultProtocol:
        """Return the elastic energy; the plastic flow has evaluated it already where there is any."""
        stored = self._flow.elastic_energy
        return ElasticPassResult(self._balance.stress.stored_energy() if stored is None else stored)

    def snapshot(self) -> object:
        """Return None: there are no history variables."""
        return None

    def restore(self, saved: object) -> bool:
        """Return False: there are no history variables."""
        return False

    def damage_restored(self) -> None:
        """Do nothing."""


# --- the update of a step ---


class StepTooLong(Exception):
    """Edges broke in a step that is longer than a step with fracture may be (on all ranks)."""


class DamageListener(Protocol):
    """Interface of an object that depends on which edges are broken."""

    def edges_broke(self, count: int | None) -> None:
        """Note that `count` edges broke on all ranks; None: an unknown number (collective).

        0 after a restart or a repeated step: no edge is broken.
        """


class InelasticUpdate:
    """Plastic flow and fracture of a body, and all its history variables.

    Attributes:
        flow: plastic flow.
        fracture: finds and breaks edges.
    """

    def __init__(
        self,
        balance: Balance,
        flow: PlasticFlowProtocol,
        fracture: FractureProtocol,
        sizes: StepSizes,
        listener: DamageListener,
    ) -> None:
        """Connect the parts; `listener` is told of broken edges."""
        self._balance, self.flow, self.fracture = balance, flow, fracture
        self._sizes, self._listener, self._comm = sizes, listener, balance.domain.comm

    @property
    def max_passes(self) -> int:
        """Largest number of fracture passes in a step."""
        return self.fracture.max_passes or 10_000  # no body has edges for so many passes

    def nonfinite_cells(self) -> int:
        """Return the number of evaluations of cells whose stress was not finite, on all ranks (collective)."""
        return int(sum_over_ranks(self._balance.domain.comm, self.fracture.nonfinite_cells)[0])

    # --- history variables ---

    def snapshot(self) -> dict[str, object]:
        """Return the present history variables of fracture, plastic flow and terms."""
        return {
            "damage": self.fracture.snapshot(),
            "flow": self.flow.snapshot(),
            "terms": self._balance.histories.snapshot(),
        }

    def with_snapshot(self, state: State) -> State:
        """Return the state with the present history variables."""
        return replace(state, history=self.snapshot())

    def with_flow(self, state: State) -> State:
        """Return the state with the present plastic strain."""
        return replace(state, history=state.history | {"flow": self.flow.snapshot()})

    def restore(self, state: State) -> None:
        """Restore all history variables and the displacement of a state (collective)."""
        self.restore_damage(state)
        self.restore_flow_and_terms(state)
        self._balance.set_displacement(state.u)

    def restore_damage(self, state: State) -> None:
        """Restore the damage of a state (collective)."""
        if "damage" not in state.history:
            return
        changed = self.fracture.restore(state.history["damage"])
        # The damage of another rank may have changed alone.
        if self._comm.allreduce(changed, op=MPI.LOR):
            self._damage_restored()

    def restore_flow_and_terms(self, state: State) -> None:
        """Restore the history variables of plastic flow and terms of a state."""
        if "flow" in state.history:
            self.flow.restore(state.history["flow"])
        if terms := state.history.get("terms"):
            self._balance.histories.restore(terms)

    def from_checkpoint(self, state: State) -> State:
        """Return the state of a checkpoint with the history variables that the body read from it (collective)."""
        self.fracture.damage_restored()
        self._balance.set_displacement(state.u)
        self._damage_restored()
        self._balance.histories.from_checkpoint(state.history.get("saved", {}))
        return self.with_snapshot(state)

    # --- a step ---

    def begin_step(self, state: State, dt: float) -> None:
        """Begin or repeat a step of dt (s) from a state: history variables are those of the state (collective)."""
        self.restore_flow_and_terms(state)
        self._balance.begin_step(state.t + dt, dt, state.u, state.v, state.a)
        self.fracture.begin_step(state.t, dt)

    def fracture_pass(self, dt: float) -> PassResultProtocol:
        """Carry out a fracture pass of a step of dt (s) (collective).

        Raises:
            StepTooLong: edges broke, and the step is longer than a step with fracture may be.
        """
        result = self.fracture()
        if result.broken_edges and not self._sizes.allows_fracture(dt):
            raise StepTooLong
        return result

    # --- consequences of damage ---

    def damage_changed(self, result: PassResultProtocol) -> None:
        """Tell balance and listener of the damage of a pass (collective)."""
        if result.broken_edges:
            self._update_edges()
        if result.cells_died:
            # Forms are restricted to the cells that carry stress.
            self._balance.damage_changed()
        if result.broken_edges:
            self._listener.edges_broke(result.broken_edges)

    def tell_listener(self) -> None:
        """Tell the listener whether any edge is broken (collective)."""
        pattern = self.fracture.broken_edge_patterns
        comm = self._balance.domain.comm
        any_broken = pattern is not None and sum_over_ranks(comm, np.count_nonzero(pattern))[0] > 0
        self._listener.edges_broke(None if any_broken else 0)

    def _damage_restored(self) -> None:
        """Tell balance and listener that the damage is another one (collective)."""
        self._update_edges()
        self._balance.damage_changed()
        self.tell_listener()

    def _update_edges(self) -> None:
        """Give the broken edges to the balance and to the plastic flow (collective)."""
        if (pattern := self.fracture.broken_edge_patterns) is not None:
            self._balance.edges_broke(pattern)
            self.flow.edges_broke()
