"""The part of a mesh that a rank has, from which it builds its part of the split surface.

A part is a whole mesh on one rank, or the cells of each rank. Its nodes and cells are in the order of the input mesh.
Hence edges, facets and points of the split surface, which are numbered by their nodes, are in one order on any number
of ranks.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
from dolfinx import la
from mpi4py import MPI

from ...meshes.data import MeshData
from ..domain import Domain
from ..fragments import find_components
from ..ghost_exchange import min_over_ranks
from ..parallel import allgather, sum_over_ranks
from .entity_numbering import BoundaryFacets, EntityNumbering, name_origins

Flags = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


class MeshPart(Protocol):
    """Part of a mesh on a rank.

    Attributes:
        comm: the ranks that have the parts of the mesh.
        skeleton: edges, facets and boundary of the part.
        node_numbers, cell_numbers: numbers (N,) and (C,) in the input mesh, ascending.
        owner: rank (N,) that owns each node, in `comm`.
    """

    comm: MPI.Intracomm
    skeleton: EntityNumbering
    node_numbers: Ints
    cell_numbers: Ints
    owner: npt.NDArray[np.int32]

    def find_fragments(self, broken: Flags) -> tuple[int, Ints]:
        """Number of fragments of the body, and fragment (N,) of each node, for `broken` edges (E,) (collective).

        Fragments are numbered by their lowest node.
        """

    def sum_at(self, nodes: Ints, values: Values) -> Values:
        """Sums (k, w) over the ranks of values (k, w) at nodes (k,) (collective).

        Every rank gives all those nodes of its part that any rank gives.
        """

    def least(self, values: Ints) -> Ints:
        """Minima (N,) over the ranks of values (N,) at the nodes (collective)."""


class WholeMesh:
    """A whole mesh on one rank (MeshPart)."""

    def __init__(self, skeleton: EntityNumbering) -> None:
        self.comm: MPI.Intracomm = MPI.COMM_SELF
        self.skeleton = skeleton
        self.node_numbers: Ints = np.arange(len(skeleton.points))
        self.cell_numbers: Ints = np.arange(len(skeleton.cells))
        self.owner: npt.NDArray[np.int32] = np.zeros(len(skeleton.points), np.int32)

    def find_fragments(self, broken: Flags) -> tuple[int, Ints]:
        """See MeshPart."""
        return self.skeleton.find_fragments(broken)

    def sum_at(self, nodes: Ints, values: Values) -> Values:
        """See MeshPart."""
        return values

    def least(self, values: Ints) -> Ints:
        """See MeshPart."""
        return values


class RankCells:
    """The cells of this rank, with straight edges (MeshPart).

    Attributes:
        nodes: node (N,) of the domain for each node of the part.
        cells: cell (C,) of the domain for each cell of the part.
    """

    def __init__(self, domain: Domain) -> None:
        """Number the entities of the cells of this rank (collective)."""
        self.comm, self._domain, numbering = domain.comm, domain, domain.input_numbering
        nodes = np.unique(domain.cell_nodes)
        self.nodes, self.cells = nodes[np.argsort(numbering.nodes[nodes])], np.argsort(numbering.cells)
        self.node_numbers: Ints = numbering.nodes[self.nodes]
        self.cell_numbers: Ints = numbering.cells[self.cells]
        self.part_node = np.full(len(domain.nodes), -1)
        self.part_node[self.nodes] = np.arange(len(nodes))
        self._index_map = domain.space.dofmap.index_map
        owner = np.full(len(domain.nodes), self.comm.rank, np.int32)
        owner[domain.node_count :] = self._index_map.owners
        self.owner: npt.NDArray[np.int32] = owner[self.nodes]
        mesh = MeshData(domain.nodes[self.nodes], self.part_node[domain.cell_nodes[self.cells]])
        self.skeleton = EntityNumbering(mesh, self._boundary_facets())

    def _boundary_facets(self) -> BoundaryFacets:
        """Boundary facets of the body at cells of this rank, with origins that are numbered alike on all ranks."""
        facets = self._domain.facets
        sides = np.argwhere(facets.boundary_sides[self.cells])
        on_boundary = facets.cell_facets[self.cells][tuple(sides.T)]
        member = np.zeros((len(sides), len(facets.groups)), bool)
        for column, group in zip(member.T, facets.groups.values(), strict=True):
            column[:] = np.isin(on_boundary, group)
        kinds = np.concatenate(allgather(self.comm, np.unique(member, axis=0)))
        return BoundaryFacets(sides, *name_origins(list(facets.groups), member, kinds))

    def find_fragments(self, broken: Flags) -> tuple[int, Ints]:
        """See MeshPart."""
        fragments = find_components(self._domain, self.nodes[self.skeleton.edges[~broken]])
        return fragments.count, fragments.node_fragment[self.nodes]

    def sum_at(self, nodes: Ints, values: Values) -> Values:
        """See MeshPart."""
        if self.comm.size == 1:
            return values
        sums = la.vector(self._index_map, values.shape[1], np.float64)
        rows = sums.array.reshape(-1, values.shape[1])
        rows[:] = 0.0
        rows[self.nodes[nodes]] = values
        sums.scatter_reverse(la.InsertMode.add)
        sums.scatter_forward()
        return np.asarray(rows[self.nodes[nodes]])

    def least(self, values: Ints) -> Ints:
        """See MeshPart."""
        if self.comm.size == 1:
            return values
        at_nodes = np.full(len(self._domain.nodes), np.iinfo(np.int64).max)
        at_nodes[self.nodes] = values
        return np.asarray(min_over_ranks(self._index_map, at_nodes)[self.nodes])


def total(part: MeshPart, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Sum over the ranks of a part, element by element (collective)."""
    return values if part.comm.size == 1 else sum_over_ranks(part.comm, np.ascontiguousarray(values))
