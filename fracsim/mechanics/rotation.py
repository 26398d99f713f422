"""Polar rotation of the deformation gradient in every cell, for the corotated energy."""

from __future__ import annotations

from dolfinx import fem
from ufl.core.expr import Expr

from ..mesh.domain import Domain
from ..mesh.small_matrices import polar_rotation
from .kernels import CellExpression


class RotationField:
    """R of F = R U (d x d, an expression of the displacement) as a DG0 tensor field, refreshed at every iterate."""

    def __init__(self, domain: Domain, F: Expr) -> None:
        d = domain.dim
        space = fem.functionspace(domain.mesh, ("DG", 0, (d, d)))
        self.field = fem.Function(space, name="rotation")
        self._gradient = CellExpression(domain.comm, domain.mesh, F, domain.cell_count)
        self._d = d

    def update(self) -> None:
        """Bring R (d x d, DG0) to the current displacement; ghosts need none, for cells are not ghosted."""
        F = self._gradient().reshape(-1, self._d, self._d)
        self.field.x.array[:] = polar_rotation(F).reshape(-1)
