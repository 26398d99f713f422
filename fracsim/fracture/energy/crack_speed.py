"""Cracks that carry their speed, and branch where it does not take up what flows to them (in the plane, with inertia).

    v = c_R (1 - G_c / G*),   G* = G / (1 - v / c_R)     up to c_R / 2, taken up over R / c_R
    mean of G over R / c_R >= 2 G_c                      the crack branches

G* is what would flow to the tip if it stood (Freund 1972); R / c_R is the time of a Rayleigh wave through its disc.
Where G is G_c, G* grows with the speed, and is that of two cracks at half of c_R. From there on the crack could become
two that set off from rest (Eshelby 1970), and in glass and PMMA it sheds short side branches, which take up what flows,
instead of getting faster (Sharon and Fineberg 1999). So here it goes no faster, and G grows over G_c. Where that is
2 G_c, two cracks that run at half of c_R take it up: the crack becomes these, and they keep its speed. In a strip that
stores less than 2 G_c a metre so much does not flow; at single looks, between the cuts of two cells, G is up to a
quarter over what flows.

A tip cuts a cell as it comes to it. By G >= G_c at each look it ran on at c_R and stood in turn, since what it has cut
is let go over R / c_R: G went from 0.4 to 2.2 G_c, and at which look a crack branched was chance. Only where no other
tip's disc lies over its own, and in steps in which a wave stays in the disc: in longer ones a crack gets on by more
than that, and goes by G >= G_c, as one.

Equations: docs/theory.md#crack-speed-and-branching.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Any

import numpy as np
import numpy.typing as npt

from ...mesh.simplices import local_edges
from ..criterion import Edges
from .branching import TIPS
from .cut_plane import Cuts
from .tip_criterion import CrackTips, Proposal
from .tip_fields import Seen
from .tip_neighbourhoods import Tips

Flags = npt.NDArray[np.bool_]
Values = npt.NDArray[np.float64]

FASTEST = 1 / TIPS  # 1 - v / c_R where G* is that of two cracks, and G that of one


class Carried(IntEnum):
    """What is kept of a tip, at the edge by which it came in."""

    SLOW = 0  # 1 - v / c_R
    LEFT = 1  # m to go before it is there
    FLOW = 2  # mean of G / G_c, of late
    AT = 3  # s, when that was so; NaN: nobody has looked


STANDS = 1.0, 0.0, 0.0, np.nan


def slower(slow: Values, flow: Values, time: Values) -> Values:
    """(n,) 1 - v / c_R of tips at which it was `slow`, after a `time`, R / c_R, in which G is `flow`, G_c.

    G_c / G* = slow / flow is what it is to be, and between that of a crack that stands and FASTEST.
    """
    wanted = slow / np.maximum(flow, slow)
    return np.maximum(later(slow, wanted, time), FASTEST)


def later(before: Values, wanted: Values, time: Values) -> Values:
    """(n,) what was `before` goes to what is `wanted`, over 1 of `time`."""
    return np.asarray(wanted + (before - wanted) * np.exp(-time))


class RunningTips(CrackTips):
    """Cells that running cracks, which may branch, cut next. In steps that see no waves they go as `CrackTips` do.

    Attributes:
        carried: (edges, 4) of the tip that came in by each local edge (`Carried`).
    """

    forks = True
    carried: Values

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.carried = np.tile(STANDS, (len(self._graph.broken), 1))
        self._due: Flags = np.empty(0, bool)

    def memory(self) -> object:
        """Where cracks cut, and how they run."""
        return super().memory(), self.carried.copy()

    def recall(self, memory: object) -> None:
        """As then."""
        assert isinstance(memory, tuple)
        cut, self.carried[:] = memory
        super().recall(cut)

    def _ready(self, size: Values, toughness: Values, tips: Tips) -> tuple[Flags, Flags]:
        """(n,) which tips have come to the end of what they cut last, in long steps reach G_c; and which go on as
        two."""
        entry, rate = self._graph.cell_edges[tips.cell, self._entry(tips.cell)], self._rate[tips.cell]
        slow, left, flow, at = self.carried[entry].T
        time = np.where(np.isnan(at), 0.0, self._now - at)
        slow = np.where(tips.mature & (size > 0), slower(slow, size / toughness, rate * time), 1.0)
        flow = later(flow, size / toughness, rate * time)
        left = left - (1 - slow) * rate * self.disc * self._h[tips.cell] * time
        self.carried[entry] = np.column_stack([slow, left, flow, np.full(len(at), self._now)])
        self._due = (slow < 1) & (left <= 0)
        sees = self._sees_waves(tips)
        return np.where(sees, self._due, size >= toughness), tips.alone & (flow >= TIPS) & sees

    def _sees_waves(self, tips: Tips) -> Flags:
        """(n,) whether a Rayleigh wave stays in the disc of a tip within a step."""
        return np.asarray(self._rate[tips.cell] * self._dt <= 1)

    def _grown(self, seen: Seen) -> Proposal:
        """Tips that advance; those that have come to the end of a cell and may not go on stand."""
        self._due = np.zeros(len(seen.tips), bool)
        grown = super()._grown(seen)
        cell = seen.tips.cell[self._due]
        cell = cell[~np.isin(cell, grown.cells)]
        held = self._graph.cell_edges[cell, self._entry(cell)]
        self.carried[held, Carried.SLOW], self.carried[held, Carried.LEFT] = STANDS[:2]
        return grown

    def _rows(self, cracks: Proposal, cuts: Cuts) -> Values:
        """With what tips carry to where they leave their cells; branches are as fast as the crack."""
        rows, cells = super()._rows(cracks, cuts), cracks.cells[cuts.row]
        if cracks.entry is None:
            return np.column_stack([rows, np.tile(STANDS, (len(rows), 1))])
        carried = self.carried[self._graph.cell_edges[cells, cracks.entry[cuts.row]]]
        ends = self._corners(cells)[np.arange(len(cells))[:, None], local_edges(2)[cuts.edge]]
        place = ends[:, 0] + cuts.share[:, None] * (ends[:, 1] - ends[:, 0])
        carried[:, Carried.LEFT] += np.linalg.norm(place - cracks.place[cuts.row], axis=1)
        return np.column_stack([rows, carried])

    def _remembered(self, rows: Values) -> tuple[Edges, Values]:
        """As others, and what tips carry there (collective)."""
        edges, rest = super()._remembered(rows)
        self.carried[edges] = rest[:, self.course :]
        return edges, rest[:, : self.course]
