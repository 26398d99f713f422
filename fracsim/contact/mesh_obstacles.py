"""Barrier, friction and collision detection between the surface of a body and solids that are where they are put.

The points of a solid are no unknowns: x (n, 3) are those of the body, and what acts on a solid is minus the sum of what
it does to them. Each solid has pairs of its own with the body: its friction, its force, its gap.

The split surface of a body before solids: walls that come to light inside one are drawn in, or left out (crowd).
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import ipctk
import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from ..errors import InputError
from ..mesh.split_surface.entity_numbering import EntityNumbering
from .ipc_friction import IpcFriction
from .ipc_pairs import KEPT, NONE, IpcPairs
from .ipc_surface import SelfContactLaw, SelfContactSurface
from .pose import Pose
from .triangle_mesh_shape import penetration_depth

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
ASKED = 500  # points that a solid's box is nearest to
TURN = 0.3  # rad of a solid's turn in one piece
LEAST = 1e-4  # of a piece: a way that is none


class MeshObstacle:
    """A solid, somewhere.

    Attributes:
        name: where messages find it.    points: (m, 3) in its own frame, m.    triangles: (k, 3).
        friction: Coulomb's coefficient.    pose: where it is now.    here: (m, 3) its points there, m.
    """

    def __init__(self, name: str, points: Values, triangles: Ints, friction: float) -> None:
        self.name, self.points, self.triangles, self.friction = name, points, triangles, friction
        self._tree, self._box = cKDTree(points), (points.min(axis=0), points.max(axis=0))
        self.move_to(Pose.at_point(np.zeros(3)))

    def move_to(self, pose: Pose) -> None:
        """It is there."""
        self.pose, self.positions = pose, self.positions_at(pose)
        self._around = self.positions.min(axis=0), self.positions.max(axis=0)

    def positions_at(self, pose: Pose) -> Values:
        """(m, 3) its points then, m."""
        return pose.points_to_space(self.points)

    def is_far(self, x: Values, distance: float) -> bool:
        """Whether its box is farther than `distance` from that of points x (n, 3), m."""
        low, high = self._around
        return bool(np.any(x.min(axis=0) - high > distance) or np.any(low - x.max(axis=0) > distance))

    def vertex_distance(self, x: Values) -> float:
        """Distance from points x (n, 3) to its points, m: half an edge more than to its surface, at most."""
        x = self.pose.to_body(x)
        out = np.linalg.norm(np.maximum(np.maximum(self._box[0] - x, x - self._box[1]), 0.0), axis=1)
        first = np.argpartition(out, min(ASKED, len(out)) - 1)[:ASKED]
        least = float(self._tree.query(x[first])[0].min())
        rest = np.flatnonzero(out < least)
        return float(self._tree.query(x[rest])[0].min(initial=least))


class MeshObstaclePairs(IpcPairs):
    """The surface of a body before one solid. Points are (n + m, 3): those of the body, then those of the solid."""

    def __init__(self, rest: Values, elements: Ints, solid: MeshObstacle, *, distance: float, stiffness: float) -> None:
        """`rest` (n, 3) m and `elements` (k, 3) of the body; as for Pairs."""
        self.mesh, self.body_count, self._of_body, self._reach = solid, len(rest), len(elements), distance
        points = np.concatenate([rest, solid.points])  # in its own frame: the measures of its elements stay as they are
        triangles = np.concatenate([elements, solid.triangles + len(rest)])
        super().__init__(points, triangles, distance=distance, stiffness=stiffness, friction=solid.friction)
        side = np.repeat(np.array([0, 1], np.int32), [len(rest), len(solid.points)])
        included = np.unique(triangles)
        self._mesh.can_collide = ipctk.make_vertex_patches_filter(side[included])
        self._body = np.unique(elements)

    @property
    def mean_edge_length(self) -> float:
        """The mean length of sides, m."""
        return float(self._edge)

    def with_mesh(self, x: Values) -> Values:
        """(n + m, 3) the body's points at x (n, 3), and the solid's where it is, m."""
        return np.concatenate([x, self.mesh.positions])

    def is_far(self, x: Values) -> bool:
        """Whether nothing of the body at x (n, 3) can be within the barrier."""
        return not len(self._body) or self.mesh.is_far(x[self._body], self._reach)

    def body_gradient(self, x: Values) -> Values:
        """(n, 3) dE/dx with the body at x (n, 3), N: the force of the solid on it is its negative."""
        return self.full_gradient(x)[: self.body_count]

    def full_gradient(self, x: Values) -> Values:
        """(n + m, 3) the same, and dE/dx of the solid's points, N."""
        both = self.with_mesh(x)
        return np.zeros_like(both) if self.is_far(x) else self.gradient(both)

    def moving_free_fraction(self, x: Values, to: Values, before: Pose) -> float:
        """The share of the straight way of the body from x to `to`, and of the solid from a pose `before` to where it
        is, on which they do not meet.

        The points of one that turns go on arcs, which are walked in chords that end on them.
        """
        end, q = self.mesh.pose, before.increment_to(self.mesh.pose)
        if not q[3:].any():
            return self.free_fraction(self._both(x, before), self._both(to, end))
        pieces, way = 1 + int(np.linalg.norm(q[3:]) / TURN), to - x
        for piece in range(pieces):
            here, share, chord = piece / pieces, 1.0, 0.0
            start = self._both(x + here * way, before.incremented(here * q))
            while chord < 1 and share > LEAST:
                there = here + share / pieces
                chord = self.free_fraction(start, self._both(x + there * way, before.incremented(there * q)))
                share *= 1.0 if chord == 1 else (1 - KEPT) * chord
            if chord < 1:
                return here
            if share < 1:
                return here + share / pieces
        return 1.0

    def _both(self, x: Values, pose: Pose) -> Values:
        return np.concatenate([x, self.mesh.positions_at(pose)])

    def cut_elements(self, x: Values) -> Ints:
        """Elements of the body at x (n, 3) that the solid cuts."""
        if self.is_far(x):
            return np.empty(0, np.int64)
        both = np.sort(self.intersections(self.with_mesh(x)), axis=1)
        return np.unique(both[(both[:, 0] < self._of_body) & (both[:, 1] >= self._of_body), 0])

    def gap(self, x: Values) -> float:
        """The least distance with the body at x (n, 3), m; beyond the barrier as Standing.about has it."""
        if not len(self._body):
            return float("inf")
        least = float("inf") if self.is_far(x) else self.min_gap(self.with_mesh(x))
        return least if least < float("inf") else max(self.mesh.vertex_distance(x[self._body]), self._reach)

    def safe_distances(self, x: Values, most: float) -> Values:
        """(n,) how far each point of the body at x (n, 3) may go by itself, m; infinite from `most` on."""
        on, near = self._mesh.vertices(self.with_mesh(x)), ipctk.Candidates()
        near.build(self._mesh, on, most, ipctk.LBVH())
        safe = near.compute_per_vertex_safe_distances(self._mesh, on, most)
        every = np.asarray(self._mesh.to_full_dof(np.repeat(safe, 3))).reshape(-1, 3)[: self.body_count, 0]
        free = np.ones(self.body_count, bool)
        free[self._body] = every[self._body] >= 0.999 * most
        return np.where(free, np.inf, every)


