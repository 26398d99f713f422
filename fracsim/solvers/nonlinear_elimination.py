"""Nonlinear elimination: the few nodes that hold most of the residual are solved for separately, with all others fixed.

Where a body tears, single cells are almost flat, turn over, or are attached by one node, and Newton's method iterates
on the whole body for their sake. If an iteration has not reduced |r| to a tenth, the nodes that hold nearly all of
|r|^2, with their neighbours, move to a minimum of the incremental potential of these nodes,

    min  sum V (psi(u + w) - psi(u))  +  w (m c_a + k) w / 2  +  (r - f(u)) w  +  E(u + w) - E(u)

with the stiffness k of ties (mechanics.node_ties) and the potential E of contact with analytic obstacles. Connected
nodes make a *patch*; where there is contact all nodes are one. A trust-region method with exact tangents finds the
minima of all patches at once, also through a snap-through; at a minimum the exact tangent of the body is positive, too.
Contact shortens its steps as it shortens Newton's; obstacles stay. With contact of other kinds the nodes stay that
points in contact follow. If others collide, or come into contact, all nodes stay that points of the surface follow, as
they do before obstacles from files. The solution of the step is the same. Every rank does the same computation; only
cells and contact are evaluated by their owners.

Sources: Lanzkron, Rose and Wilkes, SIAM J. Sci. Comput. 17, 1996; Cai and Keyes, 24, 2002; Steihaug, SIAM J. Numer.
Anal. 20, 1983.

Equations: docs/theory.md#newtons-method.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from scipy.sparse import bsr_array, coo_array, csr_array, csr_matrix, sparray
from scipy.sparse.csgraph import connected_components

from ..mechanics.balance import Balance
from ..mechanics.cell_energy import CellEnergy
from ..mechanics.term import overriding
from ..mechanics.term_protocols import (
    ContactPatch,
    EliminatingTerm,
    FollowingSurface,
    MovableSurface,
    PatchContactTerm,
    StepLimiter,
    TieTerm,
    fulfilling,
)
from ..mesh.parallel import allgather, sum_over_ranks
from .policy import DEFAULT_POLICY, SolverPolicy

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


def steihaug_step(
    K: sparray, inverse: Values, g: Values, patch: Ints, radius: Values, policy: SolverPolicy = DEFAULT_POLICY
) -> tuple[Values, Values]:
    """Return trust-region steps of independent problems, min g z + z K z / 2 over |z| <= radius.

    Conjugate gradients stop at the boundary of the region, when they leave it or when the model has no minimum.

    Args:
        K: no entry couples two problems.
        inverse: (n, d, d) blocks for preconditioning.
        g: (n, d) gradient.
        patch: (n,) problem of each node.
        radius: (p,) trust radius of each problem.
        policy: tolerance and iterations.

    Returns:
        Steps z (n, d), and the decrease of the model of each problem (p,).
    """

    def sums(values: Values) -> Values:
        return sum_by_patch(patch, values.sum(axis=1), len(radius))

    z, r = np.zeros_like(g), g.copy()
    y = np.einsum("nij,nj->ni", inverse, r)
    p, size = -y, sums(r * y)
    enough, active = policy.trust_cg_rtol**2 * size, size > 0
    for _ in range(policy.max_trust_cg_iterations):
        if not active.any():
            break
        q = (K @ p.reshape(-1)).reshape(p.shape)
        curvature, square, along = sums(p * q), sums(p * p), sums(z * p)
        boundary = np.sqrt(along**2 + square * np.maximum(radius**2 - sums(z * z), 0.0)) - along
        boundary = np.divide(boundary, square, out=np.zeros_like(square), where=square > 0)
        share = np.divide(size, curvature, out=boundary.copy(), where=active & (curvature > 0))
        leaves = share >= boundary
        share = np.where(active, np.minimum(share, boundary), 0.0)[patch, None]
        z, r = z + share * p, r + share * q
        y = np.einsum("nij,nj->ni", inverse, r)
        before, size = size, sums(r * y)
        active &= ~leaves & (size > enough)
        beta = np.divide(size, before, out=np.zeros_like(size), where=active)
        p = np.where(active[patch, None], beta[patch, None] * p - y, 0.0)
    return z, -0.5 * sums((g + r) * z)


def sum_by_patch(patch: Ints, values: Values, count: int) -> Values:
    """Return the sums (count,) of values (n,) over each `patch` (n,)."""
    return np.asarray(np.bincount(patch, values, count), np.float64)


def create_elimination(balance: Balance, policy: SolverPolicy = DEFAULT_POLICY) -> NonlinearElimination | None:
    """Return the nonlinear elimination of a balance; None if it has no suitable potential (collective).

    All its parts but the stress of each cell have to be constant forces, inertia, ties, and contact.
    """
    contacts = [term for term in balance.terms if isinstance(term, PatchContactTerm | FollowingSurface)]
    stress = balance.stress
    remaining_terms = [term for term in balance.terms if term is not stress and term not in contacts]
    has_ties_alone = all(isinstance(term, TieTerm) for term in overriding(remaining_terms, "coupling_matrix"))
    are_constant = has_ties_alone and not overriding(remaining_terms, "tangent_form", "add_stiffness")
    # forces from a strain that is projected are no derivative of the energy where the rotation changes
    has_cell_energy = balance.domain.order == 1 and (stress.rotation is None or not stress.is_projected)
    has_lumped_inertia = balance.mass.is_diagonal and balance.scheme.inertia
    # terms with unknowns of their own limit these; they stay
    limiters = [term for term in remaining_terms if fulfilling([term], StepLimiter)]
    has_potential = balance.conservative and all(fulfilling([term], EliminatingTerm) for term in limiters)
    is_suitable = has_cell_energy and has_lumped_inertia and are_constant and has_potential
    return NonlinearElimination(balance, policy) if is_suitable else None


class NonlinearElimination:
    """Nonlinear elimination on a balance."""

    def __init__(self, balance: Balance, policy: SolverPolicy) -> None:
        self._balance, self._policy = balance, policy
        self._contacts = fulfilling(balance.terms, PatchContactTerm)
        self._surfaces = fulfilling(balance.terms, FollowingSurface)
        numbers = balance.domain.space.dofmap.index_map
        self._count = numbers.size_global
        self._global_numbers = numbers.local_to_global(np.arange(numbers.size_local + numbers.num_ghosts))
        self._not_prescribed = np.ones(balance.owned_dof_count)
        self._not_prescribed[balance.motion.owned_dofs] = 0.0

    @cached_property
    def _energy(self) -> CellEnergy:
        """Energy of single cells, compiled at first use (collective)."""
        return CellEnergy(self._balance.stress)

    def relax_nodes(self, solved_norm: float) -> bool:
        """Relax the few nodes that hold most of the residual (collective).

        Args:
            solved_norm: |r| of a solution of the body, N.

        Returns:
            Whether any node has moved.
        """
        movable = [surface for surface in self._surfaces if isinstance(surface, MovableSurface)]
        moved = self._relax(solved_norm, movable)
        return bool(self._relax(solved_norm, []) if moved is None else moved)

    def _relax(self, solved_norm: float, movable: Sequence[MovableSurface]) -> bool | None:
        """Relax nodes; whether any has moved, None if that was undone (collective).

        Args:
            solved_norm: |r| of a solution of the body, N.
            movable: surfaces of which nodes in contact stay; of others all nodes stay that points follow. Motions are
                undone where they would collide or come into contact.
        """
        balance, self._free = self._balance, self._not_prescribed.copy()
        free_nodes = self._free.reshape(-1, balance.domain.dim)
        staying = [surface.nodes_in_contact() for surface in movable]
        staying += [surface.followed_nodes() for surface in self._surfaces if surface not in movable]
        for flags in staying:
            free_nodes[flags] = 0.0
        nodes = self._dominant_nodes()
        if not len(nodes):
            return False
        region = self._make_region(nodes)
        if not minimise_patches(region, solved_norm, balance.domain.mean_edge_length, self._policy):
            return False
        u = balance.u.x.array[: balance.owned_dof_count].copy()
        region.displace(np.zeros(region.shape))  # terms are told of a change alone
        if not movable:
            balance.set_displacement(u)
            return True
        start = balance.u.x.array[: balance.owned_dof_count].copy()
        fraction = min(surface.max_step_fraction(u - start) for surface in movable)
        if balance.domain.comm.allreduce(fraction, op=MPI.MIN) < 1:
            return None
        limit = (1 + self._policy.potential_round_off) * self._contact_potential(movable)
        balance.set_displacement(u)
        if self._contact_potential(movable) > limit:
            balance.set_displacement(start)
            return None
        return True

    def _contact_potential(self, surfaces: Sequence[MovableSurface]) -> float:
        """Potential of contact at the current u, J (collective)."""
        return float(sum_over_ranks(self._balance.domain.comm, sum(surface.potential() for surface in surfaces))[0])

    def _dominant_nodes(self) -> Ints:
        """Return the global numbers of the nodes that hold `relaxed_share` of |r|^2 (collective).

        Not more than `max_relaxed_nodes`; none if these hold less than `min_relaxed_share`.
        """
        comm, d = self._balance.domain.comm, self._balance.domain.dim
        squares = np.square((self._balance.reactions * self._free).reshape(-1, d)).sum(axis=1)
        maximum, owned = int(self._policy.max_relaxed_nodes * self._count), np.flatnonzero(squares)
        if len(owned) > maximum:
            owned = owned[np.argpartition(-squares[owned], maximum)[: maximum + 1]]
        total = sum_over_ranks(comm, np.sum(squares))[0]
        by_rank = allgather(comm, (self._global_numbers[owned], squares[owned]))
        numbers, squares = map(np.concatenate, zip(*by_rank, strict=True))
        descending = np.sort(squares)[::-1][:maximum]
        cumulative = np.cumsum(descending)
        if not len(cumulative) or cumulative[-1] < self._policy.min_relaxed_share * total:
            return np.asarray(numbers[:0])
        last = min(int(np.searchsorted(cumulative, self._policy.relaxed_share * total)), len(cumulative) - 1)
        return np.asarray(numbers[squares >= descending[last]])

    def _make_region(self, nodes: Ints) -> PatchRegion:
        """Return the region of nodes of these global numbers and their neighbours (collective)."""
        balance, domain = self._balance, self._balance.domain
        comm, dead = domain.comm, balance.stress.dead_cells
        alive = np.ones(domain.cell_count, bool) if dead is None else ~dead
        touched = np.unique(domain.cell_nodes[self._flag_nodes(nodes)[domain.cell_nodes].any(axis=1) & alive])
        chosen = self._flag_nodes(np.concatenate([*allgather(comm, self._global_numbers[touched]), nodes]))
        cells = np.flatnonzero(chosen[domain.cell_nodes].any(axis=1) & alive).astype(np.int32)
        owned = np.flatnonzero(chosen[: domain.node_count])
        inertia = sum(term.mass_factor for term in balance.terms) * balance.mass.lumped
        rows = (item.reshape(-1, domain.dim)[owned] for item in (inertia, balance.reactions, self._free))
        by_rank = allgather(comm, (self._global_numbers[owned], *rows, self._global_numbers[domain.cell_nodes[cells]]))
        numbers, inertia, r, free, corners = map(np.concatenate, zip(*by_rank, strict=True))
        order = np.argsort(numbers)
        numbers, local = numbers[order], np.flatnonzero(chosen)
        of_local, positions = np.searchsorted(numbers, self._global_numbers[local]), _positions_in(corners, numbers)
        forces = inertia[order], r[order], free[order], self._ties(numbers)
        contacts = [contact.patch(numbers) for contact in self._contacts]
        return PatchRegion(
            balance, self._energy, cells, local, of_local, positions, *forces, contacts, policy=self._policy
        )

    def _ties(self, region: Ints) -> coo_array:
        """Return the stiffness (n, n) of ties between nodes, N/m, the same along each axis (collective).

        `region`: global numbers of the nodes, increasing.
        """
        balance, n = self._balance, len(region)
        K = coo_array((n, n)).tocsr()
        for tied in filter(
            None, (term.tie_matrix(balance.motion.free_dofs) for term in balance.terms if isinstance(term, TieTerm))
        ):
            numbers = np.zeros(tied.K.shape[0], np.int64)
            numbers[tied.indices] = self._global_numbers[tied.nodes]
            position, ties = _positions_in(sum_over_ranks(balance.domain.comm, numbers), region), tied.K.tocoo()
            inside = (position[ties.row] >= 0) & (position[ties.col] >= 0)
            entries = position[ties.row][inside], position[ties.col][inside]
            K = K + coo_array((ties.data[inside], entries), shape=(n, n)).tocsr()
        return K.tocoo()

    def _flag_nodes(self, nodes: Ints) -> Flags:
        """Return flags (nodes,) of the nodes of this rank, with ghosts, that are among global numbers."""
        flags = np.zeros(self._count, bool)
        flags[nodes] = True
        return np.asarray(flags[self._global_numbers])


def _positions_in(numbers: Ints, increasing: Ints) -> Ints:
    """Return the positions of numbers in an increasing array, -1 for others."""
    position = np.minimum(np.searchsorted(increasing, numbers), len(increasing) - 1)
    return np.asarray(np.where(increasing[position] == numbers, position, -1))


class PatchRegion:
    """Nodes that move, and the patches that they form.

    Attributes:
        patch_of_node: (n,) patch of each node.
        patch_of_cell: (cells of all ranks,) patch of each cell.
        count: number of patches.
        initial: patches at w = 0.
    """

    def __init__(
        self, balance: Balance, energy: CellEnergy, cells: npt.NDArray[np.int32], local: Ints, of_local: Ints,
        corners: Ints, inertia: Values, r: Values, free: Values, ties: coo_array, contacts: Sequence[ContactPatch], *,
        policy: SolverPolicy,
    ) -> None:  # fmt: skip
        """Gather the region from all ranks (collective).

        Args:
            balance: gives the displacement.
            energy: energy of single cells.
            cells: owned cells of this rank.
            local: nodes of this rank.
            of_local: positions of these among all nodes of the region.
            corners: (cells of all ranks, corners) positions of the corners, -1 for nodes that stay.
            inertia: (n, d) m c_a, N/m.
            r: (n, d) residual, N.
            free: (n, d) 0 where the displacement is prescribed, else 1.
            ties: (n, n) stiffness of ties, N/m.
            contacts: contact of the nodes.
            policy: eigenvalues of blocks.
        """
        n, d = self.shape = r.shape
        self._policy = policy
        self._comm, self._energy, self._u = balance.domain.comm, energy, balance.u.x.array.reshape(-1, d)
        self._cells, self._local, self._of_local, self._corners = cells, local, of_local, corners
        self._start, self._inertia, self._free = self._u[local].copy(), inertia, free
        rows, columns = np.repeat(corners, corners.shape[1], axis=1).ravel(), np.tile(corners, corners.shape[1]).ravel()
        self._is_inside = (rows >= 0) & (columns >= 0)
        self._rows, self._columns = rows[self._is_inside], columns[self._is_inside]
        self._ties, self._contacts = ties, contacts
        joined = np.concatenate([self._rows, ties.row]), np.concatenate([self._columns, ties.col])
        links = coo_array((np.ones(len(joined[0])), joined), shape=(n, n))
        self.count, self.patch_of_node = connected_components(links, directed=False)
        if contacts:
            self.count, self.patch_of_node = 1, np.zeros(n, np.int64)
        self.patch_of_cell = self.patch_of_node[corners.max(axis=1)]
        self._constant: Values = np.zeros((n, d))
        start = self.evaluate(np.zeros((n, d)))
        self._constant = r - start.forces
        self.initial = start._replace(forces=r * free)

    def displace(self, w: Values) -> None:
        """Move the nodes of this rank, with ghosts, by w (n, d), m, from their start."""
        self._u[self._local] = self._start + w[self._of_local]

    def evaluate(self, w: Values) -> PatchValues:
        """Evaluate the patches at w (n, d), m (collective)."""
        self.displace(w)
        result = allgather(self._comm, self._energy(self._cells))
        energy, forces, stiffness = map(np.concatenate, zip(*result, strict=True))
        linear, inside = self._inertia * w + self._ties @ w, self._corners >= 0
        work = ((linear / 2 + self._constant) * w).sum(axis=1)
        sums = linear + self._constant
        np.add.at(sums, self._corners[inside], forces[inside])
        parts = [
            sum_by_patch(self.patch_of_cell, energy, self.count),
            sum_by_patch(self.patch_of_node, work, self.count),
        ]
        coupling = None
        for contact in self._contacts:
            value = contact.evaluate(w)
            parts.append(np.array([value.potential]))
            sums += value.forces
            coupling = value.stiffness if coupling is None else coupling + value.stiffness
        size = sum(abs(part) for part in parts)
        return PatchValues(np.sum(parts, axis=0), np.asarray(size), sums * self._free, stiffness, coupling)

    def free_fraction(self, w: Values, step: Values) -> float:
        """Return the fraction in [0, 1] of a step (n, d) from w (n, d), m, that contact leaves free."""
        return min((contact.free_fraction(w, step) for contact in self._contacts), default=1.0)

    @cached_property
    def _pattern(self) -> BlockPattern:
        """Sparsity pattern of the tangent."""
        n = len(self._inertia)
        nodes = np.arange(n)
        rows = np.concatenate([self._rows, self._ties.row, nodes])
        columns = np.concatenate([self._columns, self._ties.col, nodes])
        free = self._free[rows, :, None] * self._free[columns, None, :]
        order = np.argsort(rows * n + columns, kind="stable")
        keys = (rows * n + columns)[order]
        first = np.flatnonzero(np.diff(keys, prepend=-1))
        rows, columns = np.divmod(keys[first], n)
        return BlockPattern(order, first, free, columns, np.searchsorted(rows, np.arange(n + 1)), rows == columns)

    @cached_property
    def _inertia_and_ties(self) -> Values:
        """Blocks of the ties and of the inertia, in the order of the pattern."""
        identity = np.eye(self._inertia.shape[1])
        return np.concatenate([self._ties.data[:, None, None] * identity, self._inertia[:, :, None] * identity])

    def tangent(self, values: PatchValues) -> tuple[sparray, Values]:
        """Return K of the nodes, and the inverses of its diagonal blocks, made positive."""
        n, d = self._inertia.shape
        stiffness, diagonal = values.stiffness, np.zeros((n, d, d))
        pattern = self._pattern
        blocks = np.concatenate([stiffness.reshape(-1, d, d)[self._is_inside], self._inertia_and_ties]) * pattern.free
        data = np.add.reduceat(blocks[pattern.order], pattern.first)
        K: sparray = bsr_array((data, pattern.columns, pattern.starts), shape=(n * d, n * d))
        if values.coupling is not None:
            entries, free_dofs = values.coupling.tocoo(), self._free.reshape(-1)
            data_of_free = entries.data * free_dofs[entries.row] * free_dofs[entries.col]
            same = entries.row // d == entries.col // d
            block_entries = entries.row[same] // d, entries.row[same] % d, entries.col[same] % d
            np.add.at(diagonal, block_entries, data_of_free[same])
            K = K.tocsr() + csr_array((data_of_free, (entries.row, entries.col)), shape=K.shape)
        eigenvalues, vectors = np.linalg.eigh(data[pattern.diagonal] + diagonal)
        largest = abs(eigenvalues).max(axis=1, keepdims=True)
        lowest = np.where(largest > 0, self._policy.min_block_eigenvalue * largest, 1.0)
        inverse = (vectors / np.maximum(abs(eigenvalues), lowest)[:, None, :]) @ vectors.transpose(0, 2, 1)
        return K, inverse

    def norms(self, forces: Values) -> Values:
        """Return |r| (count,) of each patch, N."""
        return np.asarray(np.sqrt(sum_by_patch(self.patch_of_node, np.square(forces).sum(axis=1), self.count)))


class BlockPattern(NamedTuple):
    """Sparsity pattern of a sum of blocks.

    Attributes:
        order: order of the blocks by position in the matrix.
        first: (nonzeros,) first block of each position in that order.
        free: factors of the blocks, 0 where the displacement is prescribed.
        columns: (nonzeros,) columns of the matrix.
        starts: (n + 1,) starts of its rows.
        diagonal: (nonzeros,) flags of diagonal positions.
    """

    order: Ints
    first: Ints
    free: Values
    columns: Ints
    starts: Ints
    diagonal: Flags


class PatchValues(NamedTuple):
    """Patches at some displacement w.

    Attributes:
        potential: (count,) J.
        size: (count,) sum of the absolute values of its summands, J.
        forces: (n, d) its gradient, N.
        stiffness: blocks of all cells, N/m.
        coupling: (n d, n d) stiffness of contact, N/m, of a single patch; None: there is none.
    """

    potential: Values
    size: Values
    forces: Values
    stiffness: Values
    coupling: csr_matrix | None = None

    def where(self, chosen: Flags, other: PatchValues, region: PatchRegion) -> PatchValues:
        """Return these values for the `chosen` patches, those of `other` for the rest."""
        if region.count == 1:
            return self if chosen.all() else other
        of_nodes, of_cells = chosen[region.patch_of_node, None], chosen[region.patch_of_cell, None, None, None, None]
        flags = chosen, chosen, of_nodes, of_cells
        return PatchValues(*(np.where(*item) for item in zip(flags, self[:4], other[:4], strict=True)))


def minimise_patches(region: PatchRegion, solved_norm: float, edge: float, policy: SolverPolicy) -> bool:
    """Move each patch to a minimum of its potential, or as far as it gets (collective).

    Returns:
        Whether any node has moved.
    """
    w = np.zeros(region.shape)
    current = region.initial
    enough = np.maximum(policy.patch_rtol * region.norms(current.forces), policy.patch_residual * solved_norm)
    radius = np.full(region.count, policy.first_trust_radius * edge)
    for _ in range(policy.max_trust_steps):
        norms = region.norms(current.forces)
        active = (norms > enough) & (radius > policy.last_trust_radius * edge)
        if not active.any():
            break
        gradient = np.where(active[region.patch_of_node, None], current.forces, 0.0)
        tangent, inverse = region.tangent(current)
        step, predicted = steihaug_step(tangent, inverse, gradient, region.patch_of_node, radius, policy)
        if (fraction := region.free_fraction(w, step)) < 1:
            # along the step the model is linear and quadratic: -predicted = slope + curvature
            slope = sum_by_patch(region.patch_of_node, (gradient * step).sum(axis=1), region.count)
            predicted = -fraction * slope + fraction**2 * (predicted + slope)
            step = fraction * step
            if not step.any():
                break
        trial = region.evaluate(w + step)
        decrease, slack = current.potential - trial.potential, policy.potential_round_off * current.size
        ratio = np.divide(decrease, predicted, out=np.zeros_like(decrease), where=predicted > 0)
        accepted = active & (
            (ratio > policy.min_decrease_ratio) | ((abs(decrease) <= slack) & (region.norms(trial.forces) < norms))
        )
        length = region.norms(step)
        # The radius grows only if the step has used it up.
        grows = accepted & (ratio > policy.growth_decrease_ratio) & (length > 0.9 * radius)
        radius = np.where(grows, 2 * radius, np.where(accepted | ~active, radius, length / 4))
        w = np.where(accepted[region.patch_of_node, None], w + step, w)
        current = trial.where(accepted, current, region)
    region.displace(w)
    return bool(w.any())
