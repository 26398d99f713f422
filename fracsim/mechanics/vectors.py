"""Assembled vectors: forms summed into PETSc vectors over all ranks."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from petsc4py import PETSc

from ..mesh.dolfinx_calls import assemble_into, create_vector
from ..mesh.domain import Domain
from .kernels import CellForm, OfLarge

if TYPE_CHECKING:
    from .few_cells import FewCells
    from .lanes import VectorLanes

Values = npt.NDArray[np.float64]


class Assembler:
    """Assembles linear forms over a domain's displacement space, with one vector that is kept.

    Attributes:
        domain: the mesh.    owned: dofs of this rank.
    """

    def __init__(self, domain: Domain) -> None:
        self.domain = domain
        self.owned = domain.node_count * domain.dim
        self._kept = self.vector()
        self._lanes = OfLarge(_in_lanes)
        self._few: dict[CellForm, FewCells] = {}

    def vector(self) -> PETSc.Vec:
        """A new vector over the dofs, ghosts included."""
        return create_vector(self.domain.space)

    def __call__(self, form: fem.Form) -> Values:
        """(owned dofs,) copy of an assembled form (collective)."""
        return self.into(self._kept, form).array_r.copy()

    def added(self, add: Callable[[Values], None]) -> Values:
        """(owned dofs,) sums of what `add` adds to the dofs of each rank, ghosts included (collective)."""
        with self._kept.localForm() as local:
            local.set(0.0)
            add(local.array_w)
        return self.summed(self._kept).array_r.copy()

    def into(self, b: PETSc.Vec, form: fem.Form) -> PETSc.Vec:
        """Assemble into b, which loses what it held (collective)."""
        return self.summed(self.into_unsummed(b, form))

    def into_unsummed(self, b: PETSc.Vec, form: fem.Form) -> PETSc.Vec:
        """This rank's part alone into b; returns b (collective the first time)."""
        with b.localForm() as local:
            local.set(0.0)
            added = self._added_to(local.array_w, form)
        if not added:
            assemble_into(b, form)
        return b

    def _added_to(self, values: Values, form: fem.Form) -> bool:
        """Add this rank's part to the values of dofs, ghosts included, where DOLFINx need not do it."""
        if (lanes := self._lanes(form)) is not None:
            lanes.add(values)
        elif isinstance(form, CellForm) and (left := form.left) is not None:
            if form not in self._few:
                from .few_cells import FewCells

                self._few[form] = FewCells(form)
            self._few[form].add(left, values)
        else:
            return False
        return True

    def summed(self, b: PETSc.Vec) -> PETSc.Vec:
        """b with the parts that other ranks have assembled for its owned dofs (collective)."""
        b.ghostUpdate(PETSc.InsertMode.ADD, PETSc.ScatterMode.REVERSE)
        return b

    def destroy(self) -> None:
        """Give the memory back."""
        self._kept.destroy()


def _in_lanes(form: fem.Form) -> VectorLanes | None:
    from .lanes import VectorLanes

    return VectorLanes.of(form)
