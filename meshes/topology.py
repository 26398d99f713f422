"""Facets, measures, orientation and connected components of simplices: triangles (d = 2) and tetrahedra (d = 3)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from math import factorial

import numpy as np
import numpy.typing as npt

from .data import Indices, Points

Floats = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]


def signed_measures(points: Points, cells: npt.NDArray[np.integer]) -> Floats:
    """(m,) signed area [m^2] or volume [m^3] of each cell, positive if its nodes are positively ordered.

    det(x_1 - x_0, ..., x_d - x_0) / d!
    """
    axes = points.T.copy()
    rows = [[x[cells[:, node]] - x[cells[:, 0]] for x in axes] for node in range(1, cells.shape[1])]
    return determinants(rows) / factorial(len(rows))


def determinants(rows: Sequence[Sequence[Floats]] | Floats) -> Floats:
    """(m,) determinants of 2 x 2 or 3 x 3 matrices; row i has the components rows[i][j] (m,).

    In 3D in a quarter of the time of np.linalg.det.
    """
    if len(rows) == 2:
        return np.asarray(rows[0][0] * rows[1][1] - rows[0][1] * rows[1][0])
    a, b, c = rows
    return np.asarray(sum(a[i] * (b[i - 2] * c[i - 1] - b[i - 1] * c[i - 2]) for i in range(3)))


def orient_cells(points: Points, cells: Indices) -> tuple[Indices, int]:
    """Cells with positive measure, those of negative measure with their last two nodes swapped; number of these."""
    inverted = signed_measures(points, cells) < 0
    cells = cells.copy()
    cells[inverted, -2:] = cells[inverted, :-3:-1]
    return cells, int(inverted.sum())


def facets_of(cells: Indices) -> Indices:
    """(m, d + 1, d) facets of each cell, facet i opposite node i; their normals point out of positive cells."""
    nodes = cells.shape[1]
    rows = []
    for opposite in range(nodes):
        retained = [node for node in range(nodes) if node != opposite]
        # Dropping node i keeps the outward order for even i in 3D and in 2D; for odd i two nodes change places.
        if opposite % 2 == 1:
            retained[0], retained[1] = retained[1], retained[0]
        rows.append(cells[:, retained])
    return np.stack(rows, axis=1)


def edges_of(cells: Indices) -> Indices:
    """(k, 2) every edge of the mesh once, lower node first, in rising order."""
    first, second = np.triu_indices(cells.shape[1], k=1)
    pairs = sorted_rows(np.stack([cells[:, first].ravel(), cells[:, second].ravel()], axis=1))
    return distinct_rows(pairs)[0]


def links_in(cells: npt.NDArray[np.integer]) -> npt.NDArray[np.integer]:
    """(m d, 2) pairs of nodes that connect the nodes of each cell."""
    return np.stack([np.repeat(cells[:, 0], cells.shape[1] - 1), cells[:, 1:].ravel()], axis=1)


def sorted_rows(rows: Indices) -> Indices:
    """Each of the rows (n, w) in rising order. For w of 2 or 3 a fifth of the time of NumPy's sort of short rows."""
    columns = list(rows.T)
    for column in range(1, len(columns)):
        # inserted into those before it, which are in rising order
        for lower in range(column):
            pair = columns[lower], columns[column]
            columns[lower], columns[column] = np.minimum(*pair), np.maximum(*pair)
    return np.stack(columns, axis=1)


def facet_sides(cells: Indices) -> Iterator[tuple[Indices, Indices]]:
    """For each node i of the cells (m, d + 1) the facets opposite to it, (m, d) nodes in rising order, and their sides.

    Two positive cells at one facet are on opposite sides of it, (m,) 1 and -1, unless they overlap.
    """
    nodes = cells.shape[1]
    # without a node of a cell in rising order the others are a facet in rising order
    ordered = sorted_rows(cells)
    exchanges = sum((cells[:, i] > cells[:, j]).astype(np.int8) for i in range(nodes) for j in range(i + 1, nodes))
    for node in range(nodes):
        yield np.delete(ordered, node, axis=1), np.asarray(1 - 2 * ((exchanges + node) % 2), np.int64)


