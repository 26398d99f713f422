"""J-integral around a point as an integral over a ring of cells (docs/theory.md#contour-integral)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem

from ..errors import InputError
from ..mesh.parallel import sum_over_ranks
from .jit import cell_measure, compile_form
from .stress import Stress, energy_derivatives

Values = npt.NDArray[np.float64]


class ContourIntegral:
    """J-integral of a body in equilibrium, as a vector (d,), J/m^2; in 3D the force on the front in the ball, N.

    J = - int (psi I - H^T P) grad q dX, where q falls linearly from 1 at radius / 2 to 0 at the radius (Rice 1968; Li,
    Shih and Needleman 1985). psi and P are those of the damaged body.
    """

    def __init__(self, stress: Stress, centre: Values, radius: float, key: str) -> None:
        """Compile the integral (collective).

        Args:
            stress: stress of the body.
            centre: (d,) point at rest, m.
            radius: m.
            key: of the radius in the study, for errors.

        Raises:
            InputError: no cell has its corners on either side of the ring.
        """
        domain = stress.domain
        space = fem.functionspace(domain.mesh, ("Lagrange", 1))
        q = fem.Function(space, name="q")
        q.interpolate(lambda x: np.clip(2 - 2 * np.linalg.norm(x[: domain.dim].T - centre, axis=1) / radius, 0.0, 1.0))
        corners = q.x.array[space.dofmap.list[: domain.cell_count]]
        cells = np.flatnonzero(np.ptp(corners, axis=1) > 0).astype(np.int32)
        # A ring of less than one cell would see the fields of single cells.
        inside = np.count_nonzero(q.x.array[: space.dofmap.index_map.size_local] == 1)
        if not sum_over_ranks(domain.comm, inside)[0]:
            raise InputError(
                f"{key} = {radius:g}: no node is nearer to the point than half of it; give a radius of at least three "
                f"cells, such as {3 * domain.mean_edge_length:.2g}"
            )
        psi, P, _ = energy_derivatives(stress)
        eshelby = psi * ufl.Identity(domain.dim) - ufl.grad(stress.u).T * P
        force, dx = -eshelby * ufl.grad(q), cell_measure(domain, cells)
        self._forms = [compile_form(force[axis] * dx) for axis in range(domain.dim)]

    def __call__(self) -> Values:
        """Return the part (d,) of this rank at the present displacement."""
        return np.array([fem.assemble_scalar(form) for form in self._forms])
