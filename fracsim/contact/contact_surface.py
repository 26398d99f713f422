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
from dolfinx import la
from mpi4py import MPI
from scipy.sparse import bsr_matrix, csr_matrix

from ..mesh.domain import Domain
from ..mesh.ghost_exchange import KeyedReduction, KeyLookup, find_saved_keys
from ..mesh.parallel import gather, sum_over_ranks
from ..mesh.simplices import local_edges
from ..mesh.split_surface.drawn_surface import DrawnSurface
from ..mesh.split_surface.local_surface import LocalSurface, ParentMatrix
from ..mesh.split_surface.surface_map import SurfaceMap, row_entries
from .pose import PosedShape, min_distance

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
Pattern = npt.NDArray[np.uint8]


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


@dataclass(frozen=True)
class RetractedPoints:
    """Points on crack faces near an obstacle or retracted, to be matched after edges break.

    Attributes:
        keys: (k,) of the points.
        share: (k,) factors of their arms.
        gap: (k,) m; nan: excluded.
    """

    keys: Ints
    share: Values
    gap: Values

    @classmethod
    def select(cls, keys: Ints, share: Values, gap: Values, width: float) -> RetractedPoints:
        """Those of all points on crack faces that are within `width`, m, of an obstacle or retracted."""
        selected = np.flatnonzero(~(gap >= width) | (share < 1))
        return cls(keys[selected], share[selected], gap[selected])

    def match(self, keys: Ints, width: float) -> tuple[Values, Values]:
        """(n,) factors that points with `keys` begin with, and gaps that they must keep, m: `width` for new points."""
        share, gap, rows = np.ones(len(keys)), np.full(len(keys), width), KeyLookup(keys)(self.keys)
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


