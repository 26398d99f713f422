"""Checks of builder parameters that every builder shares; each failure is one sentence."""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

from .data import MeshData, MeshError

# A tetrahedral mesh of this size needs some 50 GB before anything is solved: surely a slip of units.
MAX_CELLS = 200_000_000
SHORTEST, LONGEST = 1e-30, 1e30  # m


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
        if not (is_length(value) and value > 0):
            raise MeshError(f"{builder}: {name} = {value!r} must be a positive number (metres), at most {LONGEST:g}.")
        if value < SHORTEST:
            raise MeshError(f"{builder}: {name} = {value!r} m is out of reach; take {SHORTEST:g} m or more.")


def require_not_negative(builder: str, **values: float) -> None:
    """Raise MeshError unless every value is a finite number of zero or more."""
    for name, value in values.items():
        if not (is_length(value) and value >= 0):
            raise MeshError(f"{builder}: {name} = {value!r} must be zero or a positive number (metres).")


def require_one_of(builder: str, name: str, value: str, allowed: tuple[str, ...]) -> None:
    """Raise MeshError unless the value is one of the allowed words."""
    if value not in allowed:
        raise MeshError(f"{builder}: {name} = {value!r} is not one of {', '.join(allowed)}.")


def require(condition: bool, message: str) -> None:
    """Raise MeshError with the message unless the condition holds."""
    if not condition:
        raise MeshError(message)


def require_affordable(builder: str, h: float, cells: float, hint: str = "Lengths are in metres.") -> None:
    """Raise MeshError where the mesh would be too large to hold; `hint` ends the message."""
    if cells > MAX_CELLS:
        raise MeshError(
            f"{builder}: h = {h!r} m would make about {cells:.1e} cells, more than {MAX_CELLS:.0e}; take a larger h. "
            f"{hint}"
        )


def check_extent(points: npt.NDArray[np.float64], what: str) -> None:
    """Raise MeshError where coordinates (n, d) are no numbers, or a body is out of reach of squares and cubes."""
    wrong = np.flatnonzero(~(np.abs(points) <= LONGEST).all(axis=1))
    if len(wrong):
        raise MeshError(
            f"{what} has {len(wrong)} points whose coordinates are not finite numbers of at most {LONGEST:g} m, the "
            f"first is point {wrong[0]} at {points[wrong[0]].tolist()}; export it again, or mend its scale."
        )
    if len(points) and (size := float(np.ptp(points, axis=0).max())) < SHORTEST:
        raise MeshError(f"{what} is {size:g} m large, and {SHORTEST:g} m or more is needed; mend its scale.")


def is_length(value: object) -> bool:
    """Whether it is one that lengths may have: finite, and far from where squares and cubes overflow."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= LONGEST
