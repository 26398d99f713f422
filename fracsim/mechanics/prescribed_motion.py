"""Prescribed motion: dofs whose displacement is a function of time.

Whether a quasi-static study holds every body: without inertia a free rigid motion has no answer.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI

from ..errors import InputError
from ..mesh.connected_bodies import bodies_of, free_motion, not_held
from ..mesh.domain import Domain, Ints
from ..mesh.parallel import on_root
from ..meshes.data import MeshData
from ..meshes.text import middle_of
from .time_functions import TimeFunction

Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Entry = tuple[Ints, Flags, TimeFunction]


class PrescribedMotion:
    """Prescribed displacement of components of nodes. Where two entries name one component, the later one counts.

    Attributes:
        dofs: sorted unrolled local dofs (node * d + component), ghosts included.
        owned: those that this rank owns; they come first.    free: (owned dofs,) all others, flags.
        bcs: the Dirichlet condition, at the values of `set`; empty where no rank has one.
    """

    def __init__(self, domain: Domain, entries: Sequence[Entry]) -> None:
        """`entries`: local nodes, (d,) which of their components move as told, and d displacements in m."""
        size = domain.dim
        self._domain, self._functions = domain, [function for _, _, function in entries]
        row = np.full((len(domain.nodes), size), -1, np.int64)  # of the value table, for each component
        for index, (nodes, components, _) in enumerate(entries):
            for component in np.flatnonzero(components):
                row[nodes, component] = index * size + component
        flat = row.reshape(-1)
        self.dofs: Ints = np.flatnonzero(flat >= 0).astype(np.int32)
        self._row = flat[self.dofs]
        owned = domain.node_count * size
        self.owned_dofs: Ints = self.dofs[: int(np.searchsorted(self.dofs, owned))]
        self.free_dofs: Flags = np.ones(owned, bool)
        self.free_dofs[self.owned_dofs] = False
        self._values = fem.Function(domain.space)
        self.bcs = [self._condition()] if domain.comm.allreduce(len(self.dofs)) else []

    def _condition(self) -> fem.DirichletBC:
        # A condition on single components of a blocked space: dofs of the sub-space's parent, values from the space.
        pair: list[Ints] = [self.dofs, self.dofs]
        return fem.dirichletbc(self._values, pair, self._domain.space.sub(0))  # type: ignore[arg-type]

    def displacements_at(self, t: float) -> Values:
        """(dofs,) displacement of each of `dofs` at time t (s), m."""
        if not self._functions:
            return np.empty(0)
        return np.concatenate([function(t) for function in self._functions])[self._row]

    def set_values(self, values: Values) -> None:
        """Prescribe (dofs,) displacements, m: what `bcs` and `values` have from here on."""
        self._values.x.array[self.dofs] = values

    @property
    def prescribed_nodes(self) -> Flags:
        """(nodes,) which have a component whose motion is prescribed, ghosts included."""
        held = np.zeros(len(self._domain.nodes), bool)
        held[self.dofs // self._domain.dim] = True
        return held

    @property
    def values(self) -> Values:
        """(owned,) what each of `owned` shall be at, m."""
        result: Values = self._values.x.array[self.owned_dofs]
        return result

    def max_deviation(self, u: Values) -> float:
        """Farthest that one of `owned` in u (owned dofs,) is from its value, in mean edge lengths (collective)."""
        if not self.bcs:
            return 0.0
        gap = np.max(np.abs(u[self.owned_dofs] - self.values), initial=0.0)
        return float(self._domain.comm.allreduce(gap, op=MPI.MAX)) / self._domain.mean_edge_length


def check_supports(domain: Domain, motion: PrescribedMotion) -> None:
    """InputError where a body of the mesh keeps a rigid motion that no prescribed component stops (collective)."""
    held = np.zeros(domain.node_count * domain.dim, bool)
    held[motion.owned_dofs] = True
    flags = domain.gather_nodes(held.reshape(-1, domain.dim))
    on_root(domain.comm, lambda: _check(domain.source, flags))


def _check(mesh: MeshData | None, held: npt.NDArray[np.bool_] | None) -> None:
    assert mesh is not None and held is not None
    bodies, body = bodies_of(mesh)
    for number in range(bodies):
        nodes = body == number
        free = free_motion(mesh.points[nodes], held[: len(body)][nodes])
        if free:
            where = f"the body around {middle_of(mesh.points, nodes)}"
            which = f"{where} (one of {bodies})" if bodies > 1 else "the body"
            raise InputError(not_held(which, free))
