"""Checks of a mesh before anything is solved: faults are mended with a note, or refused with a message."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from .data import Indices, MeshData, MeshError, Points, format_midpoint, format_point, list_some
from .parameters import LONGEST, SHORTEST
from .topology import (
    Floats,
    Mask,
    components,
    distinct_rows,
    facet_sides,
    links_in,
    orient_cells,
    signed_measures,
    sorted_rows,
)

SAME_PLACE = 1e-6  # distance over the size of the mesh within which nodes coincide


def check_mesh(mesh: MeshData, *, join: bool = False, conforming: bool = False) -> MeshData:
    """The mesh without the faults that can be mended, with notes for the user.

    Mended: nodes without cells are removed (groups and regions follow); inverted cells are turned.
    Joined, with `join`: coincident nodes of different bodies.
    With `conforming`, positive cells of one body that share whole facets, only coordinates and measures are checked.
    Noted: nodes at the same place that are not joined, separate bodies, parts that are connected by an edge or node
    only, group facets inside the body, cells in several regions.

    Raises:
        MeshError: no cells, wrong array shapes, cells or groups with nodes that do not exist, coordinates that are no
            numbers, flat cells, a cell given twice, a facet of more than two cells, overlapping cells at a facet, a
            group facet that is no facet of a cell.
    """
    _check_arrays(mesh)
    _check_coordinates(mesh)
    if conforming:
        _check_flat(mesh)
        return mesh
    mesh = _without_orphans(mesh)
    mesh = join_bodies(mesh) if join else mesh
    mesh = _without_repeated_facets(_oriented(mesh))
    _check_flat(mesh)
    table = _FacetTable(mesh.cells)
    _check_facets(mesh, table)
    bodies, body = label_bodies(mesh)
    parts = components(table.pairs(mesh.dim + 1), len(mesh.cells))[0]
    notes = [
        *_check_groups(mesh, table),
        *connection_notes(mesh.points, body, bodies, parts),
        *_region_notes(mesh),
    ]
    return replace(mesh, notes=mesh.notes + tuple(notes))


class _FacetTable:
    """The facets of all cells.

    Attributes:
        distinct: (k, d) facets, each once, its nodes in rising order.
        counts: (k,) number of cells at each facet.
        index: (m (d + 1),) distinct facet of each facet of each cell, cell by cell.
        balance: (k,) cells on one side of each facet less cells on the other.
    """

    def __init__(self, cells: Indices) -> None:
        """`cells`: (m, d + 1) positive cells."""
        rows, sides = (np.stack(parts, axis=1) for parts in zip(*facet_sides(cells), strict=True))
        self.distinct, self.counts, self.index = distinct_rows(rows.reshape(-1, cells.shape[1] - 1))
        self.balance = np.bincount(self.index, sides.ravel())

    def cells_at(self, groups: list[Indices]) -> list[Indices]:
        """For each group the number of cells at each facet; 0 of a facet that is not of the mesh."""
        sizes = np.cumsum([len(self.distinct), *map(len, groups)])
        _, _, inverse = distinct_rows(sorted_rows(np.concatenate([self.distinct, *groups])))
        counts = np.zeros(inverse.max() + 1, np.int64)
        counts[inverse[: sizes[0]]] = self.counts
        return np.split(counts[inverse[sizes[0] :]], sizes[1:-1] - sizes[0]) if groups else []

    def pairs(self, nodes: int) -> Indices:
        """(k, 2) cells that share a facet; `nodes`: of a cell."""
        order = np.argsort(self.index, kind="stable")
        shared = np.flatnonzero(np.diff(self.index[order]) == 0)
        return np.stack([order[shared], order[shared + 1]], axis=1) // nodes


# --- refused --------------------------------------------------------------------------------------------------------


def _check_arrays(mesh: MeshData) -> None:
    """Shapes and node numbers."""
    if mesh.points.ndim != 2 or mesh.points.shape[1] not in (2, 3):
        raise MeshError(f"The mesh's points have the shape {mesh.points.shape}; (n, 2) or (n, 3) is needed.")
    dim = mesh.dim
    if mesh.cells.ndim != 2 or mesh.cells.shape[1] != dim + 1 or len(mesh.cells) == 0:
        raise MeshError(f"The mesh's cells have the shape {mesh.cells.shape}; (m, {dim + 1}) with m > 0 is needed.")
    _check_numbers(mesh.cells, len(mesh.points), "cell")
    for name, facets in mesh.facet_groups.items():
        if facets.ndim != 2 or facets.shape[1] != dim:
            raise MeshError(f"The facets of group '{name}' have the shape {facets.shape}; (k, {dim}) is needed.")
        _check_numbers(facets, len(mesh.points), f"group '{name}': facet")
    for name, cells in mesh.regions.items():
        if len(cells) and not (cells.min() >= 0 and cells.max() < len(mesh.cells)):
            raise MeshError(f"Region '{name}' names cells that do not exist; there are {len(mesh.cells)} cells.")


def _check_numbers(rows: Indices, nodes: int, what: str) -> None:
    """Raise MeshError if a row has a node out of range."""
    wrong = np.flatnonzero(((rows < 0) | (rows >= nodes)).any(axis=1))
    if len(wrong):
        raise MeshError(
            f"{len(wrong)} of {len(rows)} rows name nodes that do not exist (there are {nodes}), the first {what} "
            f"{wrong[0]} with nodes {rows[wrong[0]].tolist()}; the file is damaged or cut short."
        )


def _check_coordinates(mesh: MeshData) -> None:
    """Raise MeshError if coordinates of used nodes are no numbers, or the size of the body is out of range."""
    used = np.zeros(len(mesh.points), bool)
    used[mesh.cells] = True
    wrong = np.flatnonzero(used & ~(np.abs(mesh.points) <= LONGEST).all(axis=1))
    if len(wrong):
        raise MeshError(
            f"{len(wrong)} nodes have coordinates that are not finite numbers: node {list_some(wrong)}, "
            f"the first at {mesh.points[wrong[0]].tolist()} (at most {LONGEST:g} m is allowed); export the mesh again."
        )
    if used.any() and (size := float(np.ptp(mesh.points[used], axis=0).max())) < SHORTEST:
        raise MeshError(f"The body is {size:g} m large, and {SHORTEST:g} m or more is needed; export the mesh again.")


def _check_flat(mesh: MeshData) -> None:
    """Raise MeshError if a cell has no measure."""
    flat = np.flatnonzero(flat_cells(mesh.points, mesh.cells))
    if len(flat):
        measure = "volume" if mesh.dim == 3 else "area"
        raise MeshError(
            f"{len(flat)} cells have no {measure}: cell {list_some(flat)}, the first near "
            f"{format_midpoint(mesh.points, mesh.cells[flat[0]])}; remesh there, or merge its nodes."
        )


def flat_cells(points: Points, cells: Indices, share: float = 0.0) -> Mask:
    """(m,) whether each cell's measure is zero to round-off, or below a share of its longest edge^d."""
    bound = measure_bounds(points, cells, single=is_single_precision(points), share=share)
    return np.abs(signed_measures(points, cells)) <= bound


