"""Contacts of a penalty between elements of surfaces in 2D and 3D: energy, forces and added stiffness.

A contact has m = d + 1 points x_i with weights w_i that sum to zero: a point and the corners of a facet, or the ends of
two edges. Its gap is g = n . sum_i w_i x_i with the unit normal n, and its energy

    E = k h (D - g)^2 / 2    for g < D

with the stiffness k and a share h in [0, 1], which is 1 for points before facets and depends on x for edges. As dg/dx_i
= w_i n, forces sum to zero; so do their moments, as E is invariant under rotations.

Equations: docs/theory.md#explicit-contact.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

# weight of a node, in the sum of all of a point, below which it is round-off of arms that cancel
MIN_WEIGHT = 1e-6
# number of a corner that is no more
NO_POINT = -1


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
class PenaltyContacts:
    """Contacts within some gap.

    Attributes:
        points: (k, m) numbers of points.
        weights: (k, m) w.
        gap: (k,) m; negative: penetration.
        normal: (k, d) n.
        stiffness: (k,) k, N/m.
        share: (k,) h.
        share_gradient: (k, m, d) dh/dx, 1/m; None: zero.
        slip: (k, d) stretch of the springs of friction at the start of the step, m.
        start_stiffness: (k,) k h at the start of the step, N/m; 0 of new contacts.
    """

    points: Ints
    weights: Values
    gap: Values
    normal: Values
    stiffness: Values
    share: Values
    share_gradient: Values | None
    slip: Values
    start_stiffness: Values

    def select(self, rows: Flags | Ints) -> PenaltyContacts:
        """Some of the contacts."""
        gradient = None if self.share_gradient is None else self.share_gradient[rows]
        return PenaltyContacts(
            self.points[rows], self.weights[rows], self.gap[rows], self.normal[rows], self.stiffness[rows],
            self.share[rows], gradient, self.slip[rows], self.start_stiffness[rows],
        )  # fmt: skip

    @property
    def spring_stiffness(self) -> Values:
        """(k,) k h, N/m."""
        return np.asarray(self.stiffness * self.share)

    def energy(self, width: float) -> float:
        """Energy with D = `width`, m, J."""
        return 0.5 * float(self.spring_stiffness @ (width - self.gap) ** 2)

    def gradient(self, width: float, count: int) -> Values:
        """(n, d) derivatives of the energy with D = `width`, m, by all points n = `count`, N."""
        closure = width - self.gap
        result = self.sum_at_points(-(self.spring_stiffness * closure)[:, None] * self.normal, count)
        if self.share_gradient is not None:
            factor = 0.5 * self.stiffness * closure**2
            np.add.at(result, self.points, factor[:, None, None] * self.share_gradient)
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

        By the rows of the stiffness matrix (Gershgorin).

        Args:
            nodes: (n, nodes) weights with which the first points follow nodes; others do not move.
        """
        k, m = self.points.shape
        rows, columns = np.repeat(np.arange(k), m), self.points.reshape(-1)
        moves = columns < nodes.shape[0]
        entries = self.weights.reshape(-1)[moves], (rows[moves], columns[moves])
        size = abs(csr_matrix(entries, shape=(k, nodes.shape[0])) @ nodes)
        return np.asarray(size.T @ (self.stiffness * np.asarray(size.sum(axis=1)).ravel()))


@dataclass(frozen=True)
class ContactHistory:
    """Contacts of one kind near each other at the end of the last step: points before facets, or edges against edges.

    Attributes:
        points: (k, m) numbers of points, or their keys; -1: a corner that is no more.
        values: (k, 3 + d) side, stiffness, share and slip.
    """

    points: Ints
    values: Values

    @classmethod
    def of(cls, near: PenaltyContacts, width: float, slip: Values | None, side: Values | None = None) -> ContactHistory:
        """Contacts near each other; stiffness and slip are those of contacts with gaps below `width`, m.

        `slip`: (k, d) stretch of springs, m; None: zero. `side`: (k,) sign of the normals, None: 1.
        """
        touches, ones = near.gap < width, np.ones(len(near.gap))
        stiffness = np.where(touches, near.stiffness, 0.0)
        slips = np.zeros_like(near.normal) if slip is None else np.where(touches[:, None], slip, 0.0)
        return cls(near.points, np.column_stack([ones if side is None else side, stiffness, near.share, slips]))

    @classmethod
    def none(cls, count: int, dim: int) -> ContactHistory:
        """No contacts of m = `count` points."""
        return cls(np.empty((0, count), np.int64), np.empty((0, 3 + dim)))

    def select(self, rows: Flags | Ints) -> ContactHistory:
        """Some of the contacts."""
        return ContactHistory(self.points[rows], self.values[rows])

    @property
    def side(self) -> Values:
        """(k,) sign of the normal of edges, 1 or -1."""
        return self.values[:, 0]

    @property
    def stiffness(self) -> Values:
        """(k,) k of those in contact, N/m; 0: without contact."""
        return self.values[:, 1]

    @property
    def share(self) -> Values:
        """(k,) h."""
        return self.values[:, 2]

    @property
    def slip(self) -> Values:
        """(k, d) stretch of the springs of friction, m."""
        return self.values[:, 3:]

    @property
    def spring_energy(self) -> float:
        """Energy of the springs of friction, J."""
        return 0.5 * float((self.stiffness * self.share) @ np.sum(self.slip**2, axis=1))


