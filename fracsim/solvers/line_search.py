"""The line search of Newton's method: its merit function, tangents made positive, and clipped corrections.

Equations: docs/theory.md#newtons-method.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from petsc4py import PETSc

from ..mechanics.balance import Balance
from ..mesh.domain import Domain
from ..mesh.parallel import sum_over_ranks
from .policy import DEFAULT_POLICY, SolverPolicy
from .weak_callbacks import weak_callback

TAKEN_AT_ONCE = -1e100  # J: a merit so low that the step is accepted


class MeritFunction:
    """The merit function of a SNES: rise of the incremental potential since the start of the iteration, J.

    On |r|, which a barrier makes steep, a line search cuts good steps to nothing. Where no contact acts at either end
    of a step a fall of |r| is accepted as well: its residual is asked for next anyway, and no energy has to be summed.
    """

    def __init__(self, balance: Balance, snes: PETSc.SNES, policy: SolverPolicy = DEFAULT_POLICY) -> None:
        self._balance, self._snes, self._policy = balance, snes, policy
        self._start, self._residual = balance.work_vector.duplicate(), balance.work_vector.duplicate()
        self.begin_solve()

    def begin_solve(self) -> None:
        """A solve begins: nothing is known of it."""
        self._whole_step_rise: float | None = None  # J, of the first trial of an iteration
        # Values are known by the version of the displacement that they belong to.
        self._potential_known, self._potential_version, self._residual_version = (0.0, 0.0), -1, -1
        self._start_potential, self._start_norm = 0.0, 0.0
        self._at_start, self._by_norm, self._eliminated = True, False, False

    def begin_line_search(self) -> None:
        """The direction of an iteration is known: PETSc asks for the merit of its start next."""
        self._at_start = True

    def note_elimination(self) -> None:
        """Nodes were relaxed separately, where the residual of others may rise: from here on |r| is no merit, or what
        they gained would be given back in each iteration."""
        self._eliminated = True

    def evaluate_residual(self, x: PETSc.Vec, b: PETSc.Vec) -> None:
        """r at x into b (collective)."""
        self._balance.set_iterate(x)
        if self._residual_version == self._balance.displacement_version:
            self._residual.copy(b)
        else:
            self._balance.assemble_free_residual(x, b)

    def __call__(self, x: PETSc.Vec) -> float:
        """The merit at x, J (collective).

        Near the solution potentials differ by round-off alone: such a whole step counts as a descent. A step that was
        cut until it made no difference does not: its direction rises.
        """
        self._balance.set_iterate(x)
        if self._at_start:
            self._start_from(x)
            return 0.0
        if self._by_norm:
            if not self._balance.contact.is_active() and self._norm_at(x) < self._start_norm:
                return TAKEN_AT_ONCE
            self._evaluate_start(x)
        potential, size = self._potential()
        rise, slack = potential - self._start_potential, self._policy.potential_round_off * size
        if self._whole_step_rise is None:
            self._whole_step_rise = rise
        is_near = self._whole_step_rise <= self._policy.near_solution * slack
        return -slack if abs(rise) <= slack and is_near else rise

    def _start_from(self, x: PETSc.Vec) -> None:
        self._at_start, self._whole_step_rise = False, None
        self._by_norm = not self._eliminated and not self._balance.contact.is_active()
        if self._by_norm:
            x.copy(self._start)
            self._start_norm = self._snes.getFunctionNorm()
        else:
            self._start_potential = self._potential()[0]

    def _potential(self) -> tuple[float, float]:
        """Potential and the size of its summands, J; mostly asked for where the line search has just been."""
        if self._potential_version != self._balance.displacement_version:
            self._potential_known = self._balance.energies.incremental_potential()
            self._potential_version = self._balance.displacement_version
        return self._potential_known

    def _norm_at(self, x: PETSc.Vec) -> float:
        """|r| at x, N."""
        self._balance.assemble_free_residual(x, self._residual)
        self._residual_version = self._balance.displacement_version
        return float(self._residual.norm())

    def _evaluate_start(self, x: PETSc.Vec) -> None:
        """Compare potentials after all."""
        self._balance.set_iterate(self._start)
        self._start_potential, self._by_norm = self._potential()[0], False
        self._balance.set_iterate(x)

    def destroy(self) -> None:
        """Give the memory of PETSc's objects back."""
        self._start.destroy()
        self._residual.destroy()


