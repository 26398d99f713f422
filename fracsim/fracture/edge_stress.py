"""Normal stress along the edges of simplices, and the stress that remains when some edges carry none.

With barycentric gradients g_i the tensors -sym(g_i x g_j), i < j, are dual to the dyads d_ij x d_ij of the edge vectors
d_ij = x_j - x_i, because d_kl . g_i = delta_il - delta_ik. Hence every symmetric tensor is

    s = - sum_{i<j} (d_ij . s . d_ij) sym(g_i x g_j).

This is T^-1 of M22 in closed form, in 2D and 3D. Without the broken edges in the sum it is T^-1 diag(integrity) T of
M22, eqs. 16-18, with the factor 2 of shear terms that M22, eq. 12, lacks.

The sums are computed in edge_stress.c. Equations: docs/theory.md#edge-criterion.
"""

from __future__ import annotations

from ctypes import CDLL, Structure, byref, c_int64
from functools import cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from ..mechanics.stress import Stress
from ..mesh.c_library import Float64, Int32, Uint8, load_library, struct_pointer
from ..mesh.simplices import local_edges

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
SOURCE = Path(__file__).with_suffix(".c")


def edge_vectors(corners: Values) -> Values:
    """Return the vectors d_ij = x_j - x_i (n, k, d) of the local edges of simplices with corners (n, d + 1, d)."""
    i, j = local_edges(corners.shape[2]).T
    return corners[:, j] - corners[:, i]


def normal_stress_bound(components: Values, dim: int) -> Values:
    """Return an upper bound (n,) of the first principal stress, not below 0, of tensors (n, 3 or 6).

    No normal stress is larger. In 2D it is that stress, in 3D at most 6 % of |dev s| / sqrt(6) above it. 1e-12 |s| is
    added for round-off. The first principal stress of an average is at most the average of the bounds, since it is
    convex and homogeneous of degree one.
    """
    result = np.empty(len(components))
    _code().normal_stress_bound(c_int64(dim), c_int64(len(components)), np.ascontiguousarray(components), result)
    return result


class _SimplexArrays(Structure):
    """Arrays of simplices, in the layout of edge_stress.c."""

    _fields_ = (("count", c_int64), ("nodes", Int32), ("rest", Float64), ("moved", Float64))


class _DamageArrays(Structure):
    """Arrays of damaged edges, in the layout of edge_stress.c."""

    _fields_ = (("edges", Int32), ("integrity", Float64), *((name, Uint8) for name in ("pattern", "damaged", "split")))


class EdgeDamage(Protocol):
    """Interface of edges of cells and their damage (mesh.edge_graph)."""

    @property
    def cell_edges(self) -> npt.NDArray[np.int32]:
        """(cells, k) local edges of cells."""

    @property
    def integrity(self) -> Values:
        """(edges,) 1 intact to 0 broken."""

    @property
    def pattern(self) -> npt.NDArray[np.uint8]:
        """(cells,) broken edges, one bit each."""

    @property
    def damaged(self) -> Flags:
        """(cells,) cells with a weakened edge."""

    @property
    def split(self) -> Flags:
        """(cells,) cells whose intact edges do not connect their corners."""


class EdgeStressOperator:
    """Maps the stress of simplices to normal stress along their edges, in the present configuration.

    Attributes:
        dim: 2 or 3.
    """

    def __init__(self, nodes: npt.NDArray[np.int32], rest: Values, moved: Values | None = None) -> None:
        """Store the cells.

        Args:
            nodes: (cells, d + 1) nodes of the cells.
            rest: (nodes, d) reference positions, m.
            moved: displacement of the nodes, m, read at every call; None for the reference configuration.
        """
        self.dim, self._count = rest.shape[1], len(nodes)
        # The C structure has addresses only: these references keep the arrays alive.
        self._arrays = struct_pointer(nodes), struct_pointer(rest), None if moved is None else struct_pointer(moved)
        self._cells = byref(_SimplexArrays(len(nodes), *self._arrays))

    @classmethod
    def from_stress(cls, stress: Stress) -> EdgeStressOperator:
        """Build the operator for the cells and the configuration of `stress`."""
        domain = stress.domain
        return cls(domain.cell_nodes, domain.nodes, None if stress.energy.linear else stress.u.x.array)

    def normal_stress(self, cells: Ints, components: Values) -> Values:
        """Return n . s . n (n, k) along the edges of cells (n,) under stress (n, 3 or 6), n the unit edge vector."""
        result = np.empty(components.shape)
        arguments = np.ascontiguousarray(cells), self._cells, np.ascontiguousarray(components), result
        _code().normal_stress(c_int64(self.dim), c_int64(len(cells)), *arguments)
        return result

    def intact_edge_stress(self, components: Values, damage: EdgeDamage) -> Values:
        """Return the part of the stress (cells, 3 or 6) that intact edges carry; 0 in split and in flat cells."""
        result = np.empty(components.shape)
        _code().intact_edge_stress(
            c_int64(self.dim), self._cells, _damage_arrays(damage), *_row_layout(components), result
        )
        return result

    def lower_chi(self, chi: Values, components: Values, damage: EdgeDamage) -> tuple[Ints, Values]:
        """Lower chi (cells,) in place to the share of the edge stress that intact edges carry (M22, eq. 28).

        chi = sum of integrity |n . s . n| over sum of |n . s . n|, over the edges of a damaged cell. It is 1 in an
        unloaded cell and 0 in a split one, and never increases.

        Returns:
            Cells (n,) whose chi decreased, and by how much (n,).
        """
        cells, drop = np.empty(self._count, np.int64), np.empty(self._count)
        arguments = *_row_layout(components), chi, cells, drop
        count = _code().lower_chi(c_int64(self.dim), self._cells, _damage_arrays(damage), *arguments)
        return cells[:count], drop[:count]


def _row_layout(values: Values) -> tuple[c_int64, Any]:
    """Return stride and address of rows, which may be the first columns of a wider table."""
    if values.strides[1] != values.itemsize:
        values = np.ascontiguousarray(values)
    return c_int64(values.strides[0] // values.itemsize), values[0] if len(values) else values


def _damage_arrays(damage: EdgeDamage) -> Any:
    """Return the C structure of `damage`, valid as long as its arrays live."""
    arrays: tuple[npt.NDArray[Any], ...] = (
        damage.cell_edges, damage.integrity, damage.pattern, damage.damaged, damage.split,
    )  # fmt: skip
    return byref(_DamageArrays(*map(struct_pointer, arrays)))


@cache
def _code() -> CDLL:
    """Return the compiled functions of edge_stress.c."""
    return load_library(SOURCE, separate_rounding=True)
