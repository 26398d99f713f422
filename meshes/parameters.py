"""Checks of builder parameters that every builder shares; each failure is one sentence."""

from __future__ import annotations

from math import isfinite
from typing import Protocol

from .data import MeshData, MeshError

# A tetrahedral mesh of this size needs some 50 GB before anything is solved: surely a slip of units.
MOST_CELLS = 200_000_000


class Builder(Protocol):
    """What every builder in BUILDERS offers; `name` is how studies call it."""

    @property
    def name(self) -> str: ...

    @property
    def groups(self) -> tuple[str, ...]:
        """Names of the facet groups, known without building."""

    @property
    def regions(self) -> tuple[str, ...]:
        """Names of the cell regions, known without building; empty: one material."""

    def bounds(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Lower and upper corner of the body's bounding box [m], known without building."""

    def cells_estimate(self) -> int:
        """About how many cells build() will make (a factor of 1.5 either way)."""

    def build(self) -> MeshData:
        """The mesh. Called on one process only."""


def positive(builder: str, **values: float) -> None:
    """Raise MeshError unless every value is a positive finite number."""
    for name, value in values.items():
        if not (is_number(value) and value > 0):
            raise MeshError(f"{builder}: {name} = {value!r} must be a positive number (metres).")


def not_negative(builder: str, **values: float) -> None:
    """Raise MeshError unless every value is a finite number of zero or more."""
    for name, value in values.items():
        if not (is_number(value) and value >= 0):
            raise MeshError(f"{builder}: {name} = {value!r} must be zero or a positive number (metres).")


def one_of(builder: str, name: str, value: str, allowed: tuple[str, ...]) -> None:
    """Raise MeshError unless the value is one of the allowed words."""
    if value not in allowed:
        raise MeshError(f"{builder}: {name} = {value!r} is not one of {', '.join(allowed)}.")


def require(condition: bool, message: str) -> None:
    """Raise MeshError with the message unless the condition holds."""
    if not condition:
        raise MeshError(message)


def affordable(builder: str, h: float, cells: float, hint: str = "Lengths are in metres.") -> None:
    """Raise MeshError where the mesh would be too large to hold; `hint` ends the message."""
    if cells > MOST_CELLS:
        raise MeshError(
            f"{builder}: h = {h!r} m would make about {cells:.1e} cells, more than {MOST_CELLS:.0e}; take a larger h. "
            f"{hint}"
        )


def is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and isfinite(value)
