"""History of broken edges: the time of each break, and the position of each cut."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from ..mesh.edge_graph import EdgeGraph, EdgeRows
from ..mesh.ghost_exchange import min_over_ranks

Values = npt.NDArray[np.float64]


class EdgeHistory:
    """Break times and cut positions of the edges of a rank, owned and ghost.

    Attributes:
        graph: the edges and their damage.
        break_times: (edges,) time at which each edge broke, s; NaN for intact edges.
        cut_positions: (edges,) position of each cut, from 0 at the end that comes first in the input mesh to 1 at the
            other; NaN stands for the middle.
        tip_states: (edges, n) states of moving crack tips, the time of the last update in the last column; None
            without such tips.
    """

    def __init__(self, graph: EdgeGraph) -> None:
        self.graph = graph
        self.break_times = np.full(len(graph.broken), np.nan)
        self.cut_positions = np.full(len(graph.broken), np.nan)
        self.tip_states: Values | None = None

    def record_breaks(self, t: float, cut: Values | None = None) -> None:
        """Record that edges which broke since the last call broke at `t` (s), cut at `cut` (edges,) if given."""
        new = self.graph.broken & np.isnan(self.break_times)
        self.break_times[new] = t
        if cut is not None:
            self.cut_positions[new] = cut[new]

    def record_weakened(self, cut: Values, tip_states: Values | None) -> None:
        """Record the cuts (edges,) of weakened, unbroken edges, and the states of tips (edges, n) (collective).

        Of the states that several ranks have for one edge, those with the latest time are recorded.
        """
        weakened = (self.graph.integrity < 1) & ~self.graph.broken
        self.cut_positions[weakened] = cut[weakened]
        if tip_states is not None:
            # The largest time of all ranks is the least negative one.
            edges, negative_time = self.graph.index_map, -np.nan_to_num(tip_states[:, -1], nan=-np.inf)
            latest = negative_time <= min_over_ranks(edges, negative_time)
            columns = [min_over_ranks(edges, np.where(latest, column, np.inf)) for column in tip_states.T]
            self.tip_states = np.column_stack(columns)

    def weakened_rows(self) -> Values:
        """(edges, 2 or more) times, cuts and tip states, which a checkpoint has of weakened edges."""
        states = [] if self.tip_states is None else [self.tip_states]
        return np.column_stack([self.break_times, self.cut_positions, *states])

    def restore_rows(self, blocks: Iterable[EdgeRows]) -> None:
        """Restore `weakened_rows` (n, 2 or more) of the edges with keys (n, 2), in blocks that every rank is given."""
        for keys, values in blocks:
            local, row = self.graph.keys.find_edges(keys)
            self.break_times[local], self.cut_positions[local] = values[row, :2].T
            if values.shape[1] > 2:
                if self.tip_states is None:
                    self.tip_states = np.full((len(self.break_times), values.shape[1] - 2), np.nan)
                self.tip_states[local] = values[row, 2:]


def cut_positions_from_forces(force: Values, ends: npt.NDArray[np.integer]) -> Values:
    """Return cut positions (edges,) that divide each edge in inverse proportion to its nodal forces.

    length_i / length_j = |f_j| / |f_i|, so that the cut is at |f_j| / (|f_i| + |f_j|) from node i (M22, section 4.1,
    fig. 12). It is in the middle where both forces are 0, and within 0.1 to 0.9.

    Args:
        force: (nodes, d) nodal forces, N.
        ends: (edges, 2) nodes of the edges, the lower input node first.
    """
    size = np.linalg.norm(force, axis=1)[ends]
    total = size.sum(axis=1)
    share = np.divide(size[:, 1], total, out=np.full(len(total), 0.5), where=total > 0)
    # Away from the ends of the edge, against sliver triangles of the split surface.
    return np.clip(share, 0.1, 0.9)
