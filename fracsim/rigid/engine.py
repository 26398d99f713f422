"""Rigid-body engine: one time step of bodies of fixed shapes.

    v' = v + dt g + J / m,   x' = x + s dt (v + s dt g / 2) + (1 - s) dt v',   l' = l + r x J

with impulses J (contact_solver) that satisfy the law of contact_law, and the share s of the step that a body flies
before it is impacted. Some steps are sequences of events (impact_sequence). MuJoCo's own contact model, of springs and
dashpots, and its integration of rotations, which does not conserve angular momentum, are not used.

Equations: docs/theory.md#motion-and-contact-of-rigid-bodies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from .bodies import Bodies, fly, velocities_of_all
from .collision_detection import CollisionDetector, MotionBounds, bound_motion, no_motion
from .contact_law import (
    ContactConstraints,
    flight_fractions,
    impacts_later,
    joint_flight_fractions,
    make_constraints,
    make_event_constraints,
)
from .contact_points import ContactImpulses, Contacts
from .contact_solver import ContactSolver, has_many_contacts
from .core_contact import CoreContact
from .fragment_overlap import AdmittedOverlaps, InitialOverlaps
from .impact_sequence import EventConditions, FamilyFunction, ImpactEvent, elapsed_approach, would_hit_next
from .mujoco_model import ContactParameters, MujocoModel, build_model
from .obstacles import Part, PrescribedObstacle
from .plane_contacts import CheckedCorners
from .shell_contact import ShellContacts, ShellSurface

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class EngineSettings:
    """Limits of the repetitions in a step.

    Attributes:
        excess_reach_ratio: multiple of its bound of motion above which a body is searched for contacts again.
        search_rounds: largest number of searches for contacts of bodies that move farther than expected.
        missed_depth: c_0 dt; corners that were not checked may penetrate a plane by at most this much.
        max_events: events in a sequence with few contacts.
        max_crowded_events: events in a sequence with many contacts.
    """

    excess_reach_ratio: float = 1.5
    search_rounds: int = 3
    missed_depth: float = 0.25
    max_events: int = 6
    max_crowded_events: int = 3


SETTINGS = EngineSettings()


class Engine:
    """Bodies of fixed shapes and the obstacles around them; a new engine is made where bodies break.

    Attributes:
        contact_error: of the velocities of the last step, m/s; 0 if contact is within the tolerance.
    """

    def __init__(
        self,
        bodies: Bodies,
        parts: Sequence[Sequence[Part]],
        obstacles: Sequence[PrescribedObstacle],
        parameters: ContactParameters,
        overlaps: InitialOverlaps | None = None,
        names: Ints | None = None,
        hull_points: Sequence[Values] | None = None,
        rotation: Values | None = None,
        cores: CoreContact | None = None,
        shells: Sequence[ShellSurface | None] | None = None,
    ) -> None:
        """Make the model of a set of bodies.

        Args:
            bodies: n bodies.
            parts: convex parts of each body.
            obstacles: prescribed obstacles.
            parameters: time step, gravity, friction, restitution.
            overlaps: admitted overlaps of fragments; None: there are none.
            names: (n,) of the bodies, ascending; None: their numbers.
            hull_points: outermost points of each body; None: all corners.
            rotation: (n, 3, 3) from the axes of parts and points to those of the bodies at rest; None: identity.
            cores: of the first bodies; fragments that overlap keep out of them.
            shells: surfaces of the first bodies, None for those that are no unbroken shells; None: there are none.
        """
        self._parameters, self._count = parameters, len(bodies)
        self._model = build_model(bodies, parts, obstacles, parameters, hull_points, rotation)
        shell_contacts = None
        if shells is not None and any(shell is not None for shell in shells):
            turn = np.tile(np.eye(3), (len(bodies), 1, 1)) if rotation is None else rotation
            shell_contacts = ShellContacts(shells, turn, self._model.first_geom)
        self._detector = CollisionDetector(self._model, cores, parameters.friction, shell_contacts)
        self._solver, self.contact_error = ContactSolver(self._model, parameters), 0.0
        # reference points of obstacles at the end of the last step, m
        self._obstacle_points: Values = np.array([obstacle.position for obstacle in obstacles]).reshape(-1, 3)
        body_names = np.arange(len(bodies)) if names is None else names
        geom_count = len(self._model.body_of_geom)
        self._overlaps = AdmittedOverlaps.from_overlaps(
            overlaps or InitialOverlaps.empty(), body_names, self._model.first_geom, geom_count
        )

    @property
    def initial_overlaps(self) -> InitialOverlaps:
        """Overlaps of fragments that are admitted at present."""
        return self._overlaps.to_initial_overlaps()

    def advance(
        self, bodies: Bodies, obstacle_points: Values | None = None, family: FamilyFunction | None = None
    ) -> tuple[Bodies, ContactImpulses]:
        """Return the bodies one step later, and the impulses of all contacts.

        A body that is impacted may move farther than expected. Its contacts there are searched for in rounds.

        Args:
            bodies: as the step begins.
            obstacle_points: (m, 3) reference points of obstacles at the end of the step, m; None: they do not move.
            family: families of bodies that may break, see impact_sequence; None: nothing breaks.
        """
        model, parameters = self._model, self._parameters
        rates: Values = np.zeros_like(self._obstacle_points)
        end_points = self._obstacle_points
        if obstacle_points is not None:
            rates = np.asarray((obstacle_points - self._obstacle_points) / parameters.time_step)
            end_points = obstacle_points
        bounds = bound_motion(model, parameters, bodies, rates)
        checked = model.planes.begin_step()
        previous: ImpactEvent | None = None
        exceeded: Flags = np.ones(self._count, bool)
        step = ImpactStep(model, parameters, self._detector, self._obstacle_points, checked, self._overlaps, family)
        for _ in range(SETTINGS.search_rounds):
            event = previous = step.find_first_event(bodies, bounds, previous, exceeded)
            moved, impulses, last, accurate = self._solve_events(bodies, event, step, rough=True)
            # bodies that were impacted in an earlier event have been searched again already
            present = bound_motion(model, parameters, moved, rates, last.bounds.common_velocity)
            exceeded = last.is_last & last.bounds.exceeded_by(present, SETTINGS.excess_reach_ratio)
            depth = SETTINGS.missed_depth * parameters.impact_threshold * parameters.time_step
            exceeded |= model.planes.find_missed(moved, end_points, depth, checked)
            if not np.any(exceeded):
                break
            bounds = bounds.widen(exceeded, bound_motion(model, parameters, moved, rates, bounds.common_velocity))
        if not accurate:
            moved, impulses, last, _ = self._solve_events(bodies, event, step, rough=False)
        self._overlaps = last.overlaps
        if obstacle_points is not None:
            self._obstacle_points = obstacle_points.copy()
        return moved, impulses

    def _solve_events(
        self, start: Bodies, first: ImpactEvent, step: ImpactStep, *, rough: bool
    ) -> tuple[Bodies, ContactImpulses, ImpactEvent, bool]:
        """Solve the events of the step from the `first` one on.

        Returns:
            The bodies at the end of the step, the impulses, the last event, and whether the solution is accurate.
        """
        dt, rough = self._parameters.time_step, rough and first.is_last
        untouched, record = np.ones(self._count, bool), ContactImpulses.empty()
        following: ImpactEvent | None = first
        self.contact_error = 0.0
        while following is not None:
            event = following
            force, impulses, accurate = self._solver(event, self._obstacle_points, rough=rough)
            self.contact_error = max(self.contact_error, self._solver.error)
            bodies, record = self._solver.apply_forces(event, force), record.concatenate(impulses)
            untouched &= ~np.any(force, axis=1)
            following = None if event.is_last else step.find_next_event(event, bodies)
        end = fly(self._model, bodies, dt * (1 - event.elapsed))
        # bodies without contact fall on a parabola
        mean_velocity = start.velocity[untouched] + dt * self._parameters.gravity / 2
        end.position[untouched] = start.position[untouched] + dt * mean_velocity
        return end, record, event, accurate

    def find_penetrations(self, bodies: Bodies) -> list[tuple[int, int, float]]:
        """Return (body, body, depth in m) of the deepest contact of every pair that overlaps.

        Overlaps of fragments count beyond what is admitted.
        """
        bounds, checked = no_motion(len(self._obstacle_points), self._count), self._model.planes.begin_step()
        contacts = self._detector(bodies, self._obstacle_points, bounds, self._parameters.time_step, checked)
        gap, _ = self._overlaps(contacts.geoms, contacts.pairs, contacts.gap)
        count = int(contacts.pairs.max(initial=0)) + 1
        codes, row = np.unique(np.sort(contacts.pairs, axis=1) @ np.array([count, 1]), return_inverse=True)
        depth: Values = np.zeros(len(codes))
        np.maximum.at(depth, row, -gap)
        return [
            (int(code) // count, int(code) % count, float(depth[k])) for k, code in enumerate(codes) if depth[k] > 0
        ]


# --- events of a step ---


@dataclass(frozen=True)
class PreviousRound:
    """Result of the previous round of searches.

    Attributes:
        event: as it was found.
        exceeded: (n,) bodies that moved farther than expected; their contacts are searched for again.
        retained: numbers of contacts at the beginning of the event that stay, which come first in the new list.
    """

    event: ImpactEvent
    exceeded: Flags
    retained: Ints


class ImpactStep:
    """Events of one step of the bodies of a model."""

    def __init__(
        self, model: MujocoModel, parameters: ContactParameters, detector: CollisionDetector, obstacle_points: Values,
        checked: CheckedCorners, overlaps: AdmittedOverlaps, family: FamilyFunction | None,
    ) -> None:  # fmt: skip
        """Keep what is known as the step begins.

        Args:
            model: of the bodies.
            parameters: of contact.
            detector: of contacts.
            obstacle_points: (m, 3) reference points of obstacles, m.
            checked: corners above planes that are checked in this step.
            overlaps: admitted overlaps of fragments.
            family: families of bodies that may break; None: nothing breaks.
        """
        self._model, self._parameters, self._detector, self._family = model, parameters, detector, family
        self._obstacle_points, self._checked, self._overlaps = obstacle_points, checked, overlaps
        self._count = len(model.mass)

    def find_first_event(
        self, start: Bodies, bounds: MotionBounds, previous: ImpactEvent | None, exceeded: Flags
    ) -> ImpactEvent:
        """Return the first event of the step.

        Args:
            start: bodies as the step begins.
            bounds: of their motion.
            previous: the event of the previous round, None in the first one.
            exceeded: (n,) bodies that moved farther than expected in that round.
        """
        contacts, same = self._update_contacts(start, bounds, previous.initial_contacts if previous else None, exceeded)
        earlier = PreviousRound(previous, exceeded, same) if previous else None
        if previous is None or previous.is_last:
            conditions = EventConditions(self._parameters.gravity, self._overlaps)
        else:
            conditions = previous.conditions
        event, retained = self._make_event(start, contacts, conditions, bounds, earlier)
        if event.is_last and self._needs_sequence(event):
            events = SETTINGS.max_crowded_events if has_many_contacts(event) else SETTINGS.max_events
            event, retained = self._make_event(start, contacts, event.begin_sequence(events), bounds, earlier)
        if previous:
            # start from the active contacts and the impulses of the previous round
            event.active[: len(retained)] |= previous.active[retained]
            event.active &= ~event.postponed
            event.impulse[: len(retained)] = previous.impulse[retained]
        return event

    def find_next_event(self, event: ImpactEvent, bodies: Bodies) -> ImpactEvent | None:
        """Return the event after one that left the bodies with new velocities; None if there is no further impact."""
        model, parameters, rates = self._model, self._parameters, event.bounds.obstacle_velocity
        present = bound_motion(model, parameters, bodies, rates, event.bounds.common_velocity)
        exceeded = event.bounds.exceeded_by(present, SETTINGS.excess_reach_ratio)
        bounds = bound_motion(model, parameters, bodies, rates)
        contacts, retained = self._update_contacts(bodies, bounds, event.contacts, exceeded)
        conditions = event.conditions.following(event.elapsed, event.overlaps)
        impacted = _carry_over(event.active & event.impacts, retained, len(contacts))
        constraints, _ = self._constrain(contacts, bodies, rates, conditions, event.elapsed, impacted)
        if not np.any(constraints.impact_speed):
            return None
        return self._make_event(bodies, contacts, conditions, bounds, impacted=impacted)[0]

    def _needs_sequence(self, event: ImpactEvent) -> bool:
        """Return whether the step is to be a sequence; with many contacts only for bodies that may break."""
        crowded = has_many_contacts(event)
        if crowded and self._family is None:
            return False
        dt, threshold, constraints = self._parameters.time_step, self._parameters.impact_threshold, event.constraints
        postponed = impacts_later(constraints.gap, constraints.impact_speed, dt, threshold)
        return would_hit_next(event, postponed, threshold * dt, self._count, self._family if crowded else None)

    def _make_event(
        self, start: Bodies, initial: Contacts, conditions: EventConditions, bounds: MotionBounds,
        earlier: PreviousRound | None = None, impacted: Flags | None = None,
    ) -> tuple[ImpactEvent, Ints]:  # fmt: skip
        """Return an event, and the numbers of earlier contacts that stay; these are the first of its contacts.

        Args:
            start: bodies as the event begins.
            initial: k contacts near them.
            conditions: of the event.
            bounds: of the motion.
            earlier: the previous round.
            impacted: (k,) contacts that had an impact in the event before.
        """
        rates = bounds.obstacle_velocity
        constraints, overlaps = self._constrain(initial, start, rates, conditions, conditions.elapsed, impacted)
        elapsed = self._flight_fractions(constraints, initial, conditions)
        in_flight = elapsed > conditions.elapsed_or_zero
        time = self._parameters.time_step * (elapsed - conditions.elapsed_or_zero)
        velocity_gain = time[:, None] * conditions.gravity
        bodies = self._fly(start, time, velocity_gain) if np.any(in_flight) else start
        contacts, retained = self._find_near(bodies, initial, bounds, elapsed, in_flight, earlier)
        if np.any(in_flight):
            # bodies at rest sank into what supports them while they flew
            lift = sinking_corrections(initial, contacts, in_flight & conditions.is_first)
            bodies = replace(bodies, position=bodies.position + lift)
            falling = replace(bodies, velocity=bodies.velocity + velocity_gain)
            gaps = corrected_gaps(contacts, lift)
            impacted = None if impacted is None else _carry_over(impacted, retained, len(contacts))
            past, lifted = elapsed if conditions.in_sequence else None, replace(contacts, gap=gaps)
            constraints, overlaps = self._constrain(lifted, falling, rates, conditions, past, impacted)
        return ImpactEvent(conditions, bounds, initial, bodies, elapsed, contacts, constraints, overlaps), retained

    def _flight_fractions(
        self, constraints: ContactConstraints, contacts: Contacts, conditions: EventConditions
    ) -> Values:
        """Return the shares (n,) of the step at which bodies are impacted."""
        if conditions.elapsed is None:
            return flight_fractions(constraints, contacts.pairs, self._count)
        near = self._parameters.impact_threshold * self._parameters.time_step
        return joint_flight_fractions(constraints, contacts.pairs, conditions.elapsed, near)

    def _fly(self, start: Bodies, time: Values, velocity_gain: Values) -> Bodies:
        """Return the bodies after times (n,), s, in which they gain velocities (n, 3), m/s.

        Positions include the gain, velocities do not: the gain is applied with the contact forces.
        """
        flying = replace(start, velocity=start.velocity + velocity_gain / 2)
        return replace(fly(self._model, flying, time), velocity=start.velocity)

    def _find_near(
        self, bodies: Bodies, initial: Contacts, bounds: MotionBounds, elapsed: Values, in_flight: Flags,
        earlier: PreviousRound | None,
    ) -> tuple[Contacts, Ints]:  # fmt: skip
        """Return the contacts near bodies at their impacts, and the numbers of earlier contacts that stay."""
        if earlier is None:
            return self._update_contacts(bodies, bounds, initial, in_flight)
        event = earlier.event
        if event.contacts is event.initial_contacts and not np.any(in_flight):
            return initial, earlier.retained
        return self._update_contacts(bodies, bounds, event.contacts, earlier.exceeded | (elapsed != event.elapsed))

    def _update_contacts(
        self, bodies: Bodies, bounds: MotionBounds, contacts: Contacts | None, changed: Flags
    ) -> tuple[Contacts, Ints]:
        """Return the contacts with those of the bodies `changed` (n,) searched for again, and which of them stay.

        Those that stay come first. With many bodies only few of them change, so that a full search is avoided.
        """
        if contacts is None:
            return self._search(bodies, bounds), np.empty(0, np.int64)
        unchanged = np.append(~changed, np.ones(len(bounds.obstacle_velocity), bool))
        retained = np.flatnonzero(contacts.both_flagged(unchanged))
        if not np.any(changed):
            return contacts, retained
        return contacts.select(retained).concatenate(self._search(bodies, bounds, changed)), retained

    def _search(self, bodies: Bodies, bounds: MotionBounds, chosen: Flags | None = None) -> Contacts:
        """Return the contacts that may close in the step, of all bodies or of those `chosen` (n,)."""
        dt = self._parameters.time_step
        return self._detector(bodies, self._obstacle_points, bounds, dt, self._checked, chosen, self._overlaps)

    def _constrain(
        self, contacts: Contacts, bodies: Bodies, rates: Values, conditions: EventConditions, elapsed: Values | None,
        impacted: Flags | None,
    ) -> tuple[ContactConstraints, AdmittedOverlaps]:  # fmt: skip
        """Return the constraints at contacts, and the overlaps that are admitted after them.

        Args:
            contacts: k of them.
            bodies: n of them, with their velocities.
            rates: (m, 3) velocities of obstacles, m/s.
            conditions: of the event.
            elapsed: (n,) shares of the step in a sequence; None: the step has one event.
            impacted: (k,) contacts that had an impact in the event before; they have none now.
        """
        parameters, motion = self._parameters, velocities_of_all(bodies, rates)
        dt, threshold, restitution = parameters.time_step, parameters.impact_threshold, parameters.restitution
        gap, overlaps = conditions.overlaps(contacts.geoms, contacts.pairs, contacts.gap)
        speeds = contacts.approach_speeds(*motion)
        if elapsed is None:
            return make_constraints(gap, speeds, dt, threshold, restitution), overlaps
        gap, approach, remaining = elapsed_approach(contacts, gap, motion, rates, elapsed, dt)
        candidates = speeds > max(threshold, conditions.min_impact_speed)
        if impacted is not None:
            candidates &= ~impacted
        return (
            make_event_constraints(gap, speeds, dt, threshold, restitution, approach, remaining, candidates),
            overlaps,
        )


def _carry_over(flags: Flags, retained: Ints, count: int) -> Flags:
    """Return flags (count,) of a new list of contacts, of which the first ones are those retained of the old list."""
    result = np.zeros(count, bool)
    result[: len(retained)] = flags[retained]
    return result


# --- bodies at rest that sink in before an impact ---


def sinking_corrections(before: Contacts, after: Contacts, flew: Flags) -> Values:
    """Return the translations (n, 3), m, that set bodies which flew (n,) back onto their support.

    They are moved along the normal of the obstacle by what their deepest contact is deeper than any was before.
    """
    # A body flies freely up to its impact, also into what it approaches more slowly than c_0, by up to c_0 dt. Its
    # velocity stays, so that only the work of its weight, which was too large, is corrected.
    count = len(flew)
    depth: Values = np.zeros(count)
    rows, body, _ = _obstacle_contacts(before, flew)
    np.maximum.at(depth, body, -before.gap[rows])
    rows, body, sign = _obstacle_contacts(after, flew)
    sunk = -after.gap[rows] - depth[body]
    # the deepest contact of a body is written last
    order = np.argsort(sunk, kind="stable")
    order = order[sunk[order] > 0]
    lift: Values = np.zeros((count, 3))
    lift[body[order]] = (sunk * sign)[order, None] * after.axes[rows[order], 0]
    return lift


def _obstacle_contacts(contacts: Contacts, flew: Flags) -> tuple[Ints, Ints, Values]:
    """Return numbers (k,) of contacts of bodies that flew with obstacles, these bodies (k,), and signs (k,).

    The sign is 1 where the normal points to the body, -1 where it points away from it.
    """
    count, (first, second) = len(flew), contacts.pairs.T
    body = np.minimum(first, second)
    with_obstacle = np.maximum(first, second) >= count
    rows = np.flatnonzero(with_obstacle & np.append(flew, False)[np.minimum(body, count)])
    return rows, body[rows], np.where(second[rows] < count, 1.0, -1.0)


def corrected_gaps(contacts: Contacts, lift: Values) -> Values:
    """Return the gaps (k,), m, after bodies were moved by `lift` (n, 3), m."""
    if not np.any(lift):
        return contacts.gap
    pairs = np.minimum(contacts.pairs, len(lift))
    moved = np.append(lift, np.zeros((1, 3)), axis=0)[pairs]
    return np.asarray(contacts.gap + np.einsum("ki,ki->k", moved[:, 1] - moved[:, 0], contacts.axes[:, 0]))
