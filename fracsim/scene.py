"""A study bound to its mesh: everything that a run moves, built and checked before anything is written.

Here alone a study becomes physics: below this module nothing knows of study files.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from dolfinx import fem
from mpi4py import MPI
from ufl.core.expr import Expr

from .forms.schemes import Scheme
from .mechanics.balance import Balance
from .mechanics.inertia import ConsistentMass, Inertia, LumpedMass, Mass
from .mechanics.loads import DeadLoads, OnFacets, Pressure
from .mechanics.material import MaterialFields, coefficient, material_fields
from .mechanics.prescribed_motion import Entry, PrescribedMotion
from .mechanics.stress import RESIDUAL_STIFFNESS, Stress, Weakening
from .mechanics.supports import check_supports
from .mechanics.term import Term
from .mechanics.time_functions import Values, in_time, motion_function, of_size
from .mechanics.vectors import Assembler
from .mesh.domain import Domain, distribute
from .mesh.ranks import on_root
from .output.history import Probes
from .stepping.after_step import Breaking, Flow, NoFlow, Unbreakable
from .stepping.initial import initial_velocity
from .stepping.newton import Solver
from .stepping.state import State
from .stepping.stepper import Stepper, StepSizes
from .study import MOTIONS, Study, Time
from .study.check import checked_mesh

if TYPE_CHECKING:
    from .fracture.breaking import Breaking as EdgeBreaking
    from .fracture.criterion import Criterion
    from .mesh.edges import EdgeGraph


@dataclass(frozen=True)
class Parts:
    """What terms of the balance are made from.

    Attributes:
        u: the displacement.    density: kg/m^3, a UFL coefficient.    stress, mass, motion: see mechanics.balance.
    """

    study: Study
    scheme: Scheme
    assembler: Assembler
    u: fem.Function
    density: Expr
    stress: Stress
    mass: Mass
    motion: PrescribedMotion

    @property
    def domain(self) -> Domain:
        return self.assembler.domain


@dataclass
class Scene:
    """A study bound to its mesh: what a run moves.

    Attributes:
        solver: of implicit schemes; None for explicit ones.    fracture: what breaks; None where nothing does.
    """

    study: Study
    domain: Domain
    balance: Balance
    solver: Solver | None
    stepper: Stepper
    fracture: EdgeBreaking | None
    probes: Probes

    def start(self) -> State:
        """The state at t = 0 (collective)."""
        return self.stepper.start(_initial_velocity(self.study, self.balance))

    def ended(self, state: State) -> bool:
        """Whether the state is at the end of the study."""
        return state.t >= self.study.time.end * (1 - 1e-12)

    def destroy(self) -> None:
        """Give the memory of PETSc's objects back (collective)."""
        if self.solver is not None:
            self.solver.destroy()
        self.balance.destroy()


def build_scene(comm: MPI.Comm, study: Study) -> Scene:
    """Mesh, balance, solver and, where the study has them, fracture and probes. InputError where they do not fit."""
    return scene_on(distribute(comm, on_root(comm, lambda: checked_mesh(study))), study)


def scene_on(domain: Domain, study: Study, material: MaterialFields | None = None) -> Scene:
    """The scene of a study on a mesh that is there; `material`: in place of the study's own."""
    scheme = make_scheme(study.time)
    balance = _balance(study, domain, scheme, material or _material(study, domain))
    if not scheme.inertia:
        check_supports(domain, balance.motion)
    flow = _flow(study, balance)
    breaking = _breaking(study, balance, scheme)
    solver = Solver(balance, study.solver) if scheme.implicit else None
    stepper = make_stepper(balance, study.time, flow, breaking or Unbreakable(balance, flow), solver)
    return Scene(study, domain, balance, solver, stepper, breaking, Probes(balance, study.probe))


# --- the balance ----------------------------------------------------------------------------------------------------


def _viscosity(parts: Parts) -> Term | None:
    damping = parts.study.damping
    if damping is None or not damping.stiffness:
        return None
    from .mechanics.damping import Viscosity

    return Viscosity(parts.assembler, parts.u, parts.stress, damping.stiffness)


def _pressure(parts: Parts) -> Term | None:
    pressures = _on_facets(parts, "pressure", 1)
    linear = parts.stress.material.energy.linear
    return Pressure(parts.assembler, parts.u, pressures, linear=linear) if pressures else None


def _dead_loads(parts: Parts) -> Term | None:
    load, d = parts.study.load, parts.domain.dim
    tractions = _on_facets(parts, "traction", d)
    gravity = body_force = None
    if load is not None and load.gravity is not None:
        gravity = parts.density, in_time(load.gravity, "load.gravity", d)
    if load is not None and load.body_force is not None:
        body_force = in_time(load.body_force, "load.body_force", d)
    if not tractions and gravity is None and body_force is None:
        return None
    return DeadLoads(parts.assembler, tractions=tractions, gravity=gravity, body_force=body_force)


def _inertia(parts: Parts) -> Term | None:
    return Inertia(parts.u, parts.mass) if parts.scheme.inertia else None


def _drag(parts: Parts) -> Term | None:
    damping = parts.study.damping
    if damping is None or not damping.mass:
        return None
    from .mechanics.damping import Drag

    return Drag(parts.u, parts.mass, damping.mass)


