"""Fronts in space where nothing moves by itself: all of a front that is about to advance gets on, before the body is
solved for again.

A ball of 4 h cannot tell tips apart by less than some per cent (crack_front). So where a tip reaches G_c, those in its
ball that lack 3 % go with it, and each leads on: cells that its cut enters are cut by its plane, as far as 0.65 h from
it, one by one, no nearer than half of h to one another, in rounds without a solve: neighbours cut at once would not
meet. A tip that was looked at and has less stays, wherever the others go. A front gets on by h in 1.3 to 1.9 solves,
where it took five. Tips that are not mature go by stress, which a cell changes, and do not lead.

Equations: docs/theory.md#tip-criterion.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from ...mesh.parallel import allgather
from ...mesh.simplices import is_split
from ..criterion import Edges
from .cut_plane import Cuts, cleave
from .tip_criterion import APART, CrackTips, Proposal
from .tip_fields import Seen
from .tip_neighbourhoods import Tips

Flags = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]

ABOUT = 0.03  # of G_c: what a tip may lack that goes with another
FAR = 0.65  # h: how far a tip leads on


class RowTips(CrackTips):
    """Cells that cracks in space cut next, a row of them."""

    shares = True
    course = 7  # a plane: the place of the tip that leads, m, the normal, and sigma_1 in Pa

    def __call__(self, stress: Values, psi: Values) -> tuple[Edges, Values]:
        """The edges that cracks cut now, as loaded as they may be (collective)."""
        self._leading = self._none(0)
        return super().__call__(stress, psi)

    def _ready(self, size: Values, toughness: Values, tips: Tips) -> tuple[Flags, Flags]:
        """(n,) which tips reach G_c, or lack little of it in the ball of one that does; none goes on as two
        (collective)."""
        reach = size >= toughness
        first = tips.point[reach & tips.mature & ~self.barred[tips.cell]]
        every = np.concatenate(allgather(self._domain.comm, first))
        if not len(every):
            return reach, np.zeros(len(tips), bool)
        near = cKDTree(every).query(tips.point)[0] < self.disc * self._h[tips.cell]
        return reach | (near & (size >= (1 - ABOUT) * toughness)), np.zeros(len(tips), bool)

    def _grown(self, seen: Seen) -> Proposal:
        """Tips that advance, each on its plane; those that go by G lead on."""
        grown = super()._grown(seen)
        normals = self._normals(grown.stress, grown.cells)
        mature = seen.tips.mature[np.searchsorted(seen.tips.cell, grown.cells)]
        grown = replace(grown, ahead=np.column_stack([grown.place, normals, -grown.rank[:, 1]]), turns=mature)
        self._leading = grown.taken(mature)
        return grown

    def _none(self, kind: int) -> Proposal:
        """Nothing of a kind."""
        return replace(super()._none(kind), ahead=np.empty((0, self.course)))

    def _way_out(self, grown: Proposal) -> Cuts:
        """Where planes cut their cells."""
        assert grown.ahead is not None
        return cleave(self._corners(grown.cells), self._cut_by_now(grown.cells), grown.place, grown.ahead[:, 3:6])

    def _beyond(self, edges: Edges, courses: Values) -> Edges:
        """All that is cut, edges (n,) being so already, on planes (n, 7); 0: of nobody who leads (collective)."""
        found, cells, planes = [edges], self._leading.cells, np.zeros((len(self._h), self.course))
        own = np.zeros(len(self._h), bool)
        own[cells], planes[cells] = True, self._leading.ahead
        led = np.zeros((len(self._graph.broken), self.course))
        while True:
            led[edges] = courses
            self._take_over(planes, led, own)
            (onwards,) = self._chosen(self._next(planes))
            if self._idle:
                break
            self.cells = np.concatenate([self.cells, onwards.cells])
            edges, courses = self._remembered(self._rows(onwards, self._way_out(onwards)))
            found.append(edges)
        self._idle = False
        return np.concatenate(found)

    def _take_over(self, planes: Values, led: Values, own: Flags) -> None:
        """Whole cells go on with the planes (cells, 7) of the edges (edges, 7) by which they were entered, that of the
        most loaded tip; but those that lead themselves have their `own`."""
        graph = self._graph
        entered = np.any(led[:, 3:6], axis=1)[graph.cell_edges].any(axis=1)
        cells = np.flatnonzero(entered & ~(graph.damaged | own))
        first = np.argmax(led[graph.cell_edges[cells], 6], axis=1)
        planes[cells] = led[graph.cell_edges[cells, first]]

    def _next(self, planes: Values) -> Proposal:
        """Cells that have not come apart by now, nearer to the tips whose planes they have than FAR."""
        cells = np.flatnonzero(np.any(planes[:, 3:6], axis=1) & ~(self._graph.split | self.barred)).astype(np.int64)
        cut = self._cut_by_now(cells)
        whole = ~is_split(3)[cut @ (1 << np.arange(6))]
        cells, cut = cells[whole], cut[whole]
        places = self.sight.places(self._graph.cell_edges[cells], self.cut)
        middle = np.einsum("nk,nki->ni", cut, places) / cut.sum(axis=1, keepdims=True)
        near = np.linalg.norm(middle - planes[cells, :3], axis=1) <= FAR * self._h[cells]
        cells, middle = cells[near], middle[near]
        rank = self._ranked(0, planes[cells, 6], self._numbers(cells), middle, APART[3] * self._h[cells])
        none, all_ = np.empty((len(cells), 3, 3)), np.ones(len(cells), bool)
        return Proposal(rank, cells, none, np.zeros(len(cells), np.int64), planes[cells], all_, ~all_)

    def _cut_by_now(self, cells: Ints) -> Flags:
        """(n, 6) edges of cells (n,) that are broken, or cut in this pass."""
        return ~self._graph.intact(cells) | ~np.isnan(self.cut[self._graph.cell_edges[cells]])
