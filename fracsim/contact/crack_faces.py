"""Crack faces before analytic obstacles: cells that show theirs, and points retracted where there is no room.

A crack may open where an obstacle or the body itself leaves no gap. A point of a new face is therefore retracted
towards the nodes that it follows: the factor of its arm from them is the largest at which no barrier acts. A point
that existed before keeps at least its gap, so that contact gains no energy. A point without room even at its nodes is
excluded. In every step points are extended again as far as the barrier allows.

Equations: docs/theory.md#new-crack-faces.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from dolfinx import la

from ..array_types import Flags, Ints, Pattern, Values
from ..mesh.domain import Domain
from ..mesh.ghost_exchange import KeyLookup
from ..mesh.parallel import sum_over_ranks
from ..mesh.simplices import local_edges
from ..mesh.split_surface.drawn_surface import DrawnSurface
from ..mesh.split_surface.surface_map import SurfaceMap
from .pose import PosedShape, min_distance


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
