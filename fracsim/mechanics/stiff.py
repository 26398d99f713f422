"""Stiffness between few nodes that is far above that of the body: kept beside the tangent instead of in it.

Two points that are pressed together move as one along their normal. Multigrid's smoothers and aggregates know nothing
of such a motion: with 15 pairs in touch CG takes 75 iterations where the body alone takes 12. The few stiff directions
are told apart here, and seen to exactly (stepping.woodbury), with the body's own preconditioner.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc
from scipy.sparse import csr_matrix

Values = npt.NDArray[np.float64]

DOFS, DIRECTIONS = 450, 64  # of what is few: more is dearer than the iterations that it saves


@dataclass(frozen=True)
class Stiff:
    """A share C of the tangent, and U diag(k) U^T in it that is stiff.

    Attributes:
        matrix: C over the dofs of all ranks, N/m.    directions: (owned dofs, m) U.    stiffness: (m,) k > 0, N/m.
    """

    matrix: PETSc.Mat
    directions: Values
    stiffness: Values


def stiff_directions(H: csr_matrix, least: float) -> tuple[csr_matrix, Values] | None:
    """(n, m) orthonormal eigenvectors of a symmetric H (n, n) and (m,) eigenvalues above `least`, N/m; None where H
    has more than DOFS rows that are not empty, or more than DIRECTIONS such values."""
    rows = np.flatnonzero(np.diff(H.indptr))
    if len(rows) > DOFS:
        return None
    values, vectors = np.linalg.eigh(H[rows][:, rows].toarray())
    stiff = np.flatnonzero(values > least)
    if len(stiff) > DIRECTIONS:
        return None
    at = np.repeat(rows, len(stiff)), np.tile(np.arange(len(stiff)), len(rows))
    return csr_matrix((vectors[:, stiff].reshape(-1), at), shape=(H.shape[0], len(stiff))), values[stiff]
