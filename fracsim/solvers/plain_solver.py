"""Linear solver of `[solver] plain = true`: PETSc alone, in double precision, set up for each tangent.

The Krylov method is CG, or GMRES where the tangent is not symmetric. Small systems are preconditioned by factors of
MUMPS, others by GAMG with PETSc's defaults and the rigid body modes as near null space. Newton's method is that of the
other solver (newton), without nonlinear elimination. DOLFINx assembles (mechanics.kernel_selection).

Equations: docs/theory.md#linear-systems.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from ..mechanics.balance import Balance
from .petsc_options import PetscOptions
from .policy import SolverPolicy
from .preconditioner import Update, renew_smoothers

if TYPE_CHECKING:
    from .multigrid.levels import FineLevel
    from .tangent_operators import TangentOperators


def plain_method(balance: Balance, given: PetscOptions, policy: SolverPolicy) -> PetscOptions:
    """Options of the Krylov method and the preconditioner, which those of the study (`given`) may replace."""
    krylov: PetscOptions = {"ksp_type": "cg" if balance.symmetric else "gmres"}
    is_chosen = any(key.startswith(("ksp_type", "pc_", "mg_")) for key in given)
    is_small = balance.work_vector.getSize() <= policy.max_plain_direct_dofs
    if is_chosen or not is_small or not PETSc.Sys.hasExternalPackage("mumps"):
        return krylov | {"pc_type": "gamg"}
    # A Krylov method, not "preonly": one iteration with factors, and CG tells where a symmetric tangent is indefinite.
    return krylov | {
        "pc_type": "cholesky" if balance.symmetric else "lu",
        "pc_factor_mat_solver_type": "mumps",
    }


class PlainPreconditioner:
    """PETSc's preconditioner of a KSP, set up for each tangent; the plain counterpart of `Preconditioner`.

    Attributes:
        pc, serving: PETSc's preconditioner.
        is_indefinite: whether factors tell that the last tangent was indefinite.
        changed_nodes: None, as it is set up for each tangent.
    """

    fine_level: FineLevel | None = None  # no copy in single precision
    changed_nodes: npt.NDArray[np.int64] | None = None
    is_indefinite = False

    def __init__(self, ksp: PETSc.KSP) -> None:
        self._ksp = ksp
        self.pc = self.serving = ksp.getPC()

    def update(self, operators: TangentOperators) -> None:
        """Set up for the tangent of the next solve (collective)."""
        operators.update_entries()
        renew_smoothers(self.pc)
        operators.attach_to(self._ksp, self.pc)
        if self.pc.getType() == "cholesky" and self.pc.getFactorSolverType() == "mumps":
            negative_pivots = self.pc.getFactorMatrix().getMumpsInfog(12)
            self.is_indefinite = negative_pivots > 0

    def pattern_changed(self) -> None:
        """The tangent is another matrix or has entries at other places, which PETSc's multigrid does not notice."""
        self.pc.reset()

    matrix_ends = pattern_changed

    def next_update(self) -> Update:
        """Rebuild, for every tangent."""
        return Update.REBUILD

    @contextmanager
    def updated_for_each_tangent(self) -> Iterator[None]:
        """Context in which it is set up for each tangent, as everywhere."""
        yield

    # --- facts by which `Preconditioner` decides when it is set up ---

    def edges_broke(self, count: int | None) -> None:
        """Ignored."""

    def solved(self, iterations: int, equivalent: int) -> None:
        """Ignored."""

    def solve_failed(self) -> None:
        """Ignored."""

    def tangent_was_indefinite(self) -> None:
        """Ignored."""

    def bypassed(self) -> None:
        """Ignored."""

    def destroy(self) -> None:
        """Free nothing: the KSP owns `pc`."""
