"""Elements of a surface on a rank, and their exchange: each rank gets those of other ranks near its own.

Each rank marks the cubes of a grid that its elements overlap, grown by a distance. It sends the marks to ranks whose
bounding boxes they overlap. These send the elements that overlap a marked cube, with their points. So two elements
within the distance are on a common rank, and a rank has all elements at the points of its own elements. Names are keys
(topology.row_keys); the order is that of the input mesh.

Source: S. Plimpton and others (1998), Parallel transient dynamics simulations: algorithms for contact detection and
smoothed particle hydrodynamics, Journal of Parallel and Distributed Computing 50, 104-122.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import product

import numpy as np
from mpi4py import MPI
from scipy.sparse import csr_matrix, vstack

from ..array_types import Flags, Ints, Values
from ..mesh.parallel import allgather, alltoall
from ..mesh.split_surface.local_surface import restrict_to_used_columns
from ..mesh.split_surface.surface_map import SurfaceMap
from ..meshes.topology import row_keys


@dataclass(frozen=True)
class ExchangePolicy:
    """Tuned numbers of the exchange.

    Attributes:
        margin: approach of two points, in mean edges of the mesh, after which elements are exchanged again.
        barrier_margin: the same in implicit steps, which are longer. With 0.5 elements of a torn loaf are exchanged in
            each step, with 2 as edges break.
        cube: side of a cube in mean sizes of elements.
        max_cubes: cubes along the largest element at most.
        bits: bits of the number of a cube along an axis.
    """

    margin: float = 0.5
    barrier_margin: float = 2.0
    cube: float = 2.0
    max_cubes: int = 4
    bits: int = 20


EXCHANGE = ExchangePolicy()


@dataclass(frozen=True)
class PointRows:
    """Points of a part of a surface, row by row.

    Attributes:
        keys: (n,) names.
        lead: (n,) lowest node that each follows, in the input mesh.
        middle, out: (n, d) mean reference position of its nodes, and arm from there, m.
        mean, arms: (n, nodes of the mesh) weights of a SurfaceMap.
        share: (n,) factors of the arms.
        area: (n,) m^2, of the elements of all ranks.
        stiffness: (n,) k_p, N/m.
    """

    keys: Ints
    lead: Ints
    middle: Values
    out: Values
    mean: csr_matrix
    arms: csr_matrix
    share: Values
    area: Values
    stiffness: Values


@dataclass(frozen=True)
class ElementRows:
    """Elements of a part of a surface, row by row.

    Attributes:
        corners: (m, d) rows of points.
        rank: (m,) rank of the cell.
        is_excluded: (m,) whether there is no room for the element, so that it has no contact.
    """

    corners: Ints
    rank: Ints
    is_excluded: Flags


@dataclass(frozen=True)
class ElementSet:
    """Part of a surface.

    Attributes:
        points: its points.
        elements: its elements.
    """

    points: PointRows
    elements: ElementRows

    @property
    def element_keys(self) -> Ints:
        """(m,) names of the elements."""
        return row_keys(np.sort(self.points.keys[self.elements.corners], axis=1))

    def select(self, elements: Ints) -> ElementSet:
        """Some of the elements (k,), with their points."""
        chosen = _take(self.elements, elements)
        rows, corners = np.unique(chosen.corners, return_inverse=True)
        return ElementSet(_take(self.points, rows), replace(chosen, corners=corners.reshape(chosen.corners.shape)))

    def ordered(self) -> ElementSet:
        """Points by their lowest nodes and keys, and elements by their first points and keys."""
        points = self.points
        order = np.lexsort((points.keys, points.lead))
        row = np.empty(len(order), np.int64)
        row[order] = np.arange(len(order))
        corners = row[self.elements.corners]
        # the lowest corner first, so that nothing depends on the cell's numbering on its rank
        d = corners.shape[1]
        turned = (corners.argmin(axis=1)[:, None] + np.arange(d)) % d if d == 3 else np.arange(d)[None]
        corners = np.take_along_axis(corners, np.broadcast_to(turned, corners.shape), axis=1)
        by_corner = np.lexsort((self.element_keys, corners.min(axis=1, initial=len(row))))
        elements = _take(replace(self.elements, corners=corners), by_corner)
        return ElementSet(_take(points, order), elements)

    def point_map(self) -> tuple[Ints, SurfaceMap]:
        """Global numbers of the nodes that the points follow, and the map from these to the points."""
        points = self.points
        columns, (mean, arms) = restrict_to_used_columns([points.mean, points.arms])
        return columns, SurfaceMap(mean, points.middle, arms, points.out, points.share)


def _take[Rows: (PointRows, ElementRows)](rows: Rows, numbers: Ints) -> Rows:
    """Some of the rows."""
    return type(rows)(**{field.name: getattr(rows, field.name)[numbers] for field in fields(rows)})


def join_element_sets(sets: Sequence[ElementSet]) -> ElementSet:
    """Union of parts of a surface whose elements differ, in its order."""
    arrays = {}
    for field in fields(PointRows):
        columns = [getattr(element_set.points, field.name) for element_set in sets]
        is_sparse = isinstance(columns[0], csr_matrix)
        arrays[field.name] = vstack(columns, format="csr") if is_sparse else np.concatenate(columns)
    points = PointRows(**arrays)
    _, first, number = np.unique(points.keys, return_index=True, return_inverse=True)
    starts = np.cumsum([0, *(len(element_set.points.keys) for element_set in sets)])
    corners = [number[rows.elements.corners + start] for rows, start in zip(sets, starts, strict=False)]
    elements = ElementRows(
        np.concatenate(corners),
        np.concatenate([element_set.elements.rank for element_set in sets]),
        np.concatenate([element_set.elements.is_excluded for element_set in sets]),
    )
    return ElementSet(_take(points, first), elements).ordered()


def exchange_elements(
    comm: MPI.Intracomm, element_set: ElementSet, boxes: Values, searched: Values, reach: float
) -> ElementSet:
    """Elements of a rank and those of other ranks within `reach`, m, of boxes, in the order of a surface (collective).

    Args:
        comm: ranks.
        element_set: elements of this rank.
        boxes: (m, 2, d) lower and upper corners of their bounding boxes, m.
        searched: (k, 2, d) boxes near which elements of other ranks are wanted, m.
        reach: m.
    """
    if comm.size == 1:
        return element_set
    grown = searched + reach * np.array([[-1.0], [1.0]])
    origin, side = _grid(comm, boxes, grown)
    element, cube = _overlapped_cubes(boxes, origin, side)
    _, wanted = _overlapped_cubes(grown, origin, side)
    limits = allgather(comm, (_bounds(boxes), _bounds(grown)))
    # a rank asks those ranks alone whose elements may be near
    none: Ints = np.empty(0, np.int64)
    asks = [
        rank != comm.rank and bool(np.all(_bounds(grown)[0] <= high) and np.all(low <= _bounds(grown)[1]))
        for rank, ((low, high), _) in enumerate(limits)
    ]
    wanted = np.unique(wanted)
    requests = alltoall(comm, [wanted if ask else none for ask in asks])
    sent: list[ElementSet | None] = [None] * comm.size
    for rank, cubes in enumerate(requests):
        if len(cubes) and len(near := np.unique(element[np.isin(cube, cubes)])):
            sent[rank] = element_set.select(near)
    arrived = [rows for rows in alltoall(comm, sent) if rows is not None]
    return join_element_sets([element_set, *arrived])


def _bounds(boxes: Values) -> Values:
    """(2, d) bounding box of boxes (k, 2, d)."""
    return np.stack([boxes[:, 0].min(axis=0, initial=np.inf), boxes[:, 1].max(axis=0, initial=-np.inf)])


def _grid(comm: MPI.Intracomm, boxes: Values, grown: Values) -> tuple[Values, float]:
    """(d,) lowest corner of all boxes, m, and the side of the cubes, m (collective)."""
    size = (boxes[:, 1] - boxes[:, 0]).max(axis=1, initial=0.0)
    sums = np.array([size.sum(), len(size)])
    comm.Allreduce(MPI.IN_PLACE, sums, MPI.SUM)
    extremes = np.append(_bounds(np.concatenate([boxes, grown]))[0], -size.max(initial=0.0))
    comm.Allreduce(MPI.IN_PLACE, extremes, MPI.MIN)
    mean = sums[0] / max(sums[1], 1.0)
    return extremes[:-1], float(max(EXCHANGE.cube * mean, -extremes[-1] / EXCHANGE.max_cubes))


def _overlapped_cubes(boxes: Values, origin: Values, side: float) -> tuple[Ints, Ints]:
    """(k,) boxes, and (k,) the numbers of the cubes that each overlaps."""
    low, high = (np.floor((boxes[:, end] - origin) / side).astype(np.int64) for end in range(2))
    rows, cubes, span = [], [], high - low
    for offset in product(*(range(int(largest) + 1) for largest in span.max(axis=0, initial=0))):
        overlap = np.flatnonzero((span >= np.array(offset)).all(axis=1))
        # beyond the bits, in a body that has flown apart, far cubes share a number: more is sent than needed
        position = (low[overlap] + np.array(offset)) & ((1 << EXCHANGE.bits) - 1)
        number = position[:, 0]
        for axis in range(1, boxes.shape[2]):
            number = (number << EXCHANGE.bits) | position[:, axis]
        rows.append(overlap)
        cubes.append(number)
    return np.concatenate(rows), np.concatenate(cubes)


def own_points(rank: Ints, elements: Ints, count: int, this: int) -> Flags:
    """(n,) whether a rank is the lowest one of the elements (m, d), of ranks (m,), at points n = `count`."""
    lowest = np.full(count, np.iinfo(np.int64).max)
    np.minimum.at(lowest, elements, rank[:, None])
    return np.asarray(lowest == this)


def bounding_boxes(corners: Values) -> Values:
    """(m, 2, d) lowest and highest corners of the bounding boxes of points (m, c, d), m."""
    return np.stack([corners.min(axis=1), corners.max(axis=1)], axis=1)


# --- displacements for which elements were exchanged ---


@dataclass(frozen=True)
class ExchangePath:
    """Displacements for which elements were exchanged; they serve all positions near one of them.

    Any two points have come nearer than there by at most the diagonal of the bounding box of the motions of all points.

    Attributes:
        comm: ranks.
        margin: approach of two points up to which positions are served, m.
        stops: positions (n, d) of several sets of this rank's points at each displacement, m.
    """

    comm: MPI.Intracomm
    margin: float
    stops: Sequence[list[Values]]

    def serves(self, positions: Sequence[list[Values]]) -> bool:
        """Whether no element can be missing at positions as of `stops` (collective)."""
        motions = [
            [[end - begin for end, begin in zip(x, stop, strict=True)] for stop in self.stops] for x in positions
        ]
        distances = motion_diagonals(self.comm, motions).min(axis=1)
        # positions that are no numbers have no elements
        return not np.any((distances > self.margin) & np.isfinite(distances))


def motion_diagonals(comm: MPI.Intracomm, motions: Sequence[Sequence[Sequence[Values]]]) -> Values:
    """(m, k) diagonals of the bounding boxes of m times k motions on all ranks, m (collective).

    A motion is that of several sets of points (n, d): no two points approach by more.
    """
    if not motions or not motions[0]:
        return np.empty((len(motions), 0))
    d = motions[0][0][0].shape[1]
    # by columns: minima along the first axis take twenty times as long
    bounds = np.array(
        [
            [
                [min(part[:, axis].min(initial=np.inf) for part in motion) for axis in range(d)]
                + [min(-part[:, axis].max(initial=-np.inf) for part in motion) for axis in range(d)]
                for motion in row
            ]
            for row in motions
        ]
    )
    comm.Allreduce(MPI.IN_PLACE, bounds, MPI.MIN)
    return np.asarray(np.linalg.norm(bounds[..., :d] + bounds[..., d:], axis=2))