# What may add to the balance beside the stress, in this order. A new term has its line here.
TERMS: dict[str, Callable[[Parts], Term | None]] = {
    "viscosity": _viscosity,
    "pressure": _pressure,
    "dead loads": _dead_loads,
    "inertia": _inertia,
    "drag": _drag,
}


def _balance(study: Study, domain: Domain, scheme: Scheme, material: MaterialFields) -> Balance:
    assembler, u = Assembler(domain), fem.Function(domain.space, name="displacement")
    motion = PrescribedMotion(domain, _motions(study, domain))
    density = coefficient(domain, material.density)
    mass: Mass = LumpedMass(assembler, density)
    if study.time.mass == "consistent":
        mass = ConsistentMass(assembler, density, motion.bcs)
    fracture, floor = study.fracture, 0.0 if scheme.inertia else RESIDUAL_STIFFNESS
    weakening = None if fracture is None else Weakening(fracture.approach, fracture.unilateral)
    stress = Stress(assembler, u, material, weakening, floor=floor)
    parts = Parts(study, scheme, assembler, u, density, stress, mass, motion)
    others = [term for make in TERMS.values() if (term := make(parts)) is not None]
    return Balance(assembler, u, [stress, *others], motion, mass, scheme, study.time.step)


def _motions(study: Study, domain: Domain) -> list[Entry]:
    """Entries of PrescribedMotion."""
    entries = []
    for i, boundary in enumerate(study.boundary):
        if boundary.kind in MOTIONS:
            function, components = motion_function(boundary, domain.dim, f"boundary.{i}")
            entries.append((domain.nodes_of(boundary.on, f"boundary.{i}.on"), components, function))
    return entries


def _on_facets(parts: Parts, kind: str, size: int) -> list[OnFacets]:
    """Facets and function of time of each [[boundary]] entry of a kind."""
    return [
        (
            parts.domain.facets_of(entry.on, f"boundary.{i}.on"),
            in_time(getattr(entry, kind), f"boundary.{i}.{kind}", size),
        )
        for i, entry in enumerate(parts.study.boundary)
        if entry.kind == kind
    ]


def _material(study: Study, domain: Domain) -> MaterialFields:
    material = material_fields(domain, study.material)
    if study.plasticity is None:
        return material
    from .mechanics.plasticity import plastic_material

    return plastic_material(domain, study, material)


# --- what happens after a step --------------------------------------------------------------------------------------


def _flow(study: Study, balance: Balance) -> Flow:
    if study.plasticity is None:
        return NoFlow()
    from .mechanics.return_mapping import ReturnMapping

    return ReturnMapping(balance.stress)


def _breaking(study: Study, balance: Balance, scheme: Scheme) -> EdgeBreaking | None:
    """What breaks; None without [fracture]."""
    if study.fracture is None:
        return None
    from .fracture.breaking import Breaking
    from .mesh.edges import EdgeGraph

    graph = EdgeGraph(balance.domain)
    passes = study.fracture.passes
    if passes is None and scheme.inertia:
        passes = 1
    return Breaking(balance.stress, graph, _criterion(study, balance.stress, graph), passes=passes)


def _criterion(study: Study, stress: Stress, graph: EdgeGraph) -> Criterion:
    """Which edges fail."""
    from .fracture.criterion import OverloadedEdges
    from .fracture.strength import Strength

    assert study.fracture is not None
    strength = Strength(graph, study.fracture, study.material)
    average = None
    if study.fracture.radius:
        from .fracture.nonlocal_average import NonlocalAverage

        average = NonlocalAverage(stress.domain, study.fracture.radius, study.fracture.kernel)
    if study.brittle is None:
        return OverloadedEdges(stress, graph, strength, average, study.fracture.cap)
    from .fracture.brittle.surfaces import BrittleSurfaces

    return BrittleSurfaces(stress, graph, strength, average, study.brittle)


# --- steps ----------------------------------------------------------------------------------------------------------


def make_scheme(timing: Time) -> Scheme:
    """The time scheme of a study."""
    return timing.kind(**timing.parameters)


def make_stepper(balance: Balance, timing: Time, flow: Flow, breaking: Breaking, solver: Solver | None) -> Stepper:
    """What steps a balance of this scheme."""
    sizes = StepSizes(timing.step, timing.end, timing.smallest or timing.step / 1024, timing.adapt)
    if solver is None:
        from .stepping.explicit import ExplicitStepper

        return ExplicitStepper(balance, sizes, flow, breaking)
    if balance.scheme.inertia:
        from .stepping.implicit import ImplicitStepper

        return ImplicitStepper(balance, sizes, flow, breaking, solver)
    from .stepping.quasi_static import QuasiStaticStepper

    return QuasiStaticStepper(balance, sizes, flow, breaking, solver)


def _initial_velocity(study: Study, balance: Balance) -> Values | None:
    initial, d = study.initial, balance.domain.dim
    if initial is None:
        return None
    velocity = None if initial.velocity is None else of_size(initial.velocity, d, "initial.velocity")
    spin = None if initial.spin is None else of_size(initial.spin, 1 if d == 2 else 3, "initial.spin")
    return initial_velocity(balance, velocity, spin)
