"""Speed of crack tips in 2D with inertia, and the criterion by which cracks branch.

    v = c_R (1 - G_c / G*),   G* = G / (1 - v / c_R)     up to c_R / 2, with a relaxation time of R / c_R
    mean of G over R / c_R >= 2 G_c                      the crack branches

G* is the energy release rate of a tip at rest (Freund 1972), and R / c_R the time of a Rayleigh wave through its disc.
Where G = G_c, G* grows with the speed, and at c_R / 2 it is that of two cracks: from there on the crack could become
two that start from rest (Eshelby 1970). In glass and PMMA it sheds short side branches instead of a higher speed
(Sharon and Fineberg 1999). The speed is therefore limited, and G grows beyond G_c. At 2 G_c two cracks at c_R / 2 take
up the energy: the crack branches, and both keep its speed.

A tip cuts a cell when it has travelled through it. With G >= G_c alone it would alternate between c_R and rest, since
the energy of a cut cell is released over R / c_R. The speed is used where no disc of another tip overlaps, and in steps
in which a wave does not leave the disc. In other cases the criterion of a tip is G >= G_c.

Equations: docs/theory.md#crack-speed-and-branching.
"""

from __future__ import annotations

from enum import IntEnum
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from ..criterion import Edges
from .crack_initiation import CutProposal
from .cut_plane import EdgeCuts
from .tip_criterion import TipCriterion, reference_corners
from .tip_fields import TipFields
from .tip_neighbourhoods import CrackTips
from .tip_parameters import TIP

Flags = npt.NDArray[np.bool_]
Values = npt.NDArray[np.float64]


class TipState(IntEnum):
    """Columns of the state of a tip, stored at the edge by which it came in."""

    SLOWNESS = 0  # 1 - v / c_R
    REMAINING = 1  # distance to the point at which the tip leaves its cell, m
    FLOW = 2  # recent mean of G / G_c
    TIME = 3  # time of the last update, s; NaN: never updated


AT_REST = 1.0, 0.0, 0.0, np.nan


def relax_slowness(slowness: Values, flow: Values, time: Values) -> Values:
    """Return 1 - v / c_R (n,) after a time (n,), in R / c_R, in which G is `flow` (n,), in G_c.

    The target is G_c / G* = slowness / flow, between 1 at rest and 1 / TIP.branching_ratio.
    """
    target = slowness / np.maximum(flow, slowness)
    # At the largest speed G* is that of two cracks, and G that of one.
    return np.maximum(relax(slowness, target, time), 1 / TIP.branching_ratio)


def relax(before: Values, target: Values, time: Values) -> Values:
    """Return values (n,) that relax exponentially towards a target (n,), after a time (n,) in relaxation times."""
    return np.asarray(target + (before - target) * np.exp(-time))


class RateDependentTipCriterion(TipCriterion):
    """Tip criterion with crack speed and branching; in steps too long for waves it is `TipCriterion`.

    Attributes:
        tip_states: (edges, 4) state of the tip that came in by each local edge (`TipState`).
    """

    may_branch = True
    tip_states: Values

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Build the criterion with tips at rest; arguments are those of `TipCriterion` (collective)."""
        super().__init__(*args, **kwargs)
        self.tip_states = np.tile(AT_REST, (len(self._graph.broken), 1))
        self._arrived: Flags = np.empty(0, bool)

    def snapshot(self) -> object:
        """Return copies of the cut positions and of the states of tips."""
        return super().snapshot(), self.tip_states.copy()

    def restore(self, saved: object) -> None:
        """Restore the cut positions and states that `snapshot` returned."""
        assert isinstance(saved, tuple)
        cut_positions, self.tip_states[:] = saved
        super().restore(cut_positions)

    def restore_cuts(self, cut_positions: Values, tip_states: Values | None) -> None:
        """Restore the cut positions (edges,) and the states of tips (edges, 4) that a checkpoint stored."""
        super().restore_cuts(cut_positions, tip_states)
        if tip_states is not None:
            defined = ~np.isnan(tip_states[:, 0])
            self.tip_states[defined] = tip_states[defined]

    @cached_property
    def _rate(self) -> Values:
        """c_R / R (cells,), 1/s."""
        return self.release_rate()

    def _find_critical_tips(self, size: Values, toughness: Values, tips: CrackTips) -> tuple[Flags, Flags]:
        """Return which tips (n,) have arrived at the end of their cell (in long steps: reach G_c), and which branch."""
        entry, rate = self._graph.cell_edges[tips.cell, self._graph.first_broken_edge(tips.cell)], self._rate[tips.cell]
        slowness, remaining, flow, updated = self.tip_states[entry].T
        # A tip without a state has just appeared.
        time = np.where(np.isnan(updated), 0.0, self._now - updated)
        # Young tips, and tips with a force backwards, are at rest.
        relaxed = relax_slowness(slowness, size / toughness, rate * time)
        slowness = np.where(tips.mature & (size > 0), relaxed, 1.0)
        flow = relax(flow, size / toughness, rate * time)
        # v = (1 - slowness) c_R, and c_R = rate R.
        wave_speed = rate * self.disc_radius_ratio * self._h[tips.cell]
        remaining = remaining - (1 - slowness) * wave_speed * time
        times = np.full(len(updated), self._now)
        self.tip_states[entry] = np.column_stack([slowness, remaining, flow, times])
        self._arrived = (slowness < 1) & (remaining <= 0)
        resolved = self._resolves_waves(tips)
        critical = np.where(resolved, self._arrived, size >= toughness)
        return critical, tips.alone & (flow >= TIP.branching_ratio) & resolved

    def _resolves_waves(self, tips: CrackTips) -> Flags:
        """Return whether a Rayleigh wave stays in the disc of a tip (n,) within a step."""
        return np.asarray(self._rate[tips.cell] * self._dt <= 1)

    def _propose_advances(self, fields: TipFields) -> CutProposal:
        """Propose the cells of tips that advance; tips at the end of a cell that may not advance come to rest."""
        self._arrived = np.zeros(len(fields.tips), bool)
        advances = super()._propose_advances(fields)
        cell = fields.tips.cell[self._arrived]
        # A tip that arrived and is not allowed to cut the next cell stops.
        cell = cell[~np.isin(cell, advances.cells)]
        stopped = self._graph.cell_edges[cell, self._graph.first_broken_edge(cell)]
        self.tip_states[stopped, TipState.SLOWNESS], self.tip_states[stopped, TipState.REMAINING] = AT_REST[:2]
        return advances

    def _cut_rows(self, proposal: CutProposal, cuts: EdgeCuts) -> Values:
        """Return rows with the states of tips appended (n, 4); branches keep the speed of the crack."""
        rows, cells = super()._cut_rows(proposal, cuts), proposal.cells[cuts.row]
        if proposal.entry is None:
            return np.column_stack([rows, np.tile(AT_REST, (len(rows), 1))])
        states = self.tip_states[self._graph.cell_edges[cells, proposal.entry[cuts.row]]]
        exit_points = cuts.points(reference_corners(self._domain, proposal.cells))
        # The distance through the next cell adds to what remained.
        states[:, TipState.REMAINING] += np.linalg.norm(exit_points - proposal.point[cuts.row], axis=1)
        return np.column_stack([rows, states])

    def _store_cuts(self, rows: Values) -> tuple[Edges, Values]:
        """Store cuts and the states of the tips there; return new edges (n,) and courses (n, 2) (collective)."""
        edges, columns = super()._store_cuts(rows)
        self.tip_states[edges] = columns[:, self.course_width :]
        return edges, columns[:, : self.course_width]
