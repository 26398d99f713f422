"""What is told of the edges that broke: when and where, how many there are, and the pieces that they leave."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import numpy as np
import numpy.typing as npt

from ..mechanics.stress import Stress
from ..mesh.connected_bodies import bodies_of
from ..mesh.domain import Domain
from ..mesh.parallel import sum_over_ranks

if TYPE_CHECKING:
    from ..fracture.brittle.surface_criterion import BrittleSurfaces
    from ..fracture.edge_history import EdgeRecord
    from ..fracture.fracture_pass import Breaking
    from ..mesh.fragments import Fragments


class Breaks:
    """The breaks of a run, and their figures.

    Attributes:
        record: time and place of each; None where nothing breaks.
        surfaces: what starts surfaces, where the study has [brittle]; None elsewhere.
        pieces: of the body as it is; None where nothing breaks.
        figures: (broken edges, split cells, pieces) over all ranks.
    """

    def __init__(self, stress: Stress, breaking: Breaking | None, *, cut_by_forces: bool = False) -> None:
        """`breaking`: what breaks; `cut_by_forces`: edges are cut where nodal forces say, not in the middle
        (collective)."""
        self._stress, self._domain, self._by_forces = stress, stress.domain, cut_by_forces
        self.record: EdgeRecord | None = None
        self.surfaces: BrittleSurfaces | None = None
        self.pieces: Fragments | None = None
        self.figures = (0, 0, _bodies(self._domain))
        self._cut_by: npt.NDArray[np.float64] | None = None
        self._carried: npt.NDArray[np.float64] | None = None
        if breaking is not None:
            from ..fracture.edge_history import EdgeRecord
            from ..mesh.incremental_fragments import IncrementalFragments

            self.record, self._parting = EdgeRecord(breaking.graph), IncrementalFragments(breaking.graph)
            if hasattr(breaking.criterion, "starts"):  # not isinstance: that would import what is off
                self.surfaces = cast("BrittleSurfaces", breaking.criterion)
            self._cut_by = breaking.criterion.cut
            self._carried = breaking.criterion.carried
            if breaking.opened is not None:
                self.record.note(0.0, breaking.opened)
            self.count()

    def note(self, t: float) -> None:
        """Edges that broke since the last call did so at t (s), and pieces are those of now (collective)."""
        if self.record is None:
            return
        if self._cut_by is not None:  # a surface knows where it cuts, and so does a crack
            self.record.note(t, self._cut_by)
        else:
            self.record.note(t, self._cuts() if self._by_forces else None)
        self.count()

    def remember(self) -> None:
        """A checkpoint is written: edges that cracks have cut and that hold on are cut there, and tips run
        (collective)."""
        if self.record is not None and self._cut_by is not None:
            self.record.remember(self._cut_by, self._carried)

    def restored(self) -> None:
        """The record was read from a checkpoint: so were the places of cuts (collective)."""
        if self.record is not None and self._cut_by is not None:
            self._cut_by[:] = self.record.cut
            if self._carried is not None and self.record.carried is not None:
                known = ~np.isnan(self.record.carried[:, 0])
                self._carried[known] = self.record.carried[known]
        self.count()

    def count(self) -> None:
        """Bring `pieces` and `figures` up to date, as after the damage of a checkpoint was read (collective)."""
        if self.record is None:
            return
        graph = self.record.graph
        broken, split = sum_over_ranks(self._domain.comm, np.array([graph.broken_count, np.count_nonzero(graph.split)]))
        self.pieces = self._parting.update()
        self.figures = int(broken), int(split), self.pieces.count

    def dust(self, mass: npt.NDArray[np.float64]) -> tuple[int, float]:
        """Pieces of a single corner of cells, and their mass, kg; `mass` (cells,) of cells, kg (collective)."""
        if self.pieces is None:
            return 0, 0.0
        domain, of_node = self._domain, self.pieces.node_fragment
        size = sum_over_ranks(domain.comm, np.bincount(of_node[domain.owned_corners], minlength=self.pieces.count))
        alone = (size == 1)[of_node]
        share = np.count_nonzero(alone[domain.cell_nodes], axis=1) / (domain.dim + 1)
        return int(np.count_nonzero(size == 1)), float(sum_over_ranks(domain.comm, np.array([share @ mass]))[0])

    def _cuts(self) -> npt.NDArray[np.float64]:
        """(edges,) cuts in inverse proportion to the nodal forces of now (M22 fig. 12)."""
        from ..fracture.edge_history import cut_by_forces

        assert self.record is not None
        domain, ends = self._domain, self.record.graph.edge_nodes
        force = domain.with_ghosts(self._stress.assemble_forces()).reshape(-1, domain.dim)
        swap = domain.node_input[ends[:, 0]] > domain.node_input[ends[:, 1]]
        return cut_by_forces(force, np.where(swap[:, None], ends[:, ::-1], ends))


def _bodies(domain: Domain) -> int:
    """Bodies of the mesh that share no node (collective)."""
    return int(domain.comm.bcast(bodies_of(domain.source)[0] if domain.source is not None else None))
