"""What broken edges take out of the elastic energy: the two approaches of METHOD section 4.

chi     psi_frac = chi psi, chi the share of the edges' stress that intact ones carry (M22 eq. 28), never rising
edge    psi_frac = 1/2 (D eps) : C : (D eps), D the projection on intact edges (M22 eqs. 21-22, forms.damage)

Where cracks close (`unilateral`) the springs of broken edges are added to either (forms.closing).
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
import numpy.typing as npt

from ..forms.kinematics import deformation_gradient
from ..mechanics.balance import Equilibrium
from ..mechanics.kernels import CellExpression
from ..mesh.edges import EdgeGraph
from .edge_stress import edge_vectors, normal_stress

Values = npt.NDArray[np.float64]


class Degradation(Protocol):
    """One way to weaken damaged cells."""

    idle: bool  # an edge whose cells have all come apart carries nothing

    def __call__(self, broke: bool, stress: Values, psi: Values) -> tuple[float, float]:
        """(energy released, elastic energy left) on this rank, J, after a pass that `broke` edges or did not.

        `stress` (cells, 3 or 6) and `psi` (cells,) are those of the undamaged material.
        """

    def restore(self) -> None:
        """Take up the damage of a graph that was read from a checkpoint."""


class Chi:
    """chi of the damaged cells, from the normal stress along their edges."""

    idle = True

    def __init__(self, equations: Equilibrium, graph: EdgeGraph) -> None:
        assert equations.chi is not None
        self._equations, self._graph = equations, graph
        self._chi: Values = equations.chi.x.array
        self._volumes = equations.domain.volumes

    def __call__(self, broke: bool, stress: Values, psi: Values) -> tuple[float, float]:
        """Released and left: sums of V psi times what chi lost and what it is."""
        released = self._lower(stress, psi)
        return released, float(np.sum(self._volumes * self._chi[: len(psi)] * psi))

    def _lower(self, stress: Values, psi: Values) -> float:
        graph, chi = self._graph, self._chi
        cells = np.flatnonzero(graph.damaged & (chi[: len(psi)] > 0))
        if not len(cells):
            return 0.0
        load = np.abs(normal_stress(stress[cells], edge_vectors(self._equations.corners(cells))))
        whole, kept = load.sum(axis=1), np.where(graph.intact(cells), load, 0.0).sum(axis=1)
        share = np.divide(kept, whole, out=np.ones_like(kept), where=whole > 0)
        share[graph.split[cells]] = 0.0
        lost = np.maximum(chi[cells] - share, 0.0)
        changed = lost > 0
        cells, lost = cells[changed], lost[changed]
        chi[cells] -= lost
        chi[cells[graph.split[cells]]] = 0.0
        if not chi[cells].all():
            self._equations.leave_out_dead_cells()
        return float(np.sum(self._volumes[cells] * lost * psi[cells]))

    def restore(self) -> None:
        """chi itself is in the checkpoint."""
        self._equations.leave_out_dead_cells()


class _Edges:
    """Integrity of each edge of each cell, and the energy that depends on it."""

    def __init__(self, equations: Equilibrium, graph: EdgeGraph) -> None:
        assert equations.integrity is not None
        domain = equations.domain
        self._graph, self._volumes = graph, domain.volumes
        self._integrity = equations.integrity.x.array.reshape(-1, graph.cell_edges.shape[1])
        rotation = equations.rotation.field if equations.rotation is not None else None
        density = equations.energy.psi(deformation_gradient(equations.u), rotation)
        self._density = CellExpression(domain.comm, domain.mesh, density, domain.cell_count)

    def energy(self) -> float:
        """Elastic energy on this rank, J."""
        return float(self._volumes @ self._density()[:, 0])

    def update(self) -> None:
        """Integrity from the patterns of the cells."""
        self._integrity[: len(self._volumes)] = self._graph.intact(np.arange(len(self._volumes)))


class Projection:
    """The energy follows from the integrity of the edges; split cells keep the forces of intact ones."""

    idle = False

    def __init__(self, equations: Equilibrium, graph: EdgeGraph) -> None:
        self._edges = _Edges(equations, graph)

    def __call__(self, broke: bool, stress: Values, psi: Values) -> tuple[float, float]:
        """Released: what the projected energy lost at this displacement as edges broke."""
        before = self._edges.energy()
        if not broke:
            return 0.0, before
        self.restore()
        after = self._edges.energy()
        return before - after, after

    def restore(self) -> None:
        """Integrity follows from the patterns."""
        self._edges.update()


class ClosingChi(Chi):
    """chi beside the springs of broken edges (forms.closing)."""

    def __init__(self, equations: Equilibrium, graph: EdgeGraph) -> None:
        super().__init__(equations, graph)
        self._edges = _Edges(equations, graph)

    def __call__(self, broke: bool, stress: Values, psi: Values) -> tuple[float, float]:
        """Released: what the energy lost at this displacement as chi fell and edges broke."""
        before = self._edges.energy()
        self._lower(stress, psi)
        if broke:
            self._edges.update()
        after = self._edges.energy()
        return before - after, after

    def restore(self) -> None:
        """chi itself is in the checkpoint."""
        self._edges.update()


def make_degradation(equations: Equilibrium, graph: EdgeGraph) -> Degradation:
    """The approach of the study."""
    if equations.chi is None:
        return Projection(equations, graph)
    return Chi(equations, graph) if equations.integrity is None else ClosingChi(equations, graph)
