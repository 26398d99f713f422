"""What of contact is a blow, and what a load (METHOD section 10).

A blow: two things come together faster than resting contact explains, 2 g dt. Its impulse J, however many steps the
engine takes for it, acts over a time tau (Hertz's, or what the study says), as the force J / tau. It is passed on: what
a struck body then pushes harder than it did, it strikes. What a struck body was pushed by before, f, goes on pushing,

    force = (sum over the blow of dt f_k - T f) / tau + f,   T = sum over the blow of dt,

so that the step does not matter. It is over where the two that met no longer come together and hardly push one another
any more. A load: any other contact, with the force that it has.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from .bodies import Bodies
from .touches import Touches

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Pair = tuple[int, int]  # of things, the lower first

SLOW = 1e-3  # m/s: what comes together slower than this strikes nothing, whatever the step
HARDER = 2.0  # times the push before, that a struck body gives on as a blow
SPENT = 0.1  # of its hardest push in a step: what the two that met still give one another where a blow is over
LONGEST = 100  # steps of a blow, at most
SETTLED = 5  # steps after a blow from which on contact is a load again
GROWN = 1.1  # times the greatest load so far: it is looked at again

Time = Callable[[int, int, float], float]  # of two things that meet at a speed (m/s), s


@dataclass
class _Meeting:
    """Two things that came together fast: who they are, how long the blow lasts, s, how fast they were, m/s, the
    hardest push in a step so far, N s, and whether it is over."""

    pair: tuple[int, int]
    time: float
    speed: float
    hardest: float = 0.0
    over: bool = False

    def look(self, closing: float, push: float, fast: float) -> None:
        """After a step in which the two had this approach and push; `fast`: what is."""
        self.hardest = max(self.hardest, push)
        self.over = closing <= fast and push <= SPENT * self.hardest


@dataclass
class _Struck:
    """A body under a blow: what struck it, what pushed it before, and impulses since, at points of the body at rest."""

    meeting: _Meeting
    before: tuple[Values, Values]
    points: list[Values] = field(default_factory=list)
    impulses: list[Values] = field(default_factory=list)
    steps: int = 0


@dataclass(frozen=True)
class Strain:
    """What strains a body.

    Attributes:
        body: its number.    points, force: (k, 3) where and what, of the body at rest, m and N.
        speed: of approach, m/s; 0 of a load.    time: s that a blow lasts.
    """

    body: int
    points: Values
    force: Values
    speed: float = 0.0
    time: float = 0.0


class Blows:
    """Watches contacts from step to step; bodies are known by names that stay with them."""

    def __init__(self, step: float, gravity: float, time: Time) -> None:
        """`step`: s; `gravity`: its size, m/s^2."""
        self._step, self._time = step, time
        self._fast = max(2 * gravity * step, SLOW)
        self._struck: dict[int, _Struck] = {}
        self._quiet: dict[int, int] = {}  # steps since a body was struck last
        self._borne: dict[int, float] = {}  # greatest load that was looked at, N
        self._last: tuple[Touches, Bodies, Ints] | None = None  # of the step before
        self._pushed: dict[tuple[int, int], float] = {}  # what pairs gave one another before, N s

    def look(self, touches: Touches, bodies: Bodies, names: Ints) -> list[Strain]:
        """The strains that are due after a step that began with these bodies, by their names (n,)."""
        n, mass = len(bodies), np.append(bodies.mass, np.inf)
        pairs, closing, push = _by_pairs(touches)
        light = mass[np.minimum(np.array(pairs, np.int64).reshape(-1, 2), n)].min(axis=1)
        before = np.array([self._pushed.get(self._key(pair, names), 0.0) for pair in pairs])
        fast, hard = closing > self._fast, push > HARDER * before + light * self._fast
        self._strike(pairs, closing, fast, hard, names)
        seen = {self._key(pair, names): each for pair, *each in zip(pairs, closing, push, strict=True)}
        for blow in self._struck.values():
            found = seen.get(blow.meeting.pair, [-np.inf, 0.0])
            blow.meeting.look(float(found[0]), float(found[1]), self._fast)
        due = self._go_on(touches, bodies, names)
        due += self._loads(touches, bodies, names)
        for pair, much in zip(pairs, push, strict=True):
            if not any(self._name(thing, names) in self._struck for thing in pair):
                self._pushed[self._key(pair, names)] = float(much)
        self._last = touches, bodies, names
        return due

    @property
    def under_way(self) -> bool:
        """Whether a body is under a blow now."""
        return bool(self._struck)

    def saved(self) -> dict[str, npt.NDArray[Any]]:
        """What a checkpoint keeps, where no blow is under way: loads that were borne, and what pairs give."""
        pairs = np.array([*self._pushed], np.int64).reshape(-1, 2)
        names = np.array([*self._quiet], np.int64)
        quiet, borne = [*self._quiet.values()], [self._borne.get(int(name), 0.0) for name in names]
        return {"pairs": pairs, "pushed": np.array([*self._pushed.values()], float), "rested": names,
                "quiet": np.array(quiet, np.int64), "borne": np.array(borne, float)}  # fmt: skip

    def restore(self, saved: dict[str, npt.NDArray[Any]]) -> None:
        """Be as `saved` said."""
        each = zip(saved["pairs"], saved["pushed"], strict=True)
        self._pushed = {(int(a), int(b)): float(push) for (a, b), push in each}
        names = [int(name) for name in saved["rested"]]
        self._quiet = dict(zip(names, map(int, saved["quiet"]), strict=True))
        self._borne = dict(zip(names, map(float, saved["borne"]), strict=True))

    def forget(self, names: set[int]) -> None:
        """Bodies of these names are no more."""
        kept: tuple[dict[int, Any], ...] = (self._struck, self._quiet, self._borne)
        for each in kept:
            for name in names:
                each.pop(name, None)
        self._pushed = {pair: push for pair, push in self._pushed.items() if not names & {*pair}}

    def _name(self, thing: int, names: Ints) -> int:
        """Of a body; below 0 of what stands in its way."""
        return int(names[thing]) if thing < len(names) else len(names) - 1 - thing

    def _key(self, pair: Pair, names: Ints) -> tuple[int, int]:
        first, second = (self._name(thing, names) for thing in pair)
        return min(first, second), max(first, second)

    def _strike(self, pairs: list[Pair], closing: Values, fast: Flags, hard: Flags, names: Ints) -> None:
        """Bodies that meet something fast are struck, and so is what they push harder than before."""
        for row in np.flatnonzero(fast):
            speed, pair = float(closing[row]), pairs[row]
            meeting = _Meeting(self._key(pair, names), self._time(pair[0], pair[1], speed), speed)
            for thing in pair:
                self._hit(thing, meeting, names)
        changed = bool(self._struck)
        while changed:
            changed = any([self._pass_on(pairs[row], names) for row in np.flatnonzero(hard)])

    def _pass_on(self, pair: Pair, names: Ints) -> bool:
        """Where one of a pair is struck the other is, too; whether that is news."""
        struck = [self._struck.get(self._name(thing, names)) for thing in pair]
        for blow, other in ((struck[0], 1), (struck[1], 0)):
            if blow is not None and struck[other] is None and pair[other] < len(names):
                self._hit(pair[other], blow.meeting, names)
                return True
        return False

    def _hit(self, thing: int, meeting: _Meeting, names: Ints) -> None:
        """A body is under a blow, or under a harder one."""
        if thing >= len(names):
            return
        blow = self._struck.setdefault(int(names[thing]), _Struck(meeting, self._pushing(int(names[thing]))))
        if meeting.speed > blow.meeting.speed:
            blow.meeting = meeting

    def _pushing(self, name: int) -> tuple[Values, Values]:
        """(k, 3) points at rest and (k, 3) impulses of the last step of a body."""
        none = np.empty((0, 3)), np.empty((0, 3))
        if self._last is None:
            return none
        touches, bodies, names = self._last
        at = np.flatnonzero(names == name)
        return _at_rest(touches, bodies, int(at[0])) if len(at) else none

    def _go_on(self, touches: Touches, bodies: Bodies, names: Ints) -> list[Strain]:
        """Sum up what struck bodies received; those whose blow is over are due."""
        if not self._struck:
            return []
        number = {int(name): at for at, name in enumerate(names)}
        due = []
        for name in sorted(self._struck):
            blow = self._struck[name]
            points, impulses = _at_rest(touches, bodies, number[name])
            blow.points.append(points)
            blow.impulses.append(impulses)
            blow.steps += 1
            self._quiet[name] = 0
            if blow.meeting.over or blow.steps >= LONGEST:
                due.append(self._strain(blow, number[name]))
                del self._struck[name]
        return due

    def _strain(self, blow: _Struck, body: int) -> Strain:
        (points, before), time = blow.before, blow.meeting.time
        force = np.concatenate([*blow.impulses]) / time
        still = before * (1 / self._step - blow.steps / time)
        where = np.concatenate([*blow.points, points])
        return Strain(body, where, np.concatenate([force, still]), blow.meeting.speed, time)

    def _loads(self, touches: Touches, bodies: Bodies, names: Ints) -> list[Strain]:
        """Bodies that have settled and bear more than they ever did."""
        due, size = [], np.linalg.norm(touches.impulse, axis=1) / self._step
        things, n = np.concatenate([touches.first, touches.second]), len(bodies)
        borne = np.bincount(np.minimum(things, n), np.tile(size, 2), n + 1)[:n]
        for body in np.flatnonzero(borne):
            name = int(names[body])
            if name in self._struck:
                continue
            self._quiet[name] = self._quiet.get(name, 0) + 1
            if self._quiet[name] > SETTLED and borne[body] > GROWN * self._borne.get(name, 0.0):
                self._borne[name] = float(borne[body])
                points, impulses = _at_rest(touches, bodies, int(body))
                due.append(Strain(int(body), points, np.asarray(impulses / self._step)))
        return due


def _by_pairs(touches: Touches) -> tuple[list[Pair], Values, Values]:
    """p pairs of things, the lower first, the fastest approach of each in m/s, and what it gave in N s."""
    both = np.sort(np.stack([touches.first, touches.second], axis=1), axis=1)
    count = int(both.max(initial=0)) + 1
    keys, place = np.unique(both @ np.array([count, 1]), return_inverse=True)
    closing = np.full(len(keys), -np.inf)
    np.maximum.at(closing, place, touches.closing)
    push = np.zeros(len(keys))
    np.add.at(push, place, np.linalg.norm(touches.impulse, axis=1))
    return [(int(key) // count, int(key) % count) for key in keys], closing, push


def _at_rest(touches: Touches, bodies: Bodies, body: int) -> tuple[Values, Values]:
    """(k, 3) points and (k, 3) impulses on a body, in its axes at rest."""
    points, impulses = touches.on(body)
    return bodies.to_rest(points, body), np.asarray(impulses @ bodies.turn[body])
