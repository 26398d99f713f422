"""Penalty between points and facets, and between edges, of surfaces in explicit steps, with friction.

Of a body with itself, of bodies and triangle meshes, and of triangle meshes with one another.

    E(x) = sum over points p of k_p (D - g_p)^2 / 2 + sum over edges of k h (D - g)^2 / 2    where g < D

(penalty_contacts). Points before facets: penalty_point_facet; edges against edges, in 3D: penalty_edges.

Coulomb friction: each contact has a spring that slips (Cundall and Strack 1979),

    f = -k h s,    s += (1 - n n^T) sum_i w_i dx_i in a step, shortened to |s| <= mu (D - g)

Equations: docs/theory.md#explicit-contact.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .laws import slipped, tangential
from .pair_search import PairFilter, intersecting_pairs
from .penalty_contacts import (
    ContactHistory,
    ContactStiffness,
    ElementRanks,
    PenaltyContacts,
    PenaltyHistory,
    concatenate_contacts,
)
from .penalty_edges import EdgeContacts
from .penalty_point_facet import POINT_FACET, PointFacetContacts

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

NO_ROWS: Ints = np.empty(0, np.int64)


class PenaltyPairs:
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
        ranks: ElementRanks | None = None,
        edge: float | None = None,
    ) -> None:
        """Pairs of a surface.

        Args:
            rest_positions: (n, d) reference positions, m.
            elements: (m, d) points of segments or triangles.
            stiffness: of points.
            distance: D, m.
            patch: (n,) numbers of parts of the surface that touch others alone; None: all touch.
            ranks: of the elements; None: all are of this rank.
            edge: mean length of edges, m; None: of these elements.
        """
        self.width, is_3d = distance, rest_positions.shape[1] == 3
        if edge is None:
            sides = rest_positions[elements] - rest_positions[np.roll(elements, 1, axis=1)]
            edge = float(np.linalg.norm(sides, axis=2).mean()) if len(elements) else distance
        self._elements, self._filter = elements, PairFilter.of(len(rest_positions), patch)
        is_owned = None if ranks is None else ranks.own_points
        self._points = PointFacetContacts(
            elements, stiffness, distance=distance, edge=edge, patch=patch, is_owned=is_owned
        )
        self._edges = (
            EdgeContacts(rest_positions, elements, stiffness.limit, distance=distance, patch=patch, ranks=ranks)
            if is_3d
            else None
        )
        self._near: tuple[Values, PenaltyContacts, PenaltyContacts] | None = None  # of the last x
        self._touching: PenaltyContacts | None = None  # those of them in contact
        self._ahead: tuple[Values, PenaltyContacts] | None = None  # of the end of the last step
        self._history: PenaltyHistory | None = None

    @property
    def history(self) -> PenaltyHistory:
        """Contacts at the end of the last step; the same object as long as they are the same."""
        if self._history is None:
            edges = ContactHistory.none(4, 2) if self._edges is None else self._edges.history
            self._history = PenaltyHistory(self._points.history, edges)
        return self._history

    def set_history(self, history: PenaltyHistory) -> None:
        """Set the contacts at the end of the last step; those of other ranks are left out."""
        if history is self._history:
            return
        self._points.set_history(history.points)
        if self._edges is not None:
            self._edges.set_history(history.edges)
        self._history = None
        self._near = self._ahead = None

    def store(self, points: Ints, edges: Ints) -> tuple[Flags, Flags]:
        """(k,) whether contacts of points (k,), -1: none, and (m,) of edges with ends (m, 4) can be of this rank."""
        of_points = points >= 0
        of_points[of_points] = self._points.is_owned[points[of_points]]
        of_edges: Flags = np.asarray((edges >= 0).all(axis=1))
        if self._edges is not None:
            of_edges[of_edges] = self._edges.store(edges[of_edges])
        return of_points, of_edges

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
        all_slips = _of_near(points, self.width, None if slips is None else slips[:count])
        self._points.end_step(points, all_slips)
        if self._edges is not None:
            near = edges[0] if edges else points.select(NO_ROWS)
            self._edges.end_step(x, near, _of_near(near, self.width, None if slips is None else slips[count:]))
        self._near = self._touching = None

    def intersections(self, x: Values) -> Ints:
        """(k, 2) elements that intersect with points at x."""
        return intersecting_pairs(self._elements, self._filter, x)

    def anything_is_near(self, x: Values) -> bool:
        """Whether any point has contact, or may be near a facet, at x."""
        return self._points.anything_is_near(x)

    def clearance(self, x: Values) -> float:
        """Distance by which any two points at x may approach before anything is near, m; nothing is near at x."""
        reach = POINT_FACET.clearance_gap * self.width
        distance = self._points.clearance(x, reach)
        if self._edges is not None:
            distance = self._edges.clearance(x, distance)
        return max(0.0, distance - POINT_FACET.ahead_gap * self.width)

    def clear_caches(self) -> None:
        """Discard the candidates of collision detection."""
        self._points.clear_caches()
        if self._edges is not None:
            self._edges.clear_caches()
        self._near = self._touching = None


def _of_near(near: PenaltyContacts, width: float, slips: Values | None) -> Values | None:
    """(k, d) slips of near contacts, of which those with gaps below `width`, m, have some."""
    if slips is None:
        return None
    result = np.zeros_like(near.normal)
    result[near.gap < width] = slips
    return result


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
        return history.points.spring_energy + history.edges.spring_energy - self.energy(x) - work

    def _relative_motion(self, x: Values) -> Values:
        """(k, d) motion at contacts that stay in contact since the start of the step, m."""
        contacts = self.pairs.contacts(x)
        if self.start is None:
            return np.zeros_like(contacts.normal)
        return np.where((contacts.start_stiffness > 0)[:, None], contacts.relative(x - self.start), 0.0)
