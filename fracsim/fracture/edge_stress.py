"""Normal stress along the edges of a simplex, and the stress that is left when some edges carry none.

With barycentric gradients g_i the tensors -sym(g_i x g_j), i < j, are dual to the dyads d_ij x d_ij of the edge vectors
d_ij = x_j - x_i, because d_kl . g_i = delta_il - delta_ik. Hence for every symmetric tensor

    s = - sum_{i<j} (d_ij . s . d_ij) sym(g_i x g_j),

which is M22's T^-1 in closed form: no 6 x 6 matrix is inverted, and triangles and tetrahedra share the line. Leaving
broken edges out of the sum is T^-1 diag(integrity) T of M22 eqs. 16-18, with the factor 2 on shear terms that M22
eq. 12 lacks.

These are dozens of small sums for each of a few hundred cells in every step: in edge_stress.c, which is compiled where
it is needed first, they take a tenth of the time of arrays.
"""

from __future__ import annotations

from ctypes import c_int64
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ..mesh.compiled import at, library
from ..mesh.simplices import local_edges

Values = npt.NDArray[np.float64]
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
    return _of_each("pull", dim, (len(components),), components)


def normal_stress(components: Values, corners: Values) -> Values:
    """(n, k) normal stress n . s . n along the edges of simplices with (n, d + 1, d) corners, in the unit of s; n is
    the unit vector of an edge."""
    return _of_each("normal", corners.shape[2], components.shape, components, corners)


def share_carried(components: Values, corners: Values, integrity: Values) -> Values:
    """(n,) sum of integrity |n . s . n| over the edges of a cell, as a share of that of whole ones (M22 eq. 28);
    `integrity`: (n, k). 1 where nothing is loaded."""
    return _of_each("share", corners.shape[2], (len(components),), components, corners, integrity)


def carried_by(components: Values, corners: Values, intact: Flags) -> Values:
    """(n, 3 or 6) components of the part of s that the intact edges ((n, k) flags) carry; zero in flat cells."""
    return _of_each("carried", corners.shape[2], components.shape, components, corners, intact)


def _of_each(function: str, dim: int, shape: tuple[int, ...], *given: npt.NDArray[Any]) -> Values:
    """What a function of edge_stress.c makes of each cell."""
    found, arrays = np.empty(shape), [np.ascontiguousarray(each) for each in given]
    code = getattr(library(SOURCE, as_arrays=True), function)
    code(c_int64(dim), c_int64(shape[0]), *map(at, arrays), at(found))
    return found
