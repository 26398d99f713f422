"""Polar rotations of the deformation gradients of a body, for the corotated energy.

Equations: docs/theory.md#elastic-energies.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from ufl.core.expr import Expr

from ..mesh.c_library import FAST_FLAGS, LANES, compile_on_all_ranks
from ..mesh.domain import Domain
from ..mesh.small_matrices import closest_rotation, polar_rotation
from .jit import point_expression, point_field

if TYPE_CHECKING:
    from .kernel_selection import KernelSelection

Values = npt.NDArray[np.float64]
Rotations = Callable[[Values], Values]  # (n, d, d) rotations of (n, d, d) matrices

SOURCE = Path(__file__).with_suffix(".c")


class PolarRotation:
    """Rotation R of F = R U at each point where stress is integrated.

    Attributes:
        field: R (d x d); the identity for a body at rest.
    """

    def __init__(self, domain: Domain, F: Expr, kernels: KernelSelection) -> None:
        """Compile F, a (d, d) expression of the displacement (collective)."""
        d = domain.dim
        self.field = point_field(domain, (d, d), "rotation")
        self.field.x.array.reshape(-1, d, d)[:] = np.eye(d)
        self._gradient = point_expression(domain, F, kernels=kernels)
        self._rotations = kernels.polar_rotation(domain.comm, d) or polar_rotation
        self._d, self._cell_count = d, domain.cell_count

    def update(self, cells: npt.NDArray[np.int32] | None = None) -> None:
        """Evaluate R at the current displacement in owned cells (k,); None: in all of them (not collective)."""
        # ghosts need no update: cells are not ghosted
        F = self._gradient.evaluate_at_points(cells).reshape(-1, self._d, self._d)
        values = self.field.x.array.reshape(self._cell_count, -1)
        values[slice(None) if cells is None else cells] = self._rotations(F).reshape(-1, values.shape[1])


def compiled_polar_rotation(comm: MPI.Comm, dim: int) -> Rotations | None:
    """Function like `polar_rotation`, in a tenth of its time; None without a compiler (collective)."""
    flags = [*FAST_FLAGS, f"-DD={dim}", f"-DLANES={LANES}"]
    code = compile_on_all_ranks(comm, "rotations", SOURCE.read_text(encoding="utf-8"), flags)
    if code is None:
        return None

    def rotations(F: Values) -> Values:
        """(n, d, d) rotations of F (n, d, d)."""
        R, irregular = np.empty_like(F), np.empty(len(F), np.int64)
        flagged = irregular[: code.rotations(len(F), F, R, irregular)]
        if len(flagged):
            R[flagged] = closest_rotation(F[flagged])
        return R

    return rotations
