"""The bodies of a mesh, and the rigid motions that its supports leave free. No DOLFINx here."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..meshes.components import components
from ..meshes.data import MeshData
from ..meshes.text import AXES

Values = npt.NDArray[np.float64]


def bodies_of(mesh: MeshData) -> tuple[int, npt.NDArray[np.int64]]:
    """How many bodies share no node, and the body of each node."""
    first = np.repeat(mesh.cells[:, 0], mesh.cells.shape[1] - 1)
    return components(np.stack([first, mesh.cells[:, 1:].reshape(-1)], axis=1), len(mesh.points))


def free_motion(points: Values, held: npt.NDArray[np.bool_]) -> str:
    """A rigid motion in words that the held components ((n, d) flags) do not stop; empty where there is none.

    Rows of A are the values of the rigid modes at held components, lengths scaled by the body's size; a motion c is
    free where A c = 0, that is where A^T A has a zero eigenvalue.
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
    # translations by themselves first: turning about a line far from the middle moves the middle as well
    for first, count in ((0, d), (d, len(modes))):
        values, vectors = np.linalg.eigh(A[:, :count].T @ A[:, :count])
        if values[0] <= 1e-10 * max(values[-1], 1.0):
            return names[first + int(np.argmax(np.abs(vectors[first:, 0])))]
    return ""


def not_held(which: str, motion: str) -> str:
    """The message for a body that nothing holds."""
    return (
        f"boundary: nothing holds {which} against {motion}; a quasi-static study needs every body held: "
        'add a [[boundary]] with fix or displacement, or choose a scheme with inertia (time.scheme = "newmark")'
    )