def measure_bounds(points: Points, cells: Indices, *, single: bool, share: float = 0.0) -> Floats:
    """(m,) measures of cells that are zero to round-off, or a share of the longest edge^d.

    `single`: whether all coordinates of the mesh are numbers of single precision.
    """
    # Coordinates x are stored to eps |x|, which changes the measure by up to about
    # (d + 1) / (d - 1)! * eps |x| * L^(d - 1) with the longest edge L; the bound is twice that.
    dim, eps = points.shape[1], float(np.finfo(np.float32 if single else np.float64).eps)
    largest = np.abs(points).max(axis=1)[cells].max(axis=1)
    longest = _longest_edges(points, cells)
    return np.maximum(2 * (dim + 1) * eps * largest * longest ** (dim - 1), share * longest**dim)


def is_single_precision(points: Points) -> bool:
    """Whether all coordinates are numbers of single precision."""
    return bool(np.array_equal(points, points.astype(np.float32)))


def _check_cells_once(mesh: MeshData) -> None:
    """Raise MeshError if two cells have the same nodes."""
    _, counts, inverse = distinct_rows(sorted_rows(mesh.cells))
    twice = np.flatnonzero(counts[inverse] > 1)
    if len(twice):
        raise MeshError(
            f"{len(twice)} cells have the same nodes as another cell: cell {list_some(twice)}, the first near "
            f"{format_midpoint(mesh.points, mesh.cells[twice[0]])}; remove the copies."
        )


def _check_facets(mesh: MeshData, table: _FacetTable) -> None:
    """Raise MeshError unless each facet belongs to one cell, or to two on opposite sides."""
    crowded, overlap = table.counts > 2, (table.counts == 2) & (table.balance != 0)
    if crowded.any() or overlap.any():
        _check_cells_once(mesh)
    _refuse_facets(mesh, table.distinct[crowded], "belong to more than two cells")
    _refuse_facets(mesh, table.distinct[overlap], "have two cells on the same side, so that the cells overlap")


