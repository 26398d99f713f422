"""Multigrid's cycle in single precision: PETSc's levels, copied, in blocks of a node's dofs.

CG with multigrid is bound by what it reads: five products with the finest level an iteration, four of them in the
cycle, where six digits are plenty. Floats in blocks are 40 bytes for nine entries, doubles in blocks 76, single entries
108; an iteration takes 0.4 to 0.5 of the time. CG itself goes by the tangent in double precision, but for corrections
of Newton's method (linear), which finds the last digits by its residuals.

Each level is scaled by the diagonal that it was set up with, A' = S A S, S = diag(A)^(-1/2), so that its numbers are
about 1, and P' = S_fine^-1 P S_coarse. It is smoothed by Chebyshev's polynomial (first kind) of B A', p = q(B A') B,
within LOW and HIGH of the largest eigenvalue, as PETSc takes them, B: the inverses of a node's blocks on the diagonal
of A' (block Jacobi; PETSc goes by single entries). Where cells are all but flat a node is held in one direction alone,
which is along no axis: with single entries the largest eigenvalue is 6 to 9 for the sake of a few nodes, not 4.3, and
all others are smoothed for that. The finest level is the tangent of now, B with it: one of before would smooth cells
that have stiffened beyond what is stable, or, weakened for their sake, hardly smooth the others. A jelly and a doormat
that tear take three quarters of the iterations. Below the coarsest level that is smoothed PETSc solves. The cycle from
0 is

    M = 2 p - p A' p + (1 - p A') C (1 - A' p),    C = P' A'_coarse^-1 P'^T

which is symmetric and, where p A' is within (0, 2), positive, whatever rounding has made of A' where it is almost
singular: rigid motions of what hardly anything holds are C's, which is positive by itself.
"""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from ..mesh.ranks import total
from .levels import Blocks, Copy, copied
from .rows import Code, Diagonal, Rows, Vector, code

if TYPE_CHECKING:
    from collections.abc import Iterator

    from ..mechanics.products import Products
    from ..mechanics.tied import Tied

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Single = npt.NDArray[np.float32]
type Codes = dict[tuple[int, int], Code]

STEPS = 2  # of smoothing, before and after
LOW, HIGH = 0.1, 1.1  # of the largest eigenvalue
LOOKS = 10  # products that tell how large that is
SMOOTHED = ("chebyshev", "jacobi", STEPS)  # how PETSc's levels are, which these replace


