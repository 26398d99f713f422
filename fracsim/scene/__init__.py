"""Scene: the objects that a study asks for, built and checked before anything is written.

Only this room turns the keys of a study into physics. The rooms below it take numbers, arrays and functions.

terms              material, terms of the balance of forces, and the balance
contact_terms      obstacles and self-contact
inelastic_updates  plastic flow and fracture, which follow a step
rigid_scene        rigid bodies
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..process import import_dolfinx, import_outside

# A script that imports this room takes no settings of PETSc or DOLFINx from the working folder, as the command does.
import_outside("mpi4py.MPI")
import_dolfinx()

from mpi4py import MPI  # noqa: E402

from ..forms.schemes import Scheme  # noqa: E402
from ..mechanics.balance import Balance  # noqa: E402
from ..mechanics.loads import DeadLoads  # noqa: E402
from ..mechanics.material_fields import MaterialFields  # noqa: E402
from ..mechanics.prescribed_motion import check_supports  # noqa: E402
from ..mesh.domain import Domain, distribute  # noqa: E402
from ..mesh.parallel import from_root, on_root  # noqa: E402
from ..mesh.selection import nearest_node, select_nodes  # noqa: E402
from ..meshes.data import MeshData  # noqa: E402
from ..output.history import ProbeGroup, ProbeReader  # noqa: E402
from ..solvers.nonlinear_solver import NonlinearSolver  # noqa: E402
from ..solvers.weak_callbacks import collect_dropped_scenes  # noqa: E402
from ..study import Study, TimeSettings, solver_options  # noqa: E402
from ..study.check import build_checked_mesh, check_initial_overlap, check_summary  # noqa: E402
from ..study.conditions import check_size, find_selector, initial_motion, obstacle_placements, step_size_function  # noqa: E402
from ..study.mesh_source import file_scale, find_shared_mesh  # noqa: E402
from ..study.mesh_summary import summarise_shared_mesh  # noqa: E402
from ..study.plugins import NO_PHYSICS, Physics, collect_physics  # noqa: E402
from ..timestepping.inelastic_update import FractureProtocol, NoFracture, PlasticFlowProtocol  # noqa: E402
from ..timestepping.state import State, initial_velocity  # noqa: E402
from ..timestepping.step_sizes import StepSizes  # noqa: E402
from ..timestepping.stepper import Stepper  # noqa: E402
from .inelastic_updates import build_flow, build_fracture_pass  # noqa: E402
from .terms import TERMS, TermInputs, build_balance, build_material  # noqa: E402

if TYPE_CHECKING:
    from ..fracture.fracture_pass import FracturePass as EdgeBreaking
    from ..mechanics.contour_integral import ContourIntegral
    from ..meshes.vtkhdf import FileMesh

__all__ = [
    "TERMS",
    "Scene",
    "TermInputs",
    "build_material",
    "build_scene",
    "build_scene_on",
    "make_scheme",
    "make_stepper",
]


@dataclass
class Scene:
    """Objects that a run of one deformable body needs.

    Attributes:
        study: that was built.
        domain: the distributed mesh.
        balance: of forces.
        solver: of implicit schemes; None for explicit ones.
        stepper: takes a state to the next one.
        fracture: what breaks edges; None without [fracture].
        probes: what history.csv records beside energies.
        physics: of the user, and plug-ins.
    """

    study: Study
    domain: Domain
    balance: Balance
    solver: NonlinearSolver | None
    stepper: Stepper
    fracture: EdgeBreaking | None
    probes: ProbeReader
    physics: Physics = NO_PHYSICS

    def start(self) -> State:
        """Return the state at t = 0 (collective)."""
        motion = initial_motion(self.study, self.domain.dim)
        return self.stepper.start(None if motion is None else initial_velocity(self.balance, *motion))

    def ended(self, state: State) -> bool:
        """Return whether the state is at the end of the study."""
        return state.t >= self.study.time.end * (1 - 1e-12)

    def destroy(self) -> None:
        """Free the memory of PETSc's objects (collective)."""
        if self.solver is not None:
            self.solver.destroy()
        self.balance.destroy()


def build_scene(
    comm: MPI.Comm,
    study: Study,
    stage: Callable[[str], None] = lambda name: None,
    *,
    given: MeshData | None = None,
    physics: Physics = NO_PHYSICS,
) -> Scene:
    """Return the scene of a study (collective).

    Args:
        comm: ranks that share the mesh.
        study: of one deformable body.
        stage: called with the name of each stage as it begins.
        given: mesh in place of that of [mesh], on rank 0.
        physics: of the user; plug-ins that the study names are added.

    Raises:
        InputError: mesh and study do not fit.
    """
    if physics is NO_PHYSICS and study.plugin_names:
        physics = collect_physics(study)
    stage("building the mesh" if study.mesh.builder else "reading the mesh")
    # rank 0 alone knows whether a mesh is given
    file = from_root(comm, lambda: find_shared_mesh(study.mesh) if given is None else None)
    domain = None if file is None else _domain_of_shares(comm, study, file, stage, physics)
    if domain is None:
        mesh = on_root(comm, lambda: build_checked_mesh(study, given, physics.boundary))
        stage(_distribution_stage(comm))
        domain = distribute(comm, mesh, study.mesh.order)
    return build_scene_on(domain, study, stage=stage, physics=physics)


def _distribution_stage(comm: MPI.Comm) -> str:
    return "sharing the mesh among ranks" if comm.size > 1 else "building the edges of the mesh"


