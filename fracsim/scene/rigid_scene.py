"""A study of rigid bodies bound to its mesh; on one rank."""

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
from ..meshes.data import MeshData
from ..meshes.text import format_point
from ..rigid.breakage import Breakable, Operator, Within
from ..rigid.fragment_geometry import Geometry
from ..rigid.free_body_analysis import Stiffness
from ..rigid.hertz import Hertz
from ..rigid.instance_placement import Place, Poses, motion, placed
from ..rigid.instances import Copies
from ..rigid.parallel_analyses import Analyses, serve
from ..rigid.worker_ranks import lent
from ..study import ContactSettings, Study
from ..study.check import build_checked_mesh
from ..study.conditions import volume_loads
from ..study.overlap_checks import body_placements
from .contact_terms import every_obstacle
from .inelastic_updates import average_of, strength_of, surface_rules
from .material_model import material_of, per_cell

try:
    from ..rigid.mujoco_model import Rules
    from ..rigid.rigid_stepper import RigidState, RigidStepper
except ImportError:
    raise InputError(
        'time.scheme = "rigid" needs mujoco, which this environment lacks: pip install fracsim[contact]'
    ) from None

if TYPE_CHECKING:
    from ..fracture.criterion import CellAverage
    from ..rigid.denting import Shape

Values = npt.NDArray[np.float64]

DEEP = 0.01  # of the mean edge: bodies that lie in one another by more at the start are refused


@dataclass
class RigidScene:
    """What a run of rigid bodies moves.

    Attributes:
        mesh: of all bodies, where they are at the start.    obstacles: what stands in their way.
        first: the state at t = 0.    made_of: the mesh of a copy, and where copies are at rest.
    """

    study: Study
    mesh: MeshData
    stepper: RigidStepper
    obstacles: list[RigidObstacle]
    first: RigidState
    made_of: tuple[MeshData, Poses]

    def ended(self, state: RigidState) -> bool:
        """Whether the state is at the end of the study."""
        return state.t >= self.study.time.end * (1 - 1e-12)


def build_rigid_scene(
    study: Study, comm: MPI.Comm = MPI.COMM_SELF, heed: Callable[[], None] | None = None
) -> RigidScene:
    """Mesh, bodies, obstacles and engine, on rank 0; the others `help_rigid`. InputError where they do not fit. `heed`:
    is called before an analysis, and raises Abandoned where the run is to stop."""
    single = build_checked_mesh(study)
    _check_shell(study, single)
    places = body_placements(study)
    copies, poses, density = _copies(study, single, places, heed), Poses.of(places), float(study.material.density)
    load = volume_loads(study, 3)
    gravity = load["gravity"](0.0) if "gravity" in load else np.zeros(3)
    contact, obstacles = study.contact or ContactSettings(), every_obstacle(study)
    rules = Rules(study.time.max_step, gravity, contact.friction, contact.restitution or 0.0)
    hertz = Hertz(study.material.young, study.material.poisson)
    analyses = Analyses(copies, comm, (study, single, places))
    geometry = Geometry(single, poses)
    time, helper = contact.contact_time, lent(comm)
    stepper = RigidStepper(copies, geometry, density, obstacles, rules, hertz, time, analyses, helper)
    first = stepper.start()
    _check_masses(first)
    at_rest, free = first.bodies.part(slice(stepper.count)), first.bodies.part(slice(stepper.count, None))
    velocity, spin = motion(stepper.shapes.names, len(single.points), at_rest.centre, at_rest.mass, places)
    first = replace(first, bodies=replace(at_rest, velocity=velocity, spin=spin).with_more(free))
    _check_room(stepper, first, obstacles, geometry.mean_edge)
    return RigidScene(study, placed(single, places), stepper, obstacles, first, (single, poses))


def help_rigid(comm: MPI.Comm, heed: Callable[[], None] | None = None) -> None:
    """On all ranks but the first: analyse bodies, until it lets go; `heed` as there."""

    def made(begin: tuple[Study, MeshData, list[Place]]) -> Copies:
        return _copies(*begin, heed)

    serve(comm, made)


