"""Strength of an edge in a cell: by region, with a hashed tie-break, Weibull scatter and a fibre direction.

    s_e = strength(cell) (1 + tie_break h_e) w_e f_e

- h_e in [-1, 1) is hashed from the reference mid-point of the edge, rounded to about 1e-9 of the body's size.
- w_e = (-ln(1 - U))^(1/m) / Gamma(1 + 1/m) is a Weibull number of mean 1, drawn from the mid-point and a seed.
- f_e = 1 + (ratio - 1) (n . a)^2, with the reference direction n of the edge and the fibre a.

All depend on the position of the edge, so that they are the same in any partition of the mesh.
Equations: docs/theory.md#edge-criterion.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..mechanics.material_fields import PerCell
from ..mesh.edge_graph import EdgeGraph

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class WeibullScatter:
    """Scatter of the strength.

    Attributes:
        modulus: Weibull modulus m: 5 for stone, 50 for nearly uniform strength.
        seed: seed of the draw.
    """

    modulus: float
    seed: int = 0


@dataclass(frozen=True)
class FibreAnisotropy:
    """Dependence of the strength on the direction of the edge.

    Attributes:
        direction: (d,) fibre direction, of any length.
        ratio: strength along the fibre over that across it.
    """

    direction: Sequence[float] | Values
    ratio: float = 1.0


class EdgeStrength:
    """Strength (Pa) of the edges of cells of a distributed mesh.

    Attributes:
        minimum: lower bound of the strength of all edges of the body, Pa.
    """

    def __init__(
        self,
        graph: EdgeGraph,
        cell_strength: PerCell,
        *,
        tie_break: float = 0.0,
        scatter: WeibullScatter | None = None,
        fibre: FibreAnisotropy | None = None,
    ) -> None:
        """Compute the factors of edges (collective).

        Args:
            graph: edges of the body.
            cell_strength: strength of the material, Pa, one number or (cells,).
            tie_break: relative amplitude of the hashed perturbation.
            scatter: Weibull scatter.
            fibre: fibre direction.
        """
        self._graph, self._cell_strength, self._tie_break = graph, cell_strength, tie_break
        self._factors = self._edge_factors(scatter, fibre)
        smallest = float(np.min(self._factors, initial=np.inf)) if self._factors is not None else 1.0
        minimum = float(np.min(self._cell_strength, initial=np.inf)) * smallest * (1 - tie_break)
        self.minimum = graph.domain.comm.allreduce(minimum, op=MPI.MIN)

    def __call__(self, cells: npt.NDArray[np.int64], edges: npt.NDArray[np.int32]) -> Values:
        """Return the strengths (n, k), Pa, of the local edges (n, k) of cells (n,)."""
        base = self._cell_strength[cells, None] if isinstance(self._cell_strength, np.ndarray) else self._cell_strength
        factor = 1.0 if self._factors is None else self._factors[edges]
        return np.asarray(base * factor * (1 + self._tie_break * self.tie_break_noise(edges)))

    def minimum_in(self, cells: npt.NDArray[np.int64]) -> Values | float:
        """Return a lower bound (n,) of the strength in each cell, Pa, or one number that holds for all."""
        return self._cell_minimum[cells] if isinstance(self._cell_minimum, np.ndarray) else self._cell_minimum

    @cached_property
    def _cell_minimum(self) -> Values | float:
        """Lower bound of the strength in each cell (cells,) or in all, Pa."""
        minimum = self._cell_strength * (1 - self._tie_break)
        return minimum if self._factors is None else minimum * self._factors[self._graph.cell_edges].min(axis=1)

    def tie_break_noise(self, edges: npt.NDArray[np.int32]) -> Values:
        """Return numbers in [-1, 1) hashed from the mid-points of local edges; each is computed once."""
        if not self._tie_break:
            return np.zeros(edges.shape)
        result = self._noise[edges]
        # Few edges are ever near their strength, so that the hash is computed on demand.
        if len(unknown := np.unique(edges[np.isnan(result)])):
            self._noise[unknown] = hash_points(self._twice_midpoints(unknown))
            result = self._noise[edges]
        return result

    @cached_property
    def _noise(self) -> Values:
        """(edges,) numbers computed so far; NaN elsewhere."""
        return np.full(len(self._graph.broken), np.nan)

    def _twice_midpoints(self, edges: npt.NDArray[np.integer]) -> Values:
        """Return the rounded sum (n, d) of the ends of edges."""
        domain = self._graph.domain
        ends = domain.nodes[self._graph.edge_nodes[edges]]
        return round_points(ends[:, 0] + ends[:, 1], domain.bounds.diagonal)

    def _edge_factors(self, scatter: WeibullScatter | None, fibre: FibreAnisotropy | None) -> Values | None:
        """Return w_e f_e (edges,) of local edges; None if all are 1."""
        if scatter is None and fibre is None:
            return None
        factor = np.ones(len(self._graph.broken))
        if scatter is not None:
            factor *= weibull_factors(self._twice_midpoints(np.arange(len(factor))), scatter)
        if fibre is not None:
            factor *= fibre_factors(self._edge_vectors(), fibre)
        return factor

    def _edge_vectors(self) -> Values:
        """Return the reference vectors (edges, d) of local edges, m."""
        ends = self._graph.domain.nodes[self._graph.edge_nodes]
        return ends[:, 1] - ends[:, 0]


def weibull_factors(points: Values, scatter: WeibullScatter) -> Values:
    """Return Weibull numbers (n,) of mean 1, drawn from points (n, d) and a seed."""
    m = scatter.modulus
    survival = (1 - hash_points(points, scatter.seed)) / 2  # 1 - U, in (0, 1]
    return np.asarray((-np.log(survival)) ** (1 / m) / math.gamma(1 + 1 / m), np.float64)


def fibre_factors(vectors: Values, fibre: FibreAnisotropy) -> Values:
    """Return 1 + (ratio - 1) cos^2 (n,) of the angle between edge vectors (n, d) and the fibre."""
    a = np.asarray(fibre.direction, float)
    cosine2 = (vectors @ a) ** 2 / (np.einsum("ni,ni->n", vectors, vectors) * (a @ a))
    return np.asarray(1 + (fibre.ratio - 1) * cosine2)


def round_points(points: Values, size: float) -> Values:
    """Return points (n, k) in whole multiples of a power of two between 0.6e-9 and 1.2e-9 of the body's size, m.

    Meshes whose coordinates differ by round-off, as of two versions of a library, have the same multiples: of 10^7
    coordinates about one lies so near to the middle between two multiples that round-off decides.
    """
    # The power changes at sizes of 2^(n + 0.3) m, not at powers of two, which are the sizes of many bodies.
    return np.rint(np.ldexp(points, 30 - math.floor(math.log2(size) + 0.7)))


def hash_points(points: Values, seed: int = 0) -> Values:
    """Return numbers (n,) in [-1, 1) hashed from a seed and the bits of coordinates (n, k).

    The hash is the finaliser of splitmix64 (G. L. Steele, D. Lea, C. H. Flood, 2014, Fast splittable pseudorandom
    number generators).
    """
    positions = np.ascontiguousarray(points + 0.0, float)  # + 0.0: -0 and 0 have the same bits then
    bits: npt.NDArray[np.uint64] = positions.view(np.uint64)
    state: npt.NDArray[np.uint64] = np.full(len(points), seed, np.uint64)
    # Each coordinate is mixed into the state of the one before.
    for column in bits.T:
        state = _mix(state ^ column)
    return (state >> np.uint64(11)).astype(float) * 2.0**-52 - 1.0


def _mix(x: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    """Return splitmix64's mix of 64-bit integers (n,)."""
    x = x + np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))
