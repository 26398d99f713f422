"""Meshes of other DOLFINx programs: the arrays of a mesh that is shared among ranks, in an order of their own.

Nodes are numbered by their coordinates and cells by their nodes. Hence the arrays, and the crack, do not depend on the
number of ranks that shared the mesh. Rank 0 holds the arrays, as it holds those of a builder or reader.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import dolfinx
import numpy as np
import numpy.typing as npt

from ..errors import InputError
from ..meshes.data import MeshData
from ..meshes.topology import orient_cells
from .dolfinx_compat import cell_geometry
from .parallel import allgather, gather

Ints = npt.NDArray[np.int64]
type NamedTags = tuple[dolfinx.mesh.MeshTags, Mapping[str, int]]


@dataclass(frozen=True)
class GivenMesh:
    """A mesh of DOLFINx as arrays (rank 0).

    Attributes:
        mesh: arrays with named groups and regions.
        nodes: (n,) number of each point in `geometry.input_global_indices` of the mesh of DOLFINx.
        cells: (m,) number of each cell in its `topology.original_cell_index`.
    """

    mesh: MeshData
    nodes: Ints
    cells: Ints


def gather_mesh(
    mesh: dolfinx.mesh.Mesh, facets: NamedTags | None = None, regions: NamedTags | None = None
) -> GivenMesh | None:
    """Gather a mesh on rank 0; None on the other ranks (collective).

    Args:
        mesh: straight triangles in the plane or tetrahedra in space, with or without ghost cells.
        facets: tags of facets, and the tag of each named group.
        regions: tags of cells, and the tag of each named region.

    Raises:
        InputError: other cells, tags of other entities, or a name whose tag no entity has.
    """
    _check_cells(mesh)
    dim, comm = mesh.topology.dim, mesh.comm
    count = mesh.topology.index_map(dim).size_local
    numbers = np.asarray(mesh.geometry.input_global_indices, np.int64)
    cells = cell_geometry(mesh.geometry)[:count]
    used = np.unique(cells)
    points = gather(comm, (numbers[used], mesh.geometry.x[used, :dim]))
    rows = gather(comm, (np.asarray(mesh.topology.original_cell_index[:count], np.int64), numbers[cells]))
    groups = {name: gather(comm, numbers[nodes]) for name, nodes in _tagged_facets(mesh, facets).items()}
    labels = {name: gather(comm, chosen) for name, chosen in _tagged_cells(mesh, regions).items()}
    if points is None or rows is None:
        return None
    node_numbers, first = np.unique(np.concatenate([part for part, _ in points]), return_index=True)
    x = np.concatenate([part for _, part in points])[first]
    order = np.lexsort(x.T[::-1])
    new_number = np.empty(len(order), np.int64)
    new_number[order] = np.arange(len(order))

    def renumber(nodes: Ints) -> Ints:
        return np.sort(new_number[np.searchsorted(node_numbers, nodes)], axis=1)

    nodes = renumber(np.concatenate([part for _, part in rows]))
    cell_order = np.lexsort(nodes.T[::-1])
    oriented, _ = orient_cells(x[order], nodes[cell_order])
    facet_groups = {
        name: np.unique(renumber(np.concatenate(parts)), axis=0) for name, parts in groups.items() if parts is not None
    }
    flags = {name: np.concatenate(parts)[cell_order] for name, parts in labels.items() if parts is not None}
    region_cells = {name: np.flatnonzero(chosen) for name, chosen in flags.items()}
    data = MeshData(x[order], oriented, facet_groups, region_cells)
    return GivenMesh(data, node_numbers[order], np.concatenate([part for part, _ in rows])[cell_order])


def _check_cells(mesh: dolfinx.mesh.Mesh) -> None:
    """Raise InputError unless cells are straight triangles of the plane or tetrahedra."""
    kind, dim = mesh.topology.cell_name(), mesh.geometry.dim
    if kind not in ("triangle", "tetrahedron") or dim != mesh.topology.dim:
        raise InputError(
            f"the mesh has cells of the kind {kind} in {dim} dimensions; triangles in 2 or tetrahedra in 3 are needed: "
            "for example dolfinx.mesh.create_rectangle(comm, corners, (20, 20), dolfinx.mesh.CellType.triangle)"
        )
    if (nodes := cell_geometry(mesh.geometry).shape[1]) != dim + 1:
        raise InputError(
            f"the mesh has cells with {nodes} nodes; straight cells with {dim + 1} are needed: make the mesh of order 1"
        )


def _tagged_facets(mesh: dolfinx.mesh.Mesh, tags: NamedTags | None) -> dict[str, Ints]:
    """Return geometry nodes (k, d) of the local facets of each group (collective)."""
    facet_dim = mesh.topology.dim - 1
    mesh.topology.create_connectivity(facet_dim, facet_dim + 1)
    groups: dict[str, Ints] = {}
    for name, facets in _tagged(mesh, tags, facet_dim, "facets").items():
        # of no entities DOLFINx divides by their number
        nodes = dolfinx.mesh.entities_to_geometry(mesh, facet_dim, facets) if len(facets) else np.empty(0)
        groups[name] = np.asarray(nodes, np.int64).reshape(-1, facet_dim + 1)
    return groups


def _tagged_cells(mesh: dolfinx.mesh.Mesh, tags: NamedTags | None) -> dict[str, npt.NDArray[np.bool_]]:
    """Return flags (owned cells,) of each region (collective)."""
    dim, regions = mesh.topology.dim, {}
    for name, cells in _tagged(mesh, tags, dim, "regions").items():
        regions[name] = np.zeros(mesh.topology.index_map(dim).size_local, bool)
        regions[name][cells[cells < len(regions[name])]] = True
    return regions


def _tagged(mesh: dolfinx.mesh.Mesh, tags: NamedTags | None, dim: int, what: str) -> dict[str, npt.NDArray[np.int32]]:
    """Return local entities of each name. Raises InputError for other entities or an unused tag (collective)."""
    if tags is None:
        return {}
    tagged, names = tags
    if tagged.dim != dim:
        raise InputError(f"{what}: the tags are those of entities of dimension {tagged.dim}; {dim} is needed")
    present = sorted(set(np.concatenate(allgather(mesh.comm, np.unique(tagged.values))).tolist()))
    for name, tag in names.items():
        if tag not in present:
            raise InputError(f"{what}: no entity has the tag {tag} of {name!r}; there are {present or 'none'}")
    return {name: tagged.find(tag) for name, tag in names.items()}
