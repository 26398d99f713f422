"""Few nodes that hold Newton's method up are brought to rest by themselves, with everything else at its place.

Where a body tears, single cells are all but flat, turn over, or hang by a node. A few nodes hold nearly all of the
residual then, and Newton's method solves for the whole body, again and again, for their sake: 29 times in one step,
4 times with patches. So where an iteration has not cut |r| to a tenth, nodes that hold nearly all of |r|^2, and their
neighbours, go down to a minimum of the incremental potential in which only they move,

    min  sum V (psi(u + w) - psi(u))  +  w (m c_a + k) w / 2  +  (r - f(u)) w,    k: of ties (mechanics.node_ties)

(nonlinear elimination: Lanzkron, Rose and Wilkes, SIAM J. Sci. Comput. 17, 1996; Cai and Keyes, 24, 2002). What bends
there is exact, by trust regions with exact tangents (nonlinear_elimination): a patch snaps through at once, and at its
minimum the body's exact tangent is positive, too. The step ends where r = 0 as it would.

Patches are what is left of the mesh's graph there. Every rank goes through the same motions; what cells say is found
where they are.

Equations: docs/theory.md#newtons-method.

A step of a trust region, of several problems at once: conjugate gradients that go to the border of where the model
is trusted once they leave it, or once it has no minimum in there (Steihaug, SIAM J. Numer. Anal. 20, 1983).

    min  g z + z K z / 2   over   |z| <= radius
"""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.sparse import bsr_array, coo_array, sparray
from scipy.sparse.csgraph import connected_components

from ..mechanics.balance import Balance
from ..mechanics.cell_energy import CellEnergy
from ..mechanics.tangent import adds_single_entries
from ..mechanics.term import Term
from ..mechanics.term_protocols import TieTerm
from ..mesh.parallel import allgather, sum_over_ranks
from .policy import DEFAULT_POLICY, SolverPolicy

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


def steihaug_step(
    K: sparray, inverse: Values, g: Values, of: Ints, radius: Values, policy: SolverPolicy = DEFAULT_POLICY
) -> tuple[Values, Values]:
    """Steps z (n, d) of problems that share no entry of K, and by how much each lowers its model (p,).

    `inverse`: (n, d, d) blocks to precondition with; `g`: (n, d); `of`: (n,) the problem of each node; `radius`: (p,).
    """

    def sums(values: Values) -> Values:
        return sum_by_patch(of, values.sum(axis=1), len(radius))

    z, r = np.zeros_like(g), g.copy()
    y = np.einsum("nij,nj->ni", inverse, r)
    p, size = -y, sums(r * y)
    enough, active = policy.trust_cg_rtol**2 * size, size > 0
    for _ in range(policy.max_trust_cg_iterations):
        if not active.any():
            break
        q = (K @ p.reshape(-1)).reshape(p.shape)
        curved, long, along = sums(p * q), sums(p * p), sums(z * p)
        border = np.sqrt(along**2 + long * np.maximum(radius**2 - sums(z * z), 0.0)) - along
        border = np.divide(border, long, out=np.zeros_like(long), where=long > 0)
        share = np.divide(size, curved, out=border.copy(), where=active & (curved > 0))
        out = share >= border
        share = np.where(active, np.minimum(share, border), 0.0)[of, None]
        z, r = z + share * p, r + share * q
        y = np.einsum("nij,nj->ni", inverse, r)
        before, size = size, sums(r * y)
        active &= ~out & (size > enough)
        turned = np.divide(size, before, out=np.zeros_like(size), where=active)
        p = np.where(active[of, None], turned[of, None] * p - y, 0.0)
    return z, -0.5 * sums((g + r) * z)


def sum_by_patch(of: Ints, values: Values, count: int) -> Values:
    """(count,) sums of values (n,), each `of` (n,) a problem."""
    return np.asarray(np.bincount(of, values, count), np.float64)


def create_elimination(balance: Balance, policy: SolverPolicy = DEFAULT_POLICY) -> NonlinearElimination | None:
    """Those of a balance that has what they come to rest by: a potential, of which all parts but the stress of each
    cell are constant forces, inertia and ties; None: it has not (collective)."""
    remaining = [term for term in balance.terms if term is not balance.stress]
    bent = any(type(term).tangent_form is not Term.tangent_form or adds_single_entries(term) for term in remaining)
    whole = balance.domain.order == 1 and balance.stress.rotation is None
    lumped = balance.mass.is_diagonal and balance.scheme.inertia
    fit = whole and lumped and not bent and not balance.contact.limits_newton_steps and balance.conservative
    return NonlinearElimination(balance, policy) if fit else None


