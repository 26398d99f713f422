"""A study bound to its mesh: everything that a run moves, built and checked before anything is written."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

from .forms.schemes import Scheme
from .mechanics.balance import Equilibrium
from .mechanics.material import material_fields
from .mechanics.supports import check_supports
from .mesh.domain import Domain, distribute
from .mesh.ranks import on_root
from .output.history import Probes
from .stepping.implicit import Stepper
from .stepping.newton import Solver
from .study import Study, Time
from .study.check import checked_mesh


@dataclass
class Scene:
    """A study bound to its mesh: what a run moves."""

    study: Study
    domain: Domain
    equations: Equilibrium
    solver: Solver | None  # None: explicit
    stepper: Stepper
    fracture: Any  # FracturePass | None
    probes: Probes


def build_scene(comm: MPI.Comm, study: Study) -> Scene:
    """Mesh, equations, solver and, where the study has them, fracture and probes. InputError where they do not fit."""
    domain = distribute(comm, on_root(comm, lambda: checked_mesh(study)))
    scheme = make_scheme(study.time)
    material = material_fields(domain, study.material)
    if study.plasticity is not None:
        from .mechanics.plasticity import plastic_material

        material = plastic_material(domain, study, material)
    equations = Equilibrium(domain, study, material, scheme)
    if not scheme.inertia:
        check_supports(domain, equations.motion)
    fracture = None
    if study.fracture is not None:
        from .fracture.breaking import FracturePass

        fracture = FracturePass(equations, study.fracture, study.material, study.brittle)
    solver = Solver(equations, study.solver) if scheme.implicit else None
    stepper = make_stepper(equations, solver, study.time, fracture)
    if study.plasticity is not None:
        from .mechanics.return_mapping import Flow

        stepper.flow = Flow(equations)
    return Scene(study, domain, equations, solver, stepper, fracture, Probes(equations, study.probe))


def make_scheme(timing: Time) -> Scheme:
    """The time scheme of a study."""
    return timing.kind(**timing.parameters)


def make_stepper(equations: Equilibrium, solver: Solver | None, timing: Time, fracture: Any) -> Stepper:
    """The stepper of an implicit or explicit scheme."""
    if solver is not None:
        return Stepper(equations, solver, timing, fracture)
    from .stepping.explicit import ExplicitStepper

    return ExplicitStepper(equations, None, timing, fracture)
