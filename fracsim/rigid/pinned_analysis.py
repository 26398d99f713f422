"""B07's way with a free body, for comparison: three of its nodes are pinned, so that nothing is left to move.

Node a in all directions, node b in those across ab, node c out of the plane abc: 6 components in 3D, 3 in 2D. The load
is not in balance, and what it is out of balance by strains the body around the three nodes (B07 sec. 5).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc
from scipy.sparse import bmat, csr_matrix
from scipy.sparse.linalg import spsolve

Values = npt.NDArray[np.float64]


def pins(places: Values) -> Values:
    """(k, n d) rows, one a pin, of the components that are held of nodes at places (n, d): k = 3 in 2D, 6 in 3D.

    Node a is the farthest from the middle, b the farthest from a, c the farthest from the line ab.
    """
    n, d = places.shape
    a = int(np.argmax(np.linalg.norm(places - places.mean(axis=0), axis=1)))
    b = int(np.argmax(np.linalg.norm(places - places[a], axis=1)))
    along = (places[b] - places[a]) / np.linalg.norm(places[b] - places[a])
    arm = places - places[a]
    beside = arm - np.outer(arm @ along, along)
    c = int(np.argmax(np.linalg.norm(beside, axis=1)))
    first = beside[c] / np.linalg.norm(beside[c])
    held = [(a, axis) for axis in np.eye(d)] + [(b, first)]
    if d == 3:
        normal = np.cross(along, first)
        held += [(b, normal), (c, normal)]
    rows = np.zeros((len(held), n, d))
    for row, (node, direction) in zip(rows, held, strict=True):
        row[node] = direction
    return rows.reshape(len(held), -1)


def pinned(matrix: PETSc.Mat, places: Values, force: Values) -> Values:
    """(n, d) displacement of nodes at places (n, d) with K u = f and the pins held, by factors (one rank)."""
    held = pins(places)
    start, columns, entries = matrix.getValuesCSR()
    K, C = csr_matrix((entries, columns, start), shape=matrix.size), csr_matrix(held)
    both = bmat([[K, C.T], [C, None]], format="csc")
    u = spsolve(both, np.concatenate([force.reshape(-1), np.zeros(len(held))]))[: force.size]
    return np.asarray(u).reshape(places.shape)
