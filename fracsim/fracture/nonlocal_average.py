"""Averages of cell values over neighbouring cells: within a radius, or over the cells that share a node.

`NonlocalAverage` (M22, eq. 13) is, at each owned cell,

    <s>_c = sum_k w_ck s_k / sum_k w_ck,   w_ck = V_k g(|X_k - X_c| / R),   |X_k - X_c| <= R,

with reference centroids X, volumes V and a kernel g. `NeighbourAverage` is B07's average (section 7.1),

    <s>_c = sum over nodes n of c of sum over cells k around n of V_k s_k / the same sum of V_k,

so that a neighbour counts once for each node that it shares with the cell, and the cell itself d + 1 times.

Both are the same on any number of ranks. Equations: docs/theory.md#edge-criterion.
"""

from __future__ import annotations

import math
from ctypes import CDLL, Structure, byref, c_double, c_int64
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from scipy.fft import irfftn, next_fast_len, rfftn
from scipy.spatial import cKDTree

from ..mesh.c_library import Float32, Float64, Int64, load_library, struct_pointer
from ..mesh.domain import Domain
from ..mesh.ghost_exchange import sum_at_nodes
from ..mesh.parallel import RankHalo, max_over_ranks

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
SOURCE = Path(__file__).with_suffix(".c")
KERNELS = ("linear", "constant", "gaussian")  # in the order of nonlocal_average.c


@dataclass(frozen=True)
class AverageLimits:
    """Sizes and tolerances of the averages.

    Attributes:
        bins_per_radius: bins along the radius. With 4 a group of centres sees twice the points that it needs.
        bins_per_spacing: bins along the mean distance of cells, at most, which bounds the memory of the bins.
        bin_round_off: by so many edges of a bin rounding may move a point into another bin.
        max_columns: values of a cell that are averaged at once.
        coarse_share: 1 less the relative rounding error of sums in single precision, for 10,000 points.
        max_coarse: largest norm over the bound in single precision; beyond it an average reaches the bound anyhow.
        least_radius: radius over the edge of a bin, below which it counts as larger: no cells are as close together.
        least_extent: extent of a body over its largest one, below which it counts as flat.
        bound_round_off: relative rounding error of an average that is compared with a bound.
    """

    bins_per_radius: float = 4.0
    bins_per_spacing: float = 2.0
    bin_round_off: float = 1e-6
    max_columns: int = 7
    coarse_share: float = 0.999
    max_coarse: float = 1e20
    least_radius: float = 1e-9
    least_extent: float = 1e-9
    bound_round_off: float = 1e-12


LIMITS = AverageLimits()


