"""A pass on rank 0: surfaces opened one after the other on the arrays of the input mesh.

Where surfaces start: the highest load first, all that is near a start left out (non-maximum suppression).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...meshes.data import MeshData
from .crack_level_set import Curved, DirectionField, planar
from .grains import Grains, SurfaceRules
from .principal_stress import directions, material_normals
from .surface_cut import Body, Crossing, cut_places, settled, sides_of

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


class Starts:
    """Candidates of one pass, handed out one by one.

    Attributes:
        places: (n, d) of the candidates, m.
        spacing: m; no start is closer than this to another, or to one of the starts `taken` before.
    """

    def __init__(self, places: Values, load: Values, spacing: float, taken: Values) -> None:
        """`load` (n,): the highest goes first, the earlier candidate where loads are equal."""
        self.places, self.spacing = places, spacing
        self._left: Ints = np.argsort(-load, kind="stable")
        for place in taken:
            self.leave_out(place)

    def next(self) -> int | None:
        """The candidate loaded most of those left, which does not come again. None: none is left."""
        if not len(self._left):
            return None
        chosen = int(self._left[0])
        self._left = self._left[1:]
        return chosen

    def leave_out(self, place: Values, share: float = 1.0) -> None:
        """Take out the candidates closer than the spacing, or a share of it, to a place (d,)."""
        arm = self.places[self._left] - place
        self._left = self._left[np.einsum("ni,ni->n", arm, arm) >= (share * self.spacing) ** 2]

    def drop(self, candidates: npt.NDArray[np.bool_]) -> None:
        """Take out those flagged (n,)."""
        self._left = self._left[~candidates[self._left]]


@dataclass(frozen=True)
class Load:
    """Cells under load, by rows.

    Attributes:
        cell: (n,) in the input mesh.    load: (n,) largest principal stress over strength.
        stress: (n, d, d) Pa, in the present configuration.    gradient: (n, d, d) F.
    """

    cell: Ints
    load: Values
    stress: Values
    gradient: Values


@dataclass(frozen=True)
class Opened:
    """Surfaces opened in a pass.

    Attributes:
        starts: (s, d) where they started, m.
        keys: (n, 2) nodes of the edges that they cut, the lower first.    cut: (n,) where, from the lower node.
    """

    starts: Values
    keys: Ints
    cut: Values


class Pattern:
    """Opens surfaces in a mesh, on the rank that has it; made when the first surface starts."""

    def __init__(self, mesh: MeshData, rules: SurfaceRules, spacing: float, settle: bool) -> None:
        """`settle`: nodes that a surface leaves without a whole cell go over to its other side."""
        self.body, self.rules = Body(mesh), rules
        self._spacing, self._settle = spacing, settle
        self.grains = Grains(self.body, rules.grains, settle) if rules.grains is not None else None

    def open(
        self, load: Load, broken_keys: Ints, taken: Values, most: int, field: DirectionField | None = None
    ) -> Opened:
        """Up to `most` surfaces from the cells loaded most, none nearer than the spacing to another or to those `taken`
        (n, d) before. A cell that a surface of this pass has touched is relieved: none starts there."""
        body, places = self.body, self.body.centroids[load.cell]
        normals = material_normals(directions(load.stress, places, self.rules.seed), load.gradient)
        state, starts = _State(body, broken_keys), Starts(places, load.load, self._spacing, taken)
        at: list[Values] = []
        while len(at) < most and (start := starts.next()) is not None:
            cell = int(load.cell[start])
            if self._surface(state, cell, normals[start], field):
                at.append(places[start])
                starts.leave_out(places[start])
                starts.drop(state.touched[load.cell])
            elif self.grains is None:  # no room for two sides with whole cells
                starts.leave_out(places[start], 0.5)
            else:  # nothing to open around this grain
                starts.drop(self.grains.of_cell[load.cell] == self.grains.of_cell[cell])
        new = np.flatnonzero(~np.isnan(state.cut))
        return Opened(np.array(at).reshape(-1, body.dim), body.edges[new], state.cut[new])

    def _surface(self, state: _State, cell: int, normal: Values, field: DirectionField | None) -> bool:
        """Open the surface through a cell; returns whether it cuts anything."""
        grains = self.grains
        if grains is None:
            return self._by_level_set(state, cell, *self._level_set(state, cell, normal, field))
        own = int(grains.of_cell[cell])
        if grains.mode == "replace":
            sides = grains.of_node == own
            return self._along(grains, state, Crossing.of(self.body, sides, state.broken), None)
        phi = self._level_set(state, cell, normal, field)[1]
        sides = sides_of(grains.mean(phi), self.body.tolerance)[grains.of_node]
        return self._along(grains, state, Crossing.of(self.body, sides, state.broken), grains.edges_of(own))

    def _level_set(
        self, state: _State, cell: int, normal: Values, field: DirectionField | None
    ) -> tuple[Flags | None, Values]:
        """(N,) where phi is known (None: everywhere), and phi."""
        body, origin, known = self.body, self.body.centroids[cell], None
        if field is None:
            phi = planar(body.points, origin, normal)
        else:
            curved = Curved(body, field, state.broken)
            phi = curved(cell, origin, normal)
            known = ~np.isnan(phi)
            # the nodes around tell whether those of the surface have a cell on their own side
            phi = curved.extended(self._around(known) if self.grains is None else np.ones_like(known))
        return known, phi * self._sense(phi, cell)

    def _around(self, nodes: Flags) -> Flags:
        """(N,) nodes of the cells around nodes (N,)."""
        result = nodes.copy()
        result[self.body.cells[self.body.touching(nodes)]] = True
        return result

    def _sense(self, phi: Values, cell: int) -> float:
        """1 or -1: the lowest node of the cell that is not on the surface is on the positive side.

        Nodes on the surface go to that side, and a direction has no sense of its own.
        """
        nodes = np.sort(self.body.cells[cell])
        off = np.flatnonzero(np.abs(phi[nodes]) > self.body.tolerance)
        return 1.0 if not len(off) or phi[nodes[off[0]]] > 0 else -1.0

    def _by_level_set(self, state: _State, cell: int, known: Flags | None, phi: Values) -> bool:
        """Cut where phi changes its sign, as far as the surface through the cell goes."""
        body, sides = self.body, sides_of(phi, self.body.tolerance)
        complete = None if known is None else ~body.touching(~known)
        if self._settle:
            usable = state.whole if known is None else state.whole & body.touching(known)
            sides = settled(body, sides, usable, known)
        crossing = Crossing.of(body, sides, state.broken, complete)
        edges = crossing.connected(body.dim, body.cell_edges[cell])
        return state.note(crossing, edges, cut_places(phi, sides, body.edges[edges]))

    def _along(self, grains: Grains, state: _State, crossing: Crossing, seeds: Ints | None) -> bool:
        """Cut grain boundaries: all that are crossed, or those that are linked to the seeds (edges)."""
        edges = crossing.all() if seeds is None else crossing.connected(self.body.dim, seeds)
        return state.note(crossing, edges, grains.cut_of(edges))


class _State:
    """Damage during a pass.

    Attributes:
        broken: (E,).    cut: (E,) where edges are cut in this pass, NaN for all others.
        whole: (C,) cells that have not come apart.    touched: (C,) cells with an edge cut in this pass.
    """

    def __init__(self, body: Body, broken_keys: Ints) -> None:
        self._body = body
        self.broken = body.edge_flags(broken_keys)
        self.cut: Values = np.full(len(self.broken), np.nan)
        self.whole = body.whole(np.arange(len(body.cells)), self.broken)
        self.touched = np.zeros(len(body.cells), bool)

    def note(self, crossing: Crossing, edges: Ints, cut: Values) -> bool:
        """Break edges; returns whether there are any."""
        self.broken[edges], self.cut[edges] = True, cut
        cells = crossing.touched(edges, len(self.broken))
        self.touched[cells] = True
        self.whole[cells] = self._body.whole(cells, self.broken)
        return len(edges) > 0
