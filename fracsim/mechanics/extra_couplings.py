"""Stiffness between nodes that share no cell: matrices over the dofs of all ranks, and their stiff directions.

Two points in contact move as one along their normal. Smoothers and aggregates of multigrid do not represent such a
motion: with 15 pairs in contact CG takes 75 iterations where the body alone takes 12. The few stiff directions are
found here and eliminated exactly (solvers.low_rank), with the preconditioner of the body.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from petsc4py import PETSc

from ..mesh.domain import Domain
from ..mesh.parallel import allgather

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


class CouplingBuilder:
    """Builder of the coupling matrix of a term (`Term.coupling_matrix`), which owns the last one."""

    def __init__(self, domain: Domain) -> None:
        self._domain = domain
        self._last: PETSc.Mat | None = None

    def __call__(self, part: csr_matrix, nodes: Ints) -> PETSc.Mat:
        """Sum over ranks of their parts, as a matrix over all dofs (collective).

        Args:
            part: (n d, n d) stiffness, N/m.
            nodes: (n,) global numbers of its nodes.
        """
        self.destroy()
        d, owned = self._domain.dim, self._domain.node_count * self._domain.dim
        matrix = self._last = PETSc.Mat().create(self._domain.comm)
        matrix.setSizes(((owned, PETSc.DETERMINE),) * 2, bsize=d)
        matrix.setType(PETSc.Mat.Type.AIJ)
        matrix.setUp()
        dofs = (d * nodes[:, None] + np.arange(d)).reshape(-1).astype(PETSc.IntType)
        rows = np.flatnonzero(np.diff(part.indptr))
        start, columns = part.indptr[np.append(rows, len(dofs))].astype(PETSc.IntType), dofs[part.indices]
        matrix.setValuesIJV(start, columns, part.data, PETSc.InsertMode.ADD_VALUES, dofs[rows])
        matrix.assemble()
        return matrix

    def destroy(self) -> None:
        """Free PETSc's matrix."""
        if self._last is not None:
            self._last.destroy()
            self._last = None


@dataclass(frozen=True)
class StiffCoupling:
    """Coupling C + U diag(k) U^T, of which the second part is stiff and stays beside the tangent.

    Attributes:
        matrix: C over the dofs of all ranks, N/m.
        directions: (owned dofs, m) U.
        stiffness: (m,) k > 0, N/m.
    """

    matrix: PETSc.Mat
    directions: Values
    stiffness: Values


@dataclass(frozen=True)
class StiffDirectionLimits:
    """Bounds above which stiff directions are not eliminated: it would cost more than the iterations that it saves.

    With groups of 450 dofs four plates at rest on one another (688 nodes) took 43 s instead of 9 s.

    Attributes:
        group_dofs: most dofs of a group of coupled points.
        directions: most stiff directions of all groups.
    """

    group_dofs: int = 240
    directions: int = 64


LIMITS = StiffDirectionLimits()


def stiff_directions(H: csr_matrix, least: float, comm: MPI.Comm = MPI.COMM_SELF) -> tuple[csr_matrix, Values] | None:
    """Eigenvectors (n, m) and eigenvalues (m,), N/m, above `least`, of a symmetric matrix; None beyond LIMITS.

    The matrix is the sum of H (n, n) over the ranks (collective).
    """
    from scipy.sparse import csr_matrix, hstack  # a run without contact does without SciPy

    rows, group, sizes = _coupled_groups(H)
    # groups of the sum are no smaller
    if comm.allreduce(int(sizes.max(initial=0)), op=MPI.MAX) > LIMITS.group_dofs:
        return None
    if comm.size > 1:
        H = csr_matrix(sum(allgather(comm, H)))
        rows, group, sizes = _coupled_groups(H)
        if sizes.max(initial=0) > LIMITS.group_dofs:
            return None
    coupled = H[rows][:, rows]
    # no eigenvalue is above the largest sum of absolute values of a row (Gershgorin)
    bound = np.zeros(len(sizes))
    np.maximum.at(bound, group, np.asarray(abs(coupled).sum(axis=1)).reshape(-1))
    columns, values = [csr_matrix((H.shape[0], 0))], list[Values]()
    for part in np.split(np.argsort(group, kind="stable"), np.cumsum(sizes)[:-1]) if len(rows) else []:
        if bound[group[part[0]]] <= least:
            continue
        eigenvalues, vectors = np.linalg.eigh(coupled[part][:, part].toarray())
        stiff = eigenvalues > least
        count = int(stiff.sum())
        entries = np.repeat(rows[part], count), np.tile(np.arange(count), len(part))
        columns.append(csr_matrix((vectors[:, stiff].reshape(-1), entries), shape=(H.shape[0], count)))
        values.append(eigenvalues[stiff])
    stiffness: Values = np.concatenate(values) if values else np.empty(0)
    return None if len(stiffness) > LIMITS.directions else (csr_matrix(hstack(columns)), stiffness)


def _coupled_groups(H: csr_matrix) -> tuple[Ints, Ints, Ints]:
    """(k,) rows with entries of a symmetric matrix, (k,) their groups that the entries couple, and sizes of these."""
    from scipy.sparse.csgraph import connected_components

    rows = np.flatnonzero(np.diff(H.indptr))
    _, group = connected_components(H[rows][:, rows], directed=False)
    return rows, group, np.bincount(group)
