"""Fracture pass at the end of a step: edges fail, and their cells lose stiffness."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol

import numpy as np
import numpy.typing as npt

from ..mechanics.stress import Stress
from ..mesh.edge_graph import EdgeGraph
from ..mesh.parallel import sum_over_ranks
from .criterion import FractureCriterion
from .degradation import Degradation, make_degradation
from .effective_stress import UndamagedStress
from .node_retention import NodeAttachment

if TYPE_CHECKING:
    from .energy.hinges import HingeRelease
    from .energy.tip_record import TipRecord

Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


class EdgeLaw(Protocol):
    """Interface of the law of an edge: integrity, from 1 (intact) to 0 (broken), as a function of the load.

    Attributes:
        all_or_nothing: integrity is 1 or 0, so that ranks need not agree on values in between.
    """

    all_or_nothing: bool

    def __call__(self, load: Values) -> Values:
        """Return the integrity (n,) under loads (n,), normal stress over strength; an edge keeps its least value."""


class BrittleEdgeLaw:
    """Brittle law: integrity is 1 below the strength and 0 from there on."""

    all_or_nothing = True

    def __call__(self, load: Values) -> Values:
        """Return the integrity (n,), 0 or 1, under loads (n,) over the strength."""
        return np.where(load >= 1, 0.0, 1.0)


@dataclass(frozen=True)
class FracturePassResult:
    """Result of one fracture pass.

    Attributes:
        broken_edges: number of edges that broke, on all ranks.
        largest_chi_loss: largest decrease of chi in a cell of this rank, dimensionless.
        released_energy: elastic energy released on this rank, J.
        elastic_energy: elastic energy left on this rank, J.
        cells_died: whether chi of some cell of this rank fell to 0.
        previous_damage: copies of the damage fields before the pass, if it released forces on any rank: edges broke,
            split cells released a part of their energy, or cohesive cracks softened.
    """

    broken_edges: int
    largest_chi_loss: float
    released_energy: float
    elastic_energy: float
    cells_died: bool
    previous_damage: list[Values] = field(default_factory=list)


@dataclass(frozen=True)
class DamageSnapshot:
    """Damage at one time.

    Attributes:
        integrity: (edges,) of the local edges.
        fields: values of the damage fields of the stress.
        criterion: history variables of the criterion.
    """

    integrity: Values
    fields: list[Values]
    criterion: object


class FracturePass:
    """Weakens the edges that a criterion finds, and degrades their cells (timestepping.inelastic_update).

    Attributes:
        stress: stress of the body, with its damage fields.
        graph: edges and their integrity.
        criterion: finds the edges that fail.
        law: integrity of an edge that fails.
        degradation: energy that broken edges take out of their cells.
        max_passes: largest number of passes in a step; None: until nothing changes.
        initial_cuts: (edges,) cut positions of edges broken before the start, NaN elsewhere; None without such edges.
        tip_record: crack tips of the step; None: the criterion has no tips with a release rate.
        weakens_gradually: damage grows with the load, by a law of edges that is not brittle, or of cohesive cracks.
        softens_gradually: cells soften in the course of a step with inertia, where its forces balance; otherwise
            energy is released at once, at the end of a step.
        softened_fields: damage fields at the start of the step, if cells softened in its course on any rank.
    """

    phase = "fracture"
    softens_gradually = False
    softened_fields: list[Values] | None = None

    def __init__(
        self,
        stress: Stress,
        graph: EdgeGraph,
        criterion: FractureCriterion,
        law: EdgeLaw | None = None,
        *,
        max_passes: int | None = 1,
        initial_cuts: Values | None = None,
        degradation: Degradation | None = None,
        passes_per_second: float | None = None,
        node_attachment: NodeAttachment | None = None,
        tip_record: TipRecord | None = None,
        hinges: HingeRelease | None = None,
    ) -> None:
        """Assemble a pass from its parts (collective).

        Args:
            stress: stress of the body.
            graph: edges of the body.
            criterion: finds the edges that fail.
            law: law of the edges, brittle by default.
            max_passes: largest number of passes in a step; None: until nothing changes.
            initial_cuts: (edges,) cut positions of initial cracks.
            degradation: by default that of the fields of `stress`.
            passes_per_second: rate of passes, instead of `max_passes`: short steps may have none.
            node_attachment: spares edges that attach nodes without an unsplit cell.
            tip_record: of the crack tips in each step; None: the criterion has no tips with a release rate.
            hinges: finds the edges by which parts hang on one another without a ligament; None: they stay.
        """
        self.stress, self.graph, self.criterion, self.max_passes = stress, graph, criterion, max_passes
        self.law: EdgeLaw = law or BrittleEdgeLaw()
        self.weakens_gradually = not self.law.all_or_nothing
        self.degradation: Degradation = degradation or make_degradation(stress, graph)
        self.initial_cuts, self._passes_per_second = initial_cuts, passes_per_second
        self._node_attachment, self.tip_record, self._hinges = node_attachment, tip_record, hinges
        self._is_due, self._now, self._dt = True, 0.0, math.inf
        # Moving tips change their states in every pass, also where no edge breaks.
        self._has_tip_states = criterion.tip_states is not None
        if initial_cuts is not None:
            self.degradation.apply_initial_cracks()
        self._undamaged = UndamagedStress(stress, every_step=True)
        self._snapshot: DamageSnapshot | None = None

    @property
    def broken_edge_patterns(self) -> npt.NDArray[np.uint8]:
        """(cells,) broken edges of each cell, one bit each."""
        return self.graph.pattern

    @property
    def releases_gradually(self) -> bool:
        """Whether split cells release their energy over many steps."""
        return self.degradation.releases_gradually

    @property
    def nonfinite_cells(self) -> int:
        """Number of evaluations, on this rank, of cells so crushed that their stress is not finite."""
        return self._undamaged.not_finite

    def evaluate_undamaged_stress(self) -> tuple[Values, Values]:
        """Return Cauchy stress (cells, 3 or 6), Pa, and energy density (cells,), J/m^3, without damage."""
        return self._undamaged()

    def begin_step(self, t: float, dt: float) -> None:
        """Prepare a step of `dt` (s) from `t`: its number of passes, and the energy that may be released in it."""
        self.degradation.begin_step(t, dt)
        if self.tip_record is not None:
            self.tip_record.begin_step(t, dt)
        self._now, self._dt = t + dt, dt
        if self._passes_per_second is not None:
            self.max_passes = max(1, math.ceil(self._passes_per_second * dt))
            # Passes are due at multiples of the period: a step without such a time has none.
            self._is_due = math.floor(self._passes_per_second * (t + dt)) > math.floor(self._passes_per_second * t)

    def set_rates(self, v: Values, a: Values) -> None:
        """Store velocity (owned dofs,) in m/s and acceleration in m/s^2 for the next pass."""
        self.criterion.set_motion(v, a, self._now, self._dt)

    def __call__(self) -> FracturePassResult:
        """Carry out one pass at the present displacement (collective)."""
        stress, psi = self.evaluate_undamaged_stress()
        broken, weakened = self._weaken_failing_edges(stress, psi) if self._is_due else (0, 0)
        broken += self._break_idle_edges(broken)
        if self._hinges is not None and self._is_due:
            released = self.graph.break_edges(self._hinges(stress))
            broken, weakened = broken + released, weakened + released
            broken += self._break_idle_edges(released)
        gradual = self.degradation.releases_gradually
        before = [damage.x.array.copy() for damage in self.stress.damage_fields] if broken or gradual else []
        release = self.degradation(weakened > 0, stress, psi)
        if not broken and gradual and not sum_over_ranks(self.graph.domain.comm, int(release.chi_drop > 0))[0]:
            before = []
        if weakened or release.chi_drop or self._has_tip_states:
            self.mark_changed()
        return FracturePassResult(
            broken, release.chi_drop, release.released, release.elastic, release.exhausted, before
        )

    def _break_idle_edges(self, broken: int) -> int:
        """Break edges between split cells alone, which carry nothing, if `broken` edges broke; return their number."""
        return self.graph.break_unloaded_edges() if broken and self.degradation.breaks_idle_edges else 0

    def _weaken_failing_edges(self, stress: Values, psi: Values) -> tuple[int, int]:
        """Weaken the edges that fail; return the numbers of broken and of weakened edges (collective)."""
        edges, load = self.criterion(stress, psi)
        if self._node_attachment is not None:
            fails = self._node_attachment(edges, stress)
            edges, load = edges[fails], load[fails]
        integrity = self.law(load)
        if self.law.all_or_nothing:
            flags = np.zeros(len(self.graph.broken), bool)
            flags[edges[integrity == 0]] = True
            return (self.graph.break_edges(flags),) * 2
        # An edge that fails in several cells has the least integrity.
        lowered = np.ones(len(self.graph.broken))
        np.minimum.at(lowered, edges, integrity)
        return self.graph.weaken(lowered)

    # --- history variables ---

    def mark_changed(self) -> None:
        """Mark damage as different from the last snapshot."""
        self._snapshot = None

    def damage_restored(self) -> None:
        """Recompute the damage fields from edges and chi that were read from a checkpoint."""
        self.degradation.update_from_graph()
        self.mark_changed()

    def snapshot(self) -> DamageSnapshot:
        """Return copies of the damage of this rank; the same object until something changes."""
        if self._snapshot is None:
            fields = [damage.x.array.copy() for damage in self.stress.damage_fields]
            self._snapshot = DamageSnapshot(self.graph.integrity.copy(), fields, self.criterion.snapshot())
        return self._snapshot

    def restore(self, saved: object) -> bool:
        """Restore the damage that `snapshot` returned; returns True if it changed."""
        assert isinstance(saved, DamageSnapshot)
        # Nothing changed since this snapshot was taken.
        if saved is self._snapshot:
            return False
        self.graph.set_integrity(saved.integrity)
        self.stress.exchange_damage(saved.fields)
        self.criterion.restore(saved.criterion)
        self._snapshot = saved
        return True