@dataclass(frozen=True)
class PenaltyHistory:
    """Contacts at the end of the last step.

    Attributes:
        points: of points before facets.
        edges: of edges against edges; none in 2D.
    """

    points: ContactHistory
    edges: ContactHistory

    @property
    def is_empty(self) -> bool:
        """Whether nothing was near contact."""
        return not len(self.points.points) and not len(self.edges.points)

    def select(self, points: Flags | Ints, edges: Flags | Ints) -> PenaltyHistory:
        """Some of the contacts."""
        return PenaltyHistory(self.points.select(points), self.edges.select(edges))

    @classmethod
    def join(cls, parts: Sequence[PenaltyHistory]) -> PenaltyHistory:
        """Contacts of several ranks."""
        return cls(_joined([part.points for part in parts]), _joined([part.edges for part in parts]))

    def by_keys(self, keys: Ints) -> PenaltyHistory:
        """Contacts by the keys (n,) of all points, which do not depend on the ranks."""
        points, edges = self.points.points, self.edges.points
        points = np.where(points >= 0, keys[points], NO_POINT)
        return PenaltyHistory(
            ContactHistory(points, self.points.values), ContactHistory(keys[edges], self.edges.values)
        )

    def by_numbers(self, lookup: Callable[[Ints], Ints], max_stiffness: Values) -> PenaltyHistory:
        """Contacts by keys of the points of a surface, no stiffer than `max_stiffness` (n,), N/m.

        `lookup`: function that returns the point of each key; -1: none. Contacts without their point, or with edges
        that are no more, are left out.
        """
        points, edges = lookup(self.points.points), lookup(self.edges.points)
        have_point, have_edges = points[:, 0] >= 0, (edges >= 0).all(axis=1)
        values = self.points.values[have_point]
        values[:, 1] = np.minimum(values[:, 1], max_stiffness[points[have_point, 0]])
        edge_values = self.edges.values[have_edges]
        return PenaltyHistory(
            ContactHistory(points[have_point], values), ContactHistory(edges[have_edges], edge_values)
        )

    def to_checkpoint(self, suffix: str) -> dict[str, Values]:
        """Arrays of names with a suffix; of points without side and share, which are 1."""
        values = np.delete(self.points.values, [0, 2], axis=1)
        arrays: dict[str, Any] = {"points": self.points.points, "point_values": values,
                  "edges": self.edges.points, "edge_values": self.edges.values}  # fmt: skip
        return {f"{name}{suffix}": array for name, array in arrays.items()}

    @classmethod
    def from_checkpoint(cls, saved: dict[str, Any], suffix: str) -> PenaltyHistory:
        """Contacts from the arrays of a checkpoint."""
        values = np.insert(saved[f"point_values{suffix}"], [0, 1], 1.0, axis=1)
        points = ContactHistory(saved[f"points{suffix}"], values)
        return cls(points, ContactHistory(saved[f"edges{suffix}"], saved[f"edge_values{suffix}"]))


def _joined(parts: Sequence[ContactHistory]) -> ContactHistory:
    """Contacts of one kind of several ranks."""
    points = np.concatenate([part.points for part in parts])
    return ContactHistory(points, np.concatenate([part.values for part in parts]))


class NodalMassShare:
    """Share of points in the mass of their nodes, and bounds of frequencies of springs at points.

    Points follow nodes by weights w: springs k_p between points and what is at rest are K = sum_p k_p w_p w_p^T. The
    rows of M^-1 K bound its eigenvalues (Gershgorin), whatever the directions of the springs:

        omega^2  <=  max over nodes a of  1/m_a  sum_p |w_pa| k_p S_p,    S_p = sum_b |w_pb|
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
        self._sum = np.asarray(self._size.sum(axis=1)).ravel()

    def node_rates(self, stiffness: Values) -> Values:
        """(nodes,) 1/m_a sum_p |w_pa| k_p S_p, 1/s^2, of k (n,), N/m (collective)."""
        summed = self._sum_at_nodes(self._size.T @ (stiffness * self._sum))
        return np.asarray(summed / np.maximum(self._mass, np.finfo(float).tiny))

    def point_masses(self, area: Values, local_area: Values | None = None) -> Values:
        """(n,) masses M_p of points with areas (n,), kg (collective).

        Springs k_p = M_p at all points have no frequency above 1: M_p is A_p by the largest of the rates that springs
        k_p = A_p cause at the nodes of the point. `local_area`: (n,) share of this rank in `area`; None: all of it.
        """
        rate, entries = self.node_rates(area if local_area is None else local_area), self._size.tocoo()
        counts = entries.data > MIN_WEIGHT * self._sum[entries.row]
        max_rate = np.zeros(len(area))
        np.maximum.at(max_rate, entries.row, np.where(counts, rate[entries.col], 0.0))
        return np.where(max_rate > 0, area / np.where(max_rate > 0, max_rate, 1.0), 0.0)


def concatenate_contacts(parts: list[PenaltyContacts]) -> PenaltyContacts:
    """Contacts of several kinds, in their order."""
    if len(parts) == 1:
        return parts[0]
    gradients = [
        np.zeros((*part.points.shape, part.normal.shape[1])) if part.share_gradient is None else part.share_gradient
        for part in parts
    ]
    names = [entry.name for entry in fields(PenaltyContacts)]
    arrays = {
        name: np.concatenate([getattr(part, name) for part in parts]) for name in names if name != "share_gradient"
    }
    return PenaltyContacts(**arrays, share_gradient=np.concatenate(gradients))
