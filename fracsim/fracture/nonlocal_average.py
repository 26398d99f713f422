"""Averages of cell values over neighbouring cells: within a radius, or over the cells that share a node.

`NonlocalAverage` (M22, eq. 13) is a sparse matrix with one row per owned cell,

    <s>_c = sum_k w_ck s_k / sum_k w_ck,   w_ck = V_k g(|X_k - X_c| / R),   |X_k - X_c| <= R,

with reference centroids X, volumes V and a kernel g. `NeighbourAverage` is B07's average (section 7.1),

    <s>_c = sum over nodes n of c of sum over cells k around n of V_k s_k / the same sum of V_k,

so that a neighbour counts once for each node that it shares with the cell, and the cell itself d + 1 times.

Both are the same on any number of ranks. Equations: docs/theory.md#edge-criterion.
"""

from __future__ import annotations

from collections.abc import Callable
from ctypes import CDLL, Structure, byref, c_double, c_int64
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
from dolfinx import la
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from ..mesh.c_library import Float64, Int32, load_library, struct_pointer
from ..mesh.domain import Domain
from ..mesh.parallel import RankHalo, max_over_ranks

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
SOURCE = Path(__file__).with_suffix(".c")

KERNELS: dict[str, Callable[[Values], Values]] = {
    "linear": lambda q: 1 - q,
    "constant": np.ones_like,
    # The radius is three standard deviations; the 1 % of the weight outside is cut off.
    "gaussian": lambda q: np.exp(-4.5 * q**2),
}


@dataclass(frozen=True)
class AverageLimits:
    """Memory limits and tolerances of the averages.

    Attributes:
        max_initial_weights: weights that a rank computes before the first step (0.6 GB). Beyond it a row is computed
            when the stress near it first reaches the strength, since the number of weights grows as h^-6.
        rows_per_block: rows computed at once. A distance takes three times the memory of a weight meanwhile.
        sampled_rows: rows that are counted to estimate the number of weights.
        bound_round_off: relative rounding error of an average that is compared with a bound.
        near_bound_round_off: the same of cell values that decide which rows are needed.
        radius_round_off: relative rounding error of distances that are compared with the radius.
    """

    max_initial_weights: float = 5e7
    rows_per_block: int = 20_000
    sampled_rows: int = 1_000
    bound_round_off: float = 1e-12
    near_bound_round_off: float = 1e-9
    radius_round_off: float = 1e-9


LIMITS = AverageLimits()


class NonlocalAverage:
    """Average over the cells within a radius (m), weighted by volume and kernel.

    A rank has copies of the cells of other ranks within the radius of its own.
    """

    def __init__(self, domain: Domain, radius: float, kernel: str) -> None:
        """Exchange the neighbouring cells of other ranks, and compute weights up to the memory limit (collective)."""
        self._comm = domain.comm
        centroids = domain.nodes[domain.cell_nodes].mean(axis=1)
        self._exchange = RankHalo(domain.comm, centroids, radius)
        near = self._exchange(centroids)
        volumes = self._exchange(domain.volumes[:, None])[:, 0]
        # Sums in the order of the input mesh are the same to the last bit on any number of ranks.
        order = np.argsort(self._exchange(domain.input_numbering.cells[:, None].astype(float))[:, 0], kind="stable")
        self._weights = _WeightMatrix(centroids, near[order], volumes[order], order, radius, kernel)

    def __call__(self, values: Values, active: Flags | None = None) -> Values:
        """Average cell values (cells, n); inactive cells do not enter; 0 where no active cell is near (collective)."""
        self._weights.compute_all()
        n = values.shape[1]
        # The flag is averaged as well: its sum is the weight of the active cells.
        if active is not None:
            values = np.column_stack([np.where(active[:, None], values, 0.0), active])
        near = self._exchange(values)
        averages = np.zeros((len(values), n))
        for block in self._weights.blocks:
            sums = block.multiply(near)
            weight = block.row_sums[:, None] if active is None else sums[:, -1:]
            averages[block.cells] = np.divide(sums[:, :n], weight, out=np.zeros((len(sums), n)), where=weight > 0)
        return averages

    def find_averages_above(
        self, values: Values, norms: Values, bound: float, active: Flags | None = None
    ) -> tuple[Ints, Values]:
        """Find the cells (m,) whose average may reach `bound` in norm, and their averages (m, n) (collective).

        Args:
            values: (cells, n), 0 on inactive cells.
            norms: (cells,) norms of `values`, in any norm.
            bound: value that the norm of an average is compared with.
            active: (cells,) cells that enter averages; None: all.
        """
        n = values.shape[1]
        # The norm of an average is at most the average of the norms, one column instead of six, and no average exceeds
        # the largest norm of all ranks.
        if max_over_ranks(self._comm, float(np.max(norms, initial=0.0))) < bound:
            return np.empty(0, np.int64), np.empty((0, n))
        near, near_norms = self._exchange(values), self._exchange(norms[:, None])[:, 0]
        # The sums are rounded, so that cells slightly below the bound count as well.
        over_bound = near_norms >= bound * (1 - LIMITS.near_bound_round_off)
        self._weights.compute_near(over_bound)
        candidates = self._weights.flag_centres_near(over_bound)
        near_active = None if active is None else self._exchange(active[:, None].astype(float))
        parts = [
            block.find_averages_above(candidates, near_norms, sums, bound * (1 - LIMITS.bound_round_off), near)
            for block, sums in zip(self._weights.blocks, self._weights.active_sums(near_active), strict=True)
        ]
        cells = np.concatenate([np.empty(0, np.int64), *(cells for cells, _ in parts)])
        averages = np.concatenate([np.empty((0, n)), *(averages for _, averages in parts)])
        order = np.argsort(cells)
        return cells[order], averages[order]


