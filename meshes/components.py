"""Connected components of a graph given by its links."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from .data import Indices


def components(links: npt.NDArray[np.integer], count: int) -> tuple[int, Indices]:
    """How many parts `count` nodes fall into that are joined by `links` (n, 2), and the part of each node.

    Parts are numbered by their lowest node. Each round hooks the roots of trees that a link joins on the lowest root
    beside them, and makes the trees flat (Shiloach and Vishkin 1982): at most log2 rounds. SciPy has it too, but takes
    longer to be imported than most meshes to be looked at, and as long as this for large ones.
    """
    root: Indices = np.arange(count)
    first, second = links[:, 0], links[:, 1]
    while True:
        ends = root[first], root[second]
        apart = ends[0] != ends[1]
        if not apart.any():
            break
        first, second = first[apart], second[apart]
        low, high = np.minimum(*ends)[apart], np.maximum(*ends)[apart]
        np.minimum.at(root, high, low)
        root = _flattened(root)
    is_root = root == np.arange(count)
    return int(is_root.sum()), (np.cumsum(is_root) - 1)[root]


def _flattened(parent: Indices) -> Indices:
    """(n,) the root of each node of trees given by parents, which are their own at roots."""
    while not np.array_equal(above := parent[parent], parent):
        parent = above
    return parent
