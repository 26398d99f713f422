"""Log of broken edges: time and position of each break, and the fragments that the breaks leave."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import numpy as np
import numpy.typing as npt

from ..mechanics.stress import Stress
from ..mesh.fragments import Fragments, find_bodies, find_fragments
from ..mesh.ghost_exchange import with_ghosts
from ..mesh.parallel import sum_over_ranks

if TYPE_CHECKING:
    from ..fracture.brittle.surface_criterion import BrittleSurfaces
    from ..fracture.criterion import FractureCriterion
    from ..fracture.edge_history import EdgeHistory
    from ..fracture.fracture_pass import FracturePass


class FractureLog:
    """Broken edges and fragments of a run.

    Attributes:
        record: time and position of each break; None without fracture.
        surfaces: start points of brittle surfaces, in a study with [brittle]; None otherwise.
        fragments: present fragments; None without fracture.
        counts: numbers of broken edges, split cells and fragments over all ranks.
    """

    def __init__(self, stress: Stress, breaking: FracturePass | None, *, cut_by_forces: bool = False) -> None:
        """Record the initially open edges (collective).

        Args:
            stress: stress term of the body.
            breaking: fracture pass, in a study with fracture.
            cut_by_forces: cut edges at a position that the nodal forces determine, not in the middle.
        """
        self._stress, self._domain, self._by_forces = stress, stress.domain, cut_by_forces
        self.record: EdgeHistory | None = None
        self.surfaces: BrittleSurfaces | None = None
        self.fragments: Fragments | None = None
        # (edges,) state of the broken edges that `fragments` belongs to
        self._broken: npt.NDArray[np.bool_] | None = None
        self.counts = (0, 0, 0)
        self._criterion: FractureCriterion | None = None
        if breaking is not None:
            from ..fracture.edge_history import EdgeHistory

            self.record = EdgeHistory(breaking.graph)
            # not isinstance: that would import the brittle room, which other studies do not need
            if hasattr(breaking.criterion, "starts"):
                self.surfaces = cast("BrittleSurfaces", breaking.criterion)
            # other criteria do not determine where an edge is cut
            if breaking.criterion.cut_positions is not None:
                self._criterion = breaking.criterion
            if breaking.initial_cuts is not None:
                self.record.record_breaks(0.0, breaking.initial_cuts)
            self.update_counts()
        else:
            self.counts = (0, 0, find_bodies(self._domain).count)

    def record_breaks(self, t: float) -> None:
        """Record the edges that broke since the last call, at time t in s, and find the fragments (collective)."""
        if self.record is None:
            return
        if self._criterion is not None:
            # surfaces and cracks define the position of the cut themselves
            self.record.record_breaks(t, self._criterion.cut_positions)
        else:
            self.record.record_breaks(t, self._cuts_by_forces() if self._by_forces else None)
        self.update_counts()

    def prepare_checkpoint(self) -> None:
        """Add to the record the cuts of edges that are not broken yet, and the state of crack tips (collective)."""
        if self.record is not None and self._criterion is not None:
            assert self._criterion.cut_positions is not None
            self.record.record_weakened(self._criterion.cut_positions, self._criterion.tip_states)

    def apply_checkpoint(self) -> None:
        """Set cuts and crack tips of the criterion from the record, which was read from a checkpoint (collective)."""
        if self.record is not None and self._criterion is not None:
            self._criterion.restore_cuts(self.record.cut_positions, self.record.tip_states)
        self.update_counts()

    def update_counts(self) -> None:
        """Find the fragments and update `counts` (collective)."""
        if self.record is None:
            return
        graph = self.record.graph
        changed = self._broken is None or not np.array_equal(self._broken, graph.broken)
        counts = np.array([graph.broken_count, np.count_nonzero(graph.split), changed])
        broken, split, changed_ranks = sum_over_ranks(self._domain.comm, counts)
        if self.fragments is None or changed_ranks:
            self.fragments, self._broken = find_fragments(graph), graph.broken.copy()
        self.counts = int(broken), int(split), self.fragments.count

    def count_single_nodes(self, mass: npt.NDArray[np.float64]) -> tuple[int, float]:
        """Number of fragments that are one corner node, and their mass in kg (collective).

        Args:
            mass: masses (cells,) of the cells, kg.
        """
        if self.fragments is None:
            return 0, 0.0
        domain, of_node = self._domain, self.fragments.node_fragment
        size = sum_over_ranks(
            domain.comm, np.bincount(of_node[domain.input_numbering.owned_corners], minlength=self.fragments.count)
        )
        single = (size == 1)[of_node]
        # each corner has an equal share of the mass of its cells
        share = np.count_nonzero(single[domain.cell_nodes], axis=1) / (domain.dim + 1)
        return int(np.count_nonzero(size == 1)), float(sum_over_ranks(domain.comm, np.array([share @ mass]))[0])

    def _cuts_by_forces(self) -> npt.NDArray[np.float64]:
        """Cuts (edges,) in inverse proportion to the nodal forces (Mandal et al. 2022, figure 12)."""
        from ..fracture.edge_history import cut_positions_from_forces

        assert self.record is not None
        domain, ends = self._domain, self.record.graph.edge_nodes
        force = with_ghosts(domain, self._stress.assemble_forces()).reshape(-1, domain.dim)
        # ends in the order of the input mesh, so that a cut does not depend on the partition
        swap = domain.input_numbering.nodes[ends[:, 0]] > domain.input_numbering.nodes[ends[:, 1]]
        return cut_positions_from_forces(force, np.where(swap[:, None], ends[:, ::-1], ends))
