"""Degradation: the elastic energy that broken edges take out of their cells.

- `ChiDegradation`: psi_frac = chi psi, chi the share of the edge stress that intact edges carry (M22, eq. 28).
- `EdgeProjectionDegradation`: psi_frac = 1/2 (D eps) : C : (D eps), D the projection on intact edges (M22, eqs. 21-22).
- `SplitCellDegradation`: chi = 1 until a cell is split, then 0, at once or over a time.
- `CrackClosureDegradation`: one of them, with the springs of broken edges added where cracks close (`unilateral`).

Equations: docs/theory.md#degraded-energy, docs/theory.md#edge-projected-strain, docs/theory.md#crack-closure,
docs/theory.md#release-with-inertia.
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
from .edge_stress import EdgeStressOperator

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class EnergyRelease:
    """Energy that the cells of this rank lost in a fracture pass.

    Attributes:
        released: elastic energy lost, J.
        elastic: elastic energy left, J.
        chi_drop: largest decrease of chi in a cell, dimensionless.
        exhausted: whether chi fell to 0 in some cell.
    """

    released: float
    elastic: float
    chi_drop: float = 0.0
    exhausted: bool = False

    def followed_by(self, later: EnergyRelease) -> EnergyRelease:
        """Return what this release and a later one at the same displacement come to."""
        return EnergyRelease(
            self.released + later.released,
            later.elastic,
            max(self.chi_drop, later.chi_drop),
            self.exhausted or later.exhausted,
        )


class Degradation(Protocol):
    """Interface of a degradation.

    Attributes:
        breaks_idle_edges: an edge all of whose cells are split carries no stress, so that it may break as well.
        releases_gradually: split cells release their energy in many passes, also in those in which no edge breaks.
    """

    breaks_idle_edges: bool
    releases_gradually: bool

    def __call__(self, broke: bool, stress: Values, psi: Values) -> EnergyRelease:
        """Degrade the cells after a pass.

        Args:
            broke: whether the pass weakened any edge.
            stress: (cells, 3 or 6) Cauchy stress of the undamaged material, Pa.
            psi: (cells,) energy density of the undamaged material, J/m^3.
        """

    def update_from_graph(self) -> None:
        """Recompute the fields that follow from the edges, which were read from a checkpoint."""

    def apply_initial_cracks(self) -> None:
        """Degrade the cells that cracks split before the body is loaded."""

    def begin_step(self, t: float, dt: float) -> None:
        """Prepare a step of `dt` (s) from `t`, which may be a repeated step."""


class ChiDegradation:
    """chi of damaged cells from the normal stress along their edges (M22, eq. 28); it never increases."""

    breaks_idle_edges, releases_gradually = True, False

    def __init__(self, stress: Stress, graph: EdgeGraph) -> None:
        assert stress.chi is not None
        self._edge_stress, self._graph = EdgeStressOperator.from_stress(stress), graph
        self._chi: Values = stress.chi.x.array
        self._volumes = stress.domain.volumes

    def __call__(self, broke: bool, stress: Values, psi: Values) -> EnergyRelease:
        """Lower chi; the energies are sums of V psi times the decrease of chi, and times chi."""
        released, chi_drop, exhausted = self._lower_chi(stress, psi)
        elastic = float(np.sum(self._volumes * self._chi[: len(psi)] * psi))
        return EnergyRelease(released, elastic, chi_drop, exhausted)

    def _lower_chi(self, stress: Values, psi: Values) -> tuple[float, float, bool]:
        """Lower chi; return the energy released (J), the largest decrease, and whether any chi is 0 now."""
        cells, drop = self._edge_stress.lower_chi(self._chi, stress, self._graph)
        if not len(cells):
            return 0.0, 0.0, False
        released = float(np.sum(self._volumes[cells] * drop * psi[cells]))
        return released, float(np.max(drop)), not self._chi[cells].all()

    def update_from_graph(self) -> None:
        """Do nothing: chi itself is in the checkpoint."""

    def apply_initial_cracks(self) -> None:
        """Set chi of split cells to 0; that of other damaged cells follows once they are loaded."""
        self._chi[np.flatnonzero(self._graph.split)] = 0.0

    def begin_step(self, t: float, dt: float) -> None:
        """Do nothing: energy is released at once."""


class EdgeIntegrityFields:
    """Integrity of the edges as a field on cells, and the elastic energy that depends on it."""

    def __init__(self, stress: Stress, graph: EdgeGraph) -> None:
        assert stress.integrity is not None
        domain = stress.domain
        self._graph, self._volumes = graph, domain.volumes
        self._integrity = stress.integrity.x.array.reshape(-1, graph.cell_edges.shape[1])
        density = stress.energy.psi(deformation_gradient(stress.u), stress.rotation_field)
        self._density = CellExpression(domain.comm, domain.mesh, density, domain.cell_count, kernels=stress.kernels)

    def elastic_energy(self) -> float:
        """Return the elastic energy of this rank, J."""
        return float(self._volumes @ self._density()[:, 0])

    def update_integrity(self) -> None:
        """Copy the integrity of the graph's edges to the field."""
        self._integrity[: len(self._volumes)] = self._graph.cell_integrity(np.arange(len(self._volumes)))