class NonlinearElimination:
    """Those of a balance."""

    def __init__(self, balance: Balance, policy: SolverPolicy) -> None:
        self._balance, self._policy = balance, policy
        numbers = balance.domain.space.dofmap.index_map
        self._count = numbers.size_global
        self._names = numbers.local_to_global(np.arange(numbers.size_local + numbers.num_ghosts))
        self._free = np.ones(balance.owned_dof_count)
        self._free[balance.motion.owned_dofs] = 0.0

    @cached_property
    def _energy(self) -> CellEnergy:
        """Compiled where it is first asked for (collective)."""
        return CellEnergy(self._balance.stress)

    def relax_nodes(self, little: float) -> bool:
        """Bring the few nodes that hold most of the residual to rest, down to `little`, N, as it counts for the whole
        body; whether any moved (collective)."""
        nodes = self._heavy()
        if not len(nodes):
            return False
        region = self._around(nodes)
        moved = _settle(region, little, self._balance.domain.mean_edge_length, self._policy)
        u = self._balance.u.x.array[: self._balance.owned_dof_count].copy()
        self._balance.set_displacement(u)
        return moved

    def _heavy(self) -> Ints:
        """Global numbers of the nodes that hold HELD of |r|^2, or of the FEW that hold most of it; none where these do
        not hold LEAST_HELD (collective)."""
        comm, d = self._balance.domain.comm, self._balance.domain.dim
        squares = np.square((self._balance.reactions * self._free).reshape(-1, d)).sum(axis=1)
        maximum, owned = int(self._policy.max_relaxed_nodes * self._count), np.flatnonzero(squares)
        if len(owned) > maximum:
            owned = owned[np.argpartition(-squares[owned], maximum)[: maximum + 1]]
        of_all = sum_over_ranks(comm, np.sum(squares))[0]
        names, parts = map(np.concatenate, zip(*allgather(comm, (self._names[owned], squares[owned])), strict=True))
        falling = np.sort(parts)[::-1][:maximum]
        cumulative = np.cumsum(falling)
        if not len(cumulative) or cumulative[-1] < self._policy.min_relaxed_share * of_all:
            return np.asarray(names[:0])
        last = min(int(np.searchsorted(cumulative, self._policy.relaxed_share * of_all)), len(cumulative) - 1)
        return np.asarray(names[parts >= falling[last]])

    def _around(self, nodes: Ints) -> _Region:
        """Those of global numbers and their neighbours, with all cells of these (collective)."""
        balance, domain = self._balance, self._balance.domain
        comm, dead = domain.comm, balance.stress.dead_cells
        alive = np.ones(domain.cell_count, bool) if dead is None else ~dead
        touched = np.unique(domain.cell_nodes[self._flags(nodes)[domain.cell_nodes].any(axis=1) & alive])
        chosen = self._flags(np.concatenate([*allgather(comm, self._names[touched]), nodes]))
        cells = np.flatnonzero(chosen[domain.cell_nodes].any(axis=1) & alive).astype(np.int32)
        owned = np.flatnonzero(chosen[: domain.node_count])
        inertia = sum(term.mass_factor for term in balance.terms) * balance.mass.lumped
        rows = (item.reshape(-1, domain.dim)[owned] for item in (inertia, balance.reactions, self._free))
        original = allgather(comm, (self._names[owned], *rows, self._names[domain.cell_nodes[cells]]))
        names, inertia, r, free, corners = map(np.concatenate, zip(*original, strict=True))
        order = np.argsort(names)
        names, local = names[order], np.flatnonzero(chosen)
        of_here, position = np.searchsorted(names, self._names[local]), _places(corners, names)
        forces = inertia[order], r[order], free[order], self._ties(names)
        return _Region(balance, self._energy, cells, local, of_here, position, *forces, policy=self._policy)

    def _ties(self, names: Ints) -> coo_array:
        """(n, n) K of what ties nodes of global numbers, rising, the same along each axis, N/m (collective)."""
        balance, n = self._balance, len(names)
        K = coo_array((n, n)).tocsr()
        for tied in filter(
            None, (term.tie_matrix(balance.motion.free_dofs) for term in balance.terms if isinstance(term, TieTerm))
        ):
            numbers = np.zeros(tied.K.shape[0], np.int64)
            numbers[tied.indices] = self._names[tied.nodes]
            position, ties = _places(sum_over_ranks(balance.domain.comm, numbers), names), tied.K.tocoo()
            inside = (position[ties.row] >= 0) & (position[ties.col] >= 0)
            K = (
                K
                + coo_array(
                    (ties.data[inside], (position[ties.row][inside], position[ties.col][inside])), shape=(n, n)
                ).tocsr()
            )
        return K.tocoo()

    def _flags(self, nodes: Ints) -> Flags:
        """(nodes,) of this rank, ghosts too, that are among global numbers."""
        flags = np.zeros(self._count, bool)
        flags[nodes] = True
        return np.asarray(flags[self._names])