class _WeightArrays(Structure):
    """Arrays of a sparse matrix, in the layout of nonlocal_average.c."""

    _fields_ = (("start", Int32), ("place", Int32), ("weight", Float64))


@cache
def _code() -> CDLL:
    """Return the compiled functions of nonlocal_average.c."""
    return load_library(SOURCE, separate_rounding=True)


class _WeightBlock:
    """Rows of the weight matrix of some centres.

    Attributes:
        cells: (n,) centres of the rows.
        row_sums: (n,) sums of their weights, m^d.
    """

    def __init__(self, cells: Ints, weights: csr_matrix) -> None:
        """Store the rows `weights` (n, near) of the centres `cells` (n,)."""
        self.cells, self.row_sums = cells, np.asarray(weights.sum(axis=1))[:, 0]
        # The C structure has addresses only: these references keep the arrays alive.
        self._arrays = np.asarray(weights.indptr, np.int32), np.asarray(weights.indices, np.int32), weights.data
        self._matrix = _WeightArrays(*map(struct_pointer, self._arrays))
        self._all_rows = np.arange(len(cells))

    def find_averages_above(
        self, candidates: Flags, norms: Values, sums: Values, bound: float, values: Values
    ) -> tuple[Ints, Values]:
        """Find the candidate cells (m,) whose average of `norms` reaches `bound`, and their averages (m, k).

        Args:
            candidates: (own cells,) cells that may reach the bound.
            norms: (near,) norms of values.
            sums: (n,) sums of the weights of active cells.
            bound: value to reach.
            values: (near, k) values to average.
        """
        width, count = values.shape[1], len(self.cells)
        cells, averages = np.empty(count, np.int64), np.empty((count, width))
        inputs = self.cells, candidates, np.ascontiguousarray(norms), sums, c_double(bound)
        outputs = c_int64(width), np.ascontiguousarray(values), cells, averages
        count = _code().averages_above(byref(self._matrix), c_int64(count), *inputs, *outputs)
        return cells[:count], averages[:count]

    def mark_neighbours(self, near_flags: Flags, marks: Flags) -> None:
        """Set `marks` (near,) of the cells that are near the flagged own cells (near,) of this block."""
        sizes = c_int64(len(self.cells)), self.cells
        _code().mark_columns(byref(self._matrix), *sizes, near_flags, marks)

    def multiply(self, values: Values, rows: Ints | None = None) -> Values:
        """Return the weighted sums (n, k) of near values (near, k), of all rows or of `rows`."""
        rows = self._all_rows if rows is None else rows
        result, values = np.empty((len(rows), values.shape[1])), np.ascontiguousarray(values)
        sizes = c_int64(len(rows)), rows, c_int64(values.shape[1])
        _code().multiply_rows(byref(self._matrix), *sizes, values, result)
        return result


