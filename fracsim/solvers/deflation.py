"""A preconditioner of a body of which parts hang by a node or an edge, or not at all.

Such parts move as rigid bodies against nothing but their inertia, some 1e-7 of a stiffness where steps are long, and
there are hundreds of them along a crack. Multigrid's aggregates lie across the hinges, so that CG finds one motion
after another: 275 iterations where the whole body took 10 (a core of 46,000 tetrahedra, 124 parts). They are solved for
by themselves (balancing, Mandel 1993; deflation, Nicolaides 1987; compared by Tang et al. 2009):

    P = Q + (1 - Q K) M (1 - K Q),   Q = Z E^-1 Z^T,   E = Z^T K Z

M is the body's preconditioner, Z has the rigid motions of each part but the largest, of nodes that no larger part has,
too, and of those that are tied to it (mechanics.node_ties): without them a single cell with a node that it drags along
is a motion that CG looks for, 134 iterations instead of 77. It takes 21 iterations. The sum of Q and M takes 35. K Z
has few rows, so that P costs what M does.

Equations: docs/theory.md#linear-systems.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import splu

from ..mechanics.balance import Balance
from ..mechanics.term_protocols import TieTerm
from ..mesh.domain import Domain
from ..mesh.node_cells import node_components
from ..mesh.parallel import allgather, sum_over_ranks
from .policy import DEFAULT_POLICY, SolverPolicy
from .weak_callbacks import ApplyContext

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


class DeflatedPreconditioner:
    """The context of a PETSc preconditioner.

    Attributes:
        base_pc: M.    pc: P.
    """

    def __init__(
        self, balance: Balance, base_pc: PETSc.PC, nodes: Ints, part: Ints, count: int, policy: SolverPolicy
    ) -> None:
        """`nodes`: (n,) owned nodes that move with their fragment, `part` (n,) of `count`."""
        self._balance, self.base_pc, self._policy = balance, base_pc, policy
        self._nodes, self._part, self._count = nodes, part, count
        self.pc = PETSc.PC().create(balance.domain.comm)
        self.pc.setType("python")
        self.pc.setPythonContext(ApplyContext(self.apply))
        self._rest = balance.work_vector.duplicate()

    def update_operator(self, tangent: PETSc.Mat) -> bool:
        """Serve the tangent of now, and the body where it is. False: all that hangs is held (collective)."""
        balance, domain = self._balance, self._balance.domain
        x, free = domain.nodes[self._nodes], balance.motion.free_dofs.reshape(-1, domain.dim)[self._nodes]
        if not balance.linear:
            x = x + balance.u.x.array.reshape(-1, domain.dim)[self._nodes]
        columns, values, width = _motions(domain, self._part, x, free, self._count, self._policy)
        if not width:
            return False
        self._take(columns, values, width)
        self.pc.setOperators(tangent)
        return True

    def _take(self, columns: Ints, values: Values, width: int) -> None:
        """Z, K Z, their transposes and the factors of E (collective)."""
        domain = self._balance.domain
        comm, d = domain.comm, domain.dim
        nodes = domain.space.dofmap.index_map
        first, size = d * nodes.local_range[0], d * nodes.size_global
        self._at: Ints = (d * self._nodes[:, None] + np.arange(d)).reshape(-1)
        present = np.broadcast_to((columns >= 0)[:, None], values.shape)
        row, column = (np.broadcast_to(item, values.shape)[present] for item in
                       (first + self._at.reshape(-1, d, 1), columns[:, None]))  # fmt: skip
        Z = csr_matrix((values[present], (row, column)), shape=(size, width))
        self._Z = Z[first + self._at]
        self._Zt = self._Z.T.tocsr()
        ZtK = _summed(comm, self._Zt @ self._balance.tangent.owned_rows(self._nodes))
        E = ZtK @ _summed(comm, Z)
        self._solve = splu(E.tocsc()).solve
        owned = ZtK[:, first : first + d * nodes.size_local].T.tocsr()
        self._near = np.flatnonzero(np.diff(owned.indptr))
        self._KZ = owned[self._near]
        self._KZt = self._KZ.T.tocsr()

    def apply(self, _: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """y = P x (collective)."""
        comm, position, near, remaining = self._balance.domain.comm, self._at, self._near, self._rest
        x.copy(remaining)
        moved = self._solve(sum_over_ranks(comm, self._Zt @ remaining.array_r[position]))
        remaining.array_w[near] -= self._KZ @ moved
        self.base_pc.apply(remaining, y)
        moved -= self._solve(sum_over_ranks(comm, self._KZt @ y.array_r[near]))
        y.array_w[position] += self._Z @ moved

    def destroy(self) -> None:
        """Give the memory of PETSc's objects back."""
        self.pc.destroy()
        self._rest.destroy()


