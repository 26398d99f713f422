"""Circular and cylindrical boundaries of a body, on which midside nodes of quadratic cells belong."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .data import MeshData, Points
from .topology import edges_of


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