def _domain_of_shares(
    comm: MPI.Comm, study: Study, file: FileMesh, stage: Callable[[str], None], physics: Physics
) -> Domain | None:
    """Return the domain of a mesh of which each rank reads its share; None: rank 0 builds or reads it (collective).

    Raises:
        InputError: mesh and study do not fit.
    """
    # imported here: other studies do not need it
    from ..mesh.mesh_shares import distribute_shares, read_share

    share = read_share(comm, file, file_scale(study.mesh))
    if share is None:
        return None
    bounds = share.bounds
    summary = summarise_shared_mesh(share.facet_groups, share.regions, bounds.lower, bounds.upper, share.cell_count)
    check_summary(study, summary, physics.boundary)
    stage(_distribution_stage(comm))
    domain = distribute_shares(comm, share)
    if study.obstacle:
        mesh = domain.input_mesh
        on_root(comm, lambda: None if mesh is None else check_initial_overlap(study, mesh))
    return domain


def build_scene_on(
    domain: Domain,
    study: Study,
    material: MaterialFields | None = None,
    *,
    stage: Callable[[str], None] = lambda name: None,
    physics: Physics = NO_PHYSICS,
) -> Scene:
    """Return the scene of a study on an existing mesh (collective).

    Args:
        domain: the distributed mesh.
        study: of one deformable body.
        material: in place of that of the study.
        stage: called with the name of each stage as it begins.
        physics: of the user.
    """
    stage("setting up the balance of forces (kernels are compiled the first time)")
    collect_dropped_scenes(domain.comm)
    scheme = make_scheme(study.time)
    balance = build_balance(study, domain, scheme, material or build_material(study, domain, physics.energy), physics)
    if not scheme.inertia:
        check_supports(domain, balance.motion)
    stage("setting up what breaks and what solves")
    flow = build_flow(study, balance)
    breaking = build_fracture_pass(study, balance, flow, physics)
    solver = None
    if scheme.implicit:
        options, plain = solver_options.without_plain(study.solver), solver_options.uses_plain_solver(study.solver)
        solver = NonlinearSolver(balance, options, plain=plain)
    breaks, frames = breaking or NoFracture(balance, flow), study.frame_interval
    stepper = make_stepper(balance, study.time, flow, breaks, solver, frames)
    placements = obstacle_placements(study, domain.dim)
    motions = {obstacle.name: obstacle.displacement for obstacle in placements if obstacle.displacement is not None}
    solves_again = breaking is not None and not scheme.inertia
    probes = ProbeReader(
        balance, _probes(study, domain), motions=motions, contours=_contours(study, balance), thickness=study.thickness,
        onset_reactions=(lambda: stepper.onset_reactions) if solves_again else None,
    )  # fmt: skip
    return Scene(study, domain, balance, solver, stepper, breaking, probes, physics)


def make_scheme(timing: TimeSettings) -> Scheme:
    """Return the time scheme of a study."""
    return timing.scheme_object


def make_stepper(
    balance: Balance,
    timing: TimeSettings,
    flow: PlasticFlowProtocol,
    breaking: FractureProtocol,
    solver: NonlinearSolver | None,
    frames: float = 0.0,
) -> Stepper:
    """Return the stepper for the scheme of a balance.

    Args:
        balance: of forces.
        timing: the table [time].
        flow: plastic flow.
        breaking: fracture.
        solver: of implicit schemes; None for explicit ones.
        frames: interval between times at which a step ends, s; 0: none.
    """
    smallest, course = timing.smallest or timing.min_step / 1024, step_size_function(timing)
    sizes = StepSizes(
        timing.max_step, timing.end, smallest, timing.adapt, timing.breaking_step or math.inf, course, frames
    )  # fmt: skip
    if solver is None:
        from ..timestepping.explicit import ExplicitStepper

        return ExplicitStepper(balance, sizes, flow, breaking)
    if balance.scheme.inertia:
        from ..timestepping.implicit import ImplicitStepper

        return ImplicitStepper(balance, sizes, flow, breaking, solver)
    from ..timestepping.quasi_static import QuasiStaticStepper

    return QuasiStaticStepper(balance, sizes, flow, breaking, solver)


def _probes(study: Study, domain: Domain) -> list[ProbeGroup]:
    """Return the entries of [[probe]] with their nodes (collective)."""
    probes = []
    for i, entry in enumerate(study.probe):
        if entry.quantity == "J":
            continue
        if entry.point is not None:
            key = f"probe.{i}.point"
            nodes = nearest_node(domain, check_size(entry.point, domain.dim, key), key)
        else:
            assert entry.on is not None
            key = f"probe.{i}.on"
            nodes = select_nodes(domain, find_selector(entry.on, domain.dim, key), key)
        probes.append(ProbeGroup(entry.name, entry.quantity, nodes))
    return probes


def _contours(study: Study, balance: Balance) -> dict[str, ContourIntegral]:
    """Return the J-integrals of [[probe]] by name (collective)."""
    contours = {}
    loads = [term for term in balance.terms if isinstance(term, DeadLoads)]
    volume_force = loads[0].volume_force if loads else None
    for i, entry in enumerate(study.probe):
        if entry.contour is not None:
            from ..mechanics.contour_integral import ContourIntegral

            assert entry.point is not None
            centre, key = check_size(entry.point, balance.domain.dim, f"probe.{i}.point"), f"probe.{i}.contour"
            contours[entry.name] = ContourIntegral(balance.stress, centre, entry.contour, key, volume_force)
    return contours
