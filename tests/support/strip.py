"""A clamped strip that stores some share of its fracture energy a metre, whose crack is held and then let go."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

from fracsim.scene import build_scene
from fracsim.studies.evidence.precision.torn_strip import StripCrack, crack_of_strip, strip_study

from .scenes import make_study


def run_of_a_strip(ratio: float, scheme: str, kind: str, n: int, order: int = 1, **fracture: Any) -> StripCrack:
    """How far the crack of a strip that stores `ratio` G_c a metre runs, and how fast."""
    study = make_study(**strip_study(ratio, scheme, kind, n, order, **fracture))
    return crack_of_strip(build_scene(MPI.COMM_SELF, study))
