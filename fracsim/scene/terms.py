"""Material, terms of the balance of forces, and the balance of a study."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI
from ufl.core.expr import Expr

from ..errors import InputError
from ..forms.schemes import Scheme
from ..mechanics.balance import Balance
from ..mechanics.inertia import ConsistentMass, Inertia, LumpedMass, MassMatrix
from ..mechanics.kernel_selection import KernelSelection
from ..mechanics.loads import DeadLoads, OnFacets, Pressure, surface_area, surface_measures
from ..mechanics.material_fields import MaterialFields, PerCell, coefficient, material_fields, parameter_by_region
from ..mechanics.matrix_assembly import VectorAssembler
from ..mechanics.prescribed_motion import Entry, PrescribedMotion
from ..mechanics.stress import RESIDUAL_STIFFNESS, DegradationModel, Stress
from ..mechanics.term import Term
from ..mechanics.time_functions import PlacedFunction, PlaceFunction, TimeFunction
from ..mesh.domain import Domain
from ..mesh.parallel import sum_over_ranks
from ..mesh.selection import select_facets, select_nodes
from ..mesh.selectors import Group, check_regions
from ..meshes.data import AXES
from ..study import Study, solver_options
from ..study.conditions import (
    BoundaryCondition,
    boundary_conditions,
    condition_notes,
    loaded_components,
    volume_loads,
)
from ..study.plugins import NO_PHYSICS, Physics, PhysicsPart

# --- material ---


def build_material(study: Study, domain: Domain, energy: PhysicsPart | None = None) -> MaterialFields:
    """Return the material of a study (collective). Raises InputError if the mesh lacks a region of it.

    `energy`: of the user, in place of that of the study.
    """
    table = study.material
    check_regions(table.regions, domain.region_names)
    young, poisson, density = (per_cell(study, domain, table, key) for key in ("young", "poisson", "density"))
    named: Any = table.energy
    if energy is not None:
        from .user_physics import check_energy, user_energy

        named = user_energy(energy, domain)
    material = material_fields(
        domain, named, young=young, poisson=poisson, density=density, plane_stress=table.plane == "stress"
    )
    if energy is not None:
        check_energy(energy, material, domain)
    return material if study.plasticity is None else _add_yield_law(study, domain, material)


def _add_yield_law(study: Study, domain: Domain, material: MaterialFields) -> MaterialFields:
    from ..mechanics.plasticity import YieldLaw, plastic_material

    table = study.plasticity
    assert table is not None
    law = YieldLaw(
        per_cell(study, domain, table, "yield_stress"),
        frobenius=table.measure == "frobenius",
        flow_rate=table.flow_rate,
        hardening=table.hardening,
        update=table.update,
    )
    return plastic_material(domain, law, material, implicit=study.time.scheme_class.implicit)


def per_cell(study: Study, domain: Domain, table: Any, key: str, region_key: str | None = None) -> PerCell:
    """Return a key of a table as one number, or as (cells,) if regions of the material have other values.

    `region_key`: the key of the regions, if it is another one.
    """
    region_key, regions = region_key or key, study.material.regions.items()
    values = {name: getattr(region, region_key) for name, region in regions}
    by_name = {name: value for name, value in values.items() if value is not None}
    return parameter_by_region(domain, float(getattr(table, key)), by_name)


# --- terms ---


@dataclass(frozen=True)
class TermInputs:
    """Objects from which terms of the balance are made.

    Attributes:
        study: that is built.
        scheme: of time integration.
        assembler: of vectors on the mesh.
        u: displacement, m.
        density: kg/m^3, as a UFL coefficient.
        stress: term of the elastic forces.
        mass: mass matrix.
        motion: prescribed displacement.
        conditions: entries of [[boundary]].
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
        """Distributed mesh."""
        return self.assembler.domain

    def facet_measure(self, group: str) -> ufl.Measure:
        """Return the surface measure of a facet group (collective). Raises InputError if the mesh lacks it."""
        (measure,) = surface_measures(self.domain, [select_facets(self.domain, Group(group), "facet_measure")])
        return measure

    def on_facets(self, kind: str) -> list[OnFacets]:
        """Return facets and function of time of every boundary condition of a kind (collective)."""
        conditions = [condition for condition in self.conditions if condition.kind == kind]
        facets = [select_facets(self.domain, condition.selector, f"{condition.key}.on") for condition in conditions]
        for condition in conditions:
            if isinstance(condition.function, PlaceFunction):
                _check_placed(self.domain, condition.function.at(self.domain.nodes), self.study.time.end)
        return [(numbers, condition.function) for numbers, condition in zip(facets, conditions, strict=True)]


def _viscosity(inputs: TermInputs) -> list[Term]:
    damping = inputs.study.damping
    if damping is None or not damping.stiffness:
        return []
    from ..mechanics.damping import Viscosity

    return [Viscosity(inputs.assembler, inputs.u, inputs.stress, damping.stiffness)]


