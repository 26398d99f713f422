"""Interfaces of plastic flow and of fracture at the end of a step, and implementations of a body without them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

from ..mechanics.balance import Balance
from .state import HistoryVariables

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
        """Copies of the damage fields before the pass, if edges broke."""


class FractureProtocol(HistoryVariables, Protocol):
    """Interface of the fracture of a body.

    Attributes:
        max_passes: largest number of passes in a step; None: until nothing changes.
        phase: name of the phase to which the time of a pass counts.
    """

    max_passes: int | None
    phase: str

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
    """

    elastic_energy: float | None

    def begin_step(self, dt: float) -> None:
        """Prepare the flow of a step of dt (s)."""

    def __call__(self) -> float:
        """Let the body flow at the present displacement; return the dissipated energy on this rank, J."""


class NoPlasticFlow:
    """Plastic flow of an elastic body."""

    elastic_energy: float | None = None

    def begin_step(self, dt: float) -> None:
        """Do nothing."""

    def __call__(self) -> float:
        """Return 0: nothing is dissipated."""
        return 0.0

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
