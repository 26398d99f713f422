"""Normal stress along the edges of a simplex, and the stress that is left when some edges carry none.

With barycentric gradients g_i the tensors -sym(g_i x g_j), i < j, are dual to the dyads d_ij x d_ij of the edge vectors
d_ij = x_j - x_i, because d_kl . g_i = delta_il - delta_ik. Hence for every symmetric tensor

    s = - sum_{i<j} (d_ij . s . d_ij) sym(g_i x g_j),

which is M22's T^-1 in closed form: no 6 x 6 matrix is inverted, and triangles and tetrahedra share the line. Leaving
broken edges out of the sum is T^-1 diag(integrity) T of M22 eqs. 16-18, with the factor 2 on shear terms that M22
eq. 12 lacks.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..forms.kinematics import SYMMETRIC_COMPONENTS
from ..mesh.simplices import local_edges
from ..mesh.small_matrices import barycentric_gradients

Values = npt.NDArray[np.float64]


def edge_vectors(corners: Values) -> Values:
    """(n, k, d) vectors d_ij = x_j - x_i of the local edges of simplices with (n, d + 1, d) corners."""
    i, j = local_edges(corners.shape[2]).T
    return corners[:, j] - corners[:, i]


def quadratic_form(components: Values, vectors: Values) -> Values:
    """(n, k) values d . s . d of symmetric tensors, given by their (n, 3 or 6) components, on (n, k, d) vectors."""
    pairs = SYMMETRIC_COMPONENTS[vectors.shape[2]]
    result = np.zeros(vectors.shape[:2])
    for column, (i, j) in enumerate(pairs):
        factor = 1.0 if i == j else 2.0
        result += factor * components[:, column, None] * vectors[:, :, i] * vectors[:, :, j]
    return result


def frobenius_norm(components: Values, dim: int) -> Values:
    """(n,) sqrt(s : s) of symmetric tensors given by their components; no normal stress is larger."""
    normal, shear = components[:, :dim], components[:, dim:]
    square = np.einsum("ni,ni->n", normal, normal) + 2 * np.einsum("ni,ni->n", shear, shear)
    return np.asarray(np.sqrt(square))


def greatest_pull(components: Values, dim: int) -> Values:
    """(n,) tr s / d + sqrt(1 - 1/d) |dev s|, or 0: no normal stress is larger, and in 2D one is as large.

    A convex function of s that grows in proportion to it: that of an average is at most the average of it.
    """
    columns = list(components.T)  # one after the other: sums over short rows take several times as long
    mean = sum(columns[1:dim], columns[0]) / dim
    square = np.zeros(len(components))
    for number, column in enumerate(columns):
        square += (column - mean) ** 2 if number < dim else 2 * column**2
    return np.maximum(mean + np.sqrt((1 - 1 / dim) * square), 0.0)


def normal_stress(components: Values, vectors: Values) -> Values:
    """(n, k) normal stress n . s . n along each edge, in the unit of s; n is the unit vector of the edge."""
    length2 = np.einsum("nki,nki->nk", vectors, vectors)
    form = quadratic_form(components, vectors)
    return np.divide(form, length2, out=np.zeros_like(form), where=length2 > 0)


def carried_by(components: Values, corners: Values, intact: npt.NDArray[np.bool_]) -> Values:
    """(n, 3 or 6) components of the part of s that the intact edges ((n, k) flags) carry; zero in flat cells."""
    regular = _is_regular(corners)
    result = np.zeros_like(components)
    part, flags = corners[regular], intact[regular]
    forms = np.where(flags, quadratic_form(components[regular], edge_vectors(part)), 0.0)
    gradients = barycentric_gradients(part)
    i, j = local_edges(corners.shape[2]).T
    a, b = gradients[:, i], gradients[:, j]
    columns = [
        -np.sum(forms * (a[:, :, p] * b[:, :, q] + a[:, :, q] * b[:, :, p]) / 2, axis=1)
        for p, q in SYMMETRIC_COMPONENTS[corners.shape[2]]
    ]
    result[regular] = np.stack(columns, axis=1)
    return result


def _is_regular(corners: Values) -> npt.NDArray[np.bool_]:
    """Whether the gradients are safe: the volume is not lost in the round-off of the edge lengths."""
    basis = corners[:, 1:] - corners[:, :1]
    longest = np.sqrt(np.max(np.einsum("nij,nij->ni", basis, basis), axis=1, initial=0.0))
    return np.abs(np.linalg.det(basis)) > 1e-12 * longest ** corners.shape[2]
