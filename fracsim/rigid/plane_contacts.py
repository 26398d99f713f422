"""Contacts of convex hulls with planes.

MuJoCo finds at most three contacts of a hull with a plane, so that a fragment that spins fast can fall through a floor
with a fourth corner. Contacts with planes are found here instead: those of all corners that may come as far, judged by
the motion as the step begins. A body that is impacted may come down with other corners, which are checked afterwards.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from ..contact.shape_base import frame_about
from .bodies import Bodies

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class PlaneContactSettings:
    """Numbers of the choice of corners that are contacts.

    Attributes:
        approach_factor: multiple of the approach of a corner in a step within which it is a contact.
        reach_share: share of the bound of its body that is added to it.
        nearest_corners: closest corners of a body, which always are contacts.
        sectors: directions around a body in which corners that may support it are chosen.
        lowest_corners: corners in each sector that come closest.
        outermost_corners: corners in each sector that are farthest out.
    """

    approach_factor: float = 1.5
    reach_share: float = 0.25
    nearest_corners: int = 6
    sectors: int = 8
    lowest_corners: int = 2
    outermost_corners: int = 1


SETTINGS = PlaneContactSettings()


def _is_among_first(group: Ints, value: Values, count: int) -> Flags:
    """Return (k,) flags of items that are among the `count` with the least value (k,) of their group (k,)."""
    order = np.lexsort((value, group))
    _, start, sizes = np.unique(group[order], return_index=True, return_counts=True)
    rank = np.empty(len(group), np.int64)
    rank[order] = np.arange(len(group)) - np.repeat(start, sizes)
    return np.asarray(rank < count)


def _supporting_corners(body: Ints, arm: Values, axes: Values, later_gap: Values) -> Flags:
    """Return (k,) flags of corners that may support their body: the lowest and the outermost in each sector.

    Args:
        body: (k,) of the corners.
        arm: (k, 3) from the centre of the body, m.
        axes: (3, 3) two tangents of the plane, and its normal.
        later_gap: (k,) distance from the plane after the step, m.
    """
    x, y = arm @ axes[:, 0], arm @ axes[:, 1]
    sector = np.floor((np.arctan2(x, y) / (2 * np.pi) + 0.5) * SETTINGS.sectors).astype(np.int64)
    group = SETTINGS.sectors * body + np.minimum(sector, SETTINGS.sectors - 1)
    # a body with few corners may be supported by all of them
    has_few = np.bincount(body) <= SETTINGS.sectors * (SETTINGS.lowest_corners + SETTINGS.outermost_corners)
    lowest = _is_among_first(group, later_gap, SETTINGS.lowest_corners)
    outermost = _is_among_first(group, -np.hypot(x, y), SETTINGS.outermost_corners)
    return np.asarray(lowest | outermost | has_few[body])


@dataclass
class CheckedCorners:
    """Corners above planes in a step.

    Attributes:
        checked: (p, N) corners that were contacts in the last search.
        required: (p, N) corners that are contacts in any case.
    """

    checked: Flags
    required: Flags


@dataclass(frozen=True)
class PlaneContacts:
    """Planes (p) and the corners (N) of convex hulls.

    Attributes:
        obstacle: (p,) numbers of the planes among prescribed obstacles.
        plane_geom: (p,) their geoms.
        normal: (p, 3) outwards.
        friction: (p,) coefficients.
        corners: (N, 3) relative to the centres of the bodies at rest, m.
        corner_body: (N,) bodies.
        corner_geom: (N,) geoms.
        extent: (n,) distance that each body reaches from its centre, m.
        is_optional: (n,) bodies whose corners are contacts only where a step without them goes through a plane.
    """

    obstacle: Ints
    plane_geom: Ints
    normal: Values
    friction: Values
    corners: Values
    corner_body: Ints
    corner_geom: Ints
    extent: Values
    is_optional: Flags

    @cached_property
    def frames(self) -> list[Values]:
        """Axes (3, 3) of each plane: two tangents and the normal."""
        return [frame_about(normal) for normal in self.normal]

    def begin_step(self) -> CheckedCorners:
        """Return the record of a step in which no corner has been checked."""
        none = np.zeros((len(self.obstacle), len(self.corners)), bool)
        return CheckedCorners(none, none.copy())

    def find_missed(self, bodies: Bodies, obstacle_points: Values, depth: float, checked: CheckedCorners) -> Flags:
        """Return (n,) flags of bodies with unchecked corners that penetrate a plane by more than `depth`, m.

        Args:
            bodies: after the step.
            obstacle_points: (m, 3) reference points of obstacles after the step, m.
            depth: m.
            checked: updated.
        """
        missed = np.zeros(len(bodies), bool)
        for number, (obstacle, normal) in enumerate(zip(self.obstacle, [*self.normal], strict=True)):
            near, gap = self._corners_near(bodies, obstacle_points[obstacle], normal, np.zeros(len(bodies)))
            rows = np.flatnonzero((gap < -depth) & ~checked.checked[number, near])
            if len(rows):
                body = self.corner_body[near[rows]]
                # corners that may support the body are contacts in all later searches of the step
                supporting = _supporting_corners(body, self._arms(bodies, near[rows]), self.frames[number], gap[rows])
                checked.required[number, near[rows[supporting]]] = missed[body] = True
        return missed

    def _corners_near(
        self, bodies: Bodies, point: Values, normal: Values, reach: Values, chosen: Flags | None = None
    ) -> tuple[Ints, Values]:
        """Return corners (k,) of bodies that may reach a plane, and their distances (k,) from it, m.

        Args:
            bodies: n of them.
            point: (3,) of the plane, m.
            normal: (3,).
            reach: (n,) how far each body and the plane move, m.
            chosen: (n,) bodies that count; None: all.
        """
        height, local_normal = (bodies.position - point) @ normal, np.einsum("nij,i->nj", bodies.rotation, normal)
        is_low = height < self.extent + reach
        near = np.flatnonzero((is_low if chosen is None else is_low & chosen)[self.corner_body])
        body = self.corner_body[near]
        return near, np.einsum("kj,kj->k", local_normal[body], self.corners[near]) + height[body]

    def _arms(self, bodies: Bodies, corners: Ints) -> Values:
        """Return the vectors (k, 3), m, from the centres of the bodies to corners (k,)."""
        return np.asarray(np.einsum("kij,kj->ki", bodies.rotation[self.corner_body[corners]], self.corners[corners]))

    def find_contacts(
        self, bodies: Bodies, obstacle_points: Values, reach: Values, obstacle_reach: Values, dt: float,
        checked: CheckedCorners, chosen: Flags | None = None,
    ) -> list[tuple[int, Ints, Values, Values]]:  # fmt: skip
        """Return for each plane near bodies its number here, geoms (k,), gaps (k,), m, and points (k, 3), m.

        Args:
            bodies: n of them.
            obstacle_points: (m, 3) reference points of obstacles, m.
            reach: (n,) how far bodies may move in the step, m.
            obstacle_reach: (m,) how far obstacles move, m.
            dt: s.
            checked: updated.
            chosen: (n,) bodies whose contacts are searched for; None: all.
        """
        if not len(self.obstacle) or not len(self.corners):
            return []
        result = []
        for number, (obstacle, normal) in enumerate(zip(self.obstacle, [*self.normal], strict=True)):
            plane_reach = obstacle_reach[obstacle]
            near, gap = self._corners_near(bodies, obstacle_points[obstacle], normal, reach + plane_reach, chosen)
            is_checked, required = checked.checked[number], checked.required[number]
            is_checked[slice(None) if chosen is None else chosen[self.corner_body]] = False
            may_touch = (gap < reach[self.corner_body[near]] + plane_reach) & ~self.is_optional[self.corner_body[near]]
            rows = np.flatnonzero(may_touch | required[near])
            if not len(rows):
                continue
            near, body, gap = near[rows], self.corner_body[near[rows]], gap[rows]
            arms = self._arms(bodies, near)
            x = arms + bodies.position[body]
            approach = -dt * np.einsum("ki,i->k", bodies.velocity_at(x, body), normal)
            limit = SETTINGS.approach_factor * approach + SETTINGS.reach_share * reach[body] + plane_reach
            soon = np.flatnonzero(gap < limit)
            selected = _is_among_first(body, gap, SETTINGS.nearest_corners) | required[near]
            selected[soon] |= _supporting_corners(body[soon], arms[soon], self.frames[number], (gap - approach)[soon])
            is_checked[near[selected]] = True
            # half-way between the corner and the plane
            points = x[selected] - gap[selected, None] / 2 * normal
            result.append((number, self.corner_geom[near[selected]], gap[selected], points))
        return result
