"""Neighbourhoods of crack tips: the cells around each tip and their weights, updated only where cracks have changed.

A tip is a cell that is cut and not split, at the mean of the points at which its edges are cut. The cells around a tip
and their weights are stored until the cell is split, the crack behind it until a part of it changes.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt
from scipy.sparse import csc_matrix, csr_matrix, hstack
from scipy.spatial import cKDTree

from ...mesh.edge_graph import EdgeGraph
from ...mesh.small_matrices import barycentric_gradients
from ..principal_stress import symmetric_tensors
from . import branching, mixed_mode
from .configurational_force import plateau
from .crack_front import FrontReleaseRate, advance_vectors, project_on_surface
from .cut_cells import CutCells, CutGeometry
from .neighbour_search import NearbyCells, NeighbourPairs, find_pairs, weighted_mean
from .tip_parameters import TIP

Flags = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class TipRadii:
    """Radii of the neighbourhood of a tip in each cell (cells,), m.

    Attributes:
        disc: R of the domain of a tip.
        kinked: least radius of the part of it over which the force is summed, where the crack kinks.
        average: radius within which stress is averaged, at most R.
        beyond: a tip is mature if a split cell lies between R and R plus this length.
        start: radius of the half disc ahead of a place at which a crack starts; 0 without such discs.
        cell_reach: bound of the distance from the centroid of a cell to its corners.
        straight: distance from the tangent at the tip within which the crack counts as straight.
    """

    disc: Values
    kinked: Values
    average: Values
    beyond: Values
    start: Values
    cell_reach: Values
    straight: Values


@dataclass(frozen=True)
class CrackTips:
    """Crack tips of this rank.

    Attributes:
        cell: (n,) local cells, ascending.
        pattern: (n,) broken edges of the cells, one bit each.
        point: (n, d) positions, m.
        behind: (n, d) mean of the cuts of the crack nearer than the least radius of the force, m.
        radius: (n,) radius of the force, m.
        mature: (n,) whether the crack is longer than R.
        ahead: (n, d) advance that the force is divided by: in 3D the crack area it makes, m; in 2D see `branching`.
        course: (n, d) from the mean of the crack nearer than 2 R to the tip, m; 0 unless cracks may branch.
        branch_direction: (n, d) direction of a tip that advances side by side with another; 0 without one, and in 3D.
        is_inactive: (n,) whether the other one of two branches advances first.
        alone: (n,) whether no disc of another tip overlaps that of the tip.
        surface: (n, d) int q n dA over the surface of the body, m^(d-1).
    """

    cell: Ints
    pattern: npt.NDArray[np.uint8]
    point: Values
    behind: Values
    radius: Values
    mature: Flags
    ahead: Values
    course: Values
    branch_direction: Values
    is_inactive: Flags
    alone: Flags
    surface: Values

    def __len__(self) -> int:
        """Return the number of tips."""
        return len(self.cell)


# Attributes of tips that stay the same until the crack near them changes.
_KEPT = "behind", "radius", "mature", "ahead", "course", "branch_direction", "is_inactive", "alone", "surface"


class _Weight(IntEnum):
    """Columns of the weights of a cell after V grad q; all but the first are 0 for split cells."""

    INSIDE = 0  # V q
    MEAN = 1  # V (1 - r / radius of the average)


class TipNeighbourhoods:
    """Tips of this rank, and weighted sums over the cells around them.

    Attributes:
        tips: tips at the last update.
        remote_values: exchange of the values of the cells around them.
        front_release_rate: in 3D, the energy release rate from the forces on tips.
    """

    def __init__(
        self,
        nearby: NearbyCells,
        cut_cells: CutCells,
        graph: EdgeGraph,
        geometry: CutGeometry,
        radii: TipRadii,
        *,
        may_branch: bool,
        shares: bool,
    ) -> None:
        """Start without tips.

        Args:
            nearby: cells within the largest radius.
            cut_cells: cut cells of all ranks.
            graph: edges and their damage.
            geometry: positions of the cuts.
            radii: radii of neighbourhoods.
            may_branch: cracks may branch (2D).
            shares: tips of a front share their force (3D).
        """
        self._nearby, self._cut_cells, self._graph, self._geometry = nearby, cut_cells, graph, geometry
        self._radii, self._may_branch = radii, may_branch
        self.front_release_rate = FrontReleaseRate(graph.domain.comm, averaged=shares)
        none, no_points, no = np.empty(0, np.int64), np.empty((0, graph.domain.dim)), np.empty(0, bool)
        self.tips = CrackTips(
            none,
            none.astype(np.uint8),
            no_points,
            no_points,
            np.empty(0),
            no,
            no_points,
            no_points,
            no_points,
            no,
            no,
            no_points,
        )
        self._split = np.zeros(len(nearby.number), bool)
        # Pairs of a tip and a cell (among the near ones), and the weights of the cell in sums around the tip.
        self._pair_tip: Ints = none
        self._pair_cell: Ints = none
        self._weights: Values = np.empty((0, graph.domain.dim + len(_Weight)))
        # int q n dA over the surface of the body that the cell of a pair has.
        self._surface_weights: Values = no_points
        self._matrices: dict[int, csr_matrix] = {}
        self._force_matrices: tuple[csc_matrix, csc_matrix] | None = None
        self._shape = 0, 0

    @property
    def split_cells(self) -> Flags:
        """(near,) whether the near cells are split."""
        return self._split

    def update(self, cut: Values) -> None:
        """Update the neighbourhoods near changed cells; `cut`: (edges,) cut positions (collective)."""
        # Cells that are no longer cut (after a repeated step) are unsplit again.
        number, centre = self._cut_cells.update_cells(cut)
        for cells, split in ((number, False), (self._cut_cells.number[self._cut_cells.split], True)):
            position, is_near = self._nearby.find_cells(cells)
            self._split[position[is_near]] = split
        old_row = self._find_tips(cut)
        self._update_cracks_behind(np.flatnonzero((old_row < 0) | self._flag_near(centre)), old_row)
        # Only the cells around tips are requested from their ranks.
        needed = np.zeros(len(self._split), bool)
        needed[self._pair_cell] = True
        cells = np.flatnonzero(needed)
        self.remote_values = self._nearby.request_values(cells)
        index = np.cumsum(needed) - 1
        # Row pointers of the matrices: pairs are ordered by tips.
        ends = np.concatenate([[0], np.cumsum(np.bincount(self._pair_tip, minlength=len(self.tips)))])
        self._shape, self._index, self._ends = (len(self.tips), len(cells)), index[self._pair_cell], ends
        self._matrices.clear()
        self._force_matrices = None
        if self.tips.point.shape[1] == 3:
            cell, domain = self.tips.cell, self._graph.domain
            number = domain.input_numbering.cells[cell]
            self.front_release_rate.update(number, self.tips.point, self.tips.ahead, self.tips.radius)

    # --- sums around tips; `requested` counts the cells of `remote_values` ---

    def evaluate_forces(self, sigma: Values, inertia: Values) -> Values:
        """Return configurational forces (n, d): - sum V Sigma grad q + sum V q f + surface integral.

        Args:
            sigma: (requested, d, d) Eshelby stress, Pa.
            inertia: (requested, d) f, N/m^3.
        """
        d = sigma.shape[1]
        slopes, inside = self._force_operators
        rows = np.moveaxis(sigma, 0, -1).reshape(d, -1)
        return np.column_stack([inside @ inertia[:, i] - slopes @ rows[i] for i in range(d)])

    @property
    def _force_operators(self) -> tuple[csc_matrix, csc_matrix]:
        """V grad q less int q n dA (tips, d requested), one axis after the other, and V q (tips, requested)."""
        # By columns products take two thirds of the time: by rows each sum depends on the one before.
        if self._force_matrices is None:
            slopes = self._weights[:, : self.tips.point.shape[1]] - self._surface_weights_ahead()
            axes = [self._sparse_matrix(component) for component in slopes.T]
            inside = self._weight_matrix(len(axes) + _Weight.INSIDE)
            self._force_matrices = hstack(axes).tocsc(), inside.tocsc()
        return self._force_matrices

    def _surface_weights_ahead(self) -> Values:
        """Return int q n dA (pairs, d) for tips that advance towards the body's surface, 0 for the others."""
        tips = self.tips
        advance, size = (np.linalg.norm(vectors, axis=1) for vectors in (tips.ahead, tips.surface))
        faces_surface = np.einsum("ni,ni->n", tips.ahead, tips.surface) ** 2 > (advance * size) ** 2 / 2
        return faces_surface[self._pair_tip, None] * self._surface_weights

    def mean_stress(self, rows: Ints, stress: Values) -> Values:
        """Return the mean stress (m, d, d), Pa, around tips `rows` (m,), over cells that are not split.

        The weight is 1 - r over the radius of the average; `stress` is (requested, 3 or 6), Pa.
        """
        d = self._graph.domain.dim
        weights = self._weight_matrix(d + _Weight.MEAN)[rows]
        sums = np.column_stack([weights @ column for column in stress.T])
        return symmetric_tensors(weighted_mean(sums, np.asarray(weights.sum(axis=1))), d)

    def stress_intensities(
        self, fields: tuple[Values, Values, Values], elastic: tuple[Values, Values], *, rotates: bool
    ) -> Values:
        """Return K_I and K_II (n, 2), Pa sqrt(m), of tips in 2D along the crack behind them (mixed_mode).

        Args:
            fields: stress (requested, 3), Pa, grad u (requested, 2, 2), and rho a (requested, 2), N/m^3.
            elastic: (n,) mu, Pa, and (n,) kappa.
            rotates: the mean rotation of the disc is removed first (large rotations).
        """
        # The auxiliary field is that of intact material: split cells are left out.
        rows, tips, count = np.flatnonzero(~self._split[self._pair_cell]), self.tips, len(self.tips)
        tip, index, inside = self._pair_tip[rows], self._index[rows], self._weights[rows, 2 + _Weight.INSIDE]
        stress, H, inertia_force = (
            np.ascontiguousarray(values)[index] for values in (symmetric_tensors(fields[0], 2), *fields[1:])
        )
        if rotates:
            F = H + np.eye(2)
            sines, cosines = (
                np.bincount(tip, inside * component, count)
                for component in (F[:, 1, 0] - F[:, 0, 1], F[:, 0, 0] + F[:, 1, 1])
            )
            angle = np.arctan2(sines, cosines)[tip]
            stress, H, inertia_force = mixed_mode.rotate_back(angle, stress, F, inertia_force)
        apart = self._nearby.centres[self._pair_cell[rows]] - tips.point[tip]
        tangent = branching.unit_or_zero(tips.point - tips.behind)[tip]
        mu, kappa = (values[tip] for values in elastic)
        slope = self._weights[rows, :2]
        disc = mixed_mode.TipDiscFields(apart, tangent, slope, inside, stress, H, inertia_force, mu, kappa)
        contributions = mixed_mode.intensity_contributions(disc)
        return np.column_stack([np.bincount(tip, column, count) for column in contributions.T])

    def _weight_matrix(self, column: int) -> csr_matrix:
        """Return a column of the weights as a matrix (tips, requested), kept until the next update."""
        if column not in self._matrices:
            data = self._weights[:, column]
            # V q counts in split cells as well, which have inertia; averages leave them out.
            if column > self._graph.domain.dim:
                data = np.where(self._split[self._pair_cell], 0.0, data)
            self._matrices[column] = self._sparse_matrix(data)
        return self._matrices[column]

    def _sparse_matrix(self, data: Values) -> csr_matrix:
        """Return values of pairs (pairs,) as a matrix (tips, requested)."""
        # The copy protects the weights: zeros are eliminated in place.
        matrix = csr_matrix((data, self._index, self._ends), shape=self._shape, copy=True)
        matrix.eliminate_zeros()
        return matrix

    # --- update of tips, and of the cracks behind them ---

    def _find_tips(self, cut: Values) -> Ints:
        """Find the tips; return the rows (n,) that they had at the last update, -1 for new ones."""
        graph, old = self._graph, self.tips
        cell = np.flatnonzero(graph.damaged & ~graph.split).astype(np.int64)
        old_row = np.full(graph.domain.cell_count, -1)
        old_row[old.cell] = np.arange(len(old))
        row = old_row[cell]
        # A tip is the same if its cell is cut as before.
        unchanged = row >= 0
        unchanged[unchanged] = old.pattern[row[unchanged]] == graph.pattern[cell[unchanged]]
        row[~unchanged] = -1
        point = self._geometry.mean_cut_points(cell, cut)
        behind, ahead, course, branch_direction, surfaces = np.zeros((5, *point.shape))
        mature, is_inactive, alone = np.zeros((3, len(cell)), bool)
        self.tips = CrackTips(
            cell,
            graph.pattern[cell],
            point,
            behind,
            np.zeros(len(cell)),
            mature,
            ahead,
            course,
            branch_direction,
            is_inactive,
            alone,
            surfaces,
        )
        for name in _KEPT:
            getattr(self.tips, name)[unchanged] = getattr(old, name)[row[unchanged]]
        return row

    def _update_surroundings(self, old_row: Ints) -> None:
        """Find the cells around tips with -1 in `old_row` (n,), and keep those around the others (collective)."""
        tips, new = self.tips, np.flatnonzero(old_row < 0)
        pair_tip, pair_cell, weights, surface_weights = self._find_surroundings(
            tips.cell[new], tips.point[new], tips.radius[new]
        )
        # The integral of grad q over the body is that of q n over its surface.
        slope = weights[:, : tips.point.shape[1]]
        tips.surface[new] = np.column_stack([np.bincount(pair_tip, component, len(new)) for component in slope.T])
        # Merge the pairs of old and new tips, ordered by tips.
        new_row = np.full(self._shape[0], -1)
        new_row[old_row[old_row >= 0]] = np.flatnonzero(old_row >= 0)
        old_pairs = np.flatnonzero(new_row[self._pair_tip] >= 0)
        all_tips = np.concatenate([new_row[self._pair_tip[old_pairs]], new[pair_tip]])
        order = np.argsort(all_tips, kind="stable")
        self._pair_tip = all_tips[order]
        self._pair_cell = np.concatenate([self._pair_cell[old_pairs], pair_cell])[order]
        self._weights = np.concatenate([self._weights[old_pairs], weights])[order]
        self._surface_weights = np.concatenate([self._surface_weights[old_pairs], surface_weights])[order]

    def _find_surroundings(self, cell: Ints, point: Values, radius: Values) -> tuple[Ints, Ints, Values, Values]:
        """Find the pairs of tips and cells around them (collective).

        q is that of the nodes, linear in each cell: a uniform Eshelby stress exerts no force.

        Returns:
            Tip (pairs,) and cell (pairs,), the weights (pairs, d + 2), and int q n dA (pairs, d) of the cell's surface.
        """
        average = self._radii.average[cell]
        pairs = self._nearby.find_pairs(point, radius + self._radii.cell_reach[cell])
        needed, index = np.unique(pairs.second, return_inverse=True)
        corners, outside = self._nearby.corners(needed)
        distance = np.linalg.norm(corners[index] - point[pairs.first, None], axis=2)
        q, share = plateau(distance, radius[pairs.first, None]), 1 - pairs.distance / average[pairs.first]
        rows = np.flatnonzero((q > 0).any(axis=1) | (share > 0))
        q, share, index, tip, cells = q[rows], share[rows], index[rows], pairs.first[rows], pairs.second[rows]
        volume, gradients = self._nearby.volumes[cells], barycentric_gradients(corners)[index]
        slope = volume[:, None] * np.einsum("pk,pki->pi", q, gradients)
        columns = [q.mean(axis=1), np.maximum(share, 0.0)]
        weights = np.column_stack([slope, *(volume * column for column in columns)])
        # The outward area of the side opposite to a corner is - d V grad N; q is averaged over its corners.
        side_mean = outside[index] * (q.sum(axis=1, keepdims=True) - q)
        surface_weights = -volume[:, None] * np.einsum("pk,pki->pi", side_mean, gradients)
        return tip, cells, weights, surface_weights

    def _flag_near(self, changed: Values) -> Flags:
        """Return whether tips (n,) depend on any of the changed cells with centroids (m, d)."""
        if not len(changed):
            return np.zeros(len(self.tips), bool)
        disc, beyond = self._radii.disc[self.tips.cell], self._radii.beyond[self.tips.cell]
        distance = cKDTree(changed).query(self.tips.point)[0]
        # In 2D a tip depends on other tips around it, and on what these depend on.
        reach = disc * (1 + 1 / TIP.min_disc_radius) if changed.shape[1] == 3 else 2 * (1 + self._may_branch) * disc
        return np.asarray(distance <= np.maximum(disc + beyond, reach))

    def _update_cracks_behind(self, rows: Ints, old_row: Ints) -> None:
        """Update the cracks behind tips `rows` (m,), and the cells around new tips and those with a new radius.

        `old_row` (n,) are the rows at the last update, -1 for new tips (collective).
        """
        tips, cut_cells, cell = self.tips, self._cut_cells, self.tips.cell[rows]
        point, disc = tips.point[rows], self._radii.disc[cell]
        mature_radius, split = disc + self._radii.beyond[cell], np.flatnonzero(cut_cells.split)
        reach = np.maximum(mature_radius, disc * (1 + 1 / TIP.min_disc_radius))
        pairs = find_pairs(cKDTree(cut_cells.centre[split]), point, reach)
        cells, r = split[pairs.second], disc[pairs.first]
        tips.behind[rows] = self._mean_cut_point_behind(pairs, cells, point, self._radii.kinked[cell])
        tips.mature[rows] = pairs.any((pairs.distance >= r) & (pairs.distance < mature_radius[pairs.first]))
        old_radius, in_plane = tips.radius[rows], point.shape[1] == 2
        tips.radius[rows] = self._straight_length(rows, pairs, cells) if in_plane else disc
        old_row[rows[tips.radius[rows] != old_radius]] = -1
        self._update_surroundings(old_row)
        if in_plane:
            self._update_shared_advance(rows, disc)
        else:
            near = np.flatnonzero(pairs.distance < r * (1 + 1 / TIP.min_disc_radius))
            advance = advance_vectors(cut_cells.polygon, (pairs.first[near], cells[near]), point, disc)
            tips.ahead[rows] = project_on_surface(advance, tips.surface[rows], disc)

    def _straight_length(self, rows: Ints, pairs: NeighbourPairs, cells: Ints) -> Values:
        """Return the distance (m,), m, from tips `rows` (m,) in 2D up to which the crack behind is straight.

        It is between the least and the largest radius of the force. `pairs` are those of the tips and split `cells`.
        """
        tips, first = self.tips, pairs.first
        tangent, cell = branching.unit_or_zero(tips.point - tips.behind)[rows], tips.cell[rows]
        back = self._cut_cells.cut_point[cells] - tips.point[rows][first]
        aside = np.abs(tangent[first, 0] * back[:, 1] - tangent[first, 1] * back[:, 0])
        leaves = aside > self._radii.straight[cell][first]
        length = self._radii.disc[cell].copy()
        np.minimum.at(length, first[leaves], np.linalg.norm(back[leaves], axis=1))
        return np.maximum(length, self._radii.kinked[cell])

    def _mean_cut_point_behind(self, pairs: NeighbourPairs, cells: Ints, point: Values, radius: Values) -> Values:
        """Return the mean (n, d), m, of the cuts of split cells (pairs,) nearer than `radius` to points."""
        # Relative to the point, so that a tip without a crack behind it has the point itself.
        within = (pairs.distance < radius[pairs.first]).astype(float)
        back = within[:, None] * (self._cut_cells.cut_point[cells] - point[pairs.first])
        return point + weighted_mean(pairs.sum(back), pairs.sum(within)[:, None])

    def _update_shared_advance(self, rows: Ints, disc: Values) -> None:
        """Update what tips `rows` (m,) in 2D have from tips whose discs overlap theirs."""
        tips, cut_cells = self.tips, self._cut_cells
        all_tips = np.flatnonzero(~cut_cells.split)
        pairs = find_pairs(cKDTree(cut_cells.cut_point[all_tips]), tips.point[rows], (1 + self._may_branch) * disc)
        other_points = cut_cells.cut_point[all_tips[pairs.second]]
        directions = self._direction_from_crack(other_points, self._radii.kinked[tips.cell[rows]][pairs.first])
        tips.ahead[rows] = branching.shared_advance(pairs, directions, tips.radius[rows])
        if self._may_branch:
            tips.alone[rows] = np.bincount(pairs.first, minlength=len(rows)) == 1
            tips.course[rows] = course = self._direction_from_crack(tips.point[rows], 2 * disc)
            other_course = self._direction_from_crack(other_points, 2 * disc[pairs.first])
            branch_direction, is_inactive = branching.branch_directions(pairs, course[pairs.first], other_course, disc)
            tips.branch_direction[rows], tips.is_inactive[rows] = branch_direction, is_inactive

    def _direction_from_crack(self, point: Values, radius: Values) -> Values:
        """Return vectors (n, d), m, from the mean of the crack nearer than radius (n,) to points (n, d)."""
        split = np.flatnonzero(self._cut_cells.split)
        pairs = find_pairs(cKDTree(self._cut_cells.centre[split]), point, radius)
        return point - self._mean_cut_point_behind(pairs, split[pairs.second], point, radius)
