"""Prescribed displacements as functions of time, and the check that they support every body.

Without inertia a body with a free rigid motion has no unique displacement.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI

from ..errors import InputError
from ..mesh.domain import Domain, Ints
from ..mesh.fragments import find_bodies
from ..mesh.free_motion import describe_free_motion, unsupported_message
from ..mesh.parallel import on_root
from ..meshes.data import format_midpoint
from .time_functions import PlacedFunction, TimeFunction

Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Entry = tuple[Ints, Flags, TimeFunction]  # local nodes, (d,) prescribed components, displacement (d,) in m


class PrescribedMotion:
    """Prescribed displacement of components of nodes. Of two entries for one component the later one is used.

    Attributes:
        dofs: sorted unrolled local dofs (node * d + component), ghosts included.
        owned_dofs: those of `dofs` that this rank owns; they come first.
        free_dofs: (owned dofs,) flags of all others.
        values: (owned_dofs,) prescribed displacements of `owned_dofs`, m.
        bcs: Dirichlet condition with the values of `set_values`; empty if no dof of any rank is prescribed.
        notes: sentences for the user.
    """

    def __init__(self, domain: Domain, entries: Sequence[Entry], notes: Sequence[str] = ()) -> None:
        """`entries`: local nodes, (d,) flags of their prescribed components, and displacement (d,) in m.

        A `PlacedFunction` has displacements (n d,) of the n nodes.
        """
        size, self.notes = domain.dim, notes
        self._domain, self._functions = domain, [function for _, _, function in entries]
        # row of the table of all functions' values, for each component of each node
        row, first = np.full((len(domain.nodes), size), -1, np.int64), 0
        for nodes, components, function in entries:
            # a function of time and place has values for each of its nodes
            of_node = size * np.arange(len(nodes)) if isinstance(function, PlacedFunction) else 0
            for component in np.flatnonzero(components):
                row[nodes, component] = first + of_node + component
            first += size * (len(nodes) if isinstance(function, PlacedFunction) else 1)
        flat = row.reshape(-1)
        self.dofs: Ints = np.flatnonzero(flat >= 0).astype(np.int32)
        self._row = flat[self.dofs]
        owned = domain.node_count * size
        self.owned_dofs: Ints = self.dofs[: int(np.searchsorted(self.dofs, owned))]
        self.free_dofs: Flags = np.ones(owned, bool)
        self.free_dofs[self.owned_dofs] = False
        self._values = fem.Function(domain.space)
        self.values: Values = np.zeros(len(self.owned_dofs))
        self.bcs = [self._condition()] if domain.comm.allreduce(len(self.dofs)) else []

    def _condition(self) -> fem.DirichletBC:
        # a condition on single components of a blocked space: dofs of the sub-space's parent, values from the space
        pair: list[Ints] = [self.dofs, self.dofs]
        return fem.dirichletbc(self._values, pair, self._domain.space.sub(0))  # type: ignore[arg-type]

    def displacements_at(self, t: float) -> Values:
        """(dofs,) displacements of `dofs` at time t (s), m."""
        if not self._functions:
            return np.empty(0)
        return np.concatenate([function(t) for function in self._functions])[self._row]

    def set_values(self, values: Values) -> None:
        """Set the prescribed displacements (dofs,), m, of `bcs` and `values`."""
        self._values.x.array[self.dofs] = values
        self.values = values[: len(self.owned_dofs)]

    @property
    def prescribed_nodes(self) -> Flags:
        """(nodes,) flags of nodes with a prescribed component, ghosts included."""
        prescribed = np.zeros(len(self._domain.nodes), bool)
        prescribed[self.dofs // self._domain.dim] = True
        return prescribed

    def max_deviation(self, u: Values) -> float:
        """Largest deviation of u (owned dofs,), m, from a prescribed value, in mean edge lengths (collective)."""
        if not self.bcs:
            return 0.0
        deviation = np.max(np.abs(u[self.owned_dofs] - self.values), initial=0.0)
        return float(self._domain.comm.allreduce(deviation, op=MPI.MAX)) / self._domain.mean_edge_length


def check_supports(domain: Domain, motion: PrescribedMotion) -> None:
    """Check that no body of the mesh has a free rigid motion (collective).

    Raises:
        InputError: if prescribed components leave one.
    """
    prescribed = np.zeros(domain.node_count * domain.dim, bool)
    prescribed[motion.owned_dofs] = True
    bodies, gather_corners = find_bodies(domain), domain.input_numbering.gather_corners
    rows = domain.nodes, prescribed.reshape(-1, domain.dim), bodies.node_fragment
    points, flags, body = (gather_corners(values[: domain.node_count]) for values in rows)
    on_root(domain.comm, lambda: _check(bodies.count, points, flags, body))


def _check(bodies: int, points: Values | None, prescribed: Flags | None, body: Ints | None) -> None:
    """Raise InputError if one of the bodies may move (rank 0).

    Args:
        bodies: their number.
        points: (N, d) of the input mesh, m.
        prescribed: (N, d) flags of prescribed components.
        body: (N,) that each point belongs to.
    """
    assert points is not None and prescribed is not None and body is not None
    for number in range(bodies):
        nodes = body == number
        free = describe_free_motion(points[nodes], prescribed[nodes])
        if free:
            where = f"the body around {format_midpoint(points, nodes)}"
            which = f"{where} (one of {bodies})" if bodies > 1 else "the body"
            raise InputError(unsupported_message(which, free))
