"""Blows and loads: which contacts of a step cause an analysis, and the forces in it (docs/theory.md#blows-and-loads).

A blow is a contact of bodies that approach faster than resting contact explains, 2 g dt. Its impulse J falls into one
step, and acts over a time tau (Hertz's, or that of the study) as the force J / tau. A blow is passed on: a body under
a blow gives a blow to others that it pushes harder than before. Forces f that pushed it before remain,

    force = (J - dt f) / tau + f,   J = all impulses that it received in the step,

so that the force does not depend on the step. A load is any other contact, with the force that it has.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from .bodies import Bodies
from .contact_points import ContactImpulses

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

# Durations (k,), s, of impacts of bodies (k,) and (k,) at speeds (k,), m/s.
DurationFunction = Callable[[Ints, Ints, Values], Values]
# a^3 / F (k,), m^3/N, of contacts of bodies (k,) and (k,).
RadiusFunction = Callable[[Ints, Ints], Values]


@dataclass(frozen=True)
class DetectionSettings:
    """Numbers that tell blows from loads.

    Attributes:
        blow_factor: multiple of the impulse of the step before above which a contact passes a blow on.
        settling_steps: steps after a blow in which contacts are not analysed as loads.
        load_growth: multiple of the largest load so far above which a load is analysed again.
        first_obstacle_name: above all names of bodies; prescribed obstacles are named by their numbers from here on.
        max_steps: count of steps since the last blow of a body that had none.
    """

    blow_factor: float = 2.0
    settling_steps: int = 5
    load_growth: float = 1.1
    first_obstacle_name: int = 2**30
    max_steps: int = 2**30


SETTINGS = DetectionSettings()


@dataclass(frozen=True)
class BodyLoad:
    """Forces on one body that are to be analysed.

    Attributes:
        body_number: its number.
        points: (k, 3) points of the body at rest, m.
        force: (k, 3) in the axes at rest, N.
        circle_radii: (k,) radii of the circles that the forces press on, m.
        speed: of approach in a blow, m/s; 0 for a load.
        duration: of the blow, s.
    """

    body_number: int
    points: Values
    force: Values
    circle_radii: Values
    speed: float = 0.0
    duration: float = 0.0

    def available_energy(self, impact_energy: float) -> float:
        """Return the energy, J, that flow may dissipate.

        It is the energy of the impacts of the body. For a blow that was passed on it is that of its largest impulse
        at its speed; for a load it is infinite.
        """
        if not self.speed:
            return float("inf")
        largest_impulse = self.duration * float(np.linalg.norm(self.force, axis=1).max())
        return impact_energy or largest_impulse * self.speed / 2


@dataclass
class _History:
    """Contacts and loads of earlier steps.

    Attributes:
        names: (n,) of the bodies, ascending.
        steps_since_blow: (n,).
        largest_load: (n,) largest load that was analysed, N.
        pairs: (k,) codes of pairs of bodies that touched in the last step, ascending.
        pair_impulse: (k,) impulses of these pairs, N s.
        receiver: (m,) names of bodies that received an impulse in the last step.
        points: (m, 3) where, at rest, m.
        impulses: (m, 3) in the axes at rest, N s.
        radius_cubed_per_force: (m,) m^3/N.
    """

    names: Ints
    steps_since_blow: Ints
    largest_load: Values
    pairs: Ints
    pair_impulse: Values
    receiver: Ints
    points: Values
    impulses: Values
    radius_cubed_per_force: Values

    @classmethod
    def empty(cls) -> _History:
        """Return the history before the first step."""
        numbers, values, vectors = np.empty(0, np.int64), np.empty(0), np.empty((0, 3))
        return cls(numbers, numbers, values, numbers, values, numbers, vectors, vectors, values)


# Names of the arrays of the history in a checkpoint.
STORED_NAMES = {
    "names": "names", "steps_since_blow": "quiet", "largest_load": "borne", "pairs": "pairs", "pair_impulse": "pushed",
    "receiver": "on", "points": "where", "impulses": "gave", "radius_cubed_per_force": "spread",
}  # fmt: skip


class ImpactDetector:
    """Finds the blows and loads of each step from its contact impulses and those of the step before.

    Bodies are known by names that do not change.
    """

    def __init__(
        self, dt: float, threshold: float, duration: DurationFunction, radius_cubed_per_force: RadiusFunction
    ) -> None:
        """Begin without a history.

        Args:
            dt: s.
            threshold: m/s; an impulse passes no blow on if it is smaller than this times the mass of the lighter body.
            duration: of impacts.
            radius_cubed_per_force: of contacts.
        """
        self._dt, self._threshold, self._duration = dt, threshold, duration
        self._radius_cubed_per_force = radius_cubed_per_force
        self._history = _History.empty()
        self._contacts: _StepContacts | None = None

    def find_loads(self, impulses: ContactImpulses, bodies: Bodies, names: Ints) -> list[BodyLoad]:
        """Return the blows and then the loads of a step.

        `bodies`: as the step began; `names`: (n,) theirs, ascending.
        """
        self._update_names(names)
        contacts = self._collect(impulses, bodies, names)
        speed, duration = self._find_blows(contacts, bodies, names)
        history, n = self._history, len(names)
        history.steps_since_blow = np.where(speed > 0, 0, np.minimum(history.steps_since_blow + 1, SETTINGS.max_steps))
        received = contacts.received
        size = np.linalg.norm(received.impulses, axis=1) / self._dt
        load = np.bincount(received.body, size, n)
        settled = history.steps_since_blow > SETTINGS.settling_steps
        loaded = settled & (load > SETTINGS.load_growth * history.largest_load)
        history.largest_load[loaded] = load[loaded]
        under_blow, under_load = np.flatnonzero(speed), np.flatnonzero(loaded)
        new_rows = _rows_of(received.body, under_blow)
        old_rows = _rows_of(history.receiver, names[under_blow])
        load_rows = _rows_of(received.body, under_load)
        loads = []
        for body, new, old in zip(map(int, under_blow), new_rows, old_rows, strict=True):
            loads.append(self._make_blow(received, body, new, old, float(speed[body]), float(duration[body])))
        for body, rows in zip(map(int, under_load), load_rows, strict=True):
            force = np.asarray(received.impulses[rows] / self._dt)
            radii = _circle_radii(received.radius_cubed_per_force[rows], force)
            loads.append(BodyLoad(body, received.points[rows], force, radii))
        return loads

    def record_step(self, impulses: ContactImpulses, bodies: Bodies, names: Ints) -> None:
        """Keep the final impulses of a step, for comparison with the next one."""
        self._update_names(names)
        history, contacts = self._history, self._collect(impulses, bodies, names)
        received = contacts.received
        history.pairs, history.pair_impulse = contacts.pairs, contacts.pair_impulse
        history.receiver, history.points = names[received.body], received.points
        history.impulses, history.radius_cubed_per_force = received.impulses, received.radius_cubed_per_force

    def forget_bodies(self, names: Ints) -> None:
        """Forget bodies of the names (k,), which have broken; a fragment may have the name of its body."""
        forgotten = np.isin(self._history.names, names)
        self._history.steps_since_blow[forgotten], self._history.largest_load[forgotten] = 0, 0.0

    def _update_names(self, names: Ints) -> None:
        """Keep the history of the present bodies; a new body has just had a blow."""
        history = self._history
        if np.array_equal(history.names, names):
            return
        is_first_step = not len(history.names)
        _, new, old = np.intersect1d(names, history.names, assume_unique=True, return_indices=True)
        steps, load = np.full(len(names), SETTINGS.max_steps if is_first_step else 0), np.zeros(len(names))
        steps[new], load[new] = history.steps_since_blow[old], history.largest_load[old]
        history.names, history.steps_since_blow, history.largest_load = names.copy(), steps, load

    # --- checkpoints ---

    def to_checkpoint(self) -> dict[str, npt.NDArray[Any]]:
        """Return the arrays that a checkpoint stores."""
        return {f"known.{STORED_NAMES[name]}": values for name, values in vars(self._history).items()}

    def from_checkpoint(self, arrays: dict[str, npt.NDArray[Any]]) -> None:
        """Restore the history that `to_checkpoint` stored."""
        self._history = _History(**{name: arrays[f"known.{stored}"] for name, stored in STORED_NAMES.items()})

    # --- blows ---

    def _collect(self, impulses: ContactImpulses, bodies: Bodies, names: Ints) -> _StepContacts:
        """Return the contacts of a step; `record_step` uses those of `find_loads` if nothing broke."""
        contacts = self._contacts
        if contacts is None or contacts.record is not impulses or contacts.bodies is not bodies:
            received = _received_at_rest(impulses, bodies, self._radius_cubed_per_force)
            self._contacts = contacts = _StepContacts(impulses, bodies, *_sum_by_pairs(impulses, names), received)
        return contacts

    def _find_blows(self, contacts: _StepContacts, bodies: Bodies, names: Ints) -> tuple[Values, Values]:
        """Return speeds (n,), m/s, and durations (n,), s, of the blows that bodies are under; 0 without a blow."""
        n, history = len(names), self._history
        code, approach_speed, impulse = contacts.pairs, contacts.approach_speed, contacts.pair_impulse
        first_obstacle = SETTINGS.first_obstacle_name
        pair_names = np.stack(np.divmod(code, 2 * first_obstacle), axis=1)
        is_body = pair_names < first_obstacle
        pairs = np.where(is_body, np.searchsorted(names, pair_names), n + pair_names - first_obstacle)
        before: Values = np.zeros(len(code))
        if len(history.pairs):
            row = np.minimum(np.searchsorted(history.pairs, code), max(len(history.pairs) - 1, 0))
            before = np.where(history.pairs[row] == code, history.pair_impulse[row], 0.0)
        lighter_mass = np.append(bodies.mass, np.inf)[np.minimum(pairs, n)].min(axis=1)
        passes_on = impulse > SETTINGS.blow_factor * before + lighter_mass * self._threshold
        speed, duration = np.zeros((2, n + 1))
        meets = approach_speed > 0
        self._apply_impacts(pairs[meets], approach_speed[meets], speed, duration)
        links = np.minimum(pairs[passes_on], n)
        # pass blows on to bodies that have none, until there are none left
        while True:
            under_blow = (speed > 0)[links]
            new = under_blow[:, 0] != under_blow[:, 1]
            new &= np.where(under_blow[:, 0], links[:, 1], links[:, 0]) < n
            if not new.any():
                return speed[:n], duration[:n]
            source = np.where(under_blow[new, 0], *links[new].T)
            target = links[new].sum(axis=1) - source
            # of several blows the fastest is written last
            order = np.argsort(speed[source], kind="stable")
            speed[target[order]], duration[target[order]] = speed[source[order]], duration[source[order]]

    def _apply_impacts(self, pairs: Ints, approach_speed: Values, speed: Values, duration: Values) -> None:
        """Write the fastest impact of each body of pairs (k, 2) into `speed` and `duration` (n + 1,)."""
        n = len(speed) - 1
        order = np.argsort(approach_speed, kind="stable")
        pairs, approach_speed = pairs[order], approach_speed[order]
        durations = self._duration(pairs[:, 0], pairs[:, 1], approach_speed)
        for body in np.minimum(pairs, n).T:
            faster = approach_speed >= speed[body]
            speed[body[faster]], duration[body[faster]] = approach_speed[faster], durations[faster]
        # the last entry stands for all obstacles
        speed[n] = 0.0

    def _make_blow(
        self, received: _Received, body: int, new: Ints, old: Ints, speed: float, duration: float
    ) -> BodyLoad:
        """Return a blow of the impulses `new` of this step, and `old` of the last one, which remain as forces."""
        history = self._history
        remaining = history.impulses[old] * (1 / self._dt - 1 / duration)
        force = np.concatenate([received.impulses[new] / duration, remaining])
        points = np.concatenate([received.points[new], history.points[old]])
        ratio = np.concatenate([received.radius_cubed_per_force[new], history.radius_cubed_per_force[old]])
        return BodyLoad(body, points, force, _circle_radii(ratio, force), speed, duration)


def _rows_of(numbers: Ints, wanted: Ints) -> list[Ints]:
    """Return for each wanted number (w,) the rows of `numbers` (k,) that have it."""
    order = np.argsort(numbers, kind="stable")
    first = np.searchsorted(numbers[order], wanted)
    last = np.searchsorted(numbers[order], wanted, side="right")
    return [order[a:b] for a, b in zip(first, last, strict=True)]


def _circle_radii(radius_cubed_per_force: Values, force: Values) -> Values:
    """Return radii (k,), m, of the contact circles of forces (k, 3), N."""
    return np.asarray(np.cbrt(radius_cubed_per_force * np.linalg.norm(force, axis=1)))


@dataclass(frozen=True)
class _Received:
    """Impulses (m) that bodies received in a step.

    Attributes:
        body: (m,) numbers.
        points: (m, 3) of the body at rest, m.
        impulses: (m, 3) in the axes at rest, N s.
        radius_cubed_per_force: (m,) m^3/N.
    """

    body: Ints
    points: Values
    impulses: Values
    radius_cubed_per_force: Values


@dataclass(frozen=True)
class _StepContacts:
    """Contacts of a step, summed by pairs of bodies.

    Attributes:
        record: of the impulses.
        bodies: as the step began.
        pairs: (p,) codes of pairs that touch, ascending.
        approach_speed: (p,) fastest impact of each pair, m/s.
        pair_impulse: (p,) sum of the impulses of each pair, N s.
        received: impulses of bodies.
    """

    record: ContactImpulses
    bodies: Bodies
    pairs: Ints
    approach_speed: Values
    pair_impulse: Values
    received: _Received


def _sum_by_pairs(impulses: ContactImpulses, names: Ints) -> tuple[Ints, Values, Values]:
    """Return codes (p,) of pairs, ascending, their fastest impacts (p,), m/s, and their impulses (p,), N s."""
    pairs = np.stack([impulses.first, impulses.second], axis=1)
    obstacle_names = SETTINGS.first_obstacle_name + np.arange(int(pairs.max(initial=0)) + 1)
    pair_names = np.sort(np.concatenate([names, obstacle_names])[pairs], axis=1)
    code, row = np.unique(pair_names @ np.array([2 * SETTINGS.first_obstacle_name, 1]), return_inverse=True)
    approach_speed: Values = np.zeros(len(code))
    np.maximum.at(approach_speed, row, impulses.approach_speed)
    total = np.bincount(row, np.linalg.norm(impulses.impulse, axis=1), len(code))
    return code, approach_speed, total.astype(float)


def _received_at_rest(impulses: ContactImpulses, bodies: Bodies, radius_cubed_per_force: RadiusFunction) -> _Received:
    """Return the impulses that bodies received, at points and in axes at rest."""
    numbers = np.concatenate([impulses.first, impulses.second])
    is_body = numbers < len(bodies)
    body, points = numbers[is_body], np.tile(impulses.point, (2, 1))[is_body]
    impulse = np.concatenate([-impulses.impulse, impulses.impulse])[is_body]
    rotation = bodies.rotation[body]
    arm = np.einsum("kji,kj->ki", rotation, points - bodies.position[body])
    ratio = np.tile(radius_cubed_per_force(impulses.first, impulses.second), 2)[is_body]
    return _Received(body, arm + bodies.centre[body], np.einsum("kji,kj->ki", rotation, impulse), ratio)
