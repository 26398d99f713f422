"""Where broken edges are cut so that the crack that is drawn is smooth, and not the cells around the nodes.

A crack is the zero of a field that has one sign at each end of every edge that it broke. The field is left open but for
its zeros: of the cuts c_e = x_i + s_e (x_j - x_i) each is pulled towards the mean of those it shares a cell with,

    s_e <- (1 - w) s_e + w (mean c - x_i) . (x_j - x_i) / |x_j - x_i|^2,        kept within [KEPT, 1 - KEPT],

a damped Laplacian along the edges: a surface that is nearly flat becomes flat, whatever the mesh. Closedness and volume
of the split surface do not depend on where its edges are cut.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix

from .entity_numbering import EntityNumbering

Values = npt.NDArray[np.float64]
KEPT = 0.15  # of an edge: what each end has of it at least
DAMPING, TIMES = 0.5, 30


def smooth_cuts(skeleton: EntityNumbering, broken: npt.NDArray[np.bool_], cut: Values | None = None) -> Values:
    """(E,) shares of edges from the lower node, NaN of whole ones; those that have a place in `cut` (E,) keep it."""
    result = np.full(len(broken), np.nan)
    at = np.flatnonzero(broken)
    if not len(at):
        return result
    ends = skeleton.points[skeleton.edges[at]]
    start, along = ends[:, 0], ends[:, 1] - ends[:, 0]
    share: Values = np.full(len(at), 0.5)
    free = np.ones(len(at), bool) if cut is None else np.isnan(cut[at])
    if cut is not None:
        share[~free] = cut[at][~free]
    mean = _neighbours(skeleton, broken)
    per = 1.0 / np.einsum("ni,ni->n", along, along)
    for _ in range(TIMES if free.any() else 0):
        wanted = mean @ (start + share[:, None] * along)
        pulled = (1 - DAMPING) * share + DAMPING * per * np.einsum("ni,ni->n", wanted - start, along)
        share = np.where(free, np.clip(pulled, KEPT, 1 - KEPT), share)
    result[at] = share
    return result


def _neighbours(skeleton: EntityNumbering, broken: npt.NDArray[np.bool_]) -> coo_matrix:
    """(n, n) rows are means over the broken edges that share a cell with a broken edge, itself among them."""
    cells = np.flatnonzero(broken[skeleton.cell_edges].any(axis=1))
    row, column = np.nonzero(broken[skeleton.cell_edges[cells]])
    place = np.cumsum(broken) - 1
    edge = place[skeleton.cell_edges[cells[row], column]]
    member = coo_matrix((np.ones(len(row)), (row, edge)), shape=(len(cells), int(broken.sum()))).tocsr()
    shared = member.T @ member
    shared.data[:] = 1.0  # however many cells two of them share
    return shared.multiply(1.0 / shared.sum(axis=1)).tocsr()
