"""Contact of a body with analytic obstacles where few nodes move and all others stay, for nonlinear elimination.

A point is x = x_0 + W w / f, with the part f of the step that has passed at the displacement. Obstacles stay. The
potential is that of the points that follow these nodes, and of all corners of facets with such a point: others add a
constant. Each rank evaluates its points, and all have the sums.

Equations: docs/theory.md#newtons-method.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from scipy.sparse import csr_matrix

from ..mechanics.term_protocols import ContactPatchValues
from ..mesh.ghost_exchange import KeyLookup
from ..mesh.parallel import allgather, sum_over_ranks
from .contact_state import evaluate_contact
from .contact_surface import nodal_stiffness
from .facet_contact import ContactFacets
from .obstacle_term import stiffness_blocks
from .step_limit import safe_motion_fractions

if TYPE_CHECKING:
    from .obstacle_term import ObstacleTerm

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


class ObstaclePatch:
    """Potential of the contact of k nodes that move by w (k, d), m, with all others fixed (ContactPatch)."""

    def __init__(self, term: ObstacleTerm, nodes: Ints) -> None:
        """Choose the points that follow nodes (k,), by their ascending global numbers (collective)."""
        term.evaluate_near()
        self._level, self._comm, self._barrier, surface = term.level, term.comm, term.law.barrier, term.surface
        weights = _columns_of(nodes, surface.local.point_map.weights, surface.local.columns)
        moves = np.diff(weights.indptr) > 0
        used, facets = moves.copy(), None
        if term.facets.numbers:
            active = term.facets.active
            chosen = moves[active.corners].any(axis=1)
            corners = active.corners[chosen]
            used[corners] = True
            facets = ContactFacets((np.cumsum(used) - 1)[corners], active.area[chosen], active.smoothing)
        points, self._at_rest = np.flatnonzero(used), np.zeros_like(term.group.increments[0])
        self._start, self._area, self._weights = term.positions[points], surface.area[points], weights[points]
        self._contacts = [
            (posed, term.step_contact(number).select(points), facets if number in term.facets.numbers else None)
            for number, posed in enumerate(term.group.posed)
        ]

    def _positions(self, w: Values) -> Values:
        """(n, d) positions of its points, m."""
        return np.asarray(self._start + self._weights @ w / self._level.fraction)

    def evaluate(self, w: Values) -> ContactPatchValues:
        """Potential at w (k, d), m, with its derivatives (collective)."""
        x, level = self._positions(w), self._level
        contacts = [
            evaluate_contact(x, self._area, posed, self._barrier, start, facets)
            for posed, start, facets in self._contacts
        ]
        forces = np.zeros(x.shape)
        for contact in contacts:
            forces[contact.points] -= contact.normal + contact.friction
        potential = sum_over_ranks(self._comm, np.array([sum(contact.potential for contact in contacts)]))
        gradient = sum_over_ranks(self._comm, self._weights.T @ forces)
        blocks = nodal_stiffness(self._weights, stiffness_blocks(contacts, exact=True))
        stiffness, weight = sum(allgather(self._comm, blocks)), level.contact_weight
        return ContactPatchValues(
            weight * level.fraction * float(potential[0]), weight * gradient, level.contact_weights.factor * stiffness
        )

    def free_fraction(self, w: Values, step: Values) -> float:
        """Fraction in [0, 1] of a step (k, d), m, from w (k, d) that leaves a tenth of every gap (collective)."""
        x, motion, fraction = self._positions(w), np.asarray(self._weights @ step / self._level.fraction), 1.0
        for posed, _, facets in self._contacts:
            fractions = safe_motion_fractions(posed, x, motion, self._at_rest, facets)
            fraction = min(fraction, float(fractions[self._area > 0].min(initial=1.0)))
        return float(self._comm.allreduce(fraction, op=MPI.MIN))


def _columns_of(nodes: Ints, weights: csr_matrix, numbers: Ints) -> csr_matrix:
    """(n, k) columns of nodes (k,) in weights (n, m), whose columns are of nodes with global `numbers` (m,)."""
    rows = KeyLookup(numbers)(nodes)
    present = np.flatnonzero(rows >= 0)
    selection = np.ones(len(present)), (rows[present], present)
    return weights @ csr_matrix(selection, shape=(len(numbers), len(nodes)))
