"""Meshes in files that all ranks read: each its share of the cells and points, which it checks.

A mesh that is read so has nothing to mend or to refuse. Any other one is read and checked on rank 0 (meshes.check),
which has the messages.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..meshes.cell_sets import MAX_TAGS
from ..meshes.check import connection_notes, inner_facets_note, is_single_precision, measure_bounds
from ..meshes.data import MeshError
from ..meshes.parameters import LONGEST, check_extent
from ..meshes.topology import components, facet_sides, row_keys, signed_measures, sorted_rows
from ..meshes.vtkhdf import FileMesh
from .dolfinx_compat import coordinate_element
from .domain import BoundingBox, Domain, create_mesh_with_groups, owned_input_cells
from .fragments import find_bodies
from .ghost_exchange import owner_values
from .parallel import RemoteRows, RowRouting, allgather, rank_offset, sum_over_ranks

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class MeshShare:
    """What one rank has of a mesh: cells, points and facets in equal blocks, in the order of the file.

    Attributes:
        cell_count: number of cells on all ranks.
        points: (n, d) block of the points, m.
        cells: (m, d + 1) nodes of a block of the cells.
        cell_region: (m,) index into `regions` of each of these cells, -1 outside all regions.
        regions: names.
        facet_groups: (k, d) nodes of those facets of each group that are in a block of the facets.
        bounds: bounding box of the body, over all ranks.
        points_coincide: whether any two points are at the same place.
        notes: messages to the user on groups.
    """

    cell_count: int
    points: Values
    cells: Ints
    cell_region: npt.NDArray[np.int32]
    regions: list[str]
    facet_groups: dict[str, Ints]
    bounds: BoundingBox
    points_coincide: bool
    notes: tuple[str, ...]

    @property
    def dim(self) -> int:
        """Dimension of the body, 2 or 3."""
        return self.points.shape[1]


# --- blocks ---------------------------------------------------------------------------------------------------------


def block_start(count: int, ranks: int, rank: int) -> int:
    """First row of the block of a rank, of `count` rows in equal blocks."""
    return count * rank // ranks


def request_block_rows(comm: MPI.Comm, count: int, rows: Ints) -> RemoteRows:
    """An exchange of rows (n,) of arrays of `count` rows, of which each rank has a block (collective)."""
    starts = np.array([block_start(count, comm.size, rank) for rank in range(comm.size)])
    rank = np.searchsorted(starts, rows, side="right") - 1
    return RemoteRows(comm, rank, rows - starts[rank])


# --- reading --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FileBlocks:
    """Blocks of the arrays of a file.

    Attributes:
        points: (n, 3).
        cells, facets: nodes.
        cell_tags, facet_tags: numbers of their groups.
    """

    points: Values
    cells: Ints
    cell_tags: Ints
    facets: Ints
    facet_tags: Ints


def read_share(comm: MPI.Comm, file: FileMesh, scale: float = 1.0) -> MeshShare | None:
    """The share of this rank; None on all ranks if the mesh has something to mend or to refuse (collective).

    `scale`: m per unit of length of the file.
    """
    blocks = _read_blocks(comm, file)
    if not comm.allreduce(blocks is not None, op=MPI.LAND):
        return None
    assert blocks is not None
    points = np.ascontiguousarray(blocks.points[:, : file.dim])
    checks = _ShareChecks(comm, blocks, points, len(file.points))
    bounds = BoundingBox(checks.bounds.lower * scale, checks.bounds.upper * scale)
    tags = [_distinct_tags(comm, rows) for rows in (blocks.facet_tags, blocks.cell_tags)]
    groups, regions = ({tag: file.names.get(tag, f"tag-{tag}") for tag in numbers if tag != 0} for numbers in tags)
    is_clear = all(len(set(names.values())) == len(names) for names in (groups, regions))
    is_clear = is_clear and len({*tags[0], *tags[1]}) <= MAX_TAGS
    is_sound = checks.is_sound() and is_clear and _is_in_range(checks.bounds) and _is_in_range(bounds)
    if not comm.allreduce(is_sound, op=MPI.LAND):
        return None
    members = {name: np.flatnonzero(blocks.facet_tags == tag) for tag, name in groups.items()}
    inner = checks.is_inner_facet()
    notes: list[str] = []
    for name, rows in members.items():
        count, inside = sum_over_ranks(comm, [len(rows), np.count_nonzero(inner[rows])])
        notes += inner_facets_note(name, count, inside)
    cell_region = np.full(len(blocks.cells), -1, np.int32)
    for number, tag in enumerate(regions):
        cell_region[blocks.cell_tags == tag] = number
    facets = {name: blocks.facets[rows] for name, rows in members.items()}
    return MeshShare(
        file.cell_count, points * scale, blocks.cells, cell_region, list(regions.values()), facets, bounds,
        checks.points_coincide(), tuple(notes),
    )  # fmt: skip


def _read_blocks(comm: MPI.Comm, file: FileMesh) -> FileBlocks | None:
    """The blocks of this rank; None if it is not the file of a mesh, with nodes and coordinates in range."""

    def block(count: int) -> tuple[int, int]:
        return block_start(count, comm.size, comm.rank), block_start(count, comm.size, comm.rank + 1)

    try:
        points = file.points.read(*block(len(file.points)))
        cells = file.read_rows(*block(file.cell_count))
        facets = file.read_rows(*block(file.facet_count), facets=True)
    except (OSError, ValueError):
        return None
    if cells is None or facets is None:
        return None
    for nodes, _ in (cells, facets):
        if nodes.size and not 0 <= nodes.min() <= nodes.max() < len(file.points):
            return None
    # a facet without a group is a cell that is no part of the body
    if not np.all(np.abs(points) <= LONGEST) or np.any(points[:, file.dim :]) or np.any(facets[1] == 0):
        return None
    return FileBlocks(points, *cells, *facets)


def _distinct_tags(comm: MPI.Comm, tags: Ints) -> list[int]:
    """The numbers of groups that occur on any rank, in rising order (collective)."""
    numbers: list[int] = np.unique(np.concatenate(allgather(comm, np.unique(tags)))).tolist()
    return numbers


def _is_in_range(bounds: BoundingBox) -> bool:
    """Whether the size and place of a body are allowed."""
    try:
        check_extent(np.stack([bounds.lower, bounds.upper]), "the mesh")
    except MeshError:
        return False
    return True


# --- checks ---------------------------------------------------------------------------------------------------------


class _ShareChecks:
    """Checks of blocks of cells, points and facets; what ranks share is compared on one of them (collective).

    Attributes:
        bounds: bounding box of all points.
    """

    def __init__(self, comm: MPI.Comm, blocks: FileBlocks, points: Values, point_count: int) -> None:
        """`points`: (n, d) block of all `point_count` points."""
        self._comm, self._points, self._cells = comm, points, blocks.cells
        self.bounds = self._bounding_box()
        nodes, self._corners = _local_numbers(blocks.cells)
        exchange = request_block_rows(comm, point_count, nodes)
        self._corner_points: Values = exchange(points[exchange.requested])[0]
        self._all_used = len(exchange.requested) == len(points)
        # a facet and one of its sides belong to one cell at most
        self._sides = self._facets_of_cells()
        self._facets = np.column_stack([sorted_rows(blocks.facets), blocks.facet_tags])
        self._cell_counts = self._cells_at(self._facets[:, :-1])

    def _bounding_box(self) -> BoundingBox:
        d = self._points.shape[1]
        lower, upper = np.empty(d), np.empty(d)
        self._comm.Allreduce(self._points.min(axis=0, initial=np.inf), lower, op=MPI.MIN)
        self._comm.Allreduce(self._points.max(axis=0, initial=-np.inf), upper, op=MPI.MAX)
        return BoundingBox(lower, upper)

    def _facets_of_cells(self) -> Ints:
        """Sorted keys of facets of all cells with their sides, those that fall to this rank."""
        keys = [sides * row_keys(facets) for facets, sides in facet_sides(self._cells)]
        return np.sort(_to_key_owners(self._comm, np.concatenate(keys)))

    def _cells_at(self, facets: Ints) -> Ints:
        """(k,) number of cells at each facet (k, d), nodes in rising order."""
        keys = row_keys(facets)
        both_sides = np.concatenate([keys, -keys])
        routing = RowRouting(self._comm, both_sides % self._comm.size)
        has_cell = np.isin(routing.send(both_sides), self._sides)
        return np.asarray(routing.send_back(has_cell).reshape(2, -1).sum(axis=0))

    def is_sound(self) -> bool:
        """Whether this rank found nothing to mend or to refuse (collective)."""
        single = self._comm.allreduce(is_single_precision(self._points), op=MPI.LAND)
        bound = measure_bounds(self._corner_points, self._corners, single=single)
        is_positive = bool(np.all(signed_measures(self._corner_points, self._corners) > bound))
        groups = np.sort(_to_key_owners(self._comm, row_keys(self._facets)))
        is_repeated = _has_repeats(self._sides) or _has_repeats(groups)
        return is_positive and self._all_used and not is_repeated and bool(np.all(self._cell_counts))

    def is_inner_facet(self) -> npt.NDArray[np.bool_]:
        """(k,) whether each facet lies between two cells."""
        return self._cell_counts > 1

    def points_coincide(self) -> bool:
        """Whether any two points are at the same place, on any rank (collective)."""
        # + 0.0: -0 and 0 have the same bits then
        keys = _to_key_owners(self._comm, row_keys((self._points + 0.0).view(np.int64)))
        return bool(self._comm.allreduce(_has_repeats(np.sort(keys)), op=MPI.LOR))


def _to_key_owners(comm: MPI.Comm, keys: Ints) -> Ints:
    """The keys of all ranks that fall to this rank (collective)."""
    return RowRouting(comm, keys % comm.size).send(keys)


def _has_repeats(keys: Ints) -> bool:
    """Whether any two of keys (n,) in rising order are equal."""
    return bool(np.any(keys[1:] == keys[:-1]))


def _local_numbers(cells: Ints) -> tuple[Ints, Ints]:
    """(n,) the nodes of cells, each once, and (m, d + 1) their numbers from 0 on in the cells."""
    low, high = (int(cells.min()), int(cells.max())) if cells.size else (0, -1)
    if high - low > 8 * cells.size:
        nodes, numbers = np.unique(cells, return_inverse=True)
        return nodes, numbers.reshape(cells.shape)
    # the nodes of a block are close together, as a rule
    used = np.zeros(high - low + 1, bool)
    used[cells - low] = True
    number = np.cumsum(used) - 1
    return np.flatnonzero(used) + low, number[cells - low]


# --- distribution ---------------------------------------------------------------------------------------------------


def distribute_shares(comm: MPI.Comm, share: MeshShare) -> Domain:
    """The domain of a mesh of which each rank has a share, partitioned over the ranks (collective).

    Cells are not ghosted, displacement is linear.
    """
    groups = {name: _facets_once(comm, facets) for name, facets in share.facet_groups.items()}
    geometry = share.cells, share.points, coordinate_element(share.dim)
    mesh, facets = create_mesh_with_groups(comm, geometry, groups)
    exchange = request_block_rows(comm, share.cell_count, owned_input_cells(mesh))
    (region,) = exchange(share.cell_region[exchange.requested])
    domain = Domain(mesh, facets, share.regions, region.astype(np.int32), share.bounds, group_nodes=share.facet_groups)
    return replace(domain, notes=(*share.notes, *_find_connections(domain, coincide=share.points_coincide)))


def _facets_once(comm: MPI.Comm, facets: Ints) -> Ints:
    """Facets of all ranks, equal ones of several groups on one rank (collective)."""
    rows = sorted_rows(facets)
    return RowRouting(comm, row_keys(rows) % comm.size).send(rows)


def _find_connections(domain: Domain, *, coincide: bool) -> tuple[str, ...]:
    """Notes on how the parts of a mesh are connected, on rank 0 (collective).

    `coincide`: whether any two nodes are at the same place.
    """
    parts = count_parts(domain)
    if parts == 1 and not coincide:
        return ()
    bodies, gather_nodes = find_bodies(domain), domain.input_numbering.gather_nodes
    points, body = gather_nodes(domain.nodes), gather_nodes(bodies.node_fragment)
    if points is None or body is None:
        return ()
    return tuple(connection_notes(points, body, bodies.count, parts))


def count_parts(domain: Domain) -> int:
    """Number of parts of a mesh that share no facet (collective)."""
    count, part = components(domain.facets.neighbours, domain.cell_count)
    if domain.comm.size == 1:
        return count
    # a facet between two ranks links the parts of both
    index_map = domain.mesh.topology.index_map(domain.dim - 1)
    label = np.full(index_map.size_local + index_map.num_ghosts, -1, np.int64)
    label[domain.facets.cell_facets] = (part + rank_offset(domain.comm, count))[:, None]
    ghosts = slice(index_map.size_local, None)
    links = np.stack([label[ghosts], owner_values(index_map, label)[ghosts]], axis=1)
    all_links = np.concatenate(allgather(domain.comm, np.unique(links, axis=0)))
    return components(all_links, int(sum_over_ranks(domain.comm, count)[0]))[0]
