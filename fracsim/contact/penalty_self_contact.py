"""Term of the balance for contact of a body with itself, and of its fragments, in explicit steps: a penalty.

k_p = kappa A_p / (2 D), but at most what leaves the stable step as it is (penalty_point_facet.penalty_stiffness). What
points near each other add to the square of the highest frequency limits the step. Pairs and friction: penalty_pairs.

Equations: docs/theory.md#explicit-contact.
"""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar, cast

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI

from ..mechanics.term import TimeLevel
from ..mesh.domain import Domain
from ..mesh.parallel import from_root, on_root
from ..mesh.split_surface.entity_numbering import EntityNumbering
from .ipc_pairs import vertex_areas
from .ipc_surface import SelfContactLaw, SelfContactSurface
from .penalty_contacts import ContactStiffness
from .penalty_pairs import PairSprings, PenaltyHistory, PenaltyPairs
from .penalty_point_facet import PointHistory, penalty_stiffness
from .self_contact import SelfContact, node_gather

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


class PenaltyContactSurface(SelfContactSurface):
    """Surface of a body with penalty contact, on rank 0."""

    pairs: PenaltyPairs
    closed_pressure: ClassVar[float] = 0.0  # a face that is pressed at all has no room
    search_all_faces: ClassVar[bool] = True  # to read candidates takes longer than to have more of them

    def __init__(
        self,
        skeleton: EntityNumbering,
        pattern: npt.NDArray[np.uint8],
        law: SelfContactLaw,
        u: Values,
        previous: PenaltyContactSurface | None,
        cut: Values | None = None,
        *,
        mass: Values,
        max_added: float,
    ) -> None:
        """`mass`: (nodes,) kg; `max_added`: 1/s^2 (penalty_stiffness); the others as for SelfContactSurface."""
        self._law, self.mass, self._max_added, self._previous = law, mass, max_added, previous
        self._stiffness: Values | None = None
        super().__init__(skeleton, pattern, law, u, previous, cut)
        self._previous = None

    def _build_pairs(self, elements: Ints) -> PenaltyPairs:
        # by all elements and full arms: constant while a surface lasts
        if self._stiffness is None:
            pressure, area = (
                self._law.stiffness / self._law.distance,
                vertex_areas(self._rest_positions, self.split.elements),
            )
            self._stiffness = penalty_stiffness(self.point_map.weights, area, self.mass, pressure, self._max_added)
        stiffness = ContactStiffness.of_one_body(self._stiffness)
        pairs = PenaltyPairs(self._rest_positions, elements, stiffness, distance=self._law.distance)
        if (last := getattr(self, "pairs", None)) is not None:
            pairs.set_history(last.history)
        elif self._previous is not None:
            number = self.new_numbers(self._previous, len(self._stiffness))
            pairs.set_history(self._previous.pairs.history.renumbered(number, self._stiffness))
        return pairs


# displacements where nothing was near, clearance, and number of surfaces so far
type _IdleState = tuple[Values | None, float, int]


