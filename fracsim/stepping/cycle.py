"""Multigrid's cycle in single precision: PETSc's levels, copied, in blocks of a node's dofs.

CG with multigrid is bound by what it reads: five products with the finest level an iteration, four of them in the
cycle, where six digits are plenty. Floats in blocks are 40 bytes for nine entries, doubles in blocks 76, single entries
108; an iteration takes 0.4 to 0.5 of the time. CG itself goes by the tangent in double precision, but for corrections
of Newton's method (linear), which finds the last digits by its residuals.

Each level is scaled by its diagonal, A' = S A S, S = diag(A)^(-1/2), and P' = S_fine^-1 P S_coarse, so that Jacobi's
smoother is a plain one: Chebyshev's polynomial p (first kind) of A' within LOW and HIGH of its largest eigenvalue, as
PETSc takes them. Below the coarsest level that is smoothed PETSc solves. The cycle from 0 is

    M = 2 p - p A' p + (1 - p A') C (1 - A' p),    C = P' A'_coarse^-1 P'^T

which is symmetric and, where p A' is within (0, 2), positive, whatever rounding has made of A' where it is almost
singular: rigid motions of what hardly anything holds are C's, which is positive by itself.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from ..mesh.ranks import largest, total
from .levels import Blocks, Copy, copied
from .rows import Code, Rows, Vector, code

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ..mechanics.products import Products
    from ..mechanics.tied import Tied

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
type Codes = dict[tuple[int, int], Code]

STEPS = 2  # of smoothing, before and after
LOW, HIGH = 0.1, 1.1  # of the largest eigenvalue
LOOKS = 10  # products that tell how large that is
SMOOTHED = ("chebyshev", "jacobi", STEPS)  # how PETSc's levels are, of which this is a copy


class Level:
    """One that is smoothed.

    Attributes:
        b, x: right-hand side and solution, scaled.    left: b - A x.    scale: S, of ghosts, too.
        beside: what is added to the blocks of A.
    """

    def __init__(self, copy: Copy, own: Blocks, made: Code, beside: list[Tied]) -> None:
        """`own`: the blocks of A (collective)."""
        nodes, size = copy.nodes, copy.size
        large = np.abs(copy.diagonal)
        self.scale: Values = 1 / np.sqrt(np.where(large > 0, large, 1.0))
        self._comm, self._owned, self._size = nodes.comm, nodes.size_local * size, size
        self.beside = beside
        self._rows = Rows(made, own.starts, own.columns)
        self.b, self.x, self.left, self._d, self._to = (Vector(nodes, size) for _ in range(5))
        rows = np.repeat(np.arange(nodes.size_local), np.diff(own.starts))
        self._on_diagonal = np.flatnonzero(own.columns == rows)
        self.take(own.values)
        self._at_first = self._largest()
        self._weights = chebyshev(self._at_first, STEPS)

    def take(self, values: Values) -> None:
        """Those of the blocks of A, as many as at first."""
        self._rows.take(values, self.scale, self.scale)

    def follow(self, values: Values) -> None:
        """Take others, and smooth for the largest eigenvalue that they may have, as the diagonal of A' has grown: what
        is beyond HIGH of it would make M negative (collective)."""
        self.take(values)
        axes = np.arange(self._size)
        diagonal = values.reshape(-1, self._size, self._size)[self._on_diagonal[:, None], axes, axes].reshape(-1)
        grown = float(np.max(diagonal * self.scale[: self._owned] ** 2, initial=1.0))
        self._weights = chebyshev(self._at_first * largest(self._comm, grown), STEPS)

    def _largest(self) -> float:
        """About the largest eigenvalue of A', from below, by Lanczos' method; 1 at least, as its diagonal is
        (collective)."""
        x, b, left, n = self.x.array, self.b.array, self.left.array, self._owned
        b[:], before = 0.0, np.zeros(n, np.float32)
        x[:n] = np.random.default_rng(self._comm.rank).uniform(-1.0, 1.0, n)
        x[:n] /= self._norm(x[:n])
        diagonal, beside = [], [0.0]
        for _ in range(LOOKS):
            self._residual()
            w = -left[:n] - np.float32(beside[-1]) * before
            diagonal.append(float(total(self._comm, np.vdot(w, x[:n]))[0]))
            w -= np.float32(diagonal[-1]) * x[:n]
            beside.append(self._norm(w))
            if beside[-1] < 1e-5:  # of round-off
                break
            before, x[:n] = x[:n].copy(), w / np.float32(beside[-1])
        T = np.diag(diagonal) + np.diag(beside[1:-1], 1) + np.diag(beside[1:-1], -1)
        return max(float(np.linalg.eigvalsh(T)[-1]), 1.0)

    def _norm(self, x: npt.NDArray[Any]) -> float:
        return float(np.sqrt(total(self._comm, np.vdot(x, x))[0]))

    def _residual(self) -> None:
        self.x.fetch()
        self._rows.residual(self.b, self.x, self.left)
        for nodes, product in self._beside():
            self._by_nodes(self.left)[nodes] -= product

    def _beside(self) -> Iterator[tuple[Ints, Values]]:
        """Nodes, and the product of x with what is beside the blocks there."""
        for each in self.beside:
            scale = self.scale[: self._owned].reshape(-1, self._size)[each.nodes]
            yield each.nodes, scale * each.product(scale * self._by_nodes(self.x)[each.nodes])

    def _by_nodes(self, vector: Vector) -> npt.NDArray[np.float32]:
        return vector.array[: self._owned].reshape(-1, self._size)

    def multiply(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = A x, neither of them scaled (collective)."""
        n = self._owned
        np.divide(x.array_r, self.scale[:n], out=self.x.array[:n], casting="same_kind")
        self.x.fetch()
        self.left.array[:n] = 0.0
        self._rows.add(self.x, self.left)
        for nodes, product in self._beside():
            self._by_nodes(self.left)[nodes] += product
        np.divide(self.left.array[:n], self.scale[:n], out=y.array_w)

    def begin(self) -> None:
        """Smooth from 0, and what is left (collective)."""
        n, take = self._owned, np.float32(self._weights[0][1])
        np.multiply(self.b.array[:n], take, out=self.x.array[:n])
        self._d.array[:n] = self.x.array[:n]
        self._smooth(self._weights[1:])
        self._residual()

    def end(self) -> None:
        """Smooth from x (collective)."""
        self._smooth(self._weights)

    def _smooth(self, weights: list[tuple[float, float]]) -> None:
        for keep, take in weights:
            self.x.fetch()
            self._rows.smooth(keep, take, self.b, self.x, self._d, self._to)
            for nodes, product in self._beside():
                for each in (self._d, self._to):
                    self._by_nodes(each)[nodes] -= np.float32(take) * product
            self.x, self._to = self._to, self.x


