"""Deflation: a two-level preconditioner for fragments that are attached by a node or an edge, or detached.

Inertia alone resists the rigid motion of such fragments, some 1e-7 of a stiffness in long steps, and there are hundreds
of them along a crack. Multigrid's aggregates span the hinges, so that CG needs iterations for each motion.

    P = Q + (1 - Q K) M (1 - K Q),   Q = Z E^-1 Z^T,   E = Z^T K Z

M is the preconditioner of the body. Z has the rigid motions of all fragments but the largest, with the nodes that no
larger fragment has and the nodes that are tied to it (mechanics.node_ties). K Z has few rows, so that P costs as much
as M (Nicolaides 1987; Mandel 1993; Tang et al. 2009).

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
    """Context of the PETSc preconditioner P.

    Attributes:
        base_pc: M.
        pc: P.
    """

    def __init__(
        self, balance: Balance, base_pc: PETSc.PC, nodes: Ints, fragment: Ints, count: int, policy: SolverPolicy
    ) -> None:
        """Prepare the deflation of fragments.

        Args:
            balance: balance of forces.
            base_pc: M.
            nodes: (n,) owned nodes of the fragments.
            fragment: (n,) fragment of each node.
            count: number of fragments.
            policy: tolerance of dependent motions.
        """
        self._balance, self.base_pc, self._policy = balance, base_pc, policy
        self._nodes, self._fragment, self._count = nodes, fragment, count
        self.pc = PETSc.PC().create(balance.domain.comm)
        self.pc.setType("python")
        self.pc.setPythonContext(ApplyContext(self.apply))
        self._residual = balance.work_vector.duplicate()

    def update_operator(self, tangent: PETSc.Mat) -> bool:
        """Set up P for a tangent at the present displacement (collective).

        P remains symmetric and positive definite for later tangents, with K of this one.

        Returns:
            False if all motions of the fragments are prescribed, so that there is nothing to deflate.
        """
        balance, domain = self._balance, self._balance.domain
        x, free = domain.nodes[self._nodes], balance.motion.free_dofs.reshape(-1, domain.dim)[self._nodes]
        if not balance.linear:
            x = x + balance.u.x.array.reshape(-1, domain.dim)[self._nodes]
        columns, values, width = _rigid_motions(domain, self._fragment, x, free, self._count, self._policy)
        if not width:
            return False
        self._factorise(columns, values, width)
        self.pc.setOperators(tangent)
        return True

    def _factorise(self, columns: Ints, values: Values, width: int) -> None:
        """Compute Z, K Z, their transposes and the factors of E (collective)."""
        domain = self._balance.domain
        comm, d = domain.comm, domain.dim
        nodes = domain.space.dofmap.index_map
        first, size = d * nodes.local_range[0], d * nodes.size_global
        self._dofs: Ints = (d * self._nodes[:, None] + np.arange(d)).reshape(-1)
        present = np.broadcast_to((columns >= 0)[:, None], values.shape)
        row, column = (np.broadcast_to(item, values.shape)[present] for item in
                       (first + self._dofs.reshape(-1, d, 1), columns[:, None]))  # fmt: skip
        Z = csr_matrix((values[present], (row, column)), shape=(size, width))
        self._Z = Z[first + self._dofs]
        self._Zt = self._Z.T.tocsr()
        ZtK = _sum_over_ranks(comm, self._Zt @ self._balance.tangent.owned_rows(self._nodes))
        E = ZtK @ _sum_over_ranks(comm, Z)
        self._solve_coarse = splu(E.tocsc()).solve
        owned = ZtK[:, first : first + d * nodes.size_local].T.tocsr()
        # Owned dofs in which K Z has entries.
        self._coupled_dofs = np.flatnonzero(np.diff(owned.indptr))
        self._KZ = owned[self._coupled_dofs]
        self._KZt = self._KZ.T.tocsr()

    def apply(self, _: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Evaluate y = P x (collective)."""
        comm, dofs, coupled, residual = self._balance.domain.comm, self._dofs, self._coupled_dofs, self._residual
        x.copy(residual)
        motion = self._solve_coarse(sum_over_ranks(comm, self._Zt @ residual.array_r[dofs]))
        residual.array_w[coupled] -= self._KZ @ motion
        self.base_pc.apply(residual, y)
        motion -= self._solve_coarse(sum_over_ranks(comm, self._KZt @ y.array_r[coupled]))
        y.array_w[dofs] += self._Z @ motion

    def destroy(self) -> None:
        """Free PETSc's objects."""
        self.pc.destroy()
        self._residual.destroy()