def _refuse_facets(mesh: MeshData, facets: Indices, what: str) -> None:
    """Raise MeshError if there are such facets (k, d); `what`: their fault."""
    if len(facets):
        raise MeshError(
            f"{len(facets)} facets {what}, the first with nodes {facets[0].tolist()} near "
            f"{format_midpoint(mesh.points, facets[0])}; mend the mesh there."
        )


def _check_groups(mesh: MeshData, table: _FacetTable) -> Iterator[str]:
    """Raise MeshError if a group facet is no facet of a cell; notes of group facets inside the body."""
    cells_there = table.cells_at(list(mesh.facet_groups.values()))
    for (name, facets), count in zip(mesh.facet_groups.items(), cells_there, strict=True):
        _refuse_lost(mesh, name, facets, np.flatnonzero(count == 0))
        yield from inner_facets_note(name, len(facets), int((count > 1).sum()))


def inner_facets_note(name: str, facets: int, inside: int) -> Iterator[str]:
    """A note of those facets of a group that lie inside the body."""
    if inside:
        yield f"{inside} of the {facets} facets of group '{name}' lie inside the body, between two cells."


def _refuse_lost(mesh: MeshData, name: str, facets: Indices, lost: Indices) -> None:
    """Raise MeshError if facets of a group, by their numbers `lost`, are no facets of cells."""
    if len(lost):
        raise MeshError(
            f"{len(lost)} of the {len(facets)} facets of group '{name}' are not facets of any cell, the first with "
            f"nodes {facets[lost[0]].tolist()} near {format_midpoint(mesh.points, facets[lost[0]])}; the group and the "
            "body were meshed apart."
        )


# --- mended ---------------------------------------------------------------------------------------------------------


def _without_orphans(mesh: MeshData) -> MeshData:
    """The mesh without nodes that belong to no cell."""
    used = np.zeros(len(mesh.points), bool)
    used[mesh.cells] = True
    orphans = int((~used).sum())
    if orphans == 0:
        return mesh
    number = np.cumsum(used) - 1
    groups = {}
    for name, facets in mesh.facet_groups.items():
        _refuse_lost(mesh, name, facets, np.flatnonzero(~used[facets].all(axis=1)))
        groups[name] = number[facets]
    note = f"{orphans} of {len(used)} nodes belong to no cell and were removed."
    return MeshData(mesh.points[used], number[mesh.cells], groups, mesh.regions, (*mesh.notes, note))


def _oriented(mesh: MeshData) -> MeshData:
    """The mesh with inverted cells turned."""
    cells, count = orient_cells(mesh.points, mesh.cells)
    if count == 0:
        return mesh
    note = f"{count} of {len(cells)} cells were inverted and have been turned (two nodes swapped)."
    return replace(mesh, cells=cells, notes=(*mesh.notes, note))


def _without_repeated_facets(mesh: MeshData) -> MeshData:
    """The mesh with each facet once in its group."""
    groups = {}
    for name, facets in mesh.facet_groups.items():
        _, _, inverse = distinct_rows(sorted_rows(facets))
        groups[name] = facets[np.sort(np.unique(inverse, return_index=True)[1])]
    return replace(mesh, facet_groups=groups)


# --- joined ---------------------------------------------------------------------------------------------------------


def label_bodies(mesh: MeshData) -> tuple[int, Indices]:
    """Number of bodies, which share no node, and the body of each node (n,)."""
    return components(links_in(mesh.cells), len(mesh.points))


def coincident_nodes(points: Points, body: Indices) -> Indices:
    """(k, 2) pairs of nodes of different bodies that coincide; `body`: (n,) as of `label_bodies`."""
    from scipy.spatial import cKDTree  # slow to import; most meshes have one body

    reach = SAME_PLACE * float(np.ptp(points, axis=0).max())
    pairs: Indices = cKDTree(points).query_pairs(reach, output_type="ndarray").astype(np.int64)
    return pairs[body[pairs[:, 0]] != body[pairs[:, 1]]]


