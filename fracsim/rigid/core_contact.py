"""Pieces keep out of the cores of others: of the cells of the mesh that are wholly of one piece.

Convex parts that lie in one another from birth (rigid.fragment_overlap) may go on doing so, whichever way they came
apart; so they do not tell when a piece goes on through another. Cores do: a crack goes through the cells between two of
them, and as pieces break no node of one is in the core of another. Of pieces whose parts lie in one another the nodes
beside cracks are looked for in the cores of the others, where they would be as the step ends if nothing acted. One that
is deeper than LEAST behind the faces beside cracks, by d, touches the tangent plane there, at a distance

    g = max(0, dt c - d + LEAST),   c how fast it comes nearer:

it goes no deeper but by what the step gives it, and is not driven out. What is drawn of a crack lies between the cores:
so pieces come through no more of one another, as they are drawn, than what their crack went through. To hold corners of
cracks off what is drawn costs many times as much, and locks pieces whose cracks are jagged into one.

A node is looked at again when it may have come as far as the core was from it.
"""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import c_double, c_int64
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ..mesh.c_library import load_library
from ..mesh.split_surface.closed_surface import SplitSurface
from ..mesh.split_surface.entity_numbering import EntityNumbering
from ..meshes.topology import facets_of
from .bodies import Bodies

SOURCE = Path(__file__).with_suffix(".c")
Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]

LEAST, REACH, BOX = 0.02, 0.8, 0.5  # of the mean edge: see above, how far from a core is looked, side of the boxes
FAR = 1 << 40  # number of a box
MOST = 2  # nodes of a piece that touch the core of another, the deepest


@dataclass(frozen=True)
class Core:
    """Of the pieces of a copy, in the axes of the mesh, m.

    Attributes:
        nodes: (k, 3) beside cracks, of pieces `of` (k,), ascending.
        faces: (m, 3, 3) corners of the faces of cores, normals outwards, of pieces `owner` (m,), ascending.
        crack: (m,) 1 of those beside cracks, 0 of others.
    """

    nodes: Values
    of: Ints
    faces: Values
    owner: Ints
    crack: Ints

    @classmethod
    def of_split(cls, made: SplitSurface, skeleton: EntityNumbering) -> Core:
        """Of a split surface."""
        node = np.unique(skeleton.edges[made.broken])
        node = node[np.argsort(made.node_fragment[node], kind="stable")]
        of_cell, facets = made.node_fragment[skeleton.cells], skeleton.cell_facets
        whole = np.all(of_cell == of_cell[:, :1], axis=1)
        cells, wholes = (np.bincount(each.ravel(), minlength=len(skeleton.facets)) for each in (facets, facets[whole]))
        cell, side = np.nonzero((wholes == 1)[facets] & whole[:, None])
        order = np.argsort(of_cell[cell, 0], kind="stable")
        cell, side = cell[order], side[order]
        faces = skeleton.points[skeleton.cells[cell[:, None], facets_of(np.arange(4)[None])[0][side]]]
        crack = np.asarray(cells[facets[cell, side]] == 2, np.int64)
        return cls(skeleton.points[node], made.node_fragment[node], faces, of_cell[cell, 0], crack)

    @classmethod
    def none(cls) -> Core:
        """Of a copy in one piece, or a shell."""
        no = np.empty(0, np.int64)
        return cls(np.empty((0, 3)), no, np.empty((0, 3, 3)), no, no)


