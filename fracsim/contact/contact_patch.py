"""Contact of a body with itself where few nodes move and all others stay, for nonlinear elimination.

The pairs are those of a part of the surface: of the elements that may come near a point that moves, and of the elements
around them, on which the weights of pairs depend. Points are x = x_0 + W w / f, with the part f of the step that has
passed at the displacement. Points move by no more than the part of the surface serves. Every rank does the same
computation.

Equations: docs/theory.md#newtons-method.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix, kron

from ..mechanics.term_protocols import ContactPatchValues
from ..mesh.parallel import allgather
from .element_exchange import ElementSet, join_element_sets
from .ipc_pairs import IpcPairs
from .pair_search import max_length

if TYPE_CHECKING:
    from .barrier_surface import BarrierSurface
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
        pairs: pairs of the part of the surface.
    """

    _friction: IpcFriction | None = None

    def __init__(self, term: SelfContact, nodes: Ints) -> None:
        """Choose the part of the surface around nodes (k,), by their ascending global numbers (collective)."""
        law, x, surface = term.surface.law, term.end_positions(), term.surface.current
        self._level, self._max_motion = term.level, PATCH_MOTION * law.distance
        moves = np.diff(_columns(surface.point_map.weights, surface.columns, nodes).indptr) > 0
        near, start = term.pairs.points_near(x, moves, self._max_motion), term.start_positions
        if term.friction is not None and start is not None:
            near |= term.pairs.points_near(start, moves, 0.0)
        part, (self._start, start_positions) = _gather_part(surface, near, (x, x if start is None else start))
        columns, point_map = part.point_map()
        self._weights = _columns(point_map.weights, columns, nodes)
        self._dof_weights = kron(self._weights, np.eye(x.shape[1]), format="csr")
        self.pairs = IpcPairs(
            part.points.middle + part.points.out, part.elements.corners, distance=law.distance,
            stiffness=law.stiffness, friction=law.friction, search_margin=self._max_motion,
        )  # fmt: skip
        if term.friction is not None and start is not None:
            self._friction = self.pairs.lag_friction(start_positions, start_positions, term.sticking_slip)

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


def _gather_part(surface: BarrierSurface, near: Flags, fields: tuple[Values, ...]) -> tuple[ElementSet, list[Values]]:
    """Remaining elements of all ranks that have a point near, and the values of fields at their points (collective).

    Args:
        surface: surface of this rank.
        near: (n,) flags of points on this rank.
        fields: (n, d) values at points, each.
    """
    is_near = surface.over_points(near, np.logical_or)
    elements = surface.remaining()
    of_rank = elements[surface.element_set.elements.rank[elements] == surface.comm.rank]
    near_elements = of_rank[is_near[surface.elements[of_rank]].any(axis=1)]
    points = np.unique(surface.elements[near_elements])
    current = replace(surface.element_set.points, share=surface.point_map.share)
    part = replace(surface.element_set, points=current).select(near_elements)
    parts = allgather(surface.comm, (part, [values[points] for values in fields]))
    joined = join_element_sets([element_set for element_set, _ in parts])
    keys, first = np.unique(np.concatenate([element_set.points.keys for element_set, _ in parts]), return_index=True)
    rows = first[np.searchsorted(keys, joined.points.keys)]
    return joined, [np.concatenate(of_field)[rows] for of_field in zip(*(values for _, values in parts), strict=True)]


def _columns(weights: csr_matrix, numbers: Ints, nodes: Ints) -> csr_matrix:
    """(n, k) columns of `weights` (n, m) of `nodes` (k,), ascending; `numbers`: (m,) nodes of all columns."""
    column = np.minimum(np.searchsorted(nodes, numbers), len(nodes) - 1)
    column[nodes[column] != numbers] = -1
    entries = np.flatnonzero(column[weights.indices] >= 0)
    row = np.searchsorted(weights.indptr, entries, "right") - 1
    rows_and_columns = row, column[weights.indices[entries]]
    return csr_matrix((weights.data[entries], rows_and_columns), shape=(weights.shape[0], len(nodes)))
