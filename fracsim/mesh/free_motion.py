"""Rigid motions that the supports of a body leave free. DOLFINx is not imported here."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..meshes.data import AXES

Values = npt.NDArray[np.float64]


def describe_free_motion(points: Values, held: npt.NDArray[np.bool_]) -> str:
    """A rigid motion, in words, that the prescribed components leave free; empty if there is none.

    The rows of A are the values of the rigid modes at the prescribed components, with lengths scaled by the size of the
    body. A motion c is free if A c = 0, that is, if A^T A has a zero eigenvalue.

    `points`: (n, d), m.    `held`: (n, d) flags of the prescribed components.
    """
    d = points.shape[1]
    X = points - points.mean(axis=0)
    X = X / max(float(np.abs(X).max()), 1e-300)
    modes = [np.broadcast_to(axis, X.shape) for axis in np.eye(d)]
    names = [f"moving along {axis}" for axis in AXES[:d]]
    for i, j, name in ((0, 1, "z"), (1, 2, "x"), (2, 0, "y"))[: 1 if d == 2 else 3]:
        turn = np.zeros_like(X)
        turn[:, i], turn[:, j] = -X[:, j], X[:, i]
        modes.append(turn)
        names.append(f"turning about {name}")
    A = np.stack([mode[held] for mode in modes], axis=1)
    # translations first, since a rotation about a distant axis also moves the centre
    for first, count in ((0, d), (d, len(modes))):
        values, vectors = np.linalg.eigh(A[:, :count].T @ A[:, :count])
        if values[0] <= 1e-10 * max(values[-1], 1.0):
            return names[first + int(np.argmax(np.abs(vectors[first:, 0])))]
    return ""


def unsupported_message(which: str, motion: str) -> str:
    """The message for a body that no support holds against a rigid motion."""
    return (
        f"boundary: nothing holds {which} against {motion}; a quasi-static study needs every body held: "
        'add a [[boundary]] with fix or displacement, or choose a scheme with inertia (time.scheme = "newmark")'
    )
