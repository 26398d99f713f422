"""Points of a body's split surface that obstacles act on, with new crack faces retracted where there is no room.

A crack may open where an obstacle or the body itself leaves no gap. A point of a new face is therefore retracted
towards the nodes that it follows: the factor of its arm from them is the largest at which no barrier acts. A point
that existed before keeps at least its gap, so that contact gains no energy. A point without room even at its nodes is
excluded. In every step points are extended again as far as the barrier allows.

Equations: docs/theory.md#new-crack-faces.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from scipy.sparse import bsr_matrix, csr_matrix

from ..mesh.domain import Domain
from ..mesh.parallel import allgather, gather
from ..mesh.split_surface.local_surface import LocalSurface, ParentMatrix
from ..mesh.split_surface.point_matching import match_points
from ..mesh.split_surface.surface_map import SurfaceMap, row_entries
from .facet_contact import FACETS, ContactFacets

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class RetractionPolicy:
    """Tuned numbers of the retraction of crack faces; arms are measured as factors of the full arm.

    Attributes:
        trials: factors of the current arm that are tried for a point, in turn.
        cut_trials: factors for the points of an element that is cut, applied one after another.
        extension: arm that one step gives back.
        facet_rounds: rounds in which points of new facets are retracted.
        facet_factor: factor of the arm in each round.
        min_arm: arm below which points of new facets are not retracted further.
        round_off: relative tolerance of gaps that have to be kept.
    """

    trials: tuple[float, ...] = tuple(np.linspace(1.0, 0.0, 11))
    cut_trials: tuple[float, ...] = (0.8,) * 12 + (0.0,)
    extension: float = 0.2
    facet_rounds: int = 10
    facet_factor: float = 0.7
    min_arm: float = 0.05
    round_off: float = 1e-9


RETRACTION = RetractionPolicy()
TINY = float(np.finfo(float).tiny)

type GapFunction = Callable[[Values], Values]  # (n,) distances of positions (n, d) to the nearest obstacle, m
type FacetGapFunction = Callable[[ContactFacets, Values], Values]  # (m,) gaps of facets with points at (n, d), m


@dataclass(frozen=True)
class RetractedPoints:
    """Points on crack faces near an obstacle or retracted, to be matched after edges break.

    Attributes:
        identity: (k, 2 d + 1) rows that identify the points.
        share: (k,) factors of their arms.
        gap: (k,) m; nan: excluded.
    """

    identity: Values
    share: Values
    gap: Values

    @classmethod
    def select(cls, identity: Values, share: Values, gap: Values, width: float) -> RetractedPoints:
        """Those of all points on crack faces that are within `width`, m, of an obstacle or retracted."""
        selected = np.flatnonzero(~(gap >= width) | (share < 1))
        return cls(identity[selected], share[selected], gap[selected])

    def match(self, identity: Values, width: float) -> tuple[Values, Values]:
        """(n,) factors that points begin with, and gaps that they must keep, m: `width` for new points."""
        share, gap = np.ones(len(identity)), np.full(len(identity), width)
        rows = match_points(self.identity, identity)
        share[rows[rows >= 0]], gap[rows[rows >= 0]] = self.share[rows >= 0], self.gap[rows >= 0]
        return share, np.where(np.isnan(gap), width, np.minimum(gap, width))


def retract_points(
    point_map: SurfaceMap, u: Values, points: Ints, share: Values, min_gap: Values, gaps: GapFunction
) -> tuple[SurfaceMap, Ints]:
    """Retract points until their gaps suffice.

    Args:
        point_map: map from nodes to points.
        u: (nodes, d) displacements, m.
        points: (k,) points to retract.
        share: (k,) factors of their arms to start from.
        min_gap: (k,) gaps that suffice, m.
        gaps: gap function.

    Returns:
        The new map, and the points without room, whose arms stay.
    """
    new_share, remaining = point_map.share.copy(), np.arange(len(points))
    new_share[points] = share
    for factor in RETRACTION.trials:
        trial = factor * share[remaining]
        gap = gaps(point_map.evaluate_points(u, points[remaining], trial))
        # the gap of a point that does not move may change by round-off
        fits = gap >= min_gap[remaining] - RETRACTION.round_off * abs(min_gap[remaining])
        new_share[points[remaining[fits]]] = trial[fits]
        remaining = remaining[~fits]
        if not len(remaining):
            break
    unchanged = np.array_equal(new_share, point_map.share)
    return point_map if unchanged else point_map.with_arm_share(new_share), points[remaining]


def retract_cut_elements(
    point_map: SurfaceMap, u: Values, elements: Ints, cut: Callable[[Values], Flags]
) -> SurfaceMap:
    """Retract points of elements until no element is cut, or its points are at their nodes.

    Args:
        point_map: map from nodes to points.
        u: (nodes, d) displacements, m.
        elements: (m, d) points of elements.
        cut: function of positions (n, d), m, that returns (m,) flags.
    """
    for factor in RETRACTION.cut_trials:
        points = np.intersect1d(elements[cut(point_map(u))], point_map.copies)
        points = points[point_map.share[points] > 0]
        if not len(points):
            break
        share = point_map.share.copy()
        share[points] *= factor
        point_map = point_map.with_arm_share(share)
    return point_map


def extend_points(point_map: SurfaceMap, u: Values, min_gap: float, gaps: GapFunction) -> SurfaceMap:
    """Extend retracted points by one increment where their gap stays at least `min_gap`, m."""
    retracted = np.flatnonzero(point_map.share < 1)
    if not len(retracted):
        return point_map
    trial, share = np.minimum(point_map.share[retracted] + RETRACTION.extension, 1.0), point_map.share.copy()
    fits = gaps(point_map.evaluate_points(u, retracted, trial)) >= min_gap
    share[retracted[fits]] = trial[fits]
    return point_map.with_arm_share(share)


class ContactSurface:
    """Points of this rank's split surface, and their interpolation from the nodes (HistoryTerm).

    Attributes:
        area: (n,) shares of the points in the reference area, m^2; 0 of excluded points.
        interpolation: map between nodes and points.
    """

    def __init__(self, domain: Domain, width: float) -> None:
        """`width`: of the barrier, m (collective)."""
        self._domain, self._width, self.comm = domain, width, domain.comm
        self._surface = LocalSurface(domain)
        self.interpolation = ParentMatrix(domain, self._surface)
        self.area: Values = self._surface.area
        self._all: ContactFacets | None = None
        # areas and excluded facets for which the active facets were selected, and these
        self._active: tuple[Values, Ints, ContactFacets] | None = None
        self._excluded_facets: Ints = np.empty(0, np.int64)

    @property
    def facets(self) -> ContactFacets:
        """Facets of which neither a corner nor the facet itself is excluded (not collective)."""
        cached = self._active
        if cached is None or cached[0] is not self.area or cached[1] is not self._excluded_facets:
            selected = facets = self._all_facets()
            if len(self._excluded_facets) or (self.area == 0).any():
                active = np.asarray((self.area > 0)[facets.corners].all(axis=1))
                active[self._excluded_facets] = False
                selected = ContactFacets(facets.corners[active], facets.area[active], facets.smoothing)
            cached = self._active = self.area, self._excluded_facets, selected
        return cached[2]

    def _all_facets(self) -> ContactFacets:
        if self._all is None:
            self._all = ContactFacets(*self._surface.facets(), FACETS.smoothing * self._width)
        return self._all

    def facets_from(self, elements: Ints) -> ContactFacets:
        """Facets made of the elements (m, d) of a surface for output."""
        return ContactFacets(elements, np.ones(len(elements)), FACETS.smoothing * self._width)

    def exclude_cut_facets(self, x: Values, facet_gaps: FacetGapFunction) -> None:
        """Exclude facets that are cut with points at x (n, d), m, until there is room."""
        facets = self._all_facets()
        self._excluded_facets = np.flatnonzero(facet_gaps(facets, x) <= 0)

    @property
    def point_map(self) -> SurfaceMap:
        """Map from nodal displacements to positions of points."""
        return self._surface.point_map

    def identity(self, points: Ints) -> Values:
        """(k, 2 d + 1) rows that identify points (k,), whatever breaks."""
        return self._surface.identify_points(points)

    def sum_at_points(self, points: Ints, values: Values) -> Values:
        """(k, m) sums over all ranks of values (k, m) at points (k,) that ranks share (collective)."""
        parts = allgather(self.comm, (self.identity(points), values))
        _, row = np.unique(np.concatenate([identity for identity, _ in parts]), axis=0, return_inverse=True)
        sums = np.zeros((len(row), values.shape[1]))
        np.add.at(sums, row.reshape(-1), np.concatenate([part for _, part in parts]))
        first = sum(len(identity) for identity, _ in parts[: self.comm.rank])
        return np.asarray(sums[row.reshape(-1)[first : first + len(points)]])

    @property
    def rest_positions(self) -> Values:
        """(n, d) reference positions of the points, m."""
        return self._surface.point_map.rest

    @property
    def node_numbers(self) -> Ints:
        """Global numbers of the nodes that the points depend on."""
        return self._surface.columns

    @property
    def mean_edge_length(self) -> float:
        """Mean edge length of the body's mesh, m (collective)."""
        return self._domain.mean_edge_length

    def positions(self, u: Values) -> Values:
        """(n, d) positions of the points for owned displacements u, m (collective)."""
        return np.asarray(self.rest_positions + self.interpolation(u))

    def min_distance(self, distances: Values) -> float:
        """Minimum of distances (n,), m, over this rank's points that are not excluded."""
        return float(distances[self.area > 0].min(initial=np.inf))

    def gaps_are_open(self, distances: Values) -> bool:
        """Whether all gaps (n,) are positive, on all ranks (collective)."""
        return bool(self.comm.allreduce(self.min_distance(distances) > 0, op=MPI.LAND))

    def min_fraction(self, fractions: Values) -> float:
        """Minimum of fractions (n,) of a motion over all ranks, at most 1 (collective)."""
        local = fractions[self.area > 0].min(initial=1.0)
        return float(self.comm.allreduce(float(local), op=MPI.MIN))

    def stiffness(self, groups: Sequence[tuple[Ints, Values]]) -> csr_matrix:
        """W^T B W over `node_numbers`, N/m, as of `nodal_stiffness`."""
        return nodal_stiffness(self._surface.point_map.weights, groups)

    # --- new crack faces ---

    def edges_broke(
        self,
        pattern: npt.NDArray[np.uint8],
        shown: Flags | None,
        u: Values,
        gaps: GapFunction,
        facet_gaps: FacetGapFunction | None = None,
    ) -> None:
        """Add new crack faces, retracted where they would lie in an obstacle (collective).

        Args:
            pattern: (cells,) broken edges of each cell.
            shown: (cells,) flags of cells whose crack faces are part of the surface; None: all.
            u: (owned dofs,) displacements, m.
            gaps: gap function of points.
            facet_gaps: gap function of facets, where obstacles act on them.
        """
        old_map, old_identity = self._surface.point_map, self._surface.identify_points()
        excluded = self._corner_identities(self._excluded_facets)
        gap = np.where(self.area > 0, gaps(self.positions(u)), np.nan)
        copies = old_map.copies
        retracted = RetractedPoints.select(old_identity, old_map.share[copies], gap[copies], self._width)
        self._surface.update_damage(pattern, shown)
        self.interpolation.destroy()
        self.interpolation, self._all, self._active = ParentMatrix(self._domain, self._surface), None, None
        point_map, nodal = self._surface.point_map, self.interpolation.nodal_values(u)
        share, gap = retracted.match(self._surface.identify_points(), self._width)
        self._surface.point_map, without_room = retract_points(point_map, nodal, point_map.copies, share, gap, gaps)
        self._exclude_points(without_room)
        if facet_gaps is not None:
            is_new = np.zeros(len(point_map.share), bool)
            is_new[point_map.copies] = True
            rows = match_points(old_identity, self._surface.identify_points())
            is_new[point_map.copies[rows[rows >= 0]]] = False
            self._excluded_facets = self._match_facets(excluded)
            self._retract_new_facets(is_new, nodal, gaps, facet_gaps)

    def _retract_new_facets(self, is_new: Flags, u: Values, gaps: GapFunction, facet_gaps: FacetGapFunction) -> None:
        """Retract new points (n,) of facets that would be cut or in contact; exclude facets for which this fails."""
        for _ in range(RETRACTION.facet_rounds):
            point_map, facets = self._surface.point_map, self.facets
            has_new = is_new[facets.corners].any(axis=1)
            too_close = facet_gaps(facets, point_map(u)) < np.where(has_new, self._width, TINY)
            points = np.unique(facets.corners[too_close])
            points = points[is_new[points] & (point_map.share[points] > RETRACTION.min_arm)]
            if not len(points):
                break
            share = point_map.share.copy()
            share[points] *= RETRACTION.facet_factor
            self._surface.point_map = point_map.with_arm_share(share)
        closed = np.flatnonzero(is_new & (self.area > 0))
        closed = closed[gaps(self._surface.point_map(u)[closed]) <= 0]
        if len(closed):
            self._exclude_points(np.union1d(closed, np.flatnonzero(self.area == 0)))
        self._exclude_facets(np.flatnonzero(self._facets_too_close(is_new, u, facet_gaps)))

    def _facets_too_close(self, moved: Flags, u: Values, facet_gaps: FacetGapFunction) -> Flags:
        """(m,) facets that are cut, or have a point that has `moved` (n,) and would be in contact."""
        facets = self._all_facets()
        min_gap = np.where(moved[facets.corners].any(axis=1), self._width, TINY)
        return np.asarray(facet_gaps(facets, self._surface.point_map(u)) < min_gap)

    def _exclude_facets(self, facets: Ints) -> None:
        """Exclude these facets as well."""
        if len(np.setdiff1d(facets, self._excluded_facets)):
            self._excluded_facets = np.union1d(facets, self._excluded_facets)

    def release_points(self, u: Values, gaps: GapFunction, facet_gaps: FacetGapFunction | None = None) -> None:
        """Extend retracted points, and include excluded points and facets, as far as there is room (collective)."""
        nodal, old_map, excluded = self.interpolation.nodal_values(u), self._surface.point_map, self.area == 0
        point_map = extend_points(old_map, nodal, self._width, gaps)
        if len(points := np.flatnonzero(excluded)):
            full, min_gap = np.ones(len(points)), np.full(len(points), self._width)
            point_map, points = retract_points(point_map, nodal, points, full, min_gap, gaps)
            self._exclude_points(points)
        self._surface.point_map = point_map
        changed = point_map is not old_map or len(points) or len(self._excluded_facets)
        if facet_gaps is not None and changed:
            self._restore_facets(old_map, excluded, nodal, facet_gaps)

    def _restore_facets(self, old_map: SurfaceMap, excluded: Flags, u: Values, facet_gaps: FacetGapFunction) -> None:
        """Undo extensions that bring a facet into contact; include facets that are not in contact."""
        point_map = self._surface.point_map
        moved = (point_map.share != old_map.share) | excluded
        too_close = self._facets_too_close(moved, u, facet_gaps)
        undone = np.unique(self._all_facets().corners[too_close])
        undone = undone[moved[undone]]
        if len(undone):
            share = point_map.share.copy()
            share[undone] = old_map.share[undone]
            self._surface.point_map = point_map.with_arm_share(share)
        if len(self._excluded_facets):
            gap = facet_gaps(self._all_facets(), self._surface.point_map(u))[self._excluded_facets]
            if (gap >= self._width).any():
                self._excluded_facets = self._excluded_facets[gap < self._width]
        self._exclude_facets(np.flatnonzero(self._facets_too_close(excluded, u, facet_gaps)))

    def _corner_identities(self, facets: Ints) -> Values:
        """(k c, 2 d + 1) rows that identify the corners of facets (k,)."""
        if not len(facets):
            return np.empty((0, 2 * self._domain.dim + 1))
        return self._surface.identify_points(self._all_facets().corners[facets].reshape(-1))

    def _match_facets(self, identity: Values) -> Ints:
        """Facets whose corners have the rows that `_corner_identities` returned."""
        if not len(identity):
            return np.empty(0, np.int64)
        corners = np.sort(self._all_facets().corners, axis=1)
        all_identities = self._surface.identify_points(np.arange(len(self.area)))
        matched = match_points(identity, all_identities).reshape(-1, corners.shape[1])
        matched = np.sort(matched[(matched >= 0).all(axis=1)], axis=1)
        _, group = np.unique(np.concatenate([matched, corners]), axis=0, return_inverse=True)
        return np.flatnonzero(np.isin(group.reshape(-1)[len(matched) :], group.reshape(-1)[: len(matched)]))

    def _exclude_points(self, points: Ints) -> None:
        self.area = self._surface.area.copy()
        self.area[points] = 0.0

    # --- state ---

    def snapshot(self) -> object:
        """Factors of arms, areas, and excluded facets."""
        return self._surface.point_map.share, self.area, self._excluded_facets, self._surface.columns

    def restore(self, memory: object) -> None:
        """Restore a snapshot of this surface (not collective).

        Where edges have broken since, in an earlier pass of the step, the surface is another one and stays as it is.
        """
        share, area, excluded_facets, columns = cast("tuple[Values, Values, Ints, Ints]", memory)
        if len(share) != len(self._surface.point_map.share) or not np.array_equal(columns, self._surface.columns):
            return
        self._excluded_facets = excluded_facets
        if share is not self._surface.point_map.share:
            self._surface.point_map = self._surface.point_map.with_arm_share(share)
        self.area = area

    def to_checkpoint(self) -> dict[str, Values]:
        """Rows of points that are retracted or excluded, and of corners of excluded facets; on rank 0 (collective).

        Of points: identity, factor, whether excluded.
        """
        point_map = self._surface.point_map
        excluded = self.area[point_map.copies] == 0
        selected = np.flatnonzero((point_map.share[point_map.copies] < 1) | excluded)
        identity = self._surface.identify_points()[selected]
        points = point_map.copies[selected]
        rows = np.column_stack([identity, point_map.share[points], self.area[points] == 0])
        gathered = gather(self.comm, (rows, self._corner_identities(self._excluded_facets)))
        if gathered is None:
            return {}
        points, corners = zip(*gathered, strict=True)
        return {"drawn_in": np.concatenate(points), "cut": np.concatenate(corners)}

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Set the state from the rows of a checkpoint."""
        rows, point_map = saved["drawn_in"], self._surface.point_map
        matched = match_points(rows[:, :-2], self._surface.identify_points())
        points, share = point_map.copies[matched[matched >= 0]], np.ones(len(point_map.share))
        share[points] = rows[matched >= 0, -2]
        self._surface.point_map = point_map.with_arm_share(share)
        self._exclude_points(points[rows[matched >= 0, -1] > 0])
        self._excluded_facets = self._match_facets(saved["cut"])

    def clear_caches(self) -> None:
        """Discard facets and their closest points, from which searches start."""
        self._all = self._active = None

    def destroy(self) -> None:
        """Destroy the objects of PETSc."""
        self.interpolation.destroy()


def nodal_stiffness(W: csr_matrix, groups: Sequence[tuple[Ints, Values]]) -> csr_matrix:
    """(m d, m d) W^T B W of blocks B at groups of points.

    Blocks are summed pair of nodes by pair: products of sparse matrices take ten times as long for few groups, and the
    sum of a matrix for each kind of group twice as long.

    Args:
        W: (n, m) weights of m nodes in the positions of n points.
        groups: (k, c) points of each group, and their (k, c d, c d) B; c may differ from kind to kind.
    """
    parts = [_blocks_of_nodes(W, corners, blocks) for corners, blocks in groups]
    first, second, values = (np.concatenate(part) for part in zip(*parts, strict=True))
    m, d = W.shape[1], values.shape[1]
    pair = first.astype(np.int64) * m + second
    order = np.argsort(pair, kind="stable")
    pair = pair[order]
    starts = np.flatnonzero(np.diff(pair, prepend=-1))
    row, column = np.divmod(pair[starts], m)
    data = np.add.reduceat(values[order], starts, axis=0) if len(starts) else values
    return bsr_matrix((data, column, np.searchsorted(row, np.arange(m + 1))), shape=(d * m, d * m)).tocsr()


def _blocks_of_nodes(W: csr_matrix, corners: Ints, blocks: Values) -> tuple[Ints, Ints, Values]:
    """(p,) first and (p,) second nodes, and (p, d, d) w_i w_j B_ij of all pairs of corners i, j of groups.

    As of `nodal_stiffness`.
    """
    (k, c), points = corners.shape, corners.reshape(-1)
    d = blocks.shape[1] // c
    entry, corner = row_entries(W, points)
    node, weight, group = W.indices[entry], W.data[entry], corner // c
    # pairs of entries of a group
    counts = np.bincount(group, minlength=k)
    partners, starts = counts[group], (np.cumsum(counts) - counts)[group]
    first = np.repeat(np.arange(len(entry)), partners)
    second = np.arange(len(first)) + np.repeat(starts - np.cumsum(partners) + partners, partners)
    B = blocks.reshape(k, c, d, c, d)[group[first], corner[first] % c, :, corner[second] % c]
    return node[first], node[second], (weight[first] * weight[second])[:, None, None] * B


def retract_from_obstacles(point_map: SurfaceMap, u: Values, gaps: GapFunction) -> SurfaceMap:
    """Retract points on crack faces that would lie in an obstacle, as those of contact are."""
    inside = point_map.copies[gaps(point_map(u))[point_map.copies] <= 0]
    if not len(inside):
        return point_map
    return retract_points(point_map, u, inside, point_map.share[inside], np.full(len(inside), TINY), gaps)[0]