def _places(numbers: Ints, names: Ints) -> Ints:
    """Where numbers are among names, which rise; -1: they are not."""
    position = np.minimum(np.searchsorted(names, numbers), len(names) - 1)
    return np.asarray(np.where(names[position] == numbers, position, -1))


class _Region:
    """Nodes that move, by themselves, and the patches that they make.

    Attributes:
        of, of_cell: the patch of each node and of each cell.    count: of patches.
        at_first: they where nothing has moved.
    """

    def __init__(
        self, balance: Balance, energy: CellEnergy, cells: npt.NDArray[np.int32], here: Ints, of_here: Ints, at: Ints,
        inertia: Values, r: Values, free: Values, ties: coo_array, *, policy: SolverPolicy,
    ) -> None:  # fmt: skip
        """`cells`: owned cells of this rank; `here`: its nodes, of which `of_here` tells the place among all; and of
        all ranks `at`: (k, c) such places of the corners of cells, -1 of those that stay, `inertia`: (n, d) m c_a, N/m,
        `r`: (n, d) the residual, N, `free`: (n, d) 0 where motion is prescribed, and `ties`: (n, n) K of what ties
        nodes, N/m."""
        n, d = self.shape = r.shape
        self._policy = policy
        self._comm, self._energy, self._u = balance.domain.comm, energy, balance.u.x.array.reshape(-1, d)
        self._cells, self._here, self._of_here, self._at = cells, here, of_here, at
        self._start, self._inertia, self._free = self._u[here].copy(), inertia, free
        rows, columns = np.repeat(at, at.shape[1], axis=1).ravel(), np.tile(at, at.shape[1]).ravel()
        self._both = (rows >= 0) & (columns >= 0)
        self._rows, self._columns = rows[self._both], columns[self._both]
        self._ties = ties
        joined = np.concatenate([self._rows, ties.row]), np.concatenate([self._columns, ties.col])
        links = coo_array((np.ones(len(joined[0])), joined), shape=(n, n))
        self.count, self.of = connected_components(links, directed=False)
        self.of_cell = self.of[at.max(axis=1)]
        self._constant: Values = np.zeros((n, d))
        result = self.look(np.zeros((n, d)))
        self._constant = r - result.forces
        self.at_first = result._replace(forces=r * free)

    def put(self, w: Values) -> None:
        """Nodes of this rank, ghosts too, are w (n, d) from where they began (not collective)."""
        self._u[self._here] = self._start + w[self._of_here]

    def look(self, w: Values) -> _Look:
        """The patches there (collective)."""
        self.put(w)
        result = allgather(self._comm, self._energy(self._cells))
        energy, forces, stiffness = map(np.concatenate, zip(*result, strict=True))
        linear, inside = self._inertia * w + self._ties @ w, self._at >= 0
        work = ((linear / 2 + self._constant) * w).sum(axis=1)
        sums = linear + self._constant
        np.add.at(sums, self._at[inside], forces[inside])
        parts = sum_by_patch(self.of_cell, energy, self.count), sum_by_patch(self.of, work, self.count)
        return _Look(parts[0] + parts[1], abs(parts[0]) + abs(parts[1]), sums * self._free, stiffness)

    @cached_property
    def _pattern(self) -> _Pattern:
        n = len(self._inertia)
        nodes = np.arange(n)
        rows = np.concatenate([self._rows, self._ties.row, nodes])
        columns = np.concatenate([self._columns, self._ties.col, nodes])
        free = self._free[rows, :, None] * self._free[columns, None, :]
        order = np.argsort(rows * n + columns, kind="stable")
        keys = (rows * n + columns)[order]
        first = np.flatnonzero(np.diff(keys, prepend=-1))
        rows, columns = np.divmod(keys[first], n)
        return _Pattern(order, first, free, columns, np.searchsorted(rows, np.arange(n + 1)), rows == columns)

    @cached_property
    def _inertia_and_ties(self) -> Values:
        """Blocks (of entries of the pattern that are not of cells)."""
        identity = np.eye(self._inertia.shape[1])
        return np.concatenate([self._ties.data[:, None, None] * identity, self._inertia[:, :, None] * identity])

    def tangent(self, stiffness: Values) -> tuple[bsr_array, Values]:
        """K of the nodes, and the inverses of its blocks on the diagonal, made positive."""
        n, d = self._inertia.shape
        result = self._pattern
        blocks = np.concatenate([stiffness.reshape(-1, d, d)[self._both], self._inertia_and_ties]) * result.free
        data = np.add.reduceat(blocks[result.order], result.first)
        values, vectors = np.linalg.eigh(data[result.diagonal])
        largest = abs(values).max(axis=1, keepdims=True)
        values = np.maximum(abs(values), np.where(largest > 0, self._policy.min_block_eigenvalue * largest, 1.0))
        inverse = (vectors / values[:, None, :]) @ vectors.transpose(0, 2, 1)
        return bsr_array((data, result.columns, result.starts), shape=(n * d, n * d)), inverse

    def norms(self, forces: Values) -> Values:
        """(count,) |r| of each patch, N."""
        return np.asarray(np.sqrt(sum_by_patch(self.of, np.square(forces).sum(axis=1), self.count)))


