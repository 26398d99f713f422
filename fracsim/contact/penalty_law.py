"""Law of the penalty in explicit steps: energy, forces, friction, stiffness and history of contacts.

A contact has m = d + 1 points x_i with weights w_i that sum to zero: a point and the corners of a facet, or the ends of
two edges. Its gap is g = n . sum_i w_i x_i with the unit normal n, and its energy

    E = k h (D - g)^2 / 2    for g < D

with the stiffness k and a share h in [0, 1], which is 1 for points and depends on x for edges. As dg/dx_i = w_i n,
forces sum to zero; so do their moments, as E is invariant under rotations.

Coulomb friction: each contact has a spring that slips (Cundall and Strack 1979),

    f = -k h s,    s += (1 - n n^T) relative motion in a step, shortened to |s| <= mu (D - g)

so that a body at rest on a slope stays there.

Equations: docs/theory.md#explicit-contact.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
from scipy.sparse import csr_matrix

from ..array_types import Flags, Ints, Values
from ..mesh.ghost_exchange import KeyLookup
from .laws import slipped, tangential


@dataclass(frozen=True)
class PenaltyPolicy:
    """Tuned numbers of penalties; shares are those of what contact may add to the square of a frequency.

    Attributes:
        near_gap: gap, in widths of the penalty, of what may act a step later, before analytic obstacles and between
            obstacles.
        point_share: of points of surfaces: a node may be in contact with as many points as it carries, and so may they.
        facet_share: of facets before analytic obstacles, beside points.
        pair_share: of a pair of obstacles.
        pair_width: width of the penalty between two obstacles from files in their gap at the start, where that is
            smaller than the width.
        min_weight: weight of a node, in the sum of all of a point, below which it is round-off of arms that cancel.
        extension_motion: motion of nodes, in widths of the penalty, after which crack faces may be extended again.
    """

    near_gap: float = 3.0
    point_share: float = 0.25
    facet_share: float = 0.5
    pair_share: float = 0.2
    pair_width: float = 0.5
    min_weight: float = 1e-6
    extension_motion: float = 0.5


PENALTY = PenaltyPolicy()


@dataclass(frozen=True)
class PenaltyContacts:
    """Contacts within some gap.

    As a history they are those near each other at the end of the last step: their points have keys, which depend
    neither on the ranks nor on edges that break, and the start of the step is that of the next one.

    Attributes:
        points: (k, m) numbers, or keys, of points.
        weights: (k, m) w.
        gap: (k,) m; negative: penetration.
        normal: (k, d) n.
        stiffness: (k,) k, N/m.
        share: (k,) h.
        share_gradient: (k, m, d) dh/dx, 1/m.
        side: (k,) sign of the normal of edges, 1 or -1; 0: of points.
        slip: (k, d) stretch of the springs of friction at the start of the step, m.
        start_stiffness: (k,) k h at the start of the step, N/m; 0 of new contacts.
    """

    points: Ints
    weights: Values
    gap: Values
    normal: Values
    stiffness: Values
    share: Values
    share_gradient: Values
    side: Values
    slip: Values
    start_stiffness: Values

    @classmethod
    def of_points(
        cls, points: Ints, weights: Values, gap: Values, normal: Values, stiffness: Values, slip: Values, start: Values
    ) -> PenaltyContacts:
        """Contacts of points, of which the share is 1; `start`: (k,) `start_stiffness`."""
        gradient = np.zeros((*points.shape, normal.shape[1]))
        share, side = np.ones(len(gap)), np.zeros(len(gap))
        return cls(points, weights, gap, normal, stiffness, share, gradient, side, slip, start)

    @classmethod
    def none(cls, dim: int) -> PenaltyContacts:
        """No contacts."""
        none: Values = np.empty(0)
        points, weights = np.empty((0, 1 + dim), np.int64), np.empty((0, 1 + dim))
        return cls.of_points(points, weights, none, np.empty((0, dim)), none, np.empty((0, dim)), none)

    def to_array(self) -> Values:
        """(k, 3 + d) side, stiffness, start stiffness and slip: what a step takes over from the last one."""
        return np.column_stack([self.side, self.stiffness, self.start_stiffness, self.slip])

    @classmethod
    def from_array(cls, points: Ints, rows: Values) -> PenaltyContacts:
        """Contacts of points (k, 1 + d) with rows of `to_array`; gaps and normals, which count no more, are 0."""
        (side, stiffness, start), slip = rows[:, :3].T, rows[:, 3:]
        contacts = cls.of_points(points, np.zeros(points.shape), 0 * side, 0 * slip, stiffness, slip, start)
        return replace(contacts, side=side)

    def select(self, rows: Flags | Ints) -> PenaltyContacts:
        """Some of the contacts."""
        return PenaltyContacts(*(getattr(self, field.name)[rows] for field in fields(self)))

    @classmethod
    def join(cls, parts: Sequence[PenaltyContacts]) -> PenaltyContacts:
        """Contacts of several kinds, in their order."""
        return cls(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(cls)))

    @property
    def spring_stiffness(self) -> Values:
        """(k,) k h, N/m."""
        return np.asarray(self.stiffness * self.share)

    @property
    def spring_energy(self) -> float:
        """Energy of the springs of friction at the start of the step, J."""
        return 0.5 * float(self.start_stiffness @ np.sum(self.slip**2, axis=1))

    def energy(self, width: float) -> float:
        """Energy with D = `width`, m, J."""
        return 0.5 * float(self.spring_stiffness @ (width - self.gap) ** 2)

    def gradient(self, width: float, count: int) -> Values:
        """(n, d) derivatives of the energy with D = `width`, m, by all points n = `count`, N."""
        closure = width - self.gap
        result = self.sum_at_points(-(self.spring_stiffness * closure)[:, None] * self.normal, count)
        if len(edges := np.flatnonzero(self.side)):
            factor = 0.5 * (self.stiffness * closure**2)[edges]
            np.add.at(result, self.points[edges], factor[:, None, None] * self.share_gradient[edges])
        return result

    def sum_at_points(self, vectors: Values, count: int) -> Values:
        """(n, d) sums of w_i times vectors (k, d) at the points n = `count`."""
        result = np.zeros((count, vectors.shape[1]))
        np.add.at(result, self.points, self.weights[:, :, None] * vectors[:, None])
        return result

    def relative(self, x: Values) -> Values:
        """(k, d) sums of w_i x_i of positions or motions x (n, d), m."""
        return np.asarray(np.einsum("km,kmd->kd", self.weights, x[self.points]))

    def positions(self, x: Values, side: Flags) -> Values:
        """(k, d) position of each contact among the points of one side, flags (n,), at x (n, d), m."""
        weights = abs(self.weights) * side[self.points]
        weights = weights / np.maximum(weights.sum(axis=1), np.finfo(float).tiny)[:, None]
        return np.asarray(np.einsum("km,kmd->kd", weights, x[self.points]))

    def added_load(self, nodes: csr_matrix) -> Values:
        """(nodes,) bound of what these contacts add to M omega^2 of each node if all are closed, N/m.

        Args:
            nodes: (n, nodes) weights with which the first points follow nodes; others do not move.
        """
        k, m = self.points.shape
        rows, columns = np.repeat(np.arange(k), m), self.points.reshape(-1)
        moves = columns < nodes.shape[0]
        entries = self.weights.reshape(-1)[moves], (rows[moves], columns[moves])
        return stiffness_bound(abs(csr_matrix(entries, shape=(k, nodes.shape[0])) @ nodes), self.stiffness)


def stiffness_bound(size: csr_matrix, stiffness: Values) -> Values:
    """(nodes,) bound sum_p |w_pa| k_p sum_b |w_pb| of the rows of K = sum_p k_p w_p w_p^T (Gershgorin), N/m.

    Args:
        size: (n, nodes) |w| with which springs move with nodes, whatever their directions.
        stiffness: (n,) k, N/m.
    """
    return np.asarray(size.T @ (stiffness * np.asarray(size.sum(axis=1)).ravel()))


@dataclass(frozen=True)
class PenaltyForces:
    """Forces of contacts, with springs of friction.

    Attributes:
        contacts: contacts with gaps below D.
        motion: (k, d) relative motion since the start of the step, m; it counts where contact stays since then.
        friction: coefficient of friction.
        width: D, m.
        count: n, number of the points that contacts refer to.
    """

    contacts: PenaltyContacts
    motion: Values
    friction: float
    width: float
    count: int

    @cached_property
    def _motion(self) -> Values:
        return np.where((self.contacts.start_stiffness > 0)[:, None], self.motion, 0.0)

    @cached_property
    def slips(self) -> Values:
        """(k, d) stretch of the springs, m; zero for new contacts."""
        if not self.friction:
            return np.zeros_like(self.contacts.normal)
        stretch = tangential(self.contacts.normal, self.contacts.slip + self._motion)
        return slipped(stretch, self.friction * (self.width - self.contacts.gap))

    @property
    def spring_force(self) -> Values:
        """(k, d) forces of the springs on the side of the contacts whose weights are positive, N."""
        return -self.contacts.spring_stiffness[:, None] * self.slips

    @property
    def spring_energy(self) -> float:
        """Energy of the springs, J."""
        return 0.5 * float(self.contacts.spring_stiffness @ np.sum(self.slips**2, axis=1))

    @property
    def energy(self) -> float:
        """Energy of penalty and springs, J."""
        return self.contacts.energy(self.width) + self.spring_energy

    @cached_property
    def normal_force(self) -> Values:
        """(n, d) forces of the penalty on all points, N."""
        return -self.contacts.gradient(self.width, self.count)

    @cached_property
    def friction_force(self) -> Values:
        """(n, d) forces of the springs on all points, N."""
        return self.contacts.sum_at_points(self.spring_force, self.count)

    @cached_property
    def force(self) -> Values:
        """(n, d) forces on all points, N."""
        return self.normal_force + self.friction_force if self.friction else self.normal_force

    def dissipated(self, start_energy: float) -> float:
        """Energy dissipated in the step, J: minus the work of the springs, minus the change of their energy.

        Work is that by the trapezoidal rule. `start_energy`: of all springs at the start of the step, J.
        """
        force = self.spring_force - self.contacts.start_stiffness[:, None] * self.contacts.slip
        return start_energy - self.spring_energy - 0.5 * float(np.vdot(force, self._motion))


@dataclass(frozen=True)
class ElementRanks:
    """Ranks of the elements that a rank has; a point or an edge belongs to the lowest rank of its elements.

    Attributes:
        rank: (m,).
        this: this rank.
        own_points: (n,) flags of the points of this rank.
    """

    rank: Ints
    this: int
    own_points: Flags

    def own(self, elements: Ints) -> Flags:
        """(k,) whether this rank is the lowest one of elements (k, c)."""
        return np.asarray(self.rank[elements].min(axis=1, initial=np.iinfo(np.int64).max) == self.this)


@dataclass(frozen=True)
class Slips:
    """Stretch of the springs of points or facets in contact with a rigid shape, at the end of the last step.

    Attributes:
        keys: (k,) names of the points, or facets, which stay as edges break.
        slip: (k, d) m.
    """

    keys: Ints
    slip: Values

    @classmethod
    def none(cls, dim: int) -> Slips:
        """No springs."""
        return cls(np.empty(0, np.int64), np.empty((0, dim)))

    def at(self, keys: Ints) -> tuple[Values, Flags]:
        """(m, d) stretch of the springs with `keys` (m,), m, and (m,) flags of those that are in contact."""
        rows = KeyLookup(self.keys)(keys)
        touches = rows >= 0
        slip: Values = np.zeros((len(keys), self.slip.shape[1]))
        slip[touches] = self.slip[rows[touches]]
        return slip, touches


# --- stiffness ---


@dataclass(frozen=True)
class ContactStiffness:
    """Stiffness that points of surfaces may have in a penalty.

    Attributes:
        point: (n,) k_p of points before facets, N/m.
        limit: (n,) what a point carries as a corner of a facet or an end of an edge, N/m; infinite where it is rigid.
        reduction: (n,) factor of k_p of points before facets with this corner: what the mass of the corner leaves.
    """

    point: Values
    limit: Values
    reduction: Values

    @classmethod
    def of_one_body(cls, stiffness: Values) -> ContactStiffness:
        """Stiffness of a surface in contact with itself, of k_p (n,), N/m."""
        return cls(stiffness, stiffness, np.ones(len(stiffness)))

    def followed_by(self, other: ContactStiffness) -> ContactStiffness:
        """Stiffness of these points, then of others."""
        return ContactStiffness(
            np.concatenate([self.point, other.point]),
            np.concatenate([self.limit, other.limit]),
            np.concatenate([self.reduction, other.reduction]),
        )


class NodalMassShare:
    """Share of points in the mass of their nodes, and bounds of frequencies of springs at points.

    Points follow nodes by weights w: springs k_p between points and what is at rest are K = sum_p k_p w_p w_p^T, and
    the square of a frequency is at most the largest row of M^-1 K (`stiffness_bound`).
    """

    def __init__(
        self, weights: csr_matrix, mass: Values, sum_at_nodes: Callable[[Values], Values] = lambda values: values
    ) -> None:
        """Share of points.

        Args:
            weights: (n, nodes) with which points follow nodes.
            mass: (nodes,) kg.
            sum_at_nodes: sums over the ranks of values (nodes,).
        """
        self._size, self._mass, self._sum_at_nodes = abs(weights), mass, sum_at_nodes

    def node_rates(self, stiffness: Values) -> Values:
        """(nodes,) bounds of the rows of M^-1 K of springs k (n,), N/m; 1/s^2 (collective)."""
        summed = self._sum_at_nodes(stiffness_bound(self._size, stiffness))
        return np.asarray(summed / np.maximum(self._mass, np.finfo(float).tiny))

    def point_masses(self, area: Values, local_area: Values | None = None) -> Values:
        """(n,) masses M_p of points with areas (n,), kg (collective).

        Springs k_p = M_p at all points have no frequency above 1: M_p is A_p by the largest of the rates that springs
        k_p = A_p cause at the nodes of the point. `local_area`: (n,) share of this rank in `area`; None: all of it.
        """
        rate, entries = self.node_rates(area if local_area is None else local_area), self._size.tocoo()
        counts = entries.data > PENALTY.min_weight * np.asarray(self._size.sum(axis=1)).ravel()[entries.row]
        max_rate = np.zeros(len(area))
        np.maximum.at(max_rate, entries.row, np.where(counts, rate[entries.col], 0.0))
        return np.where(max_rate > 0, area / np.where(max_rate > 0, max_rate, 1.0), 0.0)


def penalty_stiffness(
    share: NodalMassShare, area: Values, rate: float, max_added: float, local_area: Values | None = None
) -> Values:
    """(n,) stiffness k_p of points, N/m: that of their areas, and at most what their masses leave (collective).

    Args:
        share: of the points in the mass of their nodes.
        area: (n,) m^2.
        rate: stiffness of an area, Pa/m.
        max_added: what all points may add to the square of a frequency, 1/s^2; infinite: no limit.
        local_area: (n,) share of this rank in `area`, m^2; None: all of it.
    """
    stiffness = rate * area
    return stiffness if np.isinf(max_added) else np.minimum(stiffness, max_added * share.point_masses(area, local_area))
