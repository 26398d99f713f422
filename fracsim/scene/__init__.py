"""A study bound to its mesh: everything that a run moves, built and checked before anything is written.

Here alone a study becomes physics: what lies below this room takes numbers, arrays and functions.

material_model     the energy, its moduli and the yield law
terms              what adds to the balance of forces, and the balance
contact_terms      obstacles, and how they act
inelastic_updates  what flows and what breaks after a step
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..process import import_dolfinx, import_outside

# A script that imports this room takes no settings of PETSc or DOLFINx from the working folder, as the command does.
import_outside("mpi4py.MPI")
import_dolfinx(whole=True)

from mpi4py import MPI  # noqa: E402

from ..forms.schemes import Scheme  # noqa: E402
from ..mechanics.balance import Balance  # noqa: E402
from ..mechanics.material_fields import MaterialFields  # noqa: E402
from ..mechanics.prescribed_motion import check_supports  # noqa: E402
from ..mesh.domain import Domain, distribute  # noqa: E402
from ..mesh.parallel import on_root  # noqa: E402
from ..output.history import ProbeGroup, ProbeReader  # noqa: E402
from ..solvers.nonlinear_solver import NonlinearSolver  # noqa: E402
from ..solvers.weak_callbacks import collect_dropped_scenes  # noqa: E402
from ..study import Study, TimeSettings  # noqa: E402
from ..study.check import build_checked_mesh  # noqa: E402
from ..study.conditions import check_size, find_selector, initial_motion, obstacle_placements, step_size_function  # noqa: E402
from ..timestepping.initial_conditions import initial_velocity  # noqa: E402
from ..timestepping.protocols import FractureProtocol, NoFracture, PlasticFlowProtocol  # noqa: E402
from ..timestepping.state import State  # noqa: E402
from ..timestepping.stepper import Stepper, StepSizes  # noqa: E402
from .inelastic_updates import breaking_of, flow_of  # noqa: E402
from .material_model import material_of  # noqa: E402
from .terms import TERMS, Parts, balance_of  # noqa: E402

if TYPE_CHECKING:
    from ..fracture.fracture_pass import FracturePass as EdgeBreaking

__all__ = ["TERMS", "Parts", "Scene", "build_scene", "make_scheme", "make_stepper", "material_of", "scene_on"]


@dataclass
class Scene:
    """A study bound to its mesh: what a run moves.

    Attributes:
        solver: of implicit schemes; None for explicit ones.    fracture: what breaks; None where nothing does.
    """

    study: Study
    domain: Domain
    balance: Balance
    solver: NonlinearSolver | None
    stepper: Stepper
    fracture: EdgeBreaking | None
    probes: ProbeReader

    def start(self) -> State:
        """The state at t = 0 (collective)."""
        motion = initial_motion(self.study, self.domain.dim)
        return self.stepper.start(None if motion is None else initial_velocity(self.balance, *motion))

    def ended(self, state: State) -> bool:
        """Whether the state is at the end of the study."""
        return state.t >= self.study.time.end * (1 - 1e-12)

    def destroy(self) -> None:
        """Give the memory of PETSc's objects back (collective)."""
        if self.solver is not None:
            self.solver.destroy()
        self.balance.destroy()


def build_scene(comm: MPI.Comm, study: Study, stage: Callable[[str], None] = lambda name: None) -> Scene:
    """Mesh, balance, solver and, where the study has them, fracture and probes. InputError where they do not fit.

    `stage`: is told what is done from now on (collective).
    """
    stage("building the mesh" if study.mesh.builder else "reading the mesh")
    mesh = on_root(comm, lambda: build_checked_mesh(study))
    stage("sharing the mesh among ranks" if comm.size > 1 else "building the edges of the mesh")
    return scene_on(distribute(comm, mesh, study.mesh.order), study, stage=stage)


def scene_on(
    domain: Domain,
    study: Study,
    material: MaterialFields | None = None,
    *,
    stage: Callable[[str], None] = lambda name: None,
) -> Scene:
    """The scene of a study on a mesh that is there; `material`: in place of the study's own; `stage`: as above."""
    stage("setting up the balance of forces (kernels are compiled the first time)")
    collect_dropped_scenes(domain.comm)
    scheme = make_scheme(study.time)
    balance = balance_of(study, domain, scheme, material or material_of(study, domain))
    if not scheme.inertia:
        check_supports(domain, balance.motion)
    stage("setting up what breaks and what solves")
    flow = flow_of(study, balance)
    breaking = breaking_of(study, balance)
    solver = NonlinearSolver(balance, study.solver) if scheme.implicit else None
    breaks, frames = breaking or NoFracture(balance, flow), study.frame_interval
    stepper = make_stepper(balance, study.time, flow, breaks, solver, frames)
    ways = {
        each.name: each.displacement for each in obstacle_placements(study, domain.dim) if each.displacement is not None
    }
    probes = ProbeReader(balance, _probes(study, domain), motions=ways, thickness=study.thickness)
    return Scene(study, domain, balance, solver, stepper, breaking, probes)


def make_scheme(timing: TimeSettings) -> Scheme:
    """The time scheme of a study."""
    return timing.scheme_class(**timing.scheme_parameters)


def make_stepper(
    balance: Balance,
    timing: TimeSettings,
    flow: PlasticFlowProtocol,
    breaking: FractureProtocol,
    solver: NonlinearSolver | None,
    frames: float = 0.0,
) -> Stepper:
    """What steps a balance of this scheme; `frames`: s between times at which steps end, 0: they need not."""
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
    """[[probe]] entries with the nodes that they look at."""
    probes = []
    for i, entry in enumerate(study.probe):
        if entry.point is not None:
            key = f"probe.{i}.point"
            nodes = domain.nearest_node(check_size(entry.point, domain.dim, key), key)
        else:
            assert entry.on is not None
            key = f"probe.{i}.on"
            nodes = domain.select_nodes(find_selector(entry.on, domain.dim, key), key)
        probes.append(ProbeGroup(entry.name, entry.quantity, nodes))
    return probes
