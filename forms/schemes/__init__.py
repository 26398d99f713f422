"""Time schemes by the name that studies call them by: `time.scheme`, its keys and `fracsim list` follow from here."""

from __future__ import annotations

from .backward_euler import BackwardEuler
from .central_difference import CentralDifference
from .generalized_alpha import GeneralizedAlpha
from .newmark import Newmark
from .quasi_static import QuasiStatic
from .rigid import Rigid
from .scheme import Scheme

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
