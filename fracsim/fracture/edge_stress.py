"""Normal stress along the edges of a simplex, and the stress that is left when some edges carry none.

With barycentric gradients g_i the tensors -sym(g_i x g_j), i < j, are dual to the dyads d_ij x d_ij of the edge vectors
d_ij = x_j - x_i, because d_kl . g_i = delta_il - delta_ik. Hence for every symmetric tensor

    s = - sum_{i<j} (d_ij . s . d_ij) sym(g_i x g_j),

which is M22's T^-1 in closed form: no 6 x 6 matrix is inverted, and triangles and tetrahedra share the line. Leaving
broken edges out of the sum is T^-1 diag(integrity) T of M22 eqs. 16-18, with the factor 2 on shear terms that M22
eq. 12 lacks.

These are dozens of small sums for each of a few hundred cells in every step: in edge_stress.c, which is compiled where
it is needed first, they take a tenth of the time of arrays.

Equations: docs/theory.md#edge-criterion.
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
    """(n, k, d) vectors d_ij = x_j - x_i of the local edges of simplices with (n, d + 1, d) corners."""
    i, j = local_edges(corners.shape[2]).T
    return corners[:, j] - corners[:, i]


def frobenius_norm(components: Values, dim: int) -> Values:
    """(n,) sqrt(s : s) of symmetric tensors given by their components; no normal stress is larger."""
    normal, shear = components[:, :dim], components[:, dim:]
    square = np.einsum("ni,ni->n", normal, normal) + 2 * np.einsum("ni,ni->n", shear, shear)
    return np.asarray(np.sqrt(square))


def greatest_pull(components: Values, dim: int) -> Values:
    """(n,) tr s / d + sqrt(1 - 1/d) |dev s|, or 0: no normal stress is larger, and in 2D one is as large.

    A convex function of s that grows in proportion to it: that of an average is at most the average of it.
    """
    found = np.empty(len(components))
    _code().pull(c_int64(dim), c_int64(len(components)), np.ascontiguousarray(components), found)
    return found


class _Given(Structure):
    """As edge_stress.c has it."""

    _fields_ = (("count", c_int64), ("nodes", Int32), ("rest", Float64), ("moved", Float64))


class _Damage(Structure):
    """The same."""

    _fields_ = (("edges", Int32), ("integrity", Float64), *((name, Uint8) for name in ("pattern", "damaged", "split")))


class Damage(Protocol):
    """Edges of cells and their damage (mesh.edge_graph)."""

    @property
    def cell_edges(self) -> npt.NDArray[np.int32]: ...
    @property
    def integrity(self) -> Values: ...
    @property
    def pattern(self) -> npt.NDArray[np.uint8]: ...
    @property
    def damaged(self) -> Flags: ...
    @property
    def split(self) -> Flags: ...


class Simplices:
    """Cells whose edges feel a stress, as they lie when they are asked.

    Attributes:
        dim: 2 or 3.
    """

    def __init__(self, nodes: npt.NDArray[np.int32], rest: Values, moved: Values | None = None) -> None:
        """(cells, d + 1) `nodes` at `rest` (nodes, d), m, and by how much these have `moved` from there."""
        self.dim, self._count = rest.shape[1], len(nodes)
        self._kept = struct_pointer(nodes), struct_pointer(rest), None if moved is None else struct_pointer(moved)
        self._all = byref(_Given(len(nodes), *self._kept))

    @classmethod
    def of(cls, stress: Stress) -> Simplices:
        """Cells in the configuration that a stress belongs to."""
        domain = stress.domain
        return cls(domain.cell_nodes, domain.nodes, None if stress.energy.linear else stress.u.x.array)

    def normal_stress(self, cells: Ints, components: Values) -> Values:
        """(n, k) normal stress n . s . n along the edges of cells (n,) under s (n, 3 or 6), in its unit; n is the unit
        vector of an edge."""
        found = np.empty(components.shape)
        given = np.ascontiguousarray(cells), self._all, np.ascontiguousarray(components), found
        _code().normal(c_int64(self.dim), c_int64(len(cells)), *given)
        return found

    def carried(self, components: Values, damage: Damage) -> Values:
        """(cells, 3 or 6) the part of s (cells, 3 or 6) that the intact edges of cells carry; zero in those that have
        come apart and in flat ones."""
        found = np.empty(components.shape)
        _code().carried(c_int64(self.dim), self._all, _damage(damage), *_rows(components), found)
        return found

    def lower(self, chi: Values, components: Values, damage: Damage) -> tuple[Ints, Values]:
        """Lower chi (cells,) of damaged cells to the sum of integrity |n . s . n| over their edges, as a share of that
        of whole ones (M22 eq. 28), 1 where nothing is loaded; of those that have come apart to 0.

        Returns (n,) cells that lost anything, and how much.
        """
        cells, lost = np.empty(self._count, np.int64), np.empty(self._count)
        given = *_rows(components), chi, cells, lost
        many = _code().lower(c_int64(self.dim), self._all, _damage(damage), *given)
        return cells[:many], lost[:many]


def _rows(values: Values) -> tuple[c_int64, Any]:
    """How far rows are apart that may be the first columns of a table, and where they begin."""
    if values.strides[1] != values.itemsize:
        values = np.ascontiguousarray(values)
    return c_int64(values.strides[0] // values.itemsize), values[0] if len(values) else values


def _damage(of: Damage) -> Any:
    """Damage as C has it: its arrays live as long as they do in Python."""
    arrays: tuple[npt.NDArray[Any], ...] = of.cell_edges, of.integrity, of.pattern, of.damaged, of.split
    return byref(_Damage(*map(struct_pointer, arrays)))


@cache
def _code() -> CDLL:
    return load_library(SOURCE, separate_rounding=True)