class AllMeshPairs:
    """The surface of a body before several solids: what Pairs are to a body and itself."""

    def __init__(
        self, rest: Values, elements: Ints, solids: Sequence[MeshObstacle], *, distance: float, stiffness: float
    ):
        """As for Facing."""
        how = {"distance": distance, "stiffness": stiffness}
        self.pairs = [MeshObstaclePairs(rest, elements, solid, **how) for solid in solids]

    def select(self, which: Sequence[int]) -> AllMeshPairs:
        """Before some of the solids."""
        part = copy(self)
        part.pairs = [self.pairs[k] for k in which]
        return part

    def energy(self, x: Values) -> float:
        """E, J."""
        return sum(each.energy(each.with_mesh(x)) for each in self.pairs if not each.is_far(x))

    def gradient(self, x: Values) -> Values:
        """(n, 3) dE/dx, N."""
        return np.sum([each.body_gradient(x) for each in self.pairs], axis=0)

    def hessian(self, x: Values, *, exact: bool = False) -> csr_matrix:
        """(3 n, 3 n) d2E/dx2, N/m; as for Pairs."""
        H, size = csr_matrix((x.size, x.size)), x.size
        for each in self.pairs:
            if not each.is_far(x):
                H = H + each.hessian(each.with_mesh(x), exact=exact)[:size, :size]
        return csr_matrix(H)

    def set_stiffness(self, stiffness: float) -> None:
        """Barriers have this stiffness, Pa, from here on."""
        for each in self.pairs:
            each.set_stiffness(stiffness)

    def clear_caches(self) -> None:
        """Forget which elements were near."""
        for each in self.pairs:
            each.clear_caches()

    def min_gap(self, x: Values) -> float:
        """The least distance within the barrier, m; infinite where there is none."""
        return min((each.min_gap(each.with_mesh(x)) for each in self.pairs if not each.is_far(x)), default=np.inf)

    def free_fraction(self, x: Values, to: Values) -> float:
        """The share in (0, 1] of the straight way of the body from x to `to` on which it meets no solid at rest."""
        return self.moving_free_fraction(x, to, [each.mesh.pose for each in self.pairs])

    def moving_free_fraction(self, x: Values, to: Values, before: Sequence[Pose]) -> float:
        """The same where solids come from poses `before` to where they are."""
        ways = zip(self.pairs, before, strict=True)
        return min((each.moving_free_fraction(x, to, then) for each, then in ways), default=1.0)

    def search_along(self, x: Values, to: Values) -> None:
        """Have candidates for all the way of the body from x to `to`."""
        for each in self.pairs:
            if not each.is_far(x):
                each.search_along(each.with_mesh(x), each.with_mesh(to))

    def pressure(self, x: Values) -> Values:
        """(n,) the sum of the barriers' pressures on each point, Pa."""
        near = [each.pressure(each.with_mesh(x))[: len(x)] for each in self.pairs if not each.is_far(x)]
        return np.sum(near, axis=0) if near else np.zeros(len(x))

    def intersections(self, x: Values) -> Ints:
        """(k, 2) elements of the body that solids cut, twice."""
        cut = np.concatenate([each.cut_elements(x) for each in self.pairs])
        return np.column_stack([cut, cut]) if len(cut) else NONE

    def lag_friction(self, x: Values, slip: float) -> MeshFriction:
        """Friction of a step that begins with the body at x and solids where they are; `slip` as for Pairs."""
        rubs = [each for each in self.pairs if each.mesh.friction and not each.is_far(x)]
        at = [each.with_mesh(x) for each in rubs]
        return MeshFriction(rubs, [each.lag_friction(there, there, slip) for each, there in zip(rubs, at, strict=True)])


