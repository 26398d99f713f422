"""Advance of fronts in 3D without inertia: a whole stretch of a front advances before the body is solved for again.

A ball of 4 h cannot distinguish the release rates of neighbouring tips to better than some per cent (crack_front). When
a tip reaches G_c, tips in its ball that lack at most 3 % therefore advance with it. Each of them leads a plane. Cells
that its cut enters are cut by the plane up to 0.65 h away, one by one, no nearer than h / 2 to one another: cells cut
at once would not match. Tips with less do not advance. The criterion of young tips is the stress, which one cell
changes; they lead no plane.

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
from .crack_initiation import CutKind, CutProposal, empty_proposal, rank_rows, select_proposals
from .cut_plane import EdgeCuts, plane_cuts
from .tip_criterion import TipCriterion, input_numbers, reference_corners
from .tip_fields import TipFields
from .tip_neighbourhoods import CrackTips
from .tip_parameters import TIP

Flags = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


class FrontTipCriterion(TipCriterion):
    """Tip criterion that cuts rows of cells along a front in 3D.

    The course of a crack is the plane of its leading tip: point (3), m, normal (3), and sigma_1, Pa.
    """

    shares = True
    course_width = 7

    def __call__(self, stress: Values, psi: Values) -> tuple[Edges, Values]:
        """Find the local edges (n,) that cracks cut, with loads of 1 (collective)."""
        self._leading = empty_proposal(3, self.course_width)
        return super().__call__(stress, psi)

    def _find_critical_tips(self, size: Values, toughness: Values, tips: CrackTips) -> tuple[Flags, Flags]:
        """Return which tips (n,) reach G_c, or lack little in the ball of one that does; none branches (collective)."""
        critical = size >= toughness
        # Leaders are mature tips of all ranks that reach G_c.
        leading_points = tips.point[critical & tips.mature & ~self._excluded_cells[tips.cell]]
        leading_points = np.concatenate(allgather(self._domain.comm, leading_points))
        if not len(leading_points):
            return critical, np.zeros(len(tips), bool)
        near = cKDTree(leading_points).query(tips.point)[0] < self.disc_radius_ratio * self._h[tips.cell]
        return critical | (near & (size >= (1 - TIP.front_lag) * toughness)), np.zeros(len(tips), bool)

    def _propose_advances(self, fields: TipFields) -> CutProposal:
        """Propose the cells of tips that advance, each on its plane; mature tips lead their planes."""
        advances = super()._propose_advances(fields)
        _, normals = self.field_evaluator.crack_normals(advances.stress, advances.cells)
        mature = fields.tips.mature[np.searchsorted(fields.tips.cell, advances.cells)]
        # The plane of a tip passes through its point, across the first principal stress.
        planes = np.column_stack([advances.point, normals, -advances.rank[:, 1]])
        advances = replace(advances, ahead=planes, turns=mature)
        self._leading = advances.select(mature)
        return advances

    def _exit_cuts(self, advances: CutProposal) -> EdgeCuts:
        """Return the cuts of cells by their planes."""
        assert advances.ahead is not None
        cells = advances.cells
        return plane_cuts(
            reference_corners(self._domain, cells), self._flag_cut_edges(cells), advances.point, advances.ahead[:, 3:6]
        )

    def _extend_cuts(self, edges: Edges, courses: Values) -> Edges:
        """Return the cut edges (n,) with those of the rows of cells that follow (collective).

        `courses` (n, 7) are the planes of the edges, 0 where no tip leads.
        """
        all_edges, cells = [edges], self._leading.cells
        # Planes of cells, and of the edges that were cut in this pass.
        cell_planes = np.zeros((len(self._h), self.course_width))
        edge_planes = np.zeros((len(self.cut_positions), self.course_width))
        # Cells of leading tips keep their own plane.
        has_own_plane = np.zeros(len(self._h), bool)
        has_own_plane[cells], cell_planes[cells] = True, self._leading.ahead
        while True:
            edge_planes[edges] = courses
            self._inherit_planes(cell_planes, edge_planes, has_own_plane)
            (following,), any_selected = select_proposals(self._domain, self._propose_following(cell_planes))
            if not any_selected:
                break
            self.cells = np.concatenate([self.cells, following.cells])
            edges, courses = self._store_cuts(self._cut_rows(following, self._exit_cuts(following)))
            all_edges.append(edges)
        return np.concatenate(all_edges)

    def _inherit_planes(self, cell_planes: Values, edge_planes: Values, has_own_plane: Flags) -> None:
        """Give intact cells the plane of the edge by which they were entered, that with the largest sigma_1.

        Args:
            cell_planes: (cells, 7) planes, updated in place.
            edge_planes: (edges, 7) planes of cut edges.
            has_own_plane: (cells,) cells of tips with a plane of their own.
        """
        graph = self._graph
        entered = np.any(edge_planes[:, 3:6], axis=1)[graph.cell_edges].any(axis=1)
        cells = np.flatnonzero(entered & ~(graph.damaged | has_own_plane))
        first = np.argmax(edge_planes[graph.cell_edges[cells], 6], axis=1)
        cell_planes[cells] = edge_planes[graph.cell_edges[cells, first]]

    def _propose_following(self, planes: Values) -> CutProposal:
        """Propose unsplit cells on planes (cells, 7), near enough to the tips that lead these."""
        has_plane = np.any(planes[:, 3:6], axis=1)
        cells = np.flatnonzero(has_plane & ~(self._graph.split | self._excluded_cells)).astype(np.int64)
        cut = self._flag_cut_edges(cells)
        unsplit = ~is_split(3)[cut @ (1 << np.arange(6))]
        cells, cut = cells[unsplit], cut[unsplit]
        points = self.field_evaluator.cut_points(self._graph.cell_edges[cells], self.cut_positions)
        # A cell is reached once the mean of its cut points is near enough to the leading tip.
        middle = np.einsum("nk,nki->ni", cut, points) / cut.sum(axis=1, keepdims=True)
        near = np.linalg.norm(middle - planes[cells, :3], axis=1) <= TIP.lead_distance * self._h[cells]
        cells, middle = cells[near], middle[near]
        exclusion = TIP.exclusion_radius[3] * self._h[cells]
        rank = rank_rows(CutKind.TIP_ADVANCE, planes[cells, 6], input_numbers(self._domain, cells), middle, exclusion)
        stress, turns = np.empty((len(cells), 3, 3)), np.ones(len(cells), bool)
        return CutProposal(rank, cells, stress, np.zeros(len(cells), np.int64), planes[cells], turns, ~turns)

    def _flag_cut_edges(self, cells: Ints) -> Flags:
        """Flag the edges (n, 6) of cells (n,) that are broken, or cut in this pass."""
        return ~self._graph.intact(cells) | ~np.isnan(self.cut_positions[self._graph.cell_edges[cells]])
