"""Round faces of a body: where the middles of their edges belong, when cells have nodes there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .data import MeshData, Points
from .topology import edges_of


@dataclass(frozen=True)
class CurvedBoundary:
    """Facets on a circle around the origin or on a cylinder around an axis through it.

    Attributes:
        groups: of the facets.    radius: m.    along: the axis, 0 to 2; None: in the plane.
    """

    groups: tuple[str, ...]
    radius: float
    along: int | None = None


def curved_midside_points(mesh: MeshData, rounds: tuple[CurvedBoundary, ...]) -> Points:
    """(k, d) middles of `edges_of` the cells, m: those of round facets moved out to their radius."""
    edges = edges_of(mesh.cells)
    middles = mesh.points[edges].mean(axis=1)
    keys, count = edges[:, 0] * len(mesh.points) + edges[:, 1], len(mesh.points)
    for item in rounds:
        facets = np.concatenate([mesh.facet_groups[name] for name in item.groups])
        of_facets = edges_of(facets)
        result = np.searchsorted(keys, of_facets[:, 0] * count + of_facets[:, 1])
        across = np.arange(mesh.dim) != (mesh.dim if item.along is None else item.along)
        out = middles[result] * across
        middles[result] += out * (item.radius / np.linalg.norm(out, axis=1, keepdims=True) - 1)
    return middles