@dataclass(frozen=True)
class MeshFriction:
    """Lagged friction with some of several solids; x (n, 3) of the body."""

    pairs: list[MeshObstaclePairs]
    friction: list[IpcFriction]

    def energy(self, x: Values) -> float:
        """J, as of Friction."""
        return sum(part.energy(each.with_mesh(x)) for each, part in zip(self.pairs, self.friction, strict=True))

    def full_gradient(self, which: MeshObstaclePairs, x: Values) -> Values:
        """(n + m, 3) dE/dx by one of the solids, of the body's points and of its own, N."""
        both, part = which.with_mesh(x), self.friction_with(which)
        return np.zeros_like(both) if part is None else part.gradient(both)

    def friction_with(self, which: MeshObstaclePairs) -> IpcFriction | None:
        """That with one of the solids; None: it rubs nothing."""
        return next((part for each, part in zip(self.pairs, self.friction, strict=True) if each is which), None)

    def gradient(self, x: Values) -> Values:
        """(n, 3) dE/dx, N."""
        return np.sum([np.zeros_like(x), *(self.full_gradient(each, x)[: len(x)] for each in self.pairs)], axis=0)

    def hessian(self, x: Values, *, exact: bool = False) -> csr_matrix:
        """(3 n, 3 n) d2E/dx2, N/m."""
        H, size = csr_matrix((x.size, x.size)), x.size
        for each, part in zip(self.pairs, self.friction, strict=True):
            H = H + part.hessian(each.with_mesh(x), exact=exact)[:size, :size]
        return csr_matrix(H)


class MeshContactSurface(SelfContactSurface):
    """The surface, and its pairs with solids where these are. Walls of cracks do not recede from each other: they feel
    solids alone."""

    face_gap = 0.0
    pairs: AllMeshPairs  # type: ignore[assignment]

    def __init__(
        self,
        skeleton: EntityNumbering,
        pattern: npt.NDArray[np.uint8],
        solids: Sequence[MeshObstacle],
        law: SelfContactLaw,
        u: Values,
        before: SelfContactSurface | None,
    ) -> None:
        """As for Surface. InputError where a solid overlaps the body at rest."""
        self._solids = solids
        super().__init__(skeleton, pattern, law, u, before)

    def _check_apart(self) -> None:
        """InputError where a solid cuts the body at rest, or one is in the other."""
        made = self.split
        for each in self.pairs.pairs:
            solid, cut = each.mesh, len(each.cut_elements(made.points)) > 0
            deep = penetration_depth((made.points, made.elements), (solid.positions, solid.triangles), cut=cut)
            if cut or deep is not None:
                how = "cuts" if deep is None else "overlaps"
                by = "" if deep is None else f", by {deep:.4g} m"
                raise InputError(f"{solid.name} {how} the body at the start{by}; move it away or make it smaller")

    def _build_pairs(self, elements: Ints) -> AllMeshPairs:  # type: ignore[override]
        how = {name: self._parameters[name] for name in ("distance", "stiffness")}  # friction is each solid's own
        return AllMeshPairs(self._rest_positions, elements, self._solids, **how)
