"""What is remembered of every broken edge: when it broke, and where it was cut."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..mesh.edge_graph import EdgeGraph

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


class EdgeRecord:
    """Time and place of the breaks of the edges that a rank has, owned and ghost.

    Attributes:
        graph: the edges and their damage.
        at: (edges,) s at which each broke, NaN while it is whole.
        cut: (edges,) where, from the end that comes first in the input mesh (0) to the other (1); NaN: in the middle.
        carried: (edges, n) of tips that run, the time of the last look in the end; None where none do.
    """

    def __init__(self, graph: EdgeGraph) -> None:
        self.graph = graph
        self.at = np.full(len(graph.broken), np.nan)
        self.cut = np.full(len(graph.broken), np.nan)
        self.carried: Values | None = None

    def note(self, t: float, cut: Values | None = None) -> None:
        """Edges that broke since the last call did so at t (s), at `cut` (edges,) where it is given."""
        new = self.graph.broken & np.isnan(self.at)
        self.at[new] = t
        if cut is not None:
            self.cut[new] = cut[new]

    def remember(self, cut: Values, carried: Values | None) -> None:
        """Edges that are weakened and not broken are cut at `cut` (edges,); tips carry what is said by the rank that
        looked at them last, which has them (collective)."""
        held = (self.graph.integrity < 1) & ~self.graph.broken
        self.cut[held] = cut[held]
        if carried is not None:
            ago = -np.nan_to_num(carried[:, -1], nan=-np.inf)
            newest = ago <= self.graph.min_over_ranks(ago)
            columns = [self.graph.min_over_ranks(np.where(newest, each, np.inf)) for each in carried.T]
            self.carried = np.column_stack(columns)

    def gathered(self) -> tuple[Ints, Values] | None:
        """(n, 2) sorted keys of all broken edges and (n, 2) their `at` and `cut`, on rank 0 (collective)."""
        return self.graph.gather_broken(np.column_stack([self.at, self.cut]))

    def saved(self) -> tuple[Ints, Values] | None:
        """The same of all edges that are not whole (collective)."""
        carried = [] if self.carried is None else [self.carried]
        return self.graph.gather_weakened(np.column_stack([self.at, self.cut, *carried]))

    def restore(self, keys: Ints, values: Values) -> None:
        """Take up what `saved` gave, (n, 2) keys and (n, 2 and more) values, on every rank."""
        local, place = self.graph.find_keys(keys)
        self.at[local], self.cut[local] = values[place, :2].T
        if values.shape[1] > 2:
            self.carried = np.full((len(self.at), values.shape[1] - 2), np.nan)
            self.carried[local] = values[place, 2:]


def cut_by_forces(force: Values, ends: npt.NDArray[np.integer]) -> Values:
    """(edges,) cuts whose sections are in inverse proportion to the nodal forces (M22 section 4.1, fig. 12).

    length_i / length_j = |f_j| / |f_i|, so the cut is at |f_j| / (|f_i| + |f_j|) from i, the middle where both are 0.
    `force`: (nodes, d) N; `ends`: (edges, 2) from the lower input node. Held within 0.1 to 0.9: no needles.
    """
    size = np.linalg.norm(force, axis=1)[ends]
    both = size.sum(axis=1)
    share = np.divide(size[:, 1], both, out=np.full(len(both), 0.5), where=both > 0)
    return np.clip(share, 0.1, 0.9)
