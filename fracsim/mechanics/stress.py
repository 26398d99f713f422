"""Stress of a body with damage and plastic flow: the energy that is assembled, its fields, its virtual work.

The energy is that of the undamaged body, times chi in the approach "chi"; of the strain projected on intact edges in
the approach "edge" (forms.damage); in both with closing cracks (forms.crack_closure). With plasticity it is a function
of the elastic part of F (forms.plasticity).

Equations: docs/theory.md#degraded-energy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, cast

import basix
import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from ufl.core.expr import Expr

from ..forms.balance import elastic_energy, internal_work, stress_quadrature
from ..forms.energies import Energy
from ..forms.kinematics import deformation_gradient
from ..mesh.domain import Domain
from ..mesh.simplices import local_edges
from .jit import CellForm, cell_measure, compile_form
from .kernel_selection import KernelCache
from .material_fields import MaterialFields
from .matrix_assembly import VectorAssembler
from .polar_rotation import PolarRotation
from .term import Form, Term, TimeLevel

if TYPE_CHECKING:
    from ..forms.plasticity import ImplicitFlow
    from .cell_subset_assembly import CellSubsetAssembler

Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

# fraction of the stiffness that a detached fragment keeps in a quasi-static study: too small to carry load, and large
# enough for a regular tangent (a condition number of 1e16 would be too much)
RESIDUAL_STIFFNESS = 1e-8


@dataclass(frozen=True)
class DegradationModel:
    """Effect of broken edges on the energy of their cells (docs/theory.md#degraded-energy).

    Attributes:
        approach: "chi": the energy is degraded; "edge": the strain is projected on intact edges.
        cracks_close: whether broken edges resist being shorter than at rest.
    """

    approach: str = "chi"
    cracks_close: bool = False


class Stress(Term):
    """Stress of a body with displacement u: virtual work int chi P : grad w dX.

    Attributes:
        domain: the mesh.
        u: displacement.
        material: undamaged material.
        kernels: selection of kernels for forms and expressions.
        chi: degradation field of the approach "chi", None otherwise.
        integrity: (edges of a cell,) numbers in [0, 1] in each cell, in the approach "edge" or with closing cracks.
        cracks_close: whether broken edges resist being shorter than at rest.
        energy: the energy that is assembled; material.energy is that of the undamaged body.
        energy_multiplier: chi if it multiplies `energy`; None if `energy` has it, or nothing is degraded.
        degradation_factor: chi or 1; with a floor in a quasi-static study, for a regular tangent.
        energy_factor: factor of `energy`; 1 if `energy` has chi.
        rotation: polar rotation of the elastic part of F, for energies that need it.
        rotation_field: its field.
    """

    name = "stress"

    def __init__(
        self,
        assembler: VectorAssembler,
        u: fem.Function,
        material: MaterialFields,
        degradation: DegradationModel | None = None,
        *,
        floor: float = 0.0,
    ) -> None:
        """Compile energy and forces (collective).

        Args:
            assembler: of vectors over the dofs.
            u: displacement.
            material: undamaged material.
            degradation: effect of broken edges; None: nothing breaks.
            floor: fraction of the stiffness that each cell keeps.
        """
        domain = self.domain = assembler.domain
        self._assembler, self.u, self.material, self._floor = assembler, u, material, floor
        self.kernels = assembler.kernels
        self.chi: fem.Function | None = None
        self.integrity: fem.Function | None = None
        self.cracks_close = degradation is not None and degradation.cracks_close
        self.energy: Energy = material.energy if degradation is None else self._damaged_energy(degradation)
        self.energy_multiplier: fem.Function | None = self.chi if self.energy is material.energy else None
        self.degradation_factor: Expr | float = _floored(self.chi, floor)
        self.energy_factor: Expr | float = _floored(self.energy_multiplier, floor)
        self.rotation = (
            PolarRotation(domain, _elastic_part(u, material, domain.dim), self.kernels)
            if material.energy.needs_rotation
            else None
        )
        self.rotation_field = None if self.rotation is None else self.rotation.field
        self.symmetric = material.plastic is None or not material.plastic.frobenius
        self.linear = self.energy.linear and not self.cracks_close and material.plastic is None
        dx = cell_measure(domain)
        self._energy_form = compile_form(
            elastic_energy(self.energy, u, dx, chi=self.energy_factor, rotation=self.rotation_field)
        )
        self._kernel_of = KernelCache(self.kernels.functional)
        self._force_form = CellForm(self.virtual_work(ufl.TestFunction(domain.space), dx))

    # --- the energy and its fields ---

    def _damaged_energy(self, model: DegradationModel) -> Energy:
        """Energy with damage; creates the fields of damage that the approach needs."""
        energy: Energy = self.material.energy
        if model.approach == "chi":
            self.chi = _undamaged_field(self.domain, "chi", 1)
            if not model.cracks_close:
                return self.material.energy
        edges = [[int(node) for node in pair] for pair in local_edges(self.domain.dim)]
        self.integrity = _undamaged_field(self.domain, "integrity", len(edges))
        if model.approach == "edge":
            from ..forms.damage import EdgeProjectedEnergy, StrainEnergy

            energy = EdgeProjectedEnergy(cast(StrainEnergy, energy), self.integrity, edges, self._floor)
        if not model.cracks_close:
            return energy
        from ..forms.crack_closure import CrackClosureEnergy, midpoint_corrections

        share = 1.0 if self.chi is None else 1 - self.chi
        bends = (
            midpoint_corrections(self.u, _reference_coordinates(self.domain), edges) if self.domain.order == 2 else None
        )
        return CrackClosureEnergy(energy, _floored(self.chi, self._floor), share, self.integrity, edges, bends)

    @property
    def is_projected(self) -> bool:
        """Whether strain is projected on edges, each with its integrity."""
        return self.integrity is not None and self.chi is None

    @property
    def damage_fields(self) -> list[fem.Function]:
        """Fields chi and integrity, as far as the approach has them."""
        return [field for field in (self.chi, self.integrity) if field is not None]

    def exchange_damage(self, values: Sequence[Values]) -> list[Values]:
        """Replace the values of `damage_fields`; returns copies of the former values."""
        former = [field.x.array.copy() for field in self.damage_fields]
        for field, value in zip(self.damage_fields, values, strict=True):
            field.x.array[:] = value
        return former

    @property
    def dead_cells(self) -> Flags | None:
        """(owned cells,) flags of cells that have no stress any more; None if a broken cell keeps some of it."""
        if self.energy_multiplier is None or self._floor:
            return None
        return np.asarray(self.energy_multiplier.x.array[: self.domain.cell_count] == 0)

    # --- as a term of the balance ---

    def begin_step(self, level: TimeLevel) -> None:
        """Predict the plastic flow of a step that is to be solved."""
        plastic = self.material.plastic
        if plastic is None or not level.dt:
            return
        plastic.begin_step(level.fraction * level.dt)
        if plastic.prediction is not None and plastic.prediction.form is None:
            self.update_displacement()  # the rotation is that of F_e, and the prediction changed F_p

    def update_displacement(self) -> None:
        """Update the rotation."""
        if self.rotation is not None:
            self.rotation.update()

    @property
    def _flow_form(self) -> ImplicitFlow | None:
        """Virtual work and tangent with the flow of the step itself (`update = "implicit"`); None otherwise."""
        plastic = self.material.plastic
        return plastic.prediction.form if plastic is not None and plastic.prediction is not None else None

    def virtual_work(self, w: Expr, dx: ufl.Measure) -> ufl.Form:
        """Virtual work of the stress, with plastic flow within the step, N m."""
        flow = self._flow_form
        if flow is None:
            return self._work_of(self.energy, self.energy_factor, w, dx)
        return flow.work(self.u, w, dx, chi=self.degradation_factor, rotation=self.rotation_field) + self._springs(
            w, dx
        )

    def tangent_form(self, v: Expr, w: Expr, dx: ufl.Measure) -> ufl.Form:
        """Derivative of the virtual work in the direction v."""
        flow = self._flow_form
        if flow is None:
            tangent = ufl.derivative(self.virtual_work(w, dx), self.u, v)
            if (moduli := turning_moduli(self, ufl.grad(v), ufl.grad(w))) is not None:
                tangent += moduli * dx(metadata=stress_quadrature(w))
            return tangent
        tangent = flow.tangent(self.u, v, w, dx, chi=self.degradation_factor, rotation=self.rotation_field)
        springs = self._springs(w, dx)
        return tangent + (ufl.derivative(springs, self.u, v) if springs else 0)

    def _springs(self, w: Expr, dx: ufl.Measure) -> Form:
        """Virtual work of closing cracks in a body with plastic flow."""
        if not self.cracks_close:
            return 0
        without_bulk: Energy = replace(self.energy, chi=0)  # type: ignore[type-var]
        return self._work_of(without_bulk, 1.0, w, dx)

    def _work_of(self, energy: Energy, chi: Expr | float, w: Expr, dx: ufl.Measure) -> ufl.Form:
        # the pressure of a closed edge is no stress at the points where psi is integrated
        if self.cracks_close and self.domain.order == 2:
            return ufl.derivative(elastic_energy(energy, self.u, dx, chi=chi, rotation=self.rotation_field), self.u, w)
        return internal_work(energy, self.u, w, dx, chi=chi, rotation=self.rotation_field)

    def stored_energy(self) -> float:
        """Stored energy int psi dX at the current u, part of this rank, J (collective the first time)."""
        kernel = self._kernel_of(self._energy_form)
        return float(fem.assemble_scalar(self._energy_form)) if kernel is None else kernel.integrate()

    def potential(self) -> float | None:
        """Stored energy, J; None if the tangent is not symmetric, or steps are solved with their own flow."""
        return self.stored_energy() if self.symmetric and self._flow_form is None else None

    def assemble_forces(self) -> Values:
        """(owned dofs,) forces of the stress alone at the current u, N (collective)."""
        return self._assembler(self._force_form)

    def assemble_released_forces(self, before: Sequence[Values]) -> Values:
        """(owned dofs,) forces at the current u, N, that damage released: with `before` minus with `damage_fields`.

        Args:
            before: former values of `damage_fields` (collective).
        """
        if (subset := self._cell_subset) is None:
            forces = self._assembler(self._all_cells_form)
            after = self.exchange_damage(before)
            released = self._assembler(self._all_cells_form) - forces
            self.exchange_damage(after)
            return released
        changed = np.zeros(self.domain.cell_count, bool)
        for field, former in zip(self.damage_fields, before, strict=True):
            for differs in (field.x.array != former).reshape(-1, field.function_space.dofmap.bs).T:  # rows are short
                changed |= differs[: len(changed)]
        cells = np.flatnonzero(changed)
        former_values = {field.x.array.ctypes.data: was for field, was in zip(self.damage_fields, before, strict=True)}

        def add(sums: Values) -> None:
            subset.add_cells(cells, sums)
            np.negative(sums, out=sums)
            subset.add_cells(cells, sums, former_values)

        return self._assembler.sum_contributions(add)

    @cached_property
    def _all_cells_form(self) -> fem.Form:
        """Form of the forces that no cell is excluded from (collective the first time)."""
        return compile_form(self.virtual_work(ufl.TestFunction(self.domain.space), cell_measure(self.domain)))

    @cached_property
    def _cell_subset(self) -> CellSubsetAssembler | None:
        return self.kernels.cell_subset(self._force_form)

    def damage_changed(self) -> None:
        """Exclude cells without stress from integration."""
        if (dead := self.dead_cells) is not None:
            self._force_form.exclude_cells(dead)

    def cell_corners(self, cells: npt.NDArray[np.integer]) -> Values:
        """(n, d + 1, d) corners of cells in the configuration of the stress, m: at rest for a linear energy."""
        nodes, d = self.domain.cell_nodes[cells], self.domain.dim
        corners = self.domain.nodes.take(nodes, axis=0)  # a third of the time of indexing
        return corners if self.energy.linear else corners + self.u.x.array.reshape(-1, d).take(nodes, axis=0)


def _reference_coordinates(domain: Domain) -> fem.Function:
    """Field of the (d,) coordinates in the reference cell."""
    mesh, d = domain.mesh, domain.dim
    field = fem.Function(fem.functionspace(mesh, ("DG", 1, (d,))), name="place")
    field.x.array.reshape(-1, d + 1, d)[:] = basix.geometry(mesh.basix_cell())
    return field


def _undamaged_field(domain: Domain, name: str, components: int) -> fem.Function:
    """DG0 field of ones."""
    space = domain.scalar_cell_space if components == 1 else domain.vector_cell_space(components)
    field = fem.Function(space, name=name)
    field.x.array[:] = 1.0
    return field


def _floored(chi: Expr | None, floor: float) -> Expr | float:
    """Degradation chi of which a floor is left; 1 without chi."""
    if chi is None:
        return 1.0
    return floor + (1 - floor) * chi if floor else chi


def turning_moduli(stress: Stress, of_v: Expr, of_w: Expr) -> Expr | None:
    """What the variation of the rotation adds to the moduli, for two variations of F, J/m^3; None: it is left out.

    Energies without a rotation have none. The stress of a strain that is projected on edges does not commute with the
    stretch: its tangent is that of a fixed rotation.
    """
    if stress.rotation_field is None or stress.is_projected:
        return None
    energy, F = stress.material.energy, deformation_gradient(stress.u)
    moduli = energy.turning_moduli(F, stress.rotation_field, of_v, of_w)  # type: ignore[attr-defined]
    return stress.degradation_factor * moduli


def energy_derivatives(stress: Stress) -> tuple[Expr, Expr, Expr]:
    """psi, J/m^3, P, Pa (d, d), and the moduli dP/dF, Pa (d, d, d, d), of the damaged body."""
    F = ufl.variable(deformation_gradient(stress.u))
    psi = stress.energy_factor * stress.energy.psi(F, stress.rotation_field)
    P = ufl.diff(psi, F)
    moduli = ufl.diff(P, F)
    if (turning := turning_moduli(stress, F, F)) is not None:  # quadratic in a variation, for which F stands
        moduli += ufl.diff(ufl.diff(turning / 2, F), F)
    return psi, P, moduli


def _elastic_part(u: fem.Function, material: MaterialFields, dim: int) -> Expr:
    """(d, d) F, or its elastic part in a body with plastic flow."""
    F = deformation_gradient(u)
    if material.plastic is None:
        return F
    part = material.energy.elastic_part(F)  # type: ignore[attr-defined]
    return part if dim == 3 else ufl.as_tensor([[part[i, j] for j in range(2)] for i in range(2)])
