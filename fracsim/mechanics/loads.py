"""External loads as functions of time: dead loads and pressures that follow the surface."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from ufl.core.expr import Expr

from ..forms.balance import pressure_work, traction_work
from ..forms.energies import Energy
from ..mesh.dolfinx_compat import exterior_facet_domain
from ..mesh.domain import Domain, Ints
from ..mesh.parallel import sum_over_ranks
from .jit import compile_form
from .matrix_assembly import VectorAssembler
from .term import Term, TimeLevel
from .time_functions import PlaceFunction, TimeFunction

Values = npt.NDArray[np.float64]
OnFacets = tuple[Ints, TimeFunction | PlaceFunction]  # local boundary facets, and the load on them


class _TimeDependentConstants:
    """UFL constants whose values are functions of time."""

    def __init__(self, domain: Domain) -> None:
        self._domain = domain
        self._constants: list[tuple[fem.Constant, TimeFunction]] = []
        self._fields: list[tuple[fem.Function, int, TimeFunction]] = []

    def constant(self, function: TimeFunction | PlaceFunction, size: int) -> Expr:
        """Constant of `size` components with the values of a function; a field if they depend on the place."""
        if isinstance(function, PlaceFunction):
            field = fem.Function(self._domain.space)
            self._fields.append((field, size, function.at(self._domain.nodes)))
            return field if size > 1 else field[0]
        value = fem.Constant(self._domain.mesh, np.full(size, np.nan) if size > 1 else np.float64(np.nan))
        self._constants.append((value, function))
        return value

    def set_time(self, t: float) -> bool:
        """Evaluate all functions at time t (s); returns whether any value changed."""
        changed = False
        for constant, function in self._constants:
            value = function(t).reshape(constant.value.shape)
            changed |= not np.array_equal(value, constant.value)
            constant.value[...] = value
        for field, size, function in self._fields:
            values = field.x.array.reshape(-1, self._domain.dim)[:, :size]
            at_nodes = function(t).reshape(values.shape)
            changed |= not np.array_equal(at_nodes, values)
            values[...] = at_nodes
        return changed


class DeadLoads(Term):
    """Tractions and body forces -(int t . w dA + int f . w dX), assembled when a load has changed.

    Attributes:
        nodal_forces: (owned dofs,) forces of all loads at the time level, N.
        volume_force: gravity and body force at the time level as a UFL vector, N/m^3; None without them.
    """

    name = "dead loads"
    linear = True

    def __init__(
        self,
        assembler: VectorAssembler,
        u: fem.Function,
        *,
        tractions: Sequence[OnFacets] = (),
        gravity: tuple[Expr, TimeFunction] | None = None,
        weights: Values | None = None,
        body_force: TimeFunction | None = None,
    ) -> None:
        """Compile the linear form of the loads (collective).

        Args:
            assembler: of vectors over the dofs.
            u: displacement.
            tractions: facets, and tractions in Pa of the reference area.
            gravity: density as a UFL coefficient in kg/m^3, and acceleration in m/s^2.
            weights: (owned dofs,) constant nodal forces of gravity, N, in place of `gravity`.
            body_force: N/m^3 of the reference volume.
        """
        domain, d = assembler.domain, assembler.domain.dim
        self._assembler, self._u, self._constants = assembler, u, _TimeDependentConstants(domain)
        w, dx = ufl.TestFunction(domain.space), ufl.dx(domain=domain.mesh)
        facets, densities = [part for part, _ in tractions], []
        if gravity is not None:
            densities.append(gravity[0] * self._constants.constant(gravity[1], d))
        if body_force is not None:
            densities.append(self._constants.constant(body_force, d))
        works = [
            traction_work(self._constants.constant(traction, d), w, ds)
            for (_, traction), ds in zip(tractions, surface_measures(domain, facets), strict=True)
        ]
        self.volume_force: Expr | None = sum(densities[1:], densities[0]) if densities else None
        if self.volume_force is not None:
            works.append(ufl.inner(self.volume_force, w) * dx)
        self._form = compile_form(sum(works[1:], works[0])) if works else None
        self._weights: Values = np.zeros(assembler.owned_dof_count) if weights is None else weights
        self.nodal_forces: Values = self._weights

    def begin_step(self, level: TimeLevel) -> None:
        """Evaluate the loads at the time level."""
        if self._form is not None and self._constants.set_time(level.t):
            self.nodal_forces = self._weights + self._assembler(self._form)

    def add_nodal_forces(self, forces: Values) -> None:
        """Subtract the loads from r (owned dofs,), N."""
        forces -= self.nodal_forces

    def potential(self) -> float:
        """-f . u, J."""
        return -float(self.nodal_forces @ self._u.x.array[: len(self.nodal_forces)])

    def applied_forces(self) -> Values:
        """(owned dofs,) forces of all loads, N."""
        return self.nodal_forces

    def reference_forces(self) -> Values:
        """(owned dofs,) forces of all loads, N."""
        return self.nodal_forces


class Pressure(Term):
    """Pressures int p J F^-T N . w dA that follow the surface; on the reference surface of a linear body."""

    name = "pressure"

    def __init__(self, assembler: VectorAssembler, u: fem.Function, parts: Sequence[OnFacets], energy: Energy) -> None:
        """Compile the form of the pressures (collective).

        Args:
            assembler: of vectors over the dofs.
            u: displacement.
            parts: facets, and pressures in Pa.
            energy: elastic energy of the body.
        """
        domain = assembler.domain
        self._assembler, self._u, self._energy = assembler, u, energy
        self.symmetric = self.linear = energy.linear
        self._constants = _TimeDependentConstants(domain)
        measures = surface_measures(domain, [facets for facets, _ in parts])
        self._pressures = [
            (self._constants.constant(function, 1), ds) for (_, function), ds in zip(parts, measures, strict=True)
        ]
        self._normal = ufl.FacetNormal(domain.mesh)
        self._form = compile_form(self._work(ufl.TestFunction(domain.space)))

    def _work(self, w: Expr) -> ufl.Form:
        return -sum(pressure_work(p, self._u, w, self._normal, ds, self._energy) for p, ds in self._pressures)

    def begin_step(self, level: TimeLevel) -> None:
        """Evaluate the pressures at the time level."""
        self._constants.set_time(level.t)

    def virtual_work(self, w: Expr, dx: ufl.Measure) -> ufl.Form:
        """Virtual work of the pressures, N m; their facets do not depend on the cells of `dx`."""
        return self._work(w)

    def tangent_form(self, v: Expr, w: Expr, dx: ufl.Measure) -> ufl.Form:
        """Derivative of the virtual work in the direction v; 0 on the reference surface."""
        return ufl.derivative(self._work(w), self._u, v)

    def applied_forces(self) -> Values:
        """(owned dofs,) forces of the pressures on the current surface, N (collective)."""
        return -self._assembler(self._form)


def surface_area(domain: Domain, facets: Ints) -> float:
    """Area of local exterior facets of the body at rest on all ranks, m^2; in 2D their length, m (collective)."""
    if domain.has_curved_cells:
        (ds,) = surface_measures(domain, [facets])
        unit: Any = fem.Constant(domain.mesh, np.eye(domain.dim)[0])
        shares = fem.assemble_vector(compile_form(traction_work(unit, ufl.TestFunction(domain.space), ds)))
        return float(sum_over_ranks(domain.comm, np.sum(shares.array))[0])
    cell, opposite = exterior_facet_domain(domain.mesh, facets).reshape(-1, 2).T
    nodes = domain.cell_nodes[cell]
    corners = nodes[np.arange(nodes.shape[1]) != opposite[:, None]].reshape(len(nodes), domain.dim)
    x = domain.nodes[corners]
    sides = x[:, 1:] - x[:, :1]
    gram = np.einsum("nik,njk->nij", sides, sides)
    # of a segment its length, of a triangle half the length of the cross product
    areas = np.sqrt(np.linalg.det(gram)) / (domain.dim - 1)
    return float(sum_over_ranks(domain.comm, np.sum(areas))[0])


def surface_measures(domain: Domain, parts: Sequence[Ints]) -> list[ufl.Measure]:
    """Surface measure of each set of local exterior facets; sets may overlap."""
    entities = [(number, exterior_facet_domain(domain.mesh, facets)) for number, facets in enumerate(parts)]
    ds = ufl.Measure("ds", domain=domain.mesh, subdomain_data=entities)
    return [ds(number) for number in range(len(parts))]
