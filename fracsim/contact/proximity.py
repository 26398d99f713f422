"""Cells of a body, and points and facets of its surface, that may be near an obstacle.

They are searched again only after large motions.

Source: L. Verlet (1967), Computer "experiments" on classical fluids I, Physical Review 159, 98: lists of neighbours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from dolfinx import la

from ..mesh.domain import Domain
from ..mesh.parallel import sum_over_ranks
from ..mesh.simplices import local_edges
from .pose import PosedShape, min_distance

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
Pattern = npt.NDArray[np.uint8]


def bounding_box(x: Values) -> tuple[Values, Values]:
    """(d,) lowest and highest coordinates of points (n, d), m.

    By columns: minima along the first axis take twenty times as long.
    """
    columns = x.T
    return np.array([column.min() for column in columns]), np.array([column.max() for column in columns])


def outline_radius(posed: PosedShape) -> float:
    """Bound of the radius of a shape about its reference point, m; of a half space that of its patch: it never turns.

    The tessellation lies within its shape, by less than a tenth of the radius.
    """
    points, _ = posed.shape.tessellate()
    return 1.1 * float(np.linalg.norm(points, axis=1).max())


@dataclass(frozen=True)
class ProximitySearch:
    """Result of a search, and where it was made.

    Attributes:
        x: (n, d) points then, m.
        posed: obstacle then.
        distance: of what was asked for, m.
        margin: by which what is farther away was found as well, m.
        near: (k,) points or facets found.
        radius: of the shape about its reference point, m.
    """

    x: Values
    posed: PosedShape
    distance: float
    margin: float
    near: Ints
    radius: float

    def is_valid(self, posed: PosedShape, motion: float, distance: float) -> bool:
        """Whether nothing within that distance, m, can be missing; `motion`: largest of the points since then, m.

        A distance changes by no more than the point moves, |t| of the obstacle, and ||R - R_0|| times its radius.
        """
        pose, old_pose = posed.pose, self.posed.pose
        rotation = float(np.linalg.norm(pose.rotation - old_pose.rotation))
        obstacle_motion = float(np.linalg.norm(pose.centre - old_pose.centre)) + (rotation and rotation * self.radius)
        return distance - self.distance + motion + obstacle_motion <= self.margin


class ProximityCandidates:
    """Points, or facets, of a surface that may be near obstacles."""

    def __init__(self, margin: float, corners: Ints | None = None) -> None:
        """Candidates of a surface.

        Args:
            margin: motion, m, after which all are searched again.
            corners: (m, c) points of facets; None: points are searched for.
        """
        self._least_margin, self._corners = margin, corners
        self._searches: dict[int, ProximitySearch] = {}
        self._motion: tuple[Values, ProximitySearch, float] | None = None  # the last that was computed
        self._balls: tuple[Values, Values, Values] | None = None  # points, and centroids and radii of facets

    def __call__(self, posed: PosedShape, x: Values, distance: float) -> Ints:
        """(k,) those nearer than `distance`, m, to an obstacle, with points at x (n, d), m; others too, ascending."""
        last = self._searches.get(id(posed.shape))
        is_known = last is not None and last.posed.shape is posed.shape and last.x.shape == x.shape
        if last is None or not is_known or not last.is_valid(posed, self._max_motion(last, x), distance):
            last = self._searches[id(posed.shape)] = self._search(posed, x, distance)
        return last.near

    def _max_motion(self, last: ProximitySearch, x: Values) -> float:
        """Largest motion of points since a search, m."""
        if self._motion is None or self._motion[0] is not x or self._motion[1] is not last:
            motion = x - last.x
            self._motion = x, last, float(np.sqrt(np.einsum("nd,nd->n", motion, motion).max(initial=0.0)))
        return self._motion[2]

    def _search(self, posed: PosedShape, x: Values, distance: float) -> ProximitySearch:
        margin, bound = max(self._least_margin, distance), posed.distance_bound(x)
        if bound > distance + margin:  # all are far
            return ProximitySearch(x, posed, distance, bound - distance, np.empty(0, np.int64), outline_radius(posed))
        if self._corners is None:
            gap = posed.distance(x)
        else:
            centroid, radius = self._bounding_balls(x)
            margin = max(float(radius.mean()) if len(radius) else 0.0, margin)
            gap = posed.distance(centroid) - radius
        near = np.flatnonzero(gap < distance + margin)
        return ProximitySearch(x, posed, distance, margin, near, outline_radius(posed))

    def _bounding_balls(self, x: Values) -> tuple[Values, Values]:
        """(m, d) centroids of the facets, and (m,) greatest distances of their corners from them, m."""
        if self._balls is None or self._balls[0] is not x:
            assert self._corners is not None
            corners = [x[points] for points in self._corners.T]
            centroid = sum(corners[1:], corners[0]) / len(corners)
            squares = [np.einsum("kd,kd->k", arm, arm) for arm in (corner - centroid for corner in corners)]
            self._balls = x, centroid, np.sqrt(np.maximum.reduce(squares))
        return self._balls[1:]


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
