"""How contact with obstacles acts."""

from __future__ import annotations

from dataclasses import dataclass

from .barrier import Barrier


@dataclass(frozen=True)
class Law:
    """The barrier, and the speed of slip, m/s, below which friction passes for sticking."""

    barrier: Barrier
    creep: float
