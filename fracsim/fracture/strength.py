"""Strength of an edge in a cell: by region, with a hashed tie-break, and scatter and a fibre where the study asks.

    s_e = strength(cell) (1 + tie_break h_e) w_e f_e

h_e in [-1, 1) is hashed from the edge's reference mid-point; w_e is a Weibull number of mean 1 drawn from the same
place and a seed, w = (-ln(1 - U))^(1/m) / Gamma(1 + 1/m); f_e = 1 + (ratio - 1) (n . a)^2 for the edge's reference
direction n and the fibre a. All of them belong to the place of the edge, so that no partition changes them.

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
class Scatter:
    """Weibull's modulus m (5 scatters like stone, 50 hardly at all), and the seed of the draw."""

    modulus: float
    seed: int = 0


@dataclass(frozen=True)
class Fibre:
    """A direction (d,) of any length, along which the strength is `ratio` times that across it."""

    direction: Sequence[float] | Values
    ratio: float = 1.0


class Strength:
    """Pa, for edges of cells of a distributed mesh."""

    def __init__(
        self,
        graph: EdgeGraph,
        of_cell: PerCell,
        *,
        tie_break: float = 0.0,
        scatter: Scatter | None = None,
        fibre: Fibre | None = None,
    ) -> None:
        """`of_cell`: Pa, a number or (cells,); `tie_break`: relative perturbation from edge to edge (collective)."""
        self._graph, self._of_cell, self._tie_break = graph, of_cell, tie_break
        self._factor = self._edge_factors(scatter, fibre)
        smallest = float(np.min(self._factor, initial=np.inf)) if self._factor is not None else 1.0
        weakest = float(np.min(self._of_cell, initial=np.inf)) * smallest * (1 - tie_break)
        self.weakest = graph.domain.comm.allreduce(weakest, op=MPI.MIN)  # no edge of the body is weaker

    def __call__(self, cells: npt.NDArray[np.int64], edges: npt.NDArray[np.int32]) -> Values:
        """(n, k) strengths of the (n, k) local edges of n cells."""
        base = self._of_cell[cells, None] if isinstance(self._of_cell, np.ndarray) else self._of_cell
        factor = 1.0 if self._factor is None else self._factor[edges]
        return np.asarray(base * factor * (1 + self._tie_break * self.noise(edges)))

    def weakest_of(self, cells: npt.NDArray[np.int64]) -> Values | float:
        """(n,) Pa, what no edge of each cell is weaker than; one number where that is the same for all of them."""
        return self._of_cells[cells] if isinstance(self._of_cells, np.ndarray) else self._of_cells

    @cached_property
    def _of_cells(self) -> Values | float:
        """`weakest_of` all cells."""
        least = self._of_cell * (1 - self._tie_break)
        return least if self._factor is None else least * self._factor[self._graph.cell_edges].min(axis=1)

    def noise(self, edges: npt.NDArray[np.int32]) -> Values:
        """Numbers in [-1, 1) hashed from the mid-points of local edges; worked out for those asked for, once."""
        if not self._tie_break:
            return np.zeros(edges.shape)
        result = self._noise[edges]
        if len(unknown := edges[np.isnan(result)]):
            self._noise[unknown] = hashed(self._twice_middle(unknown))
            result = self._noise[edges]
        return result

    @cached_property
    def _noise(self) -> Values:
        """(edges,) those that have been worked out; NaN elsewhere."""
        return np.full(len(self._graph.broken), np.nan)

    def _twice_middle(self, edges: npt.NDArray[np.integer]) -> Values:
        ends = self._graph.domain.nodes[self._graph.edge_nodes[edges]]
        return ends[:, 0] + ends[:, 1]

    def _edge_factors(self, scatter: Scatter | None, fibre: Fibre | None) -> Values | None:
        """w_e f_e of every local edge; None where all of them are 1."""
        if scatter is None and fibre is None:
            return None
        factor = np.ones(len(self._graph.broken))
        if scatter is not None:
            factor *= weibull(self._twice_middle(np.arange(len(factor))), scatter)
        if fibre is not None:
            factor *= along_fibre(self._directions(), fibre)
        return factor

    def _directions(self) -> Values:
        ends = self._graph.domain.nodes[self._graph.edge_nodes]
        return ends[:, 1] - ends[:, 0]


def weibull(points: Values, scatter: Scatter) -> Values:
    """Weibull numbers of mean 1 and the given modulus, one a place."""
    m = scatter.modulus
    survival = (1 - hashed(points, scatter.seed)) / 2  # 1 - U, in (0, 1]
    return np.asarray((-np.log(survival)) ** (1 / m) / math.gamma(1 + 1 / m), np.float64)


def along_fibre(vectors: Values, fibre: Fibre) -> Values:
    """1 + (ratio - 1) cos^2 of the angle between edges ((n, d) vectors) and the fibre: `ratio` along it, 1 across."""
    a = np.asarray(fibre.direction, float)
    cosine2 = (vectors @ a) ** 2 / (np.einsum("ni,ni->n", vectors, vectors) * (a @ a))
    return np.asarray(1 + (fibre.ratio - 1) * cosine2)


def hashed(points: Values, seed: int = 0) -> Values:
    """Numbers in [-1, 1), one a point, from a seed and the bits of its coordinates (splitmix64's finaliser)."""
    places = np.ascontiguousarray(points + 0.0, float)  # + 0.0: -0 and 0 are one place
    bits: npt.NDArray[np.uint64] = places.view(np.uint64)
    state: npt.NDArray[np.uint64] = np.full(len(points), seed, np.uint64)
    for column in bits.T:
        state = _mix(state ^ column)
    return (state >> np.uint64(11)).astype(float) * 2.0**-52 - 1.0


def _mix(x: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    x = x + np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))
