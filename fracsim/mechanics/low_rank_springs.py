"""Stiffness between few nodes that is far above that of the body: kept beside the tangent instead of in it.

Two points that are pressed together move as one along their normal. Multigrid's smoothers and aggregates know nothing
of such a motion: with 15 pairs in touch CG takes 75 iterations where the body alone takes 12. The few stiff directions
are told apart here, and seen to exactly (solvers.low_rank), with the body's own preconditioner.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

Values = npt.NDArray[np.float64]

# dofs in one group of points that are coupled, and stiff directions in all. More of them cost more than the iterations
# that they save: with groups of 450 dofs four plates at rest on one another (688 nodes) took 43 s where this takes 9 s
DOFS, DIRECTIONS = 240, 64


@dataclass(frozen=True)
class StiffCoupling:
    """A share C of the tangent, and U diag(k) U^T in it that is stiff.

    Attributes:
        matrix: C over the dofs of all ranks, N/m.    directions: (owned dofs, m) U.    stiffness: (m,) k > 0, N/m.
    """

    matrix: PETSc.Mat
    directions: Values
    stiffness: Values


def stiff_directions(H: csr_matrix, least: float) -> tuple[csr_matrix, Values] | None:
    """(n, m) orthonormal eigenvectors of a symmetric H (n, n) and (m,) eigenvalues above `least`, N/m; None where more
    than DOFS rows are coupled, or there are more than DIRECTIONS such values."""
    from scipy.sparse import csr_matrix, hstack  # a run without contact does without SciPy
    from scipy.sparse.csgraph import connected_components

    rows = np.flatnonzero(np.diff(H.indptr))
    own = H[rows][:, rows]
    _, group = connected_components(own, directed=False)
    sizes = np.bincount(group)
    if sizes.max(initial=0) > DOFS:
        return None
    columns, values = [csr_matrix((H.shape[0], 0))], list[Values]()
    for part in np.split(np.argsort(group, kind="stable"), np.cumsum(sizes)[:-1]):
        found, vectors = np.linalg.eigh(own[part][:, part].toarray())
        stiff = found > least
        count = int(stiff.sum())
        at = np.repeat(rows[part], count), np.tile(np.arange(count), len(part))
        columns.append(csr_matrix((vectors[:, stiff].reshape(-1), at), shape=(H.shape[0], count)))
        values.append(found[stiff])
    stiffness: Values = np.concatenate(values) if values else np.empty(0)
    return None if len(stiffness) > DIRECTIONS else (csr_matrix(hstack(columns)), stiffness)
