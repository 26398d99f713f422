"""Non-local average over cells: a sparse matrix with one row per owned cell, exact across rank boundaries.

    <s>_c = sum_k w_ck s_k / sum_k w_ck,   w_ck = V_k g(|X_k - X_c| / R),   |X_k - X_c| <= R

with reference centroids X and volumes V (M22 eq. 13). Built once; a rank holds copies of the cells of other ranks
within R of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from .domain import Domain

Values = npt.NDArray[np.float64]

KERNELS: dict[str, Callable[[Values], Values]] = {
    "linear": lambda q: 1 - q,
    "constant": np.ones_like,
    # three standard deviations fit in the radius; what lies outside (1 %) is cut off
    "gaussian": lambda q: np.exp(-4.5 * q**2),
}


class NonlocalAverage:
    """The averaging matrix of a mesh for one radius (m) and kernel."""

    def __init__(self, domain: Domain, radius: float, kernel: str) -> None:
        self._comm = domain.comm
        centroids = domain.nodes[domain.cell_nodes].mean(axis=1)
        self._exchange = _Halo(domain.comm, centroids, radius)
        near = self._exchange(centroids)
        volumes = self._exchange(domain.volumes[:, None])[:, 0]
        # the same order of summation at any rank count
        order = np.argsort(self._exchange(domain.cell_input[:, None].astype(float))[:, 0], kind="stable")
        self._order = order
        self._weights = _weights(centroids, near[order], volumes[order], radius, kernel)
        self._full = np.asarray(self._weights.sum(axis=1))

    def __call__(self, values: Values, active: npt.NDArray[np.bool_] | None = None) -> Values:
        """Averages (cells, n) of cell values (cells, n); cells not `active` enter none. 0 where none is left."""
        if active is None:
            return (self._weights @ self._exchange(values)[self._order]) / self._full
        counted = np.column_stack([np.where(active[:, None], values, 0.0), active])
        sums = self._weights @ self._exchange(counted)[self._order]
        weight = sums[:, -1:]
        return np.divide(sums[:, :-1], weight, out=np.zeros_like(sums[:, :-1]), where=weight > 0)

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
        columns = [values, size[:, None]] + ([active[:, None]] if active is not None else [])
        near = self._exchange(np.hstack(columns))[self._order]
        weight = self._full[:, 0] if active is None else self._weights @ near[:, -1]
        # a hair below the bound: the sums are rounded
        rows = np.flatnonzero((self._weights @ near[:, n] >= bound * (1 - 1e-12) * weight) & (weight > 0))
        return rows, np.asarray(self._weights[rows] @ near[:, :n]) / weight[rows, None]

    @property
    def entries(self) -> int:
        """Stored weights on this rank."""
        return int(self._weights.nnz)


def _weights(centres: Values, near: Values, volumes: Values, radius: float, kernel: str) -> csr_matrix:
    """Weights of `near` cells around `centres`. Where the kernel vanishes on all of them, the cell alone counts."""
    shape = (len(centres), len(near))
    if not len(centres):
        return csr_matrix(shape)
    pairs = cKDTree(centres).sparse_distance_matrix(cKDTree(near), radius, output_type="coo_matrix")
    weights = volumes[pairs.col] * KERNELS[kernel](pairs.data / radius)
    result = csr_matrix((weights, (pairs.row, pairs.col)), shape=shape)
    result.sort_indices()
    return result


class _Halo:
    """Brings rows of the cells within a distance of this rank's cells: first its own, then those of other ranks."""

    def __init__(self, comm: MPI.Comm, centroids: Values, distance: float) -> None:
        self.comm = comm
        self._send: list[npt.NDArray[np.int64]] = [np.empty(0, np.int64)] * comm.size
        if comm.size == 1:
            return
        d = centroids.shape[1]
        empty = np.full((2, d), np.inf) * [[1], [-1]]
        box = np.array([centroids.min(axis=0), centroids.max(axis=0)]) if len(centroids) else empty
        boxes = comm.allgather(box)
        for rank, (low, high) in enumerate(boxes):
            if rank != comm.rank:
                close = np.all((centroids >= low - distance) & (centroids <= high + distance), axis=1)
                self._send[rank] = np.flatnonzero(close).astype(np.int64)
        sent = np.array([len(part) for part in self._send], np.int64)
        received = np.empty_like(sent)
        comm.Alltoall(sent, received)
        self._sent, self._received = sent, received
        self._rows = np.concatenate(self._send)

    def __call__(self, values: Values) -> Values:
        """(cells, n) rows -> (cells + halo, n) rows."""
        if self.comm.size == 1:
            return values
        width = values.shape[1]
        send = np.ascontiguousarray(values[self._rows], float)
        arrived = np.empty((int(self._received.sum()), width))
        here: Any = (send, self._sent * width)
        there: Any = (arrived, self._received * width)
        self.comm.Alltoallv(here, there)
        return np.concatenate([values, arrived])