class PenaltySelfContact(SelfContact):
    """Contact of a body with itself in explicit steps.

    Where nothing is near, nothing is gathered on rank 0 until nodes have moved far enough to change that.
    """

    _surface: PenaltyContactSurface | None
    _friction: PairSprings | None
    _idle_displacement: Values | None = None  # (owned dofs,) where nothing was near, m; None: something was
    _idle_clearance = 0.0  # approach of any two points from there on before anything is near, m
    _surface_count = 0  # surfaces so far
    _idle: bool | None = None  # at the current u; None: not known yet

    def __init__(self, domain: Domain, u: fem.Function, law: SelfContactLaw, mass: Values, max_added: float) -> None:
        """Build the term (collective).

        Args:
            domain: mesh.
            u: displacement.
            law: contact law.
            mass: (owned dofs,) lumped, kg.
            max_added: increase of the square of the highest frequency that contact may cause, 1/s^2.

        Raises:
            InputError: if the surface at rest intersects itself.
        """
        gathered = node_gather(domain, law)(mass.reshape(-1, domain.dim))
        self._mass, self._max_added = None if gathered is None else gathered[:, 0].copy(), max_added
        self._coefficient, self._friction_loss = law.friction, 0.0
        # without the friction of implicit steps
        super().__init__(domain, u, replace(law, friction=0.0))

    def _build_surface(self, pattern: npt.NDArray[np.uint8], u: Values, cut: Values | None) -> SelfContactSurface:
        assert self._skeleton is not None and self._mass is not None
        return PenaltyContactSurface(
            self._skeleton, pattern, self.law, u, self._surface, cut, mass=self._mass, max_added=self._max_added
        )

    def stiffen_contact(self) -> float:
        """Return 0: gaps of a penalty may close."""
        return 0.0

    # --- idle steps ---

    def begin_step(self, level: TimeLevel) -> None:
        """Begin a step with the springs of friction of the last one."""
        idle, self._friction_loss = self._is_idle(), 0.0 if level.dt else self._friction_loss
        if idle:
            self._level, self._is_stale, self._idle = level, True, None
        else:
            super().begin_step(level)
        if self._coefficient and self._surface is not None:
            start = self._start_positions if level.dt and not idle else None
            self._friction = PairSprings(self._surface.pairs, self._coefficient, start)

    def update_displacement(self) -> None:
        """Discard positions and forces, as u has changed."""
        super().update_displacement()
        self._idle = None

    def _is_idle(self) -> bool:
        """Whether nothing can be in contact at the current u (collective)."""
        if self._idle is None:
            reference = self._idle_displacement
            self._idle = reference is not None and self._max_approach(reference) <= self._idle_clearance
        return self._idle

    def _max_approach(self, reference: Values) -> float:
        """Bound of the approach of any two nodes from a displacement (owned dofs,), m (collective).

        It is the diagonal of the bounding box of all motions.
        """
        motion = (self._u.x.array[: self._owned] - reference).reshape(-1, self._domain.dim)
        bounds = np.concatenate([motion.min(axis=0, initial=np.inf), -motion.max(axis=0, initial=-np.inf)])
        self.comm.Allreduce(MPI.IN_PLACE, bounds, MPI.MIN)
        return float(np.linalg.norm(bounds.reshape(2, -1).sum(axis=0)))

    def _measure_clearance(self) -> None:
        """Store how far nodes may approach from the current u before anything is near (collective)."""
        x = self._end_positions()

        def clearance() -> float:
            assert self._surface is not None and x is not None
            share, excluded, _ = self._surface.snapshot()
            if len(excluded) or np.any(share < 1):
                return 0.0
            weights = self._surface.point_map.weights
            return self._surface.pairs.clearance(x) / float(abs(weights).sum(axis=1).max())

        self._idle_clearance = from_root(self.comm, clearance)
        self._idle_displacement = self._u.x.array[: self._owned].copy() if self._idle_clearance else None

    def _rebuild(self) -> None:
        self._idle_displacement, self._idle, self._surface_count = None, None, self._surface_count + 1
        super()._rebuild()

    # --- forces and energy ---

    def contact_forces(self) -> Values | None:
        """(owned dofs,) contact forces at the end of the step, N; None: nothing is near (collective)."""
        if self._is_idle():
            return None
        forces = super().contact_forces()
        self._measure_clearance()
        return forces

    def stored_energy(self) -> float:
        """Energy of the penalty and of the springs of friction at the current u, on rank 0, J (collective)."""
        if self._is_idle():
            return 0.0
        energy, x = super().stored_energy(), self._end_positions()
        return energy if self._friction is None or x is None else energy + self._friction.energy(x)

    def step_work(self) -> tuple[float, float]:
        """Work from outside, 0, and dissipation by friction, on rank 0, J."""
        return 0.0, self._friction_loss

    def frequency_bound(self) -> float:
        """Increase of the square of the highest frequency if all near points were in contact, 1/s^2 (collective)."""
        if self._is_idle():
            return 0.0
        x = self._end_positions()

        def bound() -> float:
            assert self._surface is not None and x is not None
            return self._surface.pairs.max_added_frequency(x, self._surface.point_map.weights, self._surface.mass)

        return from_root(self.comm, bound)

    def accept_step(self) -> None:
        """Store contacts and dissipation of the step (collective)."""
        if self._is_idle():
            return
        x = self._end_positions()

        def store() -> None:
            assert self._surface is not None and x is not None
            slips = None
            if self._friction is not None:
                slips, self._friction_loss = self._friction.slips(x), self._friction.dissipated(x)
            self._surface.pairs.end_step(x, slips)

        on_root(self.comm, store)

    # --- state ---

    def snapshot(self) -> object:
        """State of the surface, contacts, and idle state."""
        contacts = None if self._surface is None else self._surface.pairs.history
        idle = self._idle_displacement, self._idle_clearance, self._surface_count
        return super().snapshot(), contacts, idle

    def restore(self, memory: object) -> None:
        """Restore a snapshot (not collective)."""
        surface, contacts, idle = cast("tuple[object, PenaltyHistory | None, _IdleState]", memory)
        super().restore(surface)
        if self._surface is not None and contacts is not None:
            self._surface.pairs.set_history(contacts)
        self._idle_displacement, self._idle_clearance, surface_count = idle
        # edges have broken since: it is another surface
        if surface_count != self._surface_count:
            self._idle_displacement = None
        self._idle = None

    def to_checkpoint(self) -> dict[str, Values]:
        """Arrays for a checkpoint, with facets in contact, their stiffness and the springs of friction."""
        if self._surface is None:
            empty = PenaltyHistory(PointHistory.none(0, 0), None)
            return super().to_checkpoint() | empty.to_checkpoint()
        return super().to_checkpoint() | self._surface.pairs.history.to_checkpoint()

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Set the state from the arrays of a checkpoint."""
        self._idle_displacement = self._idle = None
        super().from_checkpoint(saved)
        if self._surface is not None and "by" in saved:
            self._surface.pairs.set_history(PenaltyHistory.from_checkpoint(saved))
