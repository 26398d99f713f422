"""Critical distance: the stress ahead of a place at which a crack starts, and the elastic zone around crack tips.

Also the strain at which a cell releases the energy of its own cut.

Equations: docs/theory.md#critical-distance, docs/theory.md#tip-criterion, docs/theory.md#elastic-zone.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from ...mesh.domain import Domain
from ...mesh.edge_graph import EdgeGraph
from ...mesh.ghost_exchange import sum_at_nodes
from ...mesh.parallel import concatenate_over_ranks
from ...mesh.small_matrices import barycentric_gradients
from ..principal_stress import first_principal_stress, symmetric_tensors
from .tip_parameters import TIP

if TYPE_CHECKING:
    from ...mechanics.material_fields import PerCell
    from ...mechanics.plasticity import PlasticHistory
    from ...mechanics.stress import Stress
    from .tip_criterion import TipCriterion

Flags = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]
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
        least_radius: (cells,) 3 h, m.
        threshold: (cells,) mean stress at which a crack starts, Pa.
    """

    length: Values
    radius: Values
    least_radius: Values
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
    least_radius = TIP.min_start_radius * h
    radius = np.clip(c**2 / 2 * length, least_radius, TIP.max_start_radius[dim] * h)
    return CriticalDistance(
        length, radius, least_radius, np.minimum(strength, c * np.sqrt(energy / (2 * np.pi * radius)))
    )


def releases_cut_energy(body: Stress, toughness: PerCell, cells: Ints, stress: Values) -> Flags:
    """Return in which cells (n,) a cut releases G_c times its area from the strain of the cell alone.

    V sigma_1^2 / (2 (lambda + 2 mu)) >= G_c A, with the area A of the largest facet, which no plane cut exceeds. The
    force on a tip in a ligament narrower than its disc is that of several tips.

    Args:
        body: gives the material and the mesh.
        toughness: G_c, J/m^2, one number or (n,).
        cells: (n,) cells.
        stress: (cells, 3 or 6) Cauchy stress of all cells, Pa.
    """
    material, domain = body.material, body.domain
    mu, lmbda = (np.broadcast_to(values, domain.cell_count)[cells] for values in (material.mu, material.lmbda))
    gradients = barycentric_gradients(domain.nodes[domain.cell_nodes[cells]])
    # A = d V |grad N| of the corner opposite to the facet
    area_per_volume = domain.dim * np.linalg.norm(gradients, axis=2).max(axis=1, initial=0.0)
    sigma = np.maximum(first_principal_stress(symmetric_tensors(stress[cells], domain.dim)), 0.0)
    return np.asarray(sigma**2 / (2 * (lmbda + 2 * mu)) >= toughness * area_per_volume)


@dataclass(frozen=True)
class StartPlaces:
    """Places of cells at which cracks start: the corners in the body's surface, or all of a cell without such corners.

    Attributes:
        points: (cells, d) mean of these corners, m.
        weights: (cells, d + 1) 1 for these corners, else 0.
        notched: (cells,) whether the surface is concave at one of them, so that it concentrates the stress.
    """

    points: Values
    weights: Values
    notched: Flags


def find_start_places(domain: Domain) -> StartPlaces:
    """Return the places of all cells at which cracks may start (collective).

    With the areas A, normals n and centroids c of the facets around a node x, and N along sum A n, the surface is
    concave at x where sum A (c - x) . N exceeds `TIP.notch_sine` times sum A |c - x|.
    """
    d, nodes, X = domain.dim, domain.cell_nodes, domain.nodes
    cell, opposite = np.nonzero(domain.facets.boundary_sides)
    # The outward area of the side opposite to a corner is - d V grad N.
    gradients = barycentric_gradients(X[nodes[cell]])[np.arange(len(cell)), opposite]
    normal = -d * domain.volumes[cell, None] * gradients
    facet = nodes[cell][np.arange(d + 1) != opposite[:, None]].reshape(-1, d)
    apart = X[facet].mean(axis=1)[:, None] - X[facet]
    area = np.linalg.norm(normal, axis=1)[:, None, None]
    rows = [
        np.broadcast_to(normal[:, None], apart.shape),
        area * apart,
        area * np.linalg.norm(apart, axis=2)[..., None],
    ]
    at_node = sum_at_nodes(domain, facet.reshape(-1), np.concatenate(rows, axis=2).reshape(-1, 2 * d + 1))
    normal, apart, size = at_node[:, :d], at_node[:, d : 2 * d], at_node[:, -1]
    notched = np.einsum("ni,ni->n", apart, normal) > TIP.notch_sine * size * np.linalg.norm(normal, axis=1)
    weights = (size > 0)[nodes].astype(float)
    weights[~weights.any(axis=1)] = 1.0
    points = np.einsum("nk,nki->ni", weights, X[nodes]) / weights.sum(axis=1)[:, None]
    return StartPlaces(points, weights, notched[nodes].any(axis=1))


def average_at_nodes(domain: Domain, values: Values, cells: Ints, weights: Values) -> Values:
    """Return the weighted mean (n, k) over the corners of cells (n,) of the mean of all cells at each corner.

    Collective.

    Args:
        domain: gives nodes and volumes.
        values: (cells, k) of all cells; those at a corner are weighted by their volumes.
        cells: (n,) cells.
        weights: (n, d + 1) of their corners.
    """
    nodes, volumes = domain.cell_nodes, domain.volumes[:, None]
    at_node = sum_at_nodes(domain, nodes, np.concatenate([values * volumes, volumes], axis=1))
    at_corners = at_node[nodes[cells]]
    mean = at_corners[..., :-1] / at_corners[..., -1:]
    return np.asarray(np.einsum("nc,nck->nk", weights, mean) / weights.sum(axis=1)[:, None])


class ElasticZone:
    """Cells that do not flow: those around crack tips, and those that cracks have cut.

    The zone of a tip has the radius D = max(L / 2, R), L = E' G_c / (pi f_t^2) the critical distance and R the radius
    of the disc over which the force on the tip is summed. At D ahead of a tip with G = G_c the elastic stress is f_t.
    The force on a tip is that of an elastic body, and the plastic work around the zone is the body's.
    Source: Suo, Shih and Varias (1993).
    """

    def __init__(self, tips: TipCriterion, graph: EdgeGraph, plastic: PlasticHistory) -> None:
        """Build the zone of the present tips (collective)."""
        self._tips, self._graph, self._plastic = tips, graph, plastic
        self._centres = cKDTree(tips.field_evaluator.centres)
        self.update()

    def update(self) -> None:
        """Move the zone to the present tips (collective)."""
        tips, dim = self._tips.find_tips(), self._graph.domain.dim
        radius = self._tips.elastic_radius[tips.cell]
        rows = concatenate_over_ranks(self._graph.domain.comm, np.column_stack([tips.point, radius]))
        elastic = self._graph.split.copy()
        for cells in self._centres.query_ball_point(rows[:, :dim], rows[:, dim]):
            elastic[cells] = True
        self._plastic.set_elastic(elastic)
