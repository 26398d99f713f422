"""Criterion of a body with a fracture energy G_c: which crack tips advance, and where cracks start.

A tip advances by a cell if the configurational force over a disc of 5 h (3D: a ball of 4 h) reaches G_c, once the crack
behind it is longer than the disc (a mature tip), or if the strain of its cell alone releases the energy of the cut.
Young tips advance, and cracks start, by the mean stress ahead (critical_distance); where a crack starts the stress has
to reach the strength, too.

Equations: docs/theory.md#tip-criterion.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ...mechanics.material_fields import PerCell
from ...mechanics.stability_limit import rayleigh_wave_speed
from ...mechanics.stress import Stress
from ...mesh.domain import Domain
from ...mesh.edge_graph import EdgeGraph
from ...mesh.parallel import allgather, sum_over_ranks
from ...mesh.simplices import local_edges
from ..criterion import Edges
from ..node_retention import NodeAttachment
from ..principal_stress import first_principal_stress, symmetric_tensors
from ..strength import EdgeStrength
from .branching import release_rate, rotate, unit_or_zero
from .crack_initiation import (
    CrackInitiation,
    CutKind,
    CutProposal,
    Initiation,
    cell_strength,
    empty_proposal,
    rank_rows,
    select_proposals,
)
from .critical_distance import CriticalDistance, critical_distance, releases_cut_energy
from .cut_plane import EdgeCuts, branching_cuts, centroid_cuts, exit_cuts, plane_cuts
from .mixed_mode import kink_angle, kink_gain, phase_angles
from .neighbour_search import local_mesh_size
from .tip_fields import TipFieldEvaluator, TipFields
from .tip_neighbourhoods import CrackTips, TipRadii
from .tip_parameters import TIP
from .tip_record import TipReading, TipRecord

Flags = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


class TipCriterion:
    """Criterion: Griffith's at mature tips, the strength elsewhere.

    Attributes:
        cut_positions: (edges,) cuts of local edges, 0 at the end that comes first in the input mesh to 1 at the other;
            NaN elsewhere.
        toughness: G_c, J/m^2, one number or (cells,).
        strength: strength of each edge in each cell, Pa.
        cells: (n,) cells of this rank that were cut last.
        disc_radius_ratio: R over h.
        field_evaluator: evaluates the fields around tips.
        tip_states: (edges, n) states of moving tips at the edge by which each came in, the time of the last update in
            the last column; None without them.
        extends_cuts: without inertia tips cut more than one cell in a pass.
        shares: tips of a front in 3D share their force (crack_front).
        may_branch: tips may branch.
        course_width: numbers that describe the course of a crack beyond the cell that it cuts.
    """

    extends_cuts, shares, may_branch, course_width = True, False, False, 2
    tip_states: Values | None = None

    def __init__(
        self,
        stress: Stress,
        graph: EdgeGraph,
        strength: EdgeStrength,
        toughness: PerCell,
        initial_cuts: Values | None = None,
        record: TipRecord | None = None,
    ) -> None:
        """Build the criterion (collective).

        Args:
            stress: stress of the body.
            graph: edges and their damage.
            strength: strength of edges.
            toughness: G_c, J/m^2.
            initial_cuts: (edges,) cut positions of initial cracks.
            record: is given the tips of each pass.
        """
        self._record = record
        self._stress, self._graph, self.strength, self.toughness = stress, graph, strength, toughness
        domain = self._domain = stress.domain
        self.cut_positions: Values = np.full(len(graph.broken), np.nan) if initial_cuts is None else initial_cuts.copy()
        self._h = local_mesh_size(domain)
        self.disc_radius_ratio = TIP.disc_radius[domain.dim]
        disc = self.disc_radius_ratio * self._h
        self._start = self._critical_distance()
        radii = TipRadii(
            disc,
            # Branches share a disc of one size.
            disc if self.may_branch else TIP.kinked_radius[domain.dim] * self._h,
            TIP.average_radius * self._h,
            TIP.mature_length * self._h,
            self._start.radius,
            TIP.cell_reach * self._h,
            TIP.straightness * self._h,
        )
        self.field_evaluator = TipFieldEvaluator(stress, graph, radii, may_branch=self.may_branch, shares=self.shares)
        self._initiation: Initiation = CrackInitiation(stress, graph, strength, self.field_evaluator, disc, self._start)
        self._now, self._dt = 0.0, np.inf
        self.cells: Ints = np.empty(0, np.int64)
        self._excluded_cells: Flags = np.zeros(domain.cell_count, bool)

    def _critical_distance(self) -> CriticalDistance:
        """Return the length and the threshold of the mean stress ahead of places at which cracks start."""
        material, cells = self._stress.material, np.arange(self._domain.cell_count)
        mu, lmbda = np.asarray(material.mu), np.asarray(material.lmbda)
        # E' of plane strain; lambda is reduced in plane stress, where this is E' of plane stress.
        modulus = 4 * mu * (lmbda + mu) / (lmbda + 2 * mu)
        strength = cell_strength(self.strength, self._graph, cells)
        return critical_distance(self._domain.dim, modulus, np.asarray(self.toughness), strength, self._h)

    @property
    def disc_radius(self) -> Values:
        """(cells,) radius R, m, of the disc (3D: ball) of a tip in a cell."""
        return self.disc_radius_ratio * self._h

    @property
    def elastic_radius(self) -> Values:
        """(cells,) radius, m, of the zone around a tip in a cell in which a body that yields stays elastic."""
        return np.maximum(self._start.length / 2, self.disc_radius)

    def __call__(self, stress: Values, psi: Values) -> tuple[Edges, Values]:
        """Find the local edges (n,) that cracks cut, with loads of 1 (collective).

        Args:
            stress: (cells, 3 or 6) Cauchy stress of the undamaged material, Pa.
            psi: (cells,) energy density of the undamaged material, J/m^3.
        """
        tips, candidates = self.find_tips(), self._initiation.find_cells(stress, self._excluded_cells)
        # The counts of all ranks decide, since the evaluations are collective.
        tip_count, candidate_count = sum_over_ranks(self._domain.comm, np.array([len(tips), len(candidates)]))
        none = empty_proposal(self._domain.dim, self.course_width)
        advances = starts = none
        if tip_count:
            advances = self._propose_advances(self.field_evaluator.evaluate_fields(stress, psi))
        if candidate_count:
            starts = self._initiation.propose_cuts(candidates, stress)
        edges: Edges = np.empty(0, np.int64)
        self.cells = np.empty(0, np.int64)
        if tip_count + candidate_count:
            # Without inertia the first crack unloads other places before a crack starts there.
            one_start = not self.field_evaluator.has_motion
            (advances, starts), any_selected = select_proposals(self._domain, advances, starts, one_start=one_start)
            self.cells = np.concatenate([advances.cells, starts.cells])
            if any_selected:
                edges = self._cut_cells(advances, starts)
        return edges, np.ones(len(edges))

    def find_tips(self) -> CrackTips:
        """Return the tips of this rank (collective)."""
        return self.field_evaluator.update_tips(self.cut_positions)

    def set_motion(self, v: Values, a: Values, now: float, dt: float) -> None:
        """Store velocity (owned dofs,) in m/s and acceleration in m/s^2 at the end `now` of a step of `dt`, s."""
        self.field_evaluator.set_motion(v, a)
        self._now, self._dt = now, dt

    def snapshot(self) -> object:
        """Return a copy of the cut positions (edges,)."""
        return self.cut_positions.copy()

    def restore(self, saved: object) -> None:
        """Restore the cut positions that `snapshot` returned."""
        assert isinstance(saved, np.ndarray)
        self.cut_positions[:] = saved

    def restore_cuts(self, cut_positions: Values, tip_states: Values | None) -> None:
        """Restore the cut positions (edges,) that a checkpoint stored."""
        self.cut_positions[:] = cut_positions

    def release_rate(self) -> Values:
        """Return c_R / R (cells,), 1/s: the inverse of the time of a Rayleigh wave through the disc of a tip."""
        # Poisson's ratio from Lame's parameters.
        mu, lmbda = np.asarray(self._stress.material.mu), np.asarray(self._stress.material.lmbda)
        poisson = lmbda / (2 * (lmbda + mu))
        shear_speed = np.sqrt(mu / np.asarray(self._stress.material.density))
        return np.asarray(rayleigh_wave_speed(shear_speed, poisson) / (self.disc_radius_ratio * self._h))

    def passes_per_second(self) -> float:
        """Return the rate of passes at which a tip, cell by cell, runs as fast as a Rayleigh wave (collective)."""
        fastest = float(np.max(self.release_rate(), initial=0.0))
        largest = float(self._domain.comm.allreduce(fastest, op=MPI.MAX))
        return TIP.passes_per_size[self._domain.dim] * self.disc_radius_ratio * largest

    def exclude_cells(self, cells: Ints) -> None:
        """Exclude cells (n,) from cuts, in addition to those excluded before."""
        self._excluded_cells[cells] = True

    def clear_excluded_cells(self) -> None:
        """Allow all cells to be cut."""
        self._excluded_cells[:] = False

    def withdraw_cuts(self, edges: Edges) -> None:
        """Forget the cuts of edges (n,) that were found last and are not to break."""
        self.cut_positions[edges] = np.nan

    # --- proposals ---

    def _propose_advances(self, fields: TipFields) -> CutProposal:
        """Propose the cells of the tips that advance."""
        tips, d = fields.tips, self._domain.dim
        h = self._h[tips.cell]
        toughness = np.broadcast_to(self.toughness, len(self._h))[tips.cell]
        # The force of young tips is not used: the crack behind them is shorter than the disc.
        force = fields.evaluate_forces()
        mature = tips.mature.copy()
        size, turns, branches = np.linalg.norm(force, axis=1), *np.zeros((2, len(tips)), bool)
        ahead = np.where(mature[:, None], force, tips.point - tips.behind)
        exclusion = TIP.exclusion_radius[d] * h
        K: Values = np.empty((len(tips), 0))
        if d == 2:
            K = fields.stress_intensities()
            size, kinked = kinked_release(phase_angles(K), tips, force)
            # A force backwards belongs to other tips in the disc.
            mature &= size > 0
            turns, side_by_side = mature & np.any(kinked, axis=1), np.any(tips.branch_direction, axis=1)
            # A crack that turns is cut on straight, at least by one cell: the fields at a kink that is short are those
            # of the tip before it.
            sine = np.abs(np.einsum("ni,ni->n", rotate(unit_or_zero(tips.point - tips.behind), np.pi / 2), kinked))
            length = np.maximum(TIP.kink_length * sine, TIP.force_round_off) * h
            ahead = np.where(turns[:, None], length[:, None] * kinked, ahead)
            # Branches that are side by side advance in the same pass.
            exclusion = np.where(side_by_side, TIP.exclusion_radius[3] * h, exclusion)
        if self._record is not None:
            # The disc of a young tip reaches beyond its crack.
            factor = np.where(tips.mature, 1.0, np.nan)
            numbers = self._domain.input_numbering.cells[tips.cell]
            self._record.add(TipReading(numbers, tips.point, size * factor, K * factor[:, None]))
        enough, enough_for_branches = self._find_critical_tips(size, toughness, tips)
        if self.may_branch:
            branches = turns & enough_for_branches
            ahead = np.where(branches[:, None], tips.course, ahead)
        # A tip that reaches G_c has its crack speed, a young one the stress ahead.
        overstrained = (
            tips.mature
            & (size < toughness)
            & releases_cut_energy(self._stress, toughness, tips.cell, fields.cell_stress)
        )
        # A branch is inactive behind the other unless there is enough energy for both.
        is_inactive = (tips.is_inactive & (size < TIP.branching_ratio * toughness)) | self._excluded_cells[tips.cell]
        candidates = np.flatnonzero((~mature | enough | overstrained) & ~is_inactive)
        if not sum_over_ranks(self._domain.comm, len(candidates))[0]:
            return empty_proposal(d, self.course_width)
        mean = fields.mean_stress(candidates)
        # The mean of a narrow ligament is that of the fragments beside it, which carry little.
        local = overstrained[candidates]
        mean[local] = symmetric_tensors(fields.cell_stress[tips.cell[candidates[local]]], d)
        sigma = first_principal_stress(mean)
        active = (sigma > 0) & (mature[candidates] | local)
        # The stress ahead of a young tip is that ahead of a place at which a crack starts.
        young = np.flatnonzero(~active & (sigma > 0))
        active[young] = self._is_overloaded(fields, candidates[young], mean[young])
        rows = candidates[active]
        cells = tips.cell[rows]
        rank = rank_rows(
            CutKind.TIP_ADVANCE, sigma[active], input_numbers(self._domain, cells), tips.point[rows], exclusion[rows]
        )
        entry = self._graph.first_broken_edge(cells)
        return CutProposal(rank, cells, mean[active], entry, ahead[rows], turns[rows], branches[rows])

    def _is_overloaded(self, fields: TipFields, rows: Ints, mean: Values) -> Flags:
        """Return whether the stress ahead of tips `rows` (m,) with averaged stress (m, d, d) is enough (collective)."""
        cells, evaluator = fields.tips.cell[rows], self.field_evaluator
        normals, start = evaluator.crack_normals(mean, cells), self._start
        radii = start.radius[cells], start.least_radius[cells]
        ahead = evaluator.mean_stress_ahead(fields.tips.point[rows], normals, *radii, fields.cell_stress)
        return np.asarray(first_principal_stress(ahead) >= self._start.threshold[cells])

    def _find_critical_tips(self, size: Values, toughness: Values, tips: CrackTips) -> tuple[Flags, Flags]:
        """Return which tips (n,) with release rates `size` (n,) reach G_c, and which branch (collective)."""
        return size >= toughness, np.zeros(len(tips), bool)

    # --- cuts ---

    def _cut_cells(self, advances: CutProposal, starts: CutProposal) -> Edges:
        """Store the cuts of selected cells on every rank; return the local edges (n,) of this one (collective)."""
        advance_rows = self._cut_rows(advances, self._exit_cuts(advances))
        through_centroid = centroid_cuts(
            reference_corners(self._domain, starts.cells),
            self.field_evaluator.crack_normals(starts.stress, starts.cells)[1],
        )
        start_rows = self._cut_rows(starts, through_centroid)
        edges, courses = self._store_cuts(np.concatenate([advance_rows, start_rows]))
        if self.extends_cuts and not self.field_evaluator.has_motion:
            return self._extend_cuts(edges, courses)
        return edges

    def _cut_rows(self, proposal: CutProposal, cuts: EdgeCuts) -> Values:
        """Return rows (n, 6 + course_width) that describe the cut edges to all ranks.

        They are the key of the edge, its cut position, the rank of the cell (3), and the course of a crack that
        continues straight, 0 for the others.
        """
        cells = proposal.cells[cuts.row]
        # Edges are described by input nodes, which all ranks know.
        local_nodes = self._domain.cell_nodes[cells[:, None], local_edges(self._domain.dim)[cuts.edge]]
        ends = self._domain.input_numbering.nodes[local_nodes]
        position = np.where(ends[:, 0] > ends[:, 1], 1 - cuts.share, cuts.share)
        course = np.zeros((len(cells), self.course_width))
        ahead = proposal.ahead
        if proposal.turns is not None and ahead is not None and ahead.shape[1] == self.course_width:
            course[:] = np.where(proposal.turns[:, None], ahead, 0.0)[cuts.row]
        return np.column_stack([np.sort(ends, axis=1), position, proposal.rank[cuts.row, :3], course])

    def _store_cuts(self, rows: Values) -> tuple[Edges, Values]:
        """Store the cuts that the rows of all ranks describe (collective).

        Returns:
            Local edges (n,) that were not cut before, and the courses (n, course_width) of the cracks there.
        """
        rows = np.concatenate(allgather(self._domain.comm, rows))
        # Of neighbours that cut the same edge the first in rank decides where.
        rows = rows[np.lexsort(rows[:, 5:2:-1].T)]
        keys, first = np.unique(rows[:, :2].astype(np.int64), axis=0, return_index=True)
        local, key_row = self._graph.keys.find_edges(keys)
        new = ~self._graph.broken[local] & np.isnan(self.cut_positions[local])
        chosen = rows[first[key_row[new]]]
        self.cut_positions[local[new]] = chosen[:, 2]
        return local[new], chosen[:, 6:]

    def _extend_cuts(self, edges: Edges, courses: Values) -> Edges:
        """Return the cut edges (n,), in 2D with those of intact cells beyond, cut straight on (collective).

        Args:
            edges: (n,) edges that were cut just now.
            courses: (n, 2) directions of the cracks, as long as what they still advance, m; 0 for those that end here.
        """
        if self._domain.dim == 3:
            return edges
        graph, domain, all_edges = self._graph, self._domain, [edges]
        while True:
            course = np.zeros((len(graph.broken), self.course_width))
            course[edges] = courses
            entered = np.any(course[graph.cell_edges], axis=2)
            # Cells with one cut edge, on the far side of a cut, are next on the course of the crack. They are cut in
            # the same pass: before a solve the force would be that of a body out of balance.
            is_cut_once = (~np.isnan(self.cut_positions))[graph.cell_edges].sum(axis=1) == 1
            is_next = entered.any(axis=1) & is_cut_once & ~(graph.damaged | self._excluded_cells)
            cells = np.flatnonzero(is_next).astype(np.int64)
            if not sum_over_ranks(domain.comm, len(cells))[0]:
                return np.concatenate(all_edges)
            entry, corners = np.argmax(entered[cells], axis=1), reference_corners(domain, cells)
            entry_edges = graph.cell_edges[cells, entry]
            point, ahead = self.field_evaluator.cut_points(entry_edges, self.cut_positions), course[entry_edges]
            split_beyond = split_cell_edges(graph)[graph.cell_edges[cells]]
            cuts = exit_cuts(corners, entry, point, rotate(ahead, np.pi / 2), ahead, split_beyond)
            passed = np.linalg.norm(cuts.points(corners) - point, axis=1) / np.linalg.norm(ahead, axis=1)
            ahead = np.maximum(1 - passed, 0.0)[:, None] * ahead
            self.cells = np.concatenate([self.cells, cells])
            turns, zeros = entry >= 0, np.zeros(len(cells))
            rank = rank_rows(CutKind.TIP_ADVANCE, zeros, input_numbers(domain, cells), point, zeros)
            proposal = CutProposal(rank, cells, np.empty((len(cells), 2, 2)), entry, ahead, turns, ~turns)
            edges, courses = self._store_cuts(self._cut_rows(proposal, cuts))
            all_edges.append(edges)

    def _exit_cuts(self, advances: CutProposal) -> EdgeCuts:
        """Return the cuts of the cells of tips that advance (collective)."""
        assert advances.entry is not None and advances.ahead is not None
        cells, ahead = advances.cells, advances.ahead
        corners, normals = (
            reference_corners(self._domain, cells),
            self.field_evaluator.crack_normals(advances.stress, cells)[1],
        )
        if self._domain.dim == 3:
            return plane_cuts(corners, ~self._graph.intact(cells), advances.point, normals)
        assert advances.turns is not None and advances.branches is not None
        # A tip that kinks by its stress intensities is cut along that direction.
        normals = np.where(advances.turns[:, None], rotate(ahead, np.pi / 2), normals)
        split_beyond = split_cell_edges(self._graph)[self._graph.cell_edges[cells]]
        return branching_cuts(corners, advances.entry, advances.point, normals, ahead, split_beyond, advances.branches)


def reference_corners(domain: Domain, cells: Ints) -> Values:
    """Return the reference corners (n, d + 1, d) of cells (n,), m."""
    return domain.nodes[domain.cell_nodes[cells]]


def input_numbers(domain: Domain, cells: Ints) -> Values:
    """Return the numbers (n, 1) of cells in the input mesh, to be hashed: two tips may be at one point."""
    return np.asarray(domain.input_numbering.cells[cells, None], float)


def kinked_release(psi: Values, tips: CrackTips, force: Values) -> tuple[Values, Values]:
    """Return G (n,), J/m^2, of tips in 2D that kink by their phase angles psi (n,), and their directions (n, 2).

    Without a crack behind the tip the size of the force is returned, and no direction.
    """
    # Branches side by side keep straight on, at the branching angle.
    tangent, side_by_side = unit_or_zero(tips.point - tips.behind), np.any(tips.branch_direction, axis=1)
    psi = np.where(side_by_side, 0.0, psi)
    # Across the crack acts also the stress along the crack faces, with the waves in it.
    along = release_rate(force, tips.ahead, tangent) * kink_gain(psi)
    kinked = np.where(side_by_side[:, None], tips.branch_direction, rotate(tangent, kink_angle(psi)))
    return np.where(np.any(tangent, axis=1), along, np.linalg.norm(force, axis=1)), kinked


def split_cell_edges(graph: EdgeGraph) -> Flags:
    """Flag the edges (edges,) of split cells of any rank (collective)."""
    flags = np.zeros(len(graph.broken), bool)
    flags[graph.cell_edges[graph.split]] = True
    return graph.any_over_ranks(flags)


class AttachedTipCriterion:
    """Tip criterion that leaves cells uncut if the cut would detach a node.

    A node without an unsplit cell stays attached by an edge (fracture.node_retention). Where a cut would break the last
    edge that can attach it, the cell is not cut: it attaches that node and nothing else, has no energy to release and
    separates no bodies. A single spared edge of the cut would leave a tip inside the crack, where the force is that of
    its neighbours.
    """

    def __init__(self, tips: TipCriterion, graph: EdgeGraph, node_attachment: NodeAttachment) -> None:
        self._tips, self._graph, self._node_attachment = tips, graph, node_attachment

    @property
    def cut_positions(self) -> Values:
        """(edges,) cut positions of local edges."""
        return self._tips.cut_positions

    @property
    def tip_states(self) -> Values | None:
        """(edges, n) states of moving tips, or None."""
        return self._tips.tip_states

    def __call__(self, stress: Values, psi: Values) -> tuple[Edges, Values]:
        """Find the local edges (n,) that cracks cut, none of which attaches a node, with loads of 1 (collective)."""
        graph = self._graph
        # They are found again in every pass, so that a restart does not need them.
        self._tips.clear_excluded_cells()
        while True:
            edges, load = self._tips(stress, psi)
            spared = np.zeros(len(graph.broken), bool)
            spared[edges[~self._node_attachment(edges, stress)]] = True
            # A cell that would lose an edge which attaches a node is excluded, and the pass is repeated without it.
            cells = self._tips.cells
            detaching = cells[spared[graph.cell_edges[cells]].any(axis=1)]
            if not sum_over_ranks(graph.domain.comm, len(detaching))[0]:
                return edges, load
            self._tips.exclude_cells(detaching)
            self._tips.withdraw_cuts(edges)

    def set_motion(self, v: Values, a: Values, now: float, dt: float) -> None:
        """Store velocity (owned dofs,) in m/s and acceleration in m/s^2 at the end `now` of a step of `dt`, s."""
        self._tips.set_motion(v, a, now, dt)

    def snapshot(self) -> object:
        """Return the history variables of the tips."""
        return self._tips.snapshot()

    def restore(self, saved: object) -> None:
        """Restore the history variables of the tips."""
        self._tips.restore(saved)

    def restore_cuts(self, cut_positions: Values, tip_states: Values | None) -> None:
        """Restore the cut positions (edges,) and the states of tips (edges, n) that a checkpoint stored."""
        self._tips.restore_cuts(cut_positions, tip_states)