def row_keys(rows: Indices) -> Indices:
    """(k,) hashes of rows (k, w) of whole numbers, from 0 to 2^63 - 1.

    Two different rows of n have one hash with a probability of n^2 / 2^64.

    Source: G. L. Steele, D. Lea, C. H. Flood (2014), Fast splittable pseudorandom number generators (its mixing).
    """
    keys: npt.NDArray[np.uint64] = np.full(len(rows), 0x9E3779B97F4A7C15, np.uint64)
    for column in rows.T:
        keys ^= column.astype(np.int64).view(np.uint64)
        keys = (keys ^ (keys >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        keys = (keys ^ (keys >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        keys ^= keys >> np.uint64(31)
    return (keys >> np.uint64(1)).astype(np.int64)


def distinct_rows(rows: Indices) -> tuple[Indices, Indices, Indices]:
    """Distinct rows (k, w) in rising order, their numbers of occurrences (k,), and the distinct row of each row (n,).

    To compare rows regardless of the order of their nodes, sort each row first.
    """
    if len(rows) == 0:
        return rows, np.zeros(0, np.int64), np.zeros(0, np.int64)
    keys = _row_keys(rows)
    # stable: the rows of meshes are nearly in order, which merge sort makes use of
    order = np.argsort(keys[0], kind="stable") if len(keys) == 1 else np.lexsort(keys[::-1])
    first = np.zeros(len(rows), bool)
    first[0] = True
    for key in keys:
        ranked = key[order]
        first[1:] |= ranked[1:] != ranked[:-1]
    starts = np.flatnonzero(first)
    inverse = np.empty(len(rows), np.int64)
    inverse[order] = np.cumsum(first) - 1
    return rows[order[starts]], np.diff(np.append(starts, len(rows))), inverse


def _row_keys(rows: Indices) -> list[Indices]:
    """Integers (n,) that compare like the rows (n, w), the most significant first; each holds several columns."""
    lowest = int(rows.min())
    bits = (int(rows.max()) - lowest).bit_length()
    # columns that fit into a signed integer of 64 bits
    per_key = max(1, 63 // max(bits, 1))
    keys = []
    for begin in range(0, rows.shape[1], per_key):
        columns = rows[:, begin : begin + per_key]
        key = columns[:, 0] - lowest if bits < 64 else columns[:, 0]
        for column in columns.T[1:]:
            key = (key << bits) | (column - lowest)
        keys.append(key)
    return keys


def boundary_facets(cells: Indices) -> Indices:
    """(k, d) facets that belong to one cell only, their normals pointing outwards."""
    facets = facets_of(cells).reshape(-1, cells.shape[1] - 1)
    _, counts, inverse = distinct_rows(sorted_rows(facets))
    return facets[counts[inverse] == 1]


def facets_on_nodes(facets: Indices, nodes: Mask) -> Indices:
    """(k, d) facets all of whose nodes are marked; `nodes`: (n,) the marks."""
    return facets[nodes[facets].all(axis=1)]


def exclude_facets(facets: Indices, *others: Indices) -> Indices:
    """(k, d) facets that are in none of the others, regardless of the order of their nodes."""
    rows = np.sort(np.concatenate([facets, *others]), axis=1)
    _, _, inverse = distinct_rows(rows)
    return facets[~np.isin(inverse[: len(facets)], inverse[len(facets) :])]


def facet_groups_on_planes(points: Points, facets: Indices, names: dict[str, tuple[int, float]]) -> dict[str, Indices]:
    """Facet groups on planes normal to the axes.

    Args:
        points: (n, d) [m].
        facets: (k, d) that are sorted into groups.
        names: group -> axis and coordinate [m] of its plane; nodes within 1e-9 of the body's size count as on it.
    """
    tolerance = 1e-9 * float(np.ptp(points, axis=0).max())
    return {
        name: facets_on_nodes(facets, np.abs(points[:, axis] - coordinate) <= tolerance)
        for name, (axis, coordinate) in names.items()
    }


def components(links: npt.NDArray[np.integer], count: int) -> tuple[int, Indices]:
    """Number of connected components of `count` nodes with links (n, 2), and the component of each node (count,).

    Components are numbered by their lowest nodes. Source: Y. Shiloach and U. Vishkin (1982), An O(log n) parallel
    connectivity algorithm.
    """
    # Each round hooks the roots of trees that a link joins onto the lower root, and flattens the trees: at most
    # log2(count) rounds. SciPy's function is no faster on large graphs, and slow to import.
    # In the type of the links, which 32 bits hold in half the memory.
    root = np.arange(count, dtype=links.dtype)
    first, second = links[:, 0], links[:, 1]
    while len(first):
        low, high = np.minimum(first, second), np.maximum(first, second)
        np.minimum.at(root, high, low)
        root = _flattened(root)
        first, second = root[low], root[high]
        apart = np.flatnonzero(first != second)
        first, second = first[apart], second[apart]
    is_root = root == np.arange(count)
    return int(is_root.sum()), (np.cumsum(is_root) - 1)[root]


def _flattened(parent: npt.NDArray[np.integer]) -> npt.NDArray[np.integer]:
    """(n,) root of each node of trees given by parents; a root is its own parent."""
    while not np.array_equal(above := parent[parent], parent):
        parent = above
    return parent


def positions_of(ids: Indices, wanted: Indices) -> Indices:
    """Index of each wanted number in `ids`, which are distinct; -1 where `ids` lacks it. Shape of `wanted`."""
    if not len(ids):
        return np.full(wanted.shape, -1, np.int64)
    if (np.diff(ids) <= 0).any():  # files list nodes in any order
        order = np.argsort(ids, kind="stable")
        sorted_positions = positions_of(ids[order], wanted)
        return np.where(sorted_positions >= 0, order[sorted_positions], -1)
    first, last = int(ids[0]), int(ids[-1])
    if last - first == len(ids) - 1:  # consecutive numbers need no search
        return np.where((wanted >= first) & (wanted <= last), wanted - first, -1)
    index = np.minimum(np.searchsorted(ids, wanted), len(ids) - 1)
    return np.where(ids[index] == wanted, index, -1)


def first_repeated(ids: Indices) -> int | None:
    """The least number that occurs more than once; None where all differ."""
    ordered = np.sort(ids)
    repeated = ordered[1:][np.diff(ordered) == 0]
    return int(repeated[0]) if len(repeated) else None
