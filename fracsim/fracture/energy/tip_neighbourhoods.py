"""What lies around the tips: looked for only where cracks have changed, and kept until they do.

A tip is a cell that is cut and has not come apart, at the mean of the places where its edges are cut. The cells around
it, and their weights in its sums, are kept as long as it stays; the crack behind it as long as none of it changes.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
import numpy.typing as npt
from scipy.sparse import csc_matrix, csr_matrix, hstack
from scipy.spatial import cKDTree

from ...mesh.edge_graph import EdgeGraph
from ..brittle.principal_stress import largest, tensors
from . import branching, mixed_mode
from .configurational_force import plateau, plateau_gradient
from .crack_front import Alone, Along, Front, advance
from .cut_cells import Crack
from .neighbour_search import Around, Pairs, over, pairs_within

Flags = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]

LEAST_DISC = 3.0  # R over h is more: polygons reach as far as a cell beyond their cell's centre
FACED = 0.1  # of R^2: area of the body's surface within a disc from which on it is there


@dataclass(frozen=True)
class Reach:
    """(cells,) how far a tip in a cell looks, m: the `disc` of its force, where stress is averaged (`average`, no more
    than that), and how far `beyond` the disc there is a crack once it is mature."""

    disc: Values
    average: Values
    beyond: Values


@dataclass(frozen=True)
class Tips:
    """Tips of this rank.

    Attributes:
        cell: (n,) local, rising.    pattern: (n,) of its cut edges.    point: (n, d) m.
        behind: (n, d) the middle of the crack nearer than R, m.    mature: (n,) whether there is any beyond R.
        ahead: (n, d) the crack that an advance makes: in space m, in the plane in tips (branching).
        course: (n, d) from the middle of the crack nearer than 2 R to the tip, m; only where cracks branch.
        parts: (n, d) whither it goes abreast of another in its disc; 0 where there is none, and in space.
        waits: (n,) whether it lets that other go first.    alone: (n,) whether no other tip's disc lies over its own.
        surface: (n, d) int q n dA of the body's own surface in the disc, m^(d-1).
    """

    cell: Ints
    pattern: npt.NDArray[np.uint8]
    point: Values
    behind: Values
    mature: Flags
    ahead: Values
    course: Values
    parts: Values
    waits: Flags
    alone: Flags
    surface: Values

    def __len__(self) -> int:
        return len(self.cell)


class _Sum(IntEnum):
    """Weights of a cell in the sums around a tip, behind its V grad q; all but the first are 0 of split cells."""

    INSIDE = 0  # V q
    MEAN = 1  # V (1 - r / radius of the average)
    ALIKE = 2  # V


class Neighbourhoods:
    """The tips of this rank, and sums over the cells around them.

    Attributes:
        tips: as they were when `update` was called last.    asked: the cells around them.
        along: in space, what G their fronts have there.
    """

    def __init__(
        self, around: Around, crack: Crack, graph: EdgeGraph, front: Front, reach: Reach, *, forks: bool, shares: bool
    ) -> None:
        """`forks`: whether cracks branch; `shares`: whether tips of a front take their shares of a force
        (crack_front)."""
        self._around, self._crack, self._graph, self._front, self._reach = around, crack, graph, front, reach
        self._forks, self.along = forks, (Along if shares else Alone)(graph.domain.comm)
        none, nowhere, no = np.empty(0, np.int64), np.empty((0, graph.domain.dim)), np.empty(0, bool)
        self.tips = Tips(none, none.astype(np.uint8), nowhere, nowhere, no, nowhere, nowhere, nowhere, no, no, nowhere)
        self._split = np.zeros(len(around.number), bool)
        # the tip and the cell (among those near) of each pair, and the cell's weights in the sums of `_Sum`
        self._place: Ints = none
        self._cell: Ints = none
        self._weights: Values = np.empty((0, graph.domain.dim + len(_Sum)))
        self._crossed: Values = nowhere  # and int q n dA over what it has of the body's surface
        self._matrices: dict[int, csr_matrix] = {}
        self._products: tuple[csc_matrix, csc_matrix, csc_matrix] | None = None

    def update(self, cut: Values) -> None:
        """Cracks have changed: look anew where they have (collective)."""
        number, centre = self._crack.update(cut)
        for cells, split in ((number, False), (self._crack.number[self._crack.split], True)):
            place, near = self._around.those_of(cells)
            self._split[place[near]] = split
        fresh = self._look(cut)
        self._look_back(np.flatnonzero(fresh | self._near(centre)))
        needed = np.zeros(len(self._split), bool)
        needed[self._cell] = True
        cells = np.flatnonzero(needed)
        self.asked = self._around.asked(cells)
        index = np.cumsum(needed) - 1
        ends = np.concatenate([[0], np.cumsum(np.bincount(self._place, minlength=len(self.tips)))])
        self._shape, self._index, self._ends = (len(self.tips), len(cells)), index[self._cell], ends
        self._matrices.clear()
        self._products = None
        if self.tips.point.shape[1] == 3:
            cell, domain = self.tips.cell, self._graph.domain
            self.along.update(domain.cell_input[cell], self.tips.point, self.tips.ahead, self._reach.disc[cell])

    # --- sums ---

    def forces(self, sigma: Values, push: Values) -> Values:
        """(n, d) - sum V Sigma grad q + sum V q f over the discs of tips: Sigma (asked, d, d) in Pa and f (asked, d) in
        N/m^3."""
        d = sigma.shape[1]
        slopes, inside, _ = self._force
        rows = np.moveaxis(sigma, 0, -1).reshape(d, -1)
        return np.column_stack([inside @ push[:, i] - slopes @ rows[i] for i in range(d)])

    def most(self, sigma: Values, push: Values) -> Values:
        """(n,) no less than the size of those forces: sum V |Sigma| |grad q| + sum V q |f|."""
        size, pushed = np.einsum("nij,nij->n", sigma, sigma), np.einsum("ni,ni->n", push, push)
        return self.most_of(np.sqrt(size)[:, None], np.sqrt(pushed)[:, None]).sum(axis=1)

    def most_of(self, sizes: Values, pushed: Values) -> Values:
        """(n, k + m) sum V |grad q| of `sizes` (asked, k), and sum V q of `pushed` (asked, m)."""
        _, inside, steep = self._force
        return np.column_stack([steep @ sizes, inside @ pushed])

    @property
    def _force(self) -> tuple[csc_matrix, csc_matrix, csc_matrix]:
        """(tips, d asked) V grad q less int q n dA, one axis after the other, (tips, asked) V q and the size of these;
        by columns, which takes two thirds of the time: in rows each sum waits for the one before."""
        if self._products is None:
            slopes = self._weights[:, : self.tips.point.shape[1]] - self._crossed_ahead()
            axes = [self._sparse(each) for each in slopes.T]
            steep = sum(each.multiply(each) for each in axes).sqrt()
            matrices = hstack(axes), self._matrix(len(axes) + _Sum.INSIDE), steep
            self._products = tuple(each.tocsc() for each in matrices)
        return self._products

    def _crossed_ahead(self) -> Values:
        """(pairs, d) int q n dA over the body's surface around tips that go for it."""
        tips = self.tips
        onwards, size = (np.linalg.norm(each, axis=1) for each in (tips.ahead, tips.surface))
        faces = np.einsum("ni,ni->n", tips.ahead, tips.surface) ** 2 > (onwards * size) ** 2 / 2
        return faces[self._place, None] * self._crossed

    def means(self, rows: Ints, stress: Values) -> Values:
        """(m, d, d) mean stress in Pa around tips `rows` (m,), that of cells (asked, 3 or 6) which have not come apart,
        weighted by 1 - r over the radius of the average."""
        d = self._graph.domain.dim
        weights = self._matrix(d + _Sum.MEAN)[rows]
        sums = np.column_stack([weights @ column for column in stress.T])
        return tensors(over(sums, np.asarray(weights.sum(axis=1))), d)

    def intensities(
        self, fields: tuple[Values, Values, Values], elastic: tuple[Values, Values], *, turns: bool
    ) -> Values:
        """(n, 2) K_I and K_II in Pa sqrt(m) of tips in the plane, along the crack behind them (mixed_mode).

        `fields`: stress (asked, 3) in Pa, grad u (asked, 2, 2), rho a (asked, 2) in N/m^3, of cells that have not
        come apart. `elastic`: (n,) mu in Pa and kappa. `turns`: as seen by somebody who turns with what is in the disc.
        """
        rows, tips, count = np.flatnonzero(~self._split[self._cell]), self.tips, len(self.tips)
        place, index, inside = self._place[rows], self._index[rows], self._weights[rows, 2 + _Sum.INSIDE]
        stress, H, push = (np.ascontiguousarray(each)[index] for each in (tensors(fields[0], 2), *fields[1:]))
        if turns:
            F = H + np.eye(2)
            sines, cosines = (np.bincount(place, inside * each, count)
                              for each in (F[:, 1, 0] - F[:, 0, 1], F[:, 0, 0] + F[:, 1, 1]))  # fmt: skip
            stress, H, push = mixed_mode.turned_back(np.arctan2(sines, cosines)[place], stress, F, push)
        apart = self._around.centres[self._cell[rows]] - tips.point[place]
        tangent = branching.unit(tips.point - tips.behind)[place]
        mu, kappa = (each[place] for each in elastic)
        around = mixed_mode.Around(apart, tangent, self._weights[rows, :2], inside, stress, H, push, mu, kappa)
        return np.column_stack([np.bincount(place, each, count) for each in mixed_mode.shares(around).T])

    def squares(self, rows: Ints, stress: Values) -> Values:
        """(m,) mean square of the positive first principal stress around tips, of stress (asked, 3 or 6), all cells
        alike, Pa^2."""
        d = self._graph.domain.dim
        weights = self._matrix(d + _Sum.ALIKE)[rows]
        cells = np.unique(weights.indices)
        squares = np.zeros(len(stress))
        squares[cells] = np.maximum(largest(tensors(stress[cells], d)), 0.0) ** 2
        return over(weights @ squares, np.asarray(weights.sum(axis=1)).ravel())

    def _matrix(self, column: int) -> csr_matrix:
        """(tips, asked) weights, kept until cracks change."""
        if column not in self._matrices:
            data = self._weights[:, column]
            if column > self._graph.domain.dim:
                data = np.where(self._split[self._cell], 0.0, data)
            self._matrices[column] = self._sparse(data)
        return self._matrices[column]

    def _sparse(self, data: Values) -> csr_matrix:
        """(tips, asked) of what pairs have."""
        matrix = csr_matrix((data, self._index, self._ends), shape=self._shape, copy=True)
        matrix.eliminate_zeros()  # in place
        return matrix

    # --- what lies around ---

    def _look(self, cut: Values) -> Flags:
        """Find the tips, and the cells around those that are new: (n,) flags of these."""
        graph, old = self._graph, self.tips
        cell = np.flatnonzero(graph.damaged & ~graph.split).astype(np.int64)
        before = np.full(graph.domain.cell_count, -1)
        before[old.cell] = np.arange(len(old))
        row = before[cell]
        kept = row >= 0
        kept[kept] = old.pattern[row[kept]] == graph.pattern[cell[kept]]
        new = np.flatnonzero(~kept)
        point = self._front.middles(cell, cut)
        place, cells, weights, crossed = self._surroundings(cell[new], point[new])
        after = np.full(len(old), -1)
        after[row[kept]] = np.flatnonzero(kept)
        stays = np.flatnonzero(after[self._place] >= 0)
        every = np.concatenate([after[self._place[stays]], new[place]])
        order = np.argsort(every, kind="stable")
        self._place, self._cell = every[order], np.concatenate([self._cell[stays], cells])[order]
        self._weights = np.concatenate([self._weights[stays], weights])[order]
        self._crossed = np.concatenate([self._crossed[stays], crossed])[order]
        behind, ahead, course, parts, surfaces = np.zeros((5, *point.shape))
        mature, waits, alone = np.zeros((3, len(cell)), bool)
        size, slope = len(new), weights[:, : point.shape[1]]
        surfaces[new] = np.column_stack([np.bincount(place, each, size) for each in slope.T])
        self.tips = Tips(cell, graph.pattern[cell], point, behind, mature, ahead, course, parts, waits, alone, surfaces)
        for each in ("behind", "mature", "ahead", "course", "parts", "waits", "alone", "surface"):
            getattr(self.tips, each)[kept] = getattr(old, each)[row[kept]]
        return ~kept

    def _surroundings(self, cell: Ints, point: Values) -> tuple[Ints, Ints, Values, Values]:
        """Of tips: the tip and the cell of each pair, its (pairs, d + 3) weights and (pairs, d) int q n dA of it."""
        disc, average = self._reach.disc[cell], self._reach.average[cell]
        pairs = self._around.pairs(point, disc)
        volume, r, R = self._around.volumes[pairs.other], pairs.distance, disc[pairs.place]
        slope = volume[:, None] * plateau_gradient(pairs.apart, R)
        share = 1 - r / average[pairs.place]
        columns = [plateau(r, R), np.maximum(share, 0.0), share > 0]
        weights = np.column_stack([slope, *(volume * each for each in columns)])
        apart = np.linalg.norm(self._around.there[pairs.other] - point[pairs.place], axis=1)
        return pairs.place, pairs.other, weights, plateau(apart, R)[:, None] * self._around.outside[pairs.other]

    def _near(self, changed: Values) -> Flags:
        """(n,) whether a tip sees any of the cells with these centres (m, d)."""
        if not len(changed):
            return np.zeros(len(self.tips), bool)
        disc, beyond = self._reach.disc[self.tips.cell], self._reach.beyond[self.tips.cell]
        apart = cKDTree(changed).query(self.tips.point)[0]
        farthest = (
            disc * (1 + 1 / LEAST_DISC) if changed.shape[1] == 3 else 2 * (1 + self._forks) * disc
        )  # others' tips, and what they see
        return np.asarray(apart <= np.maximum(disc + beyond, farthest))

    def _look_back(self, rows: Ints) -> None:
        """Find the crack behind tips."""
        tips, crack = self.tips, self._crack
        point, disc = tips.point[rows], self._reach.disc[tips.cell[rows]]
        full, split = disc + self._reach.beyond[tips.cell[rows]], np.flatnonzero(crack.split)
        pairs = pairs_within(cKDTree(crack.centre[split]), point, np.maximum(full, disc * (1 + 1 / LEAST_DISC)))
        cells, r = split[pairs.other], disc[pairs.place]
        tips.behind[rows] = self._behind(pairs, cells, point, disc)
        tips.mature[rows] = pairs.any((pairs.distance >= r) & (pairs.distance < full[pairs.place]))
        if point.shape[1] == 3:
            near = np.flatnonzero(pairs.distance < r * (1 + 1 / LEAST_DISC))
            sides = advance(crack.polygon, (pairs.place[near], cells[near]), point, disc)
            tips.ahead[rows] = along_the_surface(sides, tips.surface[rows], disc)
        else:
            self._look_aside(rows, disc)

    def _behind(self, pairs: Pairs, cells: Ints, point: Values, disc: Values) -> Values:
        """(n, d) mean of the cuts of split cells (pairs,) of the crack nearer than `disc` to points, m."""
        within = (pairs.distance < disc[pairs.place]).astype(float)
        back = within[:, None] * (self._crack.middle[cells] - point[pairs.place])
        return point + over(pairs.sum(back), pairs.sum(within)[:, None])

    def _look_aside(self, rows: Ints, disc: Values) -> None:
        """Find the tips whose discs lie over those of tips, in the plane."""
        tips, crack = self.tips, self._crack
        every = np.flatnonzero(~crack.split)
        pairs = pairs_within(cKDTree(crack.middle[every]), tips.point[rows], (1 + self._forks) * disc)
        other = crack.middle[every[pairs.other]]
        along = self._way(other, disc[pairs.place])
        tips.ahead[rows] = branching.advance(pairs, along, disc)
        if self._forks:
            tips.alone[rows] = np.bincount(pairs.place, minlength=len(rows)) == 1
            tips.course[rows] = course = self._way(tips.point[rows], 2 * disc)
            theirs = self._way(other, 2 * disc[pairs.place])
            tips.parts[rows], tips.waits[rows] = branching.parted(pairs, course[pairs.place], theirs, disc)

    def _way(self, point: Values, radius: Values) -> Values:
        """(n, d) from the middle of the crack nearer than `radius` to points, m."""
        split = np.flatnonzero(self._crack.split)
        pairs = pairs_within(cKDTree(self._crack.centre[split]), point, radius)
        return point - self._behind(pairs, split[pairs.other], point, radius)


def along_the_surface(ahead: Values, surface: Values, radius: Values) -> Values:
    """(n, 3) the crack that an advance of tips makes, m; along the body's `surface` where it ends there.

    `surface`: (n, 3) int q n dA of the body, m^2: an advance across it would move the body's own surface. A front that
    has the surface ahead goes for it.
    """
    size = np.linalg.norm(surface, axis=1)[:, None]
    normal = np.divide(surface, size, out=np.zeros_like(surface), where=size > FACED * radius[:, None] ** 2)
    along = ahead - np.einsum("nk,nk->n", ahead, normal)[:, None] * normal
    turned = np.einsum("nk,nk->n", along, along) >= np.einsum("nk,nk->n", ahead, ahead) / 2
    return np.where(turned[:, None], along, ahead)
