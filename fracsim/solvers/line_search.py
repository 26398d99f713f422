"""Line search of Newton's method: merit function and positive tangents.

Equations: docs/theory.md#newtons-method.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from petsc4py import PETSc

from ..mechanics.balance import Balance
from .policy import DEFAULT_POLICY, SolverPolicy
from .weak_callbacks import weak_callback


class MeritFunction:
    """Merit function of a SNES: rise of the incremental potential since the start of the iteration, J.

    A line search on |r|, which a barrier makes steep, cuts good steps to almost nothing. Where no contact acts at
    either end of a step, a decrease of |r| is accepted as well, which saves the sum of the energies.
    """

    def __init__(self, balance: Balance, snes: PETSc.SNES, policy: SolverPolicy = DEFAULT_POLICY) -> None:
        self._balance, self._snes, self._policy = balance, snes, policy
        self._start, self._residual = balance.work_vector.duplicate(), balance.work_vector.duplicate()
        self.begin_solve()

    def begin_solve(self) -> None:
        """Forget the values of earlier solves."""
        self._whole_step_rise: float | None = None  # J, of the first trial of an iteration
        # The last potential and residual are valid for one version of the unknowns each.
        self._last_potential, self._potential_version, self._residual_version = (0.0, 0.0), -1, -1
        self._start_potential, self._start_norm = 0.0, 0.0
        self._at_start, self._by_norm, self._eliminated = True, False, False

    @property
    def _version(self) -> int:
        """Number of changes of all unknowns."""
        eliminated = self._balance.eliminated
        return self._balance.displacement_version + (0 if eliminated is None else eliminated.version)

    def begin_line_search(self) -> None:
        """Note that PETSc evaluates the start of an iteration next."""
        self._at_start = True

    def note_elimination(self) -> None:
        """Note that nodes were relaxed separately: |r| is no merit in the remaining iterations.

        |r| of other nodes may rise in an elimination, so that a line search on |r| would undo it.
        """
        self._eliminated = True

    def evaluate_residual(self, x: PETSc.Vec, b: PETSc.Vec) -> None:
        """Evaluate r at x into b (collective)."""
        self._balance.set_iterate(x)
        if self._residual_version == self._version:
            self._residual.copy(b)
        else:
            self._balance.assemble_free_residual(x, b)

    def __call__(self, x: PETSc.Vec) -> float:
        """Return the merit at x, J (collective)."""
        self._balance.set_iterate(x)
        if self._at_start:
            self._start_from(x)
            return 0.0
        if self._by_norm:
            if not self._balance.contact.is_active() and self._norm_at(x) < self._start_norm:
                return -1e100  # so low that every line search accepts the step
            self._evaluate_start(x)
        potential, size = self._potential()
        rise, slack = potential - self._start_potential, self._policy.potential_round_off * size
        if self._whole_step_rise is None:
            self._whole_step_rise = rise
        # Near the solution potentials differ by round-off alone, and a whole step is accepted. A step that was
        # shortened until it makes no difference is not: its direction rises.
        is_near = self._whole_step_rise <= self._policy.near_solution_ratio * slack
        return -slack if abs(rise) <= slack and is_near else rise

    def _start_from(self, x: PETSc.Vec) -> None:
        """Take x as the start of the iteration (collective)."""
        self._at_start, self._whole_step_rise = False, None
        self._by_norm = not self._eliminated and not self._balance.contact.is_active()
        if self._by_norm:
            x.copy(self._start)
            self._start_norm = self._snes.getFunctionNorm()
        else:
            self._start_potential = self._potential()[0]

    def _potential(self) -> tuple[float, float]:
        """Return the potential and the sum of the absolute values of its summands, J (collective)."""
        # Newton's method asks for it mostly where the line search has evaluated it already.
        if self._potential_version != self._version:
            self._last_potential = self._balance.energies.incremental_potential()
            self._potential_version = self._version
        return self._last_potential

    def _norm_at(self, x: PETSc.Vec) -> float:
        """Return |r| at x, N (collective)."""
        self._balance.assemble_free_residual(x, self._residual)
        self._residual_version = self._version
        return float(self._residual.norm())

    def _evaluate_start(self, x: PETSc.Vec) -> None:
        """Evaluate the potential at the start of the iteration, and return to x (collective)."""
        self._balance.set_iterate(self._start)
        self._start_potential, self._by_norm = self._potential()[0], False
        self._balance.set_iterate(x)

    def destroy(self) -> None:
        """Free PETSc's objects."""
        self._start.destroy()
        self._residual.destroy()


