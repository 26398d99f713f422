"""How fast cells with broken edges vibrate: by what the intact ones carry, by springs where cracks close."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..fracture.edge_stress import edge_vectors
from ..mechanics.inertia import corner_mass_fraction
from ..mechanics.material_fields import PerCell
from ..mechanics.stress import Stress
from ..mesh.simplices import local_edges
from ..mesh.small_matrices import barycentric_gradients

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class DamagedCellFrequencies:
    """omega^2 in 1/s^2 of cells with broken edges. It belongs to the shape at rest and changes only as edges break.

    Attributes:
        cells: (n,) those that have any.
        projected: (n,) of what the intact edges carry; None where chi scales the whole cell instead.
        springs: (n,) bounds of the springs of broken edges; None where cracks do not close.
    """

    cells: npt.NDArray[np.int64]
    projected: Values | None
    springs: Values | None


def edge_frequencies(stress: Stress) -> DamagedCellFrequencies:
    """The frequencies that belong to the current integrity of the edges."""
    domain, integrity = stress.domain, stress.integrity
    assert integrity is not None
    intact = integrity.x.array.reshape(-1, len(local_edges(domain.dim)))[: domain.cell_count] > 0
    cells = np.flatnonzero(~intact.all(axis=1))
    intact = intact[cells]
    projected = projected_frequencies(stress, cells, intact) if stress.chi is None else None
    springs = spring_frequencies(stress, cells, ~intact) if stress.cracks_close else None
    return DamagedCellFrequencies(cells, projected, springs)


def projected_frequencies(stress: Stress, cells: npt.NDArray[np.int64], intact: npt.NDArray[np.bool_]) -> Values:
    """(n,) omega^2 of cells that carry the projection of their strain on `intact` edges ((n, k) flags), exactly.

    With elongations l = n . (u_j - u_i) = B u of intact edges the energy is V/2 l A l, A_ef = P_e : C : P_f and
    P_e = -|d_e| sym(g_i x g_j), so that omega^2 = V lmax(A B B^T) / m.
    """
    domain, material, d = stress.domain, stress.material, stress.domain.dim
    corners = domain.nodes[domain.cell_nodes[cells]]
    edges = edge_vectors(corners)
    length = np.linalg.norm(edges, axis=2, keepdims=True)
    A = _elongation_stiffness(corners, length, *(_of(cells, value) for value in (material.mu, material.lmbda)))
    A = np.where(intact[:, :, None] & intact[:, None, :], A, 0.0)
    n = edges / length
    highest = np.linalg.eigvals(A @ (_joined(d) * (n @ n.transpose(0, 2, 1)))).real.max(axis=1)
    return np.asarray((d + 1) / _of(cells, material.density) * highest)


def spring_frequencies(stress: Stress, cells: npt.NDArray[np.int64], broken: npt.NDArray[np.bool_]) -> Values:
    """(n,) bounds of omega^2 of the springs of broken edges ((n, k) flags), whichever of them are shortened.

    Their stiffness is V k / |d|^2 against elongation; |B B^T|, by its row sums, is at most that of edges that share a
    node at no angle. A spring that is shortened is no stiffer than at rest, and its stress only takes stiffness away.
    """
    from ..forms.crack_closure import spring_modulus

    domain, material, d = stress.domain, stress.material, stress.domain.dim
    edges = edge_vectors(domain.nodes[domain.cell_nodes[cells]])
    square = np.einsum("nki,nki->nk", edges, edges)
    shortest = np.where(broken, square, np.inf).min(axis=1)
    k = _of(cells, spring_modulus(material, d, edges.shape[1]))
    rows = np.where(broken, broken @ np.abs(_joined(d)), 0.0).max(axis=1)
    return np.asarray(k / shortest * rows / (corner_mass_fraction(domain) * _of(cells, material.density)))


def _joined(dim: int) -> Values:
    """(k, k) Gram matrix of the differences between the ends of edges: 2 with itself, +-1 with those it touches."""
    ends = local_edges(dim)
    incidence = np.eye(dim + 1)[ends[:, 1]] - np.eye(dim + 1)[ends[:, 0]]
    return np.asarray(incidence @ incidence.T)


def _elongation_stiffness(corners: Values, length: Values, mu: Values, lmbda: Values) -> Values:
    """(n, k, k) A_ef = 2 mu P_e : P_f + lambda tr P_e tr P_f."""
    gradients, ends = barycentric_gradients(corners), local_edges(corners.shape[2])
    a, b = gradients[:, ends[:, 0]], gradients[:, ends[:, 1]]
    dyads = np.einsum("nkp,nkq->nkpq", a, b)
    P = -length[..., None] / 2 * (dyads + dyads.transpose(0, 1, 3, 2))
    trace = np.trace(P, axis1=2, axis2=3)
    A = 2 * mu[:, None, None] * np.einsum("nkpq,nlpq->nkl", P, P)
    return np.asarray(A + lmbda[:, None, None] * trace[:, :, None] * trace[:, None, :])


def _of(cells: npt.NDArray[np.int64], value: PerCell) -> Values:
    """A parameter, uniform or per cell, on some of the cells."""
    return np.broadcast_to(value, len(cells)) if np.ndim(value) == 0 else np.asarray(value)[cells]
