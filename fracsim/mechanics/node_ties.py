"""Ties of nodes without an unsplit cell to an unsplit cell nearby (fracture.node_retention).

Such a node would be detached. It is attached to a cell at the neighbour that keeps an edge to it, with barycentric
coordinates lambda of its position at the time of the tie (outside of the cell), sum lambda = 1:

    d = x_v - sum_k lambda_k x_k,    psi = k |d|^2 / 2,    k = factor Y h^(dim - 2),

h the mean edge. A new tie has d = 0 and no energy. Its forces have no resultant and no moment, and d rotates with the
body, so that momentum and rigid motions are unaffected. The tangent is constant. When the cell splits, too, the node is
tied again and the stored energy is dissipated.

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
from ..meshes.topology import components
from .extra_couplings import CouplingBuilder
from .term import Term

if TYPE_CHECKING:
    from petsc4py import PETSc
    from scipy.sparse import csr_matrix

    from .block_matrix import TieMatrix

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Pattern = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class TieParameters:
    """Numbers of ties.

    Attributes:
        stiffness_factor: k over the stiffness Y h^(dim - 2) of a mean cell: far above the weight of a node, no
            limit for explicit steps.
        max_weight_sum: sum |lambda| above which a cell is too flat to define the position of a node.
    """

    stiffness_factor: float = 0.1
    max_weight_sum: float = 30.0


PARAMETERS = TieParameters()


@dataclass(frozen=True)
class Ties:
    """Tied nodes, the same on all ranks, never changed.

    Attributes:
        nodes: (n, d + 2) numbers in the input mesh of a node and of the corners of its cell.
        cell: (n,) numbers of the cells.
        weights: (n, d + 2) 1 and -lambda.
    """

    nodes: Ints
    cell: Ints
    weights: Values

    @classmethod
    def empty(cls, dim: int) -> Ties:
        """Ties of no node."""
        return cls(np.empty((0, dim + 2), np.int64), np.empty(0, np.int64), np.empty((0, dim + 2)))

    def select(self, which: npt.NDArray[np.bool_]) -> Ties:
        """Ties that are flagged (n,)."""
        return Ties(self.nodes[which], self.cell[which], self.weights[which])

    def merge(self, other: Ties) -> Ties:
        """Ties of both, in the order of their nodes."""
        arrays = (np.concatenate([getattr(ties, name) for ties in (self, other)]) for name in Ties.__annotations__)
        merged = Ties(*arrays)
        order = np.argsort(merged.nodes[:, 0])
        return Ties(merged.nodes[order], merged.cell[order], merged.weights[order])


class NodeTies(Term):
    """Springs of all ties, as a term of the balance.

    Attributes:
        ties: current ties.    stiffness: k of each, N/m.
    """

    name = "tethers"
    linear = True  # ties change only together with the degradation

    def __init__(self, domain: Domain, u: fem.Function, young: float, mass: Values, prescribed: Flags) -> None:
        """Body without ties.

        Args:
            domain: the mesh.
            u: displacement.
            young: Young's modulus, Pa.
            mass: (owned dofs,) lumped mass, kg.
            prescribed: (nodes,) nodes with prescribed displacement, ghosts too: they are not tied.
        """
        self._domain, self._u, self._mass, self._prescribed = domain, u, mass, prescribed
        self.stiffness = PARAMETERS.stiffness_factor * young * domain.mean_edge_length ** (domain.dim - 2)
        self._pattern: Pattern = np.zeros(domain.cell_count, np.uint8)
        self._coupling, self._around = CouplingBuilder(domain), NodeCellCount(domain)
        self._dissipated = 0.0
        input_of = domain.input_numbering.nodes[: domain.node_count]
        self._order = np.argsort(input_of)
        self._sorted = input_of[self._order]
        self._set_ties(Ties.empty(domain.dim))

    def _set_ties(self, ties: Ties) -> None:
        """Replace the ties (not collective)."""
        self.ties = ties
        self._matrix: PETSc.Mat | None = None
        self._tie_matrix: TieMatrix | None = None
        self._frequency_bound: float | None = None
        # all nodes of ties, and the index of each node of each tie among them
        self._numbers, index = np.unique(ties.nodes, return_inverse=True)
        self._index: Ints = index.reshape(ties.nodes.shape)
        self._own, self._local = self._owned(self._numbers)

    def _owned(self, numbers: Ints) -> tuple[Ints, Ints]:
        """Indices of those input nodes (n,) that this rank owns, and their local numbers."""
        position = np.minimum(np.searchsorted(self._sorted, numbers), max(len(self._sorted) - 1, 0))
        owned = np.flatnonzero(self._sorted[position] == numbers) if len(self._sorted) else np.empty(0, np.int64)
        return owned, self._order[position[owned]]

    # --- selection of nodes and cells ---

    def edges_broke(self, pattern: Pattern) -> None:
        """Tie nodes without an unsplit cell, and again those whose cell split; free nodes with an unsplit cell."""
        self._pattern, domain = pattern.copy(), self._domain
        without = self._around(~is_split(domain.dim)[pattern]) == 0
        local_links, local_nodes = _links(domain, pattern, without, self._prescribed)
        if not sum_over_ranks(domain.comm, len(local_nodes) + len(self.ties.cell))[0]:
            return
        links, nodes = (
            np.unique(np.concatenate(allgather(domain.comm, array)), axis=0) for array in (local_links, local_nodes)
        )
        unchanged = np.isin(self.ties.nodes[:, 0], nodes) & _is_unsplit(domain, pattern, self.ties.cell)
        self._dissipated += self._energy(~unchanged)
        remaining = self.ties.select(unchanged)
        new = nodes[~np.isin(nodes, remaining.nodes[:, 0])]
        self._set_ties(remaining.merge(self._new_ties(new, *_groups(links, nodes), without)))

    def _new_ties(self, new: Ints, linked: Ints, group: Ints, without: Flags) -> Ties:
        """Ties of input nodes (n,), each to the cell at its group's nodes that has the least sum |lambda| (collective).

        Args:
            new: (n,) nodes to be tied.
            linked: (k,) nodes of links.
            group: (k,) connected components of these.
            without: (nodes,) local nodes without an unsplit cell.
        """
        domain, d = self._domain, self._domain.dim
        number = domain.input_numbering.nodes[domain.cell_nodes]
        position = np.minimum(np.searchsorted(linked, number), len(linked) - 1)
        corner_group = np.where((linked[position] == number) & ~without[domain.cell_nodes], group[position], -1)
        cells, corner = np.nonzero((corner_group >= 0) & ~is_split(d)[self._pattern][:, None])
        x = domain.nodes + self._u.x.array.reshape(-1, d)
        local = (
            corner_group[cells, corner],
            domain.input_numbering.cells[cells],
            number[cells],
            x[domain.cell_nodes[cells]],
        )
        gathered = zip(*allgather(domain.comm, local), strict=True)
        groups, cell, corners, corner_x = (np.concatenate(parts) for parts in gathered)
        # pairs of a node and a candidate cell, ordered by node, sum |lambda|, and number of the cell
        row, column = np.nonzero(group[np.searchsorted(linked, new)][:, None] == groups)
        weights = _barycentric(self._gather_positions(new, *self._owned(new))[row], corner_x[column])
        weight_sum = np.where(np.isfinite(weights).all(axis=1), np.abs(weights).sum(axis=1), np.inf)
        order = np.lexsort((cell[column], weight_sum, row))
        _, first = np.unique(row[order], return_index=True)
        best = order[first]
        best = best[weight_sum[best] < PARAMETERS.max_weight_sum]
        nodes = np.concatenate([new[row[best], None], corners[column[best]]], axis=1)
        return Ties(nodes, cell[column[best]], np.concatenate([np.ones((len(best), 1)), -weights[best]], axis=1))

    # --- contributions to the balance ---

    def _gather_positions(self, numbers: Ints, own: Ints, local: Ints) -> Values:
        """(n, d) positions x, m, of nodes of which this rank owns those at the indices `own` (collective)."""
        d = self._domain.dim
        x = np.zeros((len(numbers), d))
        x[own] = self._domain.nodes[local] + self._u.x.array.reshape(-1, d)[local]
        return np.asarray(sum_over_ranks(self._domain.comm, x)) if len(x) else x

    def _elongations(self) -> Values:
        """(n, d) d of each tie, m (collective)."""
        x = self._gather_positions(self._numbers, self._own, self._local)
        return np.asarray(np.einsum("nk,nkd->nd", self.ties.weights, x[self._index]))

    def add_nodal_forces(self, forces: Values) -> None:
        """Add k d on the node and - lambda k d on the corners, N."""
        if not len(self.ties.cell):
            return
        tie_forces = np.zeros((len(self._numbers), self._domain.dim))
        np.add.at(
            tie_forces, self._index, self.stiffness * self.ties.weights[:, :, None] * self._elongations()[:, None]
        )
        np.add.at(forces.reshape(-1, self._domain.dim), self._local, tie_forces[self._own])

    def tie_matrix(self, free: Flags) -> TieMatrix | None:
        """Stiffness k w w^T of all ties, kept while they last."""
        if not len(self.ties.cell):
            return None
        if self._tie_matrix is None:
            from .block_matrix import TieMatrix

            may_move = free.reshape(-1, self._domain.dim)[self._local].astype(float)
            self._tie_matrix = TieMatrix(
                self._domain.comm,
                _stiffness(self.ties, self.stiffness, self._index, len(self._numbers)),
                self._own,
                self._local,
                may_move,
            )
        return self._tie_matrix

    def coupling_matrix(self) -> PETSc.Mat | None:
        """Stiffness k w w^T of all ties, kept while they last (collective)."""
        if not len(self.ties.cell):
            return None
        if self._matrix is None:
            from scipy.sparse import csr_matrix, identity, kron

            n, d = len(self._numbers), self._domain.dim
            K = csr_matrix(kron(_stiffness(self.ties, self.stiffness, self._index, len(self._numbers)), identity(d)))
            first = self._domain.space.dofmap.index_map.local_range[0]
            local_part = np.zeros(n, np.int64)
            local_part[self._own] = first + self._local
            numbers: Ints = sum_over_ranks(self._domain.comm, local_part)
            if self._domain.comm.rank:
                K, numbers = csr_matrix((0, 0)), np.empty(0, np.int64)
            self._matrix = self._coupling(K, numbers)
        return self._matrix

    def _energy(self, flags: Flags | None = None) -> float:
        """Stored energy of all ties or of those flagged (n,), on rank 0, J (collective)."""
        if not len(self.ties.cell):
            return 0.0
        squares = np.einsum("nd,nd->n", *[self._elongations()] * 2)
        energy = self.stiffness / 2 * float(squares.sum() if flags is None else squares[flags].sum())
        return energy if self._domain.comm.rank == 0 else 0.0

    def stored_energy(self) -> float:
        """Sum of k |d|^2 / 2 at the current u, on rank 0, J (collective)."""
        return self._energy()

    def potential(self) -> float:
        """Stored energy, on rank 0, J (collective)."""
        return self._energy()

    def step_work(self) -> tuple[float, float]:
        """No work, and the energy of ties that were replaced, J."""
        dissipated, self._dissipated = self._dissipated, 0.0
        return 0.0, dissipated

    def frequency_bound(self) -> float:
        """Gershgorin's bound of M^-1 K, 1/s^2: largest k / m times the sum over the ties of a node of |w| sum |w|.

        Collective.
        """
        if self._frequency_bound is None:
            mass = np.zeros(len(self._numbers))
            mass[self._own] = self._mass[:: self._domain.dim][self._local]
            w = np.abs(self.ties.weights)
            rows = np.bincount(self._index.reshape(-1), (w * w.sum(axis=1, keepdims=True)).reshape(-1), len(mass))
            masses = sum_over_ranks(self._domain.comm, mass) if len(mass) else mass
            self._frequency_bound = self.stiffness * float(np.max(rows / masses, initial=0.0))
        return self._frequency_bound

    # --- history ---

    def snapshot(self) -> object:
        """Ties, and the patterns of broken edges that they belong to."""
        return self.ties, self._pattern

    def restore(self, snapshot: object) -> None:
        """Restore ties if the same edges are broken; a repeated step may have more broken edges (collective)."""
        ties, pattern = cast("tuple[Ties, Pattern]", snapshot)
        same = ties is self.ties or np.array_equal(pattern, self._pattern)
        if self._domain.comm.allreduce(same, op=MPI.LAND):
            self._dissipated = 0.0
            if ties is not self.ties:
                self._set_ties(ties)

    def to_checkpoint(self) -> dict[str, Values]:
        """Ties by numbers of the input mesh."""
        ties = self.ties
        return {"nodes": ties.nodes.astype(float), "cell": ties.cell.astype(float), "weights": ties.weights}

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Restore the ties of a checkpoint."""
        shape = (-1, self._domain.dim + 2)
        nodes, weights = saved["nodes"].reshape(shape).astype(np.int64), saved["weights"].reshape(shape)
        self._set_ties(Ties(nodes, saved["cell"].astype(np.int64), weights))

    def destroy(self) -> None:
        """Free PETSc's matrix."""
        self._coupling.destroy()