def clip_correction(domain: Domain, y: PETSc.Vec, r: PETSc.Vec, policy: SolverPolicy = DEFAULT_POLICY) -> None:
    """Shorten a correction x <- x - y, m, of nodes that it moves by more than a mean edge (collective).

    With tangents made positive a cell that is all but flat, or hangs by one node, has next to no stiffness in some
    direction. The correction throws its nodes tens of edges far, for whose sake the line search would cut those of all
    nodes. At most `max_clipped_nodes` of them are clipped: what a whole part does is its motion. The correction stays
    as it is where the clipped one is no descent of a potential with the gradient `r`, N.
    """
    moves = y.array_r.reshape(-1, domain.dim)
    lengths, limit = np.sqrt((moves * moves).sum(axis=1)), domain.mean_edge_length
    allowed = policy.max_clipped_nodes * domain.space.dofmap.index_map.size_global
    while (clipped := sum_over_ranks(domain.comm, np.count_nonzero(lengths > limit))[0]) > allowed:
        limit *= 2
    if not clipped:
        return
    whole = y.copy()
    y.array_w[:] = (moves * np.minimum(1.0, limit / np.maximum(lengths, limit))[:, None]).reshape(-1)
    if y.dot(r) <= 0:
        whole.copy(y)
    whole.destroy()


class TangentModification(NamedTuple):
    """How tangents are made positive in an attempt.

    Attributes:
        name: of the strategy.
        exact_below: share of the largest |r| of the attempt below which tangents are exact.
        eigenvalue_floor: negative eigenvalues that are kept otherwise, in mean moduli of a cell.
        rebuild_preconditioner: whether preconditioners are set up for each tangent.
        from_last_iterate: whether it starts where the last attempt ended.
    """

    name: str
    exact_below: float
    eigenvalue_floor: float
    rebuild_preconditioner: bool = False
    from_last_iterate: bool = False


# Tried in turn. The second and the third go on from where exact tangents have misled the one before.
POSITIVE_TANGENTS = (
    TangentModification("positive tangents", DEFAULT_POLICY.exact_below, DEFAULT_POLICY.eigenvalue_floor),
    TangentModification("strictly positive tangents", DEFAULT_POLICY.exact_below, 0.0, from_last_iterate=True),
    TangentModification("strictly positive tangents to the end", 0.0, 0.0, from_last_iterate=True),
    TangentModification("strictly positive tangents, preconditioner for each", 0.0, 0.0, rebuild_preconditioner=True),
)
EXACT_TANGENTS = TangentModification("exact tangents, descent of the potential", math.inf, 0.0, from_last_iterate=True)


class ModifiedNewton:
    """A SNES whose line search goes down the incremental potential, with tangents that may be made positive.

    Exact tangents of a body that tears, buckles or is squeezed are indefinite: CG stops, and other methods may find a
    direction that rises. With positive moduli directions descend from anywhere. Near the solution tangents are exact
    again, where Newton's method converges quadratically.

    Attributes:
        snes: the SNES.    merit: its merit function.
    """

    def __init__(self, balance: Balance, snes: PETSc.SNES, policy: SolverPolicy = DEFAULT_POLICY) -> None:
        """Make the incremental potential of a conservative balance the objective of `snes`."""
        self.snes, self._balance, self._policy = snes, balance, policy
        self.merit = merit = MeritFunction(balance, snes, policy)
        objective, residual = weak_callback(merit.__call__), weak_callback(merit.evaluate_residual)
        snes.setObjective(lambda _, x: objective(x))
        snes.setFunction(lambda _, x, b: residual(x, b), balance.work_vector)
        self.use_modification(None)

    def use_modification(self, modification: TangentModification | None) -> None:
        """An attempt begins: with tangents of this kind; None: exact ones."""
        self._modification, self._largest_norm = modification, 0.0
        self._smallest_norm, self._smallest_at = math.inf, 0

    def eigenvalue_floor(self) -> float | None:
        """Negative eigenvalues that the tangent at the present iterate keeps, in mean moduli; None: it is exact."""
        if self._modification is None:
            return None
        norm = self.snes.getFunctionNorm()
        self._largest_norm = max(self._largest_norm, norm)
        is_exact = norm < self._modification.exact_below * self._largest_norm
        return None if is_exact else self._modification.eigenvalue_floor

    def clip_correction(self, y: PETSc.Vec) -> None:
        """Clip a correction from a tangent that was made positive (collective).

        Not without inertia: nothing tells then where a part moves that hangs by a thread.
        """
        if self._balance.scheme.inertia and self.eigenvalue_floor() is not None:
            clip_correction(self._balance.domain, y, self.snes.getFunction()[0], self._policy)

    def has_stalled(self, norm: float, its: int) -> bool:
        """Whether the attempt cycles: exact tangents that are indefinite, though CG does not notice, lead past the
        solution again and again. |r| is `norm`, N, after `its` iterations."""
        if norm < self._smallest_norm or not its:
            self._smallest_norm, self._smallest_at = norm, its
        is_exact = self._modification is not None and self.eigenvalue_floor() is None
        return is_exact and its - self._smallest_at >= self._policy.max_stalled_iterations

    def destroy(self) -> None:
        """Give the memory of PETSc's objects back."""
        self.merit.destroy()
