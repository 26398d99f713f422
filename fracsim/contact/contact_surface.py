"""Points and facets of a body's split surface that analytic obstacles act on.

New crack faces are retracted where they have no room (crack_faces). Before obstacles so curved that they touch facets
between their nodes new points are also retracted until their facets are open and out of contact; facets for which this
fails are excluded.

Equations: docs/theory.md#new-crack-faces.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import cast

import numpy as np
from mpi4py import MPI

from ..array_types import Flags, Ints, Pattern, Values
from ..mesh.domain import Domain
from ..mesh.ghost_exchange import KeyedReduction, find_saved_keys
from ..mesh.parallel import gather
from ..mesh.simplices import is_split
from ..mesh.split_surface.closed_surface import build_split_surface, node_keys
from ..mesh.split_surface.drawn_surface import DrawnSurface
from ..mesh.split_surface.entity_numbering import EntityNumbering
from ..mesh.split_surface.local_surface import (
    NodeExchange,
    contact_elements,
    local_map_parts,
    local_mesh,
    restrict_to_used_columns,
)
from ..mesh.split_surface.surface_map import SurfaceMap, row_entries
from ..meshes.topology import row_keys
from .crack_faces import (
    RETRACTION,
    TINY,
    RetractedPoints,
    extend_points,
    retract_cut_elements,
    retract_from_obstacles,
    retract_points,
)
from .facet_contact import FACETS, ContactFacets
from .pose import PosedShape, min_distance


class ContactSurface:
    """Points of the split surface of this rank's cells, which follow nodes, x = X + W u (HistoryTerm).

    A point on the border of two ranks exists on both, with the area of the elements of each rank.

    Attributes:
        keys: (n,) keys of the points, equal on all ranks and as edges break (SurfacePoints.keys).
        columns: global numbers of the nodes in the columns of W.
        point_map: map from these nodes to the points.
        area: (n,) shares of the points in the reference area, m^2 (2D: m); 0 of excluded points.
        curved: numbers of the obstacles that act on facets.
    """

    def __init__(
        self, domain: Domain, width: float, curved: Sequence[int] = (), *, facets_may_be_cut: bool = False
    ) -> None:
        """Make the surface of a whole body (collective).

        Args:
            domain: mesh.
            width: of the barrier, m.
            curved: numbers of the obstacles that act on facets.
            facets_may_be_cut: whether facets may be cut later on: none is excluded.
        """
        self._domain, self._width, self.comm, self.curved = domain, width, domain.comm, curved
        self._may_be_cut = facets_may_be_cut or not curved
        self._topology = EntityNumbering(local_mesh(domain))
        self._nodes: NodeExchange | None = None
        self._fingerprint = 0  # sum of the keys of all ranks: equal surfaces have equal ones
        self.update_damage(np.zeros(domain.cell_count, np.uint8))

    def update_damage(self, pattern: Pattern, shown: Flags | None = None) -> None:
        """Make the surface again, without retracted or excluded points (collective).

        Args:
            pattern: (cells,) broken edges of each cell.
            shown: (cells,) flags of cells that are split; all others are drawn as if whole. None: all cells are.
        """
        domain = self._domain
        of_shown = pattern if shown is None else np.where(shown, pattern, np.uint8(0))
        surface, numbers = build_split_surface(self._topology, of_shown), domain.input_numbering.nodes
        assert surface.numbering is not None
        keys = surface.numbering.keys(numbers)
        if domain.order == 2:
            from ..mesh.split_surface.quadratic_surface import with_midside_points

            surface = with_midside_points(surface, domain, of_shown)
            midside = surface.parents.first_parent[len(keys) :]
            keys = np.append(keys, node_keys(numbers[midside], domain.dim))
        elements, measure = contact_elements(surface, self._topology)
        shares = np.repeat(measure / domain.dim, domain.dim)
        area = np.asarray(np.bincount(elements.reshape(-1), shares, len(surface.points)), np.float64)
        points, real = np.flatnonzero(area > 0), measure > 0
        intact = ~is_split(domain.dim)[pattern]
        if shown is not None:
            intact &= shown  # so that damage elsewhere changes no arm
        means, middle, arms, out = local_map_parts(domain, surface, points, intact)
        self.columns, (means, arms) = restrict_to_used_columns([means, arms])
        self.point_map, self.keys = SurfaceMap(means, middle, arms, out), keys[points]
        self.area = self._full_area = area[points]
        self._fingerprint = self.comm.allreduce(int(self.keys.view(np.uint64).sum()))
        corners, smoothing = np.searchsorted(points, elements[real]), FACETS.smoothing * self._width
        self._all_facets = ContactFacets(corners, measure[real], smoothing)
        self._active: tuple[Values, Ints, ContactFacets] | None = None  # with area and excluded facets that it is for
        self._excluded: Ints = np.empty(0, np.int64)  # facets
        self.destroy()
        self._nodes = NodeExchange(domain, self.columns)

    # --- points that follow nodes ---

    @property
    def rest_positions(self) -> Values:
        """(n, d) reference positions of the points, m."""
        return self.point_map.rest

    def nodal_values(self, owned: Values) -> Values:
        """(columns, d) values at the nodes that points follow, of a field with `owned` dofs (collective)."""
        assert self._nodes is not None
        return self._nodes(owned)

    def interpolate(self, owned: Values) -> Values:
        """(n, d) values at the points of a field with `owned` dofs (collective)."""
        return np.asarray(self.point_map.weights @ self.nodal_values(owned))

    def positions(self, u: Values) -> Values:
        """(n, d) positions of the points for owned displacements u, m (collective)."""
        return np.asarray(self.rest_positions + self.interpolate(u))

    def sum_at_nodes(self, parts: Values) -> Values:
        """(owned dofs,) sums over ranks of `parts` (columns, d) at the nodes that points follow (collective)."""
        assert self._nodes is not None
        return self._nodes.sum_at_nodes(parts)

    def nodal_forces(self, forces: Values) -> Values:
        """(owned dofs,) nodal forces W^T f equivalent to forces (n, d) at the points, N (collective)."""
        return self.sum_at_nodes(self.point_map.nodal_forces(forces))

    def nodal_forces_of(self, points: Ints, forces: Values) -> Values:
        """(owned dofs, m) nodal forces equivalent to m sets of forces (k, d, m) at points (k,) (collective)."""
        W, m = self.point_map.weights, forces.shape[2]
        entry, row = row_entries(W, points)
        at_nodes = np.zeros((W.shape[1], *forces.shape[1:]))
        np.add.at(at_nodes, W.indices[entry], W.data[entry][:, None, None] * forces[row])
        return np.stack([self.sum_at_nodes(at_nodes[:, :, i]) for i in range(m)], axis=1)

    def sum_at_points(self, points: Ints, values: Values) -> Values:
        """(k, m) sums over all ranks of values (k, m) at points (k,) that ranks share (collective)."""
        return np.asarray(KeyedReduction(self.comm, self.keys[points])(values, np.add))

    # --- gaps ---

    def min_distance(self, distances: Values) -> float:
        """Minimum of distances (n,), m, over this rank's points that are not excluded."""
        return float(distances[self.area > 0].min(initial=np.inf))

    def min_fraction(self, fractions: Values) -> float:
        """Minimum of fractions (n,) of a motion over all ranks, at most 1 (collective)."""
        local = fractions[self.area > 0].min(initial=1.0)
        return float(self.comm.allreduce(float(local), op=MPI.MIN))

    @property
    def facets(self) -> ContactFacets:
        """Facets of which neither a corner nor the facet itself is excluded (not collective)."""
        cached, area = self._active, self.area
        if cached is None or cached[0] is not area or cached[1] is not self._excluded:
            selected = facets = self._all_facets
            if len(self._excluded) or (area == 0).any():
                active = np.asarray((area > 0)[facets.corners].all(axis=1))
                active[self._excluded] = False
                selected = ContactFacets(facets.corners[active], facets.area[active], facets.smoothing)
            cached = self._active = area, self._excluded, selected
        return cached[2]

    def facet_gaps(
        self, posed: Sequence[PosedShape], facets: ContactFacets, x: Values, reach: float | None = None
    ) -> Values:
        """(m,) least gaps of facets to the curved obstacles, with points at x (n, d), m; infinite far away.

        `reach`: gap from which on an obstacle is far, m; None: the width of the barrier.
        """
        reach = self._width if reach is None else reach
        return np.asarray(np.min([facets.gaps(posed[n], x, reach) for n in self.curved], axis=0))

    def is_open(self, posed: Sequence[PosedShape], x: Values) -> bool:
        """Whether all gaps are positive, and no facet is cut, with points at x (n, d), m (collective)."""
        is_open = self.min_distance(min_distance(posed, x)) > 0
        if is_open and not self._may_be_cut:
            is_open = bool((self.facet_gaps(posed, self.facets, x) > 0).all())
        return bool(self.comm.allreduce(is_open, op=MPI.LAND))

    def is_retracted(self) -> bool:
        """Whether any point or facet of this rank is retracted or excluded."""
        return bool((self.area == 0).any() or (self.point_map.share < 1).any() or len(self._excluded))

    # --- new crack faces ---

    def edges_broke(self, pattern: Pattern, shown: Flags | None, u: Values, posed: Sequence[PosedShape]) -> None:
        """Add new crack faces, retracted where they would lie in an obstacle (collective).

        Args:
            pattern: (cells,) broken edges of each cell.
            shown: (cells,) flags of cells whose crack faces are part of the surface; None: all.
            u: (owned dofs,) displacements, m.
            posed: obstacles.
        """
        gaps, copies, excluded = partial(min_distance, posed), self.point_map.copies, self._facet_keys(self._excluded)
        # nan: excluded points have no gap to keep
        gap = np.where(self.area > 0, gaps(self.positions(u)), np.nan)
        old_keys = self.keys[copies]
        retracted = RetractedPoints.select(old_keys, self.point_map.share[copies], gap[copies], self._width)
        self.update_damage(pattern, shown)
        nodal, copies = self.nodal_values(u), self.point_map.copies
        # points keep their keys, whatever numbers they have on the new surface
        share, gap = retracted.match(self.keys[copies], self._width)
        self.point_map, without_room = retract_points(self.point_map, nodal, copies, share, gap, gaps)
        self._exclude_points(without_room)
        if not self._may_be_cut:
            self._excluded = np.flatnonzero(np.isin(self._facet_keys(), excluded)) if len(excluded) else excluded
            is_new = np.zeros(len(self.area), bool)
            is_new[copies] = ~np.isin(self.keys[copies], old_keys)
            self._retract_facets(is_new, nodal, posed)

    def _retract_facets(self, is_new: Flags, nodal: Values, posed: Sequence[PosedShape]) -> None:
        """Retract new points (n,) of facets that would be cut or in contact; exclude facets for which this fails."""
        for _ in range(RETRACTION.facet_rounds):
            share, facets = self.point_map.share, self.facets
            has_new = is_new[facets.corners].any(axis=1)
            too_close = self.facet_gaps(posed, facets, self.point_map(nodal)) < np.where(has_new, self._width, TINY)
            points = np.unique(facets.corners[too_close])
            points = points[is_new[points] & (share[points] > RETRACTION.min_arm)]
            if not len(points):
                break
            self._set_arms(points, RETRACTION.facet_factor * share[points])
        closed = np.flatnonzero(is_new & (self.area > 0))
        closed = closed[min_distance(posed, self.point_map(nodal)[closed]) <= 0]
        if len(closed):
            self._exclude_points(np.union1d(closed, np.flatnonzero(self.area == 0)))
        self._exclude_facets(self._facets_too_close(is_new, nodal, posed))

    def release(self, u: Values, posed: Sequence[PosedShape]) -> None:
        """Extend retracted points, and include excluded points and facets, as far as there is room (collective).

        Releases of points that bring a facet into contact are undone.

        Args:
            u: (owned dofs,) displacement, m.
            posed: obstacles.
        """
        nodal, gaps = self.nodal_values(u), partial(min_distance, posed)
        old_map, excluded = self.point_map, self.area == 0
        point_map = extend_points(old_map, nodal, self._width, gaps)
        if len(points := np.flatnonzero(excluded)):
            full, min_gap = np.ones(len(points)), np.full(len(points), self._width)
            point_map, points = retract_points(point_map, nodal, points, full, min_gap, gaps)
            self._exclude_points(points)
        self.point_map = point_map
        if self._may_be_cut or (point_map is old_map and not excluded.any() and not len(self._excluded)):
            return
        moved = (point_map.share != old_map.share) | excluded
        undone = np.unique(self._all_facets.corners[self._facets_too_close(moved, nodal, posed)])
        undone = undone[moved[undone]]
        if len(undone):
            self._set_arms(undone, old_map.share[undone])
        if len(self._excluded):
            gap = self.facet_gaps(posed, self._all_facets, self.point_map(nodal))[self._excluded]
            if (gap >= self._width).any():
                self._excluded = self._excluded[gap < self._width]
        self._exclude_facets(self._facets_too_close(excluded, nodal, posed))

    def _facets_too_close(self, moved: Flags, nodal: Values, posed: Sequence[PosedShape]) -> Ints:
        """(k,) facets that are cut, or have a point that has `moved` (n,) and would be in contact."""
        facets = self._all_facets
        min_gap = np.where(moved[facets.corners].any(axis=1), self._width, TINY)
        return np.flatnonzero(self.facet_gaps(posed, facets, self.point_map(nodal)) < min_gap)

    def exclude_cut_facets(self, posed: Sequence[PosedShape]) -> None:
        """Exclude facets of the body at rest that are cut only by the smoothing, until there is room."""
        if not self._may_be_cut:
            self._exclude_facets(np.flatnonzero(self.facet_gaps(posed, self._all_facets, self.rest_positions) <= 0))

    def _exclude_facets(self, facets: Ints) -> None:
        """Exclude these facets (k,) as well."""
        if len(np.setdiff1d(facets, self._excluded)):
            self._excluded = np.union1d(facets, self._excluded)

    def _exclude_points(self, points: Ints) -> None:
        """Exclude these points (k,) and no others."""
        self.area = self._full_area.copy()
        self.area[points] = 0.0

    def _set_arms(self, points: Ints, share: Values) -> None:
        """Set the factors (k,) of the arms of points (k,)."""
        all_shares = self.point_map.share.copy()
        all_shares[points] = share
        self.point_map = self.point_map.with_arm_share(all_shares)

    def _facet_keys(self, facets: Ints | slice = slice(None)) -> Ints:
        """(k,) keys of facets (k,), of the keys of their corners."""
        corners = self._all_facets.corners[facets]
        return row_keys(np.sort(self.keys[corners], axis=1)) if len(corners) else np.empty(0, np.int64)

    # --- points for output ---

    def separate(self, points: SurfaceMap, surface: DrawnSurface, posed: Sequence[PosedShape]) -> SurfaceMap:
        """Retract drawn points that would lie in an obstacle, or whose elements curved ones cut (collective).

        `points`: a map without nodes.
        """
        points = retract_from_obstacles(points, partial(min_distance, posed))
        if not self.curved:
            return points
        elements = surface.split.elements
        facets = ContactFacets(elements, np.ones(len(elements)), self._all_facets.smoothing)
        return retract_cut_elements(points, surface, lambda x: self.facet_gaps(posed, facets, x, 0.0) <= 0)

    # --- state ---

    def snapshot(self) -> object:
        """Factors of arms, areas, excluded facets, and fingerprint of the surface."""
        return self.point_map.share, self.area, self._excluded, self._fingerprint

    def restore(self, memory: object) -> None:
        """Restore a snapshot of this surface (not collective).

        Where edges have broken since, in an earlier pass of the step, the surface is another one and stays as it is: on
        all ranks, also where the part of a rank is the same.
        """
        share, area, excluded, fingerprint = cast("tuple[Values, Values, Ints, int]", memory)
        if fingerprint != self._fingerprint:
            return
        if share is not self.point_map.share:
            self.point_map = self.point_map.with_arm_share(share)
        self.area, self._excluded = area, excluded

    def to_checkpoint(self) -> dict[str, Values]:
        """Keys and factors of retracted points, and keys of excluded points and facets, on rank 0 (collective)."""
        share, keys = self.point_map.share, self.keys
        arrays = keys[share < 1], share[share < 1], keys[self.area == 0], self._facet_keys(self._excluded)
        parts = gather(self.comm, arrays)
        if parts is None:
            return {}
        names = ("retracted", "share", "excluded", "cut_facets")[: 4 if self.curved else 3]
        return {name: np.concatenate(rows) for name, rows in zip(names, zip(*parts, strict=True), strict=False)}

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Set the state from the arrays of a checkpoint (collective).

        Raises ValueError if it has keys of no point, or not as many factors as keys.
        """
        keys, share = self.keys, saved["share"]
        retracted, excluded = (find_saved_keys(self.comm, keys, saved[name]) for name in ("retracted", "excluded"))
        if len(share) != len(retracted):
            raise ValueError(f"{len(share)} factors of {len(retracted)} retracted points")
        self.point_map = self.point_map.with_arm_share(np.ones(len(keys)))
        self._set_arms(retracted[retracted >= 0], share[retracted >= 0])
        self._exclude_points(excluded[excluded >= 0])
        if self.curved:
            facets = find_saved_keys(self.comm, self._facet_keys(), saved["cut_facets"])
            self._excluded = np.sort(facets[facets >= 0])

    def clear_search(self) -> None:
        """Discard candidates among facets."""
        self._all_facets, self._active = replace(self._all_facets), None

    def destroy(self) -> None:
        """Destroy the objects of PETSc."""
        if self._nodes is not None:
            self._nodes.destroy()
