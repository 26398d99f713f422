"""Penalty between points and facets, and between edges, of surfaces in explicit steps, with friction; on one rank.

Of a body with itself, of bodies and triangle meshes, and of triangle meshes with one another.

    E(x) = sum over points p of k_p (D - g_p)^2 / 2 + sum over edges of k h (D - g)^2 / 2    where g < D

(penalty_contacts). Points before facets: penalty_point_facet; edges against edges, in 3D: penalty_edges.

Coulomb friction: each contact has a spring that slips (Cundall and Strack 1979),

    f = -k h s,    s += (1 - n n^T) sum_i w_i dx_i in a step, shortened to |s| <= mu (D - g)

Equations: docs/theory.md#explicit-contact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix, vstack

from ..mesh.split_surface.entity_numbering import EntityNumbering
from .ipc_pairs import IpcPairs, vertex_areas
from .ipc_surface import SURFACE, SelfContactLaw, SelfContactSurface, SurfacePairs
from .laws import slipped, tangential
from .mesh_obstacles import AllMeshPairs, MeshObstacle, MeshObstaclePairs, Patches, refuse_overlaps
from .penalty_contacts import ContactStiffness, PenaltyContacts, concatenate_contacts
from .penalty_edges import EdgeContacts, EdgePairHistory
from .penalty_point_facet import NO_FACET, POINT_FACET, PointFacetContacts, PointHistory, penalty_stiffness
from .pose import Pose

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

NO_ROWS: Ints = np.empty(0, np.int64)


@dataclass(frozen=True)
class PenaltyHistory:
    """Contacts at the end of the last step.

    Attributes:
        points: of points before facets.
        edges: of edges against edges; None in 2D.
    """

    points: PointHistory
    edges: EdgePairHistory | None

    @property
    def is_empty(self) -> bool:
        """Whether nothing was near contact."""
        return not (self.points.facets != NO_FACET).any() and (self.edges is None or not len(self.edges.side))

    def to_checkpoint(self) -> dict[str, Values]:
        """Arrays for a checkpoint."""
        arrays = {"by": self.points.facets.astype(float), "held": self.points.stiffness, "slip": self.points.slip}
        return arrays if self.edges is None else arrays | {"edges": self.edges.to_array()}

    @classmethod
    def from_checkpoint(cls, saved: dict[str, Values], suffix: str = "") -> PenaltyHistory:
        """Contacts from the arrays of a checkpoint, of names with a suffix."""
        facets, stiffness = saved[f"by{suffix}"].astype(np.int64), saved[f"held{suffix}"]
        points = PointHistory(facets, stiffness, saved.get(f"slip{suffix}", np.zeros(facets.shape)))
        if facets.shape[1] == 2:
            return cls(points, None)
        edges = saved.get(f"edges{suffix}")
        return cls(points, EdgePairHistory.none() if edges is None else EdgePairHistory.from_array(edges))

    def renumbered(self, number: Ints, max_stiffness: Values) -> PenaltyHistory:
        """Contacts with new numbers (n,) of points, -1: none, no stiffer than `max_stiffness` (new n,), N/m."""
        edges = None if self.edges is None else self.edges.renumbered(number)
        return PenaltyHistory(self.points.renumbered(number, max_stiffness), edges)


class PenaltyPairs(IpcPairs):
    """Penalty between the elements of a surface; x is always (n, d), m.

    Attributes:
        width: D, m.
    """

    def __init__(
        self,
        rest_positions: Values,
        elements: Ints,
        stiffness: ContactStiffness,
        *,
        distance: float,
        patch: npt.NDArray[np.int32] | None = None,
    ) -> None:
        """Pairs of a surface.

        Args:
            rest_positions: (n, d) reference positions, m.
            elements: (m, d) points of segments or triangles.
            stiffness: of points.
            distance: D, m.
            patch: (n,) numbers of parts of the surface that touch others alone; None: all touch.
        """
        super().__init__(rest_positions, elements, distance=distance, stiffness=1.0)
        self.width, is_3d = distance, rest_positions.shape[1] == 3
        if patch is not None:
            self.restrict_to_patches(patch)
        edge = self.mean_edge_length
        self._points = PointFacetContacts(elements, stiffness, distance=distance, edge=edge, patch=patch)
        self._edges = (
            EdgeContacts(rest_positions, elements, stiffness.limit, distance=distance, patch=patch) if is_3d else None
        )
        self._near: tuple[Values, PenaltyContacts, PenaltyContacts] | None = None  # of the last x
        self._touching: PenaltyContacts | None = None  # those of them in contact
        self._ahead: tuple[Values, PenaltyContacts] | None = None  # of the end of the last step
        self._history: PenaltyHistory | None = None

    @property
    def history(self) -> PenaltyHistory:
        """Contacts at the end of the last step; the same object as long as they are the same."""
        if self._history is None:
            self._history = PenaltyHistory(self._points.history, None if self._edges is None else self._edges.history)
        return self._history

    def set_history(self, history: PenaltyHistory) -> None:
        """Set the contacts at the end of the last step."""
        if history is self._history:
            return
        self._points.history, self._history = history.points, None
        if self._edges is not None and history.edges is not None:
            self._edges.set_history(history.edges)
        self._near = self._ahead = None

    def energy(self, x: Values) -> float:
        """Energy E(x), J."""
        return self.contacts(x).energy(self.width)

    def gradient(self, x: Values) -> Values:
        """(n, d) dE/dx, N: minus the forces on the points."""
        return self.contacts(x).gradient(self.width, len(x))

    def min_gap(self, x: Values) -> float:
        """Least gap below D, m; infinite where there is none."""
        return float(self.contacts(x).gap.min(initial=np.inf))

    def contacts(self, x: Values) -> PenaltyContacts:
        """Contacts with points at x; those of the last x are kept."""
        near = self.near_contacts(x)
        if self._touching is None:
            self._touching = near.select(near.gap < self.width)
        return self._touching

    def near_contacts(self, x: Values) -> PenaltyContacts:
        """Contacts that may be closed a step later, with points at x; those of the last x are kept."""
        return concatenate_contacts(self._near_parts(x))

    def contacts_ahead(self, x: Values) -> PenaltyContacts:
        """The same points, weights and stiffness; of the end of a step those that were found before it was stored."""
        if self._ahead is None or not np.array_equal(x, self._ahead[0]):
            return self.near_contacts(x)
        return self._ahead[1]

    def _near_parts(self, x: Values) -> list[PenaltyContacts]:
        if self._near is None or not np.array_equal(x, self._near[0]):
            reach = POINT_FACET.ahead_gap * self.width
            points = self._points.contacts_within(x, reach)
            edges = points.select(NO_ROWS) if self._edges is None else self._edges.contacts_within(x, reach)
            self._near, self._touching = (x.copy(), points, edges), None
        _, points, edges = self._near
        return [points, edges] if len(edges.gap) else [points]

    def end_step(self, x: Values, slips: Values | None = None) -> None:
        """Store contacts at the end of a step, and slips (k, d) of the springs of `contacts`, m."""
        self._ahead, self._history = (x.copy(), self.near_contacts(x)), None
        points, *edges = self._near_parts(x)
        count = int((points.gap < self.width).sum())
        self._points.end_step(points, None if slips is None else slips[:count])
        if self._edges is not None:
            near, slip = edges[0] if edges else points.select(NO_ROWS), None
            if slips is not None:
                slip = np.zeros_like(near.normal)
                slip[near.gap < self.width] = slips[count:]
            self._edges.end_step(x, near, slip)
        self._near = self._touching = None

    def max_added_frequency(self, x: Values, nodes: csr_matrix, mass: Values) -> float:
        """Bound of the increase of the square of a frequency (PenaltyContacts.max_added_frequency), 1/s^2."""
        return self.contacts_ahead(x).max_added_frequency(nodes, mass)

    def clearance(self, x: Values) -> float:
        """Distance by which any two points at x may approach before anything is near, m; 0 if anything is."""
        if self._points.anything_is_near(x):
            return 0.0
        reach = POINT_FACET.clearance_gap * self.width
        distance = self._points.clearance(x, reach)
        if self._edges is not None:
            distance = self._edges.clearance(x, distance)
        return max(0.0, distance - POINT_FACET.ahead_gap * self.width)

    def search_along(self, x: Values, end: Values) -> None:
        """Search candidates for the whole motion from x to `end`."""
        self._points.search_along(x, end)
        if self._edges is not None:
            self._edges.search_along(x, end)

    def clear_caches(self) -> None:
        """Discard the candidates of collision detection."""
        self._points.clear_caches()
        if self._edges is not None:
            self._edges.clear_caches()
        self._near = self._touching = None


@dataclass(frozen=True)
class PairSprings:
    """Springs of friction at the contacts of a penalty.

    Attributes:
        pairs: penalty.
        coefficient: of friction.
        start: (n, d) points at the start of the step, m; None: the step is accepted.
    """

    pairs: PenaltyPairs
    coefficient: float
    start: Values | None

    def gradient(self, x: Values) -> Values:
        """(n, d) minus the forces on the points, N."""
        contacts = self.pairs.contacts(x)
        return contacts.sum_at_points(contacts.spring_stiffness[:, None] * self.slips(x), len(x))

    def energy(self, x: Values) -> float:
        """Energy of the springs, J."""
        return 0.5 * float(self.pairs.contacts(x).spring_stiffness @ np.sum(self.slips(x) ** 2, axis=1))

    def hessian(self, x: Values, *, exact: bool = False) -> csr_matrix:
        """Raise NotImplementedError: explicit steps need no tangent."""
        raise NotImplementedError("explicit steps ask for no tangent")

    def slips(self, x: Values) -> Values:
        """(k, d) stretch of the springs of the contacts at x, m; zero for new contacts."""
        contacts = self.pairs.contacts(x)
        slip = tangential(contacts.normal, contacts.slip + self._relative_motion(x))
        return slipped(slip, self.coefficient * (self.pairs.width - contacts.gap))

    def dissipated(self, x: Values) -> float:
        """Energy dissipated in the step, J: minus the work by the trapezoidal rule, minus the change of energy."""
        contacts, history = self.pairs.contacts(x), self.pairs.history
        start, end = (
            contacts.start_stiffness[:, None] * contacts.slip,
            contacts.spring_stiffness[:, None] * self.slips(x),
        )
        work = -0.5 * float(np.vdot(start + end, self._relative_motion(x)))
        start_energy = 0.5 * float(history.points.stiffness @ np.sum(history.points.slip**2, axis=1))
        if (edges := history.edges) is not None:
            start_energy += 0.5 * float((edges.stiffness * edges.share) @ np.sum(edges.slip**2, axis=1))
        return start_energy - self.energy(x) - work

    def _relative_motion(self, x: Values) -> Values:
        """(k, d) motion at contacts that stay in contact since the start of the step, m."""
        contacts = self.pairs.contacts(x)
        if self.start is None:
            return np.zeros_like(contacts.normal)
        return np.where((contacts.start_stiffness > 0)[:, None], contacts.relative(x - self.start), 0.0)


# --- surface of a body, and its pairs with itself or with obstacles ---


@dataclass(frozen=True)
class BodyMass:
    """Mass of a body, and what contact may add to its frequencies.

    Attributes:
        mass: (nodes,) kg.
        max_added: 1/s^2 (penalty_stiffness).
    """

    mass: Values
    max_added: float


@dataclass(frozen=True)
class PenaltyPart:
    """Contact of the surface of a body with itself, or with one obstacle.

    Its points are (n + m, d): those of the body, then those of the obstacle.

    Attributes:
        contact: penalty.
        friction: coefficient.
        obstacle: pairs with the obstacle; None: the body with itself.
    """

    contact: PenaltyPairs
    friction: float
    obstacle: MeshObstaclePairs[PenaltyPairs] | None = None

    def is_far(self, x: Values) -> bool:
        """Whether the obstacle is out of contact with the body at x (n, d), m."""
        return self.obstacle is not None and self.obstacle.is_far(x)

    def points(self, x: Values, pose: Pose | None = None) -> Values:
        """(n + m, d) points with the body at x (n, d), m, and the obstacle at a pose; None: the current one."""
        if self.obstacle is None:
            return x
        mesh = self.obstacle.mesh
        return np.concatenate([x, mesh.positions if pose is None else mesh.positions_at(pose)])


class PenaltySurface(SelfContactSurface):
    """Surface of a body with penalty contact, on rank 0.

    Before obstacles alone crack faces are not offset from one another.
    """

    pairs: PenaltyPairs | AllMeshPairs[PenaltyPairs]
    closed_pressure: ClassVar[float] = 0.0  # a face that is pressed at all has no room
    search_all_faces: ClassVar[bool] = True  # to read candidates takes longer than to have more of them

    def __init__(
        self,
        skeleton: EntityNumbering,
        pattern: npt.NDArray[np.uint8],
        law: SelfContactLaw,
        u: Values,
        previous: PenaltySurface | None,
        cut: Values | None,
        *,
        body: BodyMass,
        meshes: Sequence[MeshObstacle],
    ) -> None:
        """Build the surface; `body`: its mass; `meshes`: obstacles, none: it touches itself; others as of the base."""
        self._law, self._body, self._meshes, self._previous = law, body, meshes, previous
        self._stiffness: ContactStiffness | None = None
        self.face_gap = 0.0 if meshes else SURFACE.face_gap
        super().__init__(skeleton, pattern, law, u, previous, cut)
        self._previous = None

    @property
    def parts(self) -> list[PenaltyPart]:
        """Contact with itself, or with each obstacle."""
        if isinstance(self.pairs, PenaltyPairs):
            return [PenaltyPart(self.pairs, self._law.friction)]
        return [PenaltyPart(pairs.contact, pairs.mesh.friction, pairs) for pairs in self.pairs.pairs]

    def _check_apart(self) -> None:
        if isinstance(self.pairs, PenaltyPairs):
            super()._check_apart()
        else:
            refuse_overlaps(self.split, self.pairs)

    def _build_pairs(self, elements: Ints) -> SurfacePairs:
        stiffness, distance = self._own_stiffness(), self._law.distance
        pairs: PenaltyPairs | AllMeshPairs[PenaltyPairs]
        if not self._meshes:
            pairs = PenaltyPairs(self._rest_positions, elements, stiffness, distance=distance)
            self._transfer_contacts([pairs])
            return pairs
        pairs = AllMeshPairs([self._pairs_with(mesh, elements, stiffness) for mesh in self._meshes])
        self._transfer_contacts([of_mesh.contact for of_mesh in pairs.pairs])
        return pairs

    def _own_stiffness(self) -> ContactStiffness:
        """Stiffness of the body's points, by all elements and full arms: constant while a surface lasts."""
        if self._stiffness is None:
            pressure, area = self._pressure, vertex_areas(self._rest_positions, self.split.elements)
            # before obstacles twice that of self-contact, where both sides yield
            limit = (2 if self._meshes else 1) * self._body.max_added
            k = penalty_stiffness(self.point_map.weights, area, self._body.mass, pressure, limit)
            reduction: Values = np.ones(len(k))
            if self._meshes:
                reduction = np.divide(k, 0.5 * pressure * area, out=reduction, where=area > 0)
            self._stiffness = ContactStiffness(k, k, reduction)
        return self._stiffness

    @property
    def _pressure(self) -> float:
        return self._law.stiffness / self._law.distance

    def _pairs_with(self, mesh: MeshObstacle, elements: Ints, own: ContactStiffness) -> MeshObstaclePairs[PenaltyPairs]:
        area = vertex_areas(mesh.points, mesh.triangles)
        of_mesh = ContactStiffness(0.5 * self._pressure * area, np.full(len(area), np.inf), np.ones(len(area)))
        stiffness = own.followed_by(of_mesh)

        def make_contact(points: Values, triangles: Ints, patches: Patches) -> PenaltyPairs:
            return PenaltyPairs(points, triangles, stiffness, distance=self._law.distance, patch=patches)

        return MeshObstaclePairs(self._rest_positions, elements, mesh, self._law.distance, make_contact)

    def _transfer_contacts(self, contacts: Sequence[PenaltyPairs]) -> None:
        """Give pairs the contacts of this surface until now, or of the previous one."""
        k = self._own_stiffness().point
        number: Ints = np.arange(len(k))
        if hasattr(self, "pairs"):
            last = self.parts
        elif self._previous is not None:
            last, number = self._previous.parts, self.new_numbers(self._previous, len(k))
        else:
            return
        for old, new in zip(last, contacts, strict=True):
            m = 0 if old.obstacle is None else len(old.obstacle.mesh.points)
            numbers, limit = np.r_[number, len(k) + np.arange(m)], np.r_[k, np.full(m, np.inf)]
            new.set_history(old.contact.history.renumbered(numbers, limit))

    def max_added_frequency(self, x: Values) -> float:
        """Bound of what contact adds to the square of a frequency of the body at x (n, d), m; 1/s^2."""
        weights, total = self.point_map.weights, 0.0
        for part in self.parts:
            if not part.is_far(x):
                points = part.points(x)
                no_nodes = csr_matrix((len(points) - len(x), weights.shape[1]))
                nodes = vstack([weights, no_nodes], format="csr")
                total += part.contact.max_added_frequency(points, nodes, self._body.mass)
        return total

    def reach_of_points(self) -> float:
        """Largest motion of a point where no node moves by more than 1; infinite with retracted faces."""
        share, excluded, _ = self.snapshot()
        if len(excluded) or np.any(share < 1):
            return np.inf
        return float(abs(self.point_map.weights).sum(axis=1).max())
