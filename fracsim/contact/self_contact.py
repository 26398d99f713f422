"""Term of the balance for contact of a body with itself, and of its fragments with one another, in implicit steps.

Each rank holds the split surface, finds its share of the pairs in contact (ipc_pairs), and maps their forces and
stiffness to the nodes: x = W u, f = W^T dE/dx, K = W^T d2E/dx2 W. Nodal values are summed over the ranks.

Equations: docs/theory.md#contact.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, cast

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import csr_matrix

from ..mechanics.extra_couplings import CouplingBuilder, StiffCoupling, stiff_directions
from ..mechanics.term import Term, TimeLevel
from ..mechanics.term_protocols import CutPositions
from ..mesh.domain import Domain
from ..mesh.parallel import Gather, bcast, sum_over_ranks
from ..mesh.split_surface.entity_numbering import EntityNumbering
from ..mesh.split_surface.surface_map import SurfaceMap
from .ipc_surface import SURFACE, SelfContactLaw, SelfContactSurface, SurfaceSnapshot
from .laws import stiffness_factor
from .sample_points import SlipFriction

if TYPE_CHECKING:
    from ..meshes.data import MeshData

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


class SelfContact(Term):
    """A body that cannot penetrate itself.

    Attributes:
        law: contact law.
        allows_exact_tangent: whether tangents are exact near the solution.
    """

    name = "contact"
    leaves_tangent_incomplete = True
    allows_exact_tangent: bool = True
    _attempts = 0  # of Newton's method in the step
    _cuts: CutPositions | None = None

    def __init__(self, domain: Domain, u: fem.Function, law: SelfContactLaw) -> None:
        """Raise InputError where the surface at rest intersects itself (collective)."""
        self.law, self._domain, self._u = law, domain, u
        self._owned, self.comm = domain.node_count * domain.dim, domain.comm
        self._coupling = CouplingBuilder(domain)
        # m^(d-2), times a stiffness in Pa
        self._stiff_threshold = SURFACE.stiff_ratio * domain.mean_edge_length ** (domain.dim - 2)
        mesh = refined_mesh(domain) if self._is_refined(law) else domain.input_mesh
        self._skeleton = EntityNumbering(bcast(domain.comm, mesh))
        self._gather = node_gather(domain, law)
        first = domain.space.dofmap.index_map.local_range[0]
        self._input_nodes = self._gather.to_all_ranks(first + np.arange(domain.node_count))  # numbers of input nodes
        self._pattern: npt.NDArray[np.uint8] = np.zeros(domain.cell_count, np.uint8)
        self._rebuild(None)

    # --- surface ---

    def _rebuild(self, previous: SelfContactSurface | None) -> None:
        """Build the surface of the current damage; `previous`: the one until now (collective)."""
        pattern, u = self._all_patterns(), self._all_nodes(self._u.x.array[: self._owned])
        cuts = None if self._cuts is None else bcast(self.comm, self._cuts())
        cut = None if cuts is None else self._skeleton.edge_values(cuts[0], cuts[1][:, 0])
        self._surface = self._build_surface(pattern, u, previous, cut)
        self._positions: Values | None = None
        self._contact_force: Values | None = None
        self._stored: float | None = None
        self._start_positions: Values | None = None
        self._tangent_positions: Values | None = None
        self._friction: SlipFriction | None = None
        self._is_stale = True

    def _build_surface(
        self, pattern: npt.NDArray[np.uint8], u: Values, previous: SelfContactSurface | None, cut: Values | None
    ) -> SelfContactSurface:
        """Surface of a pattern of damage."""
        if previous is not None and previous.represents(pattern):
            return previous
        return SelfContactSurface(self._skeleton, pattern, self.law, u, previous, cut, self.comm)

    def _all_patterns(self) -> npt.NDArray[np.uint8]:
        """(cells,) broken edges of the skeleton's cells (collective); subdivided quadratic cells do not break."""
        pattern = self._domain.input_numbering.gather_cells.to_all_ranks(self._pattern)
        parts = 2**self._domain.dim if self._is_refined(self.law) else 1
        return np.repeat(pattern, parts)

    def _is_refined(self, law: SelfContactLaw) -> bool:
        """Whether quadratic cells are subdivided into linear ones."""
        return self._domain.order == 2 and not law.corners_only

    def _all_nodes(self, u: Values) -> Values:
        """(nodes, d) displacements of all nodes in the order of the input mesh, of owned ones u (collective)."""
        return np.asarray(self._gather.to_all_ranks(np.asarray(u).reshape(-1, self._domain.dim)))

    def separate_surface(self, at: SurfaceMap, elements: Ints, u: Values, t: float) -> SurfaceMap:
        """Move points of a surface for output to the crack faces of contact, which are offset."""
        contact_map = self._surface.point_map
        if self.law.fragments_only:
            return self._surface.place_faces(at)
        return contact_map.with_arm_share(np.minimum(contact_map.share, at.share))

    def set_cuts(self, cuts: CutPositions) -> None:
        """Set where edges are cut; used for faces between fragments."""
        if self.law.fragments_only:
            self._cuts = cuts

    def edges_broke(self, pattern: npt.NDArray[np.uint8]) -> None:
        """Add new crack faces, retracted where there is no room (collective)."""
        self._pattern = pattern
        self._rebuild(self._surface)

    def snapshot(self) -> object:
        """Retracted and excluded parts of the surface."""
        return self._surface.snapshot()

    def restore(self, memory: object) -> None:
        """Restore a snapshot (not collective)."""
        self._surface.restore(cast("SurfaceSnapshot", memory))

    def to_checkpoint(self) -> dict[str, Values]:
        """Factors of arms, numbers of excluded elements, steps to the next release of faces, and stiffness."""
        share, excluded, pause = self._surface.snapshot()
        return {"share": share, "left_out": np.asarray(excluded, float), "pause": np.array(pause, float),
                "stiffness": np.array([self.law.stiffness])}  # fmt: skip

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Set the state from the arrays of a checkpoint."""
        self._set_stiffness(float(saved["stiffness"][0]))
        if len(saved["share"]) != len(self._surface.point_map.share):
            raise ValueError(f"{len(saved['share'])} points of the contact surface instead of those of its damage")
        pause, remaining = (int(number) for number in saved.get("pause", (1, 1)))
        self._surface.restore((saved["share"], saved["left_out"].astype(np.int64), (pause, remaining)))

    def begin_step(self, level: TimeLevel) -> None:
        """Lag friction with the contact at the start of the step."""
        self._level, self._is_stale, self._friction, self._attempts = level, True, None, 0
        if not level.dt:
            return
        nodal, slip = self._all_nodes(level.u_n), self._sticking_speed(level.v_n) * level.dt
        self._surface.extend_faces(nodal)
        self._start_positions = x = self._surface.point_map(nodal)
        if self.law.friction:
            self._friction = self._surface.pairs.lag_friction(x, x, slip)

    def _sticking_speed(self, v: Values) -> float:
        """Slip velocity that counts as sticking at nodal velocities v (owned dofs,), m/s (collective)."""
        return max(self.law.sticking_speed, self.law.sticking_speed_ratio * self._speed(v))

    def _speed(self, v: Values) -> float:
        """Root mean square of the nodes' speeds relative to their mean velocity, m/s (collective)."""
        square, mean = self._mean_velocities(v)
        return float(np.sqrt(max(float(square - mean @ mean), 0.0)))

    def _mean_velocities(self, v: Values) -> tuple[float, Values]:
        """Mean square speed of the nodes, (m/s)^2, and their mean velocity (d,), m/s (collective)."""
        nodal = v.reshape(-1, self._domain.dim)
        square, count, *total = sum_over_ranks(self.comm, np.array([v @ v, len(nodal), *nodal.sum(axis=0)]))
        return float(square / count), np.array(total) / count

    def update_displacement(self) -> None:
        """Discard positions and forces, as u has changed."""
        self._is_stale = True

    def _end_positions(self) -> Values:
        """(n, d) positions at the end of the step that belongs to the current u, m (collective)."""
        if self._is_stale or self._positions is None:
            u = self._level.displacement_at_end(self._u.x.array[: self._owned])
            self._positions, self._is_stale = self._positions_at(u), False
            self._contact_force = self._stored = None
        return self._positions

    def _positions_at(self, u: Values) -> Values:
        """(n, d) positions for owned displacements u, m (collective)."""
        return self._surface.point_map(self._all_nodes(u))

    # --- forces, tangent and energy ---

    def _nodal_forces(self, x: Values, *, normal: bool = True) -> Values:
        """(owned dofs,) forces on the nodes, N (collective).

        Args:
            x: (n, d) positions of the surface, m.
            normal: whether normal forces are included; otherwise those of friction alone.
        """
        gradient = self._surface.pairs.gradient(x) if normal else np.zeros_like(x)
        if self._friction is not None:
            gradient = gradient + self._friction.gradient(x)
        return self._gather.sum_owned(self._surface.nodal_forces(-gradient)).reshape(-1)

    def contact_forces(self) -> Values | None:
        """(owned dofs,) contact forces at the end of the step, N; None where there are none (collective)."""
        x = self._end_positions()
        # kept, as residual and reference forces both need them
        if self._contact_force is None:
            self._contact_force = self._nodal_forces(x)
        return self._contact_force

    def reference_forces(self) -> Values | None:
        """(owned dofs,) contact forces with their weight in the residual, N (collective)."""
        forces = self.contact_forces()
        return None if forces is None else np.asarray(self._level.contact_weight * forces)

    def coupling_matrix(self) -> PETSc.Mat | StiffCoupling | None:
        """Minus the derivative of the forces; None where nothing is in contact (collective).

        Where few directions are much stiffer than the body, they come apart from the matrix (StiffCoupling).
        """
        x = self._end_positions()
        is_near = self._surface.is_near_tangent(x, self._tangent_positions, again=self._attempts > 1)
        self._tangent_positions = x
        exact = is_near and self.allows_exact_tangent
        H = self._surface.pairs.hessian(x, exact=exact)
        if self._friction is not None:
            H = H + self._friction.hessian(x, exact=exact)
        H = csr_matrix(self._level.contact_weights.factor * H)
        if not self.comm.allreduce(H.nnz):
            return None
        matrix = self._coupling(self._surface.nodal_stiffness(H), self._input_nodes)
        stiff = stiff_directions(H, self._stiff_threshold * self.law.stiffness, self.comm)
        if stiff is None:
            return matrix
        directions, stiffness = self._gather.owned(self._surface.nodal_directions(stiff[0])), stiff[1]
        return StiffCoupling(matrix, directions.reshape(self._owned, len(stiffness)), stiffness)

    def min_gap(self) -> float:
        """Least distance within the barrier at the current u, m; infinite where none is active (collective)."""
        x = self._positions_at(self._u.x.array[: self._owned])
        return float(self.comm.allreduce(self._surface.pairs.min_gap(x), op=MPI.MIN))

    def stored_energy(self) -> float:
        """Energy of the barrier at the current u, of this rank's pairs, J (collective)."""
        x = self._end_positions()
        # kept, as the line search and the energy balance both need it
        if self._stored is None:
            self._stored = self._surface.pairs.energy(x)
        return self._stored

    def stiffen_contact(self) -> float:
        """Make a barrier stiffer whose gaps have nearly closed; returns the energy that this adds, J (collective).

        The energy is that of this rank's pairs.
        """
        x = self._end_positions()
        gap = self.comm.allreduce(self._surface.pairs.min_gap(x), op=MPI.MIN)
        if (factor := stiffness_factor(gap / self.law.distance)) <= 1:
            return 0.0
        energy = (factor - 1) * self._surface.pairs.energy(x)
        self._set_stiffness(factor * self.law.stiffness)
        return energy

    def _set_stiffness(self, stiffness: float) -> None:
        if stiffness == self.law.stiffness:
            return
        self.law = replace(self.law, stiffness=stiffness)
        self._surface.set_stiffness(stiffness)

    def damping_forces(self) -> Values | None:
        """(owned dofs,) minus the forces of friction, N (collective)."""
        return -self._nodal_forces(self._end_positions(), normal=False) if self.law.friction else None

    def potential(self) -> float:
        """Potential of barrier and friction as they enter the residual, of this rank's pairs, J (collective)."""
        x, energy = self._end_positions(), self.stored_energy()
        if self._friction is not None:
            energy += self._friction.energy(x)
        return self._level.contact_weight * self._level.fraction * energy

    # --- step limits ---

    def max_step_fraction(self, change: Values) -> float:
        """Fraction of a change of u (owned dofs,), m, without a collision (collective)."""
        return self._free_fraction(self._end_positions(), np.divide(change, self._level.fraction))

    def _free_fraction(self, x: Values, motion: Values) -> float:
        """Fraction of a motion (owned dofs,) from positions x (n, d), m, without a collision (collective)."""
        return self._surface.pairs.free_fraction(x, x + self._surface.point_map.weights @ self._all_nodes(motion))

    def begin_solve(self) -> None:
        """Count an attempt of Newton's method; after a failure tangents become exact later."""
        self._tangent_positions, self._attempts = None, self._attempts + 1

    def feasible_guess(self, u: Values) -> Values:
        """(owned dofs,) first guess of u, m, as far on its way from the start as there is no collision (collective)."""
        level = self._level
        if not level.dt:
            return u
        assert self._start_positions is not None
        fraction = self._free_fraction(self._start_positions, level.displacement_at_end(u) - level.u_n)
        return u if fraction == 1 else np.asarray(level.u_n + fraction * (u - level.u_n))

    def clear_search(self) -> None:
        """Discard the candidates of collision detection (not collective)."""
        self._is_stale = True
        self._surface.pairs.clear_caches()

    def destroy(self) -> None:
        """Destroy the objects of PETSc."""
        self._coupling.destroy()


def node_gather(domain: Domain, law: SelfContactLaw) -> Gather:
    """Gathering of the nodes that the surface depends on."""
    return domain.input_numbering.gather_corners if law.corners_only else domain.input_numbering.gather_nodes


def refined_mesh(domain: Domain) -> MeshData | None:
    """Input mesh with quadratic cells subdivided into linear ones."""
    from ..mesh.split_surface.quadratic_surface import subdivided_input_mesh

    return subdivided_input_mesh(domain)
