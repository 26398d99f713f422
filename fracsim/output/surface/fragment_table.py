"""The pieces of a body: mass, volume, centre, velocity and spin, and names that stay with them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ...mesh.split_surface.polyhedron_moments import cones

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Fragments:
    """Figures of p pieces.

    Attributes:
        name: (p,) number that stays with the piece over time.
        nodes: (p,) how many.
        mass: (p,) kg (2D: of the thickness that the density is given for), the sum of the lumped nodal masses.
        volume: (p,) m^3 (2D: m^2) that the split surface encloses in the reference configuration.
        centre, velocity: (p, d) of mass, m and m/s.
        spin: (p, 3) rad/s; 2D: (p, 1). The least-squares solution of (tensor of inertia) spin = angular momentum, so 0
            about axes that a piece of one node, or of nodes in line, has no inertia about.
        turn: (p, 3) rotation vector since the start, rad, of rigid pieces; None of others.
    """

    name: Ints
    nodes: Ints
    mass: Values
    volume: Values
    centre: Values
    velocity: Values
    spin: Values
    turn: Values | None = None


def fragments(name: Ints, piece_of_node: Ints, mass: Values, volume: Values, x: Values, v: Values) -> Fragments:
    """Figures of the pieces from nodal masses (N,) in kg, current places x (N, d) and velocities v (N, d)."""

    def total(values: Values) -> Values:
        return sums(piece_of_node, values, len(name))

    weight = total(mass)
    centre, velocity = (total(mass[:, None] * each) / weight[:, None] for each in (x, v))
    spin = _spin(total, mass, x - centre[piece_of_node], v - velocity[piece_of_node])
    nodes = np.bincount(piece_of_node, minlength=len(name))
    return Fragments(name, nodes, weight, volume, centre, velocity, spin)


def _spin(total: Callable[[Values], Values], mass: Values, r: Values, w: Values) -> Values:
    """Spin of each piece from arms r and velocities w (N, d) about its centre of mass; `total` sums over its nodes.

    L = sum m r x w,   I = sum m (r.r 1 - r r^T)
    """
    if r.shape[1] == 2:
        momentum = total(mass * (r[:, 0] * w[:, 1] - r[:, 1] * w[:, 0]))
        inertia = total(mass * np.einsum("ni,ni->n", r, r))
        return np.divide(momentum, inertia, out=np.zeros_like(momentum), where=inertia > 0)[:, None]
    momentum = total(mass[:, None] * np.cross(r, w))
    second = total(mass[:, None] * np.einsum("ni,nj->nij", r, r).reshape(-1, 9)).reshape(-1, 3, 3)
    inertia = np.einsum("nii->n", second)[:, None, None] * np.eye(3) - second
    # an axis with less than 1e-9 of the largest moment has none: what is left there is round-off of the sums
    spin: Values = np.einsum("nij,nj->ni", np.linalg.pinv(inertia, rcond=1e-9, hermitian=True), momentum)
    return spin


def volumes(points: Values, elements: Ints, piece: Ints, count: int) -> Values:
    """(count,) m^3 (2D: m^2) enclosed by closed surfaces (outlines) of points (n, d): divergence theorem.

    V = 1/6 sum x_0 . (x_1 x x_2) over triangles; 2D: A = 1/2 sum x_0 x x_1 over segments.
    """
    x = (points - points.mean(axis=0))[elements]  # near the origin: less cancels
    return sums(piece, cones(x), count)


def sums(group: Ints, values: Values, count: int) -> Values:
    """(count,) or (count, k) sums of the values (n,) or (n, k) of each group. (A sparse matrix would, too, but
    to import SciPy takes 0.13 s of a start.)"""
    columns = [np.bincount(group, each, minlength=count) for each in values.reshape(len(group), -1).T]
    return np.asarray(columns, float).T.reshape(count, *values.shape[1:])


class PieceNames:
    """Numbers that stay with a piece over time.

    Damage does not heal, so a piece is part of one earlier piece. Of its parts the one with the largest mass keeps the
    name, where masses are equal the one with the lowest node; others get new names in the order of their lowest node.
    """

    def __init__(self) -> None:
        self._of_node: Ints | None = None
        self._next = 0

    def update(self, pieces: int, piece_of_node: Ints, mass: Values) -> Ints:
        """(pieces,) names; the pieces are numbered by their lowest node."""
        names: Ints = np.zeros(pieces, np.int64)
        fresh: Ints = np.arange(pieces)
        if self._of_node is not None:
            names[:] = self._of_node[np.unique(piece_of_node, return_index=True)[1]]
            fresh = _not_heaviest(names, sums(piece_of_node, mass, pieces))
        names[fresh] = self._next + np.arange(len(fresh))
        self._next += len(fresh)
        self._of_node = names[piece_of_node]
        return names


def _not_heaviest(names: Ints, mass: Values) -> Ints:
    """Pieces that are not the heaviest of their name, ascending."""
    rounded = np.round(mass / mass.sum(), 12)  # halves of a symmetric body are equal
    order = np.lexsort((np.arange(len(names)), -rounded, names))
    first = np.unique(names[order], return_index=True)[1]
    return np.sort(np.delete(order, first))
