"""What breaks of a body, or of several in one mesh: its cells, edges and pieces.

A blow on a piece is analysed, surfaces open where the averaged principal stress reaches the strength, and the pieces
that come of it are analysed in turn under what of the blow falls on them, until nothing breaks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt

from ..fracture.brittle.surface_criterion import BrittleSurfaces
from ..fracture.criterion import CellAverage
from ..fracture.edge_stress import frobenius_norm
from ..fracture.nonlocal_average import NeighbourAverage
from ..mechanics.stress import Stress
from ..mesh.edge_graph import EdgeGraph
from ..mesh.fragments import Fragments, find_fragments
from ..mesh.input_topology import MeshTopology
from ..solvers.petsc_options import PetscOptions
from .surface_loads import PointLoads, patches, point_loads

if TYPE_CHECKING:
    from .denting import Flow, Shape

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

# Share of its stiffness that a cell keeps whose parts are of one piece still: a crack that ends in the body is open,
# and the nodes between its sides stay in place.
CRACKED = 1e-3


class Within:
    """An average over the cells of one piece: `cells` (cells,) flags say of which. It wraps another, or none."""

    def __init__(self, average: CellAverage | None, count: int) -> None:
        self._average = average
        self.cells: Flags = np.ones(count, bool)

    def __call__(self, values: Values, active: Flags | None = None) -> Values:
        """Averages (cells, n) of cell values (cells, n) over active cells of the piece; 0 outside of it."""
        values = np.where(self.cells[:, None], values, 0.0)
        return values if self._average is None else self._average(values, self._both(active))

    def find_averages_above(
        self, values: Values, norms: Values, bound: float, active: Flags | None = None
    ) -> tuple[npt.NDArray[np.int64], Values]:
        """Cells (m,) of the piece whose average may reach a bound, and those averages (m, n)."""
        if self._average is None:
            cells = np.flatnonzero((norms >= bound) & self.cells)
            return cells, values[cells]
        if isinstance(self._average, NeighbourAverage):
            cells = np.flatnonzero(self.cells)
            return self._average.find_averages_above_in(cells, values, norms, bound, self._both(active))
        cells, found = self._average.find_averages_above(values, norms, bound, self._both(active))
        mine = self.cells[cells]
        return cells[mine], found[mine]

    def _both(self, active: Flags | None) -> Flags:
        return self.cells if active is None else self.cells & active


@dataclass(frozen=True)
class Opened:
    """What a strike on the body of a name opened: keys (n, 2) of edges and where they are cut, (n,), starts (k, 3) of
    surfaces, m; analyses, and iterations of CG in them; or the shape of its mesh now, where it flowed."""

    name: int
    keys: Ints
    cut: Values
    starts: Values
    passes: int
    iterations: int
    shape: Shape | None = None


class Analysis(Protocol):
    """Of one free body: its cells' shares, and what it moves by under forces at the nodes of the mesh."""

    share: Values

    @property
    def iterations(self) -> int: ...

    def __call__(self, force: Values) -> Values: ...

    def destroy(self) -> None: ...


class Operator(Protocol):
    """Of the mesh: what solves for its bodies (rigid.free_body_analysis, rigid.shell_analysis); `finest`: m, their
    least size."""

    stress: Stress

    @property
    def finest(self) -> float: ...

    def whole(self, options: PetscOptions | None = None) -> Analysis: ...

    def body(self, share: Values, options: PetscOptions | None = None) -> Analysis: ...

    def tensor(self, u: Values, share: Values) -> Values: ...


