"""Nodes that hold Newton's method up are solved for by themselves.

Where a body tears, corners and single cells are set free, turn, and are thrown about. A few nodes hold nearly all of
the residual then, and each iteration solves for the whole body: in one step 22 times, 10 of them for a single
tetrahedron. Where a small share of the nodes holds nearly all of |r|^2 they are solved for first, with everything else
at its place (nonlinear elimination: Lanzkron, Rose and Wilkes 1996; Cai and Keyes 2002), and Newton's method goes on
from there. What it finds is a solution of the same r = 0, by its own test.

The nodes are those that hold HELD of |r|^2 and their neighbours. An iteration moves those of them that hold HELD of
what is left, with their neighbours, by CG with the stiffness of their cells made positive (mechanics.cell_stiffness),
as far as the residual or the potential goes down. Every rank solves the same small system, which is gathered; forces
and stiffness are found where the cells are.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.sparse import bsr_matrix

from ..mechanics.balance import Balance
from ..mechanics.cell_stiffness import CellStiffness
from ..mesh.ranks import total

Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]

HELD = 0.99  # of |r|^2, by nodes that are solved for
FEW = 0.02  # of all nodes, which these may be
ITERATIONS = 10  # with one choice of nodes
ENOUGH = 0.1  # of what is little for a solution, or of what lies outside: |r| of these nodes once they are done
CUTS = 6  # of a move that goes up, each to a third
RTOL, MOST = 0.3, 60  # of CG, whose directions are corrected soon after, and its iterations


class Stragglers:
    """Those of a `Balance` with inertia, linear displacement and a potential.

    Attributes:
        wait: whether Newton's method stopped for some.
    """

    def __init__(self, balance: Balance) -> None:
        """Compiles (collective)."""
        self._balance, domain = balance, balance.domain
        self._stiffness = CellStiffness(balance.stress)
        self.wait, self._just = False, False
        numbers = domain.space.dofmap.index_map
        self._count, self._names = numbers.size_global, numbers.local_to_global(np.arange(len(domain.nodes)))
        self._free = np.ones(balance.owned)
        self._free[balance.motion.owned] = 0.0
        self._nodes: Ints = np.empty(0, np.int64)  # global numbers of those that hold most of r

    # --- which ---

    def begin(self) -> None:
        """An attempt begins."""
        self._just = self.wait = False

    def look(self) -> bool:
        """Whether few nodes hold most of the residual that was found last, since Newton's method has last moved
        (collective)."""
        found = None if self._just else self._heavy(self._residual())
        self.wait, self._just = found is not None, False
        self._nodes = self._nodes if found is None else found
        return self.wait

    def _residual(self) -> Values:
        """(owned dofs,) r, 0 where motion is prescribed, N."""
        return self._balance.reactions * self._free

    def _heavy(self, r: Values, within: Flags | None = None) -> Ints | None:
        """Global numbers of the nodes that hold HELD of |r|^2, those of `within` alone; None: more than FEW do
        (collective)."""
        comm, d = self._balance.domain.comm, self._balance.domain.dim
        squares = np.square(r.reshape(-1, d)).sum(axis=1)
        if within is not None:
            squares *= within[: len(squares)]
        most = int(FEW * self._count) if within is None else self._count
        own = np.flatnonzero(squares)
        if len(own) > most:
            own = own[np.argpartition(-squares[own], most)[: most + 1]]
        of_all = total(comm, np.sum(squares))[0]
        names, parts = map(np.concatenate, zip(*comm.allgather((self._names[own], squares[own])), strict=True))
        order = np.lexsort((names, -parts))
        reached = np.flatnonzero(np.cumsum(parts[order]) >= HELD * of_all)
        if not len(reached) or reached[0] >= most:
            return None
        return np.asarray(names[order[: reached[0] + 1]])

    def _flags(self, nodes: Ints) -> Flags:
        """(nodes,) of this rank, ghosts too, that are among global numbers."""
        flags = np.zeros(self._count, bool)
        flags[nodes] = True
        return np.asarray(flags[self._names])

    def _cells_at(self, flags: Flags, alive: Flags) -> Flags:
        """(owned cells,) that have flagged nodes and are not dead."""
        return np.asarray(flags[self._balance.domain.cell_nodes].any(axis=1) & alive)

    def _neighbours(self, nodes: Ints, alive: Flags) -> Flags:
        """(nodes,) of this rank, ghosts too: those of global numbers, and what shares a cell with them (collective)."""
        domain = self._balance.domain
        touched = np.unique(domain.cell_nodes[self._cells_at(self._flags(nodes), alive)])
        names = domain.comm.allgather(self._names[touched])
        return self._flags(np.concatenate([*names, nodes]))

    # --- solved for ---

    def solve(self, little: float) -> None:
        """Move those that were found, from where the body is, until their |r| is small beside what it is elsewhere, or
        `little`, N (collective)."""
        balance, self.wait, self._just = self._balance, False, True
        dead = balance.stress.stressless
        alive = np.ones(balance.domain.cell_count, bool) if dead is None else ~dead
        chosen = self._neighbours(self._nodes, alive)
        inside = np.repeat(chosen[: balance.domain.node_count], balance.domain.dim)
        r = self._residual()
        enough = ENOUGH * max(little, self._norm(r * ~inside))
        with balance.within(self._cells_at(chosen, alive)):
            for _ in range(ITERATIONS):
                if self._norm(r * inside) <= enough or (nodes := self._heavy(r, chosen)) is None:
                    break
                moving = self._neighbours(nodes, alive) & chosen
                if (r_there := self._move(self._direction(moving, alive, r), r, inside)) is None:
                    break
                r = r_there

    def _norm(self, r: Values) -> float:
        return float(np.sqrt(total(self._balance.domain.comm, r @ r)[0]))

    def _move(self, direction: Values, r: Values, inside: Flags) -> Values | None:
        """Go along a direction as far as |r| inside or the potential goes down; r there, None: nowhere."""
        balance, share = self._balance, 1.0
        start, norm, height = balance.u.x.array[: balance.owned].copy(), self._norm(r * inside), np.nan
        for _ in range(CUTS):
            balance.displace(start + share * direction)
            r_there = balance.forces() * self._free
            if self._norm(r_there * inside) < norm:
                return r_there
            there = balance.potential()[0]
            if np.isnan(height):
                balance.displace(start)
                height = balance.potential()[0]
                balance.displace(start + share * direction)
            if there < height:
                return r_there
            share /= 3
        balance.displace(start)
        return None

    def _direction(self, moving: Flags, alive: Flags, r: Values) -> Values:
        """(owned dofs,) - K^-1 r of the nodes that move, about (collective)."""
        balance, domain = self._balance, self._balance.domain
        d, own = domain.dim, np.flatnonzero(moving[: domain.node_count])
        cells = np.flatnonzero(self._cells_at(moving, alive)).astype(np.int32)
        factor = sum(term.mass_factor for term in balance.terms)
        of_nodes = [each.reshape(-1, d)[own] for each in (factor * balance.mass.lumped, r, self._free)]
        of_cells = self._names[domain.cell_nodes[cells]], self._stiffness(cells)
        gathered = domain.comm.allgather((self._names[own], *of_nodes, *of_cells))
        names, mass, r_all, free, corners, blocks = map(np.concatenate, zip(*gathered, strict=True))
        order = np.argsort(names)
        names, mass, r_all, free = (each[order] for each in (names, mass, r_all, free))
        result = np.zeros((domain.node_count, d))
        moved = _conjugate_gradients(_matrix(corners, blocks, names, mass, free), -r_all * free)
        result[own] = moved[np.searchsorted(names, self._names[own])]
        return result.reshape(-1)


def _matrix(corners: Ints, blocks: Values, names: Ints, mass: Values, free: Values) -> bsr_matrix:
    """K of nodes `names` (n,) from blocks (k, c, c, d, d) of cells with `corners` (k, c) and `mass` (n, d), rows and
    columns of what is not `free` (n, d) being the identity's."""
    at = np.minimum(np.searchsorted(names, corners), len(names) - 1)
    at[names[at] != corners] = -1
    rows, columns = (np.broadcast_to(each, blocks.shape[:3]) for each in (at[:, :, None], at[:, None, :]))
    both = (rows >= 0) & (columns >= 0)
    rows, columns, each = rows[both], columns[both], blocks[both]
    each = each * free[rows][:, :, None] * free[columns][:, None, :]
    n, d = mass.shape
    own = np.einsum("ni,ij->nij", np.where(free > 0, mass, 1.0), np.eye(d))
    rows, columns = np.concatenate([rows, np.arange(n)]), np.concatenate([columns, np.arange(n)])
    keys = rows * n + columns
    order = np.argsort(keys, kind="stable")
    keys = keys[order]
    first = np.flatnonzero(np.diff(keys, prepend=-1))
    data, keys = np.add.reduceat(np.concatenate([each, own])[order], first), keys[first]
    starts = np.searchsorted(keys // n, np.arange(n + 1))
    return bsr_matrix((data, keys % n, starts), shape=(n * d, n * d))


def _conjugate_gradients(K: bsr_matrix, b: Values) -> Values:
    """(n, d) K^-1 b to RTOL, preconditioned with the blocks on the diagonal."""
    n, d = b.shape
    at = np.repeat(np.arange(n), np.diff(K.indptr)) == K.indices
    inverse = np.linalg.inv(K.data[at])
    x, r = np.zeros_like(b), b.copy()
    z = np.einsum("nij,nj->ni", inverse, r)
    p, size = z, float(np.vdot(r, z))
    end = RTOL**2 * size
    for _ in range(MOST):
        if size <= end:
            break
        q = (K @ p.reshape(-1)).reshape(n, d)
        step = size / float(np.vdot(p, q))
        x, r = x + step * p, r - step * q
        z = np.einsum("nij,nj->ni", inverse, r)
        before, size = size, float(np.vdot(r, z))
        p = z + size / before * p
    return x
