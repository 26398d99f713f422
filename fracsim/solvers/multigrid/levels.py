"""Levels of the V cycle in single precision, with their smoother.

The smoother is Chebyshev's polynomial (first kind) of B A' on a range below its largest eigenvalue. B has the inverses
of the diagonal node blocks of A'. At almost flat cells a node is stiff in one direction, along no axis: the largest
eigenvalue is 6 to 9 with Jacobi's smoother by single entries, 4.3 with block Jacobi.

Equations: docs/theory.md#linear-systems.
"""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import CDLL
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from ...mesh.parallel import sum_over_ranks
from ..policy import DEFAULT_POLICY, SolverPolicy
from .bcsr import BlockCSR, BlockDiagonal, GhostedVector
from .hierarchy import BlockCSRData, LevelData

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ...mechanics.block_matrix import NodeCoupling

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Single = npt.NDArray[np.float32]


class SmoothingParameters(NamedTuple):
    """Amount of smoothing on a level.

    Attributes:
        steps: degree of the polynomial, before and after the coarser levels.
        lower_bound: share of the largest eigenvalue above which errors are smoothed.
        cycles: number of cycles through the coarser levels.
    """

    steps: int
    lower_bound: float
    cycles: int = 1


class SmoothedLevel:
    """A level with a smoother.

    Its matrix is A' = S A S, S = diag(A)^(-1/2) of the set-up, so that its entries are about 1.

    Attributes:
        b: scaled right-hand side.
        x: scaled solution.
        residual: b - A' x.
        scale: (dofs with ghosts,) S.
        couplings: stiffness between nodes anywhere that is added to the blocks of A.
        smoothing: amount of smoothing.
    """

    def __init__(
        self, data: LevelData, pattern: BlockCSRData, code: CDLL, policy: SolverPolicy = DEFAULT_POLICY
    ) -> None:
        """Allocate the level.

        Args:
            data: the level of PETSc's multigrid.
            pattern: pattern of A, whose values `assign_values` assigns.
            code: of `compile_block_csr`.
            policy: tuned numbers.
        """
        nodes, size = data.nodes, data.size
        self.scale = data.scale
        self._comm, self._owned, self._size, self._policy = nodes.comm, nodes.size_local * size, size, policy
        self.couplings: Sequence[NodeCoupling] = ()
        self._matrix = BlockCSR(code, size, pattern.starts, pattern.columns)
        self._inverse = BlockDiagonal(code, size, nodes.size_local)
        self.b, self.x, self.residual, self._direction, self._next_x = (GhostedVector(nodes, size) for _ in range(5))
        self._previous_x = GhostedVector(nodes, size) if data.matrix else None
        self.smoothing = SmoothingParameters(2, 0.1)  # defaults of PETSc's multigrid
        row = np.repeat(np.arange(nodes.size_local, dtype=np.int32), np.diff(pattern.starts))
        # Blocks on the diagonal, and their rows.
        self._on_diagonal = np.flatnonzero(pattern.columns == row)
        self._diagonal_row = row[self._on_diagonal]

    def assign_values(self, values: Values, couplings: Sequence[NodeCoupling] = ()) -> None:
        """Assign the blocks (blocks, size^2) of A and its couplings, and set up the smoother (collective)."""
        self.couplings = couplings
        self._matrix.assign_scaled(values, self.scale, self.scale)
        self._inverse.assign_inverse(self._diagonal_blocks())
        self._largest_eigenvalue = self._estimate_largest_eigenvalue()
        self.set_smoothing(self.smoothing)

    def set_smoothing(self, smoothing: SmoothingParameters) -> None:
        """Set the amount of smoothing."""
        self.smoothing = smoothing
        upper = self._policy.chebyshev_upper
        self._weights = chebyshev(self._largest_eigenvalue, smoothing.steps, smoothing.lower_bound, upper)

    def _diagonal_blocks(self) -> Single:
        """Return the diagonal blocks of A' with the couplings, (owned nodes, size, size)."""
        D = np.zeros_like(self._inverse.blocks)
        D[self._diagonal_row] = self._matrix.blocks[self._on_diagonal].reshape(-1, *D.shape[1:])
        for coupling in self.couplings:
            scale = self._scale_at(coupling.nodes)
            D[coupling.nodes] += coupling.diagonal_blocks * (scale[:, :, None] * scale[:, None, :])
        return D

    def _estimate_largest_eigenvalue(self) -> float:
        """Estimate the largest eigenvalue of B A' from below by Lanczos' method in the norm of B (collective)."""
        b, x, n = self.b.array, self.x.array, self._owned
        self.set_random_rhs()
        last_vector = np.zeros(n, np.float32)
        diagonal: list[float] = []
        off_diagonal: list[float] = []
        for _ in range(self._policy.lanczos_products):
            self._inverse.first_step(1.0, self.b, self._direction, self.x)
            off_diagonal.append(float(np.sqrt(sum_over_ranks(self._comm, np.vdot(b[:n], x[:n]))[0])))
            # Below round-off in single precision.
            if off_diagonal[-1] < 1e-5:
                break
            x[:n] /= np.float32(off_diagonal[-1])
            vector = b[:n] / np.float32(off_diagonal[-1])
            self._multiply()
            b[:n] = self.residual.array[:n]
            if diagonal:
                b[:n] -= np.float32(off_diagonal[-1]) * last_vector
            diagonal.append(float(sum_over_ranks(self._comm, np.vdot(b[:n], x[:n]))[0]))
            b[:n] -= np.float32(diagonal[-1]) * vector
            last_vector = vector
        off_diagonal = off_diagonal[1 : len(diagonal)]
        T = np.diag(diagonal) + np.diag(off_diagonal, 1) + np.diag(off_diagonal, -1)
        # The diagonal blocks alone give 1.
        return max(float(np.linalg.eigvalsh(T)[-1]), 1.0)

    def set_random_rhs(self) -> None:
        """Assign random numbers to b, the same in every run on as many ranks."""
        self.b.array[: self._owned] = np.random.default_rng(self._comm.rank).uniform(-1.0, 1.0, self._owned)

    def rhs_norm(self) -> float:
        """Return |b| (collective)."""
        owned = self.b.array[: self._owned]
        return float(np.sqrt(sum_over_ranks(self._comm, np.vdot(owned, owned))[0]))

    def _multiply(self) -> None:
        """Compute residual = A' x (collective)."""
        self.x.update_ghosts()
        self.residual.array[: self._owned] = 0.0
        self._matrix.add_product(self.x, self.residual)
        for nodes, product in self._coupling_products():
            self._by_nodes(self.residual)[nodes] += product

    def _compute_residual(self) -> None:
        """Compute residual = b - A' x (collective)."""
        self.x.update_ghosts()
        self._matrix.compute_residual(self.b, self.x, self.residual)
        for nodes, product in self._coupling_products():
            self._by_nodes(self.residual)[nodes] -= product

    def _coupling_products(self) -> Iterator[tuple[Ints, Values]]:
        """Yield the nodes of each coupling, and its product with x."""
        for coupling in self.couplings:
            scale = self._scale_at(coupling.nodes)
            yield coupling.nodes, scale * coupling.multiply(scale * self._by_nodes(self.x)[coupling.nodes])

    def _scale_at(self, nodes: Ints) -> Values:
        """Return S at nodes, (n, size)."""
        return self.scale[: self._owned].reshape(-1, self._size)[nodes]

    def _by_nodes(self, vector: GhostedVector) -> Single:
        """Return the owned part of a vector as (nodes, size)."""
        return vector.array[: self._owned].reshape(-1, self._size)

    def pre_smooth(self) -> None:
        """Smooth from x = 0, and compute the residual (collective)."""
        self._inverse.first_step(self._weights[0][1], self.b, self._direction, self.x)
        self._smooth(self._weights[1:])
        self._compute_residual()

    def post_smooth(self) -> None:
        """Smooth from x (collective)."""
        self._smooth(self._weights)

    def restart_from_residual(self) -> None:
        """Make the residual the right-hand side of another cycle, and keep x for `add_previous_cycle` (collective)."""
        assert self._previous_x is not None
        self._compute_residual()
        self.b, self.residual = self.residual, self.b
        self.x, self._previous_x = self._previous_x, self.x

    def add_previous_cycle(self) -> None:
        """Add the solution that `restart_from_residual` kept to x, without ghosts."""
        assert self._previous_x is not None
        self.x.array[: self._owned] += self._previous_x.array[: self._owned]

    def _smooth(self, weights: list[tuple[float, float]]) -> None:
        """Apply steps with these weights (keep, take) (collective)."""
        for keep, take in weights:
            self.x.update_ghosts()
            self._matrix.smoothing_step(self._inverse, keep, take, self.b, self.x, self._direction, self._next_x)
            for nodes, product in self._coupling_products():
                step = take * np.einsum("nij,nj->ni", self._inverse.blocks[nodes], product)
                for vector in (self._direction, self._next_x):
                    self._by_nodes(vector)[nodes] -= step
            self.x, self._next_x = self._next_x, self.x