def retract_cut_elements(points: SurfaceMap, surface: DrawnSurface, cut: Callable[[Values], Flags]) -> SurfaceMap:
    """Retract drawn points of elements until no element is cut, or its points are at their nodes (collective).

    Args:
        points: drawn points, as a map without nodes.
        surface: the drawn surface.
        cut: function of positions (n, d), m, that returns (m,) flags of the elements.
    """
    has_arm = np.zeros(len(points.share), bool)
    has_arm[points.copies] = True
    for factor in RETRACTION.cut_trials:
        retracted: Flags = np.zeros(len(has_arm), bool)
        retracted[surface.split.elements[cut(points.rest)]] = True
        retracted &= has_arm & (points.share > 0)
        if not surface.shared.has_any(retracted):
            break
        retracted = surface.shared.any_over_ranks(retracted)
        points = points.with_arm_share(np.where(retracted, factor * points.share, points.share))
    return points


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
        local: the surface.
        area: (n,) shares of the points in the reference area, m^2; 0 of excluded points.
        interpolation: map between nodes and points.
    """

    def __init__(self, domain: Domain, width: float) -> None:
        """`width`: of the barrier, m (collective)."""
        self._domain, self._width, self.comm = domain, width, domain.comm
        self.local = LocalSurface(domain)
        self.interpolation = ParentMatrix(domain, self.local)
        self.area: Values = self.local.area

    def sum_at_points(self, points: Ints, values: Values) -> Values:
        """(k, m) sums over all ranks of values (k, m) at points (k,) that ranks share (collective)."""
        return np.asarray(KeyedReduction(self.comm, self.local.keys[points])(values, np.add))

    @property
    def rest_positions(self) -> Values:
        """(n, d) reference positions of the points, m."""
        return self.local.point_map.rest

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
        """W^T B W over the columns of the weights, N/m, as of `nodal_stiffness`."""
        return nodal_stiffness(self.local.point_map.weights, groups)

    # --- new crack faces ---

    def edges_broke(self, pattern: npt.NDArray[np.uint8], shown: Flags | None, u: Values, gaps: GapFunction) -> Ints:
        """Add new crack faces, retracted where they would lie in an obstacle; keys of the old ones (collective).

        Args:
            pattern: (cells,) broken edges of each cell.
            shown: (cells,) flags of cells whose crack faces are part of the surface; None: all.
            u: (owned dofs,) displacements, m.
            gaps: gap function of points.

        Returns:
            (k,) keys of the points of crack faces until now.
        """
        old_map = self.local.point_map
        # nan: excluded points have no gap to keep
        gap = np.where(self.area > 0, gaps(self.positions(u)), np.nan)
        copies = old_map.copies
        old_keys = self.local.keys[copies]
        retracted = RetractedPoints.select(old_keys, old_map.share[copies], gap[copies], self._width)
        self.local.update_damage(pattern, shown)
        self.interpolation.destroy()
        self.interpolation = ParentMatrix(self._domain, self.local)
        point_map, nodal = self.local.point_map, self.interpolation.nodal_values(u)
        # points keep their keys, whatever numbers they have on the new surface
        share, gap = retracted.match(self.local.keys[point_map.copies], self._width)
        self.local.point_map, without_room = retract_points(point_map, nodal, point_map.copies, share, gap, gaps)
        self.exclude_points(without_room)
        return old_keys

    def release_points(self, u: Values, gaps: GapFunction) -> None:
        """Extend retracted points, and include excluded ones, as far as there is room (collective)."""
        nodal, excluded = self.interpolation.nodal_values(u), self.area == 0
        point_map = extend_points(self.local.point_map, nodal, self._width, gaps)
        if len(points := np.flatnonzero(excluded)):
            full, min_gap = np.ones(len(points)), np.full(len(points), self._width)
            point_map, points = retract_points(point_map, nodal, points, full, min_gap, gaps)
            self.exclude_points(points)
        self.local.point_map = point_map

    def set_arms(self, share: Values) -> None:
        """Set the factors (n,) of the arms of all points."""
        self.local.point_map = self.local.point_map.with_arm_share(share)

    def exclude_points(self, points: Ints) -> None:
        """Exclude these points (k,) and no others."""
        self.area = self.local.area.copy()
        self.area[points] = 0.0

    # --- state ---

    def has_points(self, keys: Ints) -> bool:
        """Whether the surface has just the points with `keys` (n,), as it has until edges break."""
        return keys is self.local.keys or np.array_equal(keys, self.local.keys)

    def snapshot(self) -> object:
        """Factors of arms, areas, and keys of the points."""
        return self.local.point_map.share, self.area, self.local.keys

    def restore(self, memory: object) -> None:
        """Restore a snapshot of this surface (not collective).

        Where edges have broken since, in an earlier pass of the step, the surface is another one and stays as it is.
        """
        share, area, keys = cast("tuple[Values, Values, Ints]", memory)
        if share is self.local.point_map.share and area is self.area:
            return
        if not self.has_points(keys):
            return
        if share is not self.local.point_map.share:
            self.set_arms(share)
        self.area = area

    def to_checkpoint(self) -> dict[str, Values]:
        """Keys and factors of retracted points, and keys of excluded ones, on rank 0 (collective)."""
        share, keys = self.local.point_map.share, self.local.keys
        parts = gather(self.comm, (keys[share < 1], share[share < 1], keys[self.area == 0]))
        if parts is None:
            return {}
        names = "retracted", "share", "excluded"
        return {name: np.concatenate(rows) for name, rows in zip(names, zip(*parts, strict=True), strict=True)}

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Set the state from the arrays of a checkpoint (collective).

        Raises ValueError if it has keys of no point, or not as many factors as keys.
        """
        keys, saved_share = self.local.keys, saved["share"]
        retracted, excluded = (find_saved_keys(self.comm, keys, saved[name]) for name in ("retracted", "excluded"))
        if len(saved_share) != len(retracted):
            raise ValueError(f"{len(saved_share)} factors of {len(retracted)} retracted points")
        share = np.ones(len(keys))
        share[retracted[retracted >= 0]] = saved_share[retracted >= 0]
        self.set_arms(share)
        self.exclude_points(excluded[excluded >= 0])

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


def retract_from_obstacles(points: SurfaceMap, gaps: GapFunction) -> SurfaceMap:
    """Retract drawn points on crack faces that would lie in an obstacle, as those of contact are.

    `points`: a map without nodes.
    """
    inside = points.copies[gaps(points.rest)[points.copies] <= 0]
    if not len(inside):
        return points
    no_nodes, min_gap = np.empty((0, points.rest.shape[1])), np.full(len(inside), TINY)
    return retract_points(points, no_nodes, inside, points.share[inside], min_gap, gaps)[0]