def _is_unsplit(domain: Domain, pattern: Pattern, cells: Ints) -> Flags:
    """(n,) whether cells of the input mesh are unsplit (collective)."""
    unsplit = domain.input_numbering.cells[~is_split(domain.dim)[pattern]] if len(cells) else cells
    return sum_over_ranks(domain.comm, np.isin(cells, unsplit).astype(np.int64)) > 0 if len(cells) else cells > 0


def _links(domain: Domain, pattern: Pattern, without: Flags, prescribed: Flags) -> tuple[Ints, Ints]:
    """(n, 2) ends of intact edges with an end `without` (nodes,) an unsplit cell, and (m,) such ends.

    Edges are those of this rank, nodes those of the input mesh. The (m,) ends are not prescribed.
    """
    pairs = local_edges(domain.dim)
    cells = np.flatnonzero(without[domain.cell_nodes].any(axis=1))
    ends = domain.cell_nodes[cells][:, pairs]  # (n, edges, 2)
    intact = (pattern[cells, None] >> np.arange(len(pairs))) & 1 == 0
    ends = ends[intact & without[ends].any(axis=2)]
    detached = np.unique(ends[without[ends] & ~prescribed[ends]])
    return np.sort(domain.input_numbering.nodes[ends], axis=1), domain.input_numbering.nodes[detached]


