"""The balance of forces that a study asks for: which terms, and what they are made from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from ufl.core.expr import Expr

from ..forms.schemes import Scheme
from ..mechanics.balance import Balance
from ..mechanics.inertia import ConsistentMass, Inertia, LumpedMass, MassMatrix
from ..mechanics.loads import DeadLoads, OnFacets, Pressure, surface_area
from ..mechanics.material_fields import MaterialFields, coefficient
from ..mechanics.matrix_assembly import VectorAssembler
from ..mechanics.prescribed_motion import PrescribedMotion
from ..mechanics.stress import RESIDUAL_STIFFNESS, DegradationModel, Stress
from ..mechanics.term import Term
from ..mechanics.time_functions import TimeFunction
from ..mesh.domain import Domain
from ..study import Study
from ..study.conditions import BoundaryCondition, boundary_conditions, volume_loads


@dataclass(frozen=True)
class TermInputs:
    """What terms of the balance are made from.

    Attributes:
        u: the displacement.    density: kg/m^3, a UFL coefficient.    stress, mass, motion: see mechanics.balance.
        conditions: the entries of [[boundary]].
    """

    study: Study
    scheme: Scheme
    assembler: VectorAssembler
    u: fem.Function
    density: Expr
    stress: Stress
    mass: MassMatrix
    motion: PrescribedMotion
    conditions: list[BoundaryCondition]

    @property
    def domain(self) -> Domain:
        return self.assembler.domain

    def on_facets(self, kind: str) -> list[OnFacets]:
        """Facets and function of time of each condition of a kind."""
        of_kind = [each for each in self.conditions if each.kind == kind]
        return [(self.domain.select_facets(each.selector, f"{each.key}.on"), each.function) for each in of_kind]


def _viscosity(parts: TermInputs) -> Term | None:
    damping = parts.study.damping
    if damping is None or not damping.stiffness:
        return None
    from ..mechanics.damping import Viscosity

    return Viscosity(parts.assembler, parts.u, parts.stress, damping.stiffness)


def _pressure(parts: TermInputs) -> Term | None:
    pressures = parts.on_facets("pressure")
    linear = parts.stress.material.energy.linear
    return Pressure(parts.assembler, parts.u, pressures, linear=linear) if pressures else None


def _dead_loads(parts: TermInputs) -> Term | None:
    tractions, on_volume = [*parts.on_facets("traction"), *_spread(parts)], volume_loads(parts.study, parts.domain.dim)
    if not tractions and not on_volume:
        return None
    gravity = (parts.density, on_volume["gravity"]) if "gravity" in on_volume else None
    body_force = on_volume.get("body_force")
    return DeadLoads(parts.assembler, parts.u, tractions=tractions, gravity=gravity, body_force=body_force)


def _spread(parts: TermInputs) -> list[OnFacets]:
    """Forces as tractions on the area of their facets (collective)."""
    return [(facets, _shared(force, surface_area(parts.domain, facets))) for facets, force in parts.on_facets("force")]


def _shared(force: TimeFunction, area: float) -> TimeFunction:
    return lambda t: np.asarray(force(t) / area)


def _obstacles(parts: TermInputs) -> Term | None:
    if all(each.shape == "mesh" for each in parts.study.obstacle):
        return None
    from .contact_terms import build_explicit_obstacle_term, build_obstacle_term

    if not parts.scheme.implicit:
        return build_explicit_obstacle_term(parts.study, parts.domain, parts.u, parts.stress, parts.mass.lumped)
    return build_obstacle_term(parts.study, parts.domain, parts.u, parts.stress.material, parts.scheme)


def _solids(parts: TermInputs) -> Term | None:
    if not any(each.shape == "mesh" for each in parts.study.obstacle):
        return None
    from .contact_terms import build_mesh_obstacle_term

    return build_mesh_obstacle_term(parts.study, parts.domain, parts.u, parts.stress.material, parts.scheme)


def _contact(parts: TermInputs) -> Term | None:
    if parts.study.contact is None or not parts.study.contact.itself:
        return None
    from .contact_terms import build_explicit_self_contact_term, build_self_contact_term

    if not parts.scheme.implicit:
        return build_explicit_self_contact_term(parts.study, parts.domain, parts.u, parts.stress, parts.mass.lumped)
    return build_self_contact_term(parts.study, parts.domain, parts.u, parts.stress.material)


def _tethers(parts: TermInputs) -> Term | None:
    fracture = parts.study.fracture
    if fracture is None or fracture.crumbs or fracture.approach != "chi" or parts.domain.order > 1:
        return None
    from ..mechanics.node_ties import NodeTies

    domain = parts.domain
    young = domain.comm.allreduce(float(np.max(parts.stress.material.young, initial=0.0)), op=MPI.MAX)
    return NodeTies(domain, parts.u, young, parts.mass.lumped, parts.motion.prescribed_nodes)


def _inertia(parts: TermInputs) -> Term | None:
    return Inertia(parts.u, parts.mass) if parts.scheme.inertia else None


def _drag(parts: TermInputs) -> Term | None:
    damping = parts.study.damping
    if damping is None or not damping.mass:
        return None
    from ..mechanics.damping import Drag

    return Drag(parts.u, parts.mass, damping.mass)


# What may add to the balance beside the stress, in this order. A new term has its line here.
TERMS: dict[str, Callable[[TermInputs], Term | None]] = {
    "viscosity": _viscosity,
    "pressure": _pressure,
    "dead loads": _dead_loads,
    "obstacles": _obstacles,
    "solids": _solids,
    "contact": _contact,
    "tethers": _tethers,
    "inertia": _inertia,
    "drag": _drag,
}


def build_balance(study: Study, domain: Domain, scheme: Scheme, material: MaterialFields) -> Balance:
    """The balance of a body of this material (collective). InputError where a place selects nothing."""
    assembler, u = VectorAssembler(domain), fem.Function(domain.space, name="displacement")
    entries = boundary_conditions(study, domain.dim)
    moved = [each for each in entries if each.prescribes_motion]
    nodes = [domain.select_nodes(each.selector, f"{each.key}.on") for each in moved]
    motion = PrescribedMotion(
        domain, [(at, each.components, each.function) for at, each in zip(nodes, moved, strict=True)]
    )
    density = coefficient(domain, material.density)
    mass: MassMatrix = LumpedMass(assembler, density)
    if study.time.mass == "consistent":
        mass = ConsistentMass(assembler, density, motion.bcs)
    fracture, floor = study.fracture, 0.0 if scheme.inertia else RESIDUAL_STIFFNESS
    weakening = None if fracture is None else DegradationModel(fracture.approach, fracture.unilateral)
    stress = Stress(assembler, u, material, weakening, floor=floor)
    parts = TermInputs(study, scheme, assembler, u, density, stress, mass, motion, entries)
    others = [term for make in TERMS.values() if (term := make(parts)) is not None]
    return Balance(assembler, u, [stress, *others], motion, mass, scheme, study.time.max_step)
