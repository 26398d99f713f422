"""A level of multigrid's cycle (vcycle) in single precision, and how it is smoothed.

Chebyshev's polynomial (first kind) of B A', within shares of the largest eigenvalue, B: the inverses of a node's blocks
on the diagonal of A' (block Jacobi; PETSc goes by single entries). Where cells are all but flat a node is held in one
direction alone, which is along no axis: with single entries the largest eigenvalue is 6 to 9 for the sake of a few
nodes, not 4.3, and all others are smoothed for that. A jelly and a doormat that tear take three quarters of the
iterations.
"""

from __future__ import annotations

from ctypes import CDLL
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt

from ...mesh.parallel import sum_over_ranks
from .bcsr import BlockCSR, BlockDiagonal, GhostedVector
from .hierarchy import BlockCSRData, LevelData

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ...mechanics.block_matrix import TieMatrix

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Single = npt.NDArray[np.float32]

LOOKS = 10  # products that tell how large an eigenvalue gets
HIGH = 1.1  # of that: as far as it is smoothed


class SmoothingParameters(NamedTuple):
    """What is done with a level.

    Attributes:
        steps: of smoothing, before and after.    low: of the largest eigenvalue, down to which it is smoothed.
        cycles: from there down, each time.
    """

    steps: int
    lower_bound: float
    cycles: int = 1


DEFAULT_SMOOTHING = SmoothingParameters(2, 0.1)  # as PETSc has it


