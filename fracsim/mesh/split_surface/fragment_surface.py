"""The surface of fragments for contact: crack faces between fragments alone, with planar cuts.

Most crack faces of a torn soft body lie within a fragment, or bound single-node fragments and nodes of split cells
only: nine in ten on a loaf of 25,000 cells. Contact does not need them. The others are cut by planes (cut_patterns).

In output, crack faces between fragments are projected onto these planes, so that they do not overlap in pictures.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix

from ..ghost_exchange import KeyLookup
from ..simplices import is_split
from .closed_surface import SplitSurface, SurfacePoints, build_split_surface, build_surface_points
from .cut_patterns import face_centre_weights, planar_cut_table
from .drawn_surface import DrawnSurface
from .entity_numbering import EntityNumbering
from .smooth_cuts import CUTS
from .surface_map import SurfaceMap

Flags = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Patterns = npt.NDArray[np.integer]


def build_surface_of_open_edges(
    topology: EntityNumbering, apart: Flags, loose: Flags, cut: Values | None = None
) -> SplitSurface:
    """The split surface of open edges (E,), without crack faces within fragments and without loose nodes (N,).

    A loose node has no undamaged cell. `cut`: (E,) as in build_split_surface; it is kept `CUTS.min_distance` from the
    ends of edges.
    """
    cut = None if cut is None else np.clip(cut, CUTS.min_distance, 1 - CUTS.min_distance)
    surface = build_split_surface(topology, patterns_with_broken(topology, apart), cut, planar_cut_table)
    # all corners of an element follow nodes of the same side
    selected = ~loose[surface.parents.first_parent[surface.elements[:, 0]]]
    fields = {name: getattr(surface, name)[selected] for name in ("elements", "cell", "edge", "origin")}
    return replace(surface, **fields)


def moves_alike(
    topology: EntityNumbering, state: tuple[Patterns, Flags, Flags], before: tuple[Patterns, Flags, Flags]
) -> bool:
    """Whether the surface of fragments is the same for two patterns (C,), with flags of open edges and loose nodes.

    Cracks within a fragment change neither it nor its motion.
    """
    (pattern, apart, loose), (pattern_before, apart_before, loose_before) = state, before
    if not (np.array_equal(apart, apart_before) and np.array_equal(loose, loose_before)):
        return False
    ends = np.zeros(len(topology.points), bool)
    ends[topology.edges[apart]] = True
    affected = ends[topology.cells].any(axis=1)
    split_patterns = is_split(topology.dim)
    return np.array_equal(split_patterns[pattern[affected]], split_patterns[pattern_before[affected]])


def find_open_edges(
    topology: EntityNumbering,
    pattern: Patterns,
    least: Callable[[Ints], Ints],
    node_fragments: Callable[[Flags], Ints],
) -> tuple[Flags, Flags, Ints]:
    """(E,) flags of open edges, (N,) flags of loose nodes, and (N,) the fragment of each node (collective).

    Fragments are connected by edges that are intact and do not lead to a loose node.

    Args:
        topology: edges of the part of the mesh on this rank.
        pattern: (C,) broken edges of each cell.
        least: values (N,) at the nodes -> their minima over the ranks.
        node_fragments: flags (E,) of broken edges -> fragment (N,) of each node.
    """
    has_no_cell = np.ones(len(topology.points), np.int64)
    has_no_cell[topology.cells[pattern == 0]] = 0
    loose, ends = least(has_no_cell) > 0, topology.edges
    cut = topology.broken_edges(pattern) | loose[ends].any(axis=1)
    node_fragment = node_fragments(cut)
    return cut & (node_fragment[ends[:, 0]] != node_fragment[ends[:, 1]]), loose, node_fragment


def patterns_with_broken(topology: EntityNumbering, broken: Flags) -> Patterns:
    """(C,) patterns of the cells for `broken` edges (E,)."""
    bits = np.arange(topology.cell_edges.shape[1])
    return np.asarray((broken[topology.cell_edges] << bits).sum(axis=1), np.uint8)


@dataclass(frozen=True)
class PlanarPoints:
    """Points of a surface of fragments, which lie on the planes of its cuts.

    Attributes:
        rows: rows of points by their keys (SurfacePoints.keys).
        reference: (n, d) reference positions, m.
        positions: (n, d) present positions, m.
    """

    rows: KeyLookup
    reference: Values
    positions: Values


def project_onto_fragments(points: SurfaceMap, surface: DrawnSurface, planar: PlanarPoints) -> SurfaceMap:
    """The drawn points with those on crack faces between fragments projected onto the planes (collective).

    Points of loose nodes are not projected. `points`: a map without nodes.
    """
    which, mean, keys, cracked = _planar_means(surface)
    rows = planar.rows(keys)
    positions = mean @ planar.positions[rows]
    # beside a crack within the fragment a point lies on the plane in the reference configuration, and moves with its
    # own nodes
    positions[cracked] = surface.positions(which[cracked], (mean @ planar.reference[rows])[cracked])
    return points.move_points(which, positions)


def _planar_means(surface: DrawnSurface) -> tuple[Ints, csr_matrix, Ints, Flags]:
    """Drawn points (k,) on crack faces between fragments, and their means of points of the planar surface (collective).

    Also returns (k, m) the matrix of the means, (m,) keys of its columns, and (k,) flags of points beside a crack
    within the fragment.
    """
    part, drawn, topology = surface.part, surface.numbering, surface.part.skeleton
    apart, loose, node_fragment = find_open_edges(
        topology, surface.pattern, part.least, lambda broken: part.find_fragments(broken)[1]
    )
    flat = build_surface_points(topology, patterns_with_broken(topology, apart), planar_cut_table)
    node = topology.cells[drawn.cell]
    lead = node[np.arange(len(node)), drawn.group.argmax(axis=1)]
    same_fragment = np.where(loose[node], -1, node_fragment[node]) == node_fragment[lead][:, None]
    within = drawn.entity_nodes()
    same_side, opposite = within & same_fragment, within & ~same_fragment
    between = np.flatnonzero(opposite.any(axis=1) & ~loose[lead])
    bits = 1 << np.arange(topology.dim + 1)
    share = face_centre_weights(topology.dim)[same_side[between] @ bits, opposite[between] @ bits]
    row, i, j = np.nonzero(share)
    ends = np.stack([node[between[row], i], node[between[row], j]], axis=1)
    column = flat.first + np.searchsorted(_planar_point_keys(topology, flat), _edge_end_keys(topology, ends))
    used, column = np.unique(column, return_inverse=True)
    mean = csr_matrix((share[row, i, j], (row, column)), shape=(len(between), len(used)))
    cracked = (drawn.group != same_side)[between].any(axis=1)
    return drawn.first + between, mean, flat.keys(part.node_numbers)[used], cracked


def _planar_point_keys(topology: EntityNumbering, flat: SurfacePoints) -> Ints:
    """(copies,) keys of the points, which all lie on edges, ascending."""
    edge = topology.cell_edges[flat.cell, flat.entity]
    end = topology.cells[flat.cell, flat.group.argmax(axis=1)]
    return np.asarray(2 * edge + (end == topology.edges[edge, 1]))


def _edge_end_keys(topology: EntityNumbering, ends: Ints) -> Ints:
    """(k,) keys of the points of the edges between nodes `ends` (k, 2) that follow the first end."""
    edge = topology.find_edges(ends)
    return np.asarray(2 * edge + (ends[:, 0] == topology.edges[edge, 1]))
