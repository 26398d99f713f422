"""What is left of the energy of a cell that cracks have cut: all of it until it comes apart, then nothing.

Where there is inertia it is let go over the time that a Rayleigh wave takes through the disc of a tip: at once, only a
fifth of the fracture energy leaves the model, and the rest rings through the mesh
(docs/theory.md#release-with-inertia).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ...mechanics.stress import Stress
from ...mesh.edge_graph import EdgeGraph
from ..degradation import EdgeEnergy, Lost

Values = npt.NDArray[np.float64]


class Splitting:
    """chi is 1 in whole cells and 0 in split ones.

    Attributes:
        rate: (cells,) 1/s at which chi of a split cell falls to 0; None: at once.
    """

    idle = True

    def __init__(self, stress: Stress, graph: EdgeGraph, rate: Values | None = None) -> None:
        assert stress.chi is not None
        self._graph, self._chi, self._volumes = graph, stress.chi.x.array, stress.domain.volumes
        self.rate, self._began = rate, -np.inf
        self._before: Values = np.ones(0)
        self._least: Values = np.zeros(0)

    def begin(self, t: float, dt: float) -> None:
        """A step of dt (s) from t on is solved, for the first time or once more."""
        if self.rate is None:
            return
        if t != self._began:
            self._began, self._before = t, self._chi[: len(self._volumes)].copy()
        self._least = np.maximum(self._before - self.rate * dt, 0.0)

    def __call__(self, broke: bool, stress: Values, psi: Values) -> Lost:
        """Released and left: sums of V psi times what chi lost and what it is."""
        chi = self._chi[: len(psi)]
        cells = np.flatnonzero(self._graph.split & (chi > 0))
        least = 0.0 if self.rate is None else np.minimum(self._least[cells], chi[cells])
        lost = chi[cells] - least
        chi[cells] = least
        released = float(np.sum(self._volumes[cells] * lost * psi[cells]))
        left = float(np.sum(self._volumes * chi * psi))
        return Lost(released, left, float(np.max(lost, initial=0.0)), bool(len(cells)) and not chi[cells].all())

    def restore(self) -> None:
        """chi itself is in the checkpoint."""

    def opened(self) -> None:
        """Cells that have come apart carry nothing."""
        self._chi[np.flatnonzero(self._graph.split)] = 0.0


class ClosingSplitting(Splitting):
    """chi as `Splitting` has it, beside the springs of broken edges, which have 1 - chi of a share
    (forms.crack_closure)."""

    def __init__(self, stress: Stress, graph: EdgeGraph, rate: Values | None = None) -> None:
        super().__init__(stress, graph, rate)
        self._edges = EdgeEnergy(stress, graph)

    def __call__(self, broke: bool, stress: Values, psi: Values) -> Lost:
        """Released: what the energy lost at this displacement as chi fell and edges broke."""
        before = self._edges.energy()
        lost = super().__call__(broke, stress, psi)
        if broke:
            self._edges.update()
        after = self._edges.energy()
        return Lost(before - after, after, lost.loss, lost.died)

    def restore(self) -> None:
        """chi itself is in the checkpoint."""
        self._edges.update()

    def opened(self) -> None:
        """Cells that have come apart carry nothing but pressure."""
        super().opened()
        self._edges.update()
