"""Bounds on how fast each cell of a body vibrates, from which explicit schemes take their step.

No assembled body is faster than its fastest cell on its own (Irons and Treharne 1971). A P1 simplex has lumped mass
m = rho V / (d + 1) a node.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from .edge_stress import barycentric_gradients, edge_vectors
from .equilibrium import Equilibrium
from .forms.closing import spring_modulus
from .graph import local_edges

Values = npt.NDArray[np.float64]


def cell_frequencies(equations: Equilibrium) -> Values:
    """(cells,) upper bounds of omega^2 of each cell on its own, 1/s^2, undamaged and in its current shape.

    A P1 simplex has lumped mass rho V / (d + 1) a node and energy V (mu |sym H|^2 + lambda/2 (tr H)^2), H = grad u.
    With L = sum_i g_i x g_i a nodal motion with gradient H has sum |u_i|^2 >= H : H L^-1 >= (tr H)^2 / tr L,
    hence omega^2 <= (d + 1) / rho (2 mu lmax(L) + lambda tr L). No assembled body is faster than its fastest cell
    (Irons and Treharne 1971).
    """
    domain, d = equations.domain, equations.domain.dim
    corners = domain.nodes[domain.cell_nodes]
    if not equations.material.energy.linear:
        corners = corners + equations.u.x.array.reshape(-1, d)[domain.cell_nodes]
    with np.errstate(divide="ignore", invalid="ignore"):
        gradients = barycentric_gradients(corners)
        spread = np.einsum("nai,naj->nij", gradients, gradients)
    flat = ~np.isfinite(spread).all(axis=(1, 2))
    spread[flat] = 0.0  # a cell without volume has forces, but no bound; the others set the step
    largest, trace = np.linalg.eigvalsh(spread)[:, -1], np.trace(spread, axis1=1, axis2=2)
    material = equations.material
    return np.asarray((d + 1) / material.density * (2 * material.mu * largest + material.lmbda * trace))


def damaged_frequencies(equations: Equilibrium, whole: Values) -> Values:
    """(cells,) the bounds of `cell_frequencies`, `whole`, as damage leaves them, 1/s^2.

    chi scales them. With the approach "edge" a cell can become *faster*: the projection on some of its edges is
    oblique, with a norm of 1.2 to 2.7 in good cells and hundreds in slivers. The springs of closing cracks are added.
    """
    chi, integrity = equations.chi, equations.integrity
    squares = whole.copy() if chi is None else whole * chi.x.array[: len(whole)]
    if integrity is None:
        return np.asarray(squares)
    intact = integrity.x.array.reshape(-1, len(local_edges(equations.domain.dim)))[: len(whole)] > 0
    damaged = np.flatnonzero(~intact.all(axis=1))
    intact = intact[damaged]
    if chi is None:
        squares[damaged] = projected_frequencies(equations, damaged, intact)
    if equations.internal.unilateral:
        share = 1.0 if chi is None else 1 - chi.x.array[damaged]
        squares[damaged] += share * spring_frequencies(equations, damaged, ~intact)
    return np.asarray(squares)


def projected_frequencies(
    equations: Equilibrium, cells: npt.NDArray[np.int64], intact: npt.NDArray[np.bool_]
) -> Values:
    """(n,) omega^2 of cells that carry the projection of their strain on `intact` edges ((n, k) flags), exactly.

    With elongations l = n . (u_j - u_i) = B u of intact edges the energy is V/2 l A l, A_ef = P_e : C : P_f and
    P_e = -|d_e| sym(g_i x g_j), so that omega^2 = V lmax(A B B^T) / m.
    """
    domain, material, d = equations.domain, equations.material, equations.domain.dim
    corners = domain.nodes[domain.cell_nodes[cells]]
    edges = edge_vectors(corners)
    length = np.linalg.norm(edges, axis=2, keepdims=True)
    A = _elongation_stiffness(corners, length, *(_of(cells, value) for value in (material.mu, material.lmbda)))
    A = np.where(intact[:, :, None] & intact[:, None, :], A, 0.0)
    n = edges / length
    highest = np.linalg.eigvals(A @ (_joined(d) * (n @ n.transpose(0, 2, 1)))).real.max(axis=1)
    return np.asarray((d + 1) / _of(cells, material.density) * highest)


def spring_frequencies(equations: Equilibrium, cells: npt.NDArray[np.int64], broken: npt.NDArray[np.bool_]) -> Values:
    """(n,) bounds of omega^2 of the springs of broken edges ((n, k) flags), whichever of them are shortened.

    Their stiffness is V k / |d|^2 against elongation; |B B^T|, by its row sums, is at most that of edges that share a
    node at no angle. A spring that is shortened is no stiffer than at rest, and its stress only takes stiffness away.
    """
    domain, material, d = equations.domain, equations.material, equations.domain.dim
    edges = edge_vectors(domain.nodes[domain.cell_nodes[cells]])
    square = np.einsum("nki,nki->nk", edges, edges)
    shortest = np.where(broken, square, np.inf).min(axis=1)
    k = _of(cells, spring_modulus(material, d, edges.shape[1]))
    rows = np.where(broken, broken @ np.abs(_joined(d)), 0.0).max(axis=1)
    return np.asarray((d + 1) / _of(cells, material.density) * k / shortest * rows)


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


def _of(cells: npt.NDArray[np.int64], value: Any) -> Values:
    """A parameter, uniform or per cell, on some of the cells."""
    return np.broadcast_to(value, len(cells)) if np.ndim(value) == 0 else value[cells]
