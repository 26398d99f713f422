"""Crack fronts in space: how much crack an advance around a place makes, by which the force there is divided.

    a = sum over sides of cut polygons of int q nu ds

nu is the normal of a side in its polygon's plane, outwards. Sides that polygons share cancel, and those in the body's
surface are left out, so that the front remains, as ragged as it is: for a flat crack a is exactly that of the smooth
front through the same area (divergence theorem), and an advance by q e makes the area a . e.

Equations: docs/theory.md#configurational-force.
"""

from __future__ import annotations

from ctypes import c_int64
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ...mesh.compiled import at, library
from ...mesh.domain import Domain
from ...mesh.edges import EdgeGraph
from ...mesh.simplices import local_edges
from ..cracks import ends_in_order

Flags = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]

WIDTH = 16  # numbers that say the polygon of a cell: four corners, and which of its sides count
SOURCE = Path(__file__).with_suffix(".c")


@cache
def partitions() -> tuple[Flags, Flags]:
    """(7, 4) the ways to part the corners of a tetrahedron in two, and (7, 6) the edges that each of them cuts."""
    sides = (np.arange(1, 8)[:, None] >> np.arange(4)) & 1 == 1
    first, second = local_edges(3).T
    return sides, sides[:, first] != sides[:, second]


@cache
def polygons() -> tuple[Ints, Ints]:
    """(64, 4) local edges on which the polygon of each pattern of cut edges has its corners, in order round it, and
    (64, 4) the local face that the side after each of them lies in; in triangles the first comes twice; -1: none."""
    corners, faces = np.full((64, 4), -1), np.full((64, 4), -1)
    first, second = local_edges(3).T
    number = {frozenset((int(a), int(b))): k for k, (a, b) in enumerate(zip(first, second, strict=True))}
    sides, cut = partitions()
    for pattern in range(64):
        intact = (pattern >> np.arange(6)) & 1 == 0
        fits = np.flatnonzero(~cut[:, intact].any(axis=1))
        if not len(fits):
            continue
        side = sides[fits[0]]
        few, many = sorted(([k for k in range(4) if side[k] == one] for one in (True, False)), key=len)
        ring = [{few[0], many[0]}, {few[0], many[1]}, {few[-1], many[-1]}, {few[-1], many[0]}]
        corners[pattern] = [number[frozenset(ends)] for ends in ring]
        faces[pattern] = [
            min({0, 1, 2, 3} - ends - after) for ends, after in zip(ring, ring[1:] + ring[:1], strict=True)
        ]
    return corners, faces


class Front:
    """The polygons that cracks cut out of the cells of this rank."""

    def __init__(self, domain: Domain, graph: EdgeGraph) -> None:
        self._domain, self._graph = domain, graph
        self._ends = ends_in_order(graph)

    def places(self, edges: npt.NDArray[np.integer], cut: Values) -> Values:
        """(..., d) where local edges are cut, m; in the middle where nobody said."""
        share = np.where(np.isnan(cut[edges]), 0.5, cut[edges])
        ends = self._domain.nodes[self._ends[edges]]
        return np.asarray(ends[..., 0, :] + share[..., None] * (ends[..., 1, :] - ends[..., 0, :]))

    def middles(self, cells: Ints, cut: Values) -> Values:
        """(n, d) mean of the places where cells (n,) are cut, m."""
        broken = ~self._graph.intact(cells)
        places = self.places(self._graph.cell_edges[cells], cut)
        return np.asarray(np.einsum("nk,nki->ni", broken, places) / broken.sum(axis=1, keepdims=True))

    def rows(self, cells: Ints, cut: Values) -> Values:
        """(n, WIDTH) polygons of split cells: four corners in m, and 1 for each side inside the body."""
        corners, faces = (table[self._graph.pattern[cells]] for table in polygons())
        edges = self._graph.cell_edges[cells[:, None], corners]
        counts = ~self._domain.sides_outside[cells[:, None], faces]
        return np.concatenate([self.places(edges, cut).reshape(len(cells), 12), counts], axis=1)


def advance(polygons: Values, pairs: tuple[Ints, Ints], places: Values, radius: Values) -> Values:
    """(n, 3) sums of int q nu ds round polygons (m, WIDTH), q of places (n, 3) and radii (n,), m.

    `pairs`: (k,) places and (k,) polygons; each pair is added in turn.
    """
    given = [np.ascontiguousarray(each) for each in (polygons, pairs[1], pairs[0], places, radius)]
    made: Values = np.zeros(places.shape)
    library(SOURCE).advance(c_int64(len(pairs[0])), *map(at, given), at(made))
    return made
