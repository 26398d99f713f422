"""Non-local average over cells: a sparse matrix with one row per owned cell, exact across rank boundaries.

    <s>_c = sum_k w_ck s_k / sum_k w_ck,   w_ck = V_k g(|X_k - X_c| / R),   |X_k - X_c| <= R

with reference centroids X and volumes V (M22 eq. 13). Built once; a rank holds copies of the cells of other ranks
within R of its own. Where all rows would take gigabytes (fine meshes: the weights of a radius grow as h^-6), a row is
made when a stress near it first reaches the strength.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from ..mesh.domain import Domain
from ..mesh.halo import Halo

Values = npt.NDArray[np.float64]

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
        self._exchange = Halo(domain.comm, centroids, radius)
        near = self._exchange(centroids)
        volumes = self._exchange(domain.volumes[:, None])[:, 0]
        order = np.argsort(self._exchange(domain.cell_input[:, None].astype(float))[:, 0], kind="stable")
        self._rows = _Rows(centroids, near[order], volumes[order], order, radius, kernel)

    def __call__(self, values: Values, active: npt.NDArray[np.bool_] | None = None) -> Values:
        """Averages (cells, n) of cell values (cells, n); cells not `active` enter none. 0 where none is left."""
        self._rows.make_all()
        n = values.shape[1]
        if active is not None:
            values = np.column_stack([np.where(active[:, None], values, 0.0), active])
        near = self._exchange(values)
        averages = np.zeros((len(values), n))
        for cells, weights, full in self._rows.made:
            sums = weights @ near
            weight = full[:, None] if active is None else sums[:, -1:]
            averages[cells] = np.divide(sums[:, :n], weight, out=np.zeros((len(cells), n)), where=weight > 0)
        return averages

    def reaching(
        self, values: Values, size: Values, bound: float, active: npt.NDArray[np.bool_] | None = None
    ) -> tuple[npt.NDArray[np.int64], Values]:
        """(m,) cells whose average may reach `bound` in size, and those averages (m, n) (collective).

        `size` (cells,) is a norm of `values`: the norm of an average is at most the average of norms, which takes one
        column where the values have six. `values` and `size` are 0 on cells that are not active.
        """
        n = values.shape[1]
        if self._comm.allreduce(float(np.max(size, initial=0.0)), op=MPI.MAX) < bound:
            return np.empty(0, np.int64), np.empty((0, n))
        near, pull = self._exchange(values), self._exchange(size[:, None])[:, 0]
        # hairs below the bound: the sums are rounded
        self._rows.make(pull >= bound * (1 - 1e-9))
        weighing = self._rows.sums(None if active is None else self._exchange(active[:, None].astype(float))[:, 0])
        found: list[npt.NDArray[np.int64]] = [np.empty(0, np.int64)]
        averages: list[Values] = [np.empty((0, n))]
        for (cells, weights, _), weight in zip(self._rows.made, weighing, strict=True):
            rows = np.flatnonzero((weights @ pull >= bound * (1 - 1e-12) * weight) & (weight > 0))
            found.append(cells[rows])
            averages.append(np.asarray(weights[rows] @ near) / weight[rows, None])
        order = np.argsort(np.concatenate(found))
        return np.concatenate(found)[order], np.concatenate(averages)[order]


class _Rows:
    """Weights of near cells around `centres`: all of them at once, or row by row where they would be too many.

    Each row has its weights in the order of the input mesh: the same order of summation at any rank count.

    Attributes:
        made: (centres, their rows, sums of those), one block after the other. They are never joined: that would take
            their memory once more.
    """

    def __init__(
        self, centres: Values, near: Values, volumes: Values, places: npt.NDArray[np.int64], radius: float, kernel: str
    ) -> None:
        """`near`, `volumes`: centroids and volumes of near cells in that order, `places` (near,) where values have
        them."""
        self._places = places
        self._centres, self._near, self._volumes, self._radius, self._kernel = centres, near, volumes, radius, kernel
        self._tree = cKDTree(near)
        self._missing = np.ones(len(centres), bool)
        self.made: list[tuple[npt.NDArray[np.int64], csr_matrix, Values]] = []
        self._active: Values = np.empty(0)
        self._sums: list[Values] = []
        if self._expected() <= AT_ONCE:
            self.make_all()

    def _expected(self) -> float:
        """About how many weights there are."""
        every = max(len(self._centres) // SAMPLED, 1)
        counts = self._tree.query_ball_point(self._centres[::every], self._radius, return_length=True)
        return float(np.sum(counts)) * every

    def make(self, hot: npt.NDArray[np.bool_]) -> None:
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
        """Sums of the weights of near cells with 1 in `active` (near,), of each block `made`; None: of all. They are
        kept until others are active."""
        if active is None:
            return [full for *_, full in self.made]
        if not np.array_equal(active, self._active):
            self._active, self._sums = active, []
        self._sums += [weights @ self._active for _, weights, _ in self.made[len(self._sums) :]]
        return self._sums

    def _add(self, cells: npt.NDArray[np.int64]) -> None:
        for start in range(0, len(cells), CHUNK):
            part = cells[start : start + CHUNK]
            pairs = cKDTree(self._centres[part]).sparse_distance_matrix(
                self._tree, self._radius, output_type="coo_matrix"
            )
            weights = self._volumes[pairs.col] * KERNELS[self._kernel](pairs.data / self._radius)
            rows = csr_matrix((weights, (pairs.row, pairs.col)), shape=(len(part), len(self._near)))
            rows.sort_indices()
            rows.indices = self._places[rows.indices].astype(rows.indices.dtype)
            rows.has_sorted_indices = False
            self.made.append((part, rows, np.asarray(rows.sum(axis=1))[:, 0]))
        self._missing[cells] = False
