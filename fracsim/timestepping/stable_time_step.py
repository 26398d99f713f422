"""Bounds on how fast each cell of a body vibrates, from which explicit schemes take their step."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import basix
import numpy as np
import numpy.typing as npt

from ..mechanics.stability_limit import frequency_bounds
from ..mechanics.stress import Stress
from ..mesh.simplices import CELL, local_edges

if TYPE_CHECKING:
    from .stable_time_step_damaged import DamagedCellFrequencies

Values = npt.NDArray[np.float64]


def cell_frequencies(stress: Stress) -> Values:
    """(cells,) upper bounds of omega^2 of each cell on its own, 1/s^2, undamaged and in its current shape.

    `gain` has what takes the place of d + 1 with quadratic displacement (mechanics.stability_limit).
    """
    domain, d, material = stress.domain, stress.domain.dim, stress.material
    corners = stress.cell_corners(np.arange(domain.cell_count))
    factor = d + 1 if domain.order == 1 else quadratic_gain(d)
    return frequency_bounds(corners, material.mu, material.lmbda, material.density, factor)


@cache
def quadratic_gain(dim: int) -> float:
    """Largest sum_q w_q |h_q|^2 of motions with sum_i s_i |u_i|^2 = 1, s the shares of nodes in the mass of a cell with
    quadratic displacement, w the weights of the points where its stress is integrated.

    H_q = sum_k h_qk x g_k, h_qk = sum_i dN_i/dl_k u_i: |H_q|^2 <= lmax(L) |h_q|^2 and (tr H_q)^2 <= tr L |h_q|^2, as of
    a P1 simplex, where h are the nodal motions themselves. The sum of the g_k is 0, so the mean over k is left out.
    """
    from ..mechanics.inertia import HRZ_FRACTIONS

    corners, edges = np.eye(dim + 1), local_edges(dim)
    points, weights = map(np.asarray, basix.make_quadrature(CELL[dim], 2))
    rows = []
    for point, w in zip(np.column_stack([1 - points.sum(axis=1), points]), weights / weights.sum(), strict=True):
        of_corners = (4 * point - 1)[:, None] * corners
        of_middles = 4 * (
            point[edges[:, 0], None] * corners[edges[:, 1]] + point[edges[:, 1], None] * corners[edges[:, 0]]
        )
        slopes = np.concatenate([of_corners, of_middles])
        rows.append(np.sqrt(w) * (slopes - slopes.mean(axis=1, keepdims=True)))
    corner, middle = HRZ_FRACTIONS[dim]
    shares = np.concatenate([np.full(dim + 1, corner), np.full(len(edges), middle)])
    return float(np.linalg.norm(np.hstack(rows) / np.sqrt(shares)[:, None], 2) ** 2)


def damaged_frequencies(stress: Stress, whole: Values, edges: DamagedCellFrequencies | None) -> Values:
    """(cells,) the bounds of `cell_frequencies`, `whole`, as damage leaves them, 1/s^2; `whole` itself without damage.

    chi, which may fall in any step, scales them. With the approach "edge" a cell can become *faster*: the projection on
    some of its edges is oblique, with a norm of 1.2 to 2.7 in good cells and hundreds in slivers. The springs of
    closing cracks are added. `edges`: None where damage has no integrity.
    """
    chi = stress.chi
    squares = whole if chi is None else np.asarray(whole * chi.x.array[: len(whole)])
    if edges is None or not len(edges.cells):
        return squares
    if edges.projected is not None:
        squares = squares.copy()
        squares[edges.cells] = edges.projected
    if edges.springs is not None:
        share = 1.0 if chi is None else 1 - chi.x.array[edges.cells]
        squares[edges.cells] += share * edges.springs
    return squares
