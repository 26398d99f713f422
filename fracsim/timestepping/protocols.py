"""What happens to a body at the end of a step: it flows, then it breaks. Where a study has neither, empty parts do."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

from ..mechanics.balance import Balance
from .state import HistoryVariables

Values = npt.NDArray[np.float64]


class PassResultProtocol(Protocol):
    """What one pass did.

    Attributes:
        broken: edges that broke, on all ranks.    loss: most that chi of a cell of this rank lost.
        released: elastic energy that went with them on this rank, J.    elastic: what is left of it, J.
        died: whether cells of this rank lost the last of their stress.
        before: copies of the fields of damage before the pass, where edges broke.
    """

    @property
    def broken_edges(self) -> int: ...
    @property
    def largest_chi_loss(self) -> float: ...
    @property
    def released_energy(self) -> float: ...
    @property
    def elastic_energy(self) -> float: ...
    @property
    def cells_died(self) -> bool: ...
    @property
    def previous_damage(self) -> list[Values]: ...


class FractureProtocol(HistoryVariables, Protocol):
    """What breaks."""

    max_passes: int | None  # most passes in a step; None: until nothing changes
    phase: str  # what its seconds are counted under

    @property
    def nonfinite_cells(self) -> int:
        """Cells whose stress was no number when it was looked at, summed over the passes of this rank."""

    @property
    def broken_edge_patterns(self) -> npt.NDArray[np.uint8] | None:
        """(cells,) broken edges of each cell (mesh.edge_graph); None where nothing can break."""

    def begin_step(self, t: float, dt: float) -> None:
        """A step of dt (s) from t on is solved, for the first time or once more: its passes are of that time."""

    def set_rates(self, v: Values, a: Values) -> None:
        """The body that the next pass looks at moves so: (owned dofs,) in m/s and m/s^2."""

    def __call__(self) -> PassResultProtocol:
        """A pass on the current displacement (collective)."""

    def damage_restored(self) -> None:
        """Damage was read from a checkpoint: what follows from it is brought to it."""


class PlasticFlowProtocol(HistoryVariables, Protocol):
    """What flows.

    Attributes:
        stored: elastic energy after the last flow, without damage, this rank's share, J; None where there is no flow.
    """

    elastic_energy: float | None

    def begin_step(self, dt: float) -> None:
        """The flow to come is that of a step of dt (s)."""

    def __call__(self) -> float:
        """Let the body flow; returns the energy lost to it on this rank, J."""


class NoPlasticFlow:
    """A body that does not flow."""

    elastic_energy: float | None = None

    def begin_step(self, dt: float) -> None:
        """Nothing."""

    def __call__(self) -> float:
        """Nothing is lost."""
        return 0.0

    def snapshot(self) -> object:
        """None."""
        return None

    def restore(self, saved: object) -> bool:
        """Nothing."""
        return False


@dataclass(frozen=True)
class _Whole:
    """The result of a pass over a body that does not break."""

    elastic_energy: float
    broken_edges: int = 0
    largest_chi_loss: float = 0.0
    released_energy: float = 0.0
    cells_died: bool = False
    previous_damage: list[Values] = field(default_factory=list)


class NoFracture:
    """A body that does not break."""

    max_passes: int | None = 1
    nonfinite_cells = 0
    phase = "energies"
    broken_edge_patterns = None

    def __init__(self, balance: Balance, flow: PlasticFlowProtocol | None = None) -> None:
        self._balance, self._flow = balance, flow or NoPlasticFlow()

    def begin_step(self, t: float, dt: float) -> None:
        """Nothing."""

    def set_rates(self, v: Values, a: Values) -> None:
        """Nothing."""

    def __call__(self) -> PassResultProtocol:
        """The elastic energy is all there is to tell."""
        stored = self._flow.elastic_energy
        return _Whole(self._balance.stress.stored_energy() if stored is None else stored)

    def snapshot(self) -> object:
        """None."""
        return None

    def restore(self, saved: object) -> bool:
        """Nothing."""
        return False

    def damage_restored(self) -> None:
        """Nothing."""
