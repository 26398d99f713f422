"""Domain: the distributed mesh of a body with named groups, from the arrays of a builder or reader."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import dolfinx
import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI

from ..meshes.data import MeshData, format_point, hash_arrays, mesh_fingerprint
from ..meshes.topology import signed_measures
from .dolfinx_compat import CachedCellElement, cell_geometry, coordinate_element, create_mesh
from .facets import Facets, find_group_facets
from .midside_nodes import CellMidsideNodes, MidsideNodes, find_midside_nodes, with_midside_nodes
from .parallel import BlockGather, Gather, GatherSubset, bcast, gather, rank_offset, sum_over_ranks

Ints = npt.NDArray[np.int32]
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class BoundingBox:
    """Axis-aligned bounding box of a body.

    Attributes:
        lower, upper: (d,) corners, m.
    """

    lower: Values
    upper: Values

    @property
    def diagonal(self) -> float:
        """Length of the diagonal, m."""
        return float(np.linalg.norm(self.upper - self.lower))

    def __str__(self) -> str:
        return f"{format_point(self.lower)} to {format_point(self.upper)}"


@dataclass(frozen=True)
class InputNumbering:
    """Numbers in the input mesh of the nodes and cells of this rank, and gathering of their rows in that order.

    Attributes:
        comm: communicator of the mesh.
        nodes: (nodes,) number of every owned and ghost node; midside nodes follow the points of the input mesh.
        cells: (cells,) number of every owned cell.
        owned_nodes: number of owned nodes, which come first.
        point_count: number of points of the input mesh; None: all nodes are points of it.
    """

    comm: MPI.Intracomm
    nodes: npt.NDArray[np.int64]
    cells: npt.NDArray[np.int64]
    owned_nodes: int
    point_count: int | None

    @cached_property
    def owned_corners(self) -> slice | npt.NDArray[np.bool_]:
        """Owned nodes that are corners of cells, as a slice or (nodes,) flags."""
        if self.point_count is None:
            return slice(self.owned_nodes)
        return (self.nodes < self.point_count) & (np.arange(len(self.nodes)) < self.owned_nodes)

    @cached_property
    def gather_nodes(self) -> Gather:
        """Gathers rows of nodes in the order of the input mesh."""
        return Gather(self.comm, self.nodes[: self.owned_nodes])

    @cached_property
    def gather_corners(self) -> Gather:
        """Gathers rows of corners: the points of the input mesh in their order."""
        if isinstance(self.owned_corners, slice):
            return self.gather_nodes
        owned = slice(self.owned_nodes)
        return GatherSubset(self.comm, self.nodes[owned], self.owned_corners[owned])

    @cached_property
    def gather_cells(self) -> Gather:
        """Gathers rows of cells in the order of the input mesh."""
        return Gather(self.comm, self.cells)


@dataclass(frozen=True)
class Domain:
    """A partitioned simplex mesh without ghost cells: every cell belongs to one rank.

    Nodes are the nodes of the displacement: corners of cells and, for quadratic displacement, midside nodes.

    Attributes:
        mesh: DOLFINx mesh; its geometry is P1, or P2 if cells are curved.
        facets: facets of the cells: named groups, boundary, neighbours.
        region_names: names of the regions, in the order of `cell_region`.
        cell_region: (cells,) index into region_names of each owned cell, -1 outside all regions.
        bounds: bounding box of the body, over all ranks.
        notes: messages to the user on the input mesh, on rank 0.
        whole_mesh: the input mesh on rank 0 that built or read it; None elsewhere, and where ranks read their shares.
        group_nodes: (k, d) input nodes of the facets of each group in the share of this rank; None without shares.
        midside_nodes: of the input mesh for quadratic displacement; None: displacement is linear.
    """

    mesh: dolfinx.mesh.Mesh
    facets: Facets
    region_names: list[str]
    cell_region: npt.NDArray[np.int32]
    bounds: BoundingBox
    notes: tuple[str, ...] = ()
    whole_mesh: MeshData | None = None
    group_nodes: dict[str, npt.NDArray[np.int64]] | None = None
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
    def cell_count(self) -> int:
        """Number of owned cells."""
        return int(self.mesh.topology.index_map(self.dim).size_local)

    @property
    def order(self) -> int:
        """Polynomial order of the displacement, 1 or 2."""
        return 1 if self.midside_nodes is None else 2

    @property
    def has_curved_cells(self) -> bool:
        """Whether any cell has curved edges."""
        return self.midside_nodes is not None and self.midside_nodes.curved

    @cached_property
    def space(self) -> fem.FunctionSpace:
        """P1 or P2 function space of the displacement."""
        return fem.functionspace(self.mesh, ("Lagrange", self.order, (self.dim,)))

    @cached_property
    def scalar_cell_space(self) -> fem.FunctionSpace:
        """DG0 function space of scalars; dof i is cell i."""
        return fem.functionspace(self.mesh, ("DG", 0))

    def vector_cell_space(self, components: int) -> fem.FunctionSpace:
        """DG0 function space of vectors; dof i * components + k is component k of cell i."""
        return fem.functionspace(self.mesh, ("DG", 0, (components,)))

    @cached_property
    def cell_nodes(self) -> Ints:
        """(cells, d + 1) node (blocked dof) numbers of the corners of the owned cells."""
        nodes = self.space.dofmap.list
        return nodes if self.midside_nodes is None else np.ascontiguousarray(nodes[:, : self.dim + 1])

    @property
    def all_cell_nodes(self) -> Ints:
        """(cells, n) node numbers of the owned cells; n = d + 1, or with midside nodes 6 (2D) or 10 (3D)."""
        return self.space.dofmap.list

    @cached_property
    def cell_midside_nodes(self) -> CellMidsideNodes:
        """Midside nodes of the owned cells, none for linear displacement."""
        return CellMidsideNodes(self.all_cell_nodes, self.dim)

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
            result[self.all_cell_nodes] = self.mesh.geometry.x[cell_geometry(self.mesh.geometry), : self.dim]
            return result
        result[self.cell_nodes] = self.mesh.geometry.x[cell_geometry(self.mesh.geometry), : self.dim]
        if self.midside_nodes is not None:
            self.cell_midside_nodes.straighten_edges(result)
        return result

    @property
    def corner_geometry(self) -> Ints:
        """(cells, d + 1) geometry nodes of `mesh` at the corners of the owned cells."""
        return cell_geometry(self.mesh.geometry)[:, : self.dim + 1]

    @cached_property
    def input_numbering(self) -> InputNumbering:
        """Numbers of nodes and cells in the input mesh."""
        nodes = np.full(len(self.nodes), -1, np.int64)
        nodes[self.cell_nodes] = self.mesh.geometry.input_global_indices[self.corner_geometry]
        point_count = None
        if self.midside_nodes is not None:
            midside, point_count = self.cell_midside_nodes, self.midside_nodes.points
            nodes[midside.nodes] = self.midside_nodes.index_between(nodes[midside.ends])
        cells = np.asarray(self.mesh.topology.original_cell_index[: self.cell_count], np.int64)
        return InputNumbering(self.comm, nodes, cells, self.node_count, point_count)

    @cached_property
    def input_mesh(self) -> MeshData | None:
        """The input mesh on rank 0, None elsewhere (collective); files keep its order.

        Where ranks read their shares, the mesh is gathered at first use, and stays.
        """
        return self.whole_mesh if self.group_nodes is None else self._gather_mesh(self.group_nodes)

    def _gather_mesh(self, group_nodes: dict[str, npt.NDArray[np.int64]]) -> MeshData | None:
        """The input mesh on rank 0, None elsewhere (collective); displacement is linear."""
        numbering = self.input_numbering
        points = numbering.gather_nodes(self.nodes)
        cells, region = (numbering.gather_cells(rows) for rows in (numbering.nodes[self.cell_nodes], self.cell_region))
        groups = gather(self.comm, group_nodes)
        if points is None or cells is None or region is None or groups is None:
            return None
        facets = {name: np.concatenate([part[name] for part in groups]) for name in group_nodes}
        regions = {name: np.flatnonzero(region == number) for number, name in enumerate(self.region_names)}
        return MeshData(points, cells, facets, regions, self.notes)

    @cached_property
    def fingerprint(self) -> str | None:
        """`mesh_fingerprint` of the input mesh on rank 0, None elsewhere (collective); no rank gathers the mesh."""
        if self.group_nodes is None:
            return None if self.whole_mesh is None else mesh_fingerprint(self.whole_mesh)
        digits = hash_arrays(part for part in self._hashed_parts(self.group_nodes) if part is not None)
        return digits if self.comm.rank == 0 else None

    def _hashed_parts(self, group_nodes: dict[str, npt.NDArray[np.int64]]) -> Iterator[npt.NDArray[Any] | None]:
        """What `mesh_fingerprint` hashes, in blocks on rank 0, None elsewhere (collective)."""
        numbering, owned = self.input_numbering, slice(self.node_count)
        for index, values in (
            (numbering.nodes[owned], self.nodes[owned]),
            (numbering.cells, numbering.nodes[self.cell_nodes]),
        ):
            yield from BlockGather(self.comm, index)(values)
        for name in sorted({*group_nodes, *self.region_names}):
            # a group and a region may have the same name
            if name in group_nodes:
                yield np.frombuffer(name.encode(), np.uint8)
                facets = group_nodes[name]
                index = rank_offset(self.comm, len(facets)) + np.arange(len(facets))
                yield from BlockGather(self.comm, index)(facets)
            if name in self.region_names:
                yield np.frombuffer(name.encode(), np.uint8)
                is_member, start = self.cell_region == self.region_names.index(name), 0
                for block in BlockGather(self.comm, numbering.cells)(is_member):
                    if block is not None:
                        yield start + np.flatnonzero(block)
                        start += len(block)

    @cached_property
    def volumes(self) -> npt.NDArray[np.float64]:
        """(cells,) volume (2D: area) of each owned cell in the reference configuration, m^d."""
        return np.abs(signed_measures(self.nodes, self.cell_nodes))

    @cached_property
    def mean_edge_length(self) -> float:
        """Edge length of a cube (2D: square) with the mean volume of the cells, m."""
        volume, cells = sum_over_ranks(self.comm, np.array([self.volumes.sum(), self.cell_count]))
        return float((volume / cells) ** (1 / self.dim))


def distribute(comm: MPI.Comm, data: MeshData | None, order: int = 1) -> Domain:
    """The domain of a mesh that rank 0 holds (None elsewhere), partitioned over the ranks (collective).

    Cells are not ghosted. `order` of the displacement: 1 or 2.
    """
    head = None
    if data is not None:
        # what all ranks need of the input mesh, in one message
        bounds = BoundingBox(data.points.min(axis=0), data.points.max(axis=0))
        head = (data.dim, list(data.facet_groups), _region_index(data), list(data.regions), bounds)
    dim, groups, region, region_names, bounds = bcast(comm, head)
    midside_nodes = find_midside_nodes(comm, data) if order == 2 else None
    group_nodes = {name: np.empty((0, dim), np.int64) for name in groups} if data is None else data.facet_groups
    mesh, facets = create_mesh_with_groups(comm, _geometry(data, midside_nodes, dim), group_nodes)
    owned = owned_input_cells(mesh)
    local = region[owned] if region_names else np.full(len(owned), -1, np.int32)
    notes = () if data is None else data.notes
    return Domain(mesh, facets, region_names, local, bounds, notes, data, midside_nodes=midside_nodes)


def create_mesh_with_groups(
    comm: MPI.Comm,
    geometry: tuple[npt.NDArray[np.int64], Values, CachedCellElement],
    group_nodes: dict[str, npt.NDArray[np.int64]],
) -> tuple[dolfinx.mesh.Mesh, Facets]:
    """The mesh of DOLFINx and its groups of facets, of which each rank gives some; no facet is given twice."""
    mesh = create_mesh(comm, *geometry)
    dim = mesh.topology.dim
    mesh.topology.create_entities(dim - 1)
    mesh.topology.create_connectivity(dim - 1, dim)
    return mesh, Facets(mesh, find_group_facets(mesh, group_nodes))


def owned_input_cells(mesh: dolfinx.mesh.Mesh) -> npt.NDArray[np.int64]:
    """(cells,) number in the input mesh of each owned cell."""
    count = mesh.topology.index_map(mesh.topology.dim).size_local
    return np.asarray(mesh.topology.original_cell_index[:count], np.int64)


def _geometry(
    data: MeshData | None, midside_nodes: MidsideNodes | None, dim: int
) -> tuple[npt.NDArray[np.int64], Values, CachedCellElement]:
    """Cells, points and the coordinate element, which is P2 only if cells are curved."""
    element, nodes = coordinate_element(dim), dim + 1
    if midside_nodes is not None and midside_nodes.curved:
        element, nodes = coordinate_element(dim, 2), (dim + 1) * (dim + 2) // 2
        data = data and with_midside_nodes(data, midside_nodes)
    if data is None:
        return np.empty((0, nodes), np.int64), np.empty((0, dim)), element
    return data.cells, data.points, element


def _region_index(data: MeshData) -> npt.NDArray[np.int32] | None:
    if not data.regions:
        return None
    index = np.full(len(data.cells), -1, np.int32)
    for number, cells in enumerate(data.regions.values()):
        index[cells] = number
    return index