class FineLevel(SmoothedLevel):
    """Finest level: the present tangent in single precision, which CG may multiply with as well.

    A' = S A S has half the bytes of A, and products with it read what the cycle has just brought into the cache.
    Rounding changes each block by 6e-8. Rigid motions are resisted by the sum of the blocks of a row alone; the loss of
    this sum is added again:

        A x ~ S^-1 A' S^-1 x + L x,    L_i = sym sum_j (A_ij - S_i^-1 A'_ij S_j^-1)

    The error of the energy of x is the sum of x_i . E_ij (x_j - x_i) with the loss E of each block. It vanishes where
    neighbours move together.
    """

    def __init__(
        self, data: LevelData, pattern: BlockCSRData, code: CDLL, policy: SolverPolicy = DEFAULT_POLICY
    ) -> None:
        """Allocate the level (see `SmoothedLevel`)."""
        super().__init__(data, pattern, code, policy)
        nodes, size = data.nodes, data.size
        self._unscale = 1 / self.scale
        self._inverse_at_setup: Single | None = None  # (owned nodes, size, size) of the blocks on the diagonal
        self._unscaled_x = GhostedVector(nodes, size, np.float64)
        self._lost = np.zeros((nodes.size_local, size, size), np.float32)

    def assign_values(self, values: Values, couplings: Sequence[NodeCoupling] = ()) -> None:
        """Assign the blocks of A and its couplings, and compute the rounding loss of the blocks (collective)."""
        super().assign_values(values, couplings)
        if self._inverse_at_setup is None:
            self._inverse_at_setup = self._inverse.blocks.copy()
        self._matrix.compute_rounding_loss(values, self._unscale, self._unscale, self._lost)

    def changed_nodes(self, share: float) -> npt.NDArray[np.bool_]:
        """(owned nodes,) flags of nodes of which the block D on the diagonal differs from D_0, that of the set-up.

        That is where |D_0^-1 D - 1| > `share`, in the norm of Frobenius.
        """
        assert self._inverse_at_setup is not None
        change = self._inverse_at_setup @ self._diagonal_blocks() - np.eye(self._size, dtype=np.float32)
        return np.asarray(np.einsum("nij,nij->n", change, change) > share**2)

    def multiply(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Compute y = A x, in double precision but for A' and L (collective)."""
        values, product, n = x.array_r, y.array_w, self._owned
        np.multiply(values, self._unscale[:n], out=self._unscaled_x.array[:n])
        self._unscaled_x.update_ghosts()
        self._matrix.multiply(self._lost, self._unscale, self._unscaled_x, values, product)
        product_by_nodes, x_by_nodes = (array.reshape(-1, self._size) for array in (product, values))
        for coupling in self.couplings:
            product_by_nodes[coupling.nodes] += coupling.multiply(x_by_nodes[coupling.nodes])


def chebyshev(largest: float, steps: int, lower: float, upper: float) -> list[tuple[float, float]]:
    """Return the weights (keep, take) of the steps d <- keep d + take B r, x <- x + d of Chebyshev's iteration.

    Y. Saad, Iterative methods for sparse linear systems, 2003, section 12.1.

    Args:
        largest: largest eigenvalue.
        steps: number of steps.
        lower: lower end of the smoothed range, as a share of the largest eigenvalue.
        upper: its upper end.
    """
    centre, half = (upper + lower) / 2 * largest, (upper - lower) / 2 * largest
    rho, weights = half / centre, [(0.0, 1 / centre)]
    for _ in range(steps - 1):
        last, rho = rho, 1 / (2 * centre / half - rho)
        weights.append((rho * last, 2 * rho / half))
    return weights