def _copies(study: Study, mesh: MeshData, places: list[Place], heed: Callable[[], None] | None) -> Copies:
    """Of the mesh, in its own axes."""
    stiffness = _operator(study, mesh)
    average = average_of(study, stiffness.stress.domain)
    sizes = len(mesh.points), len(mesh.cells), len(MeshTopology(mesh).edges)

    def made(number: int, shape: Shape | None) -> Breakable:
        if study.plasticity is None:
            return _breakable(study, stiffness, average, number, heed)
        own = stiffness if shape is None else _operator(study, replace(mesh, points=shape.points))
        return _flowing(study, own, shape, heed)  # type: ignore[arg-type]

    return Copies(made, Poses.of(places), sizes)


def _operator(study: Study, mesh: MeshData) -> Operator:
    """Of all cells of a mesh."""
    domain, density = distribute(MPI.COMM_SELF, mesh), float(study.material.density)
    elastic = material_of(study.model_copy(update={"plasticity": None}), domain)
    stress = Stress(VectorAssembler(domain), fem.Function(domain.space), elastic, DegradationModel("chi"))
    if mesh.shell is None:
        return Stiffness(stress, np.full(domain.cell_count, density))
    from ..rigid.shell_analysis import ShellStiffness

    return ShellStiffness(stress, mesh.shell, study.material.young, study.material.poisson, density)


def _flowing(study: Study, stiffness: Stiffness, shape: Shape | None, heed: Callable[[], None] | None) -> Breakable:
    """A copy of the mesh that blows dent."""
    from ..rigid.denting import Flow

    table, domain = study.plasticity, stiffness.stress.domain
    assert table is not None
    if shape is None:
        yields = np.broadcast_to(per_cell(study, domain, table, "yield_stress"), domain.cell_count)
    else:
        yields = shape.yields[domain.cell_input]
    flow, within = Flow(stiffness, yields, table.hardening), Within(None, domain.cell_count)
    return Breakable(stiffness, EdgeGraph(domain), None, within, study.solver, flow, heed)


def _breakable(
    study: Study, stiffness: Operator, average: CellAverage | None, number: int, heed: Callable[[], None] | None
) -> Breakable:
    """A copy of the mesh, with what breaks of it. Chance differs from copy to copy."""
    domain = stiffness.stress.domain
    graph, within = EdgeGraph(domain), Within(average, domain.cell_count)
    criterion = None
    if study.brittle is not None:
        from ..fracture.brittle.surface_criterion import BrittleSurfaces

        strength, rules = strength_of(study, domain, graph, number), surface_rules(study.brittle, number)
        criterion = BrittleSurfaces(stiffness.stress, graph, strength, within, rules)
    return Breakable(stiffness, graph, criterion, within, study.solver, heed=heed)


def _check_shell(study: Study, mesh: MeshData) -> None:
    """InputError where a shell is asked for what shells do not have."""
    if mesh.shell is None:
        return
    if study.brittle is not None and study.brittle.shape == "curved":
        raise InputError('brittle.shape = "curved" is not for shells: take "planar"')
    if study.plasticity is not None:
        raise InputError("[plasticity] is not for shells, which do not bend for good: remove it, or take a solid mesh")
    if study.material.regions:
        raise InputError("a shell is of one material: remove the regions of [material]")


def _check_masses(state: RigidState) -> None:
    bad = np.flatnonzero(state.bodies.mass <= 0)
    if len(bad):
        where = format_point(state.bodies.place[bad[0]])
        raise InputError(f"body {bad[0]} around {where} has no mass ({state.bodies.mass[bad[0]]:g} kg): its cells are "
                         "inside out or flat; mend the mesh")  # fmt: skip


def _check_room(stepper: RigidStepper, state: RigidState, obstacles: list[RigidObstacle], edge: float) -> None:
    """InputError where bodies lie in one another, or in an obstacle, at the start."""
    found = [each for each in stepper.depths(state) if each[2] > DEEP * edge]
    if not found:
        return
    first, second, depth = max(found, key=lambda each: each[2])
    what, other = (
        f"body {thing} around {format_point(state.bodies.place[thing])}" if thing < stepper.count
        else f"obstacle {obstacles[stepper.others.owner[thing - stepper.count]].name}" for thing in (first, second)
    )  # fmt: skip
    more = f" (one of {len(found)} such pairs)" if len(found) > 1 else ""
    raise InputError(
        f"{what} lies in {other} at the start, by {depth:.3g} m as convex parts of them go{more}: move them apart "
        "(body.N.position, spacing, or `at` of the obstacle)"
    )
