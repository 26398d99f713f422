"""Cohesive cracks, which carry stress while they open: the mesh resolves the process zone of a tip (concrete).

    sigma = f_t exp(-w f_t / G_c)      of a crack that opens by w

A cell is cut where the stress reaches the strength, and dissipates the fracture energy as it opens. The force on a tip
has no part in the criterion, since the energy would count twice. A cut cell keeps

    chi = rho exp(-(rho - 1) / b) psi_0 / psi,   rho = |w| E / (l f_t),   1 <= rho <= (psi / psi_0)^1/2
    psi_0 = f_t^2 / 2 E,   l = 1 / |grad N . n|,   b = (G_c / l psi_0 - 1) / 2 - ln m

of its energy, or less if it had less before. n is the normal of the cut. N is linear in the cell, 1 at the nodes on one
side of the cut and 0 on the other, so that l is the width over which the cell opens (Oliver 1989). Sides that part
rigidly by w strain the cell by sym(w grad N); then psi = (m rho)^2 psi_0. The forces on its nodes do the work

    chi dpsi V = V / l f_t exp(-(rho - 1) / b) d|w|

of a flat crack, and G_c V / l in all. A cell that is oblique to the crack is sheared by the opening, m > 1. With
chi as a function of psi alone, as in a cell across the crack (m = 1), it would carry m f_t.

The areas V / l add up to that of a flat crack, by the divergence theorem, wherever it cuts the edges. The areas of the
cuts themselves do so as well, but vary from cell to cell: cells cut near a corner would release their energy at once.
Where G_c < l psi_0 a cell releases its energy at rho = 1. A cut edge breaks once no cut cell around it carries stress.

A crack starts only where nothing grows or softens any more, and one at a time: in a bar the whole length reaches the
strength at once, and all but one place unload. Explicit steps have one pass, in which cells soften, tips advance and
cracks start one after another: a place learns of others by waves (docs/theory.md#spall-of-a-bar).

Equations: docs/theory.md#cohesive-cracks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..mechanics.material_fields import PerCell
from ..mechanics.stress import Stress
from ..mesh.edge_graph import EdgeGraph
from ..mesh.parallel import allgather, sum_over_ranks
from ..mesh.simplices import node_groups
from ..mesh.small_matrices import barycentric_gradients
from .criterion import Edges
from .degradation import EnergyRelease
from .energy.branching import unit_or_zero
from .energy.crack_initiation import (
    CutKind,
    CutProposal,
    Initiation,
    cell_strength,
    rank_rows,
)
from .energy.critical_distance import CriticalDistance
from .energy.cut_cells import CutGeometry
from .energy.tip_criterion import TipCriterion, input_numbers
from .energy.tip_fields import TipFieldEvaluator, TipFields
from .energy.tip_parameters import TIP
from .fracture_pass import FracturePass, FracturePassResult
from .principal_stress import first_principal_stress, symmetric_tensors, tensile_part
from .strength import EdgeStrength

Flags = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class SofteningParameters:
    """Parameters of cohesive cracks.

    Attributes:
        min_stress_ratio: stress over strength below which a cell carries nothing.
        min_chi_drop: relative decrease of chi that is applied; smaller ones accumulate, or passes would follow them
            down to rounding.
        min_softening: least softening parameter b.
        cut_integrity: integrity of an edge that is cut and not broken.
        load_digits: decimal digits of stress over strength by which the place of a new crack is chosen; more digits
            are noise of the solver.
    """

    min_stress_ratio: float = 0.01
    min_chi_drop: float = 1e-3
    min_softening: float = 1e-3
    cut_integrity: float = 0.5
    load_digits: int = 4


SOFTENING = SofteningParameters()


def uniaxial_modulus(mu: Values, lmbda: Values, dim: int) -> Values:
    """Return E (n,), Pa, of a body pulled along one axis; in 2D of plane strain."""
    return 4 * mu * (lmbda + mu) / (lmbda + 2 * mu) if dim == 2 else mu * (3 * lmbda + 2 * mu) / (lmbda + mu)


def opening_widths(gradient: Values, points: Values, cut: Flags) -> Values:
    """Return l (n,), m, of cut cells.

    Args:
        gradient: (n, d) grad N, 1/m.
        points: (n, k, d) points at which edges are cut, m.
        cut: (n, k) edges that are cut.
    """
    middle = np.einsum("nk,nki->ni", cut, points) / cut.sum(axis=1, keepdims=True)
    apart = np.where(cut[..., None], points - middle[:, None], 0.0)
    # The normal of the plane fitted to the cut points is the eigenvector of the least eigenvalue.
    normal = np.linalg.eigh(apart.transpose(0, 2, 1) @ apart)[1][:, :, 0]
    return np.asarray(1 / np.abs(np.einsum("ni,ni->n", gradient, normal)))


@dataclass(frozen=True)
class OpeningCells:
    """Law of cells across which a crack opens.

    Attributes:
        gradient: (n, d) grad N, 1/m.
        width: (n,) l, m.
        strength: (n,) f_t, Pa.
        toughness: (n,) G_c, J/m^2.
        mu: (n,) Pa.
        lmbda: (n,) Pa.
    """

    gradient: Values
    width: Values
    strength: Values
    toughness: Values
    mu: Values
    lmbda: Values

    @property
    def young(self) -> Values:
        """(n,) E, Pa."""
        return uniaxial_modulus(self.mu, self.lmbda, self.gradient.shape[1])

    @property
    def onset_density(self) -> Values:
        """(n,) psi_0, J/m^3."""
        return np.asarray(self.strength**2 / (2 * self.young))

    @property
    def shear_factor(self) -> Values:
        """(n,) m: (psi / psi_0)^1/2 over rho in a cell that opens across the cut."""
        stretch = self.mu * np.einsum("ni,ni->n", self.gradient, self.gradient) * self.width**2
        return np.asarray(np.sqrt((stretch + self.lmbda + self.mu) / self.young))

    @property
    def softening(self) -> Values:
        """(n,) b."""
        b = (self.toughness / (self.width * self.onset_density) - 1) / 2 - np.log(self.shear_factor)
        return np.maximum(b, SOFTENING.min_softening)

    def openings(self, stress: Values) -> Values:
        """Return w (n, d), m, at the stress (n, d, d) of the undamaged material, Pa.

        w is the opening whose strain sym(w grad N) has the same stress on planes normal to grad N.
        """
        steepness = np.linalg.norm(self.gradient, axis=1)
        a = self.gradient / steepness[:, None]
        traction = np.einsum("nij,nj->ni", stress, a)
        # The inverse of the acoustic tensor mu I + (lambda + mu) a a.
        share = (self.lmbda + self.mu) / (self.lmbda + 2 * self.mu) * np.einsum("ni,ni->n", traction, a)
        return np.asarray((traction - share[:, None] * a) / (self.mu * steepness)[:, None])

    def chi(self, stress: Values, psi: Values) -> Values:
        """Return chi (n,) at stress (n, d, d), Pa, and energy density psi (n,), J/m^3, of the undamaged material."""
        r2 = psi / self.onset_density
        rho = np.linalg.norm(self.openings(stress), axis=1) * self.young / (self.width * self.strength)
        # An elastic strain is no opening: rho is 1 at the onset, and at most r, as in a cell across the crack.
        rho = np.clip(rho, 1.0, np.sqrt(r2))
        stress_ratio = np.exp(-(rho - 1) / self.softening)
        return np.where(stress_ratio < SOFTENING.min_stress_ratio, 0.0, stress_ratio * rho / r2)


class CohesiveSoftening:
    """chi of the cells that cohesive cracks cut.

    Attributes:
        onset_density: (cells,) psi_0, J/m^3.
    """

    def __init__(
        self, stress: Stress, cut_graph: EdgeGraph, strength: EdgeStrength, toughness: PerCell, cut: Values
    ) -> None:
        """Build the law.

        Args:
            stress: stress of the body.
            cut_graph: graph in which cut edges are broken.
            strength: strength of edges.
            toughness: G_c, J/m^2.
            cut: (edges,) cut positions, updated by the criterion.
        """
        assert stress.chi is not None
        domain = self._domain = stress.domain
        self._cut_graph, self._cut, self._geometry = cut_graph, cut, CutGeometry(domain, cut_graph)
        self._chi = stress.chi.x.array[: domain.cell_count]
        self._strength = strength(np.arange(domain.cell_count), cut_graph.cell_edges).mean(axis=1)
        material, count = stress.material, (domain.cell_count,)
        self._toughness = np.broadcast_to(toughness, count)
        self._mu, self._lmbda = np.broadcast_to(material.mu, count), np.broadcast_to(material.lmbda, count)
        self.onset_density = np.asarray(self._strength**2 / (2 * uniaxial_modulus(self._mu, self._lmbda, domain.dim)))

    def __call__(self, stress: Values, psi: Values) -> EnergyRelease:
        """Lower chi of cells that are stretched farther than before; compressed cells do not soften.

        Args:
            stress: (cells, 3 or 6) Cauchy stress of the undamaged material, Pa.
            psi: (cells,) energy density of the undamaged material, J/m^3.

        Returns:
            Sums of V psi times the decrease of chi, and times chi.
        """
        chi, volumes = self._chi, self._domain.volumes
        cells = np.flatnonzero(self._cut_graph.split & (chi > 0) & (psi > self.onset_density))
        tensors = symmetric_tensors(stress[cells], self._domain.dim)
        pulled = first_principal_stress(tensors) > 0
        cells, tensors = cells[pulled], tensors[pulled]
        target = np.minimum(self.opening_cells(cells).chi(tensors, psi[cells]), chi[cells])
        lower = target < (1 - SOFTENING.min_chi_drop) * chi[cells]
        cells, target = cells[lower], target[lower]
        drop = chi[cells] - target
        chi[cells] = target
        released = float(volumes[cells] @ (drop * psi[cells]))
        return EnergyRelease(released, self.elastic_energy(psi), float(np.max(drop, initial=0.0)), not target.all())

    def elastic_energy(self, psi: Values) -> float:
        """Return the elastic energy of this rank, J; `psi`: (cells,) of the undamaged material, J/m^3."""
        return float(self._domain.volumes @ (self._chi * psi))

    def opening_cells(self, cells: Ints) -> OpeningCells:
        """Return the law of cut cells (n,)."""
        graph, domain = self._cut_graph, self._domain
        # Corners on the side of the first one.
        first = node_groups(domain.dim)[graph.pattern[cells]] == 0
        gradients = barycentric_gradients(domain.nodes[domain.cell_nodes[cells]])
        gradient = np.asarray(np.einsum("nc,nci->ni", first, gradients))
        points = self._geometry.cut_points(graph.cell_edges[cells], self._cut)
        width = opening_widths(gradient, points, ~graph.intact(cells))
        properties = self._strength, self._toughness, self._mu, self._lmbda
        return OpeningCells(gradient, width, *(values[cells] for values in properties))

    def find_released_edges(self) -> npt.NDArray[np.bool_]:
        """Flag the cut edges (edges,) around which no cut cell carries stress, and some did (collective)."""
        graph, split = self._cut_graph, self._cut_graph.split
        released, carrying = np.zeros((2, len(graph.broken)), bool)
        released[graph.cell_edges[split & (self._chi == 0)]] = True
        carrying[graph.cell_edges[split & (self._chi > 0)]] = True
        return np.asarray(graph.broken & graph.any_over_ranks(released) & ~graph.any_over_ranks(carrying))


# --- where cells are cut ---


def remove_normal_stress(stress: Values, along: Values) -> Values:
    """Return stress (n, d, d) without the normal stress along vectors (n, d) of any length; 0 removes nothing."""
    t = unit_or_zero(along)
    return np.asarray(stress - np.einsum("ni,nij,nj,nk,nl->nkl", t, stress, t, t, t))


def _larger_principal_stress(mean: Values, local: Values) -> Values:
    """Return the first principal stress (n,), Pa, of the averaged (n, d, d) or local (n, 3 or 6) stress, the larger."""
    local_sigma = first_principal_stress(symmetric_tensors(local, mean.shape[1]))
    return np.maximum(first_principal_stress(mean), local_sigma)


class CohesiveInitiation:
    """A cohesive crack starts at the most loaded cell of all ranks, and only while that is allowed."""

    def __init__(
        self,
        initiation: Initiation,
        graph: EdgeGraph,
        strength: EdgeStrength,
        evaluator: TipFieldEvaluator,
        mesh_size: Values,
    ) -> None:
        """Build the rule; `initiation` finds candidates, and `mesh_size` is h (cells,), m."""
        self._initiation, self._graph, self._strength = initiation, graph, strength
        self._evaluator, self._h = evaluator, mesh_size
        self._is_allowed = False

    def allow(self, allowed: bool) -> None:
        """Allow or forbid new cracks."""
        self._is_allowed = allowed

    def find_cells(self, stress: Values, excluded: Flags) -> Ints:
        """Find candidate cells by the stress of the softened body (cells, 3 or 6), Pa."""
        return self._initiation.find_cells(stress, excluded) if self._is_allowed else np.empty(0, np.int64)

    def propose_cuts(self, cells: Ints, stress: Values) -> CutProposal:
        """Propose the most loaded of cells (n,) of all ranks; equal loads are ordered by a hash (collective)."""
        mean = self._evaluator.mean_stress_at(cells, stress)
        strength = cell_strength(self._strength, self._graph, cells)
        load = np.round(_larger_principal_stress(mean, stress[cells]) / strength, SOFTENING.load_digits)
        centres = self._evaluator.centres[cells]
        rank = rank_rows(CutKind.NEW_CRACK, load, centres, centres, self._h[cells])
        rows = np.concatenate(allgather(self._graph.domain.comm, rank[load >= 1]))
        first = rows[np.lexsort(rows[:, 2::-1].T)][:1]
        chosen = (rank == first).all(axis=1) if len(first) else np.zeros(len(cells), bool)
        return CutProposal(rank[chosen], cells[chosen], mean[chosen])


class CohesiveTipCriterion(TipCriterion):
    """Criterion of cohesive cracks: a cell is cut where the stress of the softened body reaches the strength.

    Averages are of the tensile part of the stress. With the compression ahead of a crack in a bent beam the average has
    no direction, and the crack would turn along the beam.

    A tip grows across the first principal direction of s - (t . s t) t t, s the averaged stress and t the direction
    from which the crack came: ahead of a tip the stress along t is nearly as large as that across it. A tip is loaded
    by the averaged stress or by that of its own cell, whichever is larger: the average of a tip with soft cells on one
    side is too small, and so is that at an inner corner.

    In 3D cells beside a crack that share an edge with it are not tips of a front, and are not cut.
    """

    extends_cuts = False

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Build the criterion; arguments are those of `TipCriterion` (collective)."""
        super().__init__(*args, **kwargs)
        self._cohesive_initiation = CohesiveInitiation(
            self._initiation, self._graph, self.strength, self.field_evaluator, self._h
        )
        self._initiation = self._cohesive_initiation

    def _critical_distance(self) -> CriticalDistance:
        """Return no length: the strength alone starts cohesive cracks."""
        none = np.zeros(self._domain.cell_count)
        return CriticalDistance(none, none, none, none)

    def allow_initiation(self, allowed: bool) -> None:
        """Allow or forbid new cracks in the following calls."""
        self._cohesive_initiation.allow(allowed)

    def __call__(self, stress: Values, psi: Values) -> tuple[Edges, Values]:
        """Find the local edges (n,) that cracks cut, with loads of 1, from undamaged stress and energy (collective)."""
        assert self._stress.chi is not None
        softened = self._stress.chi.x.array[: len(stress), None] * stress
        self._tensile_stress = tensile_part(softened, self._domain.dim)
        return super().__call__(self._tensile_stress, psi)

    def _propose_advances(self, fields: TipFields) -> CutProposal:
        """Propose the cells of loaded tips, each of which advances by a cell."""
        tips, d = fields.tips, self._domain.dim
        mean = fields.mean_stress(np.arange(len(tips)))
        sigma = _larger_principal_stress(mean, self._tensile_stress[tips.cell])
        loaded = sigma >= cell_strength(self.strength, self._graph, tips.cell)
        if d == 3:
            is_front = np.linalg.norm(tips.ahead, axis=1) > TIP.min_front_advance * fields.disc_radius
            # A cell beside the crack, through which no front passes, stays uncut.
            loaded &= is_front | ~tips.mature
        rows = np.flatnonzero(loaded & ~self._excluded_cells[tips.cell])
        cells, ahead, no = tips.cell[rows], tips.point[rows] - tips.behind[rows], np.zeros(len(rows), bool)
        exclusion = TIP.exclusion_radius[d] * self._h[cells]
        rank = rank_rows(
            CutKind.TIP_ADVANCE, sigma[rows], input_numbers(self._domain, cells), tips.point[rows], exclusion
        )
        across = remove_normal_stress(mean[rows], ahead)
        return CutProposal(rank, cells, across, self._graph.first_broken_edge(cells), ahead, no, no)