# --- cells whose crack faces are part of the surface ---


@dataclass(frozen=True)
class CellReachPolicy:
    """Distances from obstacles, beyond barrier width and motion of a step, in longest edges of a cell.

    Points of crack faces, and all points of their facets, are less than 1.5 edges from a node of their cell.

    Attributes:
        required: distance within which crack faces of a cell have to be part of the surface.
        shown: distance within which they are part of it once it is made.
    """

    required: float = 1.5
    shown: float = 2.5


CELL_REACH = CellReachPolicy()


class ShownCells:
    """Cells whose crack faces are part of a contact surface; all others are too far from obstacles to touch them.

    Attributes:
        flags: (cells,) flags of these cells; None: all cells.
    """

    def __init__(self, domain: Domain, width: float) -> None:
        """Begin with a surface of a whole body; `width`: of the barrier, m."""
        self._domain, self._width = domain, width
        ends = domain.nodes[domain.cell_nodes[:, local_edges(domain.dim)]]
        self._longest_edge: Values = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=2).max(axis=1, initial=0.0)
        self.flags: Flags | None = np.zeros(domain.cell_count, bool)
        self._pattern: Pattern | None = np.zeros(domain.cell_count, np.uint8)  # of the surface; None: to be made again

    def discard(self) -> None:
        """Require a new surface at the next update."""
        self._pattern = None

    def show_all(self) -> None:
        """Select all cells until the next update."""
        self.flags = self._pattern = None

    def update(
        self, pattern: Pattern, obstacles: Sequence[PosedShape], u: Values, motion: Values | None, shift: float
    ) -> bool:
        """Select the cells near obstacles anew if the surface lacks damage there (collective).

        Args:
            pattern: (cells,) broken edges of each cell.
            obstacles: obstacles at their poses.
            u: (owned dofs,) displacement, m.
            motion: (owned dofs,) motion of nodes until the next update, m; None: none.
            shift: largest motion of obstacles until then, m.

        Returns:
            Whether the surface has to be made again.
        """
        distance = min_distance(obstacles, self._domain.nodes + self._at_nodes(u))
        if motion is not None:
            distance = distance - np.linalg.norm(self._at_nodes(motion), axis=1)
        beyond = (self._at_cells(distance) - shift - self._width) / self._longest_edge
        if not sum_over_ranks(self._domain.comm, int(self._is_outdated(pattern, beyond)))[0]:
            return False
        self.flags, self._pattern = beyond < CELL_REACH.shown, pattern.copy()
        return True

    def _is_outdated(self, pattern: Pattern, beyond: Values) -> bool:
        """Whether cells that are shown or, (cells,) edges `beyond` reach, have to be, are not shown as damaged."""
        if self.flags is None or self._pattern is None:
            return True
        required = self.flags | (beyond < CELL_REACH.required)
        return bool((pattern != np.where(self.flags, self._pattern, 0))[required].any())

    def face_distances(self, obstacles: Sequence[PosedShape], u: Values) -> list[float]:
        """Bounds of the distances of crack faces of this rank's cells from each obstacle, m; as of `update`."""
        x, faces = self._domain.nodes + self._at_nodes(u), CELL_REACH.required * self._longest_edge
        return [float((self._at_cells(posed.distance(x)) - faces).min(initial=np.inf)) for posed in obstacles]

    def _at_cells(self, values: Values) -> Values:
        """(cells,) least of the values (nodes,) at the corners."""
        return np.asarray(np.minimum.reduce([values[nodes] for nodes in self._domain.cell_nodes.T]))

    def _at_nodes(self, owned: Values) -> Values:
        """(nodes, d) values of a field at the nodes of this rank, with ghosts, for its owned dofs (collective)."""
        field = la.vector(self._domain.space.dofmap.index_map, self._domain.dim, np.float64)
        field.array[: len(owned)] = owned
        field.scatter_forward()
        return np.asarray(field.array.reshape(-1, self._domain.dim))
