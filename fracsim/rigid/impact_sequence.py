"""Sequences of impact events within a step.

As a rule all impacts of a step act at once. A step becomes a sequence of events where a body, after an impact, would go
on into another body behind it: with simultaneous impacts the second one would stop it in the air. With many contacts,
where each event is expensive, a sequence is used only if the body may break.

Impacts below a hundredth of the greatest speed do not count, since solutions are no more accurate. Impacts of the event
before do not count either where nothing has moved since.

In an event bodies that touch are at one time t dt, others at times of their own. Two bodies at times t_1 and t_2 have
approached by dt (c(t_1 v_1) - c(t_2 v_2)) since the step began, at their present velocities v, with c the component
along the normal. Prescribed obstacles are where they were as the step began.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .bodies import Bodies
from .collision_detection import MotionBounds
from .contact_law import LAW, ContactConstraints
from .contact_points import Contacts
from .fragment_overlap import AdmittedOverlaps

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
# Family of bodies (m,): the number c of the instance that a fragment is of, -2 - c if it cannot break any more, else
# -1.
FamilyFunction = Callable[[Ints], Ints]


@dataclass(frozen=True)
class EventConditions:
    """Conditions at the beginning of an event of a step.

    Attributes:
        gravity: (3,) m/s^2 that acts in the event; all of it in the first one.
        overlaps: overlaps of fragments that are admitted.
        elapsed: (n,) shares of the step that bodies have flown; None in a step with a single event.
        events_left: number of events that may follow.
        min_impact_speed: m/s; slower contacts are not impacts.
        is_first: whether it is the first event.
    """

    gravity: Values
    overlaps: AdmittedOverlaps
    elapsed: Values | None = None
    events_left: int = 0
    min_impact_speed: float = 0.0
    is_first: bool = True

    @property
    def in_sequence(self) -> bool:
        """Whether the step is a sequence of events."""
        return self.elapsed is not None

    @property
    def elapsed_or_zero(self) -> Values | float:
        """Shares (n,) of the step that bodies have flown."""
        return 0.0 if self.elapsed is None else self.elapsed

    def following(self, elapsed: Values, overlaps: AdmittedOverlaps) -> EventConditions:
        """Return the conditions of the next event, with bodies after shares `elapsed` (n,) of the step."""
        left = self.events_left - 1
        return EventConditions(0 * self.gravity, overlaps, elapsed, left, self.min_impact_speed, is_first=False)


class ImpactEvent:
    """Contacts of one event of a step, with the impulses found so far.

    Attributes:
        conditions: at its beginning.
        bounds: of the motion of bodies and obstacles.
        initial_contacts: contacts near the bodies as the event begins.
        bodies: at their impacts.
        elapsed: (n,) shares of the step until these.
        contacts: k contacts near these bodies.
        constraints: of these contacts.
        overlaps: admitted overlaps of fragments in the event.
        active: (k,) contacts that are solved for.
        impulse: (k, 3) along the axes of the contacts, N s.
    """

    def __init__(
        self, conditions: EventConditions, bounds: MotionBounds, initial_contacts: Contacts, bodies: Bodies,
        elapsed: Values, contacts: Contacts, constraints: ContactConstraints, overlaps: AdmittedOverlaps,
    ) -> None:  # fmt: skip
        """Begin with the contacts that may touch, and no impulses."""
        self.conditions, self.bounds, self.initial_contacts = conditions, bounds, initial_contacts
        self.bodies, self.elapsed = bodies, elapsed
        self.contacts, self.constraints, self.overlaps = contacts, constraints, overlaps
        self.active: Flags = constraints.may_touch & ~self.postponed
        self.impulse: Values = np.zeros((len(contacts), 3))

    @property
    def is_last(self) -> bool:
        """Whether no event may follow."""
        return not self.conditions.events_left

    @property
    def postponed(self) -> Flags:
        """(k,) flags of impacts that are left to later events."""
        return self.constraints.postponed & (self.conditions.events_left > 0)

    @property
    def impacts(self) -> Flags:
        """(k,) flags of impacts in this event."""
        return (self.constraints.impact_speed > 0) & ~self.constraints.postponed

    def begin_sequence(self, events: int) -> EventConditions:
        """Return the conditions of the first of at most `events` events, in place of this single one."""
        min_impact_speed = LAW.simultaneity * float(self.constraints.impact_speed.max())
        conditions, elapsed = self.conditions, np.zeros(len(self.bodies))
        return EventConditions(conditions.gravity, conditions.overlaps, elapsed, events - 1, min_impact_speed)


def would_hit_next(
    event: ImpactEvent, postponed: Flags, near: float, count: int, family: FamilyFunction | None
) -> bool:
    """Return whether a body would go on, after an impact, into something behind what it hit.

    Args:
        event: with all impacts at once.
        postponed: (k,) contacts that would close later.
        near: gap below which bodies count as touching, m.
        count: number of bodies; obstacles have the numbers from there on.
        family: only bodies that may break count, and only obstacles behind them of another family; None: all count.
    """
    if not np.any(postponed):
        return False
    impact_speed, contacts = event.constraints.impact_speed, event.contacts
    rows = np.flatnonzero((impact_speed > 0) | (event.constraints.gap < near))
    pairs, axis = contacts.pairs[rows], contacts.axes[rows, 0]
    # every contact is seen from both of its bodies
    body, partner = np.concatenate([pairs, pairs[:, ::-1]]).T
    direction, late = np.concatenate([axis, -axis]), np.tile(postponed[rows], 2)
    speed = np.tile(impact_speed[rows], 2)
    impacts = np.flatnonzero(~late & (partner < count) & (body < count))
    # of the bodies that a body hits or touches, the one that it hits hardest
    hardest = np.full(count + 1, -1)
    order = impacts[np.argsort(speed[impacts], kind="stable")]
    hardest[body[order]] = order
    later = np.flatnonzero(late & (hardest[np.minimum(body, count)] >= 0))
    earlier = hardest[body[later]]
    same_direction = np.einsum("ki,ki->k", direction[later], direction[earlier]) > 0
    behind = same_direction & (partner[later] != partner[earlier])
    if family is None or not np.any(behind):
        return bool(np.any(behind))
    owned, screen, beyond = (
        _families(numbers[behind], count, family) for numbers in (body[earlier], partner[earlier], partner[later])
    )
    # a fragment that cannot break is hit aside by bodies of no family alone
    gives_way = (screen >= 0) | ((screen < -1) & (owned == -1))
    return bool(np.any(gives_way & (screen != owned) & (screen != beyond)))


def _families(numbers: Ints, count: int, family: FamilyFunction) -> Ints:
    """Return the families (k,) of bodies and obstacles (k,); -1 for obstacles, whose numbers begin at `count`."""
    result = np.full(len(numbers), -1)
    bodies = numbers < count
    result[bodies] = family(numbers[bodies])
    return result


def elapsed_approach(
    contacts: Contacts, gap: Values, motion: tuple[Values, Values], obstacle_velocity: Values, elapsed: Values,
    dt: float,
) -> tuple[Values, Values, Values]:  # fmt: skip
    """Return gaps, approach so far and the remaining share of the step at contacts in a sequence.

    Args:
        contacts: k contacts.
        gap: (k,) m, with obstacles where they were as the step began.
        motion: (n + m, 3) velocities and spins of bodies and obstacles.
        obstacle_velocity: (m, 3) m/s.
        elapsed: (n,) shares of the step that bodies have flown.
        dt: s.

    Returns:
        Gaps (k,), m; approach (k,), m, in the elapsed shares at the present velocities; the remaining share (k,) of the
        body that has more of it left.
    """
    n = len(elapsed)
    times, (velocity, spin) = np.append(elapsed, np.zeros(len(obstacle_velocity))), motion
    earlier = np.minimum(*np.append(elapsed, np.ones(len(obstacle_velocity)))[contacts.pairs.T])
    later = np.maximum(*times[contacts.pairs.T])
    between_bodies = contacts.approach_speeds(times[:, None] * velocity, times[:, None] * spin)
    with_obstacles = later * contacts.approach_speeds(velocity, spin)
    approach = np.where(np.maximum(*contacts.pairs.T) < n, between_bodies, with_obstacles)
    if np.any(obstacle_velocity):
        obstacles_alone: Values = np.zeros((len(times), 3))
        obstacles_alone[n:] = obstacle_velocity
        gap = gap - dt * later * contacts.approach_speeds(obstacles_alone, 0 * obstacles_alone)
    return gap, dt * approach, np.maximum(1 - earlier, LAW.simultaneity)
