"""The pass after a step: which edges break, and what that leaves of the energy of their cells."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import ufl

from ..forms.energies import cauchy_stress
from ..forms.kinematics import deformation_gradient, symmetric_components
from ..mechanics.balance import Equilibrium
from ..mechanics.kernels import CellExpression
from ..mesh.domain import Domain
from ..mesh.edges import EdgeGraph
from ..study import Brittle, Fracture, Material
from .degradation import make_degradation
from .edge_stress import carried_by, edge_vectors, frobenius_norm, normal_stress
from .strength import Strength

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class PassResult:
    """What one pass did."""

    broken: int  # edges that broke in this pass, on all ranks
    released: float  # elastic energy that went with them on this rank, J
    elastic: float  # elastic energy that is left on this rank, J


class FracturePass:
    """Breaks edges where the averaged normal stress reaches the strength, and weakens their cells.

    Attributes:
        graph: edges and their damage.
        strength: of each edge in each cell.
        degradation: what broken edges take out of the energy.
        surfaces: what breaks edges instead in a study with [brittle]; None elsewhere.
    """

    def __init__(
        self, equations: Equilibrium, fracture: Fracture, material: Material, brittle: Brittle | None = None
    ) -> None:
        domain = equations.domain
        self.domain, self.equations = domain, equations
        self.graph = EdgeGraph(domain)
        self.strength = Strength(self.graph, fracture, material)
        rotation = equations.rotation.field if equations.rotation is not None else None
        F, energy = deformation_gradient(equations.u), equations.material.energy
        stress = symmetric_components(cauchy_stress(energy, F, rotation))
        both = ufl.as_vector([*stress, energy.psi(F, rotation)])  # one kernel: F is worked out once
        self._evaluate = CellExpression(domain.comm, domain.mesh, both, domain.cell_count)
        self.degradation = make_degradation(equations, self.graph)
        self._average = _average(domain, fracture)
        self.surfaces = _surfaces(equations, self.graph, self.strength, brittle)
        self.passes = fracture.passes
        self._most = None if fracture.cap is None else math.ceil(fracture.cap * self.graph.index_map.size_global)

    def __call__(self) -> PassResult:
        """One pass on the current displacement (collective)."""
        values = self._evaluate()
        stress, psi = values[:, :-1], values[:, -1]
        if not np.isfinite(values.sum()):  # a crushed cell: J = 0
            np.nan_to_num(values, copy=False, nan=0.0, posinf=0.0, neginf=0.0)
        broken = self.graph.break_edges(self._by_edges(stress) if self.surfaces is None else self._by_surfaces(stress))
        if broken and self.degradation.idle:
            broken += self.graph.break_idle()
        released, elastic = self.degradation(broken > 0, stress, psi)
        return PassResult(broken, released, elastic)

    def _by_edges(self, stress: Values) -> npt.NDArray[np.bool_]:
        """(edges,) flags of the edges that their own normal stress breaks."""
        edges, load = self._overloaded(*self._candidates(*self._carried(stress)))
        if self._most is not None:
            edges = self._strongest(edges, load, self._most)
        flags = np.zeros(len(self.graph.broken), bool)
        flags[edges] = True
        return flags

    def _by_surfaces(self, stress: Values) -> npt.NDArray[np.bool_]:
        """(edges,) flags of the edges that new surfaces cut; once all surfaces are used up nothing breaks."""
        if not self.surfaces.left:
            return np.zeros(len(self.graph.broken), bool)
        carried, active = self._carried(stress)
        average = self._average
        return self.surfaces(
            *self._candidates(carried, active), lambda: carried if average is None else average(carried, active)
        )

    def _candidates(
        self, carried: Values, active: npt.NDArray[np.bool_] | None
    ) -> tuple[npt.NDArray[np.int64], Values]:
        """Cells whose averaged stress may break an edge, and that stress.

        No normal stress exceeds the Frobenius norm of its tensor, and no average exceeds the average of the norms:
        most cells are passed over after one product.
        """
        size = frobenius_norm(carried, self.domain.dim)
        if self._average is not None:
            return self._average.reaching(carried, size, self.strength.weakest, active)
        cells = np.flatnonzero(size >= self.strength.weakest)
        return cells, carried[cells]

    def _carried(self, stress: Values) -> tuple[Values, npt.NDArray[np.bool_] | None]:
        """What intact edges carry, and which cells enter an average (None: all): split cells carry nothing."""
        graph = self.graph
        damaged = np.flatnonzero(graph.damaged)
        if not self.domain.comm.allreduce(len(damaged)):
            return stress, None
        active = ~graph.split
        carried = np.where(active[:, None], stress, 0.0)
        # by edges and locally there is no need: an intact edge has the same normal stress in the whole tensor
        if self._average is not None or self.surfaces is not None:
            whole = damaged[active[damaged]]
            carried[whole] = carried_by(stress[whole], self.equations.corners(whole), graph.intact(whole))
        return carried, active

    def _overloaded(self, cells: npt.NDArray[np.int64], averaged: Values) -> tuple[npt.NDArray[np.int32], Values]:
        """Local edges whose normal stress in one of the cells reaches the strength, and the ratio of the two."""
        edges = self.graph.cell_edges[cells]
        along = normal_stress(averaged, edge_vectors(self.equations.corners(cells)))
        strength = self.strength(cells, edges)
        over = (along >= strength) & ~self.graph.broken[edges]
        return edges[over], along[over] / strength[over]

    def _strongest(self, edges: npt.NDArray[np.int32], load: Values, most: int) -> npt.NDArray[np.int32]:
        """Those of the candidates of all ranks that are loaded most; equal ones by their input nodes (collective)."""
        keys = self.graph.edge_keys(edges.astype(np.int64))
        every = np.concatenate(self.domain.comm.allgather(np.column_stack([keys, -load])))
        order = np.lexsort((every[:, 1], every[:, 0], every[:, 2]))  # the highest ratio first
        _, first = np.unique(every[order, :2], axis=0, return_index=True)
        chosen = every[order][np.sort(first)[:most], :2].astype(np.int64)
        wanted = self.graph.flags_of_keys(chosen) if len(chosen) else np.zeros(len(self.graph.broken), bool)
        return edges[wanted[edges]]


def _average(domain: Domain, fracture: Fracture) -> Any:
    if fracture.radius == 0:
        return None
    from .nonlocal_average import NonlocalAverage

    return NonlocalAverage(domain, fracture.radius, fracture.kernel)


def _surfaces(equations: Equilibrium, graph: EdgeGraph, strength: Strength, brittle: Brittle | None) -> Any:
    if brittle is None:
        return None
    from .brittle.surfaces import BrittleSurfaces

    return BrittleSurfaces(equations, graph, strength, brittle)
