"""Positions of cuts on broken edges that give a smooth crack surface in output.

The crack surface separates the ends of each broken edge. The cut c_e = x_i + s_e (x_j - x_i) of an edge moves towards
the mean of the cuts that share a cell with it:

    s_e <- (1 - w) s_e + w (mean c - x_i) . (x_j - x_i) / |x_j - x_i|^2,        s_e in [0.15, 0.85].

This is damped Laplacian smoothing along the edges: a nearly planar surface becomes planar on any mesh. The surface
stays closed and its volume is unchanged, whatever the cuts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix

from .entity_numbering import EntityNumbering

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class CutSmoothing:
    """Numbers of the positions of cuts on edges.

    Attributes:
        min_distance: of a cut from an end of its edge, in lengths of the edge; thinner parts have no room for contact.
        damping: w.
        iterations: of the smoothing.
    """

    min_distance: float = 0.15
    damping: float = 0.5
    iterations: int = 30


CUTS = CutSmoothing()


def smooth_cuts(topology: EntityNumbering, broken: npt.NDArray[np.bool_], cut: Values | None = None) -> Values:
    """(E,) cuts of broken edges as shares from the lower node, NaN for intact edges; values in `cut` (E,) are kept."""
    result = np.full(len(broken), np.nan)
    broken_edges = np.flatnonzero(broken)
    if not len(broken_edges):
        return result
    ends = topology.points[topology.edges[broken_edges]]
    start, along = ends[:, 0], ends[:, 1] - ends[:, 0]
    share: Values = np.full(len(broken_edges), 0.5)
    free = np.ones(len(broken_edges), bool) if cut is None else np.isnan(cut[broken_edges])
    if cut is not None:
        share[~free] = cut[broken_edges][~free]
    mean = _neighbours(topology, broken)
    per = 1.0 / np.einsum("ni,ni->n", along, along)
    for _ in range(CUTS.iterations if free.any() else 0):
        wanted = mean @ (start + share[:, None] * along)
        pulled = (1 - CUTS.damping) * share + CUTS.damping * per * np.einsum("ni,ni->n", wanted - start, along)
        share = np.where(free, np.clip(pulled, CUTS.min_distance, 1 - CUTS.min_distance), share)
    result[broken_edges] = share
    return result


def _neighbours(topology: EntityNumbering, broken: npt.NDArray[np.bool_]) -> coo_matrix:
    """(n, n) matrix of means over the broken edges that share a cell with each broken edge, itself included."""
    cells = np.flatnonzero(broken[topology.cell_edges].any(axis=1))
    row, column = np.nonzero(broken[topology.cell_edges[cells]])
    number = np.cumsum(broken) - 1
    edge = number[topology.cell_edges[cells[row], column]]
    member = coo_matrix((np.ones(len(row)), (row, edge)), shape=(len(cells), int(broken.sum()))).tocsr()
    shared = member.T @ member
    # independent of the number of shared cells
    shared.data[:] = 1.0
    return shared.multiply(1.0 / shared.sum(axis=1)).tocsr()
