"""J-integral around a point as an integral over a ring of cells (docs/theory.md#contour-integral)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from ufl.core.expr import Expr

from ..errors import InputError
from ..mesh.parallel import sum_over_ranks
from .jit import cell_measure, compile_form
from .stress import Stress, energy_derivatives

Values = npt.NDArray[np.float64]


class ContourIntegral:
    """J-integral of a body in equilibrium, as a vector (d,), J/m^2; in 3D the force on the front in the ball, N.

    J = - int (psi I - H^T P) grad q dX - int q H^T f dX, where q falls linearly from 1 at radius / 2 to 0 at the radius
    (Rice 1968; Li, Shih and Needleman 1985). psi and P are those of the damaged body, f is the force per volume.
    """

    def __init__(
        self, stress: Stress, centre: Values, radius: float, key: str, volume_force: Expr | None = None
    ) -> None:
        """Compile the integral (collective).

        Args:
            stress: stress of the body.
            centre: (d,) point at rest, m.
            radius: m.
            key: of the radius in the study, for errors.
            volume_force: UFL vector, N/m^3; None: there is none.

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
        integrals = [(force, dx)]
        if volume_force is not None:
            within = cell_measure(domain, np.flatnonzero(corners.max(axis=1, initial=0.0) > 0).astype(np.int32))
            integrals.append((-q * (ufl.grad(stress.u).T * volume_force), within))
        # DOLFINx takes one set of cells a form
        self._forms = [
            [compile_form(vector[axis] * measure) for vector, measure in integrals] for axis in range(domain.dim)
        ]

    def __call__(self) -> Values:
        """Return the part (d,) of this rank at the present displacement."""
        return np.array([sum(fem.assemble_scalar(form) for form in forms) for forms in self._forms])
