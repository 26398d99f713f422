"""Penalty between points and facets, and between edges, of surfaces in explicit steps, with friction.

Of a body with itself, of bodies and triangle meshes, and of triangle meshes with one another.

    E(x) = sum over points p of k_p (D - g_p)^2 / 2 + sum over edges of k h (D - g)^2 / 2    where g < D

(penalty_contacts). Points before facets: penalty_point_facet; edges against edges, in 3D: penalty_edges.

Coulomb friction: each contact has a spring that slips (Cundall and Strack 1979),

    f = -k h s,    s += (1 - n n^T) sum_i w_i dx_i in a step, shortened to |s| <= mu (D - g)

Equations: docs/theory.md#explicit-contact.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from .laws import slipped, tangential
from .pair_search import PairFilter, intersecting_pairs
from .penalty_contacts import ContactStiffness, ElementRanks, PenaltyContacts, concatenate_contacts
from .penalty_edges import EdgeContacts, EdgePairHistory
from .penalty_point_facet import NO_FACET, POINT_FACET, PointFacetContacts, PointHistory

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

NO_ROWS: Ints = np.empty(0, np.int64)


@dataclass(frozen=True)
class HistoryRows:
    """Contacts at the end of a step by keys of points, which do not depend on the ranks.

    Attributes:
        points, point_values: of points before facets (PointHistory.to_rows).
        edges, edge_values: of edges against edges (EdgePairHistory.to_rows).
    """

    points: Ints
    point_values: Values
    edges: Ints
    edge_values: Values

    def select(self, points: Flags, edges: Flags) -> HistoryRows:
        """Some of the rows."""
        return HistoryRows(self.points[points], self.point_values[points], self.edges[edges], self.edge_values[edges])

    def to_checkpoint(self, suffix: str) -> dict[str, Values]:
        """Arrays of names with a suffix."""
        return {f"{entry.name}{suffix}": getattr(self, entry.name) for entry in fields(self)}

    @classmethod
    def from_checkpoint(cls, saved: dict[str, Values], suffix: str) -> HistoryRows:
        """Contacts from the arrays of a checkpoint."""
        arrays: list[Any] = [saved[f"{entry.name}{suffix}"] for entry in fields(cls)]
        return cls(*arrays)

    @classmethod
    def join(cls, parts: Sequence[HistoryRows]) -> HistoryRows:
        """Rows of several ranks."""
        return cls(*(np.concatenate([getattr(part, entry.name) for part in parts]) for entry in fields(cls)))


@dataclass(frozen=True)
class PenaltyHistory:
    """Contacts at the end of the last step.

    Attributes:
        points: of points before facets.
        edges: of edges against edges; none in 2D.
    """

    points: PointHistory
    edges: EdgePairHistory

    @property
    def is_empty(self) -> bool:
        """Whether nothing was near contact."""
        return not (self.points.facets != NO_FACET).any() and not len(self.edges.side)

    def to_rows(self, keys: Ints) -> HistoryRows:
        """Contacts by the keys (n,) of all points."""
        return HistoryRows(*self.points.to_rows(keys), *self.edges.to_rows(keys))

    @classmethod
    def from_rows(cls, rows: HistoryRows, lookup: Callable[[Ints], Ints], max_stiffness: Values) -> PenaltyHistory:
        """Contacts of the points of a surface, no stiffer than `max_stiffness` (n,), N/m.

        `lookup`: function that returns the point of each key; -1: none. Contacts without their point, or with edges
        that are no more, are left out.
        """
        points, edges = lookup(rows.points), lookup(rows.edges)
        have_point, have_edges = points[:, 0] >= 0, (edges >= 0).all(axis=1)
        points = points[have_point]
        return cls(
            PointHistory.from_rows(points[:, 0], points[:, 1:], rows.point_values[have_point], max_stiffness),
            EdgePairHistory.from_rows(edges[have_edges], rows.edge_values[have_edges]),
        )


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
            edges = EdgePairHistory.none() if self._edges is None else self._edges.history
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
        self._points.end_step(points, None if slips is None else slips[:count])
        if self._edges is not None:
            near, slip = edges[0] if edges else points.select(NO_ROWS), None
            if slips is not None:
                slip = np.zeros_like(near.normal)
                slip[near.gap < self.width] = slips[count:]
            self._edges.end_step(x, near, slip)
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
        points, edges = history.points, history.edges
        start_energy = 0.5 * float(points.stiffness @ np.sum(points.slip**2, axis=1))
        start_energy += 0.5 * float((edges.stiffness * edges.share) @ np.sum(edges.slip**2, axis=1))
        return start_energy - self.energy(x) - work

    def _relative_motion(self, x: Values) -> Values:
        """(k, d) motion at contacts that stay in contact since the start of the step, m."""
        contacts = self.pairs.contacts(x)
        if self.start is None:
            return np.zeros_like(contacts.normal)
        return np.where((contacts.start_stiffness > 0)[:, None], contacts.relative(x - self.start), 0.0)
