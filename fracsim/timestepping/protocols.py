"""What happens to a body at the end of a step: it flows, then it breaks. Where a study has neither, empty parts do."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

from ..mechanics.balance import Balance
from .state import Remembers

Values = npt.NDArray[np.float64]


class PassResult(Protocol):
    """What one pass did.

    Attributes:
        broken: edges that broke, on all ranks.    loss: most that chi of a cell of this rank lost.
        released: elastic energy that went with them on this rank, J.    elastic: what is left of it, J.
        died: whether cells of this rank lost the last of their stress.
        before: copies of the fields of damage before the pass, where edges broke.
    """

    @property
    def broken(self) -> int: ...
    @property
    def loss(self) -> float: ...
    @property
    def released(self) -> float: ...
    @property
    def elastic(self) -> float: ...
    @property
    def died(self) -> bool: ...
    @property
    def before(self) -> list[Values]: ...


class Breaking(Remembers, Protocol):
    """What breaks."""

    passes: int | None  # most passes in a step; None: until nothing changes
    phase: str  # what its seconds are counted under

    @property
    def not_finite(self) -> int:
        """Cells whose stress was no number when it was looked at, summed over the passes of this rank."""

    @property
    def pattern(self) -> npt.NDArray[np.uint8] | None:
        """(cells,) broken edges of each cell (mesh.edge_graph); None where nothing can break."""

    def begin(self, t: float, dt: float) -> None:
        """A step of dt (s) from t on is solved, for the first time or once more: its passes are of that time."""

    def moving(self, v: Values, a: Values) -> None:
        """The body that the next pass looks at moves so: (owned dofs,) in m/s and m/s^2."""

    def __call__(self) -> PassResult:
        """A pass on the current displacement (collective)."""

    def restored(self) -> None:
        """Damage was read from a checkpoint: what follows from it is brought to it."""


class Flow(Remembers, Protocol):
    """What flows.

    Attributes:
        stored: elastic energy after the last flow, without damage, this rank's share, J; None where there is no flow.
    """

    stored: float | None

    def begin(self, dt: float) -> None:
        """The flow to come is that of a step of dt (s)."""

    def __call__(self) -> float:
        """Let the body flow; returns the energy lost to it on this rank, J."""


class NoFlow:
    """A body that does not flow."""

    stored: float | None = None

    def begin(self, dt: float) -> None:
        """Nothing."""

    def __call__(self) -> float:
        """Nothing is lost."""
        return 0.0

    def memory(self) -> object:
        """None."""
        return None

    def recall(self, memory: object) -> bool:
        """Nothing."""
        return False


@dataclass(frozen=True)
class _Whole:
    """The result of a pass over a body that does not break."""

    elastic: float
    broken: int = 0
    loss: float = 0.0
    released: float = 0.0
    died: bool = False
    before: list[Values] = field(default_factory=list)


class Unbreakable:
    """A body that does not break."""

    passes: int | None = 1
    not_finite = 0
    phase = "energies"
    pattern = None

    def __init__(self, balance: Balance, flow: Flow | None = None) -> None:
        self._balance, self._flow = balance, flow or NoFlow()

    def begin(self, t: float, dt: float) -> None:
        """Nothing."""

    def moving(self, v: Values, a: Values) -> None:
        """Nothing."""

    def __call__(self) -> PassResult:
        """The elastic energy is all there is to tell."""
        stored = self._flow.stored
        return _Whole(self._balance.stress.stored_energy() if stored is None else stored)

    def memory(self) -> object:
        """None."""
        return None

    def recall(self, memory: object) -> bool:
        """Nothing."""
        return False

    def restored(self) -> None:
        """Nothing."""
