"""The surface of fragments for contact: crack faces between fragments alone, with planar cuts.

Most crack faces of a torn soft body lie within a fragment, or bound single-node fragments and nodes of split cells
only: nine in ten on a loaf of 25,000 cells. Contact does not need them, nor any crack face of a body of one fragment
apart from loose nodes. The others are cut by planes (cut_patterns).

In output, crack faces between fragments are projected onto these planes, so that they do not overlap in pictures.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from scipy.sparse import csr_matrix

from ..ghost_exchange import KeyLookup
from ..parallel import max_over_ranks
from ..simplices import is_split
from .closed_surface import SplitSurface, SurfacePoints, build_split_surface, build_surface_points
from .cut_patterns import face_centre_weights, planar_cut_table
from .drawn_surface import DrawnSurface
from .entity_numbering import CRACK, EntityNumbering
from .smooth_cuts import CUTS
from .surface_map import SurfaceMap

Flags = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Patterns = npt.NDArray[np.integer]


@dataclass(frozen=True)
class OpenEdges:
    """Edges at which the surface of fragments is open.

    A loose node has no undamaged cell. Fragments are connected by edges that are intact and do not lead to a loose
    node. In a body of one fragment edges and loose nodes of cells with a boundary facet count alone, as the surface
    has no crack faces.

    Attributes:
        pattern: (C,) broken edges of each cell.
        apart: (E,) flags of open edges: between fragments, or to a loose node.
        loose: (N,) flags of loose nodes.
        node_fragment: (N,) fragment of each node.
        has_crack_faces: whether crack faces are part of the surface: there are several fragments beside loose nodes.
    """

    pattern: Patterns
    apart: Flags
    loose: Flags
    node_fragment: Ints
    has_crack_faces: bool

    @classmethod
    def find(
        cls,
        comm: MPI.Intracomm,
        topology: EntityNumbering,
        pattern: Patterns,
        least: Callable[[Ints], Ints],
        node_fragments: Callable[[Flags], Ints],
    ) -> OpenEdges:
        """Find the open edges (collective).

        Args:
            comm: ranks.
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
        apart = cut & (node_fragment[ends[:, 0]] != node_fragment[ends[:, 1]])
        is_one = _is_one_value(comm, node_fragment[~loose])
        if is_one:
            cells = topology.boundary[:, 0]
            apart = apart & _flags(topology.cell_edges[cells], len(apart))
            loose = loose & _flags(topology.cells[cells], len(loose))
        return cls(pattern, apart, loose, node_fragment, not is_one)


def _is_one_value(comm: MPI.Intracomm, values: Ints) -> bool:
    """Whether all values (n,) of all ranks are the same (collective)."""
    largest = max_over_ranks(comm, int(values.max(initial=-1)))
    return max_over_ranks(comm, int(np.any(values != largest))) == 0


def _flags(numbers: npt.NDArray[np.integer], count: int) -> Flags:
    """(count,) flags of numbers."""
    result = np.zeros(count, bool)
    result[numbers] = True
    return result


def build_surface_of_open_edges(topology: EntityNumbering, edges: OpenEdges, cut: Values | None = None) -> SplitSurface:
    """The split surface of open edges, without crack faces within fragments and without loose nodes.

    `cut`: (E,) as in build_split_surface; it is kept `CUTS.min_distance` from the ends of edges.
    """
    cut = None if cut is None else np.clip(cut, CUTS.min_distance, 1 - CUTS.min_distance)
    surface = build_split_surface(topology, patterns_with_broken(topology, edges.apart), cut, planar_cut_table)
    # all corners of an element follow nodes of the same side
    selected = ~edges.loose[surface.parents.first_parent[surface.elements[:, 0]]]
    if not edges.has_crack_faces:
        selected &= surface.origin != CRACK
    fields = {name: getattr(surface, name)[selected] for name in ("elements", "cell", "edge", "origin")}
    return replace(surface, **fields)


def moves_alike(topology: EntityNumbering, edges: OpenEdges, before: OpenEdges) -> bool:
    """Whether the surface of fragments, and its motion, are the same for open edges and for those before.

    Cracks within a fragment change neither.
    """
    if not (
        np.array_equal(edges.apart, before.apart)
        and np.array_equal(edges.loose, before.loose)
        and edges.has_crack_faces == before.has_crack_faces
    ):
        return False
    ends = np.zeros(len(topology.points), bool)
    ends[topology.edges[edges.apart]] = True
    affected = ends[topology.cells].any(axis=1)
    split_patterns = is_split(topology.dim)
    return np.array_equal(split_patterns[edges.pattern[affected]], split_patterns[before.pattern[affected]])


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
    edges = OpenEdges.find(
        part.comm, topology, surface.pattern, part.least, lambda broken: part.find_fragments(broken)[1]
    )
    loose, node_fragment = edges.loose, edges.node_fragment
    flat = build_surface_points(topology, patterns_with_broken(topology, edges.apart), planar_cut_table)
    node = topology.cells[drawn.cell]
    lead = node[np.arange(len(node)), drawn.group.argmax(axis=1)]
    same_fragment = np.where(loose[node], -1, node_fragment[node]) == node_fragment[lead][:, None]
    within = drawn.entity_nodes()
    same_side, opposite = within & same_fragment, within & ~same_fragment
    between = np.flatnonzero(opposite.any(axis=1) & ~loose[lead] & edges.has_crack_faces)
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