class Breakable:
    """Bodies in one mesh, on one rank.

    Attributes:
        graph: their edges.    pieces: what holds together.    passes: analyses made so far.
        iterations: of CG in them.
    """

    def __init__(
        self,
        stiffness: Operator,
        graph: EdgeGraph,
        criterion: BrittleSurfaces | None,
        within: Within,
        options: PetscOptions | None = None,
        flow: Flow | None = None,
        heed: Callable[[], None] | None = None,
    ) -> None:
        """`criterion`: where surfaces open, averaging by `within`; None: nothing does.    `options`: PETSc's.
        `flow`: of what does not break; None: nothing flows.    `heed`: is called before an analysis, and raises
        Abandoned where the run is to stop."""
        self._heed = heed
        self._stiffness, self._criterion, self._within, self._options = stiffness, criterion, within, options
        self._flow = flow
        self._domain, self.graph, self.passes, self.iterations = stiffness.stress.domain, graph, 0, 0
        self._corners = np.ascontiguousarray(self._domain.cell_nodes.T)
        self._kept: dict[int, Analysis] = {}  # by the lowest node of the piece
        self._node = np.argsort(self._domain.node_input)  # of each node of the input mesh
        self._find_pieces()

    def _find_pieces(self) -> None:
        self.pieces: Fragments = find_fragments(self.graph)
        self._length: Values | None = None

    def damage(self) -> tuple[npt.NDArray[np.uint8], Values]:
        """Patterns (C,) of the cells and, of each edge (E,), where it is cut, in the order of the input mesh."""
        domain, source = self._domain, self._domain.source
        assert source is not None
        pattern = np.empty(domain.cell_count, np.uint8)
        pattern[domain.cell_input] = self.graph.pattern
        edges = np.arange(len(self.graph.broken))
        cut = np.full(len(edges), np.nan)
        if self._criterion is not None:
            cut[MeshTopology(source).find_edges(self.graph.edge_keys(edges))] = self._criterion.cut_positions
        return pattern, cut

    def saved(self) -> dict[str, npt.NDArray[Any]]:
        """What a checkpoint keeps: keys (n, 2) of broken edges, where they are cut, and where surfaces started."""
        if self._criterion is None:
            return {}
        keys, cut = self.graph.gather_broken(self._criterion.cut_positions[:, None])  # type: ignore[misc]
        return {"broken": keys, "cut": cut, "starts": self._criterion.starts}

    def restore(self, saved: dict[str, npt.NDArray[Any]]) -> None:
        """Be as `saved` said."""
        if self._criterion is None:
            return
        self.graph.break_edges(self.graph.flags_of_keys(saved["broken"]))
        local, place = self.graph.find_keys(saved["broken"])
        self._criterion.cut_positions[local], self._criterion.starts = saved["cut"][place, 0], saved["starts"]
        self._find_pieces()

    def piece_of(self, name: int) -> int:
        """The piece that a node of the input mesh is in."""
        return int(self.pieces.node_fragment[self._node[name]])

    def may_break(self, piece: int, force: float) -> bool:
        """Whether forces of this sum (N) could break a piece, or have it flow: no beam of its length, an edge thick,
        has a higher stress; and there are surfaces left to open."""
        if not self.left:
            return False
        if self._length is None:
            self._length = self._lengths()
        h = self._stiffness.finest
        weakest = self._flow.weakest if self._criterion is None else self._criterion.strength.minimum  # type: ignore[union-attr]
        return bool(2 * force * max(float(self._length[piece]), h) / h**3 >= weakest)

    def _lengths(self) -> Values:
        """(pieces,) diagonals of the boxes around them, m."""
        piece, X = self.pieces.node_fragment, self._domain.nodes
        order = np.argsort(piece, kind="stable")
        start = np.searchsorted(piece[order], np.arange(int(piece.max()) + 1))
        sides = np.maximum.reduceat(X[order], start) - np.minimum.reduceat(X[order], start)
        return np.asarray(np.linalg.norm(sides, axis=1))

    def loads(self, piece: int, points: Values, force: Values, radius: Values | None = None) -> PointLoads:
        """Forces (k, d) at points (k, d) of a piece at rest, on circles of radii (k,), m; None: at points."""
        if radius is not None:
            radius = radius if self._flow is None else np.maximum(radius, self._flow.pressed(force))
            points, force = patches(points, force, radius, self._domain.mean_edge_length)
        cells = self._domain.cell_nodes[self.shares(piece) > 0].astype(np.int64)
        return point_loads(self._domain.nodes, cells, points, force)

    def shares(self, piece: int) -> Values:
        """(cells,) what of each cell belongs to a piece: as many parts as it has nodes of it; of a cell in which a
        crack ends, hardly anything."""
        share = self._count(self.pieces.node_fragment == piece) / len(self._corners)
        share[self.graph.split & (share == 1)] = CRACKED
        return share

    def _count(self, nodes: Flags) -> npt.NDArray[np.int8]:
        """(cells,) how many of their nodes have a flag (nodes,): a tenth of the time of NumPy's sum."""
        flags = nodes.view(np.int8)
        return np.asarray(sum(flags[each] for each in self._corners))

    def stress(self, piece: int, loads: PointLoads) -> Values:
        """(cells, 3 or 6) stress of a piece under loads that fall on it, 0 in all other cells, Pa. Raises
        NotConverged, and Abandoned where the run is to stop."""
        if self._heed is not None:
            self._heed()
        body = self._free(piece)
        self.passes += 1
        u = body(loads.nodal(len(self._domain.nodes)))
        self.iterations += body.iterations
        return self._stiffness.tensor(u, body.share)

    def _free(self, piece: int) -> Analysis:
        """The analysis of a piece, kept until it breaks; of all cells it is that of all copies of the mesh."""
        key = int(np.flatnonzero(self.pieces.node_fragment == piece)[0])
        if key not in self._kept:
            share = self.shares(piece)
            if np.all(share == 1):
                return self._stiffness.whole(self._options)
            self._kept[key] = self._stiffness.body(share, self._options)
        return self._kept[key]

    @property
    def left(self) -> int:
        """Surfaces that may still open; 1 of what flows, for one blow after the other does."""
        return int(self._flow is not None) if self._criterion is None else self._criterion.remaining

    @property
    def breaks(self) -> bool:
        """Whether a surface may still open."""
        return self._criterion is not None and self._criterion.remaining > 0

    def opened(self, name: int, loads: PointLoads, share: int, energy: float = np.inf) -> Opened:
        """What a strike opens that may start `share` surfaces, or what shape it leaves with an energy to spend, J;
        whether they count is up to `take`. Raises NotConverged."""
        criterion = self._criterion
        if criterion is None:
            return self._dented(name, loads, energy)
        before, starts, passes, iterations = self.graph.broken.copy(), criterion.starts, self.passes, self.iterations
        criterion.reserved = criterion.remaining - share
        try:
            self.strike(self.piece_of(name), loads)
        finally:
            more, criterion.starts, criterion.reserved = criterion.starts[len(starts) :], starts, 0
        edges = np.flatnonzero(self.graph.broken & ~before)
        done = self.passes - passes, self.iterations - iterations
        self.passes, self.iterations = passes, iterations
        return Opened(name, self.graph.edge_keys(edges), criterion.cut_positions[edges], more, *done)

    def _dented(self, name: int, loads: PointLoads, energy: float) -> Opened:
        """What shape a strike leaves. Raises NotConverged."""
        assert self._flow is not None
        piece, iterations, passes = self.piece_of(name), self.iterations, self.passes
        body, stress = self._free(piece), self.stress(piece, loads)
        shape = self._flow(body, stress, energy)  # type: ignore[arg-type]
        self.iterations += body.iterations if shape is not None else 0
        done = self.passes - passes, self.iterations - iterations
        self.passes, self.iterations = passes, iterations
        return Opened(name, np.empty((0, 2), np.int64), np.empty(0), np.empty((0, 3)), *done, shape)

    def destroy(self, *, alone: bool) -> None:
        """Give back the memory of its analyses; `alone`: no other copy has this mesh."""
        for node in [*self._kept]:
            self._forget(node)
        if alone:
            self._stiffness.whole(self._options).destroy()

    def take(self, every: list[Opened]) -> None:
        """Have all of that open, whichever rank found it."""
        criterion = self._criterion
        if criterion is None or not every:
            return
        keys, cut = (np.concatenate([getattr(each, name) for each in every]) for name in ("keys", "cut"))
        order = np.lexsort(keys.T[::-1])
        local, place = self.graph.find_keys(keys[order])
        new = ~self.graph.broken[local]
        if np.any(new):
            pieces = np.unique(self.pieces.node_fragment[self.graph.edge_nodes[local[new]]])
            for piece in pieces:
                self._forget(int(np.flatnonzero(self.pieces.node_fragment == piece)[0]))
            criterion.cut_positions[local] = cut[order][place]
            flags = np.zeros(len(self.graph.broken), bool)
            flags[local] = True
            self.graph.break_edges(flags)
            self._find_pieces()
        criterion.starts = np.concatenate([criterion.starts, *(each.starts for each in every)])
        self.passes += sum(each.passes for each in every)
        self.iterations += sum(each.iterations for each in every)

    def strike(self, piece: int, loads: PointLoads) -> int:
        """Break a piece, and what it breaks into, until nothing more does; returns how many edges broke."""
        if self._criterion is None:
            return 0
        broken, waiting = 0, [int(np.flatnonzero(self.pieces.node_fragment == piece)[0])]
        while waiting:
            node = waiting.pop()
            piece = int(self.pieces.node_fragment[node])
            mine = self.pieces.node_fragment == piece
            on = loads.of(mine[loads.owner])
            if not len(on.force) or not self._may_break(mine):
                continue
            count = self._pass(piece, mine, on)
            broken += count
            if count:
                self._forget(node)
                self._find_pieces()
                waiting += self._lowest(mine)
        return broken

    def _may_break(self, mine: Flags) -> bool:
        """Whether a piece with these nodes (nodes,) has a whole cell left."""
        return bool(np.any(self._inside(mine) & ~self.graph.split))

    def _inside(self, mine: Flags) -> Flags:
        """(cells,) those with no other nodes than these (nodes,)."""
        return np.asarray(self._count(mine) == len(self._corners))

    def _pass(self, piece: int, mine: Flags, loads: PointLoads) -> int:
        """One analysis of a piece, and the edges that break in it."""
        assert self._criterion is not None
        stress = self.stress(piece, loads)
        self._within.cells = self._inside(mine)
        if self._surely_holds(stress):
            return 0
        edges, _ = self._criterion(stress)
        flags = np.zeros(len(self.graph.broken), bool)
        flags[edges] = True
        ends = self.graph.edge_nodes.T
        # the boundary of a grain may go on in other bodies
        count = self.graph.break_edges(flags & mine[ends[0]] & mine[ends[1]])
        return count + self.graph.break_unloaded_edges() if count else 0

    def _surely_holds(self, stress: Values) -> bool:
        """Whether no average over cells of the piece comes near its strength, for none of them does; cells that a crack
        ends in may carry more than they have."""
        assert self._criterion is not None
        cells = np.flatnonzero(self._within.cells & ~self.graph.split)
        size = frobenius_norm(stress[cells], self._domain.dim)
        enough = float(size.max(initial=0.0)) < self._criterion.strength.minimum * (1 - 1e-9)
        return enough and not self.graph.damaged[cells].any()

    def _lowest(self, mine: Flags) -> list[int]:
        """The lowest node of each piece that these nodes (nodes,) are in, the last first."""
        nodes = np.flatnonzero(mine)
        _, first = np.unique(self.pieces.node_fragment[nodes], return_index=True)
        return [int(each) for each in nodes[first][::-1]]

    def _forget(self, node: int) -> None:
        if (body := self._kept.pop(node, None)) is not None:
            body.destroy()
