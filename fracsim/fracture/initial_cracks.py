"""Cracks that are there before the start: which edges they cut, and where."""

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

CLOSEST = 0.02  # share of an edge that is left at either end of a cut: no slivers of surface
ON = 1e-9  # of the body's size: nodes as near as this to a crack lie on one side of it


def cut_edges(graph: EdgeGraph, crack: CrackPlane) -> Values:
    """(edges,) where the crack cuts local edges, from the end that comes first in the input mesh; NaN elsewhere
    (collective).

    In the plane edges that it crosses: it ends where it enters the cell in which its end lies. In space by cells, since
    one whose edges it crosses in part only does not come apart, and a crack would be some 0.4 h short all around.
    """
    domain, slack = graph.domain, ON * graph.domain.size
    corners = domain.nodes[ends_in_order(graph)]
    height = (corners - crack.point) @ crack.normal
    height[np.abs(height) <= slack] = 0.0
    crossed = (height[:, 0] >= 0) != (height[:, 1] >= 0)
    share = np.divide(height[:, 0], height[:, 0] - height[:, 1], out=np.zeros(len(height)), where=crossed)
    places = corners[:, 0] + share[:, None] * (corners[:, 1] - corners[:, 0])
    if domain.dim == 2:
        crossed[crossed] = crack.contains(places[crossed], slack)
    else:
        crossed = graph.any_over_ranks(_through(graph.cell_edges, crossed, places, crack, slack))
    return np.where(crossed, np.clip(share, CLOSEST, 1 - CLOSEST), np.nan)


def _through(cell_edges: Ints, crossed: Flags, places: Values, crack: CrackPlane, slack: float) -> Flags:
    """(edges,) those of `crossed`, at `places` (edges, 3), of the cells that a crack cuts through: those in which the
    middle of what its plane cuts belongs to it."""
    edges = cell_edges[crossed[cell_edges].any(axis=1)]
    through = crossed[edges]
    middle = np.einsum("nk,nki->ni", through, places[edges]) / through.sum(axis=1, keepdims=True)
    cut = through & crack.contains(middle, slack)[:, None]
    flags = np.zeros_like(crossed)
    flags[edges[cut]] = True
    return flags


def ends_in_order(graph: EdgeGraph) -> npt.NDArray[np.int32]:
    """(edges, 2) local nodes of owned and ghost edges, the one that comes first in the input mesh first."""
    ends = graph.edge_nodes
    swap = graph.domain.node_input[ends[:, 0]] > graph.domain.node_input[ends[:, 1]]
    return np.where(swap[:, None], ends[:, ::-1], ends)


def open_cracks(graph: EdgeGraph, cracks: Sequence[CrackPlane], *, in_one: bool) -> Values:
    """Break the edges that cracks cut; returns where, as `cut_edges` (collective).

    `in_one`: the body must stay in as many pieces as it is, as one without inertia has to.

    Raises:
        InputError: a crack cuts no edge, or cuts the body in two where it must not.
    """
    domain, cut = graph.domain, np.full(len(graph.broken), np.nan)
    for crack in cracks:
        before = find_fragments(graph).count if in_one else 0
        own = cut_edges(graph, crack)
        if not sum_over_ranks(domain.comm, np.count_nonzero(~np.isnan(own)))[0]:
            raise InputError(
                f"{crack.name} cuts no edge of the mesh: it lies outside the body, which spans {domain.extent()}, or "
                "is shorter than the cells there"
            )
        new = np.isnan(cut) & ~np.isnan(own)
        cut[new] = own[new]
        graph.break_edges(~np.isnan(own))
        if in_one and find_fragments(graph).count > before:
            raise InputError(
                f"{crack.name} cuts the body in two, and quasi-static loads have no answer for a piece that comes off; "
                "make it shorter, or choose a time.scheme with inertia"
            )
    return cut
