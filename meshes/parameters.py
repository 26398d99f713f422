"""The interface of builders, checks of their parameters, their curved boundaries and their round solids."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
import numpy.typing as npt

from .data import MeshData, MeshError, Points
from .topology import edges_of

MAX_CELLS = 200_000_000  # tetrahedra need some 50 GB before anything is solved: more is a wrong unit of length
SHORTEST, LONGEST = 1e-30, 1e30  # [m]: squares and cubes of lengths in between neither under- nor overflow


class Builder(Protocol):
    """A body with parameters that can be meshed; every class of BUILDERS is one.

    A builder may have `is_conforming`, true where cells are positive and share whole facets by construction: then only
    coordinates and measures are checked.
    """

    @property
    def name(self) -> str:
        """Name of the builder in studies."""

    @property
    def groups(self) -> tuple[str, ...]:
        """Names of the facet groups, known without building."""

    @property
    def regions(self) -> tuple[str, ...]:
        """Names of the cell regions, known without building; empty: one material."""

    def bounds(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Lower and upper corner of the body's bounding box [m], known without building."""

    def cells_estimate(self) -> int:
        """Approximate number of cells that build() makes, within a factor of 1.5."""

    def build(self) -> MeshData:
        """The mesh. Called on one process only."""


def require_positive(builder: str, **values: float) -> None:
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
    """Raise MeshError unless the value is one of the allowed strings."""
    if value not in allowed:
        raise MeshError(f"{builder}: {name} = {value!r} is not one of {', '.join(allowed)}.")


def require(condition: bool, message: str) -> None:
    """Raise MeshError with the message unless the condition holds."""
    if not condition:
        raise MeshError(message)


def require_affordable(builder: str, h: float, cells: float, hint: str = "Lengths are in metres.") -> None:
    """Raise MeshError if the mesh would have more than MAX_CELLS cells; `hint` ends the message."""
    if cells > MAX_CELLS:
        raise MeshError(
            f"{builder}: h = {h!r} m would make about {cells:.1e} cells, more than {MAX_CELLS:.0e}; take a larger h. "
            f"{hint}"
        )


def check_extent(points: npt.NDArray[np.float64], source: str, used: npt.NDArray[np.bool_] | None = None) -> None:
    """Raise MeshError if coordinates are no numbers or too large, or the size of a body is too small.

    Args:
        points: (n, d) [m].
        source: begins the message.
        used: (n,) points that belong to the body; None: all.
    """
    body = points if used is None or used.all() else points[used]
    if not np.abs(body).max(initial=0.0) <= LONGEST:
        wrong = ~(np.abs(points) <= LONGEST).all(axis=1)
        numbers = np.flatnonzero(wrong if used is None else used & wrong)
        raise MeshError(
            f"{source} has {len(numbers)} points that are not finite numbers of at most {LONGEST:g} m, the first is "
            f"point {numbers[0]} at {points[numbers[0]].tolist()}; export it again, or mend its scale."
        )
    if len(body) and (size := float(np.ptp(body, axis=0).max())) < SHORTEST:
        raise MeshError(f"{source} is {size:g} m large, and {SHORTEST:g} m or more is needed; mend its scale.")


def is_length(value: object) -> bool:
    """Whether a value is a number that a length may have: finite, and far from overflow of its square and cube."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) <= LONGEST


# --- round solids ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RoundSolid:
    """Sphere, capsule or cylinder that the mesh of a builder approximates, with its boundary nodes on it.

    Attributes:
        kind: of the solid.
        centre: of the solid [m].
        radius: [m].
        length: of a cylinder, or between the centres of the ends of a capsule [m].
        along: axis of a capsule or cylinder, 0 to 2.
    """

    kind: Literal["sphere", "capsule", "cylinder"]
    centre: tuple[float, float, float]
    radius: float
    length: float = 0.0
    along: int = 2


# --- curved boundaries ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class CurvedBoundary:
    """Facets on a circle around the origin, or on a cylinder around an axis through it.

    Attributes:
        groups: names of the facet groups that lie on it.
        radius: [m].
        along: axis of the cylinder, 0 to 2; None: a circle in the plane.
    """

    groups: tuple[str, ...]
    radius: float
    along: int | None = None


def curved_midside_points(mesh: MeshData, boundaries: tuple[CurvedBoundary, ...]) -> Points:
    """(k, d) midside points [m] of the k edges of the mesh (see `edges_of`), those of curved facets at their radius."""
    edges = edges_of(mesh.cells)
    middles = mesh.points[edges].mean(axis=1)
    keys, count = edges[:, 0] * len(mesh.points) + edges[:, 1], len(mesh.points)
    for boundary in boundaries:
        of_facets = edges_of(np.concatenate([mesh.facet_groups[name] for name in boundary.groups]))
        chosen = np.searchsorted(keys, of_facets[:, 0] * count + of_facets[:, 1])
        across = np.arange(mesh.dim) != (mesh.dim if boundary.along is None else boundary.along)
        radial = middles[chosen] * across
        middles[chosen] += radial * (boundary.radius / np.linalg.norm(radial, axis=1, keepdims=True) - 1)
    return middles
