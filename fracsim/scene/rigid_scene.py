"""Scene of a study of rigid bodies, on one rank: mesh, obstacles, instances and stepper."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI

from ..contact.obstacle import RigidObstacle
from ..errors import InputError
from ..mechanics.matrix_assembly import VectorAssembler
from ..mechanics.stress import DegradationModel, Stress
from ..mesh.domain import distribute
from ..mesh.edge_graph import EdgeGraph
from ..mesh.input_topology import MeshTopology
from ..meshes.data import MeshData, format_point
from ..rigid.breakage import BreakableBody, FragmentAverage
from ..rigid.fragment_analyses import StiffnessOperator
from ..rigid.fragment_geometry import FragmentGeometry
from ..rigid.free_body_analysis import SolidStiffness
from ..rigid.instance_placement import InstancePlacement, InstancePoses, instance_motion, place_mesh
from ..rigid.instances import Instances
from ..rigid.parallel_analyses import ParallelAnalyses, serve_analyses
from ..rigid.round_shape import RoundShape
from ..rigid.surface_loads import HertzContact
from ..study import ContactSettings, Study
from ..study.check import build_checked_mesh
from ..study.check_limits import LIMITS
from ..study.conditions import volume_loads
from ..study.mesh_source import find_builder
from ..study.overlap_checks import body_placements
from .contact_terms import build_rigid_obstacles
from .inelastic_updates import build_average, build_strength, build_surface_parameters
from .terms import build_material, per_cell

try:
    from ..rigid.mujoco_model import ContactParameters
    from ..rigid.rigid_stepper import RigidState, RigidStepper
except ImportError:
    raise InputError(
        'time.scheme = "rigid" needs mujoco, which this environment lacks: pip install fracsim[contact]'
    ) from None

if TYPE_CHECKING:
    from ..fracture.criterion import CellAverage
    from ..rigid.denting import DentedShape

Values = npt.NDArray[np.float64]


@dataclass
class RigidScene:
    """Objects that a run of rigid bodies needs.

    Attributes:
        study: that was built.
        mesh: of all instances, at the start.
        stepper: of the bodies.
        obstacles: of the study.
        initial_state: at t = 0.
        instance_mesh: mesh of one instance.
        poses: of the instances at rest.
    """

    study: Study
    mesh: MeshData
    stepper: RigidStepper
    obstacles: list[RigidObstacle]
    initial_state: RigidState
    instance_mesh: MeshData
    poses: InstancePoses

    def ended(self, state: RigidState) -> bool:
        """Return whether the state is at the end of the study."""
        return state.t >= self.study.time.end * (1 - 1e-12)


def build_rigid_scene(
    study: Study, comm: MPI.Comm = MPI.COMM_SELF, check_abort: Callable[[], None] | None = None
) -> RigidScene:
    """Return the scene of a study on rank 0, while the other ranks are in `serve_rigid_analyses`.

    Args:
        study: of rigid bodies.
        comm: ranks that share the analyses.
        check_abort: called before an analysis; raises StepAborted if the run is to stop.

    Raises:
        InputError: mesh, bodies and obstacles do not fit.
    """
    mesh = build_checked_mesh(study)
    _check_shell(study, mesh)
    placements = body_placements(study)
    instances = _build_instances(study, mesh, placements, check_abort)
    poses, density = InstancePoses.from_placements(placements), float(study.material.density)
    load = volume_loads(study, 3)
    gravity = load["gravity"](0.0) if "gravity" in load else np.zeros(3)
    contact, obstacles = study.contact or ContactSettings(), build_rigid_obstacles(study)
    parameters = ContactParameters(study.time.max_step, gravity, contact.friction, contact.restitution or 0.0)
    hertz = HertzContact(study.material.young, study.material.poisson)
    analyses = ParallelAnalyses(instances, comm, (study, mesh, placements))
    round_shape = RoundShape.of_mesh(mesh, getattr(find_builder(study.mesh), "round_solid", None))
    geometry = FragmentGeometry(mesh, poses, round_shape, LIMITS.max_shell_triangles)
    stepper = RigidStepper(
        instances, geometry, density, obstacles, parameters, hertz, contact.contact_time, analyses
    )  # fmt: skip
    state = stepper.start()
    _check_masses(state)
    state = _set_initial_motion(stepper, state, len(mesh.points), placements)
    _check_overlaps(stepper, state, obstacles, geometry.mean_edge)
    return RigidScene(study, place_mesh(mesh, placements), stepper, obstacles, state, mesh, poses)


def _set_initial_motion(
    stepper: RigidStepper, state: RigidState, nodes: int, placements: list[InstancePlacement]
) -> RigidState:
    """Return the state with the velocities of the placements; `nodes`: number of nodes of an instance."""
    count = stepper.fragment_count
    at_rest, free = state.bodies.select(slice(count)), state.bodies.select(slice(count, None))
    velocity, spin = instance_motion(stepper.shapes.names, nodes, at_rest.centre, at_rest.mass, placements)
    return replace(state, bodies=replace(at_rest, velocity=velocity, spin=spin).concatenate(free))


def serve_rigid_analyses(comm: MPI.Comm, check_abort: Callable[[], None] | None = None) -> None:
    """Analyse bodies on all ranks but the first, until rank 0 has finished.

    `check_abort`: as in `build_rigid_scene`.
    """

    def make(setup: tuple[Study, MeshData, list[InstancePlacement]]) -> Instances:
        return _build_instances(*setup, check_abort)

    serve_analyses(comm, make)


# --- bodies ---


def _build_instances(
    study: Study, mesh: MeshData, placements: list[InstancePlacement], check_abort: Callable[[], None] | None
) -> Instances:
    """Return the instances of a mesh, which share the operator of the unbroken body."""
    stiffness = _build_operator(study, mesh)
    average = build_average(study, stiffness.stress.domain)
    sizes = len(mesh.points), len(mesh.cells), len(MeshTopology(mesh).edges)

    def make(number: int, shape: DentedShape | None) -> BreakableBody:
        if study.plasticity is None:
            return _build_breakable(study, stiffness, average, number, check_abort)
        # a dented instance has an operator of its own
        operator = stiffness if shape is None else _build_operator(study, replace(mesh, points=shape.points))
        return _build_yielding(study, operator, shape, check_abort)  # type: ignore[arg-type]

    return Instances(make, InstancePoses.from_placements(placements), sizes)


def _build_operator(study: Study, mesh: MeshData) -> StiffnessOperator:
    """Return the stiffness operator of a mesh of solid cells or of a shell."""
    domain, density = distribute(MPI.COMM_SELF, mesh), float(study.material.density)
    elastic = build_material(study.model_copy(update={"plasticity": None}), domain)
    stress = Stress(VectorAssembler(domain), fem.Function(domain.space), elastic, DegradationModel("chi"))
    if mesh.shell is None:
        return SolidStiffness(stress, np.full(domain.cell_count, density))
    from ..rigid.shell_analysis import ShellStiffness

    return ShellStiffness(stress, mesh.shell, study.material.young, study.material.poisson, density)


def _build_yielding(
    study: Study, stiffness: SolidStiffness, shape: DentedShape | None, check_abort: Callable[[], None] | None
) -> BreakableBody:
    """Return an instance that blows dent; `shape`: after earlier blows, None before the first one."""
    from ..rigid.denting import PlasticDenting

    table, domain = study.plasticity, stiffness.stress.domain
    assert table is not None
    if shape is None:
        yield_stress = np.broadcast_to(per_cell(study, domain, table, "yield_stress"), domain.cell_count)
    else:
        yield_stress = shape.yield_stress[domain.input_numbering.cells]
    denting = PlasticDenting(stiffness, yield_stress, table.hardening)
    average = FragmentAverage(None, domain.cell_count)
    return BreakableBody(stiffness, EdgeGraph(domain), None, average, study.solver, denting, check_abort)


def _build_breakable(
    study: Study, stiffness: StiffnessOperator, average: CellAverage | None, number: int,
    check_abort: Callable[[], None] | None,
) -> BreakableBody:  # fmt: skip
    """Return the instance of a number that may break; the seeds of its grains and scatter depend on the number."""
    domain = stiffness.stress.domain
    graph, fragment_average = EdgeGraph(domain), FragmentAverage(average, domain.cell_count)
    criterion = None
    if study.brittle is not None:
        from ..fracture.brittle.surface_criterion import BrittleSurfaces

        strength = build_strength(study, domain, graph, number)
        rules = build_surface_parameters(study.brittle, domain.dim, number)
        criterion = BrittleSurfaces(stiffness.stress, graph, strength, fragment_average, rules)
    return BreakableBody(stiffness, graph, criterion, fragment_average, study.solver, check_abort=check_abort)


# --- checks ---


def _check_shell(study: Study, mesh: MeshData) -> None:
    """Raise InputError if the study asks for something that shells do not support."""
    if mesh.shell is None:
        return
    if study.brittle is not None and study.brittle.shape == "curved":
        raise InputError('brittle.shape = "curved" is not for shells: take "planar"')
    if study.plasticity is not None:
        raise InputError("[plasticity] is not for shells, which do not bend for good: remove it, or take a solid mesh")
    if study.material.regions:
        raise InputError("a shell is of one material: remove the regions of [material]")


def _check_masses(state: RigidState) -> None:
    """Raise InputError if a body has no mass."""
    bad = np.flatnonzero(state.bodies.mass <= 0)
    if len(bad):
        where = format_point(state.bodies.position[bad[0]])
        raise InputError(f"body {bad[0]} around {where} has no mass ({state.bodies.mass[bad[0]]:g} kg): its cells are "
                         "inside out or flat; mend the mesh")  # fmt: skip


def _check_overlaps(stepper: RigidStepper, state: RigidState, obstacles: list[RigidObstacle], edge: float) -> None:
    """Raise InputError if bodies overlap one another or an obstacle at the start; `edge`: mean edge, m."""
    # up to 1 % of the mean edge is admitted
    overlaps = [pair for pair in stepper.find_penetrations(state) if pair[2] > 0.01 * edge]
    if not overlaps:
        return

    def describe(number: int) -> str:
        count = stepper.fragment_count
        if number < count:
            return f"body {number} around {format_point(state.bodies.position[number])}"
        return f"obstacle {obstacles[stepper.obstacles.obstacle_of[number - count]].name}"

    first, second, depth = max(overlaps, key=lambda pair: pair[2])
    details = f" (one of {len(overlaps)} such pairs)" if len(overlaps) > 1 else ""
    raise InputError(
        f"{describe(first)} lies in {describe(second)} at the start, "
        f"by {depth:.3g} m as convex parts of them go{details}"
        ": move them apart (body.N.position, spacing, or `at` of the obstacle)"
    )
