"""Edges break some at a time, in an order that no partition changes, until all is dust: the pieces after each time."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from fracsim.mesh.edge_graph import EdgeGraph
from fracsim.mesh.fragments import find_fragments

from .scenes import make_scene

CASES = {"2d": (2, 0.06, 1), "3d": (3, 0.2, 1), "quadratic": (2, 0.1, 2)}  # dim, h and order
AT_ONCE = 12


def compared() -> dict[str, npt.NDArray[np.generic]]:
    """For each case (searches, 2): whether fragments were those of SciPy, and their count."""
    return {f"parting-{name}": broken_bit_by_bit(*case) for name, case in CASES.items()}


def broken_bit_by_bit(dim: int, h: float, order: int) -> npt.NDArray[np.int64]:
    """(searches, 2) on rank 0: whether fragments are SciPy's, and their count."""
    scene, _ = make_scene(
        mesh={"builder": "box", "size": [1] * dim, "h": h, "pattern": "unstructured", "order": order},
        fracture={"strength": 1.0},
    )
    graph, rows = scene.fracture.graph, []
    turn = _turns(graph)
    for last in np.arange(0, turn[-1] + AT_ONCE, AT_ONCE):
        graph.break_edges(turn[:-1] <= last)
        pieces = find_fragments(graph)
        of_node = graph.domain.input_numbering.gather_nodes(pieces.node_fragment[: graph.domain.node_count])
        keys = graph.broken_keys()
        if keys is not None:
            assert of_node is not None
            same = np.array_equal(of_node[: len(graph.domain.input_mesh.points)], _by_scipy(graph, keys))
            rows.append((same, pieces.count))
    return np.array(rows)


def _turns(graph: EdgeGraph) -> npt.NDArray[np.int64]:
    """(edges + 1,) when each breaks, and how many there are: those across the planes of a grid one after the other, so
    that blocks come off, then all others as places are hashed."""
    nodes, comm = graph.domain.nodes[graph.edge_nodes], graph.domain.comm
    middle = nodes.mean(axis=1)
    across = np.floor(3 * nodes[:, 0]) != np.floor(3 * nodes[:, 1])
    hashed = 100 + np.sin(1e6 * middle.sum(axis=1))
    key = np.round(np.where(across.any(axis=1), middle @ np.arange(1, middle.shape[1] + 1), hashed), 9)
    every = np.unique(np.concatenate(comm.allgather(key)))
    return np.append(np.searchsorted(every, key), len(every))


def _by_scipy(graph: EdgeGraph, broken: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """(points,) components of the input mesh without the edges `broken` (n, 2), numbered by their lowest point."""
    source = graph.domain.input_mesh
    assert source is not None
    first, second = np.triu_indices(source.cells.shape[1], 1)
    pairs = np.sort(np.stack([source.cells[:, first].ravel(), source.cells[:, second].ravel()], axis=1), axis=1)
    gone = np.isin(pairs @ [1 << 32, 1], broken @ [1 << 32, 1])
    links, count = pairs[~gone], len(source.points)
    graph_of_links = coo_matrix((np.ones(len(links)), links.T), shape=(count, count))
    _, label = connected_components(graph_of_links, directed=False)
    lowest = np.unique(label, return_index=True)[1]
    return np.asarray(np.argsort(np.argsort(lowest))[label])