class SmoothedLevel:
    """One that is smoothed.

    Attributes:
        b, x: right-hand side and solution, scaled.    left: b - A x.    scale: S, of ghosts, too.
        beside: what is added to the blocks of A.    effort: what is done with it.
    """

    def __init__(self, copy: LevelData, own: BlockCSRData, made: CDLL) -> None:
        """`own`: where the blocks of A are, which it has yet to `take`."""
        nodes, size = copy.nodes, copy.size
        large = np.abs(copy.diagonal)
        self.scale: Values = 1 / np.sqrt(np.where(large > 0, large, 1.0))
        self._comm, self._owned, self._size = nodes.comm, nodes.size_local * size, size
        self.extra_terms: list[TieMatrix] = []
        self._rows = BlockCSR(made, size, own.starts, own.columns)
        self._inverse = BlockDiagonal(made, size, nodes.size_local)
        self.b, self.x, self.residual, self._d, self._to = (GhostedVector(nodes, size) for _ in range(5))
        self._so_far = GhostedVector(nodes, size) if copy.matrix else None
        self.smoothing = DEFAULT_SMOOTHING
        self._row = np.repeat(np.arange(nodes.size_local), np.diff(own.starts))
        self._on_diagonal = np.flatnonzero(own.columns == self._row)

    def assign_values(self, values: Values) -> None:
        """Those of the blocks of A, as many as at first, and smooth for what they are (collective)."""
        self._rows.assign_scaled(values, self.scale, self.scale)
        self._inverse.assign_inverse(self._diagonal())
        self._most = self._largest()
        self.set_smoothing(self.smoothing)

    def set_smoothing(self, effort: SmoothingParameters) -> None:
        """Do so much with it."""
        self.smoothing, self._weights = effort, chebyshev(self._most, effort.steps, effort.lower_bound)

    def _diagonal(self) -> Single:
        """(owned nodes, size, size) blocks of A' with what is beside them."""
        D = np.zeros_like(self._inverse.blocks)
        D[self._row[self._on_diagonal]] = self._rows.blocks[self._on_diagonal].reshape(-1, *D.shape[1:])
        for each in self.extra_terms:
            axes = np.arange(self._size)
            D[each.nodes[:, None], axes, axes] += each.diagonal * self._scale_at(each.nodes) ** 2
        return D

    def _largest(self) -> float:
        """About the largest eigenvalue of B A', from below, by Lanczos' method in the norm of B; 1 at least, as B's
        blocks say (collective)."""
        b, x, n = self.b.array, self.x.array, self._owned
        self.set_random_rhs()
        before = np.zeros(n, np.float32)
        diagonal: list[float] = []
        beside: list[float] = []
        for _ in range(LOOKS):
            self._inverse.first_step(1.0, self.b, self._d, self.x)
            beside.append(float(np.sqrt(sum_over_ranks(self._comm, np.vdot(b[:n], x[:n]))[0])))
            if beside[-1] < 1e-5:  # of round-off
                break
            x[:n] /= np.float32(beside[-1])
            now = b[:n] / np.float32(beside[-1])
            self._multiply()
            b[:n] = self.residual.array[:n]
            if diagonal:
                b[:n] -= np.float32(beside[-1]) * before
            diagonal.append(float(sum_over_ranks(self._comm, np.vdot(b[:n], x[:n]))[0]))
            b[:n] -= np.float32(diagonal[-1]) * now
            before = now
        off = beside[1 : len(diagonal)]
        T = np.diag(diagonal) + np.diag(off, 1) + np.diag(off, -1)
        return max(float(np.linalg.eigvalsh(T)[-1]), 1.0)

    def set_random_rhs(self) -> None:
        """b."""
        self.b.array[: self._owned] = np.random.default_rng(self._comm.rank).uniform(-1.0, 1.0, self._owned)

    def rhs_norm(self) -> float:
        """|b| (collective)."""
        own = self.b.array[: self._owned]
        return float(np.sqrt(sum_over_ranks(self._comm, np.vdot(own, own))[0]))

    def _multiply(self) -> None:
        """left = A' x (collective)."""
        self.x.update_ghosts()
        self.residual.array[: self._owned] = 0.0
        self._rows.add_product(self.x, self.residual)
        for nodes, product in self._beside():
            self._by_nodes(self.residual)[nodes] += product

    def _residual(self) -> None:
        self.x.update_ghosts()
        self._rows.compute_residual(self.b, self.x, self.residual)
        for nodes, product in self._beside():
            self._by_nodes(self.residual)[nodes] -= product

    def _beside(self) -> Iterator[tuple[Ints, Values]]:
        """Nodes, and the product of x with what is beside the blocks there."""
        for each in self.extra_terms:
            scale = self._scale_at(each.nodes)
            yield each.nodes, scale * each.multiply(scale * self._by_nodes(self.x)[each.nodes])

    def _scale_at(self, nodes: Ints) -> Values:
        return self.scale[: self._owned].reshape(-1, self._size)[nodes]

    def _by_nodes(self, vector: GhostedVector) -> npt.NDArray[np.float32]:
        return vector.array[: self._owned].reshape(-1, self._size)

    def pre_smooth(self) -> None:
        """Smooth from 0, and what is left (collective)."""
        self._inverse.first_step(self._weights[0][1], self.b, self._d, self.x)
        self._smooth(self._weights[1:])
        self._residual()

    def post_smooth(self) -> None:
        """Smooth from x (collective)."""
        self._smooth(self._weights)

    def restart_from_residual(self) -> None:
        """Be of what is left, and keep x for it (collective)."""
        assert self._so_far is not None
        self._residual()
        self.b, self.residual = self.residual, self.b
        self.x, self._so_far = self._so_far, self.x

    def add_previous_cycle(self) -> None:
        """x is both together (not of ghosts)."""
        assert self._so_far is not None
        self.x.array[: self._owned] += self._so_far.array[: self._owned]

    def _smooth(self, weights: list[tuple[float, float]]) -> None:
        for keep, take in weights:
            self.x.update_ghosts()
            self._rows.smoothing_step(self._inverse, keep, take, self.b, self.x, self._d, self._to)
            for nodes, product in self._beside():
                step = take * np.einsum("nij,nj->ni", self._inverse.blocks[nodes], product)
                for each in (self._d, self._to):
                    self._by_nodes(each)[nodes] -= step
            self.x, self._to = self._to, self.x


def chebyshev(largest: float, steps: int, low: float) -> list[tuple[float, float]]:
    """The weights of d and of B r in each step d <- keep d + take B r, x <- x + d (Saad 2003, 12.1), from `low` to HIGH
    of the largest eigenvalue."""
    middle, half = (HIGH + low) / 2 * largest, (HIGH - low) / 2 * largest
    rho, weights = half / middle, [(0.0, 1 / middle)]
    for _ in range(steps - 1):
        last, rho = rho, 1 / (2 * middle / half - rho)
        weights.append((rho * last, 2 * rho / half))
    return weights
