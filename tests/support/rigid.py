"""Free bodies of one material for the tests of the rigid scheme."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI

from fracsim.mechanics.material import material_fields
from fracsim.mechanics.stress import Stress, Weakening
from fracsim.mechanics.vectors import Assembler
from fracsim.mesh.domain import Domain, distribute
from fracsim.meshes.data import MeshData
from fracsim.rigid.free_body import FreeBody, Stiffness

Values = npt.NDArray[np.float64]
DENSITY = 2000.0  # kg/m^3
TIGHT: dict[str, bool | int | float | str] = {"ksp_rtol": 1e-13}


def stiffness_of(mesh: MeshData, young: float = 1e9, poisson: float = 0.2) -> Stiffness:
    """Of a mesh of linear material."""
    domain = distribute(MPI.COMM_SELF, mesh)
    material = material_fields(domain, "linear", young=young, poisson=poisson, density=DENSITY)
    stress = Stress(Assembler(domain), fem.Function(domain.space), material, Weakening("chi"))
    return Stiffness(stress, np.full(domain.cell_count, DENSITY))


def whole_body(mesh: MeshData) -> tuple[Stiffness, FreeBody, Domain]:
    """All cells of a mesh as one body."""
    stiffness = stiffness_of(mesh)
    domain = stiffness.stress.domain
    return stiffness, FreeBody(stiffness, np.ones(domain.cell_count), TIGHT), domain


def section_mean(domain: Domain, values: Values, axis: int, low: float, high: float) -> float:
    """Mean by volume of cell values (cells,) between two heights of the centroids."""
    height = domain.nodes[domain.cell_nodes].mean(axis=1)[:, axis]
    inside = (height > low) & (height < high)
    return float(np.average(values[inside], weights=domain.volumes[inside]))