def _pressure(inputs: TermInputs) -> list[Term]:
    pressures = inputs.on_facets("pressure")
    energy = inputs.stress.material.energy
    return [Pressure(inputs.assembler, inputs.u, pressures, energy)] if pressures else []


def _dead_loads(inputs: TermInputs) -> list[Term]:
    tractions, on_volume = (
        [*inputs.on_facets("traction"), *_force_tractions(inputs)],
        volume_loads(inputs.study, inputs.domain.dim),
    )
    if not tractions and not on_volume:
        return []
    gravity, weights = on_volume.get("gravity"), None
    if gravity is not None and _has_unequal_nodal_masses(inputs):
        # M g with the mass matrix of inertia: a body in free fall has no stress
        mass = inputs.mass.lumped
        weights, gravity = mass * np.tile(gravity(0.0), len(mass) // inputs.domain.dim), None
    density_and_gravity = None if gravity is None else (inputs.density, gravity)
    return [
        DeadLoads(
            inputs.assembler, inputs.u, tractions=tractions, gravity=density_and_gravity, weights=weights,
            body_force=on_volume.get("body_force"),
        )
    ]  # fmt: skip


def _has_unequal_nodal_masses(inputs: TermInputs) -> bool:
    """Return whether M g of inertia differs from int rho g w: the lumped mass of quadratic displacement does."""
    return inputs.scheme.inertia and inputs.mass.is_diagonal and inputs.domain.order == 2


def _force_tractions(inputs: TermInputs) -> list[OnFacets]:
    """Return forces as tractions on the area of their facets (collective)."""
    return [
        (facets, _force_per_area(force, surface_area(inputs.domain, facets)))
        for facets, force in inputs.on_facets("force")
    ]


def _force_per_area(force: TimeFunction | PlaceFunction, area: float) -> TimeFunction:
    assert not isinstance(force, PlaceFunction)
    return lambda t: np.asarray(force(t) / area)


def _obstacles(inputs: TermInputs) -> list[Term]:
    if not inputs.study.obstacle:
        return []
    from .contact_terms import build_obstacle_terms

    return build_obstacle_terms(inputs.study, inputs.domain, inputs.u, inputs.stress, inputs.mass.lumped, inputs.scheme)


def _contact(inputs: TermInputs) -> list[Term]:
    if inputs.study.contact is None or not inputs.study.contact.itself:
        return []
    from .contact_terms import build_explicit_self_contact_term, build_self_contact_term

    if not inputs.scheme.implicit:
        mass = inputs.mass.lumped
        return [build_explicit_self_contact_term(inputs.study, inputs.domain, inputs.u, inputs.stress, mass)]
    return [build_self_contact_term(inputs.study, inputs.domain, inputs.u, inputs.stress.material)]


def _node_ties(inputs: TermInputs) -> list[Term]:
    fracture = inputs.study.fracture
    if fracture is None or fracture.crumbs or fracture.approach != "chi" or inputs.domain.order > 1:
        return []
    from ..mechanics.node_ties import NodeTies

    domain = inputs.domain
    young = domain.comm.allreduce(float(np.max(inputs.stress.material.young, initial=0.0)), op=MPI.MAX)
    return [NodeTies(domain, inputs.u, young, inputs.mass.lumped, inputs.motion.prescribed_nodes)]


def _inertia(inputs: TermInputs) -> list[Term]:
    return [Inertia(inputs.u, inputs.mass)] if inputs.scheme.inertia else []


def _mass_damping(inputs: TermInputs) -> list[Term]:
    damping = inputs.study.damping
    if damping is None or not damping.mass:
        return []
    from ..mechanics.damping import Drag

    return [Drag(inputs.u, inputs.mass, damping.mass)]


# Terms of the balance beside the stress, in their order. A new term gets a line here.
TERMS: dict[str, Callable[[TermInputs], list[Term]]] = {
    "viscosity": _viscosity,
    "pressure": _pressure,
    "dead loads": _dead_loads,
    "obstacles": _obstacles,
    "contact": _contact,
    "tethers": _node_ties,
    "inertia": _inertia,
    "drag": _mass_damping,
}


def _prescribed(domain: Domain, entry: BoundaryCondition, end: float) -> Entry:
    """Return nodes, components and displacement of a boundary condition (collective)."""
    nodes, function = select_nodes(domain, entry.selector, f"{entry.key}.on"), entry.function
    if isinstance(function, PlaceFunction):
        placed = function.at(domain.nodes[nodes])
        _check_placed(domain, placed, end)
        return nodes, entry.components, placed
    return nodes, entry.components, function


def conflict_notes(
    domain: Domain, motions: Sequence[BoundaryCondition], prescribed: Sequence[Entry], end: float
) -> list[str]:
    """Return sentences about nodes for which two entries prescribe different displacements (collective).

    Raises:
        InputError: at all nodes of an entry a later one prescribes another displacement.
    """
    notes = []
    for (motion, entry), (later, later_entry) in combinations(zip(motions, prescribed, strict=True), 2):
        (nodes, components, function), (later_nodes, later_components, later_function) = entry, later_entry
        if isinstance(function, PlacedFunction) or isinstance(later_function, PlacedFunction):
            continue
        # steps of an irrational share of the run: no table of round times repeats between them
        times = np.append(np.arange(0.0, end, end / (20 * np.pi)), end)
        u, v = (np.array([at_time(t) for t in times]) for at_time in (function, later_function))
        differs = np.abs(u - v).max(axis=0) > 1e-9 * max(np.nanmax(np.abs(u)), np.nanmax(np.abs(v)))
        differs &= components & later_components
        owned = nodes[nodes < domain.node_count]
        common, count = sum_over_ranks(domain.comm, [np.isin(owned, later_nodes).sum(), len(owned)])
        if not differs.any() or not common:
            continue
        axis = AXES[int(np.argmax(differs))]
        message = f"{motion.key} and {later.key} prescribe different displacements along {axis}"
        if common == count:
            raise InputError(f"{message} at all nodes of {motion.key}: remove one of them, or make them equal")
        notes.append(f"{message} at {common:g} node{'' if common == 1 else 's'}, where {later.key} holds")
    return notes


def check_loads(domain: Domain, motion: PrescribedMotion, entries: Sequence[BoundaryCondition]) -> None:
    """Raise InputError for a load along a component that is prescribed at all its nodes: it would do nothing.

    A pressure, and a load by a user's function, are refused where all components are (collective).
    """
    free = motion.free_dofs.reshape(-1, domain.dim)
    for load in entries:
        if load.prescribes_motion:
            continue
        facets = select_facets(domain, load.selector, f"{load.key}.on")
        nodes = fem.locate_dofs_topological(domain.space, domain.dim - 1, facets)
        free_nodes = sum_over_ranks(domain.comm, free[nodes[nodes < domain.node_count]].sum(axis=0))
        loaded, is_prescribed = loaded_components(load, domain.dim), free_nodes == 0
        if loaded.any() and (loaded & is_prescribed).any():
            axis = AXES[int(np.argmax(loaded & is_prescribed))]
        elif not loaded.any() and is_prescribed.all():
            axis = "all components"
        else:
            axis = ""
        if axis:
            raise InputError(
                f"{load.key}.{load.kind} acts on {load.selector}, where other entries prescribe {axis} of all nodes: "
                "it would do nothing; remove it, or leave nodes free"
            )


def _check_placed(domain: Domain, function: PlacedFunction, end: float) -> None:
    """Raise InputError on all ranks unless a function of the user has its values at start and end (collective)."""
    wrong = ""
    try:
        for t in (0.0, end):
            function(t)
    except InputError as error:
        wrong = str(error)
    if messages := [message for message in domain.comm.allgather(wrong) if message]:
        raise InputError(messages[0])


def build_balance(
    study: Study, domain: Domain, scheme: Scheme, material: MaterialFields, physics: Physics = NO_PHYSICS
) -> Balance:
    """Return the balance of a body (collective). Raises InputError if a selector selects nothing."""
    kernels = KernelSelection(plain=solver_options.uses_plain_solver(study.solver))
    assembler, u = VectorAssembler(domain, kernels), fem.Function(domain.space, name="displacement")
    entries = boundary_conditions(study, domain.dim, physics.boundary)
    motions = [entry for entry in entries if entry.prescribes_motion]
    prescribed = [_prescribed(domain, entry, study.time.end) for entry in motions]
    notes = [*conflict_notes(domain, motions, prescribed, study.time.end), *condition_notes(study, domain.dim)]
    motion = PrescribedMotion(domain, prescribed, notes)
    check_loads(domain, motion, entries)
    density = coefficient(domain, material.density)
    mass: MassMatrix = LumpedMass(assembler, density)
    if study.time.mass == "consistent":
        mass = ConsistentMass(assembler, density, motion.bcs)
    fracture, floor = study.fracture, 0.0 if scheme.inertia else RESIDUAL_STIFFNESS
    degradation = None if fracture is None else DegradationModel(fracture.approach, fracture.unilateral)
    stress = Stress(assembler, u, material, degradation, floor=floor)
    inputs = TermInputs(study, scheme, assembler, u, density, stress, mass, motion, entries)
    terms = [term for make in TERMS.values() for term in make(inputs)]
    if not physics.terms:
        return Balance(assembler, u, [stress, *terms], motion, mass, scheme, study.time.max_step)
    from .user_physics import TermCheck, user_terms

    of_user = user_terms(physics.terms, inputs)
    terms += [term for _, term in of_user]
    balance = Balance(assembler, u, [stress, *terms], motion, mass, scheme, study.time.max_step)
    check = TermCheck(balance)
    for part, term in of_user:
        check(part, term)
    return balance
