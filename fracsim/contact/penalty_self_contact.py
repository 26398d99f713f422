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
from .ipc_pairs import vertex_areas
from .ipc_surface import SelfContactLaw, SelfContactSurface
from .penalty_point_facet import NONE, PointFacetPenalty, penalty_stiffness
from .self_contact import SelfContact, node_gather

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class SelfFrictionSprings:
    """Friction of `coefficient` between what is pushed and what pushes it.

    Attributes:
        start: (n, d) points where the step began, m; None: it is over.
    """

    pairs: PointFacetPenalty
    coefficient: float
    start: Values | None

    def gradient(self, x: Values) -> Values:
        """(n, d) N: the force on the points is its negative."""
        met, found = self.pairs.contacts(x), np.zeros_like(x)
        pull = met.stiffness[:, None] * self.slips(x)
        np.add.at(found, met.pairs.points, pull)
        np.add.at(found, met.pairs.corners, -met.pairs.barycentric[:, :, None] * pull[:, None])
        return found

    def energy(self, x: Values) -> float:
        """Of the springs, J."""
        return 0.5 * float(self.pairs.contacts(x).stiffness @ np.sum(self.slips(x) ** 2, axis=1))

    def slips(self, x: Values) -> Values:
        """(k, d) by which the springs of what is pushed are stretched, m. Those that are new are not."""
        met, before = self.pairs.contacts(x), self._start_slips(x)
        slip = tangential(met.pairs.normal, before + self._relative_motion(x))
        longest = self.coefficient * (self.pairs.width - met.pairs.gap)
        length = np.maximum(np.linalg.norm(slip, axis=1), np.finfo(float).tiny)
        return np.asarray(np.minimum(1.0, longest / length)[:, None] * slip)

    def dissipated(self, x: Values) -> float:
        """What friction has taken in the step, J: its work by the trapezoidal rule, less what the springs store."""
        rate = self.pairs.contacts(x).stiffness[:, None]
        work = -0.5 * float(np.vdot(rate * (self._start_slips(x) + self.slips(x)), self._relative_motion(x)))
        stored = 0.5 * float(self.pairs.contact_stiffness @ np.sum(self.pairs.slip**2, axis=1))
        return stored - self.energy(x) - work

    def _start_slips(self, x: Values) -> Values:
        """(k, d) the slips that the step began with, m."""
        return np.asarray(self.pairs.slip[self.pairs.contacts(x).pairs.points])

    def _relative_motion(self, x: Values) -> Values:
        """(k, d) way in the step of points that were pushed as it began, over what pushes them, m."""
        at = self.pairs.contacts(x).pairs
        if self.start is None:
            return np.zeros((len(at.points), x.shape[1]))
        way = x - self.start
        over = way[at.points] - np.einsum("kcd,kc->kd", way[at.corners], at.barycentric)
        return np.where((self.pairs.contact_stiffness[at.points] > 0)[:, None], over, 0.0)


type _Idle = tuple[Values | None, float, int]


