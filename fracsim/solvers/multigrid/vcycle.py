"""Multigrid V cycle in single precision: the levels of PETSc's smoothed aggregation, copied in blocks of a node's dofs.

CG with multigrid is bound by memory bandwidth: five products with the finest level an iteration, four of them in the
cycle, where six digits suffice. A 3 x 3 block takes 40 bytes in single precision, 108 as single entries in double
precision. From x = 0 the cycle is

    M = 2 p - p A' p + (1 - p A') C (1 - A' p),    C = P' A'_coarse^-1 P'^T,    A' = S A S,  P' = S_fine^-1 P S_coarse

with Chebyshev's smoother p = q(B A') B (levels). It is symmetric, and positive definite if the eigenvalues of p A'
are within (0, 2), whatever the rounding errors of an almost singular A'.

Where cycles from the second finest level down converge slowly, as in thin and torn bodies, coarse levels have more
smoothing steps on a wider range, and C is two cycles (a W cycle). Coarse levels have less than a twelfth of the numbers
of the finest.

Equations: docs/theory.md#linear-systems.
"""

from __future__ import annotations

from collections.abc import Callable
from ctypes import CDLL
from itertools import chain, pairwise, repeat
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from petsc4py import PETSc

from ..policy import DEFAULT_POLICY, SolverPolicy
from ..weak_callbacks import ApplyContext
from . import bcsr
from .bcsr import GhostedVector, Prolongation
from .hierarchy import BlockCSRData, copy_levels
from .levels import FineLevel, SmoothedLevel, SmoothingParameters

if TYPE_CHECKING:
    from ...mechanics.block_matrix import BlockMatrix

Values = npt.NDArray[np.float64]
# By the size of a level's blocks; by the sizes of the finer level's and the coarser's for prolongations.
type CompiledProducts = dict[tuple[int, ...], CDLL]

# Smoothing of the second finest level, of the next, and of all coarser ones, if coarse levels converge slowly. The
# coarsest have so few numbers that more steps cost nothing but calls.
THOROUGH_SMOOTHING = (
    SmoothingParameters(2, 0.08, 2), SmoothingParameters(4, 0.03, 2), SmoothingParameters(8, 0.03)
)  # fmt: skip


