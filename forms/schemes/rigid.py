"""Rigid bodies: no displacement to step. Named here for studies and lists; fracsim.rigid moves them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from .scheme import Array, AtTheEnd


@dataclass(frozen=True)
class Rigid(AtTheEnd):
    """Stiff bodies that move rigidly and are strained by blows alone (Bao et al. 2007)."""

    summary: ClassVar[str] = "stiff bodies move rigidly, blows strain and break them; needs [brittle] to break"
    inertia: ClassVar[bool] = True

    def rates(self, dt: float) -> tuple[float, float]:
        """Nothing is solved for in time."""
        raise NotImplementedError("rigid bodies have no displacement to step")

    def references(self, dt: float, u: Array, v: Array, a: Array) -> tuple[Array, Array]:
        """Nothing is solved for in time."""
        raise NotImplementedError("rigid bodies have no displacement to step")