class NonlocalAverage:
    """Average over the cells within a radius (m), weighted by volume and kernel.

    A rank has copies of the cells of other ranks within the radius of its own. Weights are computed when they are used:
    their number grows as h^-6, and reading one from memory would take as long.
    """

    def __init__(self, domain: Domain, radius: float, kernel: str) -> None:
        """Exchange the neighbouring cells of other ranks, and sort all near cells into bins (collective)."""
        self._comm = domain.comm
        centroids = domain.nodes[domain.cell_nodes].mean(axis=1)
        self._exchange = RankHalo(domain.comm, centroids, radius)
        volumes, numbers = domain.volumes[:, None], domain.input_numbering.cells[:, None].astype(float)
        near = self._exchange(np.hstack([centroids, volumes, numbers]))
        self._centres = _in_space(centroids)
        self._bins = _Bins(domain.comm, self._centres, _in_space(near[:, : domain.dim]), near[:, -1], radius, kernel)
        self._volumes = near[self._bins.order, -2]
        # Centres that follow one another in a tree lie close together.
        self._tree_order = cKDTree(centroids).indices.astype(np.int64)

    def __call__(self, values: Values, active: Flags | None = None) -> Values:
        """Average cell values (cells, n); inactive cells do not enter; 0 where no active cell is near (collective)."""
        near, volumes = self._sorted(values), self._active_volumes(active)
        averages = np.empty(values.shape)
        for first in range(0, values.shape[1], LIMITS.max_columns):
            columns = slice(first, first + LIMITS.max_columns)
            averages[self._tree_order, columns] = self._average(self._tree_order, near[:, columns], volumes)
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
        # The norm of an average is at most the average of the norms, one column instead of six, and no average exceeds
        # the largest norm of all ranks.
        bound *= 1 - LIMITS.bound_round_off
        if max_over_ranks(self._comm, float(np.max(norms, initial=0.0))) < bound:
            return np.empty(0, np.int64), np.empty((0, values.shape[1]))
        near, volumes = self._sorted(np.column_stack([norms, values])), self._active_volumes(active)
        cells = self._may_reach(near[:, 0], volumes, bound)
        if not len(cells):
            return cells, np.empty((0, values.shape[1]))
        averages = self._average(cells, near, volumes)
        reaches = np.flatnonzero(averages[:, 0] >= bound)
        order = reaches[np.argsort(cells[reaches])]
        return cells[order], averages[order, 1:]

    def _sorted(self, values: Values) -> Values:
        """Return the values (near, n) of near cells in the order of bins, of those of this rank (cells, n)."""
        return np.ascontiguousarray(self._exchange(values).take(self._bins.order, axis=0), float)

    def _active_volumes(self, active: Flags | None) -> Values:
        """Return the volumes (near,) of near cells in the order of bins, 0 where inactive."""
        return self._volumes if active is None else self._volumes * self._sorted(active[:, None].astype(float))[:, 0]

    def _may_reach(self, norms: Values, volumes: Values, bound: float) -> Ints:
        """Find the cells (m,) whose average of `norms` (near,) may reach `bound`, in single precision."""
        load = np.minimum(norms / bound, LIMITS.max_coarse)
        # An average is at most the largest load within the radius.
        is_near = self._bins.near_any((load >= 1) & (volumes > 0))
        if self._bins.are_coarse and is_near.any():
            is_near &= self._bins.may_reach_one(load, volumes)
        candidates = self._tree_order[is_near[self._tree_order]]
        relative = volumes / np.mean(volumes) if volumes.any() else volumes
        coarse = (relative * load).astype(np.float32)
        selected = np.empty(len(candidates), np.int64)
        centres = c_int64(len(candidates)), candidates, self._centres
        sums = relative.astype(np.float32), coarse, c_double(LIMITS.coarse_share)
        return selected[: _code().find_centres(self._bins.pointer, *centres, *sums, selected)]

    def _average(self, cells: Ints, near: Values, volumes: Values) -> Values:
        """Return the averages (m, n) of near values (near, n) around some cells (m,)."""
        near, result = np.ascontiguousarray(near), np.empty((len(cells), near.shape[1]))
        centres, width = (c_int64(len(cells)), cells, self._centres), c_int64(near.shape[1])
        _code().averages_around(self._bins.pointer, *centres, volumes, width, near, result)
        return result


@cache
def _code() -> CDLL:
    """Return the compiled functions of nonlocal_average.c."""
    return load_library(SOURCE, separate_rounding=True)


def _in_space(points: Values) -> Values:
    """Return points (n, 3) of points (n, d), with coordinates of 0 beyond d."""
    return np.ascontiguousarray(np.pad(points, ((0, 0), (0, 3 - points.shape[1]))))


class _Points(Structure):
    """Points in bins, in the layout of nonlocal_average.c."""

    _fields_ = (
        ("origin", Float64), ("bins", Int64), ("start", Int64), ("x", Float64), ("y", Float64), ("z", Float64),
        ("coarse", Float32), ("size", c_double), ("radius", c_double), ("slack", c_double), ("margin", c_double),
        ("points", c_int64), ("kernel", c_int64),
    )  # fmt: skip


