"""What closed surfaces of triangles enclose: how much, and which points."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ..topology import Floats

AT_ONCE = 1_000_000  # pairs of a point and a triangle


def enclosed_volumes(points: Floats, triangles: npt.NDArray[np.integer]) -> Floats:
    """The triangles' shares x_0 . (x_1 x x_2) / 6 of the enclosed volume (divergence theorem) [m^3]: (k,)."""
    a, b, c = (points - points.mean(axis=0))[triangles].transpose(1, 0, 2)
    return np.asarray(np.einsum("ki,ki->k", a, np.cross(b, c)) / 6)


def winding_numbers(x: Floats, corners: Floats) -> Floats:
    """(n,) how often triangles (k, 3, 3) wind around points x (n, 3): the sums of their solid angles over 4 pi.

    tan(omega / 2) = a . (b x c) / (|a||b||c| + (a . b)|c| + (b . c)|a| + (c . a)|b|)   (Van Oosterom, Strackee 1983)
    """
    return np.concatenate([_windings(part, corners) for part in parts(x, len(corners))])


def _windings(x: Floats, corners: Floats) -> Floats:
    a, b, c = (corners[None] - x[:, None, None]).transpose(2, 0, 1, 3)
    la, lb, lc = (np.linalg.norm(item, axis=2) for item in (a, b, c))
    ab, bc, ca = (np.einsum("nki,nki->nk", *pair) for pair in ((a, b), (b, c), (c, a)))
    above = np.einsum("nki,nki->nk", a, np.cross(b, c))
    return np.asarray(np.arctan2(above, la * lb * lc + ab * lc + bc * la + ca * lb).sum(axis=1) / (2 * np.pi))


def parts(x: Floats, count: int) -> list[Floats]:
    """Of points (n, 3), each few enough for `count` triangles at once."""
    return np.array_split(x, 1 + len(x) * count // AT_ONCE)
