"""Multigrid's cycle in single precision: PETSc's levels, copied, in blocks of a node's dofs.

CG with multigrid is bound by what it reads: five products with the finest level an iteration, four of them in the
cycle, where six digits are plenty. Floats in blocks are 40 bytes for nine entries, doubles in blocks 76, single entries
108; an iteration takes 0.4 to 0.5 of the time. CG itself goes by the tangent in double precision, but for corrections
of Newton's method (linear_solver), which finds the last digits by its residuals: for these the cycle's finest level is
what CG multiplies with (fine_level).

Each level is scaled by the diagonal that it was set up with, A' = S A S, S = diag(A)^(-1/2), so that its numbers are
about 1, and P' = S_fine^-1 P S_coarse. It is smoothed by p = q(B A') B, Chebyshev's polynomial of B A' (smoother). The
finest level is the tangent of now, B with it: one of before would smooth cells that have stiffened beyond what is
stable, or, weakened for their sake, hardly smooth the others. Below the coarsest level that is smoothed PETSc solves.
The cycle from 0 is

    M = 2 p - p A' p + (1 - p A') C (1 - A' p),    C = P' A'_coarse^-1 P'^T

which is symmetric and, where p A' is within (0, 2), positive, whatever rounding has made of A' where it is almost
singular: rigid motions of what hardly anything holds are C's, which is positive by itself.

Coarser levels are smoothed as the finest, in two steps, as PETSc's V cycle has them. But where cycles of theirs leave
much (`Cycle.converges_slowly`) they have more steps, that reach further down, and C is two of such cycles, 2 B - B A' B
(a W cycle): they have a twelfth of the finest's numbers and less. That is where a body is thin, and where it has torn:
it bends as strips of two cells, and what coarser levels leave of that CG goes on for. A doormat after 110 steps took 31
iterations for 98, in 0.4 of the time, by twice the steps that they have here (with an exact C 24); by these all its
steps together take a seventh more iterations, in 0.9 of the time. A compact body takes as many as in a V cycle, and
would pay for them.

Equations: docs/theory.md#linear-systems.
"""

from __future__ import annotations

from ctypes import CDLL
from itertools import chain, pairwise, repeat
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from petsc4py import PETSc

from ..weak_callbacks import ApplyContext
from . import bcsr
from .bcsr import GhostedVector, Prolongation
from .fine_level import FineLevel
from .hierarchy import BlockCSRData, copy_levels
from .smoother import SmoothedLevel, SmoothingParameters

if TYPE_CHECKING:
    from ...mechanics.block_matrix import BlockMatrix

Values = npt.NDArray[np.float64]
# by the size of a level's blocks; by the sizes of the finer level's and the coarser's, for what is between them
type Codes = dict[tuple[int, ...], CDLL]

SMOOTHED = ("chebyshev", "jacobi", 2)  # how PETSc's levels are, which these replace
# where coarser levels converge slowly: the effort of the first of them, of the next, and of all that follow, which have
# so few numbers that calls are what they cost
THOROUGH = SmoothingParameters(2, 0.08, 2), SmoothingParameters(4, 0.03, 2), SmoothingParameters(8, 0.03)
TRIED, SLOWLY = 4, 0.8  # cycles of theirs; share that the last of them leaves where they do


