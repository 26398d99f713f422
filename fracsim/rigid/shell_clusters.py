"""Pieces of shells as unions of convex parts: hulls of clusters of their surface triangles, of all pieces at once.

A cluster is cut in two through its middle, across its longest axis, while its triangles lie off a plane by more (root
mean square, beyond the half thickness that two flat faces are off it) than

    s > max(ROUGH h, COARSE L),

with h the mean edge of the mesh and L the length of the piece: a cap of a ball, H high, has s = 0.29 H. Of the points
of a cluster those stay that are farthest along one of some directions.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from .convex_decomposition import PARTS, ROUGH, thickened

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

COARSE = 0.03  # of the length of a piece
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
AROUND, TILTED = 24, (-0.7, 0.0, 0.7)  # directions along which corners are kept


def clustered_parts(
    points: Values, triangles: Ints, piece: Ints, count: int, thickness: float, edge: float
) -> list[list[Values]]:
    """Corners (n, 3) of the parts of each of `count` pieces, m, from the closed surface of all: points (k, 3), m,
    triangles (m, 3), and the piece (m,) that each is of; `edge`: the mean one of the mesh, m."""
    cluster, owner = clusters(points[triangles], piece, count, thickness, edge)
    code = np.unique((cluster[:, None] * len(points) + triangles).ravel())
    of, places = code // len(points), points[code % len(points)]
    kept = extreme(places, of)
    of, places = of[kept], places[kept]
    corners = np.split(places, np.searchsorted(of, np.arange(1, len(owner))))
    parts: list[list[Values]] = [[] for _ in range(count)]
    for number, each in zip(owner, corners, strict=True):
        parts[number].append(thickened(each))
    return parts


def clusters(corners: Values, piece: Ints, count: int, thickness: float, edge: float) -> tuple[Ints, Ints]:
    """(m,) clusters of triangles with corners (m, 3, 3), m, of pieces (m,), and (c,) the piece of each cluster."""
    cluster, owner, going = piece.copy(), np.arange(count), np.ones(count, bool)
    allowed = np.maximum(ROUGH * edge, COARSE * _lengths(corners, piece, count))
    sums = _sums(corners, piece, count)
    while going.any() and 2 * np.bincount(owner).max() <= PARTS:
        rows = np.flatnonzero(going[cluster])
        number, of = np.unique(cluster[rows], return_inverse=True)
        centre, spread = _spread(sums[:, rows], of, len(number))
        lengths, axes = np.linalg.eigh(spread)
        off = np.sqrt(np.maximum(lengths[:, 0] - (thickness / 2) ** 2, 0.0))
        bent = off > allowed[owner[number]]
        far = np.einsum("ni,ni->n", sums[1:4, rows].T / sums[0, rows, None] - centre[of], axes[of, :, 2]) > 0
        far &= bent[of]
        # one of two halves may be empty where a few triangles have one middle: it is none then
        number_of_half = np.full(len(number), -1)
        new = np.unique(of[far])
        number_of_half[new] = len(owner) + np.arange(len(new))
        cluster[rows[far]] = number_of_half[of[far]]
        going = np.zeros(len(owner) + len(new), bool)
        going[number[new]] = going[len(owner) :] = True
        owner = np.concatenate([owner, owner[number[new]]])
    return cluster, owner


def _lengths(corners: Values, piece: Ints, count: int) -> Values:
    """(count,) diagonals of the boxes around pieces, m."""
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, piece, corners.min(axis=1))
    np.maximum.at(high, piece, corners.max(axis=1))
    return np.asarray(np.linalg.norm(high - low, axis=1))


def _sums(corners: Values, piece: Ints, count: int) -> Values:
    """(10, m) areas, first and second moments of triangles (m, 3, 3) about the middle of their piece (m,):
    int x x^T dA = A (sum_k x_k x_k^T + s s^T) / 12, s the sum of the corners."""
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    area = np.maximum(area, 1e-30)
    many = np.bincount(piece, minlength=count)
    near = np.stack([np.bincount(piece, each, count) for each in corners.mean(axis=1).T], axis=1) / many[:, None]
    x = corners - near[piece, None]
    s = x.sum(axis=1)
    second = [area * ((x[:, :, i] * x[:, :, j]).sum(axis=1) + s[:, i] * s[:, j]) / 12 for i, j in PAIRS]
    return np.stack([area, *(area * s.T / 3), *second])


def _spread(sums: Values, of: Ints, count: int) -> tuple[Values, Values]:
    """(count, 3) centres and (count, 3, 3) mean squares about them of groups (m,) of triangles with moments (10, m)."""
    area, *rest = (np.bincount(of, each, count) for each in sums)
    centre, second = np.stack(rest[:3], axis=1) / area[:, None], np.empty((count, 3, 3))
    for (i, j), each in zip(PAIRS, rest[3:], strict=True):
        second[:, i, j] = second[:, j, i] = each / area - centre[:, i] * centre[:, j]
    return centre, second


def extreme(places: Values, of: Ints) -> Flags:
    """(n,) which of the places (n, 3) of groups (n,), ascending, are the farthest of their group along one of some
    directions: AROUND its flattest plane, in it and TILTED out of it, where all of its axes are as long."""
    start = np.flatnonzero(np.diff(of, prepend=-1))
    group = np.cumsum(np.diff(of, prepend=-1) > 0) - 1
    many = np.diff(np.append(start, len(of)))[:, None]
    arm = places - (np.add.reduceat(places, start) / many)[group]
    square = np.einsum("ni,nj->nij", arm, arm).reshape(-1, 9)
    length2, axes = np.linalg.eigh(np.add.reduceat(square, start).reshape(-1, 3, 3) / many[:, None])
    axes = axes / np.sqrt(np.maximum(length2, 1e-8 * length2[:, -1:]))[:, None]
    high, *flat = np.einsum("ni,nij->jn", arm, axes[group])
    kept = np.zeros(len(places), bool)
    for turn in 2 * np.pi * np.arange(AROUND) / AROUND:
        within = np.cos(turn) * flat[0] + np.sin(turn) * flat[1]
        for tilt in TILTED:
            along = within + tilt * high
            kept |= along == np.maximum.reduceat(along, start)[group]
    return kept