def _groups(links: Ints, nodes: Ints) -> tuple[Ints, Ints]:
    """All nodes (k,) of links (m, 2) and of `nodes` (n,), and the connected component (k,) of each."""
    linked, ends = np.unique(np.concatenate([links.reshape(-1), nodes]), return_inverse=True)
    return linked, components(ends[: links.size].reshape(-1, 2), len(linked))[1]


def _stiffness(ties: Ties, k: float, index: Ints, nodes: int) -> csr_matrix:
    """(nodes, nodes) stiffness k w w^T along each axis, N/m; `index`: (n, d + 2) nodes of each tie."""
    from scipy.sparse import csr_matrix

    rows = np.repeat(np.arange(len(ties.cell)), ties.weights.shape[1])
    shape = len(ties.cell), nodes
    W = csr_matrix((ties.weights.reshape(-1), (rows, index.reshape(-1))), shape=shape)
    return csr_matrix(k * (W.T @ W))


def _barycentric(x: Values, corners: Values) -> Values:
    """(n, d + 1) barycentric coordinates of points (n, d) in simplices (n, d + 1, d); infinite in flat ones."""
    span = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    flat = np.abs(np.linalg.det(span)) < 1e-12 * np.abs(span).max(axis=(1, 2), initial=0.0) ** x.shape[1]
    span[flat] = np.eye(x.shape[1])
    last = np.linalg.solve(span, (x - corners[:, 0])[:, :, None])[:, :, 0]
    result = np.concatenate([1 - last.sum(axis=1, keepdims=True), last], axis=1)
    result[flat] = np.inf
    return np.asarray(result)