def create_deflation(
    balance: Balance, base_pc: PETSc.PC, policy: SolverPolicy = DEFAULT_POLICY
) -> DeflatedPreconditioner | None:
    """That of a body as it is now, whose preconditioner is `body`; None: all of it is one part (collective)."""
    domain, multiplier = balance.domain, balance.stress.energy_multiplier
    if multiplier is None:  # nothing breaks; a restart tells of damage that may have changed all the same
        return None
    count, part = node_components(domain, multiplier.x.array[: domain.cell_count] > 0)
    _join_tied(balance, part)
    nodes = np.flatnonzero(part > 0)
    if count <= 1:
        return None
    return DeflatedPreconditioner(balance, base_pc, nodes, part[nodes] - 1, count - 1, policy)


def _join_tied(balance: Balance, part: Ints) -> None:
    """Nodes without a whole cell go with that which they are tied to: the part (owned nodes,) of which is the smallest
    one around its corners (collective)."""
    for tied in filter(
        None, (term.tie_matrix(balance.motion.free_dofs) for term in balance.terms if isinstance(term, TieTerm))
    ):
        allowed = np.zeros(tied.K.shape[0], np.int64)
        allowed[tied.indices] = part[tied.nodes] + 1
        allowed = sum_over_ranks(balance.domain.comm, allowed)
        smallest, K = allowed.copy(), tied.K.tocoo()
        np.maximum.at(smallest, K.row, allowed[K.col])
        alone = part[tied.nodes] < 0
        part[tied.nodes[alone]] = smallest[tied.indices[alone]] - 1


def _motions(
    domain: Domain, part: Ints, x: Values, free: npt.NDArray[np.bool_], count: int, policy: SolverPolicy
) -> tuple[Ints, Values, int]:
    """Orthonormal rigid motions of `count` parts at nodes (n,) of this rank at x (n, d): columns (n, r) and values
    (n, d, r), and how many columns there are on all ranks; values of column -1 are none (collective)."""
    comm, d = domain.comm, x.shape[1]
    sums: Values = np.zeros((count, d + 1))
    np.add.at(sums, part, np.concatenate([np.ones((len(x), 1)), x], axis=1))
    sums = sum_over_ranks(comm, sums)
    middle = sums[:, 1:] / np.maximum(sums[:, :1], 1)
    B = _rigid((x - middle[part]) / domain.mean_edge_length) * free[:, :, None]
    gram = np.zeros((count, B.shape[2], B.shape[2]))
    np.add.at(gram, part, np.einsum("ndi,ndj->nij", B, B))
    values, vectors = np.linalg.eigh(sum_over_ranks(comm, gram))
    retained = values > policy.dependent_motion * np.maximum(values[:, -1:], 1.0)
    scaled = np.where(retained, 1 / np.sqrt(np.where(retained, values, 1.0)), 0.0)
    columns = np.where(retained, np.cumsum(retained).reshape(retained.shape) - 1, -1)
    return columns[part], np.einsum("ndi,nij,nj->ndj", B, vectors[part], scaled[part]), int(retained.sum())


def _rigid(r: Values) -> Values:
    """(n, d, 3 or 6) translations and rotations at r (n, d) from where the latter turn about."""
    n, d = r.shape
    turns = [(0, 1)] if d == 2 else [(0, 1), (1, 2), (2, 0)]
    B = np.zeros((n, d, d + len(turns)))
    B[:, range(d), range(d)] = 1.0
    for column, (i, j) in enumerate(turns, d):
        B[:, i, column], B[:, j, column] = -r[:, j], r[:, i]
    return B


def _summed(comm: MPI.Comm, part: csr_matrix) -> csr_matrix:
    """Over the ranks, on all of them (collective)."""
    if comm.size == 1:
        return csr_matrix(part)
    entries = part.tocoo()
    rows, columns, values = zip(*allgather(comm, (entries.row, entries.col, entries.data)), strict=True)
    total = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return csr_matrix(total, shape=part.shape)
