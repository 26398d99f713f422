"""Corrections that would throw few nodes far are held back there, so that all others go their whole way.

With moduli made positive a cell that is all but flat, or hangs by a node, has next to no stiffness in some direction:
Newton's correction throws its nodes tens to hundreds of edges far, and the line search cuts everybody's to a twentieth
for their sake, iteration after iteration. So a node goes no further than an edge, unless many would: what a whole part
does is its motion. What is held back is found again from where it has come to.
"""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from ..mesh.domain import Domain
from ..mesh.ranks import total

FEW = 0.03  # of all nodes, which are held back at most


def hold_back(domain: Domain, y: PETSc.Vec, r: PETSc.Vec) -> None:
    """Shorten a correction x <- x - y, m, of the FEW nodes that go further than an edge, where it still leads down a
    potential whose derivative at x is `r`, N (collective)."""
    moves = y.array_r.reshape(-1, domain.dim)
    lengths, far = np.sqrt((moves * moves).sum(axis=1)), domain.mean_edge
    most = FEW * domain.space.dofmap.index_map.size_global
    while (beyond := total(domain.comm, np.count_nonzero(lengths > far))[0]) > most:
        far *= 2
    if not beyond:
        return
    whole = y.copy()
    y.array_w[:] = (moves * np.minimum(1.0, far / np.maximum(lengths, far))[:, None]).reshape(-1)
    if y.dot(r) <= 0:
        whole.copy(y)
    whole.destroy()
