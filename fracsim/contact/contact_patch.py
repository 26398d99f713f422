"""Contact of a body with itself where few nodes move and all others stay, for nonlinear elimination.

The pairs are those of a part of the surface: of the elements that may come near a point that moves, and of the elements
around them, on which the weights of pairs depend. Points are x = x_0 + W w / f, with the part f of the step that has
passed at the displacement. Points move by no more than the part of the surface serves. Every rank does the same
computation.

Equations: docs/theory.md#newtons-method.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix, kron

from ..mechanics.term_protocols import ContactPatchValues
from .ipc_pairs import IpcPairs
from .pair_search import max_length

if TYPE_CHECKING:
    from .sample_points import IpcFriction
    from .self_contact import SelfContact

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

# Motion of points, in distances of the barrier, that a patch serves. For twice the motion its part of the surface has
# twice the elements.
PATCH_MOTION = 3.0


class SelfContactPatch:
    """Potential of the contact of k nodes that move by w (k, d), m, with all others fixed (ContactPatch).

    Attributes:
        points: (p,) points of the part of the surface.
        pairs: its pairs.
    """

    _friction: IpcFriction | None = None

    def __init__(self, term: SelfContact, nodes: Ints) -> None:
        """Choose the part of the surface around nodes (k,), by their ascending global numbers (collective)."""
        surface, law, x = term.surface.current, term.surface.law, term.end_positions()
        self._level, self._max_motion = term.level, PATCH_MOTION * law.distance
        all_weights = _columns(surface.point_map.weights, term.surface.node_numbers, nodes)
        moves, elements = np.diff(all_weights.indptr) > 0, surface.remaining_elements()
        near, start = term.pairs.points_near(x, moves, self._max_motion), term.start_positions
        if term.friction is not None and start is not None:
            near |= term.pairs.points_near(start, moves, 0.0)
        self.points, numbers = np.unique(elements[near[elements].any(axis=1)], return_inverse=True)
        self._start, self._weights = x[self.points], all_weights[self.points]
        self._dof_weights = kron(self._weights, np.eye(x.shape[1]), format="csr")
        self.pairs = IpcPairs(
            surface.rest_positions[self.points], numbers.reshape(-1, elements.shape[1]), distance=law.distance,
            stiffness=law.stiffness, friction=law.friction, search_margin=self._max_motion,
        )  # fmt: skip
        if term.friction is not None and start is not None:
            start = start[self.points]
            self._friction = self.pairs.lag_friction(start, start, term.sticking_slip)

    def _positions(self, w: Values) -> Values:
        """(p, d) positions of its points, m."""
        return np.asarray(self._start + self._weights @ w / self._level.fraction)

    def evaluate(self, w: Values) -> ContactPatchValues:
        """Potential at w (k, d), m, with its derivatives."""
        x, pairs, friction = self._positions(w), self.pairs, self._friction
        energy, gradient, H = pairs.energy(x), pairs.gradient(x), pairs.hessian(x, exact=True)
        if friction is not None:
            energy, gradient = energy + friction.energy(x), gradient + friction.gradient(x)
            H = H + friction.hessian(x, exact=True)
        factor, fraction = self._level.contact_weights.factor, self._level.fraction
        forces = factor * fraction * np.asarray(self._weights.T @ gradient)
        stiffness = csr_matrix(factor * (self._dof_weights.T @ H @ self._dof_weights))
        return ContactPatchValues(factor * fraction**2 * energy, forces, stiffness)

    def free_fraction(self, w: Values, step: Values) -> float:
        """Fraction in [0, 1] of a step (k, d), m, from w (k, d) without a collision, within the motion of the patch."""
        x, motion = self._positions(w), self._weights @ step / self._level.fraction
        if not (length := max_length(motion)):
            return 1.0
        left = max(self._max_motion - max_length(x - self._start), 0.0)
        allowed = min(1.0, left / length)
        return allowed * self.pairs.free_fraction(x, x + allowed * motion)


def _columns(weights: csr_matrix, numbers: Ints, nodes: Ints) -> csr_matrix:
    """(n, k) columns of `weights` (n, m) of `nodes` (k,), ascending; `numbers`: (m,) nodes of all columns."""
    column = np.minimum(np.searchsorted(nodes, numbers), len(nodes) - 1)
    column[nodes[column] != numbers] = -1
    entries = np.flatnonzero(column[weights.indices] >= 0)
    row = np.searchsorted(weights.indptr, entries, "right") - 1
    rows_and_columns = row, column[weights.indices[entries]]
    return csr_matrix((weights.data[entries], rows_and_columns), shape=(weights.shape[0], len(nodes)))
