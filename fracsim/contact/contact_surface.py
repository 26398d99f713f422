"""What obstacles touch: points of this rank's surface, walls of cracks among them, as far as there is room for these.

New walls that would lie in an obstacle are drawn in or left out, and come back as there is room.

Room for walls that come to light where there is none: their points are drawn in towards their nodes.

Gaps inside a body are closed before anything is there that could touch: it bends around an obstacle, is squeezed, or a
crumb whose cells are all split loses its deformation gradient. A new point takes the largest share of its arm that
brings no barrier to act, one that was there before the largest at which it is no nearer than it was: no energy comes
from nothing. Where there is no room even at the node, the point is left out. With every step points go out again as
far as the barrier lets them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from scipy.sparse import bsr_matrix, csr_matrix, kron

from ..mesh.domain import Domain
from ..mesh.parallel import gather
from ..mesh.split_surface.local_surface import LocalSurface, ParentMatrix
from ..mesh.split_surface.point_matching import match_points
from ..mesh.split_surface.surface_map import SurfaceMap
from .facet_contact import SOFTEN, ContactFacets

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
SHARES = np.linspace(1.0, 0.0, 11)  # of the share that a point had
NEARER = (0.8,) * 12 + (0.0,)  # what an element that is cut leaves of its points' shares, each time
OUT = 0.2  # of the arm, that a step gives back
TINY = float(np.finfo(float).tiny)
ROUNDS, IN, LEAST = 10, 0.7, 0.05  # in which facets are drawn in: what is left of an arm each time, and in all


@dataclass(frozen=True)
class RetractedPoints:
    """Copies that are worth knowing again: rows of `identity`, their shares (k,), and gaps (k,) in m; nan: left out."""

    identity: Values
    share: Values
    gap: Values

    @classmethod
    def select(cls, rows: Values, share: Values, gap: Values, width: float) -> RetractedPoints:
        """Of all copies those that are within `width` m, or drawn in."""
        which = np.flatnonzero(~(gap >= width) | (share < 1))
        return cls(rows[which], share[which], gap[which])

    def match(self, rows: Values, width: float) -> tuple[Values, Values]:
        """(n,) shares that the copies `rows` begin with, and gaps that they must keep: all of `width`, if new."""
        share, gap = np.ones(len(rows)), np.full(len(rows), width)
        at = match_points(self.identity, rows)
        share[at[at >= 0]], gap[at[at >= 0]] = self.share[at >= 0], self.gap[at >= 0]
        return share, np.where(np.isnan(gap), width, np.minimum(gap, width))


def retract_points(
    at: SurfaceMap, u: Values, which: Ints, share: Values, wanted: Values, gaps: Callable[[Values], Values]
) -> tuple[SurfaceMap, Ints]:
    """Points `which` (k,) drawn in from `share` (k,) until gaps(x) reach `wanted` (k,), m; and those that have no room,
    whose shares stay. `u`: (nodes, d) displacements, m."""
    found, left = at.share.copy(), np.arange(len(which))
    found[which] = share
    for part in SHARES:
        trial = part * share[left]
        # of what does not move: round-off
        fits = gaps(at.evaluate_points(u, which[left], trial)) >= wanted[left] - 1e-9 * abs(wanted[left])
        found[which[left[fits]]] = trial[fits]
        left = left[~fits]
        if not len(left):
            break
    return at if np.array_equal(found, at.share) else at.with_arm_share(found), which[left]


def retract_cut_elements(at: SurfaceMap, u: Values, elements: Ints, cut: Callable[[Values], Flags]) -> SurfaceMap:
    """Copies of elements (m, d) that are `cut` drawn in until none is, or they are at their nodes. `cut`: of points at
    x (n, d), m, (m,) flags. `u`: (nodes, d) displacements, m."""
    for part in NEARER:
        tight = np.intersect1d(elements[cut(at(u))], at.copies)
        tight = tight[at.share[tight] > 0]
        if not len(tight):
            break
        share = at.share.copy()
        share[tight] *= part
        at = at.with_arm_share(share)
    return at


def extend_points(at: SurfaceMap, u: Values, wanted: float, gaps: Callable[[Values], Values]) -> SurfaceMap:
    """Points that were drawn in go out by OUT where gaps stay `wanted`, m."""
    inside = np.flatnonzero(at.share < 1)
    if not len(inside):
        return at
    trial, share = np.minimum(at.share[inside] + OUT, 1.0), at.share.copy()
    fits = gaps(at.evaluate_points(u, inside, trial)) >= wanted
    share[inside[fits]] = trial[fits]
    return at.with_arm_share(share)


type GapFunction = Callable[[Values], Values]  # (n,) distances of places (n, d) to what is nearest, m


type FacetGapFunction = Callable[[ContactFacets, Values], Values]  # (m,) gaps of facets with points at places (n, d), m


class ContactSurface:
    """The points, and how they follow the nodes.

    Attributes:
        area: (n,) of the points of this rank's surface, m^2; 0 of those left out.    follow: from nodes to points.
    """

    def __init__(self, domain: Domain, width: float) -> None:
        """`width`: of the barrier, m (collective)."""
        self._domain, self._width, self.comm = domain, width, domain.comm
        self._surface = LocalSurface(domain)
        self.interpolation = ParentMatrix(domain, self._surface)
        self.area: Values = self._surface.area
        self._all: ContactFacets | None = None
        self._active: tuple[Values, Ints, ContactFacets] | None = None  # of which areas, and facets left out
        self._excluded_facets: Ints = np.empty(0, np.int64)

    @property
    def facets(self) -> ContactFacets:
        """Those whose corners are not left out, nor they themselves (not collective)."""
        if self._active is None or self._active[0] is not self.area or self._active[1] is not self._excluded_facets:
            every = self._all_facets()
            acts = np.ones(len(every.area), bool)
            acts[self._excluded_facets] = False
            acts &= (self.area[every.corners] > 0).all(axis=1)
            self._active = (
                self.area,
                self._excluded_facets,
                ContactFacets(every.corners[acts], every.area[acts], every.smoothing),
            )
        return self._active[2]

    def _all_facets(self) -> ContactFacets:
        if self._all is None:
            self._all = ContactFacets(*self._surface.facets(), SOFTEN * self._width)
        return self._all

    def facets_from(self, elements: Ints) -> ContactFacets:
        """Elements (m, d) of a surface that is drawn, as facets that feel obstacles."""
        return ContactFacets(elements, np.ones(len(elements)), SOFTEN * self._width)

    def exclude_cut_facets(self, x: Values, cuts: FacetGapFunction) -> None:
        """Facets that are cut with points at x (n, d) are left out until there is room."""
        every = self._all_facets()
        self._excluded_facets = np.flatnonzero(cuts(every, x) <= 0)

    @property
    def point_map(self) -> SurfaceMap:
        """Where the points are."""
        return self._surface.at

    def identity(self, points: Ints) -> Values:
        """(k, 2 d + 1) rows that tell points (k,) from all others, whatever breaks."""
        return self._surface.identity(points)

    @property
    def rest_positions(self) -> Values:
        """(n, d) where the points are in the body at rest, m."""
        return self._surface.at.rest

    @property
    def node_numbers(self) -> Ints:
        """Global numbers of the nodes that the points follow."""
        return self._surface.columns

    @property
    def mean_edge_length(self) -> float:
        """Of the body's mesh in the mean, m (collective)."""
        return self._domain.mean_edge_length

    def positions(self, u: Values) -> Values:
        """(n, d) x of the points at the owned displacements u, m (collective)."""
        return np.asarray(self.rest_positions + self.interpolation(u))

    def min_distance(self, distances: Values) -> float:
        """The least of distances (n,), m, of points that are not left out; on this rank."""
        return float(distances[self.area > 0].min(initial=np.inf))

    def gaps_are_open(self, distances: Values) -> bool:
        """Whether no gap (n,) is closed on any rank (collective)."""
        return bool(self.comm.allreduce(self.min_distance(distances) > 0, op=MPI.LAND))

    def min_fraction(self, shares: Values) -> float:
        """The least of shares (n,) of a way, on all ranks; 1 where there is none (collective)."""
        mine = shares[self.area > 0].min(initial=1.0)
        return float(self.comm.allreduce(float(mine), op=MPI.MIN))

    def point_stiffness(self, points: Ints, blocks: Values) -> csr_matrix:
        """W^T B W over the nodes of `columns` of blocks B (k, d, d) at points (k,), N/m."""
        k, d = blocks.shape[:2]
        W = kron(self._surface.at.weights[points], np.eye(d), format="csr")
        B = bsr_matrix((blocks, np.arange(k), np.arange(k + 1)), shape=(k * d, k * d)).tocsr()
        return (W.T @ B @ W).tocsr()

    def facet_stiffness(self, corners: Ints, blocks: Values) -> csr_matrix:
        """The same of blocks (k, c d, c d) between points (k, c)."""
        d = blocks.shape[1] // corners.shape[1]
        points, place = np.unique(corners, return_inverse=True)
        dofs = (d * place.reshape(corners.shape)[:, :, None] + np.arange(d)).reshape(len(corners), -1)
        rows, columns = np.repeat(dofs, dofs.shape[1], axis=1), np.tile(dofs, dofs.shape[1])
        size = d * len(points)
        B = csr_matrix((blocks.reshape(-1), (rows.reshape(-1), columns.reshape(-1))), shape=(size, size))
        W = kron(self._surface.at.weights[points], np.eye(d), format="csr")
        return (W.T @ B @ W).tocsr()

    # --- walls that come to light ---

    def edges_broke(
        self, pattern: npt.NDArray[np.uint8], u: Values, gaps: GapFunction, cuts: FacetGapFunction | None = None
    ) -> None:
        """New walls are part of it, drawn in where they would lie in an obstacle; `cuts`: gaps of facets, where these
        are felt (collective)."""
        old, rows, cut = self._surface.at, self._surface.identity(), self._corner_identities(self._excluded_facets)
        gap = np.where(self.area > 0, gaps(self.positions(u)), np.nan)
        known = RetractedPoints.select(rows, old.share[old.copies], gap[old.copies], self._width)
        self._surface.update_damage(pattern)
        self.interpolation.destroy()
        self.interpolation, self._all, self._active = ParentMatrix(self._domain, self._surface), None, None
        at, nodal = self._surface.at, self.interpolation.nodal(u)
        share, gap = known.match(self._surface.identity(), self._width)
        self._surface.at, out = retract_points(at, nodal, at.copies, share, gap, gaps)
        self._exclude_points(out)
        if cuts is not None:
            new = np.zeros(len(at.share), bool)
            new[at.copies] = True
            again = match_points(rows, self._surface.identity())
            new[at.copies[again[again >= 0]]] = False
            self._excluded_facets = self._match_facets(cut)
            self._retract_new_facets(new, nodal, gaps, cuts)

    def _retract_new_facets(
        self, new: npt.NDArray[np.bool_], u: Values, gaps: GapFunction, cuts: FacetGapFunction
    ) -> None:
        """Draw in new points (n,) of facets that would be cut, or feel anything; leave out those of no use."""
        for _ in range(ROUNDS):
            at, facets = self._surface.at, self.facets
            of_new = new[facets.corners].any(axis=1)
            close = cuts(facets, at(u)) < np.where(of_new, self._width, TINY)
            tight = np.unique(facets.corners[close])
            tight = tight[new[tight] & (at.share[tight] > LEAST)]
            if not len(tight):
                break
            share = at.share.copy()
            share[tight] *= IN
            self._surface.at = at.with_arm_share(share)
        lost = np.flatnonzero(new & (self.area > 0))
        lost = lost[gaps(self._surface.at(u)[lost]) <= 0]
        if len(lost):
            self._exclude_points(np.union1d(lost, np.flatnonzero(self.area == 0)))
        self._exclude_facets(np.flatnonzero(self._facets_too_close(new, u, cuts)))

    def _facets_too_close(
        self, moved: npt.NDArray[np.bool_], u: Values, cuts: FacetGapFunction
    ) -> npt.NDArray[np.bool_]:
        """(m,) facets of all that are cut, or have a point that has `moved` (n,) and would feel anything."""
        every = self._all_facets()
        wanted = np.where(moved[every.corners].any(axis=1), self._width, TINY)
        return np.asarray(cuts(every, self._surface.at(u)) < wanted)

    def _exclude_facets(self, facets: Ints) -> None:
        """Leave out these as well."""
        if len(np.setdiff1d(facets, self._excluded_facets)):
            self._excluded_facets = np.union1d(facets, self._excluded_facets)

    def release_points(self, u: Values, gaps: GapFunction, cuts: FacetGapFunction | None = None) -> None:
        """Points and facets that were drawn in or left out come back as far as there is room (collective)."""
        nodal, before, none = self.interpolation.nodal(u), self._surface.at, self.area == 0
        at = extend_points(before, nodal, self._width, gaps)
        if len(out := np.flatnonzero(none)):
            at, out = retract_points(at, nodal, out, np.ones(len(out)), np.full(len(out), self._width), gaps)
            self._exclude_points(out)
        self._surface.at = at
        if cuts is not None and (at is not before or len(out) or len(self._excluded_facets)):
            self._restore_facets(before, none, nodal, cuts)

    def _restore_facets(self, before: SurfaceMap, none: Flags, u: Values, cuts: FacetGapFunction) -> None:
        """Points that went out go back where a facet would feel it; facets come back that feel nothing."""
        at = self._surface.at
        moved = (at.share != before.share) | none
        close = self._facets_too_close(moved, u, cuts)
        back = np.unique(self._all_facets().corners[close])
        back = back[moved[back]]
        if len(back):
            share = at.share.copy()
            share[back] = before.share[back]
            self._surface.at = at.with_arm_share(share)
        if len(self._excluded_facets):
            gap = cuts(self._all_facets(), self._surface.at(u))[self._excluded_facets]
            if (gap >= self._width).any():
                self._excluded_facets = self._excluded_facets[gap < self._width]
        self._exclude_facets(np.flatnonzero(self._facets_too_close(none, u, cuts)))

    def _corner_identities(self, facets: Ints) -> Values:
        """(k c, 2 d + 1) rows that tell the corners of facets (k,) from all other points."""
        if not len(facets):
            return np.empty((0, 2 * self._domain.dim + 1))
        return self._surface.identity(self._all_facets().corners[facets].reshape(-1))

    def _match_facets(self, rows: Values) -> Ints:
        """The facets of which `_named` gave these rows."""
        if not len(rows):
            return np.empty(0, np.int64)
        every = np.sort(self._all_facets().corners, axis=1)
        at = match_points(rows, self._surface.identity(np.arange(len(self.area)))).reshape(-1, every.shape[1])
        at = np.sort(at[(at >= 0).all(axis=1)], axis=1)
        _, where = np.unique(np.concatenate([at, every]), axis=0, return_inverse=True)
        return np.flatnonzero(np.isin(where.reshape(-1)[len(at) :], where.reshape(-1)[: len(at)]))

    def _exclude_points(self, points: Ints) -> None:
        self.area = self._surface.area.copy()
        self.area[points] = 0.0

    def snapshot(self) -> object:
        """Shares of arms, areas, and facets left out."""
        return self._surface.at.share, self.area, self._excluded_facets

    def restore(self, memory: object) -> None:
        """Be again what `memory` gave of this surface; where edges have broken since, in an earlier pass of the step,
        it is another one and stays as those left it (not collective)."""
        share, area, cut = cast("tuple[Values, Values, Ints]", memory)
        if len(share) != len(self._surface.at.share):
            return
        self._excluded_facets = cut
        if share is not self._surface.at.share:
            self._surface.at = self._surface.at.with_arm_share(share)
        self.area = area

    def to_checkpoint(self) -> Values:
        """Rows of copies that are drawn in or left out: identity, share, whether left out; on rank 0 (collective)."""
        at = self._surface.at
        which = np.flatnonzero((at.share[at.copies] < 1) | (self.area[at.copies] == 0))
        rows = self._surface.identity()[which]
        of = at.copies[which]
        known = np.column_stack([rows, at.share[of], self.area[of] == 0])
        gathered = gather(self.comm, known)
        return np.concatenate(gathered) if gathered is not None else known

    def from_checkpoint(self, rows: Values) -> None:
        """Be again what `saved` gave."""
        at = self._surface.at
        place = match_points(rows[:, :-2], self._surface.identity())
        which, share = at.copies[place[place >= 0]], np.ones(len(at.share))
        share[which] = rows[place >= 0, -2]
        self._surface.at = at.with_arm_share(share)
        self._exclude_points(which[rows[place >= 0, -1] > 0])

    def cut_to_checkpoint(self) -> Values:
        """Rows of the corners of facets that are left out, on rank 0 (collective)."""
        gathered = gather(self.comm, self._corner_identities(self._excluded_facets))
        return np.concatenate(gathered) if gathered is not None else np.empty((0, 2 * self._domain.dim + 1))

    def cut_from_checkpoint(self, rows: Values) -> None:
        """Be again what `saved_cut` gave."""
        self._excluded_facets = self._match_facets(rows)

    def clear_caches(self) -> None:
        """Forget the facets that were near, and where they were nearest: searches start from there."""
        self._all = self._active = None

    def destroy(self) -> None:
        """Give the memory of PETSc's objects back."""
        self.interpolation.destroy()


def retract_from_obstacles(at: SurfaceMap, u: Values, gaps: GapFunction) -> SurfaceMap:
    """Places whose copies are drawn in where they would lie in an obstacle, as the points are that touch."""
    inside = at.copies[gaps(at(u))[at.copies] <= 0]
    return retract_points(at, u, inside, at.share[inside], np.full(len(inside), TINY), gaps)[0] if len(inside) else at
