"""Mass, volume, centre, velocity and spin of the fragments, and names that stay with them over time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ...mesh.parallel import sum_over_ranks
from ...mesh.split_surface.polyhedron_moments import cone_volumes

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class FragmentTable:
    """Figures of p fragments.

    Attributes:
        name: numbers (p,) that stay with the fragments over time.
        nodes: numbers (p,) of nodes.
        mass: masses (p,), kg, the sums of the lumped nodal masses. In 2D for the thickness of the given density.
        volume: volumes (p,), m^3 (2D: m^2), enclosed by the split surface in the reference configuration.
        centre: centres of mass (p, d), m.
        velocity: velocities (p, d) of the centres of mass, m/s.
        spin: angular velocities (p, 3), rad/s; 2D: (p, 1). They are the least-squares solution of
            (tensor of inertia) spin = angular momentum, and so 0 about axes without inertia, as of collinear nodes.
        rotation: rotation vectors (p, 3) since the start, rad, of rigid fragments; None for deformable ones.
    """

    name: Ints
    nodes: Ints
    mass: Values
    volume: Values
    centre: Values
    velocity: Values
    spin: Values
    rotation: Values | None = None


def tabulate_fragments(
    name: Ints,
    fragment_of_node: Ints,
    mass: Values,
    volume: Values,
    x: Values,
    v: Values,
    total: Callable[[npt.NDArray[Any]], npt.NDArray[Any]] = np.asarray,
) -> FragmentTable:
    """Figures of deformable fragments, from the nodes that this rank owns (collective).

    Args:
        name: names (p,) of the fragments.
        fragment_of_node: fragment (N,) of each node.
        mass: lumped masses (N,) of the nodes, kg.
        volume: volumes (p,), m^3 (2D: m^2).
        x: present positions (N, d) of the nodes, m.
        v: velocities (N, d) of the nodes, m/s.
        total: sum of an array over the ranks; by default there is one rank.
    """

    def sum_nodes(values: Values) -> Values:
        return total(group_sums(fragment_of_node, values, len(name)))

    weight = sum_nodes(mass)
    centre, velocity = (sum_nodes(mass[:, None] * values) / weight[:, None] for values in (x, v))
    r = x - centre[fragment_of_node]
    # distances that are round-off of the centre: all masses of the fragment may be at one point
    r[np.linalg.norm(r, axis=1) <= 1e-12 * np.linalg.norm(x, axis=1)] = 0.0
    spin = _spin(sum_nodes, mass, r, v - velocity[fragment_of_node])
    nodes = total(np.bincount(fragment_of_node, minlength=len(name)))
    return FragmentTable(name, nodes, weight, volume, centre, velocity, spin)


def _spin(sum_nodes: Callable[[Values], Values], mass: Values, r: Values, w: Values) -> Values:
    """Angular velocities (p, 3) or (p, 1), rad/s, with I spin = L.

    L = sum m r x w,   I = sum m (r.r 1 - r r^T)

    Args:
        sum_nodes: returns the sums of nodal values over each fragment.
        mass: lumped masses (N,), kg.
        r: positions (N, d) relative to the centre of mass, m.
        w: velocities (N, d) relative to the centre of mass, m/s.
    """
    if r.shape[1] == 2:
        momentum = sum_nodes(mass * (r[:, 0] * w[:, 1] - r[:, 1] * w[:, 0]))
        inertia = sum_nodes(mass * np.einsum("ni,ni->n", r, r))
        return np.divide(momentum, inertia, out=np.zeros_like(momentum), where=inertia > 0)[:, None]
    momentum = sum_nodes(mass[:, None] * np.cross(r, w))
    second = sum_nodes(mass[:, None] * np.einsum("ni,nj->nij", r, r).reshape(-1, 9)).reshape(-1, 3, 3)
    inertia = np.einsum("nii->n", second)[:, None, None] * np.eye(3) - second
    # moments below 1e-9 of the largest are round-off of the sums: no rotation about such an axis
    spin: Values = np.einsum("nij,nj->ni", np.linalg.pinv(inertia, rcond=1e-9, hermitian=True), momentum)
    return spin


def enclosed_volumes(points: Values, elements: Ints, fragment: Ints, count: int) -> Values:
    """Volumes (count,), m^3 (2D: m^2), enclosed by closed surfaces, by the divergence theorem.

    V = 1/6 sum x_0 . (x_1 x x_2) over triangles; 2D: A = 1/2 sum x_0 x x_1 over segments.

    Args:
        points: positions (n, d), m; near the origin there is less cancellation.
        elements: triangles (k, 3) or segments (k, 2), oriented outwards.
        fragment: fragment (k,) of each element.
        count: number of fragments.
    """
    return group_sums(fragment, cone_volumes(points[elements]), count)


def group_sums(group: Ints, values: Values, count: int) -> Values:
    """Sums (count,) or (count, k) of values (n,) or (n, k) over each group.

    Args:
        group: group (n,) of each value.
        values: the values.
        count: number of groups.
    """
    # bincount and no sparse matrix: to import scipy.sparse takes 0.13 s
    table = values.reshape(len(group), int(np.prod(values.shape[1:])))
    columns = [np.bincount(group, column, minlength=count) for column in table.T]
    return np.asarray(columns, float).T.reshape(count, *values.shape[1:])


class FragmentNames:
    """Numbers that stay with a fragment over time.

    Damage does not heal, so each fragment is part of one earlier fragment. The heaviest part of a fragment keeps its
    name; of equally heavy parts the one with the lowest node. The others get new names in the order of their lowest
    node.
    """

    def __init__(self, comm: MPI.Intracomm = MPI.COMM_SELF) -> None:
        """`comm`: ranks that have nodes of the fragments."""
        self._comm = comm
        self._of_node: Ints | None = None
        self._next = 0

    def update(self, count: int, fragment_of_node: Ints, mass: Values) -> Ints:
        """Names (count,) of the present fragments (collective).

        Args:
            count: number of fragments; they are numbered by their lowest node.
            fragment_of_node: fragment (N,) of each node.
            mass: masses (N,) of the nodes, kg; the sums over the ranks count.
        """
        names: Ints = np.zeros(count, np.int64)
        unnamed: Ints = np.arange(count)
        if self._of_node is not None:
            # all nodes of a fragment have been in one
            names[fragment_of_node] = self._of_node
            weight = group_sums(fragment_of_node, mass, count)
            if self._comm.size > 1:
                self._comm.Allreduce(MPI.IN_PLACE, names, MPI.MAX)
                weight = sum_over_ranks(self._comm, weight)
            unnamed = _lighter_parts(names, weight)
        names[unnamed] = self._next + np.arange(len(unnamed))
        self._next += len(unnamed)
        self._of_node = names[fragment_of_node]
        return names


def _lighter_parts(names: Ints, mass: Values) -> Ints:
    """Fragments, ascending, that are not the heaviest with their name."""
    # halves of a symmetric body count as equally heavy
    rounded = np.round(mass / mass.sum(), 12)
    order = np.lexsort((np.arange(len(names)), -rounded, names))
    first = np.unique(names[order], return_index=True)[1]
    return np.sort(np.delete(order, first))