class EdgeProjectionDegradation:
    """Energy of the strain projected on intact edges; split cells keep the forces of their intact edges."""

    breaks_idle_edges, releases_gradually = False, False

    def __init__(self, stress: Stress, graph: EdgeGraph) -> None:
        self._edges = EdgeIntegrityFields(stress, graph)

    def __call__(self, broke: bool, stress: Values, psi: Values) -> EnergyRelease:
        """Update the integrity; the energy released is the difference at the present displacement."""
        before = self._edges.elastic_energy()
        # Without a broken edge the projected energy did not change.
        if not broke:
            return EnergyRelease(0.0, before)
        self._edges.update_integrity()
        after = self._edges.elastic_energy()
        return EnergyRelease(before - after, after)

    def update_from_graph(self) -> None:
        """Update the integrity."""
        self._edges.update_integrity()

    def apply_initial_cracks(self) -> None:
        """Update the integrity."""
        self._edges.update_integrity()

    def begin_step(self, t: float, dt: float) -> None:
        """Do nothing: energy is released at once."""


class SplitCellDegradation:
    """chi of the energy criterion: 1 in unsplit cells; in split cells it falls to 0, at once or at a given rate.

    With inertia chi falls during the time that a Rayleigh wave takes through the disc of a tip
    (docs/theory.md#release-with-inertia).
    """

    breaks_idle_edges = True

    def __init__(self, stress: Stress, graph: EdgeGraph, release_rate: Values | None = None) -> None:
        """Build the degradation; `release_rate`: (cells,) decrease of chi in 1/s, None for a release at once."""
        assert stress.chi is not None
        self._graph, self._chi, self._volumes = graph, stress.chi.x.array, stress.domain.volumes
        self._release_rate, self._step_start = release_rate, -np.inf
        self.releases_gradually = release_rate is not None
        self._chi_at_start: Values = np.ones(0)
        self._min_chi: Values = np.zeros(0)

    def begin_step(self, t: float, dt: float) -> None:
        """Limit the release in the step from `t` of `dt`, s; a repeated step starts from the same chi."""
        if self._release_rate is None:
            return
        # A repeated step starts from chi at its first attempt.
        if t != self._step_start:
            self._step_start, self._chi_at_start = t, self._chi[: len(self._volumes)].copy()
        self._min_chi = np.maximum(self._chi_at_start - self._release_rate * dt, 0.0)

    def __call__(self, broke: bool, stress: Values, psi: Values) -> EnergyRelease:
        """Lower chi of split cells; the energies are sums of V psi times the decrease of chi, and times chi."""
        chi = self._chi[: len(psi)]
        cells = np.flatnonzero(self._graph.split & (chi > 0))
        target = 0.0 if self._release_rate is None else np.minimum(self._min_chi[cells], chi[cells])
        drop = chi[cells] - target
        chi[cells] = target
        released = float(np.sum(self._volumes[cells] * drop * psi[cells]))
        elastic = float(np.sum(self._volumes * chi * psi))
        exhausted = bool(len(cells)) and not chi[cells].all()
        return EnergyRelease(released, elastic, float(np.max(drop, initial=0.0)), exhausted)

    def update_from_graph(self) -> None:
        """Do nothing: chi itself is in the checkpoint."""

    def apply_initial_cracks(self) -> None:
        """Set chi of split cells to 0."""
        self._chi[np.flatnonzero(self._graph.split)] = 0.0


class CrackClosureDegradation:
    """A degradation of chi together with the springs of broken edges (forms.crack_closure)."""

    def __init__(self, degradation: Degradation, stress: Stress, graph: EdgeGraph) -> None:
        """Build the combination; `degradation` sets chi, and the springs carry pressure in broken edges."""
        self._degradation, self.breaks_idle_edges = degradation, degradation.breaks_idle_edges
        self.releases_gradually = degradation.releases_gradually
        self._edges = EdgeIntegrityFields(stress, graph)

    def __call__(self, broke: bool, stress: Values, psi: Values) -> EnergyRelease:
        """Degrade cells and edges; the energy released is the difference at the present displacement."""
        before = self._edges.elastic_energy()
        release = self._degradation(broke, stress, psi)
        if broke:
            self._edges.update_integrity()
        after = self._edges.elastic_energy()
        return EnergyRelease(before - after, after, release.chi_drop, release.exhausted)

    def update_from_graph(self) -> None:
        """Update chi and the integrity of the edges."""
        self._degradation.update_from_graph()
        self._edges.update_integrity()

    def apply_initial_cracks(self) -> None:
        """Degrade split cells, and let the broken edges act as springs."""
        self._degradation.apply_initial_cracks()
        self._edges.update_integrity()

    def begin_step(self, t: float, dt: float) -> None:
        """Prepare a step of `dt` (s) from `t`."""
        self._degradation.begin_step(t, dt)


def make_degradation(stress: Stress, graph: EdgeGraph) -> Degradation:
    """Return the degradation for the fields that the stress has: chi, edge integrity, or both where cracks close."""
    if stress.chi is None:
        return EdgeProjectionDegradation(stress, graph)
    chi = ChiDegradation(stress, graph)
    return chi if stress.integrity is None else CrackClosureDegradation(chi, stress, graph)
