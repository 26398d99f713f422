"""Domain: the distributed mesh of a body with named groups, from the arrays of a builder or reader."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import dolfinx
import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI

from ..errors import InputError
from ..meshes.data import MeshData, format_point
from ..meshes.topology import distinct_rows, signed_measures
from .dolfinx_compat import KeptCell, coordinate_element, create_mesh, facets_of_nodes
from .parallel import Gather, GatherSubset, bcast, sum_over_ranks
from .selectors import Group, PointsInBox, PointsOnPlane, Selector, check_group
from .simplices import local_edges

if TYPE_CHECKING:
    from .midside_nodes import MidsideNodes

Ints = npt.NDArray[np.int32]
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Domain:
    """A partitioned simplex mesh without ghost cells: every cell belongs to one rank.

    Nodes are the nodes of the displacement: corners of cells and, for quadratic displacement, midside nodes.

    Attributes:
        mesh: DOLFINx mesh; its geometry is P1, or P2 if cells are curved.
        facets: local facet indices of each facet group.
        region_names: names of the regions, in the order of `region`.
        region: (cells,) index into region_names of each owned cell, -1 outside all regions.
        source: the input mesh on rank 0, None elsewhere; output and checkpoints keep its order.
        lower, upper: (d,) corners of the bounding box, m.
        midside_nodes: of the input mesh for quadratic displacement; None: displacement is linear.
    """

    mesh: dolfinx.mesh.Mesh
    facets: dict[str, Ints]
    region_names: list[str]
    region: npt.NDArray[np.int32]
    lower: npt.NDArray[np.float64]
    upper: npt.NDArray[np.float64]
    source: MeshData | None = None
    midside_nodes: MidsideNodes | None = None

    @property
    def comm(self) -> MPI.Intracomm:
        """Communicator of the mesh."""
        comm: MPI.Intracomm = self.mesh.comm
        return comm

    @property
    def dim(self) -> int:
        """Dimension d of the body, 2 or 3."""
        return int(self.mesh.topology.dim)

    @property
    def size(self) -> float:
        """Diagonal of the bounding box, m."""
        return float(np.linalg.norm(self.upper - self.lower))

    @property
    def cell_count(self) -> int:
        """Number of owned cells."""
        return int(self.mesh.topology.index_map(self.dim).size_local)

    @property
    def order(self) -> int:
        """Polynomial order of the displacement, 1 or 2."""
        return 1 if self.midside_nodes is None else 2

    @cached_property
    def space(self) -> fem.FunctionSpace:
        """P1 or P2 function space of the displacement."""
        return fem.functionspace(self.mesh, ("Lagrange", self.order, (self.dim,)))

    @cached_property
    def cell_scalar(self) -> fem.FunctionSpace:
        """DG0 function space of scalars; dof i is cell i."""
        return fem.functionspace(self.mesh, ("DG", 0))

    def cell_vector(self, components: int) -> fem.FunctionSpace:
        """DG0 function space of vectors; dof i * components + k is component k of cell i."""
        return fem.functionspace(self.mesh, ("DG", 0, (components,)))

    @property
    def cell_nodes(self) -> Ints:
        """(cells, d + 1) node (blocked dof) numbers of the corners of the owned cells."""
        return self.space.dofmap.list if self.midside_nodes is None else self._split_cell_nodes[0]

    @property
    def all_cell_nodes(self) -> Ints:
        """(cells, n) node numbers of the owned cells; n = d + 1, or with midside nodes 6 (2D) or 10 (3D)."""
        return self.space.dofmap.list

    @property
    def cell_midside_nodes(self) -> Ints:
        """(cells, 3 or 6) node numbers of the midside nodes of local edges; (cells, 0) for linear displacement."""
        return self._split_cell_nodes[1]

    @cached_property
    def _split_cell_nodes(self) -> tuple[Ints, Ints]:
        corners, middles = np.split(self.space.dofmap.list, [self.dim + 1], axis=1)
        return np.ascontiguousarray(corners), np.ascontiguousarray(middles)

    @cached_property
    def midside_edges(self) -> tuple[Ints, Ints]:
        """(m,) midside nodes of this rank, ghosts included, and (m, 2) the ends of their edges."""
        nodes, first = np.unique(self.cell_midside_nodes, return_index=True)
        return nodes, self.cell_nodes[:, local_edges(self.dim)].reshape(-1, 2)[first]

    @cached_property
    def node_count(self) -> int:
        """Number of owned nodes."""
        return int(self.space.dofmap.index_map.size_local)

    @cached_property
    def nodes(self) -> npt.NDArray[np.float64]:
        """(nodes, d) reference coordinates X of owned and ghost nodes, m."""
        # coordinates of the input: tabulated ones depend in the last digit on the cell, hence on the partition
        count = self.node_count + self.space.dofmap.index_map.num_ghosts
        result = np.empty((count, self.dim))
        if self.has_curved_cells:
            result[self.all_cell_nodes] = self.mesh.geometry.x[self.mesh.geometry.dofmap, : self.dim]
            return result
        result[self.cell_nodes] = self.mesh.geometry.x[self.mesh.geometry.dofmap, : self.dim]
        if self.midside_nodes is not None:
            midside, ends = self.midside_edges
            result[midside] = result[ends].mean(axis=1)
        return result

    @property
    def has_curved_cells(self) -> bool:
        """Whether any cell has curved edges."""
        return self.midside_nodes is not None and self.midside_nodes.curved

    @property
    def corner_geometry(self) -> Ints:
        """(cells, d + 1) geometry nodes of `mesh` at the corners of the owned cells."""
        return self.mesh.geometry.dofmap[:, : self.dim + 1]

    @cached_property
    def node_input(self) -> npt.NDArray[np.int64]:
        """(nodes,) number in the input mesh of every owned and ghost node; midside nodes follow its points."""
        result = np.full(len(self.nodes), -1, np.int64)
        result[self.cell_nodes] = self.mesh.geometry.input_global_indices[self.corner_geometry]
        if self.midside_nodes is not None:
            midside, ends = self.midside_edges
            result[midside] = self.midside_nodes.index_between(result[ends])
        return result

    @property
    def owned_corners(self) -> slice | npt.NDArray[np.bool_]:
        """Owned nodes that are corners of cells, as a slice or (nodes,) flags."""
        if self.midside_nodes is None:
            return slice(self.node_count)
        return (self.node_input < self.midside_nodes.points) & (np.arange(len(self.nodes)) < self.node_count)

    @cached_property
    def cell_input(self) -> npt.NDArray[np.int64]:
        """(cells,) number in the input mesh of every owned cell."""
        return np.asarray(self.mesh.topology.original_cell_index[: self.cell_count], np.int64)

    def mesh_of_nodes(self) -> MeshData | None:
        """`source` on rank 0, with midside nodes for quadratic displacement; None elsewhere."""
        if self.midside_nodes is None or self.source is None:
            return self.source
        from .midside_nodes import with_midside_nodes

        return with_midside_nodes(self.source, self.midside_nodes, written=True)

    def with_ghosts(self, owned: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """(owned and ghost dofs,) values of the displacement space from its owned dofs (collective).

        On one rank the result is `owned` itself: do not write to it.
        """
        if self.comm.size == 1:
            return owned
        result = fem.Function(self.space)
        result.x.array[: len(owned)] = owned
        result.x.scatter_forward()
        return np.asarray(result.x.array)

    @cached_property
    def gather_nodes(self) -> Gather:
        """Gathers rows of nodes in the order of the input mesh."""
        return Gather(self.comm, self.node_input[: self.node_count])

    @cached_property
    def gather_corners(self) -> Gather:
        """Gathers rows of corners: the points of the input mesh in their order."""
        if self.midside_nodes is None:
            return self.gather_nodes
        return GatherSubset(self.comm, self.node_input[: self.node_count], self.owned_corners[: self.node_count])  # type: ignore[index]

    def with_straight_edges(self, owned: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """(owned dofs,) values with midside nodes at the mean of the ends of their edges (collective)."""
        if self.midside_nodes is None:
            return owned
        nodal = self.with_ghosts(owned).reshape(-1, self.dim).copy()
        midside, ends = self.midside_edges
        nodal[midside] = nodal[ends].mean(axis=1)
        return nodal.reshape(-1)[: len(owned)]

    @cached_property
    def gather_cells(self) -> Gather:
        """Gathers rows of cells in the order of the input mesh."""
        return Gather(self.comm, self.cell_input)

    @property
    def cell_facets(self) -> Ints:
        """(cells, d + 1) local facets of each owned cell."""
        array = self.mesh.topology.connectivity(self.dim, self.dim - 1).array
        return np.asarray(array.reshape(-1, self.dim + 1)[: self.cell_count])

    @cached_property
    def facet_neighbours(self) -> Ints:
        """(n, 2) pairs of owned cells that share a facet."""
        facets = self.cell_facets
        order = np.argsort(facets, axis=None, kind="stable")
        twice = np.flatnonzero(np.diff(facets.reshape(-1)[order]) == 0)
        pairs = np.stack([order[twice], order[twice + 1]], axis=1) // facets.shape[1]
        return pairs.astype(np.int32)

    @cached_property
    def volumes(self) -> npt.NDArray[np.float64]:
        """(cells,) volume (2D: area) of each owned cell in the reference configuration, m^d."""
        return np.abs(signed_measures(self.nodes, self.cell_nodes))

    @cached_property
    def mean_edge_length(self) -> float:
        """Edge length of a cube (2D: square) with the mean volume of the cells, m."""
        volume, cells = sum_over_ranks(self.comm, np.array([self.volumes.sum(), self.cell_count]))
        return float((volume / cells) ** (1 / self.dim))

    def select_nodes(self, selector: Selector, key: str = "on") -> Ints:
        """Owned and ghost nodes of a selector; InputError with the key if there are none (collective)."""
        nodes = self._group_nodes(selector, key) if isinstance(selector, Group) else self._selected(selector)
        if sum_over_ranks(self.comm, len(nodes))[0] == 0:
            raise InputError(f"{key}: {selector} selects no node; the body lies in {self.extent()}")
        return nodes

    def select_facets(self, selector: Selector, key: str = "on") -> Ints:
        """Local boundary facets of a group, or boundary facets with all nodes in a box or on a plane (collective)."""
        if isinstance(selector, Group):
            facets = np.intersect1d(self.facet_group(selector.name, key), self._exterior)
        else:
            facets = self._facets_within(self._selected(selector))
        if sum_over_ranks(self.comm, len(facets))[0] == 0:
            raise InputError(f"{key}: {selector} selects no boundary facet; the body lies in {self.extent()}")
        return facets

    def nearest_node(self, point: Values, key: str = "point") -> Ints:
        """(1,) the owned node nearest to a point (d,), m, on one rank; (0,) on all others (collective).

        Of nodes at equal distance the lowest one of the input mesh is taken. InputError if the point lies outside the
        bounding box.
        """
        low, high = self.lower - 1e-9 * self.size, self.upper + 1e-9 * self.size
        if np.any(point < low) or np.any(point > high):
            raise InputError(f"{key} = {np.asarray(point).tolist()} lies outside the body, which spans {self.extent()}")
        distance = np.linalg.norm(self.nodes[: self.node_count] - point, axis=1)
        best = (np.inf, np.iinfo(np.int64).max, -1)
        if len(distance):
            rounded = np.round(distance / (1e-12 * self.size))
            node = np.lexsort((self.node_input[: self.node_count], rounded))[0]
            best = (float(rounded[node]), int(self.node_input[node]), int(node))
        winner = min(self.comm.allgather(best[:2]))
        return np.array([best[2]] if best[:2] == winner else [], np.int32)

    def facet_group(self, name: str, key: str) -> Ints:
        """Local facets of a named group; InputError lists the groups of the mesh if it is unknown."""
        check_group(name, self.facets, key)
        return self.facets[name]

    def _group_nodes(self, group: Group, key: str) -> Ints:
        return fem.locate_dofs_topological(self.space, self.dim - 1, self.facet_group(group.name, key))

    def _selected(self, selector: PointsInBox | PointsOnPlane) -> Ints:
        return np.flatnonzero(selector.selects(self.nodes, self.size)).astype(np.int32)

    def _facets_within(self, nodes: Ints) -> Ints:
        exterior = self._exterior
        geometry = dolfinx.mesh.entities_to_geometry(self.mesh, self.dim - 1, exterior)
        chosen = np.zeros(len(self.nodes), bool)
        chosen[nodes] = True
        of_geometry = np.zeros(len(self.mesh.geometry.x), bool)
        of_geometry[self.corner_geometry] = chosen[self.cell_nodes]
        return exterior[of_geometry[geometry[:, : self.dim]].all(axis=1)]

    @cached_property
    def boundary_sides(self) -> npt.NDArray[np.bool_]:
        """(cells, d + 1) whether the facet opposite to each node of the owned cells is a boundary facet."""
        topology = self.mesh.topology
        flags = np.zeros(
            topology.index_map(self.dim - 1).size_local + topology.index_map(self.dim - 1).num_ghosts, bool
        )
        flags[self._exterior] = True
        facets = topology.connectivity(self.dim, self.dim - 1).array.reshape(-1, self.dim + 1)
        return flags[facets[: self.cell_count]]

    @cached_property
    def _exterior(self) -> Ints:
        return dolfinx.mesh.exterior_facet_indices(self.mesh.topology)

    def extent(self) -> str:
        """The bounding box in words, m."""
        return f"{format_point(self.lower)} to {format_point(self.upper)}"


def distribute(comm: MPI.Comm, data: MeshData | None, order: int = 1) -> Domain:
    """The domain of a mesh that rank 0 holds (None elsewhere), partitioned over the ranks (collective).

    Cells are not ghosted. `order` of the displacement: 1 or 2.
    """
    head = None
    if data is not None:
        bounds = data.points.min(axis=0), data.points.max(axis=0)
        head = (data.dim, list(data.facet_groups), _region_index(data), list(data.regions), *bounds)
    dim, groups, region, region_names, lower, upper = bcast(comm, head)
    midside_nodes = _midside_nodes(comm, data) if order == 2 else None
    mesh = create_mesh(comm, *_geometry(data, midside_nodes, dim))
    mesh.topology.create_entities(dim - 1)
    mesh.topology.create_connectivity(dim - 1, dim)
    facets = _group_facets(mesh, groups, None if data is None else [np.asarray(data.facet_groups[k]) for k in groups])
    owned = mesh.topology.index_map(dim).size_local
    local = region[mesh.topology.original_cell_index[:owned]] if region_names else np.full(owned, -1, np.int32)
    return Domain(mesh, facets, region_names, local, lower, upper, data, midside_nodes)


def _geometry(
    data: MeshData | None, midside_nodes: MidsideNodes | None, dim: int
) -> tuple[npt.NDArray[np.int64], Values, KeptCell]:
    """Cells, points and the coordinate element, which is P2 only if cells are curved."""
    element, nodes = coordinate_element(dim), dim + 1
    if midside_nodes is not None and midside_nodes.curved:
        from .midside_nodes import with_midside_nodes

        element, nodes = coordinate_element(dim, 2), (dim + 1) * (dim + 2) // 2
        data = data and with_midside_nodes(data, midside_nodes, written=False)
    if data is None:
        return np.empty((0, nodes), np.int64), np.empty((0, dim)), element
    return data.cells, data.points, element


def _midside_nodes(comm: MPI.Comm, data: MeshData | None) -> MidsideNodes:
    from .midside_nodes import find_midside_nodes

    return find_midside_nodes(comm, data)


def _region_index(data: MeshData) -> npt.NDArray[np.int32] | None:
    if not data.regions:
        return None
    index = np.full(len(data.cells), -1, np.int32)
    for number, cells in enumerate(data.regions.values()):
        index[cells] = number
    return index


def _group_facets(
    mesh: dolfinx.mesh.Mesh, names: list[str], nodes: list[npt.NDArray[np.int64]] | None
) -> dict[str, Ints]:
    """Local facets of each group, given on rank 0 by the input nodes of their facets (collective).

    DOLFINx needs as long to find the facets of one group as those of all. Therefore each facet is sent once, with a bit
    for each group, 31 groups at a time.
    """
    result: dict[str, Ints] = {}
    for first in range(0, len(names), GROUPS_PER_CALL):
        batch = slice(first, first + GROUPS_PER_CALL)
        rows, bits = _group_bits(mesh.topology.dim, None if nodes is None else nodes[batch])
        facets, groups = facets_of_nodes(mesh, rows, bits)
        result |= {name: facets[groups >> bit & 1 == 1] for bit, name in enumerate(names[batch])}
    return result


GROUPS_PER_CALL = 31  # bits of a signed 32-bit integer without the sign


def _group_bits(dim: int, nodes: list[npt.NDArray[np.int64]] | None) -> tuple[npt.NDArray[np.int64], Ints]:
    """(n, d) sorted nodes of the distinct facets of all groups, and (n,) a number whose bit k is set in group k."""
    groups = nodes or []
    rows, _, inverse = distinct_rows(np.sort(np.concatenate([np.empty((0, dim), np.int64), *groups]), axis=1))
    bits = np.zeros(len(rows), np.int32)
    group_bit = np.repeat(1 << np.arange(len(groups), dtype=np.int32), [len(facets) for facets in groups])
    np.bitwise_or.at(bits, inverse, group_bit)
    return rows, bits
