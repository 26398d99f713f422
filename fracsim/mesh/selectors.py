"""Selectors of nodes and facets: a named group, a box or a plane. DOLFINx is not imported here."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..errors import InputError

Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
# Round-off of coordinates, relative to the size of the body.
RELATIVE_TOLERANCE = 1e-9


@dataclass(frozen=True)
class Group:
    """The nodes of a named group of facets."""

    name: str

    def __str__(self) -> str:
        return f'group "{self.name}"'


@dataclass(frozen=True)
class PointsInBox:
    """The closed box between two corners (d numbers each, m)."""

    lower: tuple[float, ...]
    upper: tuple[float, ...]

    def __str__(self) -> str:
        return f"box {list(self.lower)} to {list(self.upper)}"

    def selects(self, points: Values, size: float) -> Flags:
        """(n,) whether the points (n, d), m, lie in the box; `size` of the body, m."""
        slack = RELATIVE_TOLERANCE * size
        return np.all((points >= np.array(self.lower) - slack) & (points <= np.array(self.upper) + slack), axis=1)

    def intersects_box(self, lower: Values, upper: Values) -> bool:
        """Whether the box intersects a bounding box, m."""
        slack = RELATIVE_TOLERANCE * float(np.linalg.norm(upper - lower))
        return bool(np.all(self.lower <= upper + slack) and np.all(self.upper >= lower - slack))


@dataclass(frozen=True)
class PointsOnPlane:
    """A plane through a point (m), with all points closer than `within` (m; default: 1e-6 of the size of the body).

    Raises InputError if the normal is zero.
    """

    point: tuple[float, ...]
    normal: tuple[float, ...]
    within: float | None = None

    def __post_init__(self) -> None:
        # components below 1e-154 underflow in the norm
        if not np.linalg.norm(self.normal) > 0:
            raise InputError(f"normal = {list(self.normal)}: a normal must not be zero")

    def __str__(self) -> str:
        return f"plane through {list(self.point)} with normal {list(self.normal)}"

    def selects(self, points: Values, size: float) -> Flags:
        """(n,) whether the points (n, d), m, lie on the plane; `size` of the body, m."""
        normal = np.array(self.normal)
        distance = np.abs((points - np.array(self.point)) @ normal) / np.linalg.norm(normal)
        return np.asarray(distance <= (self.within or 1e-6 * size))

    def intersects_box(self, lower: Values, upper: Values) -> bool:
        """Whether the plane passes through a bounding box, whose corners may be infinite."""
        normal = np.array(self.normal)
        ends = np.sort(normal * (np.array([lower, upper]) - np.array(self.point)), axis=0)
        slack = (self.within or 0.0) * np.linalg.norm(normal) + RELATIVE_TOLERANCE * np.abs(
            ends[np.isfinite(ends)]
        ).sum()
        return bool(ends[0].sum() <= slack and ends[1].sum() >= -slack)


type Selector = Group | PointsInBox | PointsOnPlane


def check_group(name: str, groups: Iterable[str], key: str) -> None:
    """Raise InputError if the mesh has no facet group of that name; `key` of the study that names the group."""
    names = sorted(groups)
    if name not in names:
        raise InputError(f'{key} = "{name}": the mesh has no such facet group; it has: {", ".join(names) or "none"}')


def check_regions(names: Iterable[str], known: Sequence[str]) -> None:
    """Raise InputError if the mesh lacks a region that a [material.NAME] names."""
    for name in names:
        if name not in known:
            regions = ", ".join(known) or "none"
            raise InputError(f"material.{name}: the mesh has no region of that name; it has: {regions}")