def create_deflation(
    balance: Balance, base_pc: PETSc.PC, policy: SolverPolicy = DEFAULT_POLICY
) -> DeflatedPreconditioner | None:
    """Return the deflation of the present body; None if it is in one piece or cannot break (collective)."""
    domain, multiplier = balance.domain, balance.stress.energy_multiplier
    # A restart tells of damage that may have changed, also to a body that cannot break.
    if multiplier is None:
        return None
    count, fragment = node_components(domain, multiplier.x.array[: domain.cell_count] > 0)
    # Fragment 0 is the largest.
    _assign_tied_nodes(balance, fragment)
    nodes = np.flatnonzero(fragment > 0)
    if count <= 1:
        return None
    return DeflatedPreconditioner(balance, base_pc, nodes, fragment[nodes] - 1, count - 1, policy)


def _assign_tied_nodes(balance: Balance, fragment: Ints) -> None:
    """Assign nodes without an intact cell to the fragment to which they are tied (collective).

    The smallest of several fragments is taken. Numbers increase as fragments get smaller.

    Args:
        balance: its terms have the ties.
        fragment: (owned nodes,) number of the fragment, negative without an intact cell; changed in place.
    """
    for tied in filter(
        None, (term.tie_matrix(balance.motion.free_dofs) for term in balance.terms if isinstance(term, TieTerm))
    ):
        # Numbers from 1 on, of the nodes of all ranks; 0 without a fragment.
        numbers = np.zeros(tied.K.shape[0], np.int64)
        numbers[tied.indices] = fragment[tied.nodes] + 1
        numbers = sum_over_ranks(balance.domain.comm, numbers)
        largest, K = numbers.copy(), tied.K.tocoo()
        np.maximum.at(largest, K.row, numbers[K.col])
        alone = fragment[tied.nodes] < 0
        fragment[tied.nodes[alone]] = largest[tied.indices[alone]] - 1


def _rigid_motions(
    domain: Domain, fragment: Ints, x: Values, free: npt.NDArray[np.bool_], count: int, policy: SolverPolicy
) -> tuple[Ints, Values, int]:
    """Return orthonormal rigid motions of fragments (collective).

    Args:
        domain: gives mean edge and ranks.
        fragment: (n,) fragment of the nodes of this rank.
        x: (n, d) positions, m.
        free: (n, d) flags of dofs without a prescribed displacement.
        count: number of fragments.
        policy: tolerance of dependent motions.

    Returns:
        Columns (n, r) of Z, -1 where a motion depends on others, its values (n, d, r), and the number of columns.
    """
    comm, d = domain.comm, x.shape[1]
    sums: Values = np.zeros((count, d + 1))
    np.add.at(sums, fragment, np.concatenate([np.ones((len(x), 1)), x], axis=1))
    sums = sum_over_ranks(comm, sums)
    centre = sums[:, 1:] / np.maximum(sums[:, :1], 1)
    B = _rigid_modes((x - centre[fragment]) / domain.mean_edge_length) * free[:, :, None]
    gram = np.zeros((count, B.shape[2], B.shape[2]))
    np.add.at(gram, fragment, np.einsum("ndi,ndj->nij", B, B))
    values, vectors = np.linalg.eigh(sum_over_ranks(comm, gram))
    retained = values > policy.dependent_motion_tolerance * np.maximum(values[:, -1:], 1.0)
    scaled = np.where(retained, 1 / np.sqrt(np.where(retained, values, 1.0)), 0.0)
    columns = np.where(retained, np.cumsum(retained).reshape(retained.shape) - 1, -1)
    return columns[fragment], np.einsum("ndi,nij,nj->ndj", B, vectors[fragment], scaled[fragment]), int(retained.sum())


def _rigid_modes(r: Values) -> Values:
    """Return translations and rotations (n, d, 3 or 6) at positions r (n, d) relative to their centre."""
    n, d = r.shape
    planes = [(0, 1)] if d == 2 else [(0, 1), (1, 2), (2, 0)]
    B = np.zeros((n, d, d + len(planes)))
    B[:, range(d), range(d)] = 1.0
    for column, (i, j) in enumerate(planes, d):
        B[:, i, column], B[:, j, column] = -r[:, j], r[:, i]
    return B


def _sum_over_ranks(comm: MPI.Comm, matrix: csr_matrix) -> csr_matrix:
    """Return the sum of the matrices of all ranks (collective)."""
    if comm.size == 1:
        return csr_matrix(matrix)
    entries = matrix.tocoo()
    rows, columns, values = zip(*allgather(comm, (entries.row, entries.col, entries.data)), strict=True)
    total = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return csr_matrix(total, shape=matrix.shape)
