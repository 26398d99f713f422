"""The stress of a body as damage and flow leave it: the energy that is assembled, its fields, its virtual work.

energy                    undamaged; times chi in the approach "chi"
forms.damage              approach "edge"
forms.closing             either, where cracks close
forms.plasticity          the elastic part of F, and what flow within a step takes off its stress
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem

from ..forms.balance import elastic_energy, internal_work
from ..forms.energies import Energy
from ..forms.kinematics import deformation_gradient
from ..mesh.domain import Domain
from ..study import Fracture, Study
from .material import MaterialFields
from .rotation import RotationField

Values = npt.NDArray[np.float64]

# Share of the stiffness that a detached piece keeps in a quasi-static study: small enough not to carry load, large
# enough that the tangent stays regular (a condition number of 1e16 would not do).
RESIDUAL_STIFFNESS = 1e-8


class InternalForces:
    """Forms of the stress in a body with displacement u.

    Attributes:
        chi: degradation field of the approach "chi", None otherwise.
        integrity: 1 or 0 for each edge of each cell in the approach "edge" or where cracks close, None otherwise.
        unilateral: whether broken edges resist being shortened.
        energy: the energy that is assembled; material.energy is that of the undamaged body.
        rotation: polar rotation of the elastic part of F, for energies that need it.
    """

    def __init__(self, domain: Domain, u: fem.Function, study: Study, material: MaterialFields, inertia: bool) -> None:
        self._domain, self._u, self._material = domain, u, material
        self._floor = 0.0 if inertia else RESIDUAL_STIFFNESS
        self.chi: fem.Function | None = None
        self.integrity: fem.Function | None = None
        self.unilateral = study.fracture is not None and study.fracture.unilateral
        self.energy: Energy = material.energy if study.fracture is None else self._damaged(study.fracture)
        self.rotation = RotationField(domain, self._elastic_part()) if material.energy.needs_rotation else None

    def _damaged(self, fracture: Fracture) -> Energy:
        """The energy with the fields of damage that the study's approach needs."""
        whole: Any = self._material.energy
        if fracture.approach == "chi":
            self.chi = self._whole_cells("chi", 1)
            if not fracture.unilateral:
                return self._material.energy
        from ..mesh.simplices import local_edges

        edges: list[Any] = np.asarray(local_edges(self._domain.dim)).tolist()  # type: ignore[assignment]
        self.integrity = self._whole_cells("integrity", len(edges))
        if fracture.approach == "edge":
            from ..forms.damage import EdgeProjected

            whole = EdgeProjected(whole, self.integrity, edges, self._floor)
        if not fracture.unilateral:
            return whole
        from ..forms.closing import Closing

        share = 1.0 if self.chi is None else 1 - self.chi
        return Closing(whole, self._floored(self.chi), share, self.integrity, edges)

    def _whole_cells(self, name: str, components: int) -> fem.Function:
        """A DG0 field of ones: nothing is broken yet."""
        space = self._domain.cell_scalar if components == 1 else self._domain.cell_vector(components)
        field = fem.Function(space, name=name)
        field.x.array[:] = 1.0
        return field

    def damage(self) -> list[Values]:
        """Copies of the values of chi and integrity, as far as there are any."""
        return [field.x.array.copy() for field in self._fields]

    def exchange_damage(self, values: list[Values]) -> list[Values]:
        """Put in what `damage` has returned; returns what was there."""
        found = self.damage()
        for field, value in zip(self._fields, values, strict=True):
            field.x.array[:] = value
        return found

    @property
    def _fields(self) -> list[fem.Function]:
        return [field for field in (self.chi, self.integrity) if field is not None]

    def _elastic_part(self) -> Any:
        """What the energy takes of F: all of it, or what plastic flow left (d x d)."""
        F = deformation_gradient(self._u)
        if self._material.plastic is None:
            return F
        part = self._material.energy.elastic_part(F)  # type: ignore[attr-defined]
        return part if self._domain.dim == 3 else ufl.as_tensor([[part[i, j] for j in range(2)] for i in range(2)])

    @property
    def factor(self) -> fem.Function | None:
        """chi where it multiplies `energy`; None where it is part of it, or does not exist."""
        return self.chi if self.energy is self._material.energy else None

    @property
    def dead(self) -> npt.NDArray[np.bool_] | None:
        """(owned cells,) flags of those without any stress, for ever; None where a broken cell keeps some of it."""
        if self.factor is None or self._floor:
            return None
        return np.asarray(self.factor.x.array[: self._domain.cell_count] == 0)

    @property
    def stiffness_left(self) -> Any:
        """chi, 1 where there is none; in a quasi-static study with a floor, so that the tangent stays regular."""
        return self._floored(self.chi)

    def _floored(self, chi: Any) -> Any:
        if chi is None:
            return 1.0
        return self._floor + (1 - self._floor) * chi if self._floor else chi

    @property
    def _R(self) -> Any:
        return self.rotation.field if self.rotation is not None else None

    @property
    def _relaxation(self) -> Any:
        """Virtual work and tangent of a step that is solved with its own flow; None for all others."""
        plastic = self._material.plastic
        return plastic.relaxation.form if plastic is not None and plastic.relaxation is not None else None

    def stored(self, dx: ufl.Measure) -> ufl.Form:
        """Elastic energy, J."""
        return elastic_energy(self.energy, self._u, dx, chi=self._floored(self.factor), rotation=self._R)

    def work(self, w: Any, dx: ufl.Measure) -> ufl.Form:
        """Virtual work of the stress, as flow within the step leaves it."""
        relaxed = self._relaxation
        if relaxed is None:
            return internal_work(self.energy, self._u, w, dx, chi=self._floored(self.factor), rotation=self._R)
        return relaxed.work(self._u, w, dx, chi=self.stiffness_left, rotation=self._R) + self._springs(w, dx)

    def stiffness(self, v: Any, w: Any, dx: ufl.Measure) -> ufl.Form:
        """Derivative of the virtual work in the direction v."""
        relaxed = self._relaxation
        if relaxed is None:
            return ufl.derivative(self.work(w, dx), self._u, v)
        tangent = relaxed.tangent(self._u, v, w, dx, chi=self.stiffness_left, rotation=self._R)
        springs = self._springs(w, dx)
        return tangent + (ufl.derivative(springs, self._u, v) if springs else 0)

    def _springs(self, w: Any, dx: ufl.Measure) -> ufl.Form | int:
        """Virtual work of closing cracks in a body that flows."""
        if not self.unilateral:
            return 0
        alone: Any = replace(self.energy, chi=0)  # type: ignore[type-var]
        return internal_work(alone, self._u, w, dx)
