"""What acts on the body from outside, as functions of time: prescribed motion, dead loads, following pressure."""

from __future__ import annotations

from typing import Any

import numpy as np
import ufl
from dolfinx import fem

from ..mesh.domain import Domain, Ints
from ..study import MOTIONS, Boundary, Study
from .time_functions import Law, Values, in_time, motion_law


class Motion:
    """Prescribed displacement of components of nodes. Where two entries hold one component, the later one counts.

    Attributes:
        dofs: sorted unrolled local dofs (node * d + component), ghosts included.
        owned: how many of them this rank owns; they come first.
    """

    def __init__(self, domain: Domain, boundaries: list[Boundary]) -> None:
        size = domain.dim
        self._laws: list[Law] = []
        entry = np.full((len(domain.nodes), size), -1, np.int64)  # row of the value table that holds each component
        for index, boundary in enumerate(boundaries):
            if boundary.kind not in MOTIONS:
                continue
            law, held = motion_law(boundary, size, f"boundary.{index}")
            nodes = domain.nodes_of(boundary.on, f"boundary.{index}.on")
            for component in np.flatnonzero(held):
                entry[nodes, component] = len(self._laws) * size + component
            self._laws.append(law)
        flat = entry.reshape(-1)
        self.dofs: Ints = np.flatnonzero(flat >= 0).astype(np.int32)
        self._entry = flat[self.dofs]
        self.owned = int(np.searchsorted(self.dofs, domain.node_count * size))

    def at(self, t: float) -> Values:
        """Displacement in m of each of `dofs` at time t."""
        if not self._laws:
            return np.empty(0)
        return np.concatenate([law(t) for law in self._laws])[self._entry]


class Forces:
    """Dead loads and following pressures as UFL terms with constants that `set_time` moves."""

    def __init__(self, domain: Domain, study: Study, density: Any) -> None:
        self._moving: list[tuple[fem.Constant, Law]] = []
        self._domain = domain
        self.body = self._body_force(study, density)
        loaded = [(i, entry) for i, entry in enumerate(study.boundary) if entry.kind not in MOTIONS]
        ds = surface_measure(domain, [domain.facets_of(entry.on, f"boundary.{i}.on") for i, entry in loaded])
        self.tractions = self._surface(loaded, "traction", domain.dim, ds)
        self.pressures = self._surface(loaded, "pressure", 1, ds)

    def set_time(self, t: float) -> bool:
        """Move every load to time t; whether any of them changed."""
        changed = False
        for constant, law in self._moving:
            value = law(t).reshape(constant.value.shape)
            changed |= not np.array_equal(value, constant.value)
            constant.value[...] = value
        return changed

    def _constant(self, law: Law, size: int) -> fem.Constant:
        constant = fem.Constant(self._domain.mesh, np.full(size, np.nan) if size > 1 else np.float64(np.nan))
        self._moving.append((constant, law))
        return constant

    def _body_force(self, study: Study, density: Any) -> Any:
        """Force per reference volume in N/m^3 as a UFL expression, None where there is none."""
        load, size = study.load, self._domain.dim
        force = None
        if load is not None and load.gravity is not None:
            force = density * self._constant(in_time(load.gravity, "load.gravity", size), size)
        if load is not None and load.body_force is not None:
            extra = self._constant(in_time(load.body_force, "load.body_force", size), size)
            force = extra if force is None else force + extra
        return force

    def _surface(
        self, loaded: list[tuple[int, Boundary]], kind: str, size: int, ds: ufl.Measure
    ) -> list[tuple[fem.Constant, ufl.Measure]]:
        """(load, measure) of each boundary entry of a kind."""
        found = []
        for number, (index, entry) in enumerate(loaded):
            if entry.kind == kind:
                law = in_time(getattr(entry, kind), f"boundary.{index}.{kind}", size)
                found.append((self._constant(law, size), ds(number)))
        return found


def surface_measure(domain: Domain, parts: list[Ints]) -> ufl.Measure:
    """Surface measure whose part `number` is over the exterior facets parts[number]; parts may overlap."""
    kind, topology = fem.IntegralType.exterior_facet, domain.mesh.topology
    entities = [
        (number, fem.compute_integration_domains(kind, topology, facets, domain.dim - 1))
        for number, facets in enumerate(parts)
    ]
    return ufl.Measure("ds", domain=domain.mesh, subdomain_data=entities)
