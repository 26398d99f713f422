"""What acts on the body from outside, as functions of time: prescribed motion, dead loads, following pressure."""

from __future__ import annotations

from typing import Any

import numpy as np
import ufl
from dolfinx import fem

from .domain import Domain, Ints
from .laws import Law, Values, in_time, motion_law
from .study import MOTIONS, Boundary, Study


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
        self.tractions = self._surface(study, "traction", domain.dim)
        self.pressures = self._surface(study, "pressure", 1)

    def set_time(self, t: float) -> bool:
        """Move every load to time t; whether any of them changed."""
        changed = False
        for constant, law in self._moving:
            value = law(t).reshape(constant.value.shape)
            changed |= not np.array_equal(value, constant.value)
            constant.value[...] = value
        return changed

    def _constant(self, law: Law, size: int) -> fem.Constant:
        constant = fem.Constant(self._domain.mesh, np.full(size, np.nan) if size > 1 else np.nan)
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

    def _surface(self, study: Study, kind: str, size: int) -> list[tuple[fem.Constant, ufl.Measure]]:
        """(load, measure) of each boundary entry of a kind."""
        found = []
        for index, boundary in enumerate(study.boundary):
            if boundary.kind != kind:
                continue
            key = f"boundary.{index}"
            facets = self._domain.facets_of(boundary.on, f"{key}.on")
            law = in_time(getattr(boundary, kind), f"{key}.{kind}", size)
            found.append((self._constant(law, size), facet_measure(self._domain, facets)))
        return found


def facet_measure(domain: Domain, facets: Ints) -> ufl.Measure:
    """Surface measure over the given exterior facets."""
    entities = fem.compute_integration_domains(fem.IntegralType.exterior_facet, domain.mesh.topology, facets, domain.dim - 1)
    return ufl.Measure("ds", domain=domain.mesh, subdomain_data=[(1, entities)])(1)