class _Pattern(NamedTuple):
    """Where blocks that are summed go.

    Attributes:
        order: of blocks, by where they go.    first: (nonzeros,) of each place, in that order.
        free: what blocks are multiplied with: 0 where motion is prescribed.    columns, starts: of the matrix.
        diagonal: (nonzeros,) places on it.
    """

    order: Ints
    first: Ints
    free: Values
    columns: Ints
    starts: Ints
    diagonal: Flags


class _Look(NamedTuple):
    """What patches are like at some w.

    Attributes:
        potential: (count,) J.    size: (count,) of what that is the sum of, J.    forces: (n, d) its derivative, N.
        stiffness: blocks of all cells, N/m.
    """

    potential: Values
    size: Values
    forces: Values
    stiffness: Values

    def where(self, taken: Flags, other: _Look, region: _Region) -> _Look:
        """Of those patches, and the other's of all else."""
        choices = taken, taken, taken[region.of, None], taken[region.of_cell, None, None, None, None]
        return _Look(*(np.where(*item) for item in zip(choices, self, other, strict=True)))


def _settle(region: _Region, little: float, edge: float, policy: SolverPolicy) -> bool:
    """Each patch goes down to a minimum, or as far as it gets; whether any moved (collective)."""
    w = np.zeros(region.shape)
    current = region.at_first
    enough = np.maximum(policy.patch_rtol * region.norms(current.forces), policy.patch_residual * little)
    radius = np.full(region.count, policy.first_trust_radius * edge)
    for _ in range(policy.max_trust_steps):
        norms = region.norms(current.forces)
        active = (norms > enough) & (radius > policy.last_trust_radius * edge)
        if not active.any():
            break
        pulled = np.where(active[region.of, None], current.forces, 0.0)
        step, promised = steihaug_step(*region.tangent(current.stiffness), pulled, region.of, radius, policy)
        trial = region.look(w + step)
        fell, slack = current.potential - trial.potential, policy.potential_round_off * current.size
        gain = np.divide(fell, promised, out=np.zeros_like(fell), where=promised > 0)
        accepted = active & (
            (gain > policy.poor_decrease) | ((abs(fell) <= slack) & (region.norms(trial.forces) < norms))
        )
        long = region.norms(step)
        longer = accepted & (gain > policy.good_decrease) & (long > 0.9 * radius)
        radius = np.where(longer, 2 * radius, np.where(accepted | ~active, radius, long / 4))
        w = np.where(accepted[region.of, None], w + step, w)
        current = trial.where(accepted, current, region)
    region.put(w)
    return bool(w.any())
