"""Crack fronts in space: how much crack an advance around a place makes, by which the force there is divided.

    a = sum over sides of cut polygons of int q nu ds

nu is the normal of a side in its polygon's plane, outwards. Sides that polygons share cancel, and those in the body's
surface are left out, so that the front remains, as ragged as it is: for a flat crack a is exactly that of the smooth
front through the same area (divergence theorem), and an advance by q e makes the area a . e.

Equations: docs/theory.md#configurational-force.

Along a front in space: the force on a tip is that on all of the front that is near.

    G_i = sum_j w_ij g_j . a_j / sum_j w_ij |a_j|^2,    w_ij = 1 - |x_j - x_i| / R_i

g_j is the force on the tips of the front, a_j the crack that their advance makes (crack_front): G is what an advance by
sum_j w_ij q_j a_j releases, over what it makes. Along a straight front the G of tips by themselves has a standard
deviation of 2.5 %, and the mean of 1.1 %. Tips of a front that goes the other way do not count. Fronts that run with
inertia go by each tip alone: what lags behind is fed more, and by the mean they ran at 0.61 of c_R and not 0.70.

Equations: docs/theory.md#configurational-force.
"""

from __future__ import annotations

from ctypes import c_int64
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from ...mesh.c_library import load_library
from ...mesh.domain import Domain
from ...mesh.edge_graph import EdgeGraph
from ...mesh.parallel import allgather
from ...mesh.simplices import local_edges
from ..initial_cracks import ends_in_order
from .neighbour_search import over, pairs_within

Flags = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
WIDTH = 16  # numbers that say the polygon of a cell: four corners, and which of its sides count
SOURCE = Path(__file__).with_suffix(".c")
LEAST = 0.05  # of R: a shorter advance is that of no front


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
        counts = ~self._domain.boundary_sides[cells[:, None], faces]
        return np.concatenate([self.places(edges, cut).reshape(len(cells), 12), counts], axis=1)


def advance(polygons: Values, pairs: tuple[Ints, Ints], places: Values, radius: Values) -> Values:
    """(n, 3) sums of int q nu ds round polygons (m, WIDTH), q of places (n, 3) and radii (n,), m.

    `pairs`: (k,) places and (k,) polygons; each pair is added in turn.
    """
    given = [np.ascontiguousarray(each) for each in (polygons, pairs[1], pairs[0], places, radius)]
    made: Values = np.zeros(places.shape)
    load_library(SOURCE).advance(c_int64(len(pairs[0])), *given, made)
    return made


class Alone:
    """Each tip by itself: (g . a) / |a|^2."""

    def __init__(self, comm: MPI.Comm) -> None:
        self._comm = comm

    def update(self, number: Ints, point: Values, ahead: Values, radius: Values) -> None:
        """Tips of this rank, in cells `number` (n,) of the input mesh, at (n, 3) in m, whose advance makes `ahead`
        (n, 3) m, see as far as `radius` (n,), m (collective)."""
        length = np.linalg.norm(ahead, axis=1)
        self._front = length > LEAST * radius
        self._square = np.where(self._front, length**2, 0.0)
        self._ahead = ahead
        self._way = np.divide(ahead, length[:, None], out=np.zeros_like(ahead), where=self._front[:, None])

    def __call__(self, force: Values) -> Values:
        """(n, 3) G along the advance of each tip, J/m^2, of the forces g on tips (n, 3); 0 of those of no front, and of
        those whose advance would take energy: the force in their ball is that of tips on the crack's other side
        (collective)."""
        released, made = self._sums(np.where(self._front, np.einsum("nk,nk->n", force, self._ahead), 0.0))
        return np.asarray(np.maximum(over(released, made), 0.0)[:, None] * self._way)

    def most(self, force: Values) -> Values:
        """(n,) no less than G, J/m^2, of tips by themselves, of the size of the forces on them (n,)."""
        return over(force, np.sqrt(self._square))

    def _sums(self, released: Values) -> tuple[Values, Values]:
        """(n,) g . a and |a|^2."""
        return released, self._square


class Along(Alone):
    """Tips and those of all ranks that are near."""

    def update(self, number: Ints, point: Values, ahead: Values, radius: Values) -> None:
        """As above."""
        super().update(number, point, ahead, radius)
        every = np.concatenate(allgather(self._comm, np.column_stack([number, point, ahead, self._square])))
        self._order = np.argsort(every[:, 0], kind="stable")
        every = every[self._order]
        pairs = pairs_within(cKDTree(every[:, 1:4]), point, radius)
        alike = np.einsum("nk,nk->n", ahead[pairs.place], every[pairs.other, 4:7]) > 0
        weight = np.where(alike, 1 - pairs.distance / radius[pairs.place], 0.0)
        ends = np.concatenate([[0], np.cumsum(np.bincount(pairs.place, minlength=len(point)))])
        self._weights = csr_matrix((weight, pairs.other, ends), shape=(len(point), len(every)))
        self._made = self._weights @ every[:, 7]

    def _sums(self, released: Values) -> tuple[Values, Values]:
        """(n,) over those that are near."""
        every = np.concatenate(allgather(self._comm, released))[self._order]
        return self._weights @ every, self._made
