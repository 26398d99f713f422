"""Numbers of the points and elements of a split surface that ranks have in parts.

They are those of the surface of the whole mesh built on one rank, so that files do not depend on the number of ranks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..parallel import RowRouting, allgather, rank_offset, sum_over_ranks
from .closed_surface import SplitSurface
from .entity_numbering import CRACK
from .mesh_part import MeshPart

Flags = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class SurfaceNumbering:
    """Numbers of the points and elements of a rank on the whole surface.

    Attributes:
        comm: the ranks that have parts of the surface.
        points: (n,) number of each point of this rank.
        is_own: (n,) flags of points that belong to this rank; a point that ranks share belongs to one of them.
        elements: (m,) number of each element of this rank: triangles, then segments.
        point_count, triangle_count, segment_count: of the whole surface.
    """

    comm: MPI.Intracomm
    points: Ints
    is_own: Flags
    elements: Ints
    point_count: int
    triangle_count: int
    segment_count: int


def number_whole_surface(points: int, triangles: int, segments: int) -> SurfaceNumbering:
    """Numbers of a surface that one rank has, from the numbers of its points, triangles and segments."""
    elements = np.arange(triangles + segments)
    return SurfaceNumbering(
        MPI.COMM_SELF, np.arange(points), np.ones(points, bool), elements, points, triangles, segments
    )


def number_surface(part: MeshPart, split: SplitSurface, pattern: npt.NDArray[np.integer]) -> SurfaceNumbering:
    """Numbers of the split surface of a part of a mesh with damage patterns (C,) (collective)."""
    flat = part.skeleton.dim == 2
    counts = np.array([len(split.fill), 0]) + ([0, len(split.elements)] if flat else [len(split.elements), 0])
    if part.comm.size == 1:
        return number_whole_surface(len(split.points), *counts.tolist())
    assert split.numbering is not None
    keys, lowest_cell = split.numbering.order_keys(part.node_numbers, part.cell_numbers)
    points, is_own = number_rows(part.comm, keys, lowest_cell)
    # as build_split_surface orders them: triangles that cover the body, its boundary, and crack faces
    cell, filled = np.concatenate([split.fill_cell, split.cell]), len(split.fill)
    section = 2 + (pattern[cell] != 0)
    section[:filled] -= 2
    section[filled:][split.origin == CRACK] = 4
    cell_key = (section << 40) + part.cell_numbers[cell]
    elements, _ = number_rows(part.comm, np.stack([cell_key, np.arange(len(cell))], axis=1))
    totals = sum_over_ranks(part.comm, np.append(counts, np.count_nonzero(is_own)))
    triangles, segments, point_count = map(int, totals)
    return SurfaceNumbering(part.comm, points, is_own, elements, point_count, triangles, segments)


def number_rows(comm: MPI.Intracomm, rows: Ints, preference: Ints | None = None) -> tuple[Ints, Flags]:
    """Numbers (n,) of rows (n, w) among the distinct rows of all ranks in rising order (collective).

    Also returns flags (n,): of equal rows of several ranks the one with the least `preference` (n,) is flagged.
    """
    preference = np.zeros(len(rows), np.int64) if preference is None else preference
    # rows with one first column meet on one rank; ranks have the columns in rising order
    # every 256th key of a rank tells how keys are distributed
    sample = np.sort(np.concatenate(allgather(comm, np.sort(rows[:, 0])[::256])))
    borders = sample[len(sample) * np.arange(1, comm.size) // comm.size] if len(sample) else sample
    routing = RowRouting(comm, np.searchsorted(borders, rows[:, 0], side="right"))
    arrived = routing.send(np.column_stack([rows, preference]))
    order = np.lexsort(arrived.T[::-1])
    ordered = arrived[order, :-1]
    is_first = np.ones(len(order), bool)
    is_first[1:] = (ordered[1:] != ordered[:-1]).any(axis=1)
    number = rank_offset(comm, int(np.count_nonzero(is_first))) + np.cumsum(is_first) - 1
    results = np.empty((len(order), 2), np.int64)
    results[order] = np.column_stack([number, is_first])
    result = routing.send_back(results)
    return result[:, 0], result[:, 1] == 1
