"""Initial cracks: the edges that `[[crack]]` cuts before the start, and the positions of the cuts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from ..errors import InputError
from ..mesh.crack_planes import CrackPlane
from ..mesh.edge_graph import EdgeGraph
from ..mesh.fragments import find_fragments
from ..mesh.parallel import sum_over_ranks

Flags = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.integer]
Values = npt.NDArray[np.float64]

# Least share of an edge between a cut and its ends, against sliver triangles of the split surface.
MIN_CUT_SHARE = 0.02


def cut_edges(graph: EdgeGraph, crack: CrackPlane, *, to_nearest: bool) -> Values:
    """Return the cut positions (edges,) of local edges, NaN where the crack does not cut (collective).

    A position is 0 at the end that comes first in the input mesh and 1 at the other. In 2D a crack ends where it enters
    its last cell, or, with `to_nearest`, at the edge that is nearest to its end.
    """
    domain, tolerance = graph.domain, 1e-9 * graph.domain.bounds.diagonal
    ends = domain.nodes[edge_ends_in_input_order(graph)]
    height = (ends - crack.point) @ crack.normal
    # Nodes on the plane count as above it, so that they are never cut.
    height[np.abs(height) <= tolerance] = 0.0
    crossed = (height[:, 0] >= 0) != (height[:, 1] >= 0)
    share = np.divide(height[:, 0], height[:, 0] - height[:, 1], out=np.zeros(len(height)), where=crossed)
    points = ends[:, 0] + share[:, None] * (ends[:, 1] - ends[:, 0])
    if domain.dim == 2 and not to_nearest:
        crossed[crossed] = crack.contains(points[crossed], tolerance)
    else:
        # A cell with some of its crossed edges cut would not be split: the crack would be about 0.4 h short along its
        # front.
        crossed = graph.any_over_ranks(_edges_of_cut_cells(graph.cell_edges, crossed, points, crack, tolerance))
    return np.where(crossed, np.clip(share, MIN_CUT_SHARE, 1 - MIN_CUT_SHARE), np.nan)


def _edges_of_cut_cells(cell_edges: Ints, crossed: Flags, points: Values, crack: CrackPlane, tolerance: float) -> Flags:
    """Flag the crossed edges (edges,) of the cells that a crack cuts.

    It cuts a cell if the mean of the points (edges, 3) at which its plane crosses the cell's edges lies in the crack.
    """
    edges = cell_edges[crossed[cell_edges].any(axis=1)]
    crossed_here = crossed[edges]
    middle = np.einsum("nk,nki->ni", crossed_here, points[edges]) / crossed_here.sum(axis=1, keepdims=True)
    cut = crossed_here & crack.contains(middle, tolerance)[:, None]
    flags = np.zeros_like(crossed)
    flags[edges[cut]] = True
    return flags


def edge_ends_in_input_order(graph: EdgeGraph) -> npt.NDArray[np.int32]:
    """Return the nodes (edges, 2) of owned and ghost edges, the lower node of the input mesh first."""
    ends = graph.edge_nodes
    swap = graph.domain.input_numbering.nodes[ends[:, 0]] > graph.domain.input_numbering.nodes[ends[:, 1]]
    return np.where(swap[:, None], ends[:, ::-1], ends)


def open_initial_cracks(
    graph: EdgeGraph, cracks: Sequence[CrackPlane], *, keep_connected: bool, to_nearest: bool = False
) -> Values:
    """Break the edges that cracks cut; return the cut positions (edges,), NaN elsewhere (collective).

    Args:
        graph: edges of the body; they are broken in place.
        cracks: the cracks, in the order of the study.
        to_nearest: end cracks at the edges nearest to their ends (2D).
        keep_connected: refuse cracks that cut off a fragment, which has no equilibrium without inertia.

    Raises:
        InputError: a crack cuts no edge, or cuts the body in two although `keep_connected`.
    """
    domain, positions = graph.domain, np.full(len(graph.broken), np.nan)
    for crack in cracks:
        fragments_before = find_fragments(graph).count if keep_connected else 0
        crack_positions = cut_edges(graph, crack, to_nearest=to_nearest)
        if not sum_over_ranks(domain.comm, np.count_nonzero(~np.isnan(crack_positions)))[0]:
            raise InputError(
                f"{crack.name} cuts no edge of the mesh: it lies outside the body, which spans {domain.bounds}, or "
                "is shorter than the cells there"
            )
        # An edge that several cracks cut has the position of the first.
        new = np.isnan(positions) & ~np.isnan(crack_positions)
        positions[new] = crack_positions[new]
        graph.break_edges(~np.isnan(crack_positions))
        if keep_connected and find_fragments(graph).count > fragments_before:
            raise InputError(
                f"{crack.name} cuts the body in two, and quasi-static loads have no answer for a piece that comes off; "
                "make it shorter, or choose a time.scheme with inertia"
            )
    return positions
