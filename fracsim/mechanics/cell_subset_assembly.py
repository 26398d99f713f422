"""A linear form in some cells, with fields as they are or as they were: what breaks in a step frees forces there, and
cells that have come apart are left out of the body's own.

To bind a form to other cells, and to put the fields of before into it, takes DOLFINx longer than a hundred cells do.
"""

from __future__ import annotations

from collections.abc import Mapping
from ctypes import Array, Structure, byref, c_int64, c_void_p
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..mesh.c_library import Float64, Int32, at, load_library, struct_pointer
from ..mesh.dolfinx_compat import constants_in, form_fields, kernel_of, nodes_of_cells
from .jit import CellForm

Values = npt.NDArray[np.float64]
SOURCE = Path(__file__).with_suffix(".c")


class _Field(Structure):
    """As cell_subset_assembly.c has it."""

    _fields_ = (("nodes", c_int64), ("size", c_int64), ("dofs", Int32), ("values", Float64))


class _Form(Structure):
    """The same."""

    _fields_ = (
        ("kernel", c_void_p),
        *((name, c_int64) for name in ("nodes", "size", "corners", "fields", "width")),
        *((name, Int32) for name in ("dofs", "points")),
        *((name, Float64) for name in ("x", "constants")),
    )


class CellSubsetAssembler:
    """A form with one integral, over cells."""

    def __init__(self, form: CellForm) -> None:
        self._form, self._fields = form, form_fields(form)
        nodes, geometry, size = nodes_of_cells(form), form.mesh.geometry, form.function_spaces[0].dofmap.index_map_bs
        self._constants = constants_in(form.all_cells_form)
        self._kept = [struct_pointer(each) for each in (nodes, geometry.dofmap, geometry.x, self._constants)]
        width = sum(field.dofs.shape[1] * field.size for field in self._fields)
        sizes = nodes.shape[1], size, geometry.dofmap.shape[1], len(self._fields), width
        self._given = _Form(kernel_of(form), *sizes, *self._kept)
        self._now = self._given_fields({})

    def add_cells(
        self, cells: npt.NDArray[np.int64], values: Values, instead: Mapping[int, Values] | None = None
    ) -> None:
        """Add the part of cells, rising, to the `values` of dofs, ghosts included; `instead`: numbers of fields in
        place of those that begin at an address."""
        self._constants[:] = constants_in(self._form.all_cells_form)
        fields = self._given_fields(instead) if instead else self._now
        _code().add(byref(self._given), byref(fields), c_int64(len(cells)), at(cells), at(values))

    def _given_fields(self, instead: Mapping[int, Values]) -> Array[_Field]:
        """Fields as C has them, with other numbers in place of those that begin at an address."""
        arrays = [instead.get(field.values.ctypes.data, field.values) for field in self._fields]
        return (_Field * (len(arrays) + 1))(
            *(_Field(field.dofs.shape[1], field.size, struct_pointer(field.dofs), struct_pointer(array))
              for field, array in zip(self._fields, arrays, strict=True))
        )  # fmt: skip


@cache
def _code() -> Any:
    return load_library(SOURCE)