class SinglePrecisionVCycle:
    """Context of a PETSc preconditioner that applies the cycle.

    Attributes:
        gamg: PETSc's multigrid.
        pc: the preconditioner.
        fine_level: level of the tangent.
        has_thorough_smoothing: whether coarse levels are smoothed more, and take as long as the finest.
    """

    def __init__(
        self,
        gamg: PETSc.PC,
        blocks: BlockMatrix,
        codes: CompiledProducts,
        policy: SolverPolicy = DEFAULT_POLICY,
        release_entries: Callable[[], None] | None = None,
    ) -> None:
        """Copy the levels (collective).

        Args:
            gamg: multigrid as `create_vcycle` requires it.
            blocks: the tangent, whose values `update_operator` assigns.
            codes: compiled code for the sizes of the blocks.
            policy: tuned numbers.
            release_entries: frees the entries from which `gamg` was set up; they and `gamg` are not kept then.
        """
        self.gamg, self._blocks, self._tangent, self._policy = gamg, blocks, blocks.matrix, policy
        levels = copy_levels(gamg, self._tangent.index_map(1))
        coarsest = next(levels)
        if release_entries is not None:
            release_entries()
        starts = self._tangent.indptr[: self._tangent.index_map(0).size_local + 1]
        pattern = BlockCSRData(starts, self._tangent.indices[: starts[-1]], self._values)
        self._levels: list[SmoothedLevel] = []
        self._prolongations: list[Prolongation] = []
        coarser_size = coarsest.size
        scale: Values = np.ones(len(coarsest.diagonal))
        for data in levels:
            # First, so that the double precision of its blocks is gone as the level is allocated.
            product_code = codes[data.size, coarser_size]
            self._prolongations.append(Prolongation(product_code, data.prolongation, 1 / data.scale, scale))
            block_code = codes[data.size,]
            if data.matrix:
                level = SmoothedLevel(data, data.matrix, block_code, policy)
                level.assign_values(data.matrix.values)
            else:
                # The present tangent, not that of the set-up: its smoother could be unstable for cells that have become
                # stiffer.
                level = self.fine_level = FineLevel(data, pattern, block_code, policy)
            self._levels.append(level)
            coarser_size, scale = data.size, level.scale
        owned = (len(starts) - 1) * self._tangent.block_size[0]
        self._scale = scale[:owned].astype(np.float32)
        self._coarsest_b, self._coarsest_x = (GhostedVector(coarsest.nodes, coarsest.size) for _ in range(2))
        self._coarsest_solver = gamg.getMGCoarseSolve()
        coarsest_matrix = self._coarsest_solver.getOperators()[1]
        self._coarsest_vectors = coarsest_matrix.createVecs()
        self.pc = PETSc.PC().createPython(ApplyContext(self.apply), comm=gamg.comm)
        # The preconditioner may serve a KSP that has no other operators.
        self.pc.setOperators(*gamg.getOperators())
        if release_entries is not None:
            # PETSc's product P^T A P keeps its factors: a copy does not.
            coarsest_matrix = coarsest_matrix.copy()
            gamg.reset()
            self._coarsest_solver.setOperators(coarsest_matrix)
        self.has_thorough_smoothing = len(self._levels) > 1 and self.converges_slowly()
        if self.has_thorough_smoothing:
            smoothings = chain(THOROUGH_SMOOTHING, repeat(THOROUGH_SMOOTHING[-1]))
            for level, smoothing in zip(self._levels[-2::-1], smoothings, strict=False):
                level.set_smoothing(smoothing)

    def converges_slowly(self) -> bool:
        """Return True if cycles from the second finest level down reduce a random residual slowly (collective).

        False if they diverge, as for an indefinite tangent.
        """
        number, level = len(self._levels) - 2, self._levels[-2]
        level.set_random_rhs()
        norms = []
        for _ in range(self._policy.trial_cycles):
            self._apply_cycle(number)
            level.restart_from_residual()
            norms.append(level.rhs_norm())
        return self._policy.slow_cycle_ratio * norms[-2] < norms[-1] < norms[-2]

    @property
    def _values(self) -> Values:
        """(blocks, size^2) values of the tangent."""
        return np.asarray(self._tangent.data, np.float64)

    def update_operator(self) -> None:
        """Assign the present tangent to the finest level (collective)."""
        self.fine_level.assign_values(self._values, self._blocks.couplings)

    def apply(self, _: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Evaluate y = M x (collective)."""
        finest, n = self.fine_level, x.getLocalSize()
        b, result = finest.b.array[:n], y.array_w
        # A product of numbers of two types would take three times as long.
        b[:] = x.array_r
        b *= self._scale
        self._apply_cycle(len(self._levels) - 1)
        result[:] = finest.x.array[:n]
        result *= finest.scale[:n]

    def _apply_cycle(self, number: int) -> None:
        """Apply the cycle from a level down (collective)."""
        level = self._levels[number]
        level.pre_smooth()
        b = self._levels[number - 1].b if number else self._coarsest_b
        b.array[:] = 0.0
        self._prolongations[number].add_transposed_product(level.residual, b)
        b.add_ghosts_to_owners()
        if number:
            self._apply_coarse_cycles(number - 1)
        else:
            self._solve_coarsest()
        x = self._levels[number - 1].x if number else self._coarsest_x
        x.update_ghosts()
        self._prolongations[number].add_product(x, level.x)
        level.post_smooth()

    def _apply_coarse_cycles(self, number: int) -> None:
        """Apply the cycles of a coarser level, each to the residual of the last (collective)."""
        level = self._levels[number]
        self._apply_cycle(number)
        for _ in range(level.smoothing.cycles - 1):
            level.restart_from_residual()
            self._apply_cycle(number)
            level.add_previous_cycle()

    def _solve_coarsest(self) -> None:
        """Solve on the coarsest level (collective)."""
        b, x = self._coarsest_vectors
        n = b.getLocalSize()
        b.array_w[:] = self._coarsest_b.array[:n]
        self._coarsest_solver.solve(b, x)
        self._coarsest_x.array[:n] = x.array_r

    def destroy(self) -> None:
        """Free PETSc's objects."""
        for owned in (*self._coarsest_vectors, self.pc):
            owned.destroy()


def create_vcycle(
    gamg: PETSc.PC,
    blocks: BlockMatrix,
    policy: SolverPolicy = DEFAULT_POLICY,
    release_entries: Callable[[], None] | None = None,
) -> SinglePrecisionVCycle | None:
    """Return the cycle of a multigrid that was set up from a tangent in these blocks (collective).

    None if it is not PETSc's default smoothed aggregation, or without a compiler. The arguments are those of
    `SinglePrecisionVCycle`.
    """
    if gamg.getType() != "gamg" or gamg.getMGLevels() < 2:
        return None
    smoothers = [gamg.getMGSmoother(level) for level in range(gamg.getMGLevels())]
    # The cycle stands for PETSc's default smoother alone.
    if any((ksp.getType(), ksp.getPC().getType(), ksp.max_it) != ("chebyshev", "jacobi", 2) for ksp in smoothers[1:]):
        return None
    sizes = [ksp.getOperators()[1].getBlockSize() for ksp in smoothers]
    codes = _compile_products(gamg.comm.tompi4py(), sizes)
    return None if codes is None else SinglePrecisionVCycle(gamg, blocks, codes, policy, release_entries)


def _compile_products(comm: MPI.Comm, sizes: list[int]) -> CompiledProducts | None:
    """Return compiled code for levels with so many dofs of a node, from the coarsest on.

    None without a compiler (collective).
    """
    codes: dict[tuple[int, ...], CDLL | None] = {
        (size,): bcsr.compile_block_csr(comm, size) for size in sorted(set(sizes[1:]))
    }
    codes |= {
        (fine, coarse): bcsr.compile_prolongation(comm, fine, coarse) for coarse, fine in sorted(set(pairwise(sizes)))
    }
    compiled = {key: code for key, code in codes.items() if code is not None}
    return compiled if len(compiled) == len(codes) else None
