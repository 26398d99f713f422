"""Time schemes by the names of `time.scheme`; their keys and `fracsim list` follow from these classes."""

from __future__ import annotations

from .backward_euler import BackwardEuler, QuasiStatic
from .newmark import CentralDifference, GeneralizedAlpha, Newmark
from .scheme import Rigid, Scheme

SCHEMES: dict[str, type[Scheme]] = {
    "backward-euler": BackwardEuler,
    "newmark": Newmark,
    "generalized-alpha": GeneralizedAlpha,
    "explicit": CentralDifference,
    "quasi-static": QuasiStatic,
    "rigid": Rigid,
}

__all__ = [
    "SCHEMES", "BackwardEuler", "CentralDifference", "GeneralizedAlpha", "Newmark", "QuasiStatic", "Rigid", "Scheme",
]  # fmt: skip
