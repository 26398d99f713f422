"""Polar rotation of the deformation gradient in every cell, for the corotated energy."""

from __future__ import annotations

import numpy as np
from ufl.core.expr import Expr

from ..mesh.domain import Domain
from ..mesh.small_matrices import polar_rotation
from .jit import point_expression, point_field


class RotationField:
    """R of F = R U (d x d, an expression of the displacement) as a tensor field with a value at each point where stress
    is integrated: the identity of a body at rest, refreshed at every iterate. One R a cell would do for P1 alone: R is
    exact where it is that of F."""

    def __init__(self, domain: Domain, F: Expr) -> None:
        d = domain.dim
        self.field = point_field(domain, (d, d), "rotation")
        self.field.x.array.reshape(-1, d, d)[:] = np.eye(d)
        self._gradient = point_expression(domain, F)
        self._d = d

    def update(self) -> None:
        """Bring R (d x d) to the current displacement; ghosts need none, for cells are not ghosted."""
        F = self._gradient.evaluate_at_points().reshape(-1, self._d, self._d)
        self.field.x.array[:] = polar_rotation(F).reshape(-1)
