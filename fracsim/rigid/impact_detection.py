"""What of contact is a blow, and what a load (docs/theory.md#blows-and-loads).

A blow: two things meet faster than resting contact explains, 2 g dt. Its impulse J, which falls into one step, acts
over a time tau (Hertz's, or what the study says), as the force J / tau. It is passed on: what a struck body then pushes
harder than it did, it strikes. What a struck body was pushed by before, f, goes on pushing,

    force = (J - dt f) / tau + f,   J = all that it received in the step,

so that the step does not matter. A load: any other contact, with the force that it has.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from .bodies import Bodies
from .contact_records import Touches

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

HARDER = 2.0  # times the push before, that a struck body gives on as a blow
SETTLED = 5  # steps after a blow from which on contact is a load again
GROWN = 1.1  # times the greatest load so far: it is looked at again
STANDS = 2**30  # above all names of bodies: what stands in their way is known by its number beyond
NEVER = 2**30  # steps since a body was struck that never was

Time = Callable[[Ints, Ints, Values], Values]  # s of things (k,) and (k,) that meet at speeds (k,), m/s
Spread = Callable[[Ints, Ints], Values]  # (k,) a^3 / F of where things (k,) and (k,) touch, m^3/N


@dataclass(frozen=True)
class Strain:
    """What strains a body.

    Attributes:
        body: its number.    points, force: (k, 3) where and what, of the body at rest, m and N.
        radius: (k,) of the circles that the forces press on, m.
        speed: of approach, m/s; 0 of a load.    time: s that a blow lasts.
    """

    body: int
    points: Values
    force: Values
    radius: Values
    speed: float = 0.0
    time: float = 0.0

    def energy(self, met: float) -> float:
        """J that it may spend: what came in where the body met something; of a blow that was passed on that of its
        greatest impulse at its speed; of a load no end."""
        if not self.speed:
            return float("inf")
        greatest = self.time * float(np.linalg.norm(self.force, axis=1).max())
        return met or greatest * self.speed / 2


@dataclass
class _Known:
    """Of bodies by their names (n,), ascending: steps that they were not struck for, the greatest load that was looked
    at, N; of the last step, by the codes of pairs of things (k,), ascending, what they gave one another, N s, and what
    the bodies `on` (m,) received, `gave` (m, 3) N s at points `where` (m, 3), m, in their axes at rest, and how it
    `spread` (m,), m^3/N."""

    names: Ints
    quiet: Ints
    borne: Values
    pairs: Ints
    pushed: Values
    on: Ints
    where: Values
    gave: Values
    spread: Values

    @classmethod
    def nothing(cls) -> _Known:
        """Before the first step."""
        none, no, nowhere = np.empty(0, np.int64), np.empty(0), np.empty((0, 3))
        return cls(none, none, no, none, no, none, nowhere, nowhere, no)


class Blows:
    """Watches contacts from step to step; bodies are known by names that stay with them."""

    def __init__(self, step: float, fast: float, time: Time, spread: Spread) -> None:
        """`step`: s; `fast`: what pushes by less, times the mass of the lighter thing, passes no blow on, m/s."""
        self._step, self._fast, self._time, self._spread = step, fast, time, spread
        self._known = _Known.nothing()
        self._seen: _Seen | None = None

    def look(self, touches: Touches, bodies: Bodies, names: Ints) -> list[Strain]:
        """The strains of a step that began with these bodies, by their names (n,), ascending."""
        self._align(names)
        seen = self._see(touches, bodies, names)
        speed, time = self._struck(seen, bodies, names)
        known, n = self._known, len(names)
        known.quiet = np.where(speed > 0, 0, np.minimum(known.quiet + 1, NEVER))
        received = seen.received
        size = np.linalg.norm(received.impulses, axis=1) / self._step
        borne = np.bincount(received.body, size, n)
        loaded = (known.quiet > SETTLED) & (borne > GROWN * known.borne)
        known.borne[loaded] = borne[loaded]
        struck, pressed = np.flatnonzero(speed), np.flatnonzero(loaded)
        new, before, rows = (
            _rows(received.body, struck), _rows(known.on, names[struck]), _rows(received.body, pressed)
        )  # fmt: skip
        due = [self._blow(received, int(each), new[k], before[k], float(speed[each]), float(time[each]))
               for k, each in enumerate(struck)]  # fmt: skip
        return due + [self._load(received, int(each), rows[k]) for k, each in enumerate(pressed)]

    def keep(self, touches: Touches, bodies: Bodies, names: Ints) -> None:
        """What a step came to in the end, for the next one to compare with."""
        self._align(names)
        known, seen = self._known, self._see(touches, bodies, names)
        known.pairs, known.pushed, received = seen.pairs, seen.push, seen.received
        known.on, known.where = names[received.body], received.points
        known.gave, known.spread = received.impulses, received.spread

    def forget(self, names: Ints) -> None:
        """Bodies of these names are no more."""
        gone = np.isin(self._known.names, names)
        self._known.quiet[gone], self._known.borne[gone] = 0, 0.0

    def _align(self, names: Ints) -> None:
        """Know the bodies that there are; a new one has just been struck."""
        known = self._known
        if np.array_equal(known.names, names):
            return
        first = not len(known.names)
        _, new, old = np.intersect1d(names, known.names, assume_unique=True, return_indices=True)
        quiet, borne = np.full(len(names), NEVER if first else 0), np.zeros(len(names))
        quiet[new], borne[new] = known.quiet[old], known.borne[old]
        known.names, known.quiet, known.borne = names.copy(), quiet, borne

    # --- a checkpoint ---

    def saved(self) -> dict[str, npt.NDArray[Any]]:
        """What a checkpoint keeps."""
        return {f"known.{name}": values for name, values in vars(self._known).items()}

    def restore(self, saved: dict[str, npt.NDArray[Any]]) -> None:
        """Be as `saved` said."""
        self._known = _Known(**{name: saved[f"known.{name}"] for name in vars(self._known)})

    # --- who is struck ---

    def _see(self, touches: Touches, bodies: Bodies, names: Ints) -> _Seen:
        """What a step did, which is looked at and, where nothing breaks, kept."""
        seen = self._seen
        if seen is None or seen.touches is not touches or seen.bodies is not bodies:
            received = _at_rest(touches, bodies, self._spread)
            self._seen = seen = _Seen(touches, bodies, *_by_pairs(touches, names), received)
        return seen

    def _struck(self, seen: _Seen, bodies: Bodies, names: Ints) -> tuple[Values, Values]:
        """(n + 1,) speed of the blow that bodies are under, m/s, 0 of none, and (n + 1,) its time, s."""
        n, known = len(names), self._known
        code, closing, push = seen.pairs, seen.closing, seen.push
        pairs = np.stack([code // (2 * STANDS), code % (2 * STANDS)], axis=1)
        things = np.where(pairs < STANDS, np.searchsorted(names, pairs), n + pairs - STANDS)
        at = np.minimum(np.searchsorted(known.pairs, code), max(len(known.pairs) - 1, 0))
        before = np.where(known.pairs[at] == code, known.pushed[at], 0.0) if len(known.pairs) else np.zeros(len(code))
        light = np.append(bodies.mass, np.inf)[np.minimum(things, n)].min(axis=1)
        hard = push > HARDER * before + light * self._fast
        speed, time = np.zeros((2, n + 1))
        fast = closing > 0
        self._hit(things[fast], closing[fast], speed, time)
        links = np.minimum(things[hard], n)
        while True:
            under = (speed > 0)[links]
            news = under[:, 0] != under[:, 1]
            news &= np.where(under[:, 0], links[:, 1], links[:, 0]) < n
            if not news.any():
                return speed[:n], time[:n]
            source = np.where(under[news, 0], *links[news].T)
            target = links[news].sum(axis=1) - source
            order = np.argsort(speed[source], kind="stable")
            speed[target[order]], time[target[order]] = speed[source[order]], time[source[order]]

    def _hit(self, things: Ints, closing: Values, speed: Values, time: Values) -> None:
        """Bodies of pairs (k, 2) that meet are under the fastest of their blows."""
        n = len(speed) - 1
        order = np.argsort(closing, kind="stable")
        things, closing = things[order], closing[order]
        lasting = self._time(things[:, 0], things[:, 1], closing)
        for body in np.minimum(things, n).T:
            harder = closing >= speed[body]
            speed[body[harder]], time[body[harder]] = closing[harder], lasting[harder]
        speed[n] = 0.0

    # --- strains ---

    def _blow(self, received: _Received, body: int, new: Ints, before: Ints, speed: float, time: float) -> Strain:
        """Of rows `new` of what was received, and rows `before` of what is known."""
        still = self._known.gave[before] * (1 / self._step - 1 / time)
        force = np.concatenate([received.impulses[new] / time, still])
        points = np.concatenate([received.points[new], self._known.where[before]])
        spread = np.concatenate([received.spread[new], self._known.spread[before]])
        return Strain(body, points, force, _radius(spread, force), speed, time)

    def _load(self, received: _Received, body: int, mine: Ints) -> Strain:
        force = np.asarray(received.impulses[mine] / self._step)
        return Strain(body, received.points[mine], force, _radius(received.spread[mine], force))


def _rows(of: Ints, wanted: Ints) -> list[Ints]:
    """Of each that is wanted (w,), where it stands among so many (k,)."""
    order = np.argsort(of, kind="stable")
    first = np.searchsorted(of[order], wanted)
    last = np.searchsorted(of[order], wanted, side="right")
    return [order[a:b] for a, b in zip(first, last, strict=True)]


def _radius(spread: Values, force: Values) -> Values:
    """(k,) m, of forces (k, 3) that spread so."""
    return np.asarray(np.cbrt(spread * np.linalg.norm(force, axis=1)))


@dataclass(frozen=True)
class _Received:
    """What bodies (m,) received in a step: impulses (m, 3) at points (m, 3) of theirs at rest, N s and m, and how they
    `spread` (m,), m^3/N."""

    body: Ints
    points: Values
    impulses: Values
    spread: Values


@dataclass(frozen=True)
class _Seen:
    """What touched among bodies in a step: codes `pairs` (p,), ascending, the fastest meeting of each `closing` (p,) in
    m/s, what it gave, `push` (p,) in N s, and what the bodies `received`."""

    touches: Touches
    bodies: Bodies
    pairs: Ints
    closing: Values
    push: Values
    received: _Received


def _by_pairs(touches: Touches, names: Ints) -> tuple[Ints, Values, Values]:
    """Codes (p,) of pairs that touch, ascending; the fastest meeting of each in m/s, and what it gave in N s."""
    both = np.stack([touches.first, touches.second], axis=1)
    known = np.concatenate([names, STANDS + np.arange(int(both.max(initial=0)) + 1)])
    both = np.sort(known[both], axis=1)
    code, place = np.unique(both @ np.array([2 * STANDS, 1]), return_inverse=True)
    closing: Values = np.zeros(len(code))
    np.maximum.at(closing, place, touches.closing)
    push = np.bincount(place, np.linalg.norm(touches.impulse, axis=1), len(code))
    return code, closing, push.astype(float)


def _at_rest(touches: Touches, bodies: Bodies, spread: Spread) -> _Received:
    """What the bodies received, in their axes at rest."""
    things = np.concatenate([touches.first, touches.second])
    mine = things < len(bodies)
    body, points = things[mine], np.tile(touches.point, (2, 1))[mine]
    impulse = np.concatenate([-touches.impulse, touches.impulse])[mine]
    turn = bodies.turn[body]
    arm = np.einsum("kji,kj->ki", turn, points - bodies.place[body])
    wide = np.tile(spread(touches.first, touches.second), 2)[mine]
    return _Received(body, arm + bodies.centre[body], np.einsum("kji,kj->ki", turn, impulse), wide)