class Cores:
    """Of n pieces of copies, and how pairs of them stand."""

    def __init__(self, cores: Sequence[Core], pieces: Sequence[int], centre: Values, turn: Values, edge: float) -> None:
        """`cores` of copies in so many `pieces`; `centre`: (n, 3) of pieces in the axes of the mesh, m; `turn`:
        (n, 3, 3) from these to those of the body at rest; `edge`: the mean one of the mesh, m."""
        first = np.cumsum([0, *pieces])
        self._centre, self._turn, self._edge = np.ascontiguousarray(centre), turn, edge
        self._nodes = np.concatenate([each.nodes for each in cores])
        each_first = list(zip(cores, first, strict=False))
        self._of_node = np.concatenate([each.of + start for each, start in each_first])
        self._owner = np.concatenate([each.owner + start for each, start in each_first])
        self._faces = np.ascontiguousarray(np.concatenate([each.faces for each in cores]))
        self._crack = np.concatenate([each.crack for each in cores])
        self._begin = np.searchsorted(self._of_node, np.arange(first[-1] + 1))
        self._ends = np.searchsorted(self._owner, np.arange(first[-1] + 1))
        self._side = BOX * edge
        self._boxes, self._first, self._of = self._sorted()
        self._stands: _Stands | None = None

    def _ranges(self, begin: Ints, end: Ints, of: Ints) -> tuple[Ints, Ints]:
        """(n, 3) lowest boxes of pieces and (n, 3) how many there are, from boxes `begin` (k, 3) to `end` (k, 3) `of`
        pieces (k,)."""
        low, high = np.full((len(self._centre), 3), FAR), np.full((len(self._centre), 3), -FAR)
        np.minimum.at(low, of, begin)
        np.maximum.at(high, of, end)
        return low, np.maximum(high - low + 1, 0)

    def _near(self, pairs: Ints) -> Ints:
        """Those of pairs (k, 2) of which nodes of the second lie within REACH of the boxes of the first, or so, as they
        broke."""
        at = np.floor(self._nodes / self._side).astype(np.int64)
        low, many = self._ranges(at, at, self._of_node)
        (a, b), around = pairs.T, int(np.ceil(REACH / BOX))
        core, size = self._boxes[:, :3], self._boxes[:, 3:6]
        apart = (low[b] > core[a] + size[a] + around) | (low[b] + many[b] < core[a] - around)
        return pairs[~apart.any(axis=1) & (size[a, 0] > 0) & (many[b, 0] > 0)]

    def _sorted(self) -> tuple[Ints, Ints, Ints]:
        """Of boxes along the axes those of each piece (n, 7): the lowest along each, how many, and where they begin;
        where the faces in each box begin, and these."""
        ranges = self._faces.min(axis=1), self._faces.max(axis=1)
        begin, end = (np.floor(each / self._side).astype(np.int64) for each in ranges)
        low, many = self._ranges(begin, end, self._owner)
        ends = np.cumsum(many.prod(axis=1))
        span = end - begin + 1
        count = span.prod(axis=1)
        face = np.repeat(np.arange(len(begin)), count)
        place = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        piece, (_, b, c) = self._owner[face], span[face].T
        i, j, k = (begin[face] - low[piece]).T + np.stack([place // (b * c), place // c % b, place % c])
        box = (ends - many.prod(axis=1))[piece] + (i * many[piece, 1] + j) * many[piece, 2] + k
        order = np.argsort(box, kind="stable")
        boxes = np.concatenate([low, many, (ends - many.prod(axis=1))[:, None]], axis=1)
        return boxes, np.searchsorted(box[order], np.arange(ends[-1] + 1)), face[order]

    def __call__(self, pairs: Ints, bodies: Bodies, later: Bodies, step: float) -> tuple[Ints, Values, Values, Values]:
        """Of pairs (k, 2) of pieces that lie in one another from birth, all of them when first called and some later,
        what touches in a step, s: bodies (m, 2), points (m, 3), axes (m, 3, 3), the first out of the core of the first
        body, and distances (m,), m. `later`: the bodies where they would be after it."""
        things, node, depth, normal = self.deepest(pairs, later)
        first, second = things.T
        arm = np.einsum("kij,kj->ki", self._turn[second], self._nodes[node] - self._centre[second])
        x = bodies.to_space(bodies.centre[second] + arm, second)
        closing = np.einsum("ki,ki->k", normal, bodies.velocity_at(x, first) - bodies.velocity_at(x, second))
        gap = np.maximum(step * closing - depth + LEAST * self._edge, 0.0)
        return things, x, _axes(normal), gap

    def deepest(self, pairs: Ints, bodies: Bodies) -> tuple[Ints, Ints, Values, Values]:
        """Of such pairs, which bodies (m, 2) there are in the core of the first of which a node (m,) of the second is,
        how deep (m,), m, and the ways out (m, 3)."""
        n, least, both = len(self._centre), LEAST * self._edge, np.concatenate([pairs, pairs[:, ::-1]])
        if self._stands is None:
            self._stands = _Stands.of(np.unique(self._near(both) @ [n, 1]), n, self._begin, self._nodes, least)
        stands = self._stands
        both = both[np.isin(both @ [n, 1], stands.code)]
        chosen, count = np.searchsorted(stands.code, both @ [n, 1]), len(both)
        turn, place = np.ascontiguousarray(bodies.turn[:n] @ self._turn), np.ascontiguousarray(bodies.place)
        found, node = np.zeros(count, np.int64), np.zeros((count, MOST), np.int64)
        depth, normal = np.zeros((count, MOST)), np.zeros((count, MOST, 3))
        mine = [turn, place, self._centre, self._begin, self._nodes]
        grid = [self._boxes, self._first, self._of, self._faces, self._crack, self._ends]
        how = c_double(self._side), c_double(least), c_double(REACH * self._edge), c_int64(MOST)
        kept, out = [stands.last, stands.near, stands.where], [found, node, depth, normal]
        load_library(SOURCE).within(c_int64(count), chosen, stands.pairs, *mine, *grid, *how, *(kept + out))
        row, rank = np.nonzero(np.arange(MOST) < found[:, None])
        things = both[row]
        out_of = np.einsum("kij,kj->ki", turn[things[:, 0]], normal[row, rank])
        return things, node[row, rank], depth[row, rank], out_of


@dataclass(frozen=True)
class _Stands:
    """How ordered pairs (k, 2) with ascending codes (k,) stand: see `within` in core_contact.c."""

    code: Ints
    pairs: Ints
    last: Values
    near: Ints
    where: Ints

    @classmethod
    def of(cls, code: Ints, count: int, begin: Ints, nodes: Values, least: float) -> _Stands:
        """As pieces broke: no node is in a core."""
        pairs = np.stack([code // count, code % count], axis=1)
        many = np.diff(begin)[pairs[:, 1]]
        where = np.cumsum(many) - many
        node = np.arange(many.sum()) + np.repeat(begin[pairs[:, 1]] - where, many)
        last = np.concatenate([nodes[node], np.full((len(node), 1), least)], axis=1)
        return cls(code, pairs, last, np.full(len(node), -1), where)


def _axes(normal: Values) -> Values:
    """(k, 3, 3) rotations whose first rows are unit vectors (k, 3)."""
    across = np.cross(np.eye(3)[np.abs(normal).argmin(axis=1)], normal)
    across /= np.linalg.norm(across, axis=1)[:, None]
    return np.stack([normal, across, np.cross(normal, across)], axis=1)
