"""Numbers of the edges, facets and boundary facets of a mesh on one rank."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from ...meshes.data import MeshData
from ...meshes.topology import components, distinct_rows, facets_of, sorted_rows
from ..input_topology import MeshTopology

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
# Origins of elements that do not lie on a boundary facet
CRACK, BODY = 0, 1


@dataclass(frozen=True)
class BoundaryFacets:
    """Boundary facets of a mesh, or of a part of it.

    Attributes:
        sides: (B, 2) cell and local facet of each, in the order of the cells.
        origins: names of the possible origins of an element.
        origin: (B,) index into `origins` of each.
    """

    sides: Ints
    origins: list[str]
    origin: Ints


class EntityNumbering(MeshTopology):
    """A mesh with numbered edges, facets and boundary facets.

    Attributes:
        facets: (F, d) nodes of each facet, ascending.
        cell_facets: (C, d + 1) facets of each cell; facet i lies opposite node i.
        boundary: (B, 2) cell and local facet of each boundary facet, in the order of the cells.
        origins: names of the possible origins of an element: "crack", "body", and combinations of facet groups, for
            instance "left + grip", or "boundary" for a facet of no group.
        origin: (B,) index into `origins` of each boundary facet.
    """

    def __init__(self, mesh: MeshData, boundary: BoundaryFacets | None = None) -> None:
        """`boundary`: of the body, where the mesh is a part of it; None: the facets of one cell."""
        super().__init__(mesh)
        sorted_facets = sorted_rows(facets_of(mesh.cells).reshape(-1, mesh.dim))
        facets, counts, inverse = distinct_rows(sorted_facets)
        self.facets, self.cell_facets = facets.astype(np.int32), inverse.reshape(mesh.cells.shape).astype(np.int32)
        if boundary is None:
            sides = np.argwhere(counts[self.cell_facets] == 1)
            boundary = BoundaryFacets(sides, *_origins(mesh, self.facets[self.cell_facets[tuple(sides.T)]]))
        self.boundary, self.origins, self.origin = boundary.sides, boundary.origins, boundary.origin

    def with_points(self, points: Values) -> EntityNumbering:
        """This topology with nodes at `points` (N, d), m."""
        if points is self.points:
            return self
        result = copy(self)
        result.points = points
        return result

    @cached_property
    def boundary_nodes(self) -> Ints:
        """(n,) nodes of boundary facets, ascending."""
        on_boundary = np.zeros(len(self.points), bool)
        on_boundary[self.facets[self.cell_facets[tuple(self.boundary.T)]]] = True
        return np.flatnonzero(on_boundary)

    def edge_values(self, keys: Ints, values: Values) -> Values:
        """(E,) values of the edges between pairs of nodes `keys` (n, 2), NaN for all other edges."""
        result = np.full(len(self.edges), np.nan)
        result[self.find_edges(keys)] = values
        return result

    def broken_edges(self, pattern: npt.NDArray[np.integer]) -> npt.NDArray[np.bool_]:
        """(E,) whether each edge is broken in the patterns (C,) of the cells."""
        damaged = np.flatnonzero(pattern)
        bits = np.arange(self.cell_edges.shape[1])
        broken = np.zeros(len(self.edges), bool)
        broken[self.cell_edges[damaged][(pattern[damaged, None] >> bits) & 1 == 1]] = True
        return broken

    def find_fragments(self, broken: npt.NDArray[np.bool_]) -> tuple[int, Ints]:
        """The number of fragments, and (N,) the fragment of each node; `broken` (E,). Numbered by their lowest node."""
        return components(self.edges[~broken], len(self.points))


def _origins(mesh: MeshData, facets: npt.NDArray[np.int32]) -> tuple[list[str], Ints]:
    """The names of origins, and (B,) the index of the name of each boundary facet (B, d)."""
    groups = mesh.facet_groups
    _, _, number = distinct_rows(np.sort(np.concatenate([facets, *groups.values()]), axis=1))
    boundary, grouped = number[: len(facets)], number[len(facets) :]
    members = np.split(grouped, np.cumsum([len(group) for group in groups.values()])[:-1]) if groups else []
    member: npt.NDArray[np.bool_] = np.zeros((len(boundary), 0), bool)
    if groups:
        member = np.stack([np.isin(boundary, numbers) for numbers in members], axis=1)
    return name_origins(list(groups), member, member)


def name_origins(
    groups: list[str], member: npt.NDArray[np.bool_], kinds: npt.NDArray[np.bool_]
) -> tuple[list[str], Ints]:
    """Names of origins, and (B,) the index of the name of each boundary facet.

    Args:
        groups: names of the groups.
        member: (B, groups) flags of the groups that each facet is in.
        kinds: (n, groups) rows among which are all rows that occur on any rank.
    """
    distinct, number = np.unique(np.concatenate([kinds, member]), axis=0, return_inverse=True)
    named = [" + ".join(np.array(groups)[kind]) if kind.any() else "boundary" for kind in distinct]
    return ["crack", "body", *named], number.reshape(-1)[len(kinds) :] + 2
