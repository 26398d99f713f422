"""Deflation: the rigid motions of fragments that are attached by a node or an edge, or detached, as a coarse space.

Inertia alone resists the rigid motion of such fragments, some 1e-7 of a stiffness in long steps, and there are hundreds
of them along a crack. Multigrid's aggregates span the hinges, so that CG needs iterations for each motion. Z of the
balancing preconditioner (solvers.balancing) has the rigid motions of small fragments, with the nodes that no larger
fragment has and the nodes that are tied to it (mechanics.node_ties). A larger one has aggregates of its own. Source:
Nicolaides (1987).

Equations: docs/theory.md#linear-systems.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import csr_matrix

from ..mechanics.balance import Balance
from ..mechanics.extra_couplings import dofs_of_nodes
from ..mechanics.term_protocols import TieTerm
from ..mesh.domain import Domain
from ..mesh.node_cells import node_components
from ..mesh.parallel import allgather, sum_over_ranks
from .balancing import BalancingPreconditioner
from .policy import DEFAULT_POLICY, SolverPolicy

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


class FragmentDeflation:
    """Balancing preconditioner with the rigid motions of fragments.

    Attributes:
        base_pc: M.
        pc: P; None if all motions of the fragments are prescribed, so that there is nothing to deflate.
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
        self.pc: PETSc.PC | None = None

    def update(self) -> None:
        """Set up P for the tangent K at the present displacement (collective).

        P remains symmetric and positive definite for later tangents, with K of this one.
        """
        self.destroy()
        Zt = self._transposed_motions()
        if not Zt.shape[0]:
            return
        balance, comm = self._balance, self._balance.domain.comm
        first = balance.work_vector.getOwnershipRange()[0]
        owned_Zt = Zt[:, first + dofs_of_nodes(self._nodes, balance.domain.dim)]
        ZtK = _sum_over_ranks(comm, owned_Zt @ balance.tangent.owned_rows(self._nodes))
        Zt = _sum_over_ranks(comm, Zt)
        self.pc = BalancingPreconditioner(self.base_pc, Zt, ZtK, balance.work_vector).to_petsc()

    def _transposed_motions(self) -> csr_matrix:
        """Return the part of Z^T of this rank's nodes, (columns of Z, dofs of all ranks) (collective)."""
        balance, domain, d = self._balance, self._balance.domain, self._balance.domain.dim
        x, free = domain.nodes[self._nodes], balance.motion.free_dofs.reshape(-1, d)[self._nodes]
        if not balance.linear:
            x = x + balance.u.x.array.reshape(-1, d)[self._nodes]
        columns, values, width = _rigid_motions(domain, self._fragment, x, free, self._count, self._policy)
        first = balance.work_vector.getOwnershipRange()[0]
        dofs = first + dofs_of_nodes(self._nodes, d).reshape(-1, d, 1)
        present = np.broadcast_to((columns >= 0)[:, None], values.shape)
        column, dof = (np.broadcast_to(item, values.shape)[present] for item in (columns[:, None], dofs))
        return csr_matrix((values[present], (column, dof)), shape=(width, balance.work_vector.getSize()))

    def destroy(self) -> None:
        """Free P."""
        if self.pc is not None:
            self.pc.destroy()
            self.pc = None


def create_deflation(
    balance: Balance, base_pc: PETSc.PC, policy: SolverPolicy = DEFAULT_POLICY, max_nodes: float = np.inf
) -> FragmentDeflation | None:
    """Return the deflation of the present body; None if it has no such fragment or cannot break (collective).

    Args:
        balance: balance of forces.
        base_pc: M.
        policy: tolerance of dependent motions.
        max_nodes: largest number of nodes of a deflated fragment.
    """
    domain, multiplier = balance.domain, balance.stress.energy_multiplier
    # A restart tells of damage that may have changed, also to a body that cannot break.
    if multiplier is None:
        return None
    count, fragment = node_components(domain, multiplier.x.array[: domain.cell_count] > 0)
    _assign_tied_nodes(balance, fragment)
    sizes = sum_over_ranks(domain.comm, np.bincount(fragment[fragment >= 0], minlength=count))
    is_small = sizes <= max_nodes
    is_small[:1] = False  # the largest fragment
    if not is_small.any():
        return None
    nodes = np.flatnonzero((fragment >= 0) & is_small[fragment])
    number = np.cumsum(is_small) - 1
    return FragmentDeflation(balance, base_pc, nodes, number[fragment[nodes]], int(is_small.sum()), policy)


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
