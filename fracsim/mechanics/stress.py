"""The stress of a body as damage and flow leave it: the energy that is assembled, its fields, its virtual work.

energy                    undamaged; times chi in the approach "chi"
forms.damage              approach "edge"
forms.crack_closure             either, where cracks close
forms.plasticity          the elastic part of F, and what flow within a step takes off its stress
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

from ..forms.balance import elastic_energy, internal_work
from ..forms.energies import Energy
from ..forms.kinematics import deformation_gradient
from ..mesh.simplices import local_edges
from .cell_subset_assembly import CellSubsetAssembler
from .jit import CellForm, SimdKernelCache, cell_measure, compile_form
from .material_fields import MaterialFields
from .matrix_assembly import VectorAssembler
from .rotation import RotationField
from .term import Form, Term, TimeLevel

if TYPE_CHECKING:
    from ..forms.plasticity import ImplicitFlow
    from .simd_kernels import SimdFunctional

Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

# Share of the stiffness that a detached piece keeps in a quasi-static study: small enough not to carry load, large
# enough that the tangent stays regular (a condition number of 1e16 would not do).
RESIDUAL_STIFFNESS = 1e-8


@dataclass(frozen=True)
class DegradationModel:
    """How broken edges weaken the energy of their cells (docs/theory.md#degraded-energy).

    Attributes:
        approach: "chi", the energy fades; "edge", the strain is projected on intact edges.
        closes: whether broken edges resist being shorter than at rest.
    """

    approach: str = "chi"
    cracks_close: bool = False


class Stress(Term):
    """int chi P : grad w dX of a body with displacement u.

    Attributes:
        domain, u: the mesh and its displacement.    material: the undamaged body.
        chi: degradation field of the approach "chi", None otherwise.
        integrity: a number in [0, 1] for each edge of each cell in the approach "edge" or where cracks close.
        closes: whether broken edges resist being shortened.
        energy: the energy that is assembled; material.energy is that of the undamaged body.
        rotation: polar rotation of the elastic part of F, for energies that need it.
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
        """`weakening`: None where nothing breaks. `floor`: share of the stiffness that every cell keeps."""
        domain = self.domain = assembler.domain
        self._assembler, self.u, self.material, self._floor = assembler, u, material, floor
        self.chi: fem.Function | None = None
        self.integrity: fem.Function | None = None
        self.cracks_close = degradation is not None and degradation.cracks_close
        self.energy: Energy = material.energy if degradation is None else self._weakened(degradation)
        self.rotation = RotationField(domain, self._elastic_part()) if material.energy.needs_rotation else None
        self.symmetric = material.plastic is None or not material.plastic.frobenius
        self.linear = self.energy.linear and not self.cracks_close and material.plastic is None
        whole = cell_measure(domain)
        self._energy_form = compile_form(self._stored_energy(whole))
        self._sums = SimdKernelCache(_sums_in_lanes)
        self._alone = CellForm(self.virtual_work(ufl.TestFunction(domain.space), whole))

    # --- the energy and its fields ---

    def _weakened(self, weakening: DegradationModel) -> Energy:
        """The energy with the fields of damage that the approach needs."""
        whole: Energy = self.material.energy
        if weakening.approach == "chi":
            self.chi = self._whole_cells("chi", 1)
            if not weakening.cracks_close:
                return self.material.energy
        edges: list[list[int]] = np.asarray(local_edges(self.domain.dim)).tolist()  # type: ignore[assignment]
        self.integrity = self._whole_cells("integrity", len(edges))
        if weakening.approach == "edge":
            from ..forms.damage import EdgeProjected, Strained

            whole = EdgeProjected(cast(Strained, whole), self.integrity, edges, self._floor)
        if not weakening.cracks_close:
            return whole
        from ..forms.crack_closure import Closing, bends_of

        share = 1.0 if self.chi is None else 1 - self.chi
        bends = bends_of(self.u, self._place_in_cell(), edges) if self.domain.order == 2 else None
        return Closing(whole, self._floored(self.chi), share, self.integrity, edges, bends)

    def _place_in_cell(self) -> fem.Function:
        """(d,) coordinates in the reference cell."""
        mesh, d = self.domain.mesh, self.domain.dim
        place = fem.Function(fem.functionspace(mesh, ("DG", 1, (d,))), name="place")
        place.x.array.reshape(-1, d + 1, d)[:] = basix.geometry(mesh.basix_cell())
        return place

    def _whole_cells(self, name: str, components: int) -> fem.Function:
        """A DG0 field of ones: nothing is broken yet."""
        space = self.domain.cell_scalar if components == 1 else self.domain.cell_vector(components)
        field = fem.Function(space, name=name)
        field.x.array[:] = 1.0
        return field

    @property
    def damage_fields(self) -> list[fem.Function]:
        """chi and integrity, as far as there are any."""
        return [field for field in (self.chi, self.integrity) if field is not None]

    def exchange_damage(self, values: Sequence[Values]) -> list[Values]:
        """Put other values into `fields`; returns copies of those that were there."""
        found = [field.x.array.copy() for field in self.damage_fields]
        for field, value in zip(self.damage_fields, values, strict=True):
            field.x.array[:] = value
        return found

    def _elastic_part(self) -> Expr:
        """What the energy takes of F: all of it, or what plastic flow left (d x d)."""
        F = deformation_gradient(self.u)
        if self.material.plastic is None:
            return F
        part = self.material.energy.elastic_part(F)  # type: ignore[attr-defined]
        return part if self.domain.dim == 3 else ufl.as_tensor([[part[i, j] for j in range(2)] for i in range(2)])

    @property
    def energy_multiplier(self) -> fem.Function | None:
        """chi where it multiplies `energy`; None where it is part of it, or does not exist."""
        return self.chi if self.energy is self.material.energy else None

    @property
    def dead_cells(self) -> Flags | None:
        """(owned cells,) flags of those without any stress, for ever; None where a broken cell keeps some of it."""
        if self.energy_multiplier is None or self._floor:
            return None
        return np.asarray(self.energy_multiplier.x.array[: self.domain.cell_count] == 0)

    @property
    def degradation_factor(self) -> Expr | float:
        """chi, 1 where there is none; in a quasi-static study with a floor, so that the tangent stays regular."""
        return self._floored(self.chi)

    @property
    def energy_factor(self) -> Expr | float:
        """What multiplies `energy`: 1 where chi is part of it."""
        return self._floored(self.energy_multiplier)

    def _floored(self, chi: Expr | None) -> Expr | float:
        if chi is None:
            return 1.0
        return self._floor + (1 - self._floor) * chi if self._floor else chi

    @property
    def rotation_field(self) -> fem.Function | None:
        """The field of `rotation`."""
        return self.rotation.field if self.rotation is not None else None

    # --- as a term of the balance ---

    def begin_step(self, level: TimeLevel) -> None:
        """What flow takes off the stress of a step that is to be solved."""
        plastic = self.material.plastic
        if plastic is None or not level.dt:
            return
        plastic.begin_step(level.fraction * level.dt)
        if plastic.prediction is not None and plastic.prediction.form is None:
            self.update_displacement()  # the rotation is that of F_e, in which another F_p stands now

    def update_displacement(self) -> None:
        """u has moved."""
        if self.rotation is not None:
            self.rotation.update()

    @property
    def _flow_form(self) -> ImplicitFlow | None:
        """Virtual work and tangent of a step that is solved with its own flow; None for all others."""
        plastic = self.material.plastic
        return plastic.prediction.form if plastic is not None and plastic.prediction is not None else None

    def _stored_energy(self, dx: ufl.Measure) -> ufl.Form:
        return elastic_energy(self.energy, self.u, dx, chi=self.energy_factor, rotation=self.rotation_field)

    def virtual_work(self, w: Expr, dx: ufl.Measure) -> ufl.Form:
        """Virtual work of the stress, as flow within the step leaves it."""
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
            return ufl.derivative(self.virtual_work(w, dx), self.u, v)
        tangent = flow.tangent(self.u, v, w, dx, chi=self.degradation_factor, rotation=self.rotation_field)
        springs = self._springs(w, dx)
        return tangent + (ufl.derivative(springs, self.u, v) if springs else 0)

    def _springs(self, w: Expr, dx: ufl.Measure) -> Form:
        """Virtual work of closing cracks in a body that flows."""
        if not self.cracks_close:
            return 0
        alone: Energy = replace(self.energy, chi=0)  # type: ignore[type-var]
        return self._work_of(alone, 1.0, w, dx)

    def _work_of(self, energy: Energy, chi: Expr | float, w: Expr, dx: ufl.Measure) -> ufl.Form:
        if (
            self.cracks_close and self.domain.order == 2
        ):  # what presses on an edge is no stress of the points where psi is
            return ufl.derivative(elastic_energy(energy, self.u, dx, chi=chi, rotation=self.rotation_field), self.u, w)
        return internal_work(energy, self.u, w, dx, chi=chi, rotation=self.rotation_field)

    def stored_energy(self) -> float:
        """int psi dX at the current u, this rank's share, J (collective the first time)."""
        lanes = self._sums(self._energy_form)
        return float(fem.assemble_scalar(self._energy_form)) if lanes is None else lanes.integrate()

    def potential(self) -> float | None:
        """int psi dX at the current u, J; None where the tangent is not symmetric, or steps are solved with their own
        flow."""
        return self.stored_energy() if self.symmetric and self._flow_form is None else None

    def assemble_forces(self) -> Values:
        """(owned dofs,) forces of the stress alone at the current u, N."""
        return self._assembler(self._alone)

    def assemble_released_forces(self, before: Sequence[Values]) -> Values:
        """(owned dofs,) forces at the current u, N, that went with what `fields` lost since they were `before`: over
        the cells alone that lost any (collective)."""
        lower = np.zeros(self.domain.cell_count, bool)
        for field, was in zip(self.damage_fields, before, strict=True):
            for differs in (field.x.array != was).reshape(-1, field.function_space.dofmap.bs).T:  # rows are short
                lower |= differs[: len(lower)]
        cells = np.flatnonzero(lower)
        then = {field.x.array.ctypes.data: was for field, was in zip(self.damage_fields, before, strict=True)}

        def add(sums: Values) -> None:
            self._few.add_cells(cells, sums)
            np.negative(sums, out=sums)
            self._few.add_cells(cells, sums, then)

        return self._assembler.sum_contributions(add)

    @cached_property
    def _few(self) -> CellSubsetAssembler:
        return CellSubsetAssembler(self._alone)

    def damage_changed(self) -> None:
        """Cells without stress are not integrated from here on: they would add zeros for ever."""
        if (dead := self.dead_cells) is not None:
            self._alone.exclude_cells(dead)

    def cell_corners(self, cells: npt.NDArray[np.integer]) -> Values:
        """(n, d + 1, d) corners of cells in the configuration that the energy's stress belongs to, m."""
        nodes, d = self.domain.cell_nodes[cells], self.domain.dim
        corners = self.domain.nodes.take(nodes, axis=0)  # a third of the time of an index
        return corners if self.energy.linear else corners + self.u.x.array.reshape(-1, d).take(nodes, axis=0)


def _sums_in_lanes(form: fem.Form) -> SimdFunctional | None:
    from .simd_kernels import SimdFunctional

    return SimdFunctional.for_form(form)
