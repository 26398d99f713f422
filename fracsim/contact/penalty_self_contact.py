"""Contact of a body with itself, and of its pieces, in explicit steps: the same term with a penalty
(penalty_point_facet).

k_p = kappa A_p / (2 D), but no more than what leaves the stable step as it is (penalty_point_facet.rates); what points
that are near each other add to the square of the highest frequency sets the step.

Equations: docs/theory.md#explicit-contact.

Coulomb friction of a surface with itself in explicit steps: each point that is pushed hangs on a spring that slips.

    f_p = -k_p s,    s += (1 - n n^T) (dx_p - sum_c l_c dx_c) in a step, shortened to k_p |s| <= mu k_p (D - g)

with k_p, the gap g, its normal n and the shares l of the place on the facet as pushed (penalty_point_facet); the
facet's corners take -l_c f_p. (Cundall and Strack's springs, as before obstacles: springs.) Forces sum to nothing;
their moment is that of f_p over the gap, as point and place are apart by it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, cast

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI

from ..mechanics.term import TimeLevel
from ..mesh.domain import Domain
from ..mesh.parallel import from_root, on_root
from ..mesh.split_surface.entity_numbering import EntityNumbering
from ..mesh.split_surface.point_matching import match_points
from .friction import tangential
from .ipc_pairs import areas
from .ipc_surface import Law, Surface
from .penalty_point_facet import NONE, Pushing, rates
from .self_contact import SelfContact, gathering

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Sticking:
    """Friction of `coefficient` between what is pushed and what pushes it.

    Attributes:
        start: (n, d) points where the step began, m; None: it is over.
    """

    pairs: Pushing
    coefficient: float
    start: Values | None

    def gradient(self, x: Values) -> Values:
        """(n, d) N: the force on the points is its negative."""
        met, found = self.pairs.met(x), np.zeros_like(x)
        pull = met.rate[:, None] * self.slips(x)
        np.add.at(found, met.at.points, pull)
        np.add.at(found, met.at.corners, -met.at.share[:, :, None] * pull[:, None])
        return found

    def energy(self, x: Values) -> float:
        """Of the springs, J."""
        return 0.5 * float(self.pairs.met(x).rate @ np.sum(self.slips(x) ** 2, axis=1))

    def slips(self, x: Values) -> Values:
        """(k, d) by which the springs of what is pushed are stretched, m. Those that are new are not."""
        met, before = self.pairs.met(x), self._before(x)
        slip = tangential(met.at.normal, before + self._moved(x))
        longest = self.coefficient * (self.pairs.width - met.at.gap)
        length = np.maximum(np.linalg.norm(slip, axis=1), np.finfo(float).tiny)
        return np.asarray(np.minimum(1.0, longest / length)[:, None] * slip)

    def lost(self, x: Values) -> float:
        """What friction has taken in the step, J: its work by the trapezoidal rule, less what the springs store."""
        rate = self.pairs.met(x).rate[:, None]
        work = -0.5 * float(np.vdot(rate * (self._before(x) + self.slips(x)), self._moved(x)))
        stored = 0.5 * float(self.pairs.held @ np.sum(self.pairs.slip**2, axis=1))
        return stored - self.energy(x) - work

    def _before(self, x: Values) -> Values:
        """(k, d) the slips that the step began with, m."""
        return np.asarray(self.pairs.slip[self.pairs.met(x).at.points])

    def _moved(self, x: Values) -> Values:
        """(k, d) way in the step of points that were pushed as it began, over what pushes them, m."""
        at = self.pairs.met(x).at
        if self.start is None:
            return np.zeros((len(at.points), x.shape[1]))
        way = x - self.start
        over = way[at.points] - np.einsum("kcd,kc->kd", way[at.corners], at.share)
        return np.where((self.pairs.held[at.points] > 0)[:, None], over, 0.0)


type _Idle = tuple[Values | None, float, int]


class Pushes(Surface):
    """The surface of a body that a penalty keeps apart (rank 0)."""

    pairs: Pushing
    close: ClassVar[float] = 0.0  # what presses at all has no room
    at_once: ClassVar[bool] = True  # to read candidates takes longer than to have more of them

    def __init__(
        self,
        skeleton: EntityNumbering,
        pattern: npt.NDArray[np.uint8],
        law: Law,
        u: Values,
        before: Pushes | None,
        cut: Values | None = None,
        *,
        mass: Values,
        most: float,
    ) -> None:
        """`mass`: (nodes,) kg; `most`: 1/s^2 (pushing.rates); the others as for Surface."""
        self._law, self.mass, self._most, self._earlier = law, mass, most, before
        self._rates: Values | None = None
        super().__init__(skeleton, pattern, law, u, before, cut)
        self._earlier = None

    def _pairs_of(self, elements: Ints) -> Pushing:
        if self._rates is None:  # by all elements, and whole arms: they stay as they are while a surface lasts
            pressure, area = self._law.stiffness / self._law.distance, areas(self._rest, self.made.elements)
            self._rates = rates(self.at.weights, area, self.mass, pressure, self._most)
        pairs = Pushing(self._rest, elements, self._rates, distance=self._law.distance)
        if (last := getattr(self, "pairs", None)) is not None:
            pairs.hold(last.by, last.held, last.slip)
        elif self._earlier is not None:
            pairs.hold(*self._pushed_before(self._earlier, self._rates))
        return pairs

    def _pushed_before(self, before: Pushes, most: Values) -> tuple[Ints, Values, Values]:
        """What is pushed still is, and no harder: corners (n, d), k_p (n,) and slips (n, d) of `before` for the points
        of now."""
        old, new, pairs = before.at.copies, self.at.copies, before.pairs
        nodes = min(old.min(initial=len(pairs.by)), new.min(initial=len(most)))  # have kept their numbers
        now = np.full(len(pairs.by), NONE)
        now[:nodes] = np.arange(nodes)
        again = match_points(before._identity(), self._identity())
        now[old[again >= 0]] = new[again[again >= 0]]
        held, by = np.zeros(len(most)), np.full((len(most), pairs.by.shape[1]), NONE)
        slip = np.zeros(by.shape)
        which = np.flatnonzero((now >= 0) & (pairs.held > 0))
        corners = pairs.by[which]
        by[now[which]], held[now[which]] = np.where(corners >= 0, now[corners], NONE), pairs.held[which]
        slip[now[which]] = pairs.slip[which]
        return by, np.minimum(held, most), slip


class ExplicitSelfContact(SelfContact):
    """A body that explicit steps keep apart from itself."""

    _surface: Pushes | None
    _rubbing: Sticking | None  # type: ignore[assignment]
    # displacements (owned dofs,) where nothing was near, m; None: something was; and how far from there nothing is, m
    _since: Values | None = None
    _room = 0.0
    _age = 0  # surfaces that there have been
    _idle: bool | None = None  # at the current u; None: not known yet

    def __init__(self, domain: Domain, u: fem.Function, law: Law, mass: Values, most: float) -> None:
        """`mass`: (owned dofs,) lumped, kg; `most`: what contact may add to the square of the highest frequency, 1/s^2.

        InputError where the surface at rest cuts itself (collective).
        """
        gathered = gathering(domain, law)(mass.reshape(-1, domain.dim))
        self._mass, self._most = None if gathered is None else gathered[:, 0].copy(), most
        self._friction, self._lost = law.friction, 0.0
        super().__init__(domain, u, replace(law, friction=0.0))  # that of implicit steps

    def _made(self, pattern: npt.NDArray[np.uint8], u: Values, cut: Values | None) -> Surface:
        assert self._skeleton is not None and self._mass is not None
        return Pushes(self._skeleton, pattern, self.law, u, self._surface, cut, mass=self._mass, most=self._most)

    def stiffen_contact(self) -> float:
        """A penalty knows no gap that is all but closed."""
        return 0.0

    # --- where nothing is near, nothing is gathered until nodes have gone far enough to change that ---

    def begin_step(self, level: TimeLevel) -> None:
        """As of SelfContact."""
        idle, self._lost = self._is_idle(), 0.0 if level.dt else self._lost
        if idle:
            self._level, self._moved, self._idle = level, True, None
        else:
            super().begin_step(level)
        if self._friction and self._surface is not None:
            start = self._start if level.dt and not idle else None
            self._rubbing = Sticking(self._surface.pairs, self._friction, start)

    def update_displacement(self) -> None:
        """What touches has to be found anew."""
        super().update_displacement()
        self._idle = None

    def _is_idle(self) -> bool:
        """Whether nothing can be in touch with the body where it is (collective)."""
        if self._idle is None:
            self._idle = self._since is not None and self._gone(self._since) <= self._room
        return self._idle

    def _gone(self, since: Values) -> float:
        """m, by how much any two nodes may have come closer: the diagonal of a box around their ways (collective)."""
        way = (self._u.x.array[: self._owned] - since).reshape(-1, self._domain.dim)
        ends = np.concatenate([way.min(axis=0, initial=np.inf), -way.max(axis=0, initial=-np.inf)])
        self.comm.Allreduce(MPI.IN_PLACE, ends, MPI.MIN)
        return float(np.linalg.norm(ends.reshape(2, -1).sum(axis=0)))

    def _look(self) -> None:
        """Note by how much nodes may come closer from here on before anything is near (collective)."""
        x = self._places()

        def room() -> float:
            assert self._surface is not None and x is not None
            share, out, _ = self._surface.memory()
            if len(out) or np.any(share < 1):
                return 0.0
            return self._surface.pairs.room(x) / float(abs(self._surface.at.weights).sum(axis=1).max())

        self._room = from_root(self.comm, room)
        self._since = self._u.x.array[: self._owned].copy() if self._room else None

    def _rebuild(self) -> None:
        self._since, self._idle, self._age = None, None, self._age + 1
        super()._rebuild()

    # --- what it adds to the balance ---

    def contact_forces(self) -> Values | None:  # type: ignore[override]
        """(owned dofs,) forces at the end of the step, N; None: nothing is near (collective)."""
        if self._is_idle():
            return None
        forces = super().contact_forces()
        self._look()
        return forces

    def reference_forces(self) -> Values | None:  # type: ignore[override]
        """(owned dofs,) the same as they enter r, N (collective)."""
        return None if self._is_idle() else super().reference_forces()

    def stored_energy(self) -> float:
        """Energy of the penalty, and of the springs of friction, at the current u, on rank 0, J (collective)."""
        if self._is_idle():
            return 0.0
        energy, x = super().stored_energy(), self._places()
        return energy if self._rubbing is None or x is None else energy + self._rubbing.energy(x)

    def step_work(self) -> tuple[float, float]:
        """What friction takes, on rank 0, J."""
        return 0.0, self._lost

    def frequency_bound(self) -> float:
        """What contact adds at most, were all points in touch that are near, 1/s^2 (collective)."""
        if self._is_idle():
            return 0.0
        x = self._places()

        def found() -> float:
            assert self._surface is not None and x is not None
            return self._surface.pairs.fastest(x, self._surface.at.weights, self._surface.mass)

        return from_root(self.comm, found)

    def accept_step(self) -> None:
        """The step is over: what is pushed is known from here on (collective)."""
        if self._is_idle():
            return
        x = self._places()

        def noted() -> None:
            assert self._surface is not None and x is not None
            slips = None
            if self._rubbing is not None:
                slips, self._lost = self._rubbing.slips(x), self._rubbing.lost(x)
            self._surface.pairs.arrive(x, slips)

        on_root(self.comm, noted)

    def snapshot(self) -> object:
        """With what is pushed."""
        pushed = self._surface and (self._surface.pairs.by, self._surface.pairs.held, self._surface.pairs.slip)
        return super().snapshot(), pushed, (self._since, self._room, self._age)

    def restore(self, memory: object) -> None:
        """Be again what `memory` gave of this surface (not collective)."""
        surface, pushed, idle = cast("tuple[object, tuple[Ints, Values, Values] | None, _Idle]", memory)
        super().restore(surface)
        if self._surface is not None and pushed is not None and pushed[1] is not self._surface.pairs.held:
            self._surface.pairs.hold(*pushed)
        self._since, self._room, age = idle
        if age != self._age:  # edges have broken since: it is another surface
            self._since = None
        self._idle = None

    def to_checkpoint(self) -> dict[str, Values]:
        """With the facets that push points, and the springs of friction."""
        if self._surface is None:
            return super().to_checkpoint() | {"by": np.empty((0, 0)), "held": np.empty(0), "slip": np.empty((0, 0))}
        pairs = self._surface.pairs
        return super().to_checkpoint() | {"by": pairs.by.astype(float), "held": pairs.held, "slip": pairs.slip}

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Be again what `saved` gave."""
        self._since = self._idle = None
        super().from_checkpoint(saved)
        if self._surface is not None and "by" in saved:
            slip = saved.get("slip", np.zeros(saved["by"].shape))
            self._surface.pairs.hold(saved["by"].astype(np.int64), saved["held"], slip)
