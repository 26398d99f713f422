"""A pass of fracture at the end of a step: which edges fail, and what that leaves of the energy of their cells."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from ..mechanics.stress import Stress
from ..mesh.edge_graph import EdgeGraph
from .criterion import Criterion
from .degradation import Degradation, make_degradation
from .edge_law import Brittle, EdgeLaw
from .effective_stress import Undamaged
from .node_retention import Joining

Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class PassResult:
    """What one pass did.

    Attributes:
        broken: edges that broke, on all ranks.    loss: most that chi of a cell of this rank lost.
        released: elastic energy that went with them on this rank, J.    elastic: what is left of it, J.
        died: whether cells of this rank lost the last of their stress.
        before: copies of the fields of damage before the pass, where edges broke.
    """

    broken_edges: int
    largest_chi_loss: float
    released_energy: float
    elastic_energy: float
    cells_died: bool
    previous_damage: list[Values] = field(default_factory=list)


@dataclass(frozen=True)
class Damage:
    """What is damaged at a time: integrity of local edges, the fields of damage, and what the criterion remembers."""

    integrity: Values
    fields: list[Values]
    criterion: object


class Breaking:
    """Weakens the edges that a criterion finds overloaded, and their cells: a part of timestepping.protocols.

    Attributes:
        graph: edges and their integrity.    criterion: which edges fail.    law: what is left of an edge that does.
        degradation: what broken edges take out of the energy.
        max_passes: most passes in a step; None: until nothing changes.
        opened: (edges,) where edges that were broken before the start are cut, NaN elsewhere; None: there are none.
    """

    phase = "fracture"

    def __init__(
        self,
        stress: Stress,
        graph: EdgeGraph,
        criterion: Criterion,
        law: EdgeLaw | None = None,
        *,
        max_passes: int | None = 1,
        opened: Values | None = None,
        degradation: Degradation | None = None,
        pace: float | None = None,
        joining: Joining | None = None,
    ) -> None:
        """`pace`: passes a second, in place of `passes`: in short steps not one in each; `joining`: which of the edges
        that fail hold nodes that would be crumbs (collective)."""
        self.stress, self.graph, self.criterion, self.max_passes = stress, graph, criterion, max_passes
        self.law: EdgeLaw = law or Brittle()
        self.degradation: Degradation = degradation or make_degradation(stress, graph)
        self.opened, self._pace, self._joining = opened, pace, joining
        self._due, self._now, self._dt = True, 0.0, math.inf
        self._restless = criterion.carried is not None  # remembers more than what broke
        if opened is not None:
            self.degradation.opened()
        self._undamaged = Undamaged(stress, often=True)
        self._memory: Damage | None = None

    @property
    def broken_edge_patterns(self) -> npt.NDArray[np.uint8]:
        """(cells,) broken edges of each cell."""
        return self.graph.pattern

    @property
    def nonfinite_cells(self) -> int:
        """Cells of this rank whose stress was no number (crushed flat), over all passes."""
        return self._undamaged.not_finite

    def evaluate(self) -> tuple[Values, Values]:
        """Cauchy stress (cells, 3 or 6) in Pa and energy density (cells,) in J/m^3 of the undamaged material."""
        return self._undamaged()

    def begin_step(self, t: float, dt: float) -> None:
        """A step of dt (s) from t on is solved: no more passes than cracks have time for, nor more let go."""
        self.degradation.begin(t, dt)
        self._now, self._dt = t + dt, dt
        if self._pace is not None:
            self.max_passes = max(1, math.ceil(self._pace * dt))
            self._due = math.floor(self._pace * (t + dt)) > math.floor(self._pace * t)

    def set_rates(self, v: Values, a: Values) -> None:
        """The body that the next pass looks at moves so: (owned dofs,) in m/s and m/s^2."""
        self.criterion.moving(v, a, self._now, self._dt)

    def __call__(self) -> PassResult:
        """One pass on the current displacement (collective)."""
        stress, psi = self.evaluate()
        broken, weakened = self._broken(stress, psi) if self._due else (0, 0)
        if broken and self.degradation.idle:
            broken += self.graph.break_unloaded_edges()
        before = [each.x.array.copy() for each in self.stress.damage_fields] if broken else []
        lost = self.degradation(weakened > 0, stress, psi)
        if weakened or lost.loss or self._restless:
            self.changed()
        return PassResult(broken, lost.loss, lost.released, lost.elastic, lost.died, before)

    def _broken(self, stress: Values, psi: Values) -> tuple[int, int]:
        """Weaken what fails: how many edges broke, and how many lost anything (collective)."""
        edges, load = self.criterion(stress, psi)
        if self._joining is not None:
            fail = self._joining(edges, stress)
            edges, load = edges[fail], load[fail]
        return self._weaken(edges, load)

    def _weaken(self, edges: npt.NDArray[np.integer], load: Values) -> tuple[int, int]:
        """Give edges (n,) under a load (n,), in units of their strength, what the law leaves them.

        Returns how many broke, and how many lost anything (collective).
        """
        kept = self.law(load)
        if self.law.all_or_nothing:
            flags = np.zeros(len(self.graph.broken), bool)
            flags[edges[kept == 0]] = True
            return (self.graph.break_edges(flags),) * 2
        left = np.ones(len(self.graph.broken))
        np.minimum.at(left, edges, kept)
        return self.graph.weaken(left)

    # --- what it remembers ---

    def changed(self) -> None:
        """Damage is not what `memory` gave last: edges were weakened from elsewhere."""
        self._memory = None

    def damage_restored(self) -> None:
        """Edges and chi were read from a checkpoint: bring the other fields of damage to them."""
        self.degradation.restore()
        self.changed()

    def snapshot(self) -> Damage:
        """Copies of the damage of now, on this rank; the same object until something changes."""
        if self._memory is None:
            fields = [each.x.array.copy() for each in self.stress.damage_fields]
            self._memory = Damage(self.graph.integrity.copy(), fields, self.criterion.memory())
        return self._memory

    def restore(self, saved: object) -> bool:
        """Be damaged as `memory` says; whether that is anything else than now."""
        assert isinstance(saved, Damage)
        if saved is self._memory:
            return False
        self.graph.set_integrity(saved.integrity)
        self.stress.exchange_damage(saved.fields)
        self.criterion.recall(saved.criterion)
        self._memory = saved
        return True
