"""Plastic flow and fracture at the end of a step, and the history variables of the body."""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np

from ..mechanics.balance import Balance
from ..mesh.parallel import sum_over_ranks
from .protocols import FractureProtocol, PassResultProtocol, PlasticFlowProtocol
from .state import State
from .step_sizes import StepSizes


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
        self._sizes, self._listener = sizes, listener

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

    def restore(self, state: State) -> None:
        """Restore all history variables and the displacement of a state (collective)."""
        self.restore_damage(state)
        self.restore_flow_and_terms(state)
        self._balance.set_displacement(state.u)

    def restore_damage(self, state: State) -> None:
        """Restore the damage of a state (collective)."""
        if "damage" in state.history and self.fracture.restore(state.history["damage"]):
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
        """Give the broken edges to the balance."""
        if (pattern := self.fracture.broken_edge_patterns) is not None:
            self._balance.edges_broke(pattern)
