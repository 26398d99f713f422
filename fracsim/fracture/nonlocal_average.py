"""Non-local average over cells: a sparse matrix with one row per owned cell, exact across rank boundaries.

    <s>_c = sum_k w_ck s_k / sum_k w_ck,   w_ck = V_k g(|X_k - X_c| / R),   |X_k - X_c| <= R

with reference centroids X and volumes V (M22 eq. 13). Built once; a rank holds copies of the cells of other ranks
within R of its own. Where all rows would take gigabytes (fine meshes: the weights of a radius grow as h^-6), a row is
made when a stress near it first reaches the strength. In a pass few cells pull as hard as the bound that is asked for,
and fewer have come apart since the last one: only rows near these are looked at.

Equations: docs/theory.md#edge-criterion.
"""

from __future__ import annotations

from collections.abc import Callable
from ctypes import CDLL, Structure, byref, c_double, c_int64
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
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
    # three standard deviations fit in the radius; what lies outside (1 %) is cut off
    "gaussian": lambda q: np.exp(-4.5 * q**2),
}

AT_ONCE = 5e7  # weights that a rank makes before the first step: 0.6 GB
CHUNK = 20_000  # rows made at a time: on the way a distance takes thrice the memory of a weight
SAMPLED = 1_000  # rows that are counted for that


class NonlocalAverage:
    """The averaging matrix of a mesh for one radius (m) and kernel."""

    def __init__(self, domain: Domain, radius: float, kernel: str) -> None:
        self._comm = domain.comm
        centroids = domain.nodes[domain.cell_nodes].mean(axis=1)
        self._exchange = RankHalo(domain.comm, centroids, radius)
        near = self._exchange(centroids)
        volumes = self._exchange(domain.volumes[:, None])[:, 0]
        order = np.argsort(self._exchange(domain.cell_input[:, None].astype(float))[:, 0], kind="stable")
        self._rows = _AllRows(centroids, near[order], volumes[order], order, radius, kernel)

    def __call__(self, values: Values, active: Flags | None = None) -> Values:
        """Averages (cells, n) of cell values (cells, n); cells not `active` enter none. 0 where none is left."""
        self._rows.make_all()
        n = values.shape[1]
        if active is not None:
            values = np.column_stack([np.where(active[:, None], values, 0.0), active])
        near = self._exchange(values)
        averages = np.zeros((len(values), n))
        for rows in self._rows.made:
            sums = rows.times(near)
            weight = rows.full[:, None] if active is None else sums[:, -1:]
            averages[rows.cells] = np.divide(sums[:, :n], weight, out=np.zeros((len(sums), n)), where=weight > 0)
        return averages

    def reaching(self, values: Values, size: Values, bound: float, active: Flags | None = None) -> tuple[Ints, Values]:
        """(m,) cells whose average may reach `bound` in size, and those averages (m, n) (collective).

        `size` (cells,) is a norm of `values`: the norm of an average is at most the average of norms, which takes one
        column where the values have six. `values` and `size` are 0 on cells that are not active.
        """
        n = values.shape[1]
        if max_over_ranks(self._comm, float(np.max(size, initial=0.0))) < bound:
            return np.empty(0, np.int64), np.empty((0, n))
        near, pull = self._exchange(values), self._exchange(size[:, None])[:, 0]
        hot = pull >= bound * (1 - 1e-9)  # hairs below the bound: the sums are rounded
        self._rows.make(hot)
        may = self._rows.around(hot)
        weighing = self._rows.sums(None if active is None else self._exchange(active[:, None].astype(float)))
        blocks = [
            rows.reaching(may, pull, weight, bound * (1 - 1e-12), near)
            for rows, weight in zip(self._rows.made, weighing, strict=True)
        ]
        found = np.concatenate([np.empty(0, np.int64), *(cells for cells, _ in blocks)])
        averages = np.concatenate([np.empty((0, n)), *(averages for _, averages in blocks)])
        order = np.argsort(found)
        return found[order], averages[order]


class _Given(Structure):
    """As nonlocal_average.c has it."""

    _fields_ = (("start", Int32), ("place", Int32), ("weight", Float64))


@cache
def _code() -> CDLL:
    return load_library(SOURCE, separate_rounding=True)