class CohesiveFracturePass(FracturePass):
    """Fracture pass that cuts cells, softens cut cells, and breaks released edges.

    Cut and broken edges are two patterns of the same edges: the broken ones separate fragments, the cut ones
    are the crack of the tips.

    Attributes:
        cut_graph: graph in which the cut edges are broken.
        softening: chi of the cut cells.
    """

    def __init__(
        self,
        stress: Stress,
        graph: EdgeGraph,
        cut_graph: EdgeGraph,
        tips: CohesiveTipCriterion,
        softening: CohesiveSoftening,
        *,
        max_passes: int | None = None,
        initial_cuts: Values | None = None,
        has_inertia: bool = False,
    ) -> None:
        """Build the pass; the arguments are those of `FracturePass`, with the parts of cohesive cracks.

        `has_inertia`: energy is released in the course of a step, and not at rest at the end of it.
        """
        self.cut_graph, self._tips, self.softening = cut_graph, tips, softening
        super().__init__(stress, graph, tips, max_passes=max_passes, initial_cuts=initial_cuts)
        self.weakens_gradually = True
        self.softens_gradually, self._step_start = has_inertia, -np.inf
        self._start_fields: list[Values] = []
        self._released, self._is_settled = 0.0, False
        self._update_cut_graph()

    def begin_step(self, t: float, dt: float) -> None:
        """Prepare a step of `dt` (s) from `t`, which may be a repeated step: it starts from the same damage."""
        super().begin_step(t, dt)
        if self.softens_gradually and t != self._step_start:
            self._step_start, self.softened_fields = t, None
            self._released, self._is_settled = 0.0, False
            self._start_fields = [damage.x.array.copy() for damage in self.stress.damage_fields]

    def __call__(self) -> FracturePassResult:
        """Carry out one pass at the present displacement; with further passes, until a cell softens (collective)."""
        stress, psi = self.evaluate_undamaged_stress()
        before = [damage.x.array.copy() for damage in self.stress.damage_fields]
        if self.softens_gradually and self._is_settled:
            # The step is in balance: what is left is to sum its energies.
            release = EnergyRelease(0.0, self.softening.elastic_energy(psi))
        elif self.softens_gradually and self.max_passes == 1:
            release = self._soften_and_cut(stress, psi)
        else:
            release = self._cut_until_softening(stress, psi)
        broken = 0
        # Edges can only be released where a cell lost its last stress.
        if sum_over_ranks(self.graph.domain.comm, int(release.exhausted))[0]:
            broken = self.graph.break_edges(self.softening.find_released_edges())
            if broken:
                broken += self.graph.break_unloaded_edges()
        if broken or release.chi_drop:
            self.mark_changed()
        softened = self._has_softened(release)
        if self.softens_gradually and softened:
            self.softened_fields = self._start_fields
        self._is_settled = not softened and not broken
        previous, released = before if broken or softened else [], release.released
        if self.softens_gradually:
            released = self._released_since_start(psi)
        return FracturePassResult(broken, release.chi_drop, released, release.elastic, release.exhausted, previous)

    def _released_since_start(self, psi: Values) -> float:
        """Return the energy of this rank, J, released since the start of the step, less that of its earlier passes.

        All of it is released at the displacement of the last pass: `psi` (cells,), J/m^3.
        """
        chi, start_chi = self.stress.damage_fields[0].x.array, self._start_fields[0]
        total = float(self.stress.domain.volumes @ ((start_chi - chi)[: len(psi)] * psi))
        earlier, self._released = self._released, total
        return total - earlier

    def _cut_until_softening(self, stress: Values, psi: Values) -> EnergyRelease:
        """Advance tips or start a crack, until a cut cell softens or nothing is left to cut (collective)."""
        release = self._advance_tips(stress, psi)
        if not self._has_softened(release) and self._cut_cells(stress, psi, new_cracks=True):
            return self._advance_tips(stress, psi)
        return release

    def _soften_and_cut(self, stress: Values, psi: Values) -> EnergyRelease:
        """Soften cut cells, advance all tips and start all cracks, one after another (collective)."""
        release = self.softening(stress, psi)
        # A crack under a uniform stress goes through the body before another one starts.
        while self._cut_cells(stress, psi, new_cracks=False) or self._cut_cells(stress, psi, new_cracks=True):
            release = release.followed_by(self.softening(stress, psi))
        return release

    def _advance_tips(self, stress: Values, psi: Values) -> EnergyRelease:
        """Advance tips until a cut cell softens, or no tip advances (collective)."""
        while True:
            release = self.softening(stress, psi)
            if self._has_softened(release) or not self._cut_cells(stress, psi, new_cracks=False):
                return release

    def _has_softened(self, release: EnergyRelease) -> bool:
        """Return whether chi of a cell of any rank decreased (collective)."""
        return bool(self.graph.domain.comm.allreduce(release.chi_drop, op=MPI.MAX) > 0)

    def _cut_cells(self, stress: Values, psi: Values, *, new_cracks: bool) -> bool:
        """Cut the next cells; return whether there are any (collective)."""
        self._tips.allow_initiation(new_cracks)
        edges, _ = self.criterion(stress, psi)
        flags = np.zeros(len(self.cut_graph.broken), bool)
        flags[edges] = True
        if not self.cut_graph.break_edges(flags):
            return False
        # Cut edges count as damaged, but they do not separate fragments.
        self.graph.weaken(np.where(self.cut_graph.broken, SOFTENING.cut_integrity, 1.0))
        self.mark_changed()
        return True

    # --- history variables ---

    def damage_restored(self) -> None:
        """Recompute the cut edges from the cut positions, and the damage fields, after reading a checkpoint."""
        self._update_cut_graph()
        super().damage_restored()

    def restore(self, saved: object) -> bool:
        """Restore the damage that `snapshot` returned; returns True if it changed."""
        self._released, self._is_settled = 0.0, False
        changed = super().restore(saved)
        if changed:
            self._update_cut_graph()
        return changed

    def _update_cut_graph(self) -> None:
        """Cut the edges that have a cut position."""
        self.cut_graph.set_integrity(np.where(np.isnan(self._tips.cut_positions), 1.0, 0.0))
