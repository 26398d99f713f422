"""The body as crack tips see it: stress, and the force on them; at any number of ranks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ...forms.crack_closure import spring_modulus
from ...mechanics.stress import Stress
from ...mesh.edge_graph import EdgeGraph
from ...mesh.simplices import local_edges
from ...mesh.small_matrices import barycentric_gradients
from ..brittle.principal_stress import tensors
from ..effective_stress import Undamaged
from .configurational_force import across, eshelby, first_piola, springs
from .crack_front import Front
from .cut_cells import Crack
from .gradient_operators import Patch
from .neighbour_search import Around, Asked, over
from .tip_neighbourhoods import Neighbourhoods, Reach, Tips

Cells = npt.NDArray[np.integer]
Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]

ROUND_OFF = 1e-9  # of the bound of a force: of sums of some thousand cells


@dataclass(frozen=True)
class Seen:
    """The body as it is, of the cells around tips (`Neighbourhoods.asked`).

    Attributes:
        around: the tips and their sums.    disc: (tips,) R in m.
        stress: (asked, 3 or 6) Cauchy stress of the undamaged material, Pa.
        sigma: (asked, d, d) Eshelby's stress of the body as it is, Pa.
        inertia: (asked, d) rho (H^T a - (grad v)^T v), N/m^3; 0 where nothing has a mass.
        H, push: (asked, 2, 2) grad u and (asked, 2) rho a in N/m^3; of nothing in space.
        elastic: (tips,) mu in Pa and (lambda + 3 mu) / (lambda + mu).    turns: whether turning strains nothing.
    """

    around: Neighbourhoods
    disc: Values
    stress: Values
    sigma: Values
    inertia: Values
    H: Values
    push: Values
    elastic: tuple[Values, Values]
    turns: bool

    @property
    def tips(self) -> Tips:
        """Of this rank."""
        return self.around.tips

    def forces(self) -> Values:
        """(tips, d) configurational force, J/m^2.

        g = - sum V Sigma grad q + int q Sigma n dA + sum V q rho (H^T a - (grad v)^T v)

        The surface is the body's, where a crack goes for it: it does not move with the crack.
        In space that along the advance of a crack, over the area it makes (crack_front) (collective).
        """
        force = self.around.forces(self.sigma, self.inertia)
        return force if force.shape[1] == 2 else self.around.along(force)

    def most(self) -> Values:
        """(tips,) no less than the force on tips by themselves, J/m^2: a bound that takes a third of the time, at rest
        twice the force, where strong waves pass far more; in the plane none."""
        if self.sigma.shape[1] == 2:
            return np.full(len(self.tips), np.inf)
        return self.around.along.most(self.around.most(self.sigma, self.inertia)) * (1 + ROUND_OFF)

    def means(self, rows: Ints) -> Values:
        """(m, d, d) mean stress around tips `rows` (m,), Pa."""
        return self.around.means(rows, self.stress)

    def phases(self) -> Values:
        """(tips,) atan2(K_II, K_I) of tips in the plane (mixed_mode)."""
        fields = self.stress, self.H, self.push
        K = self.around.intensities(fields, self.elastic, turns=self.turns)
        return np.asarray(np.arctan2(K[:, 1], K[:, 0]))

    def squares(self, rows: Ints) -> Values:
        """(m,) mean square of the positive first principal stress around tips `rows`, Pa^2."""
        return self.around.squares(rows, self.stress)


class Sight:
    """What makes a `Seen` of the body.

    Attributes:
        centres: (cells, d) of the cells of this rank, m.    crack: all cells that are cut.
        around: the tips of this rank, and what lies around them.
        motion: (owned dofs,) velocity in m/s and acceleration in m/s^2; None where nothing moves.
    """

    def __init__(
        self, stress: Stress, graph: EdgeGraph, reach: Reach, *, forks: bool = False, shares: bool = False
    ) -> None:
        """`forks`: whether cracks branch; `shares`: whether the force on a tip in space is that on the front nearby
        (collective)."""
        self._stress, self._graph, self._reach = stress, graph, reach
        domain = self._domain = stress.domain
        self.centres: Values = domain.nodes[domain.cell_nodes].mean(axis=1)
        self.motion: tuple[Values, Values] | None = None
        farthest = domain.comm.allreduce(float(np.max(reach.disc, initial=0.0)), op=MPI.MAX)
        self._near, self._front = Around(domain, farthest), Front(domain, graph)
        self.crack = Crack(graph, self._front, self.centres)
        self.around = Neighbourhoods(self._near, self.crack, graph, self._front, reach, forks=forks, shares=shares)
        # of the coordinates of cells, NaN until somebody looks there
        self._slopes = np.full((domain.cell_count, domain.dim + 1, domain.dim), np.nan)
        self._patch: tuple[Asked, Patch] | None = None
        self._undamaged = Undamaged(stress) if domain.order == 2 else None  # of points
        mu, lmbda = np.asarray(stress.material.mu), np.asarray(stress.material.lmbda)
        every = (domain.cell_count,)
        self._elastic = np.broadcast_to(mu, every), np.broadcast_to((lmbda + 3 * mu) / (lmbda + mu), every)
        self._density = np.broadcast_to(np.asarray(stress.material.density), (domain.cell_count,))

    def follow(self, cut: Values) -> Tips:
        """The tips of this rank; `cut`: (edges,) where cracks cut local edges (collective)."""
        if self.crack.changed():
            self.around.update(cut)
        return self.around.tips

    def look(self, stress: Values, psi: Values) -> Seen:
        """What is around the tips (collective)."""
        asked, tips, (mu, kappa) = self.around.asked, self.around.tips, self._elastic
        cells, patch = asked.own, self.patch
        H = patch.gradients(patch.at_nodes(self._stress.u.x.array))
        own = np.array([column[cells] for column in stress.T]).T  # in half the time of rows
        assert self._stress.chi is not None
        chi = self._stress.chi.x.array[cells]
        there, stored = (own, psi[cells]) if self._undamaged is None else self._undamaged.at_points(cells)
        sigma = self._eshelby(patch.everywhere(chi), there, stored, H)
        inertia, push = np.zeros((2, len(H), self._domain.dim))
        if self.motion is not None:
            density = np.where(self._stress.cracks_close | (chi > 0), self._density[cells], 0.0)
            v, a = map(self._domain.with_ghosts, self.motion)
            kinetic, inertia, push = self._moved(patch.everywhere(density), H, patch, v, a)
            for axis in range(self._domain.dim):
                sigma[:, axis, axis] += kinetic
        sigma, inertia, H, push = map(patch.means, (sigma, inertia, H, push))
        if self._stress.cracks_close:
            sigma += self._pressed(cells, 1 - chi)
        flat = (H, push) if self._domain.dim == 2 else (np.empty((len(cells), 0)),) * 2
        seen, sigma, inertia, H, push = asked(own, sigma, inertia, *flat)
        elastic, turns = (mu[tips.cell], kappa[tips.cell]), not self._stress.energy.linear
        return Seen(self.around, self._reach.disc[tips.cell], seen, sigma, inertia, H, push, elastic, turns)

    @property
    def patch(self) -> Patch:
        """Of the cells of this rank that anybody asks for: as long as they are the same."""
        asked = self.around.asked
        if self._patch is None or self._patch[0] is not asked:
            self._patch = asked, Patch.of(self._domain, asked.own, self._slopes_of(asked.own))
        return self._patch[1]

    def places(self, edges: npt.NDArray[np.integer], cut: Values) -> Values:
        """(n, d) where local edges are cut, m."""
        return self._front.places(edges, cut)

    def means_at(self, cells: Ints, stress: Values) -> Values:
        """(n, d, d) mean stress around the centres of cells (n,) of this rank that are far from cracks, Pa, of all
        cells' (cells, 3 or 6) (collective)."""
        average = self._reach.average[cells]
        pairs = self._near.pairs(self.centres[cells], average)
        needed, index = np.unique(pairs.other, return_inverse=True)
        asked = self._near.asked(needed)
        (near,) = asked(stress[asked.own])
        weight = self._near.volumes[pairs.other] * (1 - pairs.distance / average[pairs.place])
        return tensors(over(pairs.sum(weight[:, None] * near[index]), pairs.sum(weight)[:, None]), self._domain.dim)

    def _eshelby(self, chi: Values, stress: Values, psi: Values, H: Values) -> Values:
        """(m, d, d) Pa of the stress (m, 3 or 6)."""
        P = first_piola(tensors((chi * stress.T).T, self._domain.dim), H, linear=self._stress.energy.linear)
        return eshelby(chi * psi, H, P)

    def _pressed(self, cells: Ints, share: Values) -> Values:
        """(n, d, d) Pa of the broken edges of cells, with `share` of their springs: of what corners make alone."""
        graph, material, corners = self._graph, self._stress.material, self._domain.cell_nodes[cells]
        nodes, moved = self._domain.nodes[corners], self._stress.u.x.array.reshape(-1, self._domain.dim)[corners]
        H = np.einsum("nki,nkj->nij", moved, self._slopes_of(cells))
        first, second = local_edges(self._domain.dim).T
        stiff = np.broadcast_to(spring_modulus(material, self._domain.dim, len(first)), (len(self.centres),))[cells]
        modulus = (share * stiff)[:, None] * ~graph.intact(cells)
        psi, P = springs(nodes[:, second] - nodes[:, first], modulus, H, linear=self._stress.energy.linear)
        return eshelby(psi, H, P)

    @staticmethod
    def _moved(density: Values, H: Values, patch: Patch, v: Values, a: Values) -> tuple[Values, Values, Values]:
        """(m,) rho v^2 / 2 in J/m^3, and (m, d) rho (H^T a - (grad v)^T v) and rho a in N/m^3, at points of a density
        (m,), 0 of those that carry nothing."""
        moves = patch.at_nodes(v)
        speed, push = patch.values(moves), density[:, None] * patch.values(patch.at_nodes(a))
        momentum = density[:, None] * speed
        carried = across(H, push) - across(patch.gradients(moves), momentum)
        return np.einsum("ni,ni->n", speed, momentum) / 2, carried, push

    def gradients(self, cells: Ints, field: Values) -> Values:
        """(n, d, d) mean gradients of a field of nodes (nodes * d,), H_ij = du_i / dX_j of the displacement."""
        patch = Patch.of(self._domain, cells, self._slopes_of(cells))
        return patch.means(patch.gradients(patch.at_nodes(field)))

    def _slopes_of(self, cells: Ints) -> Values:
        """(n, d + 1, d) of the barycentric coordinates of cells, 1/m."""
        new = cells[np.isnan(self._slopes[cells, 0, 0])]
        if len(new):
            self._slopes[new] = barycentric_gradients(self._domain.nodes[self._domain.cell_nodes[new]])
        return self._slopes[cells]
