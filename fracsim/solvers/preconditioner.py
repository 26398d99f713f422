"""Preconditioner of the tangent: its kind, and the decision when it is set up again.

Facts are told to a `Preconditioner` (`edges_broke`, `pattern_changed`, `solved`, `solve_failed`, `bypassed`). Its
method `_decide` alone decides whether it is reused, refreshed (new operators and smoothers on the same coarse spaces)
or rebuilt.

Equations: docs/theory.md#linear-systems.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from enum import IntEnum
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from petsc4py import PETSc

from ..mechanics.balance import Balance
from ..mesh.parallel import sum_over_ranks
from .petsc_options import PetscOptions, PetscOptionSet, stored_products
from .policy import SolverPolicy

if TYPE_CHECKING:
    from .multigrid.levels import FineLevel
    from .multigrid.vcycle import SinglePrecisionVCycle
    from .tangent_operators import TangentOperators

Values = npt.NDArray[np.float64]

GAMG_OPTIONS: PetscOptions = {
    "pc_type": "gamg",
    "pc_gamg_reuse_interpolation": True,
    "mg_levels_ksp_type": "chebyshev",
    "mg_levels_ksp_max_it": 2,
    "mg_levels_pc_type": "jacobi",
}
MULTIGRID_TYPES = ("gamg", "mg", "ml")
SSOR_OPTIONS: PetscOptions = {"pc_type": "sor"}
MULTIGRID_OPTIONS: PetscOptions = {"pc_type": "gamg"}
STRONG_LINKS: PetscOptions = {"pc_gamg_threshold": 0.05, "pc_gamg_aggressive_square_graph": False}
# On several ranks PETSc (3.22) coarsens the square of a graph of strong links: without, MISk does not end.
STRONG_LINKS_ON_RANKS: PetscOptions = STRONG_LINKS | {"pc_gamg_aggressive_square_graph": True}
ALL_LINKS: PetscOptions = {"pc_gamg_threshold": 0.0, "pc_gamg_aggressive_square_graph": True}


def rigid_body_nullspace(comm: MPI.Comm, positions: Values) -> PETSc.NullSpace:
    """Translations and linearised rotations, orthonormal: 3 vectors in the plane, 6 in space (collective).

    `positions`: (n, d) of this rank's nodes relative to the centre of the rotations, m.
    """
    coordinates = PETSc.Vec().createWithArray(positions.reshape(-1), bsize=positions.shape[1], comm=comm)
    return PETSc.NullSpace().createRigidBody(coordinates)


def renew_smoothers(pc: PETSc.PC) -> None:
    """Make the smoothers of multigrid follow the tangent, though coarse spaces and coarse operators are kept.

    PETSc 3.25 makes smoothers keep their set-up where that of multigrid is kept, 3.22 does not. Diagonals of an older
    tangent are too small where contact has become stiff, and the preconditioner is then indefinite.
    """
    if pc.getType() in MULTIGRID_TYPES:
        for level in range(pc.getMGLevels()):
            pc.getMGSmoother(level).getPC().setReusePreconditioner(False)


def renew_smoothers_before_solve(ksp: PETSc.KSP, *_: object) -> None:
    """Renew the smoothers of the preconditioner of a KSP; a callback of `KSP.setPreSolve`."""
    renew_smoothers(ksp.getPC())


def mass_stiffness_ratio(balance: Balance) -> float:
    """Inertia of a cell over its stiffness in the present step, c_a rho h^2 / Y (collective).

    c_a = da/du of the scheme, 1 / dt^2 in backward Euler; h is the mean edge.
    """
    domain, material = balance.domain, balance.stress.material
    sums = [np.sum(field * domain.volumes) for field in (material.young, material.density)]
    stiffness, mass = sum_over_ranks(domain.comm, np.array(sums))
    return float(balance.c_a * mass * domain.mean_edge_length**2 / stiffness)


class Update(IntEnum):
    """What is done to the preconditioner before a solve."""

    NONE = 0
    REFRESH = 1  # new operators on the same coarse spaces
    REBUILD = 2  # coarse spaces too


class AppliedPreconditioner:
    """PETSc's preconditioner of a KSP, and what is applied in its place.

    Attributes:
        pc: PETSc's preconditioner of the whole body.
        vcycle: V cycle in single precision, copied from `pc`; None: PETSc's own is applied.
        keeps_coarse_spaces: whether `pc` is still set up, so that a refresh is possible.
        changed_nodes: (n,) owned nodes around those whose stiffness has changed since the set-up, to be solved for
            exactly; None: there are none, or too many.
    """

    changed_nodes: npt.NDArray[np.int64] | None = None

    def __init__(
        self, ksp: PETSc.KSP, options: PetscOptionSet, balance: Balance, policy: SolverPolicy, *, is_default: bool
    ) -> None:
        """`is_default`: whether the study chooses no preconditioner."""
        self._ksp, self._options, self._balance, self._policy = ksp, options, balance, policy
        self._is_default = is_default
        self.pc = ksp.getPC()
        self.vcycle: SinglePrecisionVCycle | None = None
        self.keeps_coarse_spaces = True

    def change_kind(self, options: PetscOptions) -> None:
        """Change options of `pc`, which has to be rebuilt after this."""
        self._options.change(options)
        self.pc.reset()
        self.pc.setFromOptions()

    def set_up(self, operators: TangentOperators, *, rebuild: bool) -> None:
        """Set up for the tangent of the next solve (collective).

        Args:
            operators: tangent.
            rebuild: whether coarse spaces are made anew.
        """
        if rebuild:
            self.pc.reset()
            # PETSc would call the next set-up failed as well after one that failed
            self.pc.setFailedReason(PETSc.PC.FailedReason.NOERROR)
        self.release_vcycle()
        renew_smoothers(self.pc)
        is_large = operators.matrix.getSize()[0] > self._policy.max_kept_multigrid_dofs
        with stored_products(operators.matrix, self._policy.max_stored_product_dofs):
            operators.attach_to(self._ksp, self.pc)
        if self._is_default and operators.blocks is not None:
            from .multigrid.vcycle import create_vcycle

            release_entries = operators.release_entries if is_large else None
            self.vcycle = create_vcycle(self.pc, operators.blocks, self._policy, release_entries)
        self.keeps_coarse_spaces = self.vcycle is None or not is_large

    @property
    def serving(self) -> PETSc.PC:
        """Preconditioner that is applied: `pc`, or the V cycle copied from it."""
        return self.pc if self.vcycle is None else self.vcycle.pc

    def find_changed_nodes(self) -> None:
        """Find `changed_nodes` for the tangent of the next solve (collective)."""
        self.changed_nodes = None
        if self.vcycle is None:
            return
        from ..mesh.node_cells import with_neighbours

        domain, policy = self._balance.domain, self._policy
        nodes = with_neighbours(domain, self.vcycle.fine_level.changed_nodes(policy.changed_stiffness))
        limit = min(policy.max_changed_share * domain.space.dofmap.index_map.size_global, policy.max_changed_nodes)
        if 0 < domain.comm.allreduce(int(np.count_nonzero(nodes))) <= limit:
            self.changed_nodes = np.flatnonzero(nodes)

    def release_vcycle(self) -> None:
        """Free the V cycle."""
        if self.vcycle is not None:
            self.vcycle.destroy()
            self.vcycle = None


class Preconditioner:
    """Preconditioner of a KSP that is reused for later tangents as long as iterations stay few.

    Attributes:
        applied: PETSc's objects.
        is_indefinite: whether the last tangent was indefinite; CG detects that by itself.
    """

    is_indefinite = False

    def __init__(
        self,
        ksp: PETSc.KSP,
        options: PetscOptionSet,
        balance: Balance,
        policy: SolverPolicy,
        *,
        is_default: bool,
        keeps: bool,
    ) -> None:
        """Create the preconditioner (collective).

        Args:
            ksp: Krylov solver.
            options: options of the solver.
            balance: equations.
            policy: tuned numbers.
            is_default: whether the study chooses no preconditioner.
            keeps: whether it is reused for later tangents, unlike factors.
        """
        self._comm, self._balance, self._policy = ksp.comm, balance, policy
        self.applied = AppliedPreconditioner(ksp, options, balance, policy, is_default=is_default)
        self._node_count = balance.domain.space.dofmap.index_map.size_global
        # --- facts ---
        self._iterations = self._equivalent = 0  # of the last solve, and of one to full accuracy
        self._edges_since_update = 0
        self._edges_since_rebuild = False
        self._ever_broken = False
        self._pattern_is_new = False
        # --- decisions ---
        self._due, self._keeps = Update.REBUILD, keeps
        self._last_update = Update.NONE  # before the last solve
        self._solves = 0  # since it was rebuilt
        self._fresh_iterations = 0  # of a solve when it was fresh; 0: unknown
        self._whole_iterations = 0  # of a fresh set-up while the body was whole
        self._extra_iterations = 0.0  # beyond the fresh ones since it was rebuilt
        self._extra_at_refresh = 0.0
        # whether sweeps may come to serve a body in fragments, which inertia has to hold
        self._may_use_ssor = is_default and balance.scheme.inertia
        # iterations with aggregates of all links, while strong ones are on trial; 0: unknown; None: settled
        self._all_links_iterations: int | None = 0 if self._may_use_ssor else None
        self._uses_ssor: bool | None = None  # of a body in fragments; None: multigrid takes few iterations

    # --- facts ---

    def edges_broke(self, count: int | None) -> None:
        """Record the number of edges that broke on all ranks; None: an unknown number, as after a restart."""
        self._ever_broken = True
        self._edges_since_update += self._node_count if count is None else count
        self._edges_since_rebuild = self._edges_since_rebuild or count != 0

    def pattern_changed(self) -> None:
        """Record that the tangent is another matrix or has another nonzero pattern."""
        self._pattern_is_new = True

    def matrix_ends(self) -> None:
        """Free multigrid, since another matrix is about to take the place of the tangent."""
        self.applied.release_vcycle()
        self.applied.pc.reset()

    def solved(self, iterations: int, equivalent: int) -> None:
        """Record the iterations of the last solve, which may be told repeatedly.

        Args:
            iterations: number of iterations.
            equivalent: that of a solve to full accuracy; 0: unknown.
        """
        self._iterations, self._equivalent = iterations, equivalent

    def solve_failed(self) -> None:
        """Record that a solve failed: smoothers of an older tangent need not be positive for this one."""
        self._due = Update.REBUILD

    def tangent_was_indefinite(self) -> None:
        """Record that the last tangent was indefinite: what was set up for it is set up again for the next one."""
        self._due = max(self._due, self._last_update)

    def bypassed(self) -> None:
        """Record that another solver was used, and that the tangent has changed since."""
        self._due = Update.REBUILD
        self.applied.release_vcycle()

    @contextmanager
    def updated_for_each_tangent(self) -> Iterator[None]:
        """Context in which it is rebuilt for the first tangent and refreshed for each later one."""
        keeps, self._due, self._keeps = self._keeps, Update.REBUILD, False
        try:
            yield
        finally:
            self._keeps = keeps

    # --- the decision ---

    def next_update(self) -> Update:
        """Update that is due before the next solve; does not change the state (collective)."""
        return self._decide(counts_solve=False)

    def _decide(self, *, counts_solve: bool) -> Update:
        """Update that is due before the next solve: the only place that decides it (collective).

        `counts_solve`: whether the solve follows, so that iterations of the last one are added to the sums.
        """
        policy, equivalent = self._policy, self._equivalent
        # Many edges broke. The V cycle has the fine level of each tangent, and is judged by its iterations.
        is_old = self._edges_since_update > policy.refresh_edges * self._node_count
        is_other_body = self._edges_since_update > policy.many_edges * self._node_count
        if is_other_body or (is_old and self.applied.vcycle is None):
            self._due = max(self._due, Update.REFRESH)
        if self._due == Update.NONE:
            self._learn_from_solve(equivalent)
            if self.applied.vcycle is not None and self._solves < policy.solves_after_setup:
                self._fresh_iterations = max(self._fresh_iterations, equivalent)
        # Too many iterations. Also where a refresh is due: coarse spaces from before a crack carry the motion of one
        # side to the other.
        fresh = self._fresh_iterations
        if self.applied.vcycle is None and fresh and equivalent > policy.rebuild_ratio * fresh + 2:
            self._due = Update.REBUILD
        # Factors and coarse spaces of another pattern would be written past the end of their arrays.
        if self._pattern_is_new or (self._due == Update.REFRESH and not self.applied.keeps_coarse_spaces):
            self._due = Update.REBUILD
        if not counts_solve:
            return self._due
        # Iterations beyond the fresh ones have added up to what an update costs.
        self._solves += 1
        if self.applied.vcycle is None:
            if self._edges_since_update:
                self._extra_iterations += max(equivalent - fresh, 0)
            if self._extra_iterations > policy.refresh_cost:
                self._due = max(self._due, Update.REFRESH)
        else:
            if equivalent > fresh > 0:
                self._extra_iterations += self._iterations * (1 - fresh / equivalent)
            factor = policy.thorough_cost_factor if self.applied.vcycle.has_thorough_smoothing else 1.0
            if self._extra_iterations > factor * policy.vcycle_setup_cost:
                self._due = Update.REBUILD
            elif (
                not self._edges_since_rebuild  # its coarse spaces are good still
                and self.applied.keeps_coarse_spaces
                and self._extra_iterations > self._extra_at_refresh + factor * policy.vcycle_refresh_cost
            ):
                self._due = max(self._due, Update.REFRESH)
        # The step size calls for sweeps or for multigrid.
        if self._uses_ssor is not None and self._uses_ssor != (
            mass_stiffness_ratio(self._balance) > policy.min_ssor_inertia
        ):
            self._uses_ssor, self._fresh_iterations = not self._uses_ssor, 0
            self._change_kind(SSOR_OPTIONS if self._uses_ssor else MULTIGRID_OPTIONS)
        return self._due

    def _learn_from_solve(self, equivalent: int) -> None:
        """Change the kind of multigrid if the iterations of a solve since the last update were many (collective)."""
        if self._uses_ssor:
            self._due = Update.REFRESH
            return
        if not self._fresh_iterations:
            self._fresh_iterations = equivalent
            if not self._ever_broken and self._tries_other_links(equivalent):
                return
            self._whole_iterations = self._whole_iterations or equivalent
            limit = self._policy.fragmented_ratio * self._whole_iterations + 2
            has_short_steps = mass_stiffness_ratio(self._balance) > self._policy.min_ssor_inertia_broken
            may_begin = self._ever_broken and self._may_use_ssor and self._uses_ssor is None
            if may_begin and (equivalent > limit or has_short_steps):
                self._uses_ssor = False  # from now on the step size decides
        if not self._keeps:
            self._due = max(self._due, Update.REFRESH)

    def _tries_other_links(self, equivalent: int) -> bool:
        """Aggregate over strong links if an unbroken body is slow to solve, and undo that where it is no better.

        Returns:
            Whether the kind of aggregation has changed.
        """
        all_links = self._all_links_iterations
        if all_links is None or not equivalent:
            return False
        policy = self._policy
        is_worse = equivalent > (policy.strong_link_gain * all_links if all_links else policy.slow_iterations)
        self._all_links_iterations = equivalent if is_worse and not all_links else (None if all_links else 0)
        if is_worse:
            strong = STRONG_LINKS if self._comm.size == 1 else STRONG_LINKS_ON_RANKS
            self._change_kind(ALL_LINKS if all_links else strong)
            self._fresh_iterations = 0
        return is_worse

    def _change_kind(self, options: PetscOptions) -> None:
        self._due = Update.REBUILD
        self.applied.change_kind(options)

    # --- setting up ---

    def update(self, operators: TangentOperators) -> None:
        """Update the preconditioner to the tangent of the next solve (collective)."""
        # SNES only knows a fixed number of tangents between two set-ups
        self._last_update = self._decide(counts_solve=True)
        if self._last_update != Update.NONE:
            operators.update_entries()  # which may change the pattern
            self._last_update = self._decide(counts_solve=False)
            self._set_up(operators, self._last_update)
        if self.applied.vcycle is not None:
            self.applied.vcycle.update_operator()
        if self._ever_broken:
            self.applied.find_changed_nodes()

    def _set_up(self, operators: TangentOperators, update: Update) -> None:
        rebuild = update == Update.REBUILD
        if rebuild:
            self._fresh_iterations = self._solves = 0
            self._edges_since_rebuild = False
        self.applied.set_up(operators, rebuild=rebuild)
        if rebuild or self.applied.vcycle is None:
            self._extra_iterations = 0.0
        self._extra_at_refresh = self._extra_iterations
        self._due, self._edges_since_update, self._pattern_is_new = Update.NONE, 0, False

    # --- the solver's side ---

    @property
    def pc(self) -> PETSc.PC:
        """PETSc's preconditioner of the whole body."""
        return self.applied.pc

    @property
    def serving(self) -> PETSc.PC:
        """Preconditioner that is applied."""
        return self.applied.serving

    @property
    def changed_nodes(self) -> npt.NDArray[np.int64] | None:
        """Nodes to be solved for exactly (AppliedPreconditioner)."""
        return self.applied.changed_nodes

    @property
    def fine_level(self) -> FineLevel | None:
        """Tangent of the next solve in single precision; None: there is none."""
        return None if self.applied.vcycle is None else self.applied.vcycle.fine_level

    def destroy(self) -> None:
        """Free what was made of `pc`."""
        self.applied.release_vcycle()
