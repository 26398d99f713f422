"""A preconditioner of a body of which parts hang by a node or an edge, or not at all.

Such parts move as rigid bodies against nothing but their inertia, some 1e-7 of a stiffness where steps are long, and
there are hundreds of them along a crack. Multigrid's aggregates lie across the hinges, so that CG finds one motion
after another: 275 iterations where the whole body took 10 (a core of 46,000 tetrahedra, 124 parts). They are solved for
by themselves (balancing, Mandel 1993; deflation, Nicolaides 1987; compared by Tang et al. 2009):

    P = Q + (1 - Q K) M (1 - K Q),   Q = Z E^-1 Z^T,   E = Z^T K Z

M is the body's preconditioner, Z has the rigid motions of each part but the largest, of nodes that no larger part has,
too. It takes 21 iterations. The sum of Q and M takes 35. K Z has few rows, so that P costs what M does.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from ..mechanics.balance import Balance
from ..mesh.domain import Domain
from ..mesh.parts import parts_of_nodes
from ..mesh.ranks import total

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

DEPENDENT = 1e-8  # of the largest eigenvalue of a part's Gram matrix: motions that are the same on its nodes


class LooseParts:
    """The context of a PETSc preconditioner.

    Attributes:
        body: M.    pc: P.
    """

    def __init__(self, balance: Balance, body: PETSc.PC, nodes: Ints, part: Ints, count: int) -> None:
        """`nodes`: (n,) owned ones that move with their `part` (n,) of so many."""
        self._balance, self.body = balance, body
        self._nodes, self._part, self._count = nodes, part, count
        self._at: tuple[int, int] | None = None
        self._made: list[PETSc.Object] = []
        self.pc = PETSc.PC().create(balance.domain.comm)
        self.pc.setType("python")
        self.pc.setPythonContext(self)

    def follow(self, tangent: PETSc.Mat) -> bool:
        """Serve this tangent, and the body where it is now. False: all that hangs is held (collective)."""
        if self._at == (at := (tangent.handle, tangent.stateGet())):
            return True
        self._forget_parts()
        if (Z := self._motions(tangent)) is None:
            return False
        self._Z, self._at = Z, at
        self._KZ = tangent.matMult(Z)
        self._KtZ = self._KZ if self._balance.symmetric else tangent.transposeMatMult(Z)
        E, self._solve = Z.transposeMatMult(self._KZ), PETSc.PC().create(tangent.comm)
        self._small, self._moved, self._back = (Z.createVecRight() for _ in range(3))
        self._left = tangent.createVecRight()
        self._made = [Z, self._KZ, self._KtZ, E, self._solve, self._small, self._moved, self._back, self._left]
        self._solve.setType("redundant" if tangent.comm.size > 1 else "lu")
        self._solve.setOperators(E)
        self._solve.setUp()
        self.pc.setOperators(tangent)
        return True

    def _motions(self, tangent: PETSc.Mat) -> PETSc.Mat | None:
        """Z (collective)."""
        balance, domain = self._balance, self._balance.domain
        x, free = domain.nodes[self._nodes], balance.motion.free.reshape(-1, domain.dim)[self._nodes]
        if not balance.linear:
            x = x + balance.u.x.array.reshape(-1, domain.dim)[self._nodes]
        columns, values, width = _motions(domain, self._part, x, free, self._count)
        return _matrix(tangent, self._nodes, columns, values, width) if width else None

    def apply(self, _: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = P x (collective)."""
        small, moved, back, left = self._small, self._moved, self._back, self._left
        self._Z.multTranspose(x, small)
        self._solve.apply(small, moved)
        self._KZ.mult(moved, left)
        left.aypx(-1.0, x)
        self.body.apply(left, y)
        self._KtZ.multTranspose(y, small)
        self._solve.apply(small, back)
        moved.axpy(-1.0, back)
        self._Z.multAdd(moved, y, y)

    def _forget_parts(self) -> None:
        for each in self._made:
            each.destroy()
        self._made = []

    def forget(self) -> None:
        """Give the memory of PETSc's objects back."""
        self._forget_parts()
        self.pc.destroy()


def loose_parts(balance: Balance, body: PETSc.PC) -> LooseParts | None:
    """That of a body as it is now, whose preconditioner is `body`; None: all of it is one part (collective)."""
    domain, multiplier = balance.domain, balance.stress.multiplier
    assert multiplier is not None  # where anything breaks
    count, part = parts_of_nodes(domain, multiplier.x.array[: domain.cell_count] > 0)
    nodes = np.flatnonzero(part > 0)
    return LooseParts(balance, body, nodes, part[nodes] - 1, count - 1) if count > 1 else None


def _motions(
    domain: Domain, part: Ints, x: Values, free: npt.NDArray[np.bool_], count: int
) -> tuple[Ints, Values, int]:
    """Orthonormal rigid motions of `count` parts at nodes (n,) of this rank at x (n, d): columns (n, r) and values
    (n, d, r), and how many columns there are on all ranks; values of column -1 are none (collective)."""
    comm, d = domain.comm, x.shape[1]
    sums: Values = np.zeros((count, d + 1))
    np.add.at(sums, part, np.concatenate([np.ones((len(x), 1)), x], axis=1))
    sums = total(comm, sums)
    middle = sums[:, 1:] / np.maximum(sums[:, :1], 1)
    B = _rigid((x - middle[part]) / domain.mean_edge) * free[:, :, None]
    gram = np.zeros((count, B.shape[2], B.shape[2]))
    np.add.at(gram, part, np.einsum("ndi,ndj->nij", B, B))
    values, vectors = np.linalg.eigh(total(comm, gram))
    kept = values > DEPENDENT * np.maximum(values[:, -1:], 1.0)
    scaled = np.where(kept, 1 / np.sqrt(np.where(kept, values, 1.0)), 0.0)
    columns = np.where(kept, np.cumsum(kept).reshape(kept.shape) - 1, -1)
    return columns[part], np.einsum("ndi,nij,nj->ndj", B, vectors[part], scaled[part]), int(kept.sum())


def _rigid(r: Values) -> Values:
    """(n, d, 3 or 6) translations and rotations at r (n, d) from where the latter turn about."""
    n, d = r.shape
    turns = [(0, 1)] if d == 2 else [(0, 1), (1, 2), (2, 0)]
    B = np.zeros((n, d, d + len(turns)))
    B[:, range(d), range(d)] = 1.0
    for column, (i, j) in enumerate(turns, d):
        B[:, i, column], B[:, j, column] = -r[:, j], r[:, i]
    return B


def _matrix(tangent: PETSc.Mat, nodes: Ints, columns: Ints, values: Values, width: int) -> PETSc.Mat:
    """Z (owned dofs, width) (collective)."""
    d = values.shape[1]
    rows = tangent.getLocalSize()[0]
    there = np.broadcast_to((columns >= 0)[:, None], values.shape)
    lengths = np.zeros(rows, PETSc.IntType)
    lengths[(d * nodes[:, None] + np.arange(d)).reshape(-1)] = there.sum(axis=2).reshape(-1)
    starts = np.concatenate([[0], np.cumsum(lengths)]).astype(PETSc.IntType)
    where = np.broadcast_to(columns[:, None], values.shape)[there].astype(PETSc.IntType)
    size = ((rows, None), (None, width))
    Z = PETSc.Mat().createAIJ(size, csr=(starts, where, values[there]), comm=tangent.comm)
    Z.assemble()
    return Z
