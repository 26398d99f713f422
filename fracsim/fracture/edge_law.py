"""What is left of an edge under a load: its integrity, from 1 (whole) to 0 (broken)."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[np.float64]


class EdgeLaw(Protocol):
    """A law of an edge."""

    all_or_nothing: bool  # integrity is 1 or 0: ranks need not agree on the numbers between

    def __call__(self, load: Values) -> Values:
        """(n,) integrity under the load (n,), stress over strength. An edge keeps the least that it ever had."""


class Brittle:
    """1 below the strength, 0 from there on."""

    all_or_nothing = True

    def __call__(self, load: Values) -> Values:
        """(n,) integrity, 0 or 1, under loads (n,) in units of the strength."""
        return np.where(load >= 1, 0.0, 1.0)
