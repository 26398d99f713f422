"""Critical distance: the stress ahead of a place at which a crack starts (docs/theory.md#critical-distance)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from dolfinx import la

from ...mesh.domain import Domain
from .tip_parameters import TIP

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class CriticalDistance:
    """Length and threshold of the mean stress ahead of a place, in each cell.

    With L = E' G_c / (pi f_t^2) a crack starts where the mean over a half disc of radius R = max(c^2 L / 2, 3 h)
    reaches min(f_t, c sqrt(E' G_c / (2 pi R))). c is the mean around a crack tip in units of K / sqrt(2 pi R). R is at
    most 60 h in 2D and 8 h in 3D.

    Attributes:
        length: (cells,) L, m.
        radius: (cells,) R, m.
        threshold: (cells,) mean stress at which a crack starts, Pa.
    """

    length: Values
    radius: Values
    threshold: Values


def critical_distance(dim: int, modulus: Values, toughness: Values, strength: Values, h: Values) -> CriticalDistance:
    """Return the critical distance of cells.

    Args:
        dim: dimension of the body, 2 or 3.
        modulus: (cells,) E' of plane strain or plane stress, Pa.
        toughness: (cells,) G_c, J/m^2.
        strength: (cells,) f_t, Pa.
        h: (cells,) mesh size, m.
    """
    c, energy = TIP.near_field_mean[dim], modulus * toughness
    length = energy / (np.pi * strength**2)
    radius = np.clip(c**2 / 2 * length, TIP.min_start_radius * h, TIP.max_start_radius[dim] * h)
    return CriticalDistance(length, radius, np.minimum(strength, c * np.sqrt(energy / (2 * np.pi * radius))))


def start_points(domain: Domain) -> Values:
    """Return the points (cells, d), m, from which a crack in a cell starts (collective).

    They are the mean of the corners in the body's surface, or the centroid of a cell without such corners.
    """
    on_surface = la.vector(domain.space.dofmap.index_map, 1, np.float64)
    nodes, outside = domain.cell_nodes, domain.facets.boundary_sides
    for opposite, flags in enumerate(outside.T):
        on_surface.array[np.delete(nodes, opposite, axis=1)[flags]] = 1.0
    # A node of this rank may be in the surface by a facet of another rank.
    on_surface.scatter_reverse(la.InsertMode.add)
    on_surface.scatter_forward()
    weight = (on_surface.array[nodes] > 0).astype(float)
    weight[~weight.any(axis=1)] = 1.0
    return np.asarray(np.einsum("nk,nki->ni", weight, domain.nodes[nodes]) / weight.sum(axis=1)[:, None])
