"""Principal stress: its largest value, its direction, and the material plane normal to that direction."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..forms.kinematics import SYMMETRIC_COMPONENTS
from .strength import hash_points, round_points

Values = npt.NDArray[np.float64]

# Principal stresses that differ by less than this share of the largest one count as equal: the difference of their
# directions is noise of the solver.
EQUAL_STRESS_TOLERANCE = 1e-3


def symmetric_tensors(components: Values, dim: int) -> Values:
    """Return symmetric tensors (n, d, d) from components (n, 3 or 6); in memory one component follows the other."""
    result = np.empty((dim, dim, len(components))).transpose(2, 0, 1)
    for column, (i, j) in enumerate(SYMMETRIC_COMPONENTS[dim]):
        result[:, i, j] = result[:, j, i] = components[:, column]
    return result


def first_principal_stress(stress: Values) -> Values:
    """Return the largest principal stress (n,) of tensors (n, d, d)."""
    return np.asarray(np.linalg.eigvalsh(stress)[:, -1])


def tensile_part(components: Values, dim: int) -> Values:
    """Return the components (n, 3 or 6) of sum max(s_i, 0) n_i n_i, s_i the principal stresses of (n, 3 or 6)."""
    values, vectors = np.linalg.eigh(symmetric_tensors(components, dim))
    scaled = np.maximum(values, 0)[:, None] * vectors
    return np.stack([np.einsum("nk,nk->n", scaled[:, i], vectors[:, j]) for i, j in SYMMETRIC_COMPONENTS[dim]], axis=1)


def first_principal_directions(stress: Values, points: Values, size: float, seed: int = 0) -> Values:
    """Return unit directions (n, d) of the largest principal stress; their sign is arbitrary.

    If several principal stresses are equal to the largest one, a direction of their eigenspace is drawn.

    Args:
        stress: (n, d, d), Pa.
        points: (n, d) from which directions are drawn, m.
        size: length of the body, m: points that differ by its round-off have the same directions.
        seed: seed of the draws.
    """
    values, vectors = np.linalg.eigh(stress)
    largest = np.abs(values).max(axis=1, keepdims=True)
    is_largest = values >= values[:, -1:] - EQUAL_STRESS_TOLERANCE * largest
    result = vectors[:, :, -1].copy()
    multiple = np.flatnonzero(is_largest.sum(axis=1) > 1)
    if len(multiple):
        # Hashed from the points, so that the directions are the same on any number of ranks.
        d = stress.shape[1]
        rounded = round_points(points[multiple], size)
        draw = np.column_stack([hash_points(rounded, d * seed + axis) for axis in range(d)])
        shares = np.einsum("nij,ni->nj", vectors[multiple], draw) * is_largest[multiple]
        result[multiple] = np.einsum("nij,nj->ni", vectors[multiple], shares)
    return unit_or_first_axis(result)


def material_normals(direction: Values, gradient: Values) -> Values:
    """Return unit reference normals N ~ F^T n (n, d) of material planes with present normals n (n, d).

    A tangent t = F T of the plane has n . F T = (F^T n) . T = 0. `gradient` is F (n, d, d).
    """
    return unit_or_first_axis(np.einsum("nji,nj->ni", gradient, direction))


def unit_or_first_axis(vectors: Values) -> Values:
    """Return vectors (..., d) of length 1; vectors of no length become the first axis."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    first = np.eye(vectors.shape[-1])[0]
    return np.where(length > 0, vectors / np.where(length > 0, length, 1.0), first)
