"""What obstacles touch: points of this rank's surface, walls of cracks among them, as far as there is room for these.

New walls that would lie in an obstacle are drawn in or left out, and come back as there is room (room).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from scipy.sparse import bsr_matrix, csr_matrix, kron

from ...mesh.domain import Domain
from ...mesh.split.identity import found_again
from ...mesh.split.local import Following, LocalSurface
from ...mesh.split.places import Places
from .room import Known, drawn_in, let_out

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
type Gaps = Callable[[Values], Values]  # (n,) distances of places (n, d) to what is nearest, m

TINY = float(np.finfo(float).tiny)


class Skin:
    """The points, and how they follow the nodes.

    Attributes:
        area: (n,) of the points of this rank's surface, m^2; 0 of those left out.    follow: from nodes to points.
    """

    def __init__(self, domain: Domain, width: float) -> None:
        """`width`: of the barrier, m (collective)."""
        self._domain, self._width, self.comm = domain, width, domain.comm
        self._surface = LocalSurface(domain)
        self.follow = Following(domain, self._surface)
        self.area: Values = self._surface.area

    @property
    def at(self) -> Places:
        """Where the points are."""
        return self._surface.at

    def identity(self, points: Ints) -> Values:
        """(k, 2 d + 1) rows that tell points (k,) from all others, whatever breaks."""
        return self._surface.identity(points)

    @property
    def rest(self) -> Values:
        """(n, d) where the points are in the body at rest, m."""
        return self._surface.at.rest

    @property
    def columns(self) -> Ints:
        """Global numbers of the nodes that the points follow."""
        return self._surface.columns

    @property
    def edge(self) -> float:
        """Of the body's mesh in the mean, m (collective)."""
        return self._domain.mean_edge

    def places(self, u: Values) -> Values:
        """(n, d) x of the points at the owned displacements u, m (collective)."""
        return np.asarray(self.rest + self.follow(u))

    def least(self, distances: Values) -> float:
        """The least of distances (n,), m, of points that are not left out; on this rank."""
        return float(distances[self.area > 0].min(initial=np.inf))

    def are_apart(self, distances: Values) -> bool:
        """Whether no gap (n,) is closed on any rank (collective)."""
        return bool(self.comm.allreduce(self.least(distances) > 0, op=MPI.LAND))

    def safe(self, shares: Values) -> float:
        """The least of shares (n,) of a way, on all ranks; 1 where there is none (collective)."""
        mine = shares[self.area > 0].min(initial=1.0)
        return float(self.comm.allreduce(float(mine), op=MPI.MIN))

    def stiffness(self, points: Ints, blocks: Values) -> csr_matrix:
        """W^T B W over the nodes of `columns` of blocks B (k, d, d) at points (k,), N/m."""
        k, d = blocks.shape[:2]
        W = kron(self._surface.at.weights[points], np.eye(d), format="csr")
        B = bsr_matrix((blocks, np.arange(k), np.arange(k + 1)), shape=(k * d, k * d)).tocsr()
        return (W.T @ B @ W).tocsr()

    # --- walls that come to light ---

    def edges_broke(self, pattern: npt.NDArray[np.uint8], u: Values, gaps: Gaps) -> None:
        """New walls are part of it, drawn in where they would lie in an obstacle (collective)."""
        old = self._surface.at
        gap = np.where(self.area > 0, gaps(self.places(u)), np.nan)
        known = Known.of(self._surface.identity(), old.share[old.copies], gap[old.copies], self._width)
        self._surface.follow_damage(pattern)
        self.follow.destroy()
        self.follow = Following(self._domain, self._surface)
        at, nodal = self._surface.at, self.follow.nodal(u)
        share, gap = known.again(self._surface.identity(), self._width)
        self._surface.at, out = drawn_in(at, nodal, at.copies, share, gap, gaps)
        self._leave_out(out)

    def make_room(self, u: Values, gaps: Gaps) -> None:
        """Points that were drawn in or left out come back as far as there is room (collective)."""
        nodal = self.follow.nodal(u)
        at = let_out(self._surface.at, nodal, self._width, gaps)
        if len(out := np.flatnonzero(self.area == 0)):
            at, out = drawn_in(at, nodal, out, np.ones(len(out)), np.full(len(out), self._width), gaps)
            self._leave_out(out)
        self._surface.at = at

    def _leave_out(self, points: Ints) -> None:
        self.area = self._surface.area.copy()
        self.area[points] = 0.0

    def memory(self) -> object:
        """Shares of arms, and areas."""
        return self._surface.at.share, self.area

    def recall(self, memory: object) -> None:
        """Be again what `memory` gave of this surface (not collective)."""
        share, area = cast("tuple[Values, Values]", memory)
        if share is not self._surface.at.share:
            self._surface.at = self._surface.at.drawn_in(share)
        self.area = area

    def saved(self) -> Values:
        """Rows of copies that are drawn in or left out: identity, share, whether left out; on rank 0 (collective)."""
        at = self._surface.at
        which = np.flatnonzero((at.share[at.copies] < 1) | (self.area[at.copies] == 0))
        rows = self._surface.identity()[which]
        of = at.copies[which]
        known = np.column_stack([rows, at.share[of], self.area[of] == 0])
        gathered = self.comm.gather(known)
        return np.concatenate(gathered) if gathered is not None else known

    def restore(self, rows: Values) -> None:
        """Be again what `saved` gave."""
        at = self._surface.at
        place = found_again(rows[:, :-2], self._surface.identity())
        which, share = at.copies[place[place >= 0]], np.ones(len(at.share))
        share[which] = rows[place >= 0, -2]
        self._surface.at = at.drawn_in(share)
        self._leave_out(which[rows[place >= 0, -1] > 0])

    def destroy(self) -> None:
        """Give the memory of PETSc's objects back."""
        self.follow.destroy()


def clear_of(at: Places, u: Values, gaps: Gaps) -> Places:
    """Places whose copies are drawn in where they would lie in an obstacle, as the points are that touch."""
    inside = at.copies[gaps(at(u))[at.copies] <= 0]
    return drawn_in(at, u, inside, at.share[inside], np.full(len(inside), TINY), gaps)[0] if len(inside) else at