class Level:
    """One that is smoothed.

    Attributes:
        b, x: right-hand side and solution, scaled.    left: b - A x.    scale: S, of ghosts, too.
        beside: what is added to the blocks of A.
    """

    def __init__(self, copy: Copy, own: Blocks, made: Code, beside: list[Tied]) -> None:
        """`own`: where the blocks of A are, which it has yet to `take`."""
        nodes, size = copy.nodes, copy.size
        large = np.abs(copy.diagonal)
        self.scale: Values = 1 / np.sqrt(np.where(large > 0, large, 1.0))
        self._comm, self._owned, self._size = nodes.comm, nodes.size_local * size, size
        self.beside = beside
        self._rows = Rows(made, own.starts, own.columns)
        self._inverse = Diagonal(made, nodes.size_local, size)
        self.b, self.x, self.left, self._d, self._to = (Vector(nodes, size) for _ in range(5))
        self._row = np.repeat(np.arange(nodes.size_local), np.diff(own.starts))
        self._on_diagonal = np.flatnonzero(own.columns == self._row)

    def take(self, values: Values) -> None:
        """Those of the blocks of A, as many as at first, and smooth for what they are (collective)."""
        self._rows.take(values, self.scale, self.scale)
        self._inverse.invert(self._diagonal())
        self._weights = chebyshev(self._largest(), STEPS)

    def _diagonal(self) -> Single:
        """(owned nodes, size, size) blocks of A' with what is beside them."""
        D = np.zeros_like(self._inverse.blocks)
        D[self._row[self._on_diagonal]] = self._rows.blocks[self._on_diagonal].reshape(-1, *D.shape[1:])
        for each in self.beside:
            axes = np.arange(self._size)
            D[each.nodes[:, None], axes, axes] += each.diagonal * self._scale_at(each.nodes) ** 2
        return D

    def _largest(self) -> float:
        """About the largest eigenvalue of B A', from below, by Lanczos' method in the norm of B; 1 at least, as B's
        blocks say (collective)."""
        b, x, n = self.b.array, self.x.array, self._owned
        b[:n] = np.random.default_rng(self._comm.rank).uniform(-1.0, 1.0, n)
        before = np.zeros(n, np.float32)
        diagonal: list[float] = []
        beside: list[float] = []
        for _ in range(LOOKS):
            self._inverse.begin(1.0, self.b, self._d, self.x)
            beside.append(float(np.sqrt(total(self._comm, np.vdot(b[:n], x[:n]))[0])))
            if beside[-1] < 1e-5:  # of round-off
                break
            x[:n] /= np.float32(beside[-1])
            now = b[:n] / np.float32(beside[-1])
            self._multiply()
            b[:n] = self.left.array[:n]
            if diagonal:
                b[:n] -= np.float32(beside[-1]) * before
            diagonal.append(float(total(self._comm, np.vdot(b[:n], x[:n]))[0]))
            b[:n] -= np.float32(diagonal[-1]) * now
            before = now
        off = beside[1 : len(diagonal)]
        T = np.diag(diagonal) + np.diag(off, 1) + np.diag(off, -1)
        return max(float(np.linalg.eigvalsh(T)[-1]), 1.0)

    def _multiply(self) -> None:
        """left = A' x (collective)."""
        self.x.fetch()
        self.left.array[: self._owned] = 0.0
        self._rows.add(self.x, self.left)
        for nodes, product in self._beside():
            self._by_nodes(self.left)[nodes] += product

    def _residual(self) -> None:
        self.x.fetch()
        self._rows.residual(self.b, self.x, self.left)
        for nodes, product in self._beside():
            self._by_nodes(self.left)[nodes] -= product

    def _beside(self) -> Iterator[tuple[Ints, Values]]:
        """Nodes, and the product of x with what is beside the blocks there."""
        for each in self.beside:
            scale = self._scale_at(each.nodes)
            yield each.nodes, scale * each.product(scale * self._by_nodes(self.x)[each.nodes])

    def _scale_at(self, nodes: Ints) -> Values:
        return self.scale[: self._owned].reshape(-1, self._size)[nodes]

    def _by_nodes(self, vector: Vector) -> npt.NDArray[np.float32]:
        return vector.array[: self._owned].reshape(-1, self._size)

    def multiply(self, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = A x, neither of them scaled (collective)."""
        n = self._owned
        np.divide(x.array_r, self.scale[:n], out=self.x.array[:n], casting="same_kind")
        self._multiply()
        np.divide(self.left.array[:n], self.scale[:n], out=y.array_w)

    def begin(self) -> None:
        """Smooth from 0, and what is left (collective)."""
        self._inverse.begin(self._weights[0][1], self.b, self._d, self.x)
        self._smooth(self._weights[1:])
        self._residual()

    def end(self) -> None:
        """Smooth from x (collective)."""
        self._smooth(self._weights)

    def _smooth(self, weights: list[tuple[float, float]]) -> None:
        for keep, take in weights:
            self.x.fetch()
            self._rows.smooth(self._inverse, keep, take, self.b, self.x, self._d, self._to)
            for nodes, product in self._beside():
                step = take * np.einsum("nij,nj->ni", self._inverse.blocks[nodes], product)
                for each in (self._d, self._to):
                    self._by_nodes(each)[nodes] -= step
            self.x, self._to = self._to, self.x


def chebyshev(largest: float, steps: int) -> list[tuple[float, float]]:
    """The weights of d and of B r in each step d <- keep d + take B r, x <- x + d (Saad 2003, 12.1)."""
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
        """`body`: of the kind that `in_single` takes; `products`: with the tangent, which it has yet to `follow`;
        `codes`: for the sizes of blocks (collective)."""
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
            if here.own:
                level.take(here.own.values)
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
        self.finest.beside = self._products.beside
        self.finest.take(self._values)

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
