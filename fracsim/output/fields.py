"""What a frame of fields.xdmf holds: displacement, and the fields that the study asks for."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import ufl
from ufl.core.expr import Expr

from ..forms.energies import Energy, full_cauchy_stress, von_mises
from ..forms.kinematics import deformation_gradient, embed, green_strain
from ..mechanics.jit import CellExpression
from ..mechanics.stress import Stress
from ..timestepping.state import State
from .fields_file import TENSOR, Field

if TYPE_CHECKING:
    from ..fracture.fracture_pass import Breaking
    from ..mesh.fragments import Fragments

Values = npt.NDArray[np.generic]
_ENTRIES = [("xyz".index(name[0]), "xyz".index(name[1])) for name in TENSOR]


class Frames:
    """Gathers the fields of a frame to rank 0. Expressions are compiled at the first frame that needs them."""

    def __init__(self, stress: Stress, names: list[str], fracture: Breaking | None = None) -> None:
        self._stress, self._domain, self._fracture = stress, stress.domain, fracture
        self._names = names
        self._compiled: dict[str, CellExpression] = {}

    def __call__(self, state: State, pieces: Fragments | None) -> list[Field]:
        """All fields in input order (complete on rank 0; collective)."""
        d = self._domain.dim
        fields = [self._on_nodes("displacement", state.u.reshape(-1, d))]
        for name in self._names:
            if name == "velocity":
                fields.append(self._on_nodes(name, state.v.reshape(-1, d)))
            elif name == "piece":
                assert pieces is not None
                fields.append(self._on_nodes(name, pieces.node_fragment[: self._domain.node_count].astype(np.int32)))
            else:
                fields.append(Field(name, "Cell", self._domain.gather_cells(self._cell_values(name))))
        return fields

    def _on_nodes(self, name: str, owned: Values) -> Field:
        return Field(name, "Node", self._domain.gather_nodes(owned))

    def _cell_values(self, name: str) -> Values:
        if name == "region":
            return self._domain.region.astype(np.int32)
        if name == "plastic_strain":
            plastic = self._stress.material.plastic
            strain: Values = plastic.cell_means(plastic.accumulated_strain)
            return strain
        if name == "damage":
            return self._broken_share()
        if name == "chi":
            assert self._stress.chi is not None
            return self._stress.chi.x.array[: self._domain.cell_count]
        values = self._carried(name)
        return values[:, 0] if values.shape[1] == 1 else values

    def _broken_share(self) -> Values:
        """Broken edges of a cell over all its edges, 0 to 1."""
        assert self._fracture is not None
        graph = self._fracture.graph
        return np.asarray(graph.broken[graph.cell_edges].mean(axis=1))

    def _carried(self, name: str) -> Values:
        """An expression of the deformation; stress and energy times chi: what the damaged body really carries."""
        if name not in self._compiled:
            expression = _EXPRESSIONS[name](self._stress)
            self._compiled[name] = CellExpression(
                self._domain.comm, self._domain.mesh, expression, self._domain.cell_count
            )
        values = self._compiled[name]()
        if (chi := self._stress.energy_multiplier) is not None and name != "strain":
            values *= chi.x.array[: self._domain.cell_count, None]
        if self._fracture is not None and name == "strain":
            values[self._fracture.graph.split] = 0.0  # nodes of several pieces have no strain in common
        return np.nan_to_num(values, posinf=0.0, neginf=0.0)  # of crushed cells, which count as none


def _kinematics(stress: Stress) -> tuple[Energy, Expr, Expr | None]:
    return stress.energy, deformation_gradient(stress.u), stress.rotation_field


def _tensor(stress: Stress) -> Expr:
    tensor = full_cauchy_stress(*_kinematics(stress))
    return ufl.as_vector([tensor[i, j] for i, j in _ENTRIES])


def _von_mises(stress: Stress) -> Expr:
    return von_mises(full_cauchy_stress(*_kinematics(stress)))


def _energy_density(stress: Stress) -> Expr:
    energy, F, rotation = _kinematics(stress)
    return energy.psi(F, rotation)


def _strain(stress: Stress) -> Expr:
    """Equivalent Green-Lagrange strain sqrt(2/3 e:e), e the deviator of E (the strain profile of M22 fig. 2)."""
    E = green_strain(embed(deformation_gradient(stress.u), 1.0))
    return ufl.sqrt(2 / 3 * ufl.inner(ufl.dev(E), ufl.dev(E)))


_EXPRESSIONS: dict[str, Callable[[Stress], Expr]] = {
    "stress": _tensor,
    "von_mises": _von_mises,
    "energy_density": _energy_density,
    "strain": _strain,
}
