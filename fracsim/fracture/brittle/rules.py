"""What decides where brittle surfaces start and run: plain numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class GrainRules:
    """Grain boundaries: regions of `count` seeded points p_i by least k_i |x - p_i|.

    Attributes:
        seed: of the points.    spread: k_i are drawn from 1 - spread to 1 + spread; 0: all grains alike.
        mode: "replace": a surface frees a grain; "bias": it runs along the boundaries nearest to it.
    """

    count: int
    seed: int = 0
    spread: float = 0.0
    mode: Literal["replace", "bias"] = "replace"


@dataclass(frozen=True)
class SurfaceRules:
    """Surfaces in place of single edges.

    Attributes:
        surfaces: most of the run.    per_pass: most that start in one pass; None: no limit.
        spacing: m between places where surfaces start; None: about two mesh edges.
        curved: whether surfaces turn with the principal direction; else they are planes.
        seed: of the direction where several principal stresses are equal.
    """

    surfaces: int
    spacing: float | None = None
    curved: bool = False
    seed: int = 0
    per_pass: int | None = None
    grains: GrainRules | None = None
