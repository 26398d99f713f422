"""Free bodies of one material for the tests of the rigid scheme."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI

from fracsim.fracture.brittle.grains import SurfaceParameters
from fracsim.fracture.brittle.surface_criterion import BrittleSurfaces
from fracsim.fracture.nonlocal_average import NeighbourAverage
from fracsim.fracture.strength import EdgeStrength
from fracsim.mechanics.material_fields import material_fields
from fracsim.mechanics.matrix_assembly import VectorAssembler
from fracsim.mechanics.stress import DegradationModel, Stress
from fracsim.mesh.domain import Domain, distribute
from fracsim.mesh.edge_graph import EdgeGraph
from fracsim.mesh.split_surface.closed_surface import build_split_surface
from fracsim.mesh.split_surface.entity_numbering import EntityNumbering
from fracsim.mesh.split_surface.polyhedron_moments import PolyhedronMoments, moments
from fracsim.meshes.data import MeshData
from fracsim.rigid.breakage import BreakableBody, FragmentAverage
from fracsim.rigid.fragment_analyses import StiffnessOperator
from fracsim.rigid.free_body_analysis import SolidBody, SolidStiffness
from fracsim.rigid.shell_analysis import ShellStiffness

Values = npt.NDArray[np.float64]
DENSITY = 2000.0  # kg/m^3
TIGHT: dict[str, bool | int | float | str] = {"ksp_rtol": 1e-13}


def stiffness_of(mesh: MeshData, young: float = 1e9, poisson: float = 0.2) -> SolidStiffness:
    """Of a mesh of linear material."""
    domain = distribute(MPI.COMM_SELF, mesh)
    material = material_fields(domain, "linear", young=young, poisson=poisson, density=DENSITY)
    stress = Stress(VectorAssembler(domain), fem.Function(domain.space), material, DegradationModel("chi"))
    return SolidStiffness(stress, np.full(domain.cell_count, DENSITY))


def shell_of(mesh: MeshData, young: float = 1e9, poisson: float = 0.2) -> ShellStiffness:
    """Of a shell of linear material."""
    assert mesh.shell is not None
    return ShellStiffness(stiffness_of(mesh, young, poisson).stress, mesh.shell, young, poisson, DENSITY)


def whole_body(mesh: MeshData) -> tuple[SolidStiffness, SolidBody, Domain]:
    """All cells of a mesh as one body."""
    stiffness = stiffness_of(mesh)
    domain = stiffness.stress.domain
    return stiffness, SolidBody(stiffness, np.ones(domain.cell_count), TIGHT), domain


def section_mean(domain: Domain, values: Values, axis: int, low: float, high: float) -> float:
    """Mean by volume of cell values (cells,) between two heights of the centroids."""
    height = domain.nodes[domain.cell_nodes].mean(axis=1)[:, axis]
    inside = (height > low) & (height < high)
    return float(np.average(values[inside], weights=domain.volumes[inside]))


def breakable(mesh: MeshData, strength: float, rules: SurfaceParameters, poisson: float = 0.2) -> BreakableBody:
    """A mesh that breaks along surfaces where its stress, averaged over neighbours, reaches a strength in Pa."""
    stiffness: StiffnessOperator = (
        stiffness_of(mesh, poisson=poisson) if mesh.shell is None else shell_of(mesh, poisson=poisson)
    )
    domain = stiffness.stress.domain
    graph, within = EdgeGraph(domain), FragmentAverage(NeighbourAverage(domain), domain.cell_count)
    criterion = BrittleSurfaces(stiffness.stress, graph, EdgeStrength(graph, strength, tie_break=1e-6), within, rules)
    return BreakableBody(stiffness, graph, criterion, within)


def density_of(bodies: PolyhedronMoments) -> Values:
    """(n,) the same everywhere."""
    return np.full(len(bodies.volume), DENSITY)


def moments_of(body: BreakableBody) -> PolyhedronMoments:
    """Of the pieces, from the split surface of the mesh at rest."""
    domain = body.graph.domain
    assert domain.input_mesh is not None
    skeleton = EntityNumbering(domain.input_mesh)
    pattern = np.empty(domain.cell_count, np.uint8)
    pattern[domain.input_numbering.cells] = body.graph.pattern
    made = build_split_surface(skeleton, pattern)
    return moments(made.points, made.elements, made.point_fragment[made.elements[:, 0]], made.fragment_count)
