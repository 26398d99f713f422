"""The surface of a body that touches itself, with room for walls that come to light where it is crowded (rank 0).

The sides of a new crack recede (recede); where that is not enough, in a body that is squeezed or for a crumb that has
lost its deformation gradient, walls are drawn in towards their nodes until no barrier presses harder on them than before
the edge broke: no energy comes from nothing. What is crowded even so is left out. With every step walls go out again,
and those left out come back, where nothing acts on them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_matrix, kron

from ...errors import InputError
from ...mesh.split.build import Split, split
from ...mesh.split.drawn import whole
from ...mesh.split.identity import found_again, identity
from ...mesh.split.skeleton import Skeleton
from ...meshes.words import format_point
from .pairs import Pairs
from .recede import receded

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

GAP = 2.0  # between the sides of a new crack, in distances of the barrier (recede)
IN, ROUNDS = 0.7, 8  # what is left of an arm, and how often it may be shortened: to a twentieth
ROUND_OFF = 1e-6  # of a force


@dataclass(frozen=True)
class Law:
    """Barrier from `distance` m on with `stiffness` Pa; Coulomb's `friction`, sticking below `creep` m/s."""

    distance: float
    stiffness: float
    friction: float
    creep: float


class Surface:
    """The split surface and its pairs for a state of damage.

    Attributes:
        made: the surface.    at: where its points are, new walls drawn back.    pairs: what may touch.
    """

    def __init__(
        self, skeleton: Skeleton, pattern: npt.NDArray[np.uint8], law: Law, u: Values, before: Surface | None
    ) -> None:
        """`u`: (nodes, d) where the body is, m; `before`: the surface until now."""
        self.made = split(skeleton, pattern)
        self._rest = receded(self.made, GAP * law.distance)
        self.at = whole(self.made, skeleton, pattern, self._rest)
        self._how = {"distance": law.distance, "stiffness": law.stiffness, "friction": law.friction}
        copies = np.zeros(len(self._rest), bool)
        copies[self.at.copies] = True
        self._walls = np.flatnonzero(copies[self.made.elements].any(axis=1))
        self._nodes, self._size = len(skeleton.points), float(np.linalg.norm(np.ptp(skeleton.points, axis=0)))
        self.pairs, self._out = self._all_pairs(), np.empty(0, np.int64)
        if before is None:
            _check_apart(self.pairs, self.made)
        else:
            share, load = self._known(before, u)
            self.at.draw_in(share)
            self._leave_out(self._draw_in(u, load))

    def _all_pairs(self) -> Pairs:
        return Pairs(self._rest, self.made.elements, **self._how)

    def _leave_out(self, elements: Ints) -> None:
        """Pairs without these elements (k,)."""
        if len(elements):
            self.pairs = Pairs(self._rest, np.delete(self.made.elements, elements, axis=0), **self._how)
        self._out = elements

    def memory(self) -> tuple[Values, Ints]:
        """Shares of arms, and elements that are left out."""
        return self.at.share, self._out

    def recall(self, memory: tuple[Values, Ints]) -> None:
        """Be again what `memory` gave of this surface."""
        share, out = memory
        if share is not self.at.share:
            self.at.draw_in(share)
        if out is not self._out:
            self.pairs = self._all_pairs()
            self._leave_out(out)

    # --- what is crowded ---

    def _identity(self) -> Values:
        return identity(self.made, self.at.copies, np.arange(self._nodes), self._size)

    def _known(self, before: Surface, u: Values) -> tuple[Values, Values]:
        """(n,) shares and forces, N, that points had before; of new ones 1 and 0."""
        share, load = np.ones(len(self.made.points)), np.zeros(len(self.made.points))
        force = before.pairs.load(before.places(u))
        old = before.at.copies
        which = np.flatnonzero((force[old] > 0) | (before.at.share[old] < 1))
        again = found_again(before._identity()[which], self._identity())
        at = self.at.copies[again[again >= 0]]
        share[at], load[at] = before.at.share[old[which]][again >= 0], force[old[which]][again >= 0]
        return share, load

    def _crowded(self, x: Values, load: Values, pairs: Pairs) -> Ints:
        """Walls that are pressed harder than with `load` (n,) N, at a corner, or cut something."""
        elements = self.made.elements[self._walls]
        flags = (pairs.load(x) > load * (1 + ROUND_OFF))[elements].any(axis=1)
        cut = np.zeros(len(self.made.elements), bool)
        cut[pairs.overlaps(x)] = True
        return self._walls[flags | cut[self._walls]]

    def _draw_in(self, u: Values, load: Values) -> Ints:
        """Draw in crowded walls; those that stay so."""
        for _ in range(ROUNDS):
            crowded = self._crowded(self.places(u), load, self.pairs)
            if not len(crowded):
                break
            share = self.at.share.copy()
            share[np.unique(self.made.elements[crowded])] *= IN
            self.at.draw_in(share)
        return self._crowded(self.places(u), load, self.pairs) if len(crowded) else crowded

    def make_room(self, u: Values) -> None:
        """A step begins at u (nodes, d), m: what was drawn in or left out comes back where there is room."""
        load = self.pairs.load(self.places(u))
        if (self.at.share < 1).any():
            self._let_out(u, load)
        if len(self._out):
            crowded = self._crowded(self.places(u), load, self._all_pairs())
            if len(still := np.intersect1d(self._out, crowded)) < len(self._out):
                self._leave_out(still)

    def _let_out(self, u: Values, load: Values) -> None:
        before = self.at.share
        self.at.draw_in(np.minimum(before / IN, 1.0))
        for _ in range(2):  # what stays in may be in the way of its neighbours
            crowded = self._crowded(self.places(u), load, self.pairs)
            if not len(crowded):
                return
            share = self.at.share.copy()
            tight = np.unique(self.made.elements[crowded])
            share[tight] = before[tight]
            self.at.draw_in(share)
        if len(self._crowded(self.places(u), load, self.pairs)):
            self.at.draw_in(before)

    # --- from nodes to points and back ---

    def places(self, u: Values) -> Values:
        """(n, d) x of nodal displacements (nodes, d), m."""
        return np.asarray(self.at.rest + self.at.weights @ u)

    def handed_down(self, forces: Values) -> Values:
        """(nodes, d) of forces (n, d) at the points, N."""
        return np.asarray(self.at.weights.T @ forces)

    def stiffness(self, H: csr_matrix) -> csr_matrix:
        """(nodes d, nodes d) of (n d, n d), N/m."""
        W = kron(self.at.weights, np.eye(self.at.rest.shape[1]), format="csr")
        return (W.T @ H @ W).tocsr()


def _check_apart(pairs: Pairs, made: Split) -> None:
    """InputError where a body at rest cuts or touches itself."""
    if len(found := pairs.overlaps(made.points)):
        where = format_point(made.points[made.elements[found[0]]].mean(axis=(0, 1)))
        raise InputError(
            f"[contact]: {len(found)} pairs of surface elements cut or touch each other at the start, the first near "
            f"{where}; move the bodies apart"
        )
