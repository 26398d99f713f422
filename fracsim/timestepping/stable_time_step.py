"""Stable time step of explicit schemes: upper bounds of the eigenfrequencies of cells, undamaged and damaged.

Equations: docs/theory.md#stable-time-step, docs/theory.md#quadratic-displacement.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import basix
import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..mechanics.balance import Balance
from ..mechanics.damping import Drag, Viscosity
from ..mechanics.inertia import HRZ_FRACTIONS, corner_mass_fraction
from ..mechanics.material_fields import PerCell
from ..mechanics.stability_limit import SAFETY, frequency_bounds, stable_step
from ..mechanics.stress import Stress
from ..mesh.simplices import cell_type, local_edges
from ..mesh.small_matrices import barycentric_gradients
from .state import State
from .step_sizes import StepSizes

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class ExplicitPolicy:
    """Limits of the size of explicit steps."""

    # The square of the frequency is at least so many times what contact springs add to it. A spring that becomes active
    # gains energy where omega dt exceeds 1.
    min_spring_ratio: float = 3.0
    # Steps between updates of the frequencies of cells, which change with their shape.
    update_interval: int = 20
    # Number of remaining steps, below which the steps to the end or to the next frame are made equal.
    equal_steps: int = 100
    # Relative round-off of a number of steps.
    round_off: float = 1e-9


EXPLICIT_STEP_POLICY = ExplicitPolicy()


class StableTimeStep:
    """Stable step of a body with its damage, its terms and Rayleigh damping.

    Attributes:
        mass_damping: a of a M + b K, 1/s.
    """

    def __init__(self, balance: Balance) -> None:
        self._balance = balance
        self.mass_damping, self._stiffness_damping = rayleigh_coefficients(balance)
        # It costs an eigenvalue problem for each damaged cell, and is kept until edges break.
        self._damaged: DamagedCellFrequencies | None = None

    def edges_broke(self, count: int | None) -> None:
        """Note that the broken edges have changed."""
        self._damaged = None

    def next_step(self, state: State, sizes: StepSizes) -> float:
        """Return the size of the next step, s: the stable step, or less as the study asks (collective).

        Steps end at the end of the run and at frames.
        """
        assert state.frequencies is not None
        stress = self._balance.stress
        squares = damaged_frequencies(stress, state.frequencies, self._damaged_cells())
        fastest = stress.domain.comm.allreduce(float(np.max(squares, initial=0.0)), op=MPI.MAX)
        added = sum(term.frequency_bound() for term in self._balance.terms)
        highest = float(np.sqrt(max(fastest + added, EXPLICIT_STEP_POLICY.min_spring_ratio * added)))
        stable = SAFETY * stable_step(highest, self.mass_damping, self._stiffness_damping)
        dt = min(state.dt, stable, sizes.largest_step_at(state.t))
        remaining = min(sizes.end - state.t, sizes.time_to_frame(state.t, dt))
        if remaining >= EXPLICIT_STEP_POLICY.equal_steps * dt:
            return dt
        # The number of steps is rounded up, so that equal steps do not exceed the bound.
        return remaining / np.ceil(remaining / dt * (1 - EXPLICIT_STEP_POLICY.round_off))

    def _damaged_cells(self) -> DamagedCellFrequencies | None:
        """Return the frequencies of cells with broken edges; None if damage has no integrity."""
        if self._damaged is None and self._balance.stress.integrity is not None:
            self._damaged = edge_frequencies(self._balance.stress)
        return self._damaged


def rayleigh_coefficients(balance: Balance) -> tuple[float, float]:
    """Return a (1/s) and b (s) of the Rayleigh damping a M + b K."""
    a = sum(term.a for term in balance.terms if isinstance(term, Drag))
    return a, sum(term.b for term in balance.terms if isinstance(term, Viscosity))


# --- undamaged cells ---


def cell_frequencies(stress: Stress) -> Values:
    """Return upper bounds (cells,) of omega^2 of each cell, 1/s^2, undamaged and in its current shape."""
    domain, d, material = stress.domain, stress.domain.dim, stress.material
    corners = stress.cell_corners(np.arange(domain.cell_count))
    factor = d + 1 if domain.order == 1 else quadratic_gain(d)
    return frequency_bounds(corners, material.mu, material.lmbda, material.density, factor)


@cache
def quadratic_gain(dim: int) -> float:
    """Return the factor that replaces d + 1 in the bound of omega^2 with quadratic displacement.

    It is the largest sum_q w_q |h_q|^2 of nodal displacements with sum_i s_i |u_i|^2 = 1. s are the shares of the nodes
    in the mass of a cell, w the weights of the points where stress is integrated. With H_q = sum_k h_qk x g_k and h_qk
    = sum_i dN_i/dl_k u_i, |H_q|^2 <= lmax(L) |h_q|^2 and (tr H_q)^2 <= tr L |h_q|^2, as for a linear simplex, whose h
    are the nodal displacements.
    """
    corners, edges = np.eye(dim + 1), local_edges(dim)
    points, weights = map(np.asarray, basix.make_quadrature(cell_type(dim), 2))
    rows = []
    for point, w in zip(np.column_stack([1 - points.sum(axis=1), points]), weights / weights.sum(), strict=True):
        of_corners = (4 * point - 1)[:, None] * corners
        of_midpoints = 4 * (
            point[edges[:, 0], None] * corners[edges[:, 1]] + point[edges[:, 1], None] * corners[edges[:, 0]]
        )
        slopes = np.concatenate([of_corners, of_midpoints])
        # The gradients g_k sum to 0: the mean over k has no effect.
        rows.append(np.sqrt(w) * (slopes - slopes.mean(axis=1, keepdims=True)))
    corner, midpoint = HRZ_FRACTIONS[dim]
    shares = np.concatenate([np.full(dim + 1, corner), np.full(len(edges), midpoint)])
    return float(np.linalg.norm(np.hstack(rows) / np.sqrt(shares)[:, None], 2) ** 2)


# --- damaged cells ---


@dataclass(frozen=True)
class DamagedCellFrequencies:
    """Bounds of omega^2, 1/s^2, of cells with broken edges, in the reference configuration.

    They change only when edges break.

    Attributes:
        cells: (n,) cells with broken edges.
        projected: (n,) bounds of the stress of intact edges; None if chi scales the whole cell.
        springs: (n,) bounds of the springs of broken edges; None if cracks do not close.
    """

    cells: Ints
    projected: Values | None
    springs: Values | None


def damaged_frequencies(stress: Stress, undamaged: Values, damaged: DamagedCellFrequencies | None) -> Values:
    """Return bounds (cells,) of omega^2 of the damaged body, 1/s^2; without damage `undamaged` itself.

    Args:
        stress: gives chi, which scales the bounds and may change in any step.
        undamaged: (cells,) bounds of `cell_frequencies`.
        damaged: bounds of cells with broken edges; None if damage has no integrity.
    """
    chi = stress.chi
    squares = undamaged if chi is None else np.asarray(undamaged * chi.x.array[: len(undamaged)])
    if damaged is None or not len(damaged.cells):
        return squares
    if damaged.projected is not None:
        # Larger than undamaged in some cells: the projection on some of the edges is oblique, with a norm of 1.2 to 2.7
        # in well-shaped cells and of hundreds in slivers.
        squares = squares.copy()
        squares[damaged.cells] = damaged.projected
    if damaged.springs is not None:
        share = 1.0 if chi is None else 1 - chi.x.array[damaged.cells]
        squares[damaged.cells] += share * damaged.springs
    return squares


def edge_frequencies(stress: Stress) -> DamagedCellFrequencies:
    """Return the bounds for the present integrity of the edges."""
    domain, integrity = stress.domain, stress.integrity
    assert integrity is not None
    intact = integrity.x.array.reshape(-1, len(local_edges(domain.dim)))[: domain.cell_count] > 0
    cells = np.flatnonzero(~intact.all(axis=1))
    intact = intact[cells]
    projected = projected_frequencies(stress, cells, intact) if stress.chi is None else None
    springs = spring_frequencies(stress, cells, ~intact) if stress.cracks_close else None
    return DamagedCellFrequencies(cells, projected, springs)


def projected_frequencies(stress: Stress, cells: Ints, intact: Flags) -> Values:
    """Return omega^2 (n,) of cells with the stress of their `intact` edges ((n, k) flags) alone, exactly.

    With elongations l = n . (u_j - u_i) = B u of intact edges the energy is V/2 l A l, A_ef = P_e : C : P_f and
    P_e = -|d_e| sym(g_i x g_j), so that omega^2 = V lmax(A B B^T) / m.
    """
    # Imported only if a study has fracture.
    from ..fracture.edge_stress import edge_vectors

    domain, material, d = stress.domain, stress.material, stress.domain.dim
    corners = domain.nodes[domain.cell_nodes[cells]]
    edges = edge_vectors(corners)
    length = np.linalg.norm(edges, axis=2, keepdims=True)
    A = _elongation_stiffness(corners, length, *(_on_cells(value, cells) for value in (material.mu, material.lmbda)))
    A = np.where(intact[:, :, None] & intact[:, None, :], A, 0.0)
    n = edges / length
    highest = np.linalg.eigvals(A @ (_edge_gram_matrix(d) * (n @ n.transpose(0, 2, 1)))).real.max(axis=1)
    return np.asarray((d + 1) / _on_cells(material.density, cells) * highest)


def spring_frequencies(stress: Stress, cells: Ints, broken: Flags) -> Values:
    """Return bounds (n,) of omega^2 of the springs of `broken` edges ((n, k) flags), whichever of them are shortened.

    Their stiffness is V k / |d|^2 per elongation. The row sums of the Gram matrix without angles bound |B B^T|. A
    shortened spring is no stiffer than at rest, and its stress reduces the stiffness.
    """
    # Imported only if a study has fracture.
    from ..forms.crack_closure import spring_modulus
    from ..fracture.edge_stress import edge_vectors

    domain, material, d = stress.domain, stress.material, stress.domain.dim
    edges = edge_vectors(domain.nodes[domain.cell_nodes[cells]])
    squared_lengths = np.einsum("nki,nki->nk", edges, edges)
    shortest = np.where(broken, squared_lengths, np.inf).min(axis=1)
    k = _on_cells(spring_modulus(material, d, edges.shape[1]), cells)
    row_sums = np.where(broken, broken @ np.abs(_edge_gram_matrix(d)), 0.0).max(axis=1)
    return np.asarray(k / shortest * row_sums / (corner_mass_fraction(domain) * _on_cells(material.density, cells)))


def _edge_gram_matrix(dim: int) -> Values:
    """Return the Gram matrix (k, k) of the node differences of edges: 2, 1 or -1 with a common node, 0."""
    ends = local_edges(dim)
    incidence = np.eye(dim + 1)[ends[:, 1]] - np.eye(dim + 1)[ends[:, 0]]
    return np.asarray(incidence @ incidence.T)


def _elongation_stiffness(corners: Values, length: Values, mu: Values, lmbda: Values) -> Values:
    """Return A_ef = 2 mu P_e : P_f + lambda tr P_e tr P_f, (n, k, k)."""
    gradients, ends = barycentric_gradients(corners), local_edges(corners.shape[2])
    a, b = gradients[:, ends[:, 0]], gradients[:, ends[:, 1]]
    dyads = np.einsum("nkp,nkq->nkpq", a, b)
    P = -length[..., None] / 2 * (dyads + dyads.transpose(0, 1, 3, 2))
    trace = np.trace(P, axis1=2, axis2=3)
    A = 2 * mu[:, None, None] * np.einsum("nkpq,nlpq->nkl", P, P)
    return np.asarray(A + lmbda[:, None, None] * trace[:, :, None] * trace[:, None, :])


def _on_cells(value: PerCell, cells: Ints) -> Values:
    """Return a material parameter, uniform or per cell, on cells (n,)."""
    return np.broadcast_to(value, len(cells)) if np.ndim(value) == 0 else np.asarray(value)[cells]
