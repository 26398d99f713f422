"""Contact law of a time step: unilateral constraints on velocities at all contacts (J. J. Moreau 1988).

    0 <= force  _|_  separation speed after the step + r / dt >= 0

r is the distance that the two bodies may still approach. In resting contact r is the gap. An impact is faster than
c_0 and closes the gap within the step, c dt > g; it has r = -e c dt, and the body flies freely for the share g / (c dt)
of the step before. In a sequence of impacts (impact_sequence) later impacts are postponed to the next event.

Equations: docs/theory.md#motion-and-contact-of-rigid-bodies.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class ContactLawSettings:
    """Numbers of the contact law.

    Attributes:
        overlap_recovery: share of an overlap that is removed in a step.
        recovery_speed: largest speed of separation of overlapping bodies, in units of c_0. The forces that jam bodies
            do work as they separate, so that a faster recovery would add energy.
        simultaneity: share of a step; impacts within it are simultaneous.
    """

    overlap_recovery: float = 0.2
    recovery_speed: float = 0.25
    simultaneity: float = 0.01


LAW = ContactLawSettings()


@dataclass(frozen=True)
class ContactConstraints:
    """Constraints at contacts (k) in a step or an event of it.

    Attributes:
        gap: (k,) m.
        allowed_approach: (k,) r, m.
        may_touch: (k,) whether the contact may close in the step.
        impact_speed: (k,) normal speed of impacts, m/s; 0 for other contacts.
        impact_fraction: (k,) share of the step after which an impact happens.
        postponed: (k,) impacts that happen in a later event.
        remaining_fraction: (k,) share of the step that is left, 1 in a step with one event.
    """

    gap: Values
    allowed_approach: Values
    may_touch: Flags
    impact_speed: Values
    impact_fraction: Values
    postponed: Flags
    remaining_fraction: Values | float = 1.0


def make_constraints(
    gap: Values, approach_speed: Values, dt: float, threshold: float, restitution: float
) -> ContactConstraints:
    """Return the constraints of a step with a single event.

    Args:
        gap: (k,) m.
        approach_speed: (k,) m/s.
        dt: s.
        threshold: c_0, m/s.
        restitution: coefficient of restitution e, 0 to 1.
    """
    # faster than resting contacts, and closed within the step
    impacts = (approach_speed > threshold) & (gap < approach_speed * dt)
    resting = _approach_without_impact(gap, gap, dt, threshold)
    allowed = np.where(impacts, -restitution * approach_speed * dt, resting)
    share = np.divide(gap, approach_speed * dt, out=np.zeros_like(gap), where=impacts & (gap > threshold * dt))
    may_touch, none = gap < (approach_speed + threshold) * dt, np.zeros(len(gap), bool)
    impact_speed = np.where(impacts, approach_speed, 0.0)
    return ContactConstraints(gap, allowed, may_touch, impact_speed, np.clip(share, 0.0, 1.0), none)


def make_event_constraints(
    gap: Values, approach_speed: Values, dt: float, threshold: float, restitution: float, approach: Values,
    remaining: Values, impact_candidates: Flags,
) -> ContactConstraints:  # fmt: skip
    """Return the constraints of one event in a sequence.

    Args:
        gap: (k,) m.
        approach_speed: (k,) m/s.
        dt: s.
        threshold: c_0, m/s.
        restitution: coefficient of restitution e, 0 to 1.
        approach: (k,) distance that bodies would have approached since the step began, at their present speed, m.
        remaining: (k,) share of the step that is left.
        impact_candidates: (k,) contacts in which an impact counts.
    """
    impacts = impact_candidates & (gap + approach < approach_speed * dt)
    # in the last event of a sequence these close just as the step ends
    postponed = impacts & impacts_later(gap, approach_speed, dt, threshold)
    resting = _approach_without_impact(gap, gap / remaining, dt, threshold)
    allowed = np.where(impacts & ~postponed, -restitution * approach_speed * dt, resting)
    far = impacts & (gap > threshold * dt)
    share = np.divide(gap + approach, approach_speed * dt, out=np.zeros_like(gap), where=far)
    may_touch, impact_speed = (
        gap < (approach_speed * remaining + threshold) * dt,
        np.where(impacts, approach_speed, 0.0),
    )
    return ContactConstraints(
        gap, allowed, may_touch, impact_speed, np.clip(share, 0.0, 1.0), postponed, remaining
    )  # fmt: skip


def _approach_without_impact(gap: Values, room: Values, dt: float, threshold: float) -> Values:
    """Return r (k,), m: the `room` (k,), m, of open contacts, and a negative distance for overlapping bodies."""
    recovery = np.maximum(LAW.overlap_recovery * gap, -LAW.recovery_speed * threshold * dt)
    return np.where(gap < 0, recovery, room)


def impacts_later(gap: Values, approach_speed: Values, dt: float, threshold: float) -> Flags:
    """Return (k,) flags of bodies that approach faster than c_0 = `threshold` and do not touch yet."""
    return np.asarray((approach_speed > threshold) & (gap > (threshold + LAW.simultaneity * approach_speed) * dt))


# --- free flight before impacts ---


def flight_fractions(constraints: ContactConstraints, pairs: Ints, count: int) -> Values:
    """Return the shares (count,) of the step that bodies fly before their first impact; 0 for bodies without one.

    `pairs`: (k, 2) bodies of the contacts, obstacles from `count` on.
    """
    rows = np.flatnonzero(constraints.impact_speed)
    share = _earliest(np.minimum(pairs[rows], count), constraints.impact_fraction[rows], count)[:count]
    return np.where(np.isfinite(share), share, 0.0)


def joint_flight_fractions(constraints: ContactConstraints, pairs: Ints, elapsed: Values, near: float) -> Values:
    """Return the shares (n,) of the step at which bodies of a sequence are impacted next.

    Bodies with gaps below `near`, m, fly equally long, since contact forces between bodies at different times would be
    meaningless. No body flies beyond an impact of another one that comes before.

    Args:
        constraints: of the event.
        pairs: (k, 2) bodies of the contacts.
        elapsed: (n,) shares of the step that the bodies have flown.
        near: m.
    """
    count, rows = len(elapsed), np.flatnonzero(constraints.impact_speed)
    links = pairs[constraints.gap < near]
    links = links[np.maximum(*links.T) < count]
    graph = csr_array((np.ones(len(links)), links.T), shape=(count, count))
    group_of_body = np.append(connected_components(graph, directed=False)[1], count)
    groups, fraction = group_of_body[np.minimum(pairs[rows], count)], constraints.impact_fraction[rows]
    earliest = _earliest(groups, fraction, count)
    # an impact happens now only if it is the first one of both groups
    current = fraction <= earliest[groups].min(axis=1) + LAW.simultaneity
    first = _earliest(groups[current], fraction[current], count)[group_of_body[:-1]]
    return np.where(np.isfinite(first), np.maximum(first, elapsed), elapsed)


def _earliest(groups: Ints, fraction: Values, count: int) -> Values:
    """Return the least impact fraction (count + 1,) of the pairs (k, 2) that a group is in; infinite without any.

    The last entry is that of obstacles, which is infinite.
    """
    first: Values = np.full(count + 1, np.inf)
    np.minimum.at(first, groups, np.repeat(fraction[:, None], 2, axis=1))
    first[count] = np.inf
    return first
