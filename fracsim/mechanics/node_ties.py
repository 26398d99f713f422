"""What holds nodes that have lost their last whole cell, and are joined to a neighbour all the same
(fracture.node_retention).

A cell that has come apart carries nothing, so such a node would fly off alone. It goes with a whole cell around the
neighbour that it is joined to, over others that hang there where need be: with barycentric coordinates lambda of its
place in the body as it is when it is tied (extrapolated: it lies outside the cell), sum lambda = 1,

    d = x_v - sum_k lambda_k x_k,    psi = k |d|^2 / 2,    k = HOLD Y h^(dim - 2),

h the mean edge. So d = 0 and nothing changes as a node is tied. Forces on v and on the corners of the cell are equal
and opposite, with no moment, f_v = -k d and f_k = lambda_k k d (sum_k lambda_k x_k x d + d x x_v = 0), and d turns with
the body: momentum, its moment and the energy of a rigid motion are those of a body without. The tangent is constant.
When the cell comes apart, too, the node is tied anew and what was stored is lost.

Equations: docs/theory.md#node-retention.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI

from ..mesh.domain import Domain
from ..mesh.node_cells import NodeCellCount
from ..mesh.parallel import allgather, sum_over_ranks
from ..mesh.simplices import is_split, local_edges
from ..meshes.components import components
from .extra_couplings import CouplingBuilder
from .term import Term

if TYPE_CHECKING:
    from petsc4py import PETSc
    from scipy.sparse import csr_matrix

    from .tie_matrix import TieMatrix

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Pattern = npt.NDArray[np.uint8]
TIE_STIFFNESS_FACTOR = (
    0.1  # of what a cell of the mean size has: far above the weight of a node, no burden for explicit steps
)
MAX_WEIGHT_SUM = 30.0  # sum |lambda| of a cell that is too flat to say where a node is


@dataclass(frozen=True)
class Ties:
    """Nodes that are tied, the same on all ranks, never changed.

    Attributes:
        nodes: (n, d + 2) numbers in the input mesh of a node and of the corners of its cell.    cell: (n,) the cell's.
        weights: (n, d + 2) 1 and -lambda.
    """

    nodes: Ints
    cell: Ints
    weights: Values

    @classmethod
    def empty(cls, dim: int) -> Ties:
        """No node is tied."""
        return cls(np.empty((0, dim + 2), np.int64), np.empty(0, np.int64), np.empty((0, dim + 2)))

    def select(self, which: npt.NDArray[np.bool_]) -> Ties:
        """Those flagged (n,)."""
        return Ties(self.nodes[which], self.cell[which], self.weights[which])

    def merge(self, other: Ties) -> Ties:
        """Both, by their nodes."""
        every = (np.concatenate([getattr(each, name) for each in (self, other)]) for name in Ties.__annotations__)
        both = Ties(*every)
        order = np.argsort(both.nodes[:, 0])
        return Ties(both.nodes[order], both.cell[order], both.weights[order])


class NodeTies(Term):
    """Nodes without a whole cell, tied to where they hang."""

    name = "tethers"
    linear = True  # ties change where cells come apart, and so with chi

    def __init__(self, domain: Domain, u: fem.Function, young: float, mass: Values, held: Flags) -> None:
        """`young`: Pa; `mass`: (owned dofs,) lumped, kg; `held`: (nodes,) whose motion is prescribed, ghosts too: they
        are not tied."""
        self._domain, self._u, self._mass, self._held = domain, u, mass, held
        self.stiffness = TIE_STIFFNESS_FACTOR * young * domain.mean_edge_length ** (domain.dim - 2)
        self._pattern: Pattern = np.zeros(domain.cell_count, np.uint8)
        self._coupling, self._around = CouplingBuilder(domain), NodeCellCount(domain)
        self._lost = 0.0
        input_of = domain.node_input[: domain.node_count]
        self._order = np.argsort(input_of)
        self._sorted = input_of[self._order]
        self._be(Ties.empty(domain.dim))

    def _be(self, ties: Ties) -> None:
        """Tie these, and no others (not collective)."""
        self.ties = ties
        self._matrix: PETSc.Mat | None = None
        self._beside: TieMatrix | None = None
        self._fastest: float | None = None
        self._numbers, place = np.unique(ties.nodes, return_inverse=True)
        self._place: Ints = place.reshape(ties.nodes.shape)
        self._here, self._local = self._owned(self._numbers)

    def _owned(self, numbers: Ints) -> tuple[Ints, Ints]:
        """Which of the input nodes (n,) this rank owns, and their local numbers."""
        at = np.minimum(np.searchsorted(self._sorted, numbers), max(len(self._sorted) - 1, 0))
        here = np.flatnonzero(self._sorted[at] == numbers) if len(self._sorted) else np.empty(0, np.int64)
        return here, self._order[at[here]]

    # --- which ---

    def edges_broke(self, pattern: Pattern) -> None:
        """Nodes are tied that have no whole cell any more, or whose cell came apart; what is whole again goes free."""
        self._pattern, domain = pattern.copy(), self._domain
        without = self._around(~is_split(domain.dim)[pattern]) == 0
        links, own = self._links(pattern, without)
        if not sum_over_ranks(domain.comm, len(own) + len(self.ties.cell))[0]:
            return
        links, nodes = (np.unique(np.concatenate(allgather(domain.comm, each)), axis=0) for each in (links, own))
        stays = np.isin(self.ties.nodes[:, 0], nodes) & self._is_whole(self.ties.cell)
        self._lost += self._stored(~stays)
        kept = self.ties.select(stays)
        new = nodes[~np.isin(nodes, kept.nodes[:, 0])]
        self._be(kept.merge(self._tied(new, *self._hanging(links, nodes), without)))

    def _links(self, pattern: Pattern, without: Flags) -> tuple[Ints, Ints]:
        """(n, 2) input nodes of the intact edges of this rank that have an end `without` (nodes,) a whole cell, and
        (m,) such ends that are not held."""
        domain, pairs = self._domain, local_edges(self._domain.dim)
        cells = np.flatnonzero(without[domain.cell_nodes].any(axis=1))
        ends = domain.cell_nodes[cells][:, pairs]  # (n, edges, 2)
        intact = (pattern[cells, None] >> np.arange(len(pairs))) & 1 == 0
        ends = ends[intact & without[ends].any(axis=2)]
        own = np.unique(ends[without[ends] & ~self._held[ends]])
        return np.sort(domain.node_input[ends], axis=1), domain.node_input[own]

    def _hanging(self, links: Ints, nodes: Ints) -> tuple[Ints, Ints]:
        """Of nodes (n,) that hang on others by links (m, 2): all nodes (k,) of links and the group (k,) of each."""
        every, ends = np.unique(np.concatenate([links.reshape(-1), nodes]), return_inverse=True)
        return every, components(ends[: links.size].reshape(-1, 2), len(every))[1]

    def _tied(self, new: Ints, every: Ints, group: Ints, without: Flags) -> Ties:
        """Nodes (n,) of input numbers, each by the cell around its group's (k,) nodes that tells best where it is
        (collective)."""
        domain, d = self._domain, self._domain.dim
        number = domain.node_input[domain.cell_nodes]
        at = np.minimum(np.searchsorted(every, number), len(every) - 1)
        of = np.where((every[at] == number) & ~without[domain.cell_nodes], group[at], -1)
        cells, corner = np.nonzero((of >= 0) & ~is_split(d)[self._pattern][:, None])
        x = domain.nodes + self._u.x.array.reshape(-1, d)
        mine = of[cells, corner], domain.cell_input[cells], number[cells], x[domain.cell_nodes[cells]]
        groups, cell, corners, places = (np.concatenate(each) for each in zip(*allgather(domain.comm, mine)))  # noqa: B905
        row, column = np.nonzero(group[np.searchsorted(every, new)][:, None] == groups)  # (node, cell) that may be
        weights = _barycentric(self._at(new)[row], places[column])
        size = np.where(np.isfinite(weights).all(axis=1), np.abs(weights).sum(axis=1), np.inf)
        order = np.lexsort((cell[column], size, row))
        _, first = np.unique(row[order], return_index=True)
        best = order[first]
        best = best[size[best] < MAX_WEIGHT_SUM]
        nodes = np.concatenate([new[row[best], None], corners[column[best]]], axis=1)
        return Ties(nodes, cell[column[best]], np.concatenate([np.ones((len(best), 1)), -weights[best]], axis=1))

    def _is_whole(self, cells: Ints) -> Flags:
        """(n,) whether cells of the input mesh are (collective)."""
        whole = self._domain.cell_input[~is_split(self._domain.dim)[self._pattern]] if len(cells) else cells
        return (
            sum_over_ranks(self._domain.comm, np.isin(cells, whole).astype(np.int64)) > 0 if len(cells) else cells > 0
        )

    # --- what it adds to the balance ---

    def _at(self, numbers: Ints) -> Values:
        """(n, d) x of nodes of the input mesh, m (collective)."""
        return self._sum(numbers, *self._owned(numbers))

    def _sum(self, numbers: Ints, here: Ints, local: Ints) -> Values:
        """(n, d) x of nodes of which this rank owns `here`, its `local` ones, m (collective)."""
        d = self._domain.dim
        x = np.zeros((len(numbers), d))
        x[here] = self._domain.nodes[local] + self._u.x.array.reshape(-1, d)[local]
        return np.asarray(sum_over_ranks(self._domain.comm, x)) if len(x) else x

    def _apart(self) -> Values:
        """(n, d) d of each tie, m (collective)."""
        x = self._sum(self._numbers, self._here, self._local)
        return np.asarray(np.einsum("nk,nkd->nd", self.ties.weights, x[self._place]))

    def add_nodal_forces(self, rows: Values) -> None:
        """r += k d on the node, - lambda k d on the corners."""
        if not len(self.ties.cell):
            return
        force = np.zeros((len(self._numbers), self._domain.dim))
        np.add.at(force, self._place, self.stiffness * self.ties.weights[:, :, None] * self._apart()[:, None])
        np.add.at(rows.reshape(-1, self._domain.dim), self._local, force[self._here])

    def _nodal(self) -> csr_matrix:
        """k w w^T along each axis, over the nodes of all ties."""
        from scipy.sparse import csr_matrix

        rows = np.repeat(np.arange(len(self.ties.cell)), self._domain.dim + 2)
        shape = len(self.ties.cell), len(self._numbers)
        W = csr_matrix((self.ties.weights.reshape(-1), (rows, self._place.reshape(-1))), shape=shape)
        return csr_matrix(self.stiffness * (W.T @ W))

    def tie_matrix(self, free: Flags) -> TieMatrix | None:
        """k w w^T, made once for the ties of now."""
        if not len(self.ties.cell):
            return None
        if self._beside is None:
            from .tie_matrix import TieMatrix

            may_move = free.reshape(-1, self._domain.dim)[self._local].astype(float)
            self._beside = TieMatrix(self._domain.comm, self._nodal(), self._here, self._local, may_move)
        return self._beside

    def coupling_matrix(self) -> PETSc.Mat | None:
        """k w w^T, made once for the ties of now (collective)."""
        if not len(self.ties.cell):
            return None
        if self._matrix is None:
            from scipy.sparse import csr_matrix, identity, kron

            n, d = len(self._numbers), self._domain.dim
            K = csr_matrix(kron(self._nodal(), identity(d)))
            first = self._domain.space.dofmap.index_map.local_range[0]
            own = np.zeros(n, np.int64)
            own[self._here] = first + self._local
            numbers: Ints = sum_over_ranks(self._domain.comm, own)
            if self._domain.comm.rank:
                K, numbers = csr_matrix((0, 0)), np.empty(0, np.int64)
            self._matrix = self._coupling(K, numbers)
        return self._matrix

    def _stored(self, which: Flags | None = None) -> float:
        """J, of all ties or of those flagged (n,), on rank 0 (collective)."""
        if not len(self.ties.cell):
            return 0.0
        squares = np.einsum("nd,nd->n", *[self._apart()] * 2)
        energy = self.stiffness / 2 * float(squares.sum() if which is None else squares[which].sum())
        return energy if self._domain.comm.rank == 0 else 0.0

    def stored_energy(self) -> float:
        """k |d|^2 / 2 at the current u, on rank 0, J (collective)."""
        return self._stored()

    def potential(self) -> float:
        """The same (collective)."""
        return self._stored()

    def step_work(self) -> tuple[float, float]:
        """No work, and what ties that came off had stored."""
        lost, self._lost = self._lost, 0.0
        return 0.0, lost

    def frequency_bound(self) -> float:
        """Gershgorin's bound of M^-1 K: max over nodes of k / m times the sum over its ties of |w| sum |w|, 1/s^2
        (collective)."""
        if self._fastest is None:
            mass = np.zeros(len(self._numbers))
            mass[self._here] = self._mass[:: self._domain.dim][self._local]
            size = np.abs(self.ties.weights)
            rows = np.bincount(self._place.reshape(-1), (size * size.sum(axis=1, keepdims=True)).reshape(-1), len(mass))
            every = sum_over_ranks(self._domain.comm, mass) if len(mass) else mass
            self._fastest = self.stiffness * float(np.max(rows / every, initial=0.0))
        return self._fastest

    # --- what it remembers ---

    def snapshot(self) -> object:
        """The ties, and the patterns of broken edges that they belong to."""
        return self.ties, self._pattern

    def restore(self, memory: object) -> None:
        """Those of then, if edges are broken as then: a step that is solved once more may have more of them."""
        ties, pattern = cast("tuple[Ties, Pattern]", memory)
        same = ties is self.ties or np.array_equal(pattern, self._pattern)
        if self._domain.comm.allreduce(same, op=MPI.LAND):
            self._lost = 0.0
            if ties is not self.ties:
                self._be(ties)

    def to_checkpoint(self) -> dict[str, Values]:
        """The ties by numbers of the input mesh."""
        ties = self.ties
        return {"nodes": ties.nodes.astype(float), "cell": ties.cell.astype(float), "weights": ties.weights}

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Be again what `saved` gave."""
        shape = (-1, self._domain.dim + 2)
        nodes, weights = saved["nodes"].reshape(shape).astype(np.int64), saved["weights"].reshape(shape)
        self._be(Ties(nodes, saved["cell"].astype(np.int64), weights))

    def destroy(self) -> None:
        """Give the memory of PETSc's matrix back."""
        self._coupling.destroy()


def _barycentric(x: Values, corners: Values) -> Values:
    """(n, d + 1) coordinates of points (n, d) in simplices (n, d + 1, d); not finite where these are flat."""
    span = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    flat = np.abs(np.linalg.det(span)) < 1e-12 * np.abs(span).max(axis=(1, 2), initial=0.0) ** x.shape[1]
    span[flat] = np.eye(x.shape[1])
    rest = np.linalg.solve(span, (x - corners[:, 0])[:, :, None])[:, :, 0]
    result = np.concatenate([1 - rest.sum(axis=1, keepdims=True), rest], axis=1)
    result[flat] = np.inf
    return np.asarray(result)
