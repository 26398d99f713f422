"""Grain boundaries (B07, section 7.1): nodes belong to the seed p_i with the least energy k_i |S^-1 (x - p_i)|.

S is diagonal: long grains, as of wood, are round in shrunk coordinates. B07 has S = I.

B07 cuts edges at the zero of (E_i - E_j) / 2, linear between nodes. The difference of the squares has the same zero and
is linear along an edge if the weights are equal, so that the boundaries are exact planes then.

Equations: docs/theory.md#brittle-surfaces.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.spatial.distance import cdist

from .surface_cut import CUT, SurfaceCutMesh, relabel_isolated_nodes

Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class GrainParameters:
    """Parameters of grains.

    Attributes:
        count: number of seeds.
        seed: seed of the random points.
        spread: the weights k_i are drawn from 1 - spread to 1 + spread; 0 for equal weights.
        mode: "replace": a surface cuts out a grain; "bias": it follows the nearest grain boundaries.
        stretch: (d,) lengths of a grain along the axes, relative to one another; None: equal lengths.
    """

    count: int
    seed: int = 0
    spread: float = 0.0
    mode: Literal["replace", "bias"] = "replace"
    stretch: Sequence[float] | Values | None = None


@dataclass(frozen=True)
class SurfaceParameters:
    """Parameters of brittle surfaces.

    Attributes:
        surfaces: largest number of surfaces in the run.
        spacing: least distance between starts of surfaces, m; None: about two mesh edges.
        curved: surfaces turn with the principal direction; otherwise they are planes.
        seed: seed of the direction where several principal stresses are equal.
        per_pass: largest number of surfaces that start in one pass; None: no limit.
        grains: grains; None for surfaces by a level set.
    """

    surfaces: int
    spacing: float | None = None
    curved: bool = False
    seed: int = 0
    per_pass: int | None = None
    grains: GrainParameters | None = None


class GrainBoundaries:
    """Grains of a mesh, and the edges between them.

    Attributes:
        mode: see `GrainParameters`.
        seeds: (n, d) points, m, uniform in the body.
        weights: (n,) k_i.
        node_grain: (nodes,) grain of each node.
        cell_grain: (cells,) grain of each centroid.
        edges: (k,) edges between grains.
        cut_positions: (k,) positions of the boundary on these edges, from the lower node.
    """

    def __init__(self, mesh: SurfaceCutMesh, parameters: GrainParameters, retain_nodes: bool) -> None:
        """Draw seeds and assign nodes; `retain_nodes`: every node gets a cell within its own grain where possible."""
        self.mode = parameters.mode
        self.seeds, self.weights = draw_seeds(mesh, parameters)
        stretch = np.ones(mesh.dim) if parameters.stretch is None else np.asarray(parameters.stretch, float)
        self._shrunk = 1 / stretch
        self.node_grain, self.cell_grain = (
            assign_to_seeds(points * self._shrunk, self.seeds * self._shrunk, self.weights)[0]
            for points in (mesh.points, mesh.centroids)
        )
        if retain_nodes and mesh.layer is None:
            self.node_grain = _reassign_isolated_nodes(mesh.cells, self.node_grain)
        elif retain_nodes and mesh.layer is not None:
            # The nodes of a shell are there twice: both faces belong to the same grains.
            half = len(self.node_grain) // 2
            self.node_grain = np.tile(_reassign_isolated_nodes(mesh.layer.cells, self.node_grain[:half]), 2)
        end_grains = self.node_grain[mesh.edges]
        self.edges: Ints = np.flatnonzero(end_grains[:, 0] != end_grains[:, 1])
        self._end_grains = end_grains[self.edges]
        self.cut_positions = self._boundary_positions(mesh.points[mesh.edges[self.edges]], self._end_grains)

    def cut_positions_of(self, edges: Ints) -> Values:
        """Return the cut positions (n,) of edges (n,) between grains."""
        return self.cut_positions[np.searchsorted(self.edges, edges)]

    def edges_of(self, grain: int) -> Ints:
        """Return the edges that leave a grain."""
        return self.edges[(self._end_grains == grain).any(axis=1)]

    def average_by_grain(self, phi: Values) -> Values:
        """Return the mean (n,) of nodal values (nodes,) over each grain."""
        count = len(self.weights)
        nodes = np.bincount(self.node_grain, minlength=count)
        return np.asarray(np.bincount(self.node_grain, phi, minlength=count) / np.maximum(nodes, 1))

    def _boundary_positions(self, ends: Values, grain: Ints) -> Values:
        """Return the zeros (k,) of E_j^2 - E_i^2 on edges with ends (k, 2, d) in grains i and j (k, 2)."""
        difference = [
            self._squared_energy(ends[:, a], grain[:, 1 - a]) - self._squared_energy(ends[:, a], grain[:, a])
            for a in (0, 1)
        ]
        # A node that was moved to another grain has a negative difference: the cut is at that node then.
        first, second = (np.maximum(end, 0.0) for end in difference)
        total = first + second
        position = np.divide(first, total, out=np.full(len(total), 0.5), where=total > 0)
        return np.clip(position, CUT.min_share, 1 - CUT.min_share)

    def _squared_energy(self, points: Values, grain: Ints) -> Values:
        """Return k_i^2 |S^-1 (x - p_i)|^2 (n,) of points (n, d) and grains i (n,)."""
        distance = (points - self.seeds[grain]) * self._shrunk
        return np.asarray(self.weights[grain] ** 2 * np.sum(distance**2, axis=1))


def draw_seeds(mesh: SurfaceCutMesh, parameters: GrainParameters) -> tuple[Values, Values]:
    """Draw points (n, d), m, uniformly from the body, and weights (n,) from 1 - spread to 1 + spread."""
    random = np.random.Generator(np.random.PCG64(parameters.seed))
    # A cell is drawn by its volume, and a point in it by barycentric coordinates.
    share = np.cumsum(mesh.volumes)
    cell = np.searchsorted(share / share[-1], random.random(parameters.count), side="right")
    barycentric = random.dirichlet(np.ones(mesh.dim + 1), parameters.count)
    seeds = np.einsum("nk,nki->ni", barycentric, mesh.points[mesh.cells[np.minimum(cell, len(mesh.cells) - 1)]])
    return seeds, random.uniform(1 - parameters.spread, 1 + parameters.spread, parameters.count)


def assign_to_seeds(points: Values, seeds: Values, weights: Values) -> tuple[Ints, Values]:
    """Return for each point (N, d) the seed of least energy k_i |x - p_i|, the first of equal ones, and the energy."""
    label, energy = np.empty(len(points), np.int64), np.empty(len(points))
    # 32 MiB of distances between points and seeds at once.
    rows = max((1 << 22) // len(seeds), 1)
    for first in range(0, len(points), rows):
        part = slice(first, first + rows)
        energies = cdist(points[part], seeds) * weights
        label[part] = energies.argmin(axis=1)
        energy[part] = energies.min(axis=1)
    return label, energy


def _reassign_isolated_nodes(cells: Ints, grain: Ints) -> Ints:
    """Return the grains (nodes,) with isolated nodes moved to a grain in which they have a cell.

    An isolated node has no cell with all corners in its own grain. It moves alone, or with the other corners of the
    cell that has most corners in one grain.
    """
    grain = grain.copy()
    isolated = _flag_isolated(cells, grain)
    for attempt in range(2 * CUT.reassign_rounds):
        if not isolated.any():
            break
        moved = _move_alone(cells, grain, isolated) if attempt < CUT.reassign_rounds else grain
        if np.array_equal(moved, grain):
            moved = _move_with_cell(cells, grain, isolated)
            if np.count_nonzero(_flag_isolated(cells, moved)) >= np.count_nonzero(isolated):
                break
        grain, isolated = moved, _flag_isolated(cells, moved)
    return relabel_isolated_nodes(cells, grain, np.ones(len(grain), bool)) if isolated.any() else grain


def _flag_isolated(cells: Ints, grain: Ints) -> Flags:
    """Flag the nodes (nodes,) without a cell within their own grain."""
    corner_grain = grain[cells]
    isolated = np.ones(len(grain), bool)
    isolated[cells[np.all(corner_grain == corner_grain[:, :1], axis=1)]] = False
    return isolated


def _move_alone(cells: Ints, grain: Ints, isolated: Flags) -> Ints:
    """Return the grains with isolated nodes moved to the common grain of all other corners of one of their cells."""
    corner_grain, moved = grain[cells], grain.copy()
    for corner in range(cells.shape[1]):
        remaining = np.delete(corner_grain, corner, axis=1)
        common = np.all(remaining == remaining[:, :1], axis=1) & isolated[cells[:, corner]]
        moved[cells[common, corner]] = remaining[common, 0]
    return moved


def _move_with_cell(cells: Ints, grain: Ints, isolated: Flags) -> Ints:
    """Return the grains with one cell of each isolated node moved, all corners, to the most frequent grain in it."""
    near = cells[isolated[cells].any(axis=1)]
    corner_grain = grain[near]
    frequency = (corner_grain[:, :, None] == corner_grain[:, None, :]).sum(axis=2)
    frequent = corner_grain[np.arange(len(near)), frequency.argmax(axis=1)]
    row, corner = np.nonzero(isolated[near])
    order = np.lexsort((row, -frequency.max(axis=1)[row], near[row, corner]))
    _, first = np.unique(near[row, corner][order], return_index=True)
    chosen = row[order][first]
    moved = grain.copy()
    moved[near[chosen]] = frequent[chosen, None]
    return moved