class TangentModification(NamedTuple):
    """Modification by which tangents are made positive in an attempt.

    Attributes:
        name: of the strategy.
        exact_below: share of the largest |r| of the attempt, below which tangents are exact.
        eigenvalue_floor: magnitude of the negative eigenvalues that stay otherwise, in mean moduli of a cell.
        rebuild_preconditioner: whether preconditioners are set up for each tangent.
        from_last_iterate: whether the attempt starts where the last one ended.
    """

    name: str
    exact_below: float
    eigenvalue_floor: float
    rebuild_preconditioner: bool = False
    from_last_iterate: bool = False


# Tried in turn. The second, third and fourth continue from the last iterate of the one before: with positive moduli
# again where the exact tangent was indefinite still, then without negative eigenvalues at all.
POSITIVE_TANGENTS = (
    TangentModification("positive tangents", DEFAULT_POLICY.exact_below, DEFAULT_POLICY.eigenvalue_floor),
    TangentModification(
        "positive tangents again", DEFAULT_POLICY.exact_below, DEFAULT_POLICY.eigenvalue_floor, from_last_iterate=True
    ),
    TangentModification("strictly positive tangents", DEFAULT_POLICY.exact_below, 0.0, from_last_iterate=True),
    TangentModification("strictly positive tangents to the end", 0.0, 0.0, from_last_iterate=True),
    TangentModification("strictly positive tangents, preconditioner for each", 0.0, 0.0, rebuild_preconditioner=True),
)


class ModifiedNewton:
    """A SNES whose line search decreases the incremental potential, with tangents that may be made positive.

    Exact tangents of a body that tears, buckles or is squeezed are indefinite: CG stops, and other methods may find a
    direction in which the potential rises. With positive moduli all directions descend. Near the solution tangents are
    exact again, so that Newton's method converges quadratically.

    Attributes:
        snes: the SNES.
        merit: its merit function.
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
        """Begin an attempt with a modification of its tangents; None: with exact ones."""
        self._modification, self._largest_norm = modification, 0.0
        self._smallest_norm, self._smallest_at = math.inf, 0

    def eigenvalue_floor(self) -> float | None:
        """Return the magnitude of negative eigenvalues that stay in the tangent at the present iterate, in mean moduli.

        None: the tangent is exact.
        """
        if self._modification is None:
            return None
        norm = self.snes.getFunctionNorm()
        self._largest_norm = max(self._largest_norm, norm)
        is_exact = norm < self._modification.exact_below * self._largest_norm
        return None if is_exact else self._modification.eigenvalue_floor

    def has_stalled(self, norm: float, its: int) -> bool:
        """Return True if the attempt cycles between iterates, or leaves an unstable equilibrium.

        Exact tangents that are indefinite without being noticed by CG lead past the solution again and again. Positive
        ones lead away from it: |r| grows for many iterations.

        Args:
            norm: |r|, N.
            its: number of iterations.
        """
        if norm < self._smallest_norm or not its:
            self._smallest_norm, self._smallest_at = norm, its
        is_exact, policy = self.eigenvalue_floor() is None, self._policy
        if self._modification is None or its - self._smallest_at < policy.max_stalled_iterations:
            return False
        return is_exact or norm > policy.divergence_ratio * self._smallest_norm

    def destroy(self) -> None:
        """Free PETSc's objects."""
        self.merit.destroy()
