"""Numbers of the edges and facets of the input mesh, and its boundary: made once, on the rank that has the mesh."""

from __future__ import annotations

from copy import copy
from functools import cached_property

import numpy as np
import numpy.typing as npt

from ...meshes.components import components
from ...meshes.data import MeshData
from ...meshes.topology import distinct_rows, facets_of
from ..input_topology import MeshTopology

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
CRACK, BODY = 0, 1  # origins of elements that are on no boundary facet


class EntityNumbering(MeshTopology):
    """A mesh with its facets as well.

    Attributes:
        facets: (F, d) nodes, ascending; cell_facets: (C, d + 1), facet i opposite node i.
        boundary: (B, 2) cell and local facet of each boundary facet, in the order of the cells.
        origins: names of the places that an element may come from; origin (B,) of each boundary facet.
            A facet of several groups has them all in its name: "left + grip". "boundary": a facet of no group.
    """

    def __init__(self, mesh: MeshData) -> None:
        super().__init__(mesh)
        sorted_facets = np.sort(facets_of(mesh.cells).reshape(-1, mesh.dim), axis=1)
        self.facets, counts, inverse = distinct_rows(sorted_facets)
        self.cell_facets: Ints = inverse.reshape(len(mesh.cells), -1)
        self.boundary = np.argwhere(counts[self.cell_facets] == 1)
        self.origins, self.origin = _origins(mesh, self.facets[self.cell_facets[tuple(self.boundary.T)]])

    def moved(self, points: Values) -> EntityNumbering:
        """The same with nodes at other places (N, d), m."""
        if points is self.points:
            return self
        result = copy(self)
        result.points = points
        return result

    @cached_property
    def boundary_nodes(self) -> Ints:
        """Nodes of boundary facets, ascending."""
        on_boundary = np.zeros(len(self.points), bool)
        on_boundary[self.facets[self.cell_facets[tuple(self.boundary.T)]]] = True
        return np.flatnonzero(on_boundary)

    def of_edges(self, keys: Ints, values: Values) -> Values:
        """(E,) values of edges named by pairs of nodes (n, 2), NaN for all others."""
        result = np.full(len(self.edges), np.nan)
        result[self.find_edges(keys)] = values
        return result

    def broken_edges(self, pattern: npt.NDArray[np.integer]) -> npt.NDArray[np.bool_]:
        """(E,) which edges the patterns (C,) of the cells call broken."""
        damaged = np.flatnonzero(pattern)
        bits = np.arange(self.cell_edges.shape[1])
        broken = np.zeros(len(self.edges), bool)
        broken[self.cell_edges[damaged][(pattern[damaged, None] >> bits) & 1 == 1]] = True
        return broken

    def pieces(self, broken: npt.NDArray[np.bool_]) -> tuple[int, Ints]:
        """How many pieces the intact edges leave, and the piece of each node, numbered by their lowest node."""
        return components(self.edges[~broken], len(self.points))


def _origins(mesh: MeshData, facets: Ints) -> tuple[list[str], Ints]:
    """Names, and the number of the name of each of the (B, d) boundary facets."""
    groups = mesh.facet_groups
    _, _, place = distinct_rows(np.sort(np.concatenate([facets, *groups.values()]), axis=1))
    own, rest = place[: len(facets)], place[len(facets) :]
    parts = np.split(rest, np.cumsum([len(group) for group in groups.values()])[:-1]) if groups else []
    member = np.stack([np.isin(own, part) for part in parts], axis=1) if groups else np.zeros((len(own), 0), bool)
    kinds, number = np.unique(member, axis=0, return_inverse=True)
    named = [" + ".join(np.array(list(groups))[kind]) if kind.any() else "boundary" for kind in kinds]
    return ["crack", "body", *named], number.reshape(-1) + 2
