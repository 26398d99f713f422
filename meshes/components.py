"""Connected components of a graph given by its links."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from .data import Indices


def components(links: npt.NDArray[np.integer], count: int) -> tuple[int, Indices]:
    """How many parts `count` nodes fall into that are joined by `links` (n, 2), and the part of each node.

    Parts are numbered by their lowest node.
    """
    # not by the process that fills a surface, which takes longer to import SciPy than most surfaces to be filled
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(links), np.int8), (links[:, 0], links[:, 1])), shape=(count, count))
    parts, label = connected_components(graph, directed=False)
    return int(parts), label.astype(np.int64)
