"""Bounds on how fast each cell of a body vibrates, from which explicit schemes take their step.

No assembled body is faster than its fastest cell on its own (Irons and Treharne 1971). A P1 simplex has lumped mass
m = rho V / (d + 1) a node.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from ..mechanics.stress import Stress
from ..mesh.small_matrices import barycentric_gradients

if TYPE_CHECKING:
    from .edge_frequencies import EdgeFrequencies

Values = npt.NDArray[np.float64]


def cell_frequencies(stress: Stress) -> Values:
    """(cells,) upper bounds of omega^2 of each cell on its own, 1/s^2, undamaged and in its current shape.

    A P1 simplex has lumped mass rho V / (d + 1) a node and energy V (mu |sym H|^2 + lambda/2 (tr H)^2), H = grad u.
    With L = sum_i g_i x g_i a nodal motion with gradient H has sum |u_i|^2 >= H : H L^-1 >= (tr H)^2 / tr L,
    hence omega^2 <= (d + 1) / rho (2 mu lmax(L) + lambda tr L). No assembled body is faster than its fastest cell
    (Irons and Treharne 1971).
    """
    domain, d = stress.domain, stress.domain.dim
    corners = stress.corners(np.arange(domain.cell_count))
    with np.errstate(divide="ignore", invalid="ignore"):
        gradients = barycentric_gradients(corners)
        spread = np.einsum("nai,naj->nij", gradients, gradients)
    flat = ~np.isfinite(spread).all(axis=(1, 2))
    spread[flat] = 0.0  # a cell without volume has forces, but no bound; the others set the step
    largest, trace = np.linalg.eigvalsh(spread)[:, -1], np.trace(spread, axis1=1, axis2=2)
    material = stress.material
    return np.asarray((d + 1) / material.density * (2 * material.mu * largest + material.lmbda * trace))


def damaged_frequencies(stress: Stress, whole: Values, edges: EdgeFrequencies | None) -> Values:
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