class SinglePrecisionVCycle:
    """The context of a PETSc preconditioner.

    Attributes:
        body: PETSc's multigrid.    pc: the preconditioner.    finest: the level of the tangent.
        thorough: whether more is done with coarser levels, which takes as long as the finest then.
    """

    def __init__(self, body: PETSc.PC, products: BlockMatrix, codes: Codes) -> None:
        """`body`: of the kind that `in_single` takes; `products`: with the tangent, which it has yet to `follow`;
        `codes`: for the sizes of its blocks (collective)."""
        self.gamg, self._products, self._tangent = body, products, products.matrix
        coarsest, *found = copy_levels(body, self._tangent.index_map(1))
        starts = self._tangent.indptr[: self._tangent.index_map(0).size_local + 1]
        tangent = BlockCSRData(starts, self._tangent.indices[: starts[-1]], self._values)
        self._levels: list[SmoothedLevel] = []
        self._between: list[Prolongation] = []
        below = coarsest
        scale: Values = np.ones(len(coarsest.diagonal))
        for here in found:
            square = codes[here.size,]
            if here.matrix:
                level = SmoothedLevel(here, here.matrix, square)
                level.assign_values(here.matrix.values)
            else:
                level = self.fine_level = FineLevel(here, tangent, square)
            self._levels.append(level)
            assert here.prolongation is not None
            made = codes[here.size, below.size]
            self._between.append(Prolongation(made, here.prolongation, 1 / level.scale, scale))
            below, scale = here, level.scale
        own = (len(starts) - 1) * self._tangent.block_size[0]
        self._scale = scale[:own].astype(np.float32)
        self._b, self._x = (GhostedVector(coarsest.nodes, coarsest.size) for _ in range(2))
        self._solver = body.getMGCoarseSolve()
        self._ends = self._solver.getOperators()[1].createVecs()
        self.pc = PETSc.PC().createPython(ApplyContext(self.apply), comm=body.comm)
        self.pc.setOperators(*body.getOperators())  # or it may serve a KSP alone
        self.has_thorough_smoothing = len(self._levels) > 1 and self.converges_slowly()
        if self.has_thorough_smoothing:
            for level, effort in zip(self._levels[-2::-1], chain(THOROUGH, repeat(THOROUGH[-1])), strict=False):
                level.set_smoothing(effort)

    def converges_slowly(self) -> bool:
        """Whether cycles from the second finest level down do, of what is left of anything after a few of them; not
        where they diverge, of a tangent that is not positive (collective)."""
        at, level = len(self._levels) - 2, self._levels[-2]
        level.set_random_rhs()
        left = []
        for _ in range(TRIED):
            self._go_through(at)
            level.restart_from_residual()
            left.append(level.rhs_norm())
        return SLOWLY * left[-2] < left[-1] < left[-2]

    @property
    def _values(self) -> Values:
        """Of the tangent's blocks."""
        return np.asarray(self._tangent.data, np.float64)

    def update_operator(self) -> None:
        """Take the tangent as it is now for the finest level (collective)."""
        self.fine_level.extra_terms = self._products.ties
        self.fine_level.assign_values(self._values)

    def apply(self, _: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = M x (collective)."""
        finest, n = self.fine_level, x.getLocalSize()
        b, found = finest.b.array[:n], y.array_w
        b[:] = x.array_r  # products of two kinds of numbers take three times as long
        b *= self._scale
        self._go_through(len(self._levels) - 1)
        found[:] = finest.x.array[:n]
        found *= finest.scale[:n]

    def _go_through(self, at: int) -> None:
        """The cycle from a level down."""
        level = self._levels[at]
        level.pre_smooth()
        b = self._levels[at - 1].b if at else self._b
        b.array[:] = 0.0
        self._between[at].add_transposed_product(level.residual, b)
        b.add_ghosts_to_owners()
        if at:
            self._correct(at - 1)
        else:
            self._solve_coarsest()
        x = self._levels[at - 1].x if at else self._x
        x.update_ghosts()
        self._between[at].add_product(x, level.x)
        level.post_smooth()

    def _correct(self, at: int) -> None:
        """Cycles from a coarser level down, each of what the one before has left."""
        level = self._levels[at]
        self._go_through(at)
        for _ in range(level.smoothing.cycles - 1):
            level.restart_from_residual()
            self._go_through(at)
            level.add_previous_cycle()

    def _solve_coarsest(self) -> None:
        b, x = self._ends
        n = b.getLocalSize()
        b.array_w[:] = self._b.array[:n]
        self._solver.solve(b, x)
        self._x.array[:n] = x.array_r

    def destroy(self) -> None:
        """Give the memory of PETSc's objects back."""
        for each in (*self._ends, self.pc):
            each.destroy()


def create_vcycle(body: PETSc.PC, products: BlockMatrix) -> SinglePrecisionVCycle | None:
    """The cycle of multigrid that is set up from a tangent, of the products with this; None where it is of another kind
    than PETSc's own choice for smoothed aggregation, or there is no compiler (collective)."""
    if body.getType() != "gamg" or body.getMGLevels() < 2:
        return None
    solvers = [body.getMGSmoother(level) for level in range(body.getMGLevels())]
    if any((each.getType(), each.getPC().getType(), each.max_it) != SMOOTHED for each in solvers[1:]):
        return None
    sizes = [each.getOperators()[1].getBlockSize() for each in solvers]
    codes = _compiled(body.comm.tompi4py(), sizes)
    return None if codes is None else SinglePrecisionVCycle(body, products, codes)


def _compiled(comm: MPI.Comm, sizes: list[int]) -> Codes | None:
    """For levels with so many dofs of a node, from the coarsest on; None without a compiler (collective)."""
    asked: dict[tuple[int, ...], CDLL | None] = {
        (size,): bcsr.compile_block_csr(comm, size) for size in sorted(set(sizes[1:]))
    }
    asked |= {
        (fine, coarse): bcsr.compile_prolongation(comm, fine, coarse) for coarse, fine in sorted(set(pairwise(sizes)))
    }
    made = {key: each for key, each in asked.items() if each is not None}
    return made if len(made) == len(asked) else None