class PenaltyContactSurface(SelfContactSurface):
    """The surface of a body that a penalty keeps apart (rank 0)."""

    pairs: PointFacetPenalty
    closed_pressure: ClassVar[float] = 0.0  # what presses at all has no room
    search_all_faces: ClassVar[bool] = True  # to read candidates takes longer than to have more of them

    def __init__(
        self,
        skeleton: EntityNumbering,
        pattern: npt.NDArray[np.uint8],
        law: SelfContactLaw,
        u: Values,
        before: PenaltyContactSurface | None,
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

    def _build_pairs(self, elements: Ints) -> PointFacetPenalty:
        if self._rates is None:  # by all elements, and whole arms: they stay as they are while a surface lasts
            pressure, area = (
                self._law.stiffness / self._law.distance,
                vertex_areas(self._rest_positions, self.split.elements),
            )
            self._rates = penalty_stiffness(self.point_map.weights, area, self.mass, pressure, self._most)
        pairs = PointFacetPenalty(self._rest_positions, elements, self._rates, distance=self._law.distance)
        if (last := getattr(self, "pairs", None)) is not None:
            pairs.set_contacts(last.contact_facets, last.contact_stiffness, last.slip)
        elif self._earlier is not None:
            pairs.set_contacts(*self._pushed_before(self._earlier, self._rates))
        return pairs

    def _pushed_before(self, before: PenaltyContactSurface, most: Values) -> tuple[Ints, Values, Values]:
        """What is pushed still is, and no harder: corners (n, d), k_p (n,) and slips (n, d) of `before` for the points
        of now."""
        old, new, pairs = before.point_map.copies, self.point_map.copies, before.pairs
        nodes = min(old.min(initial=len(pairs.contact_facets)), new.min(initial=len(most)))  # have kept their numbers
        now = np.full(len(pairs.contact_facets), NONE)
        now[:nodes] = np.arange(nodes)
        again = match_points(before._identity(), self._identity())
        now[old[again >= 0]] = new[again[again >= 0]]
        held, by = np.zeros(len(most)), np.full((len(most), pairs.contact_facets.shape[1]), NONE)
        slip = np.zeros(by.shape)
        which = np.flatnonzero((now >= 0) & (pairs.contact_stiffness > 0))
        corners = pairs.contact_facets[which]
        by[now[which]], held[now[which]] = np.where(corners >= 0, now[corners], NONE), pairs.contact_stiffness[which]
        slip[now[which]] = pairs.slip[which]
        return by, np.minimum(held, most), slip


class PenaltySelfContact(SelfContact):
    """A body that explicit steps keep apart from itself."""

    _surface: PenaltyContactSurface | None
    _friction: SelfFrictionSprings | None  # type: ignore[assignment]
    # displacements (owned dofs,) where nothing was near, m; None: something was; and how far from there nothing is, m
    _idle_displacement: Values | None = None
    _idle_clearance = 0.0
    _surface_count = 0  # surfaces that there have been
    _idle: bool | None = None  # at the current u; None: not known yet

    def __init__(self, domain: Domain, u: fem.Function, law: SelfContactLaw, mass: Values, most: float) -> None:
        """`mass`: (owned dofs,) lumped, kg; `most`: what contact may add to the square of the highest frequency, 1/s^2.

        InputError where the surface at rest cuts itself (collective).
        """
        gathered = node_gather(domain, law)(mass.reshape(-1, domain.dim))
        self._mass, self._most = None if gathered is None else gathered[:, 0].copy(), most
        self._coefficient, self._friction_loss = law.friction, 0.0
        super().__init__(domain, u, replace(law, friction=0.0))  # that of implicit steps

    def _build_surface(self, pattern: npt.NDArray[np.uint8], u: Values, cut: Values | None) -> SelfContactSurface:
        assert self._skeleton is not None and self._mass is not None
        return PenaltyContactSurface(
            self._skeleton, pattern, self.law, u, self._surface, cut, mass=self._mass, most=self._most
        )

    def stiffen_contact(self) -> float:
        """A penalty knows no gap that is all but closed."""
        return 0.0

    # --- where nothing is near, nothing is gathered until nodes have gone far enough to change that ---

    def begin_step(self, level: TimeLevel) -> None:
        """As of SelfContact."""
        idle, self._friction_loss = self._is_idle(), 0.0 if level.dt else self._friction_loss
        if idle:
            self._level, self._is_stale, self._idle = level, True, None
        else:
            super().begin_step(level)
        if self._coefficient and self._surface is not None:
            start = self._start_positions if level.dt and not idle else None
            self._friction = SelfFrictionSprings(self._surface.pairs, self._coefficient, start)

    def update_displacement(self) -> None:
        """What touches has to be found anew."""
        super().update_displacement()
        self._idle = None

    def _is_idle(self) -> bool:
        """Whether nothing can be in touch with the body where it is (collective)."""
        if self._idle is None:
            self._idle = (
                self._idle_displacement is not None
                and self._max_approach(self._idle_displacement) <= self._idle_clearance
            )
        return self._idle

    def _max_approach(self, since: Values) -> float:
        """m, by how much any two nodes may have come closer: the diagonal of a box around their ways (collective)."""
        way = (self._u.x.array[: self._owned] - since).reshape(-1, self._domain.dim)
        ends = np.concatenate([way.min(axis=0, initial=np.inf), -way.max(axis=0, initial=-np.inf)])
        self.comm.Allreduce(MPI.IN_PLACE, ends, MPI.MIN)
        return float(np.linalg.norm(ends.reshape(2, -1).sum(axis=0)))

    def _measure_clearance(self) -> None:
        """Note by how much nodes may come closer from here on before anything is near (collective)."""
        x = self._end_positions()

        def room() -> float:
            assert self._surface is not None and x is not None
            share, out, _ = self._surface.snapshot()
            if len(out) or np.any(share < 1):
                return 0.0
            return self._surface.pairs.clearance(x) / float(abs(self._surface.point_map.weights).sum(axis=1).max())

        self._idle_clearance = from_root(self.comm, room)
        self._idle_displacement = self._u.x.array[: self._owned].copy() if self._idle_clearance else None

    def _rebuild(self) -> None:
        self._idle_displacement, self._idle, self._surface_count = None, None, self._surface_count + 1
        super()._rebuild()

    # --- what it adds to the balance ---

    def contact_forces(self) -> Values | None:  # type: ignore[override]
        """(owned dofs,) forces at the end of the step, N; None: nothing is near (collective)."""
        if self._is_idle():
            return None
        forces = super().contact_forces()
        self._measure_clearance()
        return forces

    def reference_forces(self) -> Values | None:  # type: ignore[override]
        """(owned dofs,) the same as they enter r, N (collective)."""
        return None if self._is_idle() else super().reference_forces()

    def stored_energy(self) -> float:
        """Energy of the penalty, and of the springs of friction, at the current u, on rank 0, J (collective)."""
        if self._is_idle():
            return 0.0
        energy, x = super().stored_energy(), self._end_positions()
        return energy if self._friction is None or x is None else energy + self._friction.energy(x)

    def step_work(self) -> tuple[float, float]:
        """What friction takes, on rank 0, J."""
        return 0.0, self._friction_loss

    def frequency_bound(self) -> float:
        """What contact adds at most, were all points in touch that are near, 1/s^2 (collective)."""
        if self._is_idle():
            return 0.0
        x = self._end_positions()

        def found() -> float:
            assert self._surface is not None and x is not None
            return self._surface.pairs.max_added_frequency(x, self._surface.point_map.weights, self._surface.mass)

        return from_root(self.comm, found)

    def accept_step(self) -> None:
        """The step is over: what is pushed is known from here on (collective)."""
        if self._is_idle():
            return
        x = self._end_positions()

        def noted() -> None:
            assert self._surface is not None and x is not None
            slips = None
            if self._friction is not None:
                slips, self._friction_loss = self._friction.slips(x), self._friction.dissipated(x)
            self._surface.pairs.end_step(x, slips)

        on_root(self.comm, noted)

    def snapshot(self) -> object:
        """With what is pushed."""
        pushed = self._surface and (
            self._surface.pairs.contact_facets,
            self._surface.pairs.contact_stiffness,
            self._surface.pairs.slip,
        )
        return super().snapshot(), pushed, (self._idle_displacement, self._idle_clearance, self._surface_count)

    def restore(self, memory: object) -> None:
        """Be again what `memory` gave of this surface (not collective)."""
        surface, pushed, idle = cast("tuple[object, tuple[Ints, Values, Values] | None, _Idle]", memory)
        super().restore(surface)
        if self._surface is not None and pushed is not None and pushed[1] is not self._surface.pairs.contact_stiffness:
            self._surface.pairs.set_contacts(*pushed)
        self._idle_displacement, self._idle_clearance, age = idle
        if age != self._surface_count:  # edges have broken since: it is another surface
            self._idle_displacement = None
        self._idle = None

    def to_checkpoint(self) -> dict[str, Values]:
        """With the facets that push points, and the springs of friction."""
        if self._surface is None:
            return super().to_checkpoint() | {"by": np.empty((0, 0)), "held": np.empty(0), "slip": np.empty((0, 0))}
        pairs = self._surface.pairs
        return super().to_checkpoint() | {
            "by": pairs.contact_facets.astype(float),
            "held": pairs.contact_stiffness,
            "slip": pairs.slip,
        }

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Be again what `saved` gave."""
        self._idle_displacement = self._idle = None
        super().from_checkpoint(saved)
        if self._surface is not None and "by" in saved:
            slip = saved.get("slip", np.zeros(saved["by"].shape))
            self._surface.pairs.set_contacts(saved["by"].astype(np.int64), saved["held"], slip)
