"""Duplication of cut cells with virtual nodes: the equations of methods that represent a crack by added unknowns.

The baseline of the report, after Molino, Bao and Fedkiw (2004), A virtual node algorithm for changing mesh topology
during simulation; Bao et al. (2007) use it for fracture. The unknowns are those that an extended finite element method
with shifted Heaviside functions adds.

A cut cell becomes one copy for each group of nodes that its intact edges connect. A copy owns the nodes of its group;
its other nodes are virtual. Copies in neighbouring cells belong to the same material if they own a common node of the
shared face. They then share all nodes of that face, so that the displacement is continuous.

At a crack tip two copies of a cell may then share a whole face, which would have three cells. DOLFINx does not support
such meshes: the copy that owns fewer nodes of the face keeps its virtual nodes there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class DuplicatedMesh:
    """Mesh with copies of cut cells.

    Attributes:
        cells: (copies, d + 1) new nodes.
        owned: (copies, d + 1) whether the copy owns the node; the others are virtual.
        cell: (copies,) original cell of each copy.
        node: (new nodes,) original node of each.
        share: (copies,) share of the cell's material: owned nodes over d + 1. Sums to 1 over the copies of a cell.
    """

    cells: Ints
    owned: npt.NDArray[np.bool_]
    cell: Ints
    node: Ints
    share: npt.NDArray[np.float64]


def duplicate_cut_cells(cells: npt.NDArray[np.integer], groups: npt.NDArray[np.integer], nodes: int) -> DuplicatedMesh:
    """Copies of `cells` (m, d + 1) by `groups` (m, d + 1), the lowest local node connected to each local node."""
    corners: Ints = np.asarray(cells, np.int64)
    joined: Ints = np.asarray(groups, np.int64)
    leads = joined == np.arange(corners.shape[1])  # a copy for each group, named by its lowest node
    number: Ints = np.cumsum(leads).reshape(leads.shape) - 1
    of_node: Ints = np.take_along_axis(number, joined, axis=1)  # (m, d + 1) the copy that owns each local node
    cell, lead = np.nonzero(leads)
    owned = joined[cell] == lead[:, None]
    own, shared = _owned_pairs(corners, of_node, nodes), _shared_face_pairs(corners, joined, of_node, nodes)
    alone = np.zeros(len(cell), bool)
    while True:
        kept = shared[:, ~alone[(shared - nodes) // corners.shape[1]].any(axis=0)]
        places, source = _merge_nodes(np.concatenate([own, kept], axis=1), nodes, corners[cell])
        results = _third_cells_of_faces(places, owned, cell) & ~alone
        if not results.any():
            return DuplicatedMesh(places, owned, cell, source, owned.mean(axis=1))
        alone |= results


def _merge_nodes(pairs: Ints, nodes: int, originals: Ints) -> tuple[Ints, Ints]:
    """New nodes (copies, d + 1) and the original of each; nodes of copies that `pairs` connect become one."""
    total = nodes + originals.size
    graph = coo_array((np.ones(pairs.shape[1], bool), (pairs[0], pairs[1])), (total, total))
    count, label = connected_components(graph, directed=False)
    source = np.empty(count, np.int64)
    source[label[:nodes]] = np.arange(nodes)
    places: Ints = label[nodes:].reshape(originals.shape).astype(np.int64)
    source[places] = originals
    return places, source


def _third_cells_of_faces(places: Ints, owned: npt.NDArray[np.bool_], cell: Ints) -> npt.NDArray[np.bool_]:
    """Flags (copies,) of copies that share a face with another copy of their cell and own fewer of its nodes."""
    result, width = np.zeros(len(cell), bool), places.shape[1]
    for apart in range(1, width):  # copies of a cell follow each other
        a = np.flatnonzero(cell[apart:] == cell[:-apart])
        b = a + apart
        face = places[a] == places[b]
        whole = np.count_nonzero(face, axis=1) >= width - 1
        a, b, face = a[whole], b[whole], face[whole]
        less = np.count_nonzero(owned[a] & face, axis=1) < np.count_nonzero(owned[b] & face, axis=1)
        result[np.where(less, a, b)] = True
    return result


def _owned_pairs(cells: Ints, of_node: Ints, nodes: int) -> Ints:
    """Pairs (2, n): position of each owned node in its copy, and the original node."""
    width = cells.shape[1]
    return np.stack([(nodes + of_node * width + np.arange(width)).ravel(), cells.ravel()])


def _shared_face_pairs(cells: Ints, groups: Ints, of_node: Ints, nodes: int) -> Ints:
    """Pairs (2, n) of positions that neighbouring copies share, since they own a common node of the face."""
    first, second, at_first, at_second = _faces_of_cut_cells(cells, np.any(groups != 0, axis=1))
    width, pairs = cells.shape[1], []
    for own in range(width - 1):
        a = of_node[first, at_first[:, own]]
        b = of_node[second, at_second[:, own]]
        pairs += [
            np.stack([nodes + a * width + at_first[:, k], nodes + b * width + at_second[:, k]])
            for k in range(width - 1)
        ]
    return np.concatenate(pairs, axis=1)


def _faces_of_cut_cells(cells: Ints, cut: npt.NDArray[np.bool_]) -> tuple[Ints, Ints, Ints, Ints]:
    """Cells on both sides of the inner faces of cut cells, and the local nodes of the face in each.

    Shapes (n,), (n,), (n, d), (n, d): column k is the same node on both sides.
    """
    width = cells.shape[1]
    local = np.array([[k for k in range(width) if k != face] for face in range(width)])
    faces = cells[:, local].reshape(-1, width - 1)
    order = np.argsort(faces, axis=1)
    keys = np.take_along_axis(faces, order, axis=1)
    at = np.take_along_axis(np.tile(local, (len(cells), 1)), order, axis=1)
    sorted_ = np.lexsort(keys.T[::-1])
    same = np.all(keys[sorted_[1:]] == keys[sorted_[:-1]], axis=1)
    a, b = sorted_[:-1][same], sorted_[1:][same]
    wanted = cut[a // width] | cut[b // width]
    a, b = a[wanted], b[wanted]
    return a // width, b // width, at[a], at[b]
