"""What is left of the energy of cells that a cohesive crack cuts.

    chi = exp(-(r - 1) / b) / r,   r = max (psi / psi_0)^1/2 >= 1,   psi_0 = f_t^2 / 2 E
    b = (G_c / l psi_0 - 1) / 2,   l = 1 / |grad N . n|

n is the normal of the cut and N the function that is 1 on the nodes on one side of it and 0 on the other, linear in the
cell: l is the width over which the cell opens (Oliver 1989). Pulled alone its stress is f_t exp(-(r - 1) / b), and by
the time that it carries nothing it has taken, on whatever way it came there,

    V int psi (-dchi) = V psi_0 (1 + 2 b) = G_c V / l

The areas V / l add up to that of a flat crack, by the divergence theorem, wherever it cuts the edges. Those of the cuts
themselves do as well, but differ from cell to cell with the place of the cut: cells that are clipped at a corner let go
at once, and a bar of random triangles took 1.07 to 1.2 G_c. Where G_c < l psi_0 a cell lets go at r = 1.

Equations: docs/theory.md#cohesive-cracks.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from ...mechanics.material_fields import MaterialFields, PerCell
from ...mechanics.stress import Stress
from ...mesh.edge_graph import EdgeGraph
from ...mesh.simplices import node_groups
from ...mesh.small_matrices import barycentric_gradients
from ..brittle.principal_stress import largest, tensors
from ..degradation import Lost
from ..energy.crack_front import Front
from ..strength import Strength

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]

LEAST = 0.01  # of the strength: a cell that carries less has let go
STEP = 1e-3  # of chi: a fall that is less waits until it is more, or passes would follow it to round-off
SUDDEN = 1e-3  # the least b


def pulled_modulus(material: MaterialFields, dim: int) -> Values:
    """() or (cells,) E of a body that is pulled along one axis: in the plane as strain across it allows, Pa."""
    mu, lmbda = np.asarray(material.mu), np.asarray(material.lmbda)
    return 4 * mu * (lmbda + mu) / (lmbda + 2 * mu) if dim == 2 else mu * (3 * lmbda + 2 * mu) / (lmbda + mu)


def decay(energy: Values, width: Values, start: Values) -> Values:
    """(n,) b, from G_c (n,) in J/m^2, l (n,) in m and psi_0 (n,) in J/m^3."""
    return np.maximum((energy / (width * start) - 1) / 2, SUDDEN)


def carried(r: Values, b: Values) -> Values:
    """(n,) stress over strength at r (n,) >= 1."""
    return np.exp(-(r - 1) / b)


def widths(corners: Values, first: npt.NDArray[np.bool_], points: Values, cut: npt.NDArray[np.bool_]) -> Values:
    """(n,) l in m of cells with corners (n, d + 1, d), of which `first` (n, d + 1) lie on one side of the cut through
    those of `points` (n, k, d) on edges that are `cut` (n, k)."""
    middle = np.einsum("nk,nki->ni", cut, points) / cut.sum(axis=1, keepdims=True)
    apart = np.where(cut[..., None], points - middle[:, None], 0.0)
    normal = np.linalg.eigh(apart.transpose(0, 2, 1) @ apart)[1][:, :, 0]
    slope = np.einsum("nc,nci,ni->n", first, barycentric_gradients(corners), normal)
    return np.asarray(1 / np.abs(slope))


class Softening:
    """chi of the cells that cohesive cracks cut.

    Attributes:
        start: (cells,) psi_0, J/m^3.
    """

    def __init__(self, stress: Stress, cuts: EdgeGraph, strength: Strength, toughness: PerCell, cut: Values) -> None:
        """`cuts`: the edges that are cut, and `cut` (edges,) where; `toughness`: G_c, J/m^2."""
        assert stress.chi is not None
        domain = self._domain = stress.domain
        self._cuts, self._cut, self._front = cuts, cut, Front(domain, cuts)
        self._chi = stress.chi.x.array[: domain.cell_count]
        mean = strength(np.arange(domain.cell_count), cuts.cell_edges).mean(axis=1)
        self.start = np.asarray(mean**2 / (2 * pulled_modulus(stress.material, domain.dim)))
        self._toughness = np.broadcast_to(toughness, (domain.cell_count,))

    def __call__(self, stress: Values, psi: Values) -> Lost:
        """Soften what is stretched farther than ever; `stress` (cells, 3 or 6) in Pa, `psi` (cells,) in J/m^3, both of
        the undamaged material. Released and left: sums of V psi times what chi lost and what it is."""
        chi, volumes = self._chi, self._domain.volumes
        cells = np.flatnonzero(self._cuts.split & (chi > 0) & (psi > self.start))
        cells = cells[largest(tensors(stress[cells], self._domain.dim)) > 0]  # pressed together nothing tears
        kept = np.minimum(self._kept(cells, psi[cells]), chi[cells])
        lower = kept < (1 - STEP) * chi[cells]
        cells, kept = cells[lower], kept[lower]
        lost = chi[cells] - kept
        chi[cells] = kept
        released, left = volumes[cells] @ (lost * psi[cells]), volumes @ (chi * psi)
        return Lost(float(released), float(left), float(np.max(lost, initial=0.0)), not kept.all())

    def _kept(self, cells: Ints, psi: Values) -> Values:
        """(n,) chi of cells that are stretched to psi (n,) for the first time."""
        start, r = self.start[cells], np.sqrt(psi / self.start[cells])
        share = carried(r, decay(self._toughness[cells], self.widths(cells), start))
        return np.where(share < LEAST, 0.0, share / r)

    def widths(self, cells: Ints) -> Values:
        """(n,) l of cells that are cut, m."""
        cuts, domain = self._cuts, self._domain
        points = self._front.places(cuts.cell_edges[cells], self._cut)
        first = node_groups(domain.dim)[cuts.pattern[cells]] == 0  # with the first corner
        return widths(domain.nodes[domain.cell_nodes[cells]], first, points, ~cuts.intact(cells))

    def let_go(self) -> npt.NDArray[np.bool_]:
        """(edges,) cut ones around which no cut cell carries anything any more, and some did (collective)."""
        cuts, split = self._cuts, self._cuts.split
        gone, held = np.zeros((2, len(cuts.broken)), bool)
        gone[cuts.cell_edges[split & (self._chi == 0)]] = True
        held[cuts.cell_edges[split & (self._chi > 0)]] = True
        return np.asarray(cuts.broken & cuts.any_over_ranks(gone) & ~cuts.any_over_ranks(held))