def chebyshev(largest: float, steps: int) -> list[tuple[float, float]]:
    """The weights of d and of the residual in each step d <- keep d + take r, x <- x + d (Saad 2003, 12.1)."""
    middle, half = (HIGH + LOW) / 2 * largest, (HIGH - LOW) / 2 * largest
    rho, weights = half / middle, [(0.0, 1 / middle)]
    for _ in range(steps - 1):
        last, rho = rho, 1 / (2 * middle / half - rho)
        weights.append((rho * last, 2 * rho / half))
    return weights


class Cycle:
    """The context of a PETSc preconditioner.

    Attributes:
        body: PETSc's multigrid.    pc: the preconditioner.
    """

    def __init__(self, body: PETSc.PC, products: Products, codes: Codes) -> None:
        """`body`: of the kind that `in_single` takes; `products`: with the tangent that it was set up from; `codes`:
        for the sizes of blocks (collective)."""
        self.body, self._products, self._tangent = body, products, products.matrix
        coarsest, *found = copied(body, self._tangent.index_map(1))
        starts = self._tangent.indptr[: self._tangent.index_map(0).size_local + 1]
        tangent = Blocks(starts, self._tangent.indices[: starts[-1]], self._values)
        self._levels: list[Level] = []
        self._between: list[Rows] = []
        below = coarsest
        scale: Values = np.ones(len(coarsest.diagonal))
        for here in found:
            beside = [] if here.own else products.beside
            level = Level(here, here.own or tangent, codes[here.size, here.size], beside)
            self._levels.append(level)
            assert here.between is not None
            between = Rows(codes[here.size, below.size], here.between.starts, here.between.columns)
            between.take(here.between.values, 1 / level.scale, scale)
            self._between.append(between)
            below, scale = here, level.scale
        self._b, self._x = (Vector(coarsest.nodes, coarsest.size) for _ in range(2))
        self._solver = body.getMGCoarseSolve()
        self._ends = self._solver.getOperators()[1].createVecs()
        self.pc = PETSc.PC().createPython(self, comm=body.comm)
        self.pc.setOperators(*body.getOperators())  # or it may serve a KSP alone

    @property
    def finest(self) -> Level:
        """The tangent's own."""
        return self._levels[-1]

    @property
    def _values(self) -> Values:
        """Of the tangent's blocks."""
        return np.asarray(self._tangent.data, np.float64)

    def follow(self) -> None:
        """Take the tangent as it is now for the finest level (collective)."""
        self.finest.follow(self._values)
        self.finest.beside = self._products.beside

    def apply(self, _: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = M x (collective)."""
        finest, n = self.finest, x.getLocalSize()
        np.multiply(x.array_r, finest.scale[:n], out=finest.b.array[:n], casting="same_kind")
        self._go_through(len(self._levels) - 1)
        np.multiply(finest.x.array[:n], finest.scale[:n], out=y.array_w)

    def _go_through(self, at: int) -> None:
        """The cycle from a level down."""
        level, between = self._levels[at], self._between[at]
        level.begin()
        b = self._levels[at - 1].b if at else self._b
        b.array[:] = 0.0
        between.add_transposed(level.left, b)
        b.give_back()
        if at:
            self._go_through(at - 1)
        else:
            self._solve_coarsest()
        x = self._levels[at - 1].x if at else self._x
        x.fetch()
        between.add(x, level.x)
        level.end()

    def _solve_coarsest(self) -> None:
        b, x = self._ends
        n = b.getLocalSize()
        b.array_w[:] = self._b.array[:n]
        self._solver.solve(b, x)
        self._x.array[:n] = x.array_r

    def forget(self) -> None:
        """Give the memory of PETSc's objects back."""
        for each in (*self._ends, self.pc):
            each.destroy()


def in_single(body: PETSc.PC, products: Products) -> Cycle | None:
    """The cycle of multigrid that is set up from a tangent, of the products with this; None where it is of another kind
    than PETSc's own choice for smoothed aggregation, or there is no compiler (collective)."""
    if body.getType() != "gamg" or body.getMGLevels() < 2:
        return None
    solvers = [body.getMGSmoother(level) for level in range(body.getMGLevels())]
    if any((each.getType(), each.getPC().getType(), each.max_it) != SMOOTHED for each in solvers[1:]):
        return None
    sizes = [each.getOperators()[1].getBlockSize() for each in solvers]
    comm = body.comm.tompi4py()
    needed = sorted({*((size, size) for size in sizes[1:]), *pairwise(sizes[::-1])})
    made = {size: code(comm, *size) for size in needed}
    codes = {size: each for size, each in made.items() if each is not None}
    return Cycle(body, products, codes) if len(codes) == len(made) else None
