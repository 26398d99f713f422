"""Map from nodal displacements to the points of a split surface, linear, with reduced arms where contact needs it.

    x = mean over p of (x_p + s F_p (X - X_p)) = X_s + sum over nodes a of w_a u_a

F_p as in local_surface. With s = 1 the point is the material point; with s < 1 it is nearer to the nodes p. A new crack
face that would lie inside an obstacle starts with s < 1, since nodes lie deeper in the body than crack faces. For all s
affine motions of the reference position X_s are reproduced, and sum w_a = 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
import numpy.typing as npt
from scipy.sparse import bsr_matrix, csr_matrix, diags, kron

from .surface_motion import PointParents

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


class SurfaceMap:
    """Immutable map from nodal displacements to n points with shares s of their arms.

    Attributes:
        share: (n,) s.
        rest: (n, d) reference positions X_s, m.
    """

    def __init__(
        self, mean: csr_matrix, middle: Values, arms: csr_matrix, out: Values, share: Values | None = None
    ) -> None:
        """Matrices and vectors of the map.

        `mean`: (n, nodes) means over the parents.    `middle`: (n, d) mean reference position of the parents, m.
        `arms`: (n, nodes) means of arm times gradient.    `out`: (n, d) mean arm, m.    `share`: s, by default 1.
        """
        self._mean, self._middle, self._arms, self._out = mean, middle, arms, out
        self.share = np.ones(len(middle)) if share is None else share
        self.rest: Values = middle + self.share[:, None] * out

    @cached_property
    def copies(self) -> Ints:
        """(k,) points that have arms, including points whose arms cancel in the reference configuration."""
        armed = np.asarray(abs(self._arms).sum(axis=1)).ravel() > 0
        return np.flatnonzero(np.any(self._out != 0, axis=1) | armed)

    @cached_property
    def weights(self) -> csr_matrix:
        """(n, nodes) matrix of the weights w."""
        return (self._mean + diags(self.share) @ self._arms).tocsr()

    def with_arm_share(self, share: Values) -> SurfaceMap:
        """The map with shares `share` (n,) of the arms."""
        return SurfaceMap(self._mean, self._middle, self._arms, self._out, share)

    def move_points(self, points: Ints, positions: Values) -> SurfaceMap:
        """The map without nodes with `points` (k,) at positions (k, d), m, for s = 1."""
        out = self._out.copy()
        out[points] = positions - self._middle[points]
        return SurfaceMap(self._mean, self._middle, self._arms, out, self.share)

    def __call__(self, u: Values) -> Values:
        """(n, d) positions x for nodal displacements u (nodes, d), m."""
        return np.asarray(self.rest + self.weights @ u)

    def evaluate_points(self, u: Values, points: Ints, share: Values) -> Values:
        """(k, d) positions x of `points` (k,) with other shares (k,); u (nodes, d), m."""
        middle = self._middle[points] + self._mean[points] @ u
        return np.asarray(middle + share[:, None] * (self._out[points] + self._arms[points] @ u))

    def arm_ends(self, u: Values) -> list[Values]:
        """(n, d) positions x without arms and with full arms; u (nodes, d), m."""
        middle = self._middle + self._mean @ u
        return [middle, middle + self._out + self._arms @ u]

    # --- from points to nodes ---

    def nodal_forces(self, forces: Values) -> Values:
        """(nodes, d) forces on nodes of forces (n, d) on the points, N."""
        return np.asarray(self.weights.T @ forces)

    def nodal_stiffness(self, H: csr_matrix) -> csr_matrix:
        """(nodes d, nodes d) stiffness at the nodes of second derivatives H (n d, n d) at the points, N/m."""
        W, used = self._used_weights(H)
        return (W.T @ H[used][:, used] @ W).tocsr()

    def _used_weights(self, rows: csr_matrix) -> tuple[csr_matrix, Ints]:
        """(k d, nodes d) weights of the points with entries in `rows` (n d, m), and (k d,) their rows: mostly few."""
        d = self.rest.shape[1]
        points = np.unique(np.flatnonzero(np.diff(rows.indptr)) // d)
        used = (d * points[:, None] + np.arange(d)).reshape(-1)
        return kron(self.weights[points], np.eye(d), format="csr"), used


def placed_points(middle: Values, arm: Values) -> SurfaceMap:
    """A map without nodes: points at x = middle + s arm, (n, d), m, whose arms can still be shortened."""
    no_nodes = csr_matrix((len(middle), 0))
    return SurfaceMap(no_nodes, middle, no_nodes, arm)


def row_entries(matrix: csr_matrix, rows: Ints) -> tuple[Ints, Ints]:
    """(e,) entries of rows (k,) of a matrix, one row after another, and (e,) which of the rows each belongs to.

    For few rows a third of the time of SciPy's selection of rows.
    """
    lengths = np.diff(matrix.indptr)[rows]
    row = np.repeat(np.arange(len(rows)), lengths)
    starts = matrix.indptr[rows] - np.cumsum(lengths) + lengths
    return np.arange(len(row)) + starts[row], row


def nodal_stiffness(W: csr_matrix, groups: Sequence[tuple[Ints, Values]]) -> csr_matrix:
    """(m d, m d) W^T B W of blocks B at groups of points.

    Blocks are summed pair of nodes by pair: products of sparse matrices take ten times as long for few groups, and the
    sum of a matrix for each kind of group twice as long.

    Args:
        W: (n, m) weights of m nodes in the positions of n points.
        groups: (k, c) points of each group, and their (k, c d, c d) B; c may differ from kind to kind.
    """
    parts = [_blocks_of_nodes(W, corners, blocks) for corners, blocks in groups]
    first, second, values = (np.concatenate(part) for part in zip(*parts, strict=True))
    m, d = W.shape[1], values.shape[1]
    pair = first.astype(np.int64) * m + second
    order = np.argsort(pair, kind="stable")
    pair = pair[order]
    starts = np.flatnonzero(np.diff(pair, prepend=-1))
    row, column = np.divmod(pair[starts], m)
    data = np.add.reduceat(values[order], starts, axis=0) if len(starts) else values
    return bsr_matrix((data, column, np.searchsorted(row, np.arange(m + 1))), shape=(d * m, d * m)).tocsr()


def _blocks_of_nodes(W: csr_matrix, corners: Ints, blocks: Values) -> tuple[Ints, Ints, Values]:
    """(p,) first and (p,) second nodes, and (p, d, d) w_i w_j B_ij of all pairs of corners i, j of groups.

    As of `nodal_stiffness`.
    """
    (k, c), points = corners.shape, corners.reshape(-1)
    d = blocks.shape[1] // c
    entry, corner = row_entries(W, points)
    node, weight, group = W.indices[entry], W.data[entry], corner // c
    # pairs of entries of a group
    counts = np.bincount(group, minlength=k)
    partners, starts = counts[group], (np.cumsum(counts) - counts)[group]
    first = np.repeat(np.arange(len(entry)), partners)
    second = np.arange(len(first)) + np.repeat(starts - np.cumsum(partners) + partners, partners)
    B = blocks.reshape(k, c, d, c, d)[group[first], corner[first] % c, :, corner[second] % c]
    return node[first], node[second], (weight[first] * weight[second])[:, None, None] * B


def mean_parent_positions(points: Values, follow: PointParents) -> Values:
    """(n, d) mean reference positions of the parents of `points` (n, d), m."""
    start = follow.start
    result: Values = points - np.add.reduceat(follow.arm, start[:-1], axis=0) / np.diff(start)[:, None]
    return result


def gradient_entries(X: Values, share: Values, number: Ints) -> tuple[Ints, Ints, Values]:
    """Matrix entries (row, column, value) of the averages of d/dX_j around nodes: row d p + j, column a.

    `X` (cells, d + 1, d) corners, `number` (cells, d + 1) of their nodes, `share` (cells, d + 1) of each cell in the
    average around each of its nodes.
    """
    d = X.shape[2]
    # column k of the inverse of the rows X_k - X_0 is the gradient of corner k + 1
    inverse = np.linalg.inv(X[:, 1:] - X[:, :1])
    # axes: cell, component, corner
    slope = np.concatenate([-inverse.sum(axis=2)[:, :, None], inverse], axis=2)
    # axes: cell, node of the average, component, corner
    entries = share[:, :, None, None] * slope[:, None]
    rows = np.broadcast_to((d * number[:, :, None] + np.arange(d))[..., None], entries.shape)
    columns = np.broadcast_to(number[:, None, None, :], entries.shape)
    return rows.reshape(-1), columns.reshape(-1), entries.reshape(-1)
