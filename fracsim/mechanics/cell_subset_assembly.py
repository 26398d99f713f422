"""Linear forms assembled over a subset of cells, with current or former values of their fields.

Damage in a step releases forces in the cells that it reached, and split cells are excluded from the body's own forms.
To bind a DOLFINx form to other cells, and to put former values into its fields, takes longer than a hundred cells do.
"""

from __future__ import annotations

from collections.abc import Mapping
from ctypes import Array, Structure, byref, c_int64, c_void_p
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..mesh.c_library import Float64, Int32, load_library, struct_pointer
from ..mesh.dolfinx_compat import cell_geometry, form_cell_nodes, form_fields, kernel_address, kernel_constants
from .jit import CellForm

Values = npt.NDArray[np.float64]
SOURCE = Path(__file__).with_suffix(".c")


class _SubsetField(Structure):
    """Structure `Field` of cell_subset_assembly.c."""

    _fields_ = (("nodes", c_int64), ("size", c_int64), ("dofs", Int32), ("values", Float64))


class _SubsetForm(Structure):
    """Structure `Form` of cell_subset_assembly.c."""

    _fields_ = (
        ("kernel", c_void_p),
        *((name, c_int64) for name in ("nodes", "size", "corners", "fields", "width")),
        *((name, Int32) for name in ("dofs", "points")),
        *((name, Float64) for name in ("x", "constants")),
    )


class CellSubsetAssembler:
    """Assembler of a form with one integral, over any of its cells."""

    def __init__(self, form: CellForm) -> None:
        self._form, self._fields = form, form_fields(form)
        nodes, size = form_cell_nodes(form), form.function_spaces[0].dofmap.index_map_bs
        points, corners = form.mesh.geometry.x, cell_geometry(form.mesh.geometry)
        self._constants = kernel_constants(form.whole)
        self._pointers = [struct_pointer(array) for array in (nodes, corners, points, self._constants)]
        width = sum(field.dofs.shape[1] * field.size for field in self._fields)
        sizes = nodes.shape[1], size, corners.shape[1], len(self._fields), width
        self._arguments = _SubsetForm(kernel_address(form), *sizes, *self._pointers)
        self._current_fields = self._field_table({})

    def add_cells(
        self, cells: npt.NDArray[np.int64], values: Values, instead: Mapping[int, Values] | None = None
    ) -> None:
        """Add the integral over cells to the values of dofs.

        Args:
            cells: (k,) local cells, ascending.
            values: (dofs,) of this rank, ghosts included; added to.
            instead: values of fields in place of those whose array begins at an address.
        """
        self._constants[:] = kernel_constants(self._form.whole)
        fields = self._field_table(instead) if instead else self._current_fields
        _code().add(byref(self._arguments), byref(fields), len(cells), cells, values)

    def _field_table(self, instead: Mapping[int, Values]) -> Array[_SubsetField]:
        """Fields as C has them, with other values in place of those whose array begins at an address."""
        arrays = [instead.get(field.values.ctypes.data, field.values) for field in self._fields]
        return (_SubsetField * (len(arrays) + 1))(
            *(_SubsetField(field.dofs.shape[1], field.size, struct_pointer(field.dofs), struct_pointer(array))
              for field, array in zip(self._fields, arrays, strict=True))
        )  # fmt: skip


@cache
def _code() -> Any:
    return load_library(SOURCE)