class _Rows:
    """Rows of the weights of near cells around some cells.

    Attributes:
        cells: (n,) they.    full: (n,) sums of their weights.
    """

    def __init__(self, cells: Ints, weights: csr_matrix) -> None:
        """`weights`: (n, near)."""
        self.cells, self.full = cells, np.asarray(weights.sum(axis=1))[:, 0]
        self._kept = np.asarray(weights.indptr, np.int32), np.asarray(weights.indices, np.int32), weights.data
        self._given = _Given(*map(struct_pointer, self._kept))
        self._all = np.arange(len(cells))

    def reaching(self, may: Flags, pull: Values, weight: Values, bound: float, values: Values) -> tuple[Ints, Values]:
        """(m,) cells, of those that `may` (own cells,), whose average of `pull` (near,) reaches a bound, and their
        averages (m, k) of values (near, k); `weight`: (n,) sums of weights."""
        width, count = values.shape[1], len(self.cells)
        found, averages = np.empty(count, np.int64), np.empty((count, width))
        given = self.cells, may, np.ascontiguousarray(pull), weight, c_double(bound)
        told = c_int64(width), np.ascontiguousarray(values), found, averages
        many = _code().reaching(byref(self._given), c_int64(count), *given, *told)
        return found[:many], averages[:many]

    def mark(self, places: Flags, marks: Flags) -> None:
        """Mark those near (near,) the own cells that are among some `places` (near,)."""
        sizes = c_int64(len(self.cells)), self.cells
        _code().mark(byref(self._given), *sizes, places, marks)

    def times(self, values: Values, some: Ints | None = None) -> Values:
        """(n, k) sums over the weights of near values (near, k), of all rows or of some of them."""
        some = self._all if some is None else some
        found, values = np.empty((len(some), values.shape[1])), np.ascontiguousarray(values)
        sizes = c_int64(len(some)), some, c_int64(values.shape[1])
        _code().times(byref(self._given), *sizes, values, found)
        return found


class _AllRows:
    """Weights of near cells around `centres`: all of them at once, or row by row where they would be too many.

    Each row has its weights in the order of the input mesh: the same order of summation at any rank count.

    Attributes:
        made: one block after the other. They are never joined: that would take their memory once more.
    """

    def __init__(
        self, centres: Values, near: Values, volumes: Values, places: Ints, radius: float, kernel: str
    ) -> None:
        """`near`, `volumes`: centroids and volumes of near cells in that order, `places` (near,) where values have
        them, the centres first."""
        self._places = places
        self._centres, self._near, self._volumes, self._radius, self._kernel = centres, near, volumes, radius, kernel
        self._tree = cKDTree(near)
        self._missing = np.ones(len(centres), bool)
        self._border = np.zeros(len(centres), bool)  # with cells of other ranks within the radius
        self.made: list[_Rows] = []
        self._active: Values = np.ones((len(near), 1))
        self._sums: list[Values] = []
        if self._expected() <= AT_ONCE:
            self.make_all()

    def _expected(self) -> float:
        """About how many weights there are."""
        every = max(len(self._centres) // SAMPLED, 1)
        counts = self._tree.query_ball_point(self._centres[::every], self._radius, return_length=True)
        return float(np.sum(counts)) * every

    def around(self, places: Flags) -> Flags:
        """(centres,) which of those that have rows may have any of some near cells (near,) within the radius: what is
        near one of them it is near to. Own cells among these are to have rows.

        Two cells that are R apart to the last digit may be near for one of them alone, which counts where the kernel
        does not end at 0 there.
        """
        count, marks = len(self._centres), np.zeros(len(places), bool)
        if KERNELS[self._kernel](np.ones(1))[0]:
            return ~marks[:count]
        for rows in self.made:
            rows.mark(places, marks)
        return marks[:count] | self._border if places[count:].any() else marks[:count]

    def make(self, hot: Flags) -> None:
        """See that there are rows of all centres with a `hot` near cell within the radius."""
        if not self._missing.any() or not hot.any():
            return
        centres, points, reach = self._centres, self._near[hot[self._places]], self._radius * (1 + 1e-9)
        close = np.all((centres >= points.min(axis=0) - reach) & (centres <= points.max(axis=0) + reach), axis=1)
        cells = np.flatnonzero(self._missing & close)
        distance, _ = cKDTree(points).query(centres[cells], distance_upper_bound=reach)
        self._add(cells[np.isfinite(distance)])

    def make_all(self) -> None:
        """See that there are rows of all centres."""
        self._add(np.flatnonzero(self._missing))

    def sums(self, active: Values | None) -> list[Values]:
        """Sums of the weights of near cells with 1 in `active` (near, 1), of each block `made`; None: of all."""
        if active is None:
            return [rows.full for rows in self.made]
        changed, self._active = (active != self._active)[:, 0], active
        if changed.any() and self._missing.any():  # what has changed may be near rows and have none itself
            self._sums = []
        elif changed.any():
            near = self.around(changed)
            for rows, sums in zip(self.made, self._sums, strict=False):
                some = np.flatnonzero(near[rows.cells])
                sums[some] = rows.times(active, some)[:, 0]
        self._sums += [rows.times(active)[:, 0] for rows in self.made[len(self._sums) :]]
        return self._sums

    def _add(self, cells: Ints) -> None:
        for start in range(0, len(cells), CHUNK):
            part = cells[start : start + CHUNK]
            pairs = cKDTree(self._centres[part]).sparse_distance_matrix(
                self._tree, self._radius, output_type="coo_matrix"
            )
            weights = self._volumes[pairs.col] * KERNELS[self._kernel](pairs.data / self._radius)
            self._border[part[pairs.row[self._places[pairs.col] >= len(self._centres)]]] = True
            rows = csr_matrix((weights, (pairs.row, pairs.col)), shape=(len(part), len(self._near)))
            rows.sort_indices()
            rows.indices = self._places[rows.indices].astype(rows.indices.dtype)
            rows.has_sorted_indices = False
            self.made.append(_Rows(part, rows))
        self._missing[cells] = False
