"""Grain boundaries (B07 section 7.1): nodes belong to the seeded point p_i with the least energy k_i |x - p_i|.

B07 cuts at the zero of (E_i - E_j) / 2, linear between nodes. The difference of the squares has the same zero, and is
linear along an edge where the weights are equal: then the boundaries are planes exactly.

Equations: docs/theory.md#brittle-surfaces.

What decides where brittle surfaces start and run: plain numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.spatial.distance import cdist

from .surface_cut import NEAREST, ROUNDS, Body, one_by_one

Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
Values = npt.NDArray[np.float64]
CHUNK = 1 << 22  # distances held at a time


@dataclass(frozen=True)
class GrainRules:
    """Grain boundaries: regions of `count` seeded points p_i by least k_i |x - p_i|.

    Attributes:
        seed: of the points.    spread: k_i are drawn from 1 - spread to 1 + spread; 0: all grains alike.
        mode: "replace": a surface frees a grain; "bias": it runs along the boundaries nearest to it.
    """

    count: int
    seed: int = 0
    spread: float = 0.0
    mode: Literal["replace", "bias"] = "replace"


@dataclass(frozen=True)
class SurfaceRules:
    """Surfaces in place of single edges.

    Attributes:
        surfaces: most of the run.    per_pass: most that start in one pass; None: no limit.
        spacing: m between places where surfaces start; None: about two mesh edges.
        curved: whether surfaces turn with the principal direction; else they are planes.
        seed: of the direction where several principal stresses are equal.
    """

    surfaces: int
    spacing: float | None = None
    curved: bool = False
    seed: int = 0
    per_pass: int | None = None
    grains: GrainRules | None = None


class Grains:
    """Grains of a body.

    Attributes:
        seeds: (n, d) m, uniform in the body.    weights: (n,) k_i.
        mode: see GrainRules.
        of_node: (N,) grain of each node.    of_cell: (C,) grain of each centroid.
        edges: (k,) edges between grains.    cut: (k,) where their boundaries cut them, from the lower node.
    """

    def __init__(self, body: Body, rules: GrainRules, settle: bool) -> None:
        """`settle`: no node without a cell in its own grain, as far as its cells allow."""
        self.mode = rules.mode
        self.seeds, self.weights = sow(body, rules)
        self.of_node, _ = least(body.points, self.seeds, self.weights)
        self.of_cell, _ = least(body.centroids, self.seeds, self.weights)
        if settle:
            half = len(self.of_node) // 2
            self.of_node = (_settled(body.cells, self.of_node) if body.layer is None
                            else np.tile(_settled(body.layer.cells, self.of_node[:half]), 2))  # fmt: skip
        both = self.of_node[body.edges]
        self.edges: Ints = np.flatnonzero(both[:, 0] != both[:, 1])
        self._ends = both[self.edges]
        self.cut = self._cuts(body.points[body.edges[self.edges]], self._ends)

    def cut_of(self, edges: Ints) -> Values:
        """(n,) where edges between grains are cut."""
        return self.cut[np.searchsorted(self.edges, edges)]

    def edges_of(self, grain: int) -> Ints:
        """The edges that leave a grain."""
        return self.edges[(self._ends == grain).any(axis=1)]

    def mean(self, phi: Values) -> Values:
        """(n,) mean of nodal values over each grain."""
        count = len(self.weights)
        nodes = np.bincount(self.of_node, minlength=count)
        return np.asarray(np.bincount(self.of_node, phi, minlength=count) / np.maximum(nodes, 1))

    def _cuts(self, ends: Values, grain: Ints) -> Values:
        """(k,) zeros of E_j^2 - E_i^2 on edges whose ends (k, 2, d) belong to grains (k, 2) i and j."""
        lead = [self._energy2(ends[:, a], grain[:, 1 - a]) - self._energy2(ends[:, a], grain[:, a]) for a in (0, 1)]
        first, second = (np.maximum(each, 0.0) for each in lead)  # below 0: a node that was moved over
        both = first + second
        return np.clip(np.divide(first, both, out=np.full(len(both), 0.5), where=both > 0), NEAREST, 1 - NEAREST)

    def _energy2(self, points: Values, grain: Ints) -> Values:
        return np.asarray(self.weights[grain] ** 2 * np.sum((points - self.seeds[grain]) ** 2, axis=1))


def sow(body: Body, rules: GrainRules) -> tuple[Values, Values]:
    """Points drawn uniformly from the body, (n, d) in m, and weights (n,) drawn from 1 - spread to 1 + spread."""
    random = np.random.Generator(np.random.PCG64(rules.seed))
    share = np.cumsum(body.volumes)
    cell = np.searchsorted(share / share[-1], random.random(rules.count), side="right")
    inside = random.dirichlet(np.ones(body.dim + 1), rules.count)
    seeds = np.einsum("nk,nki->ni", inside, body.points[body.cells[np.minimum(cell, len(body.cells) - 1)]])
    return seeds, random.uniform(1 - rules.spread, 1 + rules.spread, rules.count)


def least(points: Values, seeds: Values, weights: Values) -> tuple[Ints, Values]:
    """For each point the seed of least energy k_i |x - p_i|, the first where several are, and that energy (k m)."""
    label, energy = np.empty(len(points), np.int64), np.empty(len(points))
    rows = max(CHUNK // len(seeds), 1)
    for first in range(0, len(points), rows):
        part = slice(first, first + rows)
        every = cdist(points[part], seeds) * weights
        label[part] = every.argmin(axis=1)
        energy[part] = every.min(axis=1)
    return label, energy


def _settled(cells: Ints, grain: Ints) -> Ints:
    """Grains (N,) with the nodes moved over that have no cell within their own grain: into one where they have, alone
    or, where there is none, with the other corners of the cell that most of are of one grain."""
    grain = grain.copy()
    lost = _lost(cells, grain)
    for attempt in range(2 * ROUNDS):
        if not lost.any():
            break
        moved = _moved_alone(cells, grain, lost) if attempt < ROUNDS else grain
        if np.array_equal(moved, grain):
            moved = _moved_with_cells(cells, grain, lost)
            if np.count_nonzero(_lost(cells, moved)) >= np.count_nonzero(lost):
                break
        grain, lost = moved, _lost(cells, moved)
    return one_by_one(cells, grain, np.ones(len(grain), bool)) if lost.any() else grain


def _lost(cells: Ints, grain: Ints) -> Flags:
    """(N,) nodes without a cell within their own grain."""
    of = grain[cells]
    lost = np.ones(len(grain), bool)
    lost[cells[np.all(of == of[:, :1], axis=1)]] = False
    return lost


def _moved_alone(cells: Ints, grain: Ints, lost: Flags) -> Ints:
    """Lost nodes in the grain that all other corners of a cell of theirs are of."""
    of, moved = grain[cells], grain.copy()
    for corner in range(cells.shape[1]):
        rest = np.delete(of, corner, axis=1)
        one = np.all(rest == rest[:, :1], axis=1) & lost[cells[:, corner]]
        moved[cells[one, corner]] = rest[one, 0]
    return moved


def _moved_with_cells(cells: Ints, grain: Ints, lost: Flags) -> Ints:
    """All corners of one cell of each lost node in the grain that most of the cell's corners are of."""
    near = cells[lost[cells].any(axis=1)]
    of = grain[near]
    like = (of[:, :, None] == of[:, None, :]).sum(axis=2)
    most = of[np.arange(len(near)), like.argmax(axis=1)]
    row, corner = np.nonzero(lost[near])
    order = np.lexsort((row, -like.max(axis=1)[row], near[row, corner]))
    _, first = np.unique(near[row, corner][order], return_index=True)
    chosen = row[order][first]
    moved = grain.copy()
    moved[near[chosen]] = most[chosen, None]
    return moved
