"""Principal stress: its largest value, its direction, and the material plane that is normal to it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ...forms.kinematics import SYMMETRIC_COMPONENTS
from ..strength import hashed

Values = npt.NDArray[np.float64]

# Principal stresses closer than this share of the largest one are one: their directions are noise of the solver.
SAME = 1e-3


def tensors(components: Values, dim: int) -> Values:
    """(n, d, d) symmetric tensors from their (n, 3 or 6) components, which lie one after the other in memory."""
    result = np.empty((dim, dim, len(components))).transpose(2, 0, 1)
    for column, (i, j) in enumerate(SYMMETRIC_COMPONENTS[dim]):
        result[:, i, j] = result[:, j, i] = components[:, column]
    return result


def upper_bound(stress: Values) -> Values:
    """(n,) bound of the largest eigenvalue of (n, d, d) tensors (Gershgorin's discs): most cells need no more."""
    diagonal = np.einsum("nii->ni", stress)
    radius = np.abs(stress).sum(axis=2) - np.abs(diagonal)
    return np.asarray((diagonal + radius).max(axis=1))


def largest(stress: Values) -> Values:
    """(n,) largest principal stress of (n, d, d) tensors."""
    return np.asarray(np.linalg.eigvalsh(stress)[:, -1])


def directions(stress: Values, places: Values, seed: int) -> Values:
    """(n, d) unit directions of the largest principal stress, without a sense.

    Where several principal stresses are the largest every direction among theirs is as good: one is drawn from the
    seed and the bits of the place (n, d), so that it is the same at any number of ranks.
    """
    values, vectors = np.linalg.eigh(stress)
    size = np.abs(values).max(axis=1, keepdims=True)
    among = values >= values[:, -1:] - SAME * size
    result = vectors[:, :, -1].copy()
    several = np.flatnonzero(among.sum(axis=1) > 1)
    if len(several):
        d = stress.shape[1]
        draw = np.column_stack([hashed(places[several], d * seed + axis) for axis in range(d)])
        shares = np.einsum("nij,ni->nj", vectors[several], draw) * among[several]
        result[several] = np.einsum("nij,nj->ni", vectors[several], shares)
    return unit(result)


def material_normals(direction: Values, gradient: Values) -> Values:
    """(n, d) unit reference normals N ~ F^T n of the material planes whose present normals are n, from F (n, d, d).

    A tangent t = F T of the plane has n . F T = (F^T n) . T = 0.
    """
    return unit(np.einsum("nji,nj->ni", gradient, direction))


def unit(vectors: Values) -> Values:
    """Vectors of length 1; those of no length become the first axis."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    first = np.eye(vectors.shape[-1])[0]
    return np.where(length > 0, vectors / np.where(length > 0, length, 1.0), first)
