"""What broken edges take out of the elastic energy: two approaches (docs/theory.md#degraded-energy,
docs/theory.md#edge-projected-strain).

chi     psi_frac = chi psi, chi the share of the edges' stress that intact ones carry (M22 eq. 28), never rising
edge    psi_frac = 1/2 (D eps) : C : (D eps), D the projection on intact edges (M22 eqs. 21-22, forms.damage)

Where cracks close (`unilateral`) the springs of broken edges are added to either (forms.crack_closure).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from ..forms.kinematics import deformation_gradient
from ..mechanics.jit import CellExpression
from ..mechanics.stress import Stress
from ..mesh.edge_graph import EdgeGraph
from .edge_stress import Simplices

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Lost:
    """What cells of this rank lost in a pass.

    Attributes:
        released, elastic: elastic energy that went, and that is left, J.
        loss: most that chi of a cell fell.    died: whether cells lost the last of their stress.
    """

    released: float
    elastic: float
    loss: float = 0.0
    died: bool = False


class Degradation(Protocol):
    """One way to weaken damaged cells."""

    idle: bool  # an edge whose cells have all come apart carries nothing

    def __call__(self, broke: bool, stress: Values, psi: Values) -> Lost:
        """After a pass that weakened edges (`broke`) or did not.

        `stress` (cells, 3 or 6) in Pa and `psi` (cells,) in J/m^3 are those of the undamaged material.
        """

    def restore(self) -> None:
        """Take up the damage of a graph that was read from a checkpoint."""

    def opened(self) -> None:
        """Take up the damage of a graph with cracks, before anything is loaded."""

    def begin(self, t: float, dt: float) -> None:
        """A step of dt (s) from t on is solved, for the first time or once more."""


class Chi:
    """chi of the damaged cells, from the normal stress along their edges."""

    idle = True

    def __init__(self, stress: Stress, graph: EdgeGraph) -> None:
        assert stress.chi is not None
        self._cells, self._graph = Simplices.of(stress), graph
        self._chi: Values = stress.chi.x.array
        self._volumes = stress.domain.volumes

    def __call__(self, broke: bool, stress: Values, psi: Values) -> Lost:
        """Released and left: sums of V psi times what chi lost and what it is."""
        released, loss, died = self._lower(stress, psi)
        return Lost(released, float(np.sum(self._volumes * self._chi[: len(psi)] * psi)), loss, died)

    def _lower(self, stress: Values, psi: Values) -> tuple[float, float, bool]:
        """Energy released on this rank in J, most that chi of a cell fell, and whether it fell to 0 in any."""
        cells, lost = self._cells.lower(self._chi, stress, self._graph)
        if not len(cells):
            return 0.0, 0.0, False
        released = float(np.sum(self._volumes[cells] * lost * psi[cells]))
        return released, float(np.max(lost)), not self._chi[cells].all()

    def restore(self) -> None:
        """chi itself is in the checkpoint."""

    def opened(self) -> None:
        """Cells that have come apart carry nothing; what others lose is seen once they are loaded."""
        self._chi[np.flatnonzero(self._graph.split)] = 0.0

    def begin(self, t: float, dt: float) -> None:
        """What goes goes at once."""


class EdgeEnergy:
    """Integrity of each edge of each cell, and the energy that depends on it."""

    def __init__(self, stress: Stress, graph: EdgeGraph) -> None:
        assert stress.integrity is not None
        domain = stress.domain
        self._graph, self._volumes = graph, domain.volumes
        self._integrity = stress.integrity.x.array.reshape(-1, graph.cell_edges.shape[1])
        density = stress.energy.psi(deformation_gradient(stress.u), stress.rotation_field)
        self._density = CellExpression(domain.comm, domain.mesh, density, domain.cell_count, kernels=stress.kernels)

    def energy(self) -> float:
        """Elastic energy on this rank, J."""
        return float(self._volumes @ self._density()[:, 0])

    def update(self) -> None:
        """Integrity of the edges as cells see it."""
        self._integrity[: len(self._volumes)] = self._graph.cell_integrity(np.arange(len(self._volumes)))


class Projection:
    """The energy follows from the integrity of the edges; split cells keep the forces of intact ones."""

    idle = False

    def __init__(self, stress: Stress, graph: EdgeGraph) -> None:
        self._edges = EdgeEnergy(stress, graph)

    def __call__(self, broke: bool, stress: Values, psi: Values) -> Lost:
        """Released: what the projected energy lost at this displacement as edges broke."""
        before = self._edges.energy()
        if not broke:
            return Lost(0.0, before)
        self.restore()
        after = self._edges.energy()
        return Lost(before - after, after)

    def restore(self) -> None:
        """Integrity follows from that of the edges."""
        self._edges.update()

    def opened(self) -> None:
        """Integrity follows from that of the edges."""
        self._edges.update()

    def begin(self, t: float, dt: float) -> None:
        """What goes goes at once."""


class ClosingChi(Chi):
    """chi beside the springs of broken edges (forms.crack_closure)."""

    def __init__(self, stress: Stress, graph: EdgeGraph) -> None:
        super().__init__(stress, graph)
        self._edges = EdgeEnergy(stress, graph)

    def __call__(self, broke: bool, stress: Values, psi: Values) -> Lost:
        """Released: what the energy lost at this displacement as chi fell and edges broke."""
        before = self._edges.energy()
        _, loss, died = self._lower(stress, psi)
        if broke:
            self._edges.update()
        after = self._edges.energy()
        return Lost(before - after, after, loss, died)

    def restore(self) -> None:
        """chi itself is in the checkpoint."""
        self._edges.update()

    def opened(self) -> None:
        """As without springs, and these are there where edges are broken."""
        super().opened()
        self._edges.update()


def make_degradation(stress: Stress, graph: EdgeGraph) -> Degradation:
    """The approach that the stress has fields for: chi alone, integrity alone, or both where cracks close."""
    if stress.chi is None:
        return Projection(stress, graph)
    return Chi(stress, graph) if stress.integrity is None else ClosingChi(stress, graph)