class _WeightMatrix:
    """Weights of near cells around centres, computed at once or row by row if they are too many.

    Attributes:
        blocks: blocks of rows. They are never joined, which would need their memory once more.
    """

    def __init__(
        self, centres: Values, near: Values, volumes: Values, positions: Ints, radius: float, kernel: str
    ) -> None:
        """Build the matrix.

        Args:
            centres: (centres, d) centroids of the cells of this rank, m.
            near: (near, d) centroids of these and of near cells, in the order of the input mesh, m.
            volumes: (near,) their volumes, m^d.
            positions: (near,) their positions in exchanged values, where the cells of this rank come first.
            radius: radius of the average, m.
            kernel: name of the kernel.
        """
        self._positions, self._centres, self._near, self._volumes = positions, centres, near, volumes
        self._radius, self._kernel = radius, kernel
        self._tree = cKDTree(near)
        self._missing = np.ones(len(centres), bool)
        # Centres with cells of other ranks within the radius.
        self._near_other_rank = np.zeros(len(centres), bool)
        self.blocks: list[_WeightBlock] = []
        self._active: Values = np.ones((len(near), 1))
        self._active_sums: list[Values] = []
        if self._estimate_weights() <= LIMITS.max_initial_weights:
            self.compute_all()

    def _estimate_weights(self) -> float:
        """Estimate the number of weights from a sample of rows."""
        stride = max(len(self._centres) // LIMITS.sampled_rows, 1)
        counts = self._tree.query_ball_point(self._centres[::stride], self._radius, return_length=True)
        return float(np.sum(counts)) * stride

    def flag_centres_near(self, near_flags: Flags) -> Flags:
        """Flag the centres (centres,) with rows that may have a flagged near cell (near,) within the radius.

        Own cells among the flagged ones must have rows.
        """
        count, marks = len(self._centres), np.zeros(len(near_flags), bool)
        # Of two cells exactly R apart only one may count as near, which matters if the kernel is not 0 at R.
        if KERNELS[self._kernel](np.ones(1))[0]:
            return ~marks[:count]
        # Nearness is symmetric: the rows of flagged cells have their centres.
        for block in self.blocks:
            block.mark_neighbours(near_flags, marks)
        return marks[:count] | self._near_other_rank if near_flags[count:].any() else marks[:count]

    def compute_near(self, near_flags: Flags) -> None:
        """Compute the rows of all centres with a flagged near cell (near,) within the radius."""
        if not self._missing.any() or not near_flags.any():
            return
        centres, points = self._centres, self._near[near_flags[self._positions]]
        reach = self._radius * (1 + LIMITS.radius_round_off)
        # A bounding box excludes most centres from the search.
        in_box = np.all((centres >= points.min(axis=0) - reach) & (centres <= points.max(axis=0) + reach), axis=1)
        cells = np.flatnonzero(self._missing & in_box)
        distance, _ = cKDTree(points).query(centres[cells], distance_upper_bound=reach)
        self._add_rows(cells[np.isfinite(distance)])

    def compute_all(self) -> None:
        """Compute the rows of all centres."""
        self._add_rows(np.flatnonzero(self._missing))

    def active_sums(self, active: Values | None) -> list[Values]:
        """Return, for each block, the sums of the weights of near cells with 1 in `active` (near, 1); None: of all."""
        if active is None:
            return [block.row_sums for block in self.blocks]
        changed, self._active = (active != self._active)[:, 0], active
        if changed.any() and self._missing.any():
            # A changed cell without a row of its own may be near rows that exist: sum all again.
            self._active_sums = []
        elif changed.any():
            # Only rows near cells that became active or inactive are summed again.
            near = self.flag_centres_near(changed)
            for block, sums in zip(self.blocks, self._active_sums, strict=False):
                rows = np.flatnonzero(near[block.cells])
                sums[rows] = block.multiply(active, rows)[:, 0]
        self._active_sums += [block.multiply(active)[:, 0] for block in self.blocks[len(self._active_sums) :]]
        return self._active_sums

    def _add_rows(self, cells: Ints) -> None:
        """Compute the rows of centres (n,), in blocks."""
        for start in range(0, len(cells), LIMITS.rows_per_block):
            part = cells[start : start + LIMITS.rows_per_block]
            pairs = cKDTree(self._centres[part]).sparse_distance_matrix(
                self._tree, self._radius, output_type="coo_matrix"
            )
            weights = self._volumes[pairs.col] * KERNELS[self._kernel](pairs.data / self._radius)
            self._near_other_rank[part[pairs.row[self._positions[pairs.col] >= len(self._centres)]]] = True
            rows = csr_matrix((weights, (pairs.row, pairs.col)), shape=(len(part), len(self._near)))
            rows.sort_indices()
            # Columns become positions in exchanged values, and keep the order of the input mesh.
            rows.indices = self._positions[rows.indices].astype(rows.indices.dtype)
            rows.has_sorted_indices = False
            self.blocks.append(_WeightBlock(part, rows))
        self._missing[cells] = False


class NeighbourAverage:
    """Average over the cells that share a node with a cell (B07, section 7.1); it stores nothing but the mesh."""

    def __init__(self, domain: Domain) -> None:
        self._domain = domain

    def __call__(self, values: Values, active: Flags | None = None) -> Values:
        """Average cell values (cells, n); inactive cells do not enter; 0 where no active cell is near (collective)."""
        volume = self._domain.volumes if active is None else np.where(active, self._domain.volumes, 0.0)
        sums = self._sum_over_neighbours(np.column_stack([volume[:, None] * values, volume]))
        return np.asarray(sums[:, :-1] / np.where(sums[:, -1:] > 0, sums[:, -1:], 1.0))

    def find_averages_above(
        self, values: Values, norms: Values, bound: float, active: Flags | None = None
    ) -> tuple[Ints, Values]:
        """Find the cells (m,) whose average may reach `bound` in norm, and their averages (m, n) (collective)."""
        cells = np.flatnonzero(self(norms[:, None], active)[:, 0] >= bound * (1 - LIMITS.bound_round_off))
        return cells, self(values, active)[cells]

    def find_averages_above_in(
        self, cells: Ints, values: Values, norms: Values, bound: float, active: Flags
    ) -> tuple[Ints, Values]:
        """Find averages above `bound` in a subset `cells` (k,) on one rank, at the cost of the subset.

        Of the subset the cells that are `active` (cells,) enter the averages, and no other cell does.
        """
        if not len(cells):
            return cells, values[cells]
        corners = np.unique(self._domain.cell_nodes[cells], return_inverse=True)[1].reshape(len(cells), -1)
        volume = np.where(active[cells], self._domain.volumes[cells], 0.0)

        def sum_over_neighbours(column: Values) -> Values:
            nodal = np.bincount(corners.ravel(), np.repeat(volume * column, corners.shape[1]))
            return np.asarray(sum(nodal[corner] for corner in corners.T))

        weight = sum_over_neighbours(np.ones(len(cells)))
        # A cell without active neighbours has sums of 0.
        weight[weight <= 0] = 1.0
        limit = bound * (1 - LIMITS.bound_round_off)
        near = np.flatnonzero(sum_over_neighbours(norms[cells]) / weight >= limit)
        if not len(near):
            return cells[near], values[cells[near]]
        means = np.stack([sum_over_neighbours(column)[near] for column in values[cells].T], axis=1)
        return cells[near], means / weight[near, None]

    def _sum_over_neighbours(self, values: Values) -> Values:
        """Return the sums (cells, n) over the nodes of each cell of the sums over the cells around the node."""
        nodes, n = self._domain.cell_nodes, values.shape[1]
        nodal = la.vector(self._domain.space.dofmap.index_map, n, np.float64)
        table = nodal.array.reshape(-1, n)
        for total, column in zip(table.T, values.T, strict=True):
            total += np.bincount(nodes.ravel(), np.repeat(column, nodes.shape[1]), minlength=len(table))
        # Sums of ghost nodes are added to their owners, then copied back.
        nodal.scatter_reverse(la.InsertMode.add)
        nodal.scatter_forward()
        return np.asarray(table[nodes].sum(axis=1))