def join_bodies(mesh: MeshData) -> MeshData:
    """The mesh with one node in place of the coincident nodes of different bodies, and a note.

    Nodes of one body at the same place stay apart, as along a crack.

    Raises:
        MeshError: several bodies without coincident nodes, or nodes that coincide with two nodes of one other body.
    """
    count, body = label_bodies(mesh)
    if count == 1:
        return replace(mesh, notes=(*mesh.notes, "[mesh] join = true: the mesh is one body already."))
    pairs = coincident_nodes(mesh.points, body)
    if len(pairs) == 0:
        raise MeshError(
            f"[mesh] join = true, and no nodes of the {count} bodies are at the same place (within {SAME_PLACE:g} of "
            "the mesh's size). Mesh the parts so that common faces have common nodes, or leave join out."
        )
    clusters, cluster = components(pairs, len(mesh.points))
    _refuse_cracks(mesh, body, cluster)
    retained = np.unique(cluster, return_index=True)[1]
    groups = {name: cluster[facets] for name, facets in mesh.facet_groups.items()}
    joined = replace(mesh, points=mesh.points[retained], cells=cluster[mesh.cells], facet_groups=groups)
    bodies_left = label_bodies(joined)[0]
    note = (
        f"{len(mesh.points) - clusters} nodes were joined with coincident nodes of another body: {count} bodies are "
        f"{bodies_left} now."
    )
    return replace(joined, notes=(*mesh.notes, note))


def _refuse_cracks(mesh: MeshData, body: Indices, cluster: Indices) -> None:
    """Raise MeshError if two nodes of one body coincide with the same node of another body."""
    order = np.lexsort((body, cluster))
    same = (np.diff(cluster[order]) == 0) & (np.diff(body[order]) == 0)
    if same.any():
        where = format_point(mesh.points[order[np.flatnonzero(same)[0]]])
        raise MeshError(
            f"[mesh] join = true: {int(same.sum())} nodes coincide with two nodes of one other body, the first at "
            f"{where} m: that body is open there, as along a crack, and which side is joined is not known. Join these "
            "nodes in the file, or move them apart."
        )


# --- noted ----------------------------------------------------------------------------------------------------------


def connection_notes(points: Points, body: Indices, bodies: int, parts: int) -> Iterator[str]:
    """Notes of nodes at the same place, of separate bodies, and of parts that an edge or a node only connects.

    Args:
        points: (n, d) [m].
        body: (n,) that each point belongs to.
        bodies: number of bodies, which share no node.
        parts: number of parts of the mesh that share no facet.
    """
    yield from _unmerged_nodes(points, body)
    yield from _body_notes(points, body, bodies, parts)


def _unmerged_nodes(points: Points, body: Indices) -> Iterator[str]:
    """A note of nodes of one body at the same place."""
    order = np.lexsort((body, *points.T))
    same = (np.diff(points[order], axis=0) == 0).all(axis=1) & (np.diff(body[order]) == 0)
    if same.any():
        where = points[order[np.flatnonzero(same)[0]]].tolist()
        yield (
            f"{int(same.sum())} nodes lie exactly on another node (the first at {where}) and are not joined: the body "
            "is open there, as along a crack."
        )


def _body_notes(points: Points, body: Indices, bodies: int, parts: int) -> Iterator[str]:
    """Notes of separate bodies, and of parts that are connected by an edge or node only; as `connection_notes`."""
    if bodies > 1:
        yield f"The mesh has {bodies} bodies that share no node; each needs its own supports."
        if len(pairs := coincident_nodes(points, body)):
            yield (
                f"{len(np.unique(pairs))} nodes coincide with nodes of another body, the first at "
                f"{format_point(points[pairs[0, 0]])} m: these bodies touch and are not joined. Where parts of a "
                "file are meant to be one body, give [mesh] join = true."
            )
    if parts > bodies:
        how, count = "an edge or a node" if points.shape[1] == 3 else "a node", parts - bodies
        touch = f"{count} parts of the mesh touch" if count > 1 else "1 part of the mesh touches"
        yield f"{touch} the rest in {how} only, not through a facet: motion there is free as on a hinge."


def _region_notes(mesh: MeshData) -> Iterator[str]:
    """A note of cells in several regions."""
    times = np.zeros(len(mesh.cells), np.int64)
    for cells in mesh.regions.values():
        times[np.unique(cells)] += 1
    if (times > 1).any():
        yield f"{int((times > 1).sum())} cells are in more than one region."


def _longest_edges(points: Points, cells: Indices) -> Floats:
    """(m,) longest edge of each cell [m]."""
    longest = np.zeros(len(cells))
    for first, second in zip(*np.triu_indices(cells.shape[1], k=1), strict=True):
        edges = points.take(cells[:, first], axis=0) - points.take(cells[:, second], axis=0)
        np.maximum(longest, np.einsum("ij,ij->i", edges, edges), out=longest)
    return np.asarray(np.sqrt(longest))
