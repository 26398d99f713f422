"""A step of rigid bodies: they move, what was struck is analysed, what breaks goes on as pieces."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ..contact.obstacle import RigidObstacle
from ..errors import NotConverged
from ..timestepping.stepper import StepAborted
from .bodies import Bodies
from .contact_records import Touches
from .engine import Engine
from .fragment_geometry import Geometry, Shapes
from .fragment_overlap import Overlaps
from .hertz import Hertz, reduced
from .impact_detection import Blows, Strain
from .instances import Copies, Kept
from .mujoco_model import Part, Rules
from .obstacles import Others
from .parallel_analyses import Analyses, Strike
from .worker_ranks import Helper

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class RigidState:
    """Bodies at time t (s), pieces first, then obstacles that are free; `step` of the run, and what gravity and drivers
    have done since its start, J."""

    t: float
    step: int
    bodies: Bodies
    work: float = 0.0


@dataclass(frozen=True)
class RigidReport:
    """What a step did.

    Attributes:
        broken: edges that broke.    blows, loads: analyses that were due.    kinetic: J, of the bodies.
        pushed: (obstacles, 3) mean force of the pieces on each, N.    worked: (obstacles,) what each did, J; a free
        one: what it lost.
        krylov: iterations of CG in all analyses.    seconds: it took.
    """

    broken: int
    blows: int
    loads: int
    kinetic: float
    pushed: Values
    worked: Values
    krylov: int
    seconds: float


@dataclass
class _Begun:
    """What a step began with beside its state: overlaps, what `Blows.saved` gave, and of copies that are analysed in it
    what they were."""

    overlaps: Overlaps
    blows: dict[str, npt.NDArray[Any]]
    copies: Kept | None = None


@dataclass
class Phases:
    """Seconds in each part of the steps so far."""

    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(("motion", "analysis", "pieces"), 0.0))

    def add(self, phase: str, began: float) -> float:
        """To a phase, since a time; returns the time now."""
        now = time.perf_counter()
        self.seconds[phase] += now - began
        return now


class RigidStepper:
    """Copies of one mesh, on one rank; the bodies of a state are their pieces as they are broken now.

    Attributes:
        shapes: of the pieces.    copies: of the mesh.    others: obstacles.    phases: seconds so far.
    """

    shapes: Shapes
    _mass: Values  # of all things, and half their sizes
    _size: Values

    def __init__(
        self,
        copies: Copies,
        geometry: Geometry,
        density: float,
        obstacles: Sequence[RigidObstacle],
        rules: Rules,
        hertz: Hertz,
        contact_time: float | None = None,
        analyses: Analyses | None = None,
        helper: Helper | None = None,
    ) -> None:
        """`density`: kg/m^3; `contact_time`: s, of every blow; None: Hertz's; `analyses`: of the mesh; `helper`: a
        second thread, None: there is none."""
        self.analyses, self._helper = analyses or Analyses(copies), helper
        self.copies, self._geometry, self._density = copies, geometry, density
        self.others, self._rules, self._hertz, self._given = Others(obstacles), rules, hertz, contact_time
        self.blows, self.phases, self.overlaps = (
            Blows(rules.step, rules.fast, self._time, self._spread),
            Phases(),
            Overlaps.none(),
        )
        self._engine: Engine | None = None
        self._abandoned: _Begun | None = None  # what was before a step that was abandoned
        self._broke: set[int] = set()  # copies, in this step
        self.look_again()

    def look_again(self) -> None:
        """Copies have broken: shapes are those of their pieces."""
        damage = {number: each.damage() for number, each in self.copies.damaged.items()}
        points = {number: each.points for number, each in self.copies.shapes.items()}
        self.shapes, self._engine = self._geometry.shapes(damage, points), None
        self._mass, self._size = self._weights()

    def start(self) -> RigidState:
        """The bodies where the mesh has them, at rest."""
        pieces = Bodies.at_rest(self._densities(), self.shapes.moments)
        return RigidState(0.0, 0, pieces.with_more(self.others.bodies()))

    def _densities(self) -> Values:
        return np.full(self.count, self._density)

    @property
    def count(self) -> int:
        """Of pieces."""
        return len(self.shapes.names)

    @property
    def names(self) -> Ints:
        """(n,) of all bodies: of pieces their lowest node, of free obstacles more than any has."""
        more = len(self.shapes.piece_of_node) + np.arange(len(self.others.free))
        return np.concatenate([self.shapes.names, more])

    # --- a checkpoint ---

    def saved(self, state: RigidState) -> dict[str, npt.NDArray[Any]]:
        """Arrays that `restore` goes on from; where the step after `state` was abandoned, as they were before it."""
        bodies = {f"body.{name}": values for name, values in vars(state.bodies).items()}
        begun = self._abandoned or self._begun()
        overlaps = {f"overlap.{name}": values for name, values in vars(begun.overlaps).items()}
        return {**bodies, **overlaps, **self.copies.saved(begun.copies), **begun.blows}

    def _begun(self) -> _Begun:
        return _Begun(self.overlaps, {name: values.copy() for name, values in self.blows.saved().items()})

    def restore(self, saved: dict[str, npt.NDArray[Any]], t: float, step: int, work: float) -> RigidState:
        """The state that `saved` was of, with the mesh as broken as then."""
        self.copies.restore(saved)
        self.analyses.restored()
        self.look_again()
        self.overlaps = Overlaps(**{name: saved[f"overlap.{name}"] for name in vars(self.overlaps)})
        self.blows.restore(saved)
        bodies = {name.removeprefix("body."): values for name, values in saved.items() if name.startswith("body.")}
        return RigidState(t, step, Bodies(**bodies), work)

    # --- a step ---

    def advance(self, state: RigidState) -> tuple[RigidState, RigidReport]:
        """The state a step later. Raises NotConverged where an analysis fails, or the motion is not finite, Abandoned
        where the run is to stop; then `saved` gives what was before.

        Where something breaks the step is taken again with the pieces, which take no more of a blow than they can.
        """
        begun, self._abandoned = self._begun(), None
        try:
            return self._advance(state, begun)
        except StepAborted:
            self._abandoned = begun
            raise

    def _advance(self, state: RigidState, begun: _Begun) -> tuple[RigidState, RigidReport]:
        began = clock = time.perf_counter()
        iterations, bodies, shapes = self.copies.iterations, state.bodies, self.copies.shapes.copy()
        _check_finite(bodies, state.t)
        self._broke.clear()
        moved, touches = self._moved(state, bodies)
        due = self.blows.look(touches, bodies, self.names)
        clock = self.phases.add("motion", clock)
        if strikes := self._strikes(due, touches):
            begun.copies = self.copies.kept(each.name for each in strikes)
        struck = self.analyses(strikes)
        clock = self.phases.add("analysis", clock)
        broken = sum(struck.values())
        if broken:
            bodies = self._divided(bodies, {name for name, count in struck.items() if count})
            clock = self.phases.add("pieces", clock)
            moved, touches = self._moved(state, bodies)
            self.phases.add("motion", clock)
        self.blows.keep(touches, bodies, self.names)
        if dented := [number for number, each in self.copies.shapes.items() if each is not shapes.get(number)]:
            moved = self._reshaped(moved, dented)
        _check_finite(moved, state.t + self._rules.step)
        pushed, worked = self._given_by(touches, state.t)
        fallen = moved.mass * ((moved.place - bodies.place) @ self._rules.gravity)
        work = state.work + float(fallen.sum()) + float(worked.sum())
        worked[self.others.free] = (fallen + bodies.kinetics - moved.kinetics)[self.count :]
        after = RigidState(state.t + self._rules.step, state.step + 1, moved, work)
        blows = sum(each.speed > 0 for each in due)
        krylov, seconds = self.copies.iterations - iterations, time.perf_counter() - began
        return after, RigidReport(broken, blows, len(due) - blows, moved.kinetic, pushed, worked, krylov, seconds)

    def _moved(self, state: RigidState, bodies: Bodies) -> tuple[Bodies, Touches]:
        """The bodies of a state, or the pieces that they are now, a step later, and what touched."""
        engine, end = self._engine or self._made(state.t, bodies), state.t + self._rules.step
        moved, touches = engine.advance(bodies, self.others.ways(end), self._kin)
        self.overlaps = engine.overlaps
        return moved, touches

    def _kin(self, bodies: Ints) -> Ints:
        """(m,) of bodies (m,), see rigid.impact_sequence: copies c of those that may break, or have done so in this
        step,
        -2 - c of pieces that may not."""
        found, mine = np.full(len(bodies), -1), bodies < self.count
        of, place = np.unique(self.shapes.names[bodies[mine]] // self.copies.nodes, return_inverse=True)
        may = [number in self._broke or self.copies.breaks(number) for number in map(int, of)]
        found[mine] = np.where(may, of, -2 - of)[place]
        return found

    def _made(self, t: float, bodies: Bodies) -> Engine:
        """The engine for the bodies as they are now."""
        of, others = self.shapes, self.others
        parts: list[Sequence[Part]] = [*of.parts, *others.parts]
        outer, turn = [*of.outer, *others.outer], of.turn
        if others.free:
            turn = np.concatenate([turn, np.tile(np.eye(3), (len(others.free), 1, 1))])
        stands = others.stands(t)
        rest = self.names, outer, turn, self._helper, of.cores
        self._engine = Engine(bodies, parts, stands, self._rules, self.overlaps, *rest)
        return self._engine

    def depths(self, state: RigidState) -> list[tuple[int, int, float]]:
        """(thing, thing, depth in m) of what is in one another by more than hulls of pieces are from birth."""
        return (self._engine or self._made(state.t, state.bodies)).depth(state.bodies)

    def _given_by(self, touches: Touches, t: float) -> tuple[Values, Values]:
        """Mean force of the pieces on each obstacle (m, 3) in N, and what drivers did (m,) in J."""
        count, dt, others = self.count, self._rules.step, self.others
        pushed, more = np.zeros((2, len(others.every), 3))
        for things, partner, sign in ((touches.first, touches.second, -1.0), (touches.second, touches.first, 1.0)):
            for chosen, sums in ((partner < count, pushed), (partner >= count, more)):
                mine = (things >= count) & chosen
                np.add.at(sums, others.owner[things[mine] - count], sign * touches.impulse[mine] / dt)
        return pushed, -np.einsum("mi,mi->m", pushed + more, others.moved(t, dt))

    def _strikes(self, due: list[Strain], touches: Touches) -> list[Strike]:
        """Those that might break a body."""
        due = [each for each in due if each.body < self.count]
        if not due:
            return []
        energy = touches.energies(self.count, self._rules.restitution)
        every = [Strike(int(self.shapes.names[each.body]), each.points, each.force, each.radius,
                        energy=each.energy(float(energy[each.body]))) for each in due]  # fmt: skip
        sums = [float(np.linalg.norm(each.force, axis=1).sum()) for each in due]
        may = [self.copies.may_break(each.name, much) for each, much in zip(every, sums, strict=True)]
        return [each for each, yes in zip(every, may, strict=True) if yes]

    def _divided(self, bodies: Bodies, names: set[int]) -> Bodies:
        """The pieces that bodies of these names broke into, among those that did not."""
        before, free = self.shapes, bodies.part(slice(self.count, None))
        bodies = bodies.part(slice(self.count))
        self.look_again()
        after = self.shapes
        parent = np.searchsorted(before.names, before.names[before.piece_of_node[after.names]])
        parts = bodies.divided(self._densities(), after.moments, parent)
        self.blows.forget(np.array([*names], np.int64))
        self._broke = {name // self.copies.nodes for name in names}
        whole = ~np.isin(before.names[parent], list(names))  # not even by round-off are these other bodies now
        kept = {key: np.array(values) for key, values in vars(parts).items()}
        for key, values in kept.items():
            values[whole] = getattr(bodies, key)[parent[whole]]
        self.overlaps = self.overlaps.divided(after.names, before.names[parent])
        return replace(parts, **kept).with_more(free)

    def _reshaped(self, bodies: Bodies, copies: list[int]) -> Bodies:
        """The bodies, those of some copies as they are dented now. The step stays as it was: what is struck and dented
        has been struck all the same."""
        self.look_again()
        mine = np.isin(self.shapes.names // self.copies.nodes, copies)
        return bodies.reshaped(self.shapes.moments, np.flatnonzero(mine))

    # --- how long a blow lasts, and what it presses on ---

    def _time(self, first: Ints, second: Ints, speed: Values) -> Values:
        """s, of things (k,) that meet others (k,) at speeds (k,), m/s."""
        if self._given is not None:
            return np.full(len(first), self._given)
        mass, size, both = self._mass, self._size, self._both_give(first, second)
        return self._hertz(reduced(mass[first], mass[second]), reduced(size[first], size[second]), speed, both)

    def _spread(self, first: Ints, second: Ints) -> Values:
        """a^3 / F, m^3/N, of things (k,) that touch others (k,)."""
        size = self._size
        return self._hertz.spread(reduced(size[first], size[second]), self._both_give(first, second))

    def _both_give(self, first: Ints, second: Ints) -> Flags:
        """(k,) whether both are bodies: what stands does not give way."""
        return np.asarray(np.maximum(first, second) < self.count)

    def _weights(self) -> tuple[Values, Values]:
        """Masses of all things in kg and half their sizes in m: half the side of a cube as large."""
        volume, others = self.shapes.moments.volume, self.others
        free = others.bodies().mass
        stands = np.full(len(others.extent) - len(free), np.inf)
        return (
            np.concatenate([self._density * volume, free, stands]),
            np.concatenate([np.cbrt(volume) / 2, others.extent]),
        )


def _check_finite(bodies: Bodies, t: float) -> None:
    """NotConverged where bodies are, or move, at time t (s) as no numbers can say."""
    if not bodies.finite:
        raise NotConverged(f"the motion of the bodies is not finite at t = {t:g} s; look at velocities and time.step")