class _Bins:
    """Points sorted into cubic bins that are the same on all ranks, so that sums over them are.

    Attributes:
        order: (points,) the points by bin, and in a bin by number.
        pointer: argument of the functions of nonlocal_average.c.
        are_coarse: whether there are fewer bins than points.
    """

    def __init__(
        self, comm: MPI.Intracomm, centres: Values, points: Values, numbers: Values, radius: float, kernel: str
    ) -> None:
        """Sort points (points, 3) with distinct numbers (points,): first the `centres` of this rank (collective)."""
        # Bins, and so sums, do not depend on the partition.
        low, high = np.empty(3), np.empty(3)
        comm.Allreduce(centres.min(axis=0, initial=np.inf), low, MPI.MIN)
        comm.Allreduce(centres.max(axis=0, initial=-np.inf), high, MPI.MAX)
        extent = (high - low)[high - low > LIMITS.least_extent * np.max(high - low)]
        spacing = (np.prod(extent) / comm.allreduce(len(centres))) ** (1 / max(len(extent), 1))
        size = max(radius / LIMITS.bins_per_radius, float(spacing) / LIMITS.bins_per_spacing)
        radius = max(radius, LIMITS.least_radius * size)
        bin_indices = np.floor((points - low) / size).astype(np.int64)
        first = bin_indices.min(axis=0) if len(points) else np.zeros(3, np.int64)
        bins = np.max(bin_indices - first, axis=0, initial=0) + 1
        x, y, z = (bin_indices - first).T
        bin_of = (z * bins[1] + y) * bins[0] + x
        self.order = np.lexsort([numbers, bin_of])
        self._shape: tuple[int, ...] = tuple(map(int, bins[::-1]))
        self.are_coarse = math.prod(self._shape) < len(points)
        self._bins_per_radius, self._kernel = radius / size, kernel
        self._bin_of_centre, self._bin_in_order = bin_of[: len(centres)], bin_of[self.order]
        self._reach = math.ceil(radius / size * (1 + LIMITS.bin_round_off))
        start = np.concatenate([[0], np.cumsum(np.bincount(bin_of, minlength=int(bins.prod())))])
        origin, sorted_points = low + first * size, points[self.order].T.copy()
        coarse = ((sorted_points - origin[:, None]) / radius).astype(np.float32)
        # Each coordinate is rounded to half a unit in the 24th binary digit, before and after the difference.
        margin = 2.0**-20 + float(np.max(coarse, initial=0.0)) * 2.0**-21
        # The C structure has addresses only: these references keep the arrays alive.
        self._arrays = origin, bins, start, *sorted_points, coarse
        sizes = size, radius, LIMITS.bin_round_off * size, margin, len(points), KERNELS.index(kernel)
        self._points = _Points(*map(struct_pointer, self._arrays), *sizes)
        self.pointer = byref(self._points)

    def near_any(self, flags: Flags) -> Flags:
        """Flag the centres (centres,) near flagged points (points,) in the order of bins: all within the radius."""
        marks = np.zeros(self._shape, bool)
        marks.ravel()[self._bin_in_order[flags]] = True
        for axis in range(3):
            marks = _any_within(marks, self._reach, axis)
        return np.asarray(marks.ravel()[self._bin_of_centre])

    def may_reach_one(self, load: Values, volumes: Values) -> Flags:
        """Flag the centres (centres,) around which the average of `load` (points,) may reach 1.

        It does where sum_k w_k V_k (load_k - 1) >= 0. In sums over bins positive terms take the weight of the smallest
        distance in two bins, negative ones that of the largest: an upper bound. A convolution gives it for all bins.
        """
        excess = volumes * (load - 1)
        shape, transforms = self._convolution
        parts = np.maximum(excess, 0.0), np.minimum(excess, 0.0)
        sums = (np.bincount(self._bin_in_order, part, math.prod(self._shape)).reshape(self._shape) for part in parts)
        total = sum(rfftn(part, shape) * weights for part, weights in zip(sums, transforms, strict=True))
        bounds = irfftn(total, shape)[tuple(slice(self._reach, self._reach + count) for count in self._shape)]
        round_off = LIMITS.bound_round_off * float(volumes @ (1 + load))
        return np.asarray(bounds.ravel()[self._bin_of_centre] >= -round_off)

    @cached_property
    def _convolution(self) -> tuple[list[int], list[npt.NDArray[np.complex128]]]:
        """Shape of a convolution with weights between bins, and transforms of the largest and the smallest weights."""
        away = np.abs(np.arange(-self._reach, self._reach + 1))
        shape = [next_fast_len(count + 2 * self._reach, real=True) for count in self._shape]
        transforms = []
        slack = LIMITS.bin_round_off
        for steps in (np.maximum(away - 1 - slack, 0.0), away + 1 + slack):
            squares = np.square(steps / self._bins_per_radius)
            q = np.sqrt(squares[:, None, None] + squares[:, None] + squares)
            transforms.append(rfftn(_weights(self._kernel, q), shape))
        return shape, transforms


def _weights(kernel: str, q: Values) -> Values:
    """Weights at distances over the radius."""
    shape = {"linear": 1 - q, "constant": np.ones_like(q), "gaussian": np.exp(-4.5 * q**2)}[kernel]
    return np.where(q <= 1, shape, 0.0)


def _any_within(marks: Flags, reach: int, axis: int) -> Flags:
    """Return whether any of the marks (...) up to `reach` entries away along an axis is set."""
    count = marks.shape[axis]
    reach = min(reach, count - 1)
    lines = np.zeros((count + 2 * reach, *np.delete(marks.shape, axis)), bool)
    lines[reach : reach + count] = np.moveaxis(marks, axis, 0)
    # Entry i has those of i to i + width - 1.
    width = 1
    while width < 2 * reach + 1:
        shift = min(width, 2 * reach + 1 - width)
        lines[:-shift] |= lines[shift:]
        width += shift
    return np.moveaxis(lines[:count], 0, axis)


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
        nodes = self._domain.cell_nodes
        return np.asarray(sum_at_nodes(self._domain, nodes, values)[nodes].sum(axis=1))
