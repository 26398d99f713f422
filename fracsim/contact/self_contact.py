"""Term of the balance for contact of a body with itself, and of its fragments with one another, in implicit steps.

Each rank has its own elements of the split surface and those of others near them (partitioned_surface), finds its pairs
in contact (ipc_pairs), and maps their forces and stiffness to the nodes: x = W u, f = W^T dE/dx, K = W^T d2E/dx2 W.
Nodal values are summed over the ranks.

Equations: docs/theory.md#contact.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import csr_matrix

from ..array_types import Flags, Ints, Pattern, Values
from ..mechanics.extra_couplings import CouplingBuilder, FewNodesCoupling, sum_few_nodes
from ..mechanics.term import Term, TimeLevel
from ..mesh.domain import Domain
from ..mesh.parallel import allgather, max_over_ranks, sum_over_ranks
from .element_exchange import EXCHANGE
from .ipc_pairs import IpcPairs, PairShare
from .laws import BARRIER, stiffness_factor
from .mesh_obstacles import BarrierPart, MeshObstacle
from .pair_search import max_length
from .partitioned_surface import PartitionedSurface
from .retractable_surface import SURFACE, RetractableSurface, SelfContactLaw
from .sample_points import IpcFriction


class BarrierBodySurface(PartitionedSurface[BarrierPart]):
    """Contact surface of a body with the barrier, whose stiffness may grow.

    A pair belongs to the rank of its lowest point (ipc_pairs.PairShare). Before obstacles a rank needs the elements
    around the points of its own ones alone, since every rank has the whole obstacle.
    """

    closed_pressure: ClassVar[float] = SURFACE.closed_pressure

    def __init__(
        self, domain: Domain, u: fem.Function, law: SelfContactLaw, obstacles: Sequence[MeshObstacle] = ()
    ) -> None:
        """As of PartitionedSurface (collective)."""
        # before obstacles: elements that share a point are always near each other
        margin = np.inf if obstacles else EXCHANGE.barrier_margin * domain.mean_edge_length
        super().__init__(domain, u, law, obstacles, law.distance, margin)

    def _build_part(
        self, surface: RetractableSurface[BarrierPart], elements: Ints, mesh: MeshObstacle | None
    ) -> BarrierPart:
        law, share = self.law, PairShare.of(self._comm, surface.own_points)
        return BarrierPart.build(
            surface.rest_positions, surface.elements[elements], mesh, distance=law.distance, stiffness=law.stiffness,
            edge=self.mean_edge, friction=law.friction, share=share,
        )  # fmt: skip

    def _searched_boxes(self, boxes: Values) -> Values:
        return boxes[self.border_elements()] if self._meshes else super()._searched_boxes(boxes)

    def set_stiffness(self, stiffness: float) -> None:
        """Set the stiffness of the barrier, Pa."""
        if stiffness != self.law.stiffness:
            self.law = replace(self.law, stiffness=stiffness)
            self.current.set_law(self.law)
            for part in self.current.parts:
                part.pairs.set_stiffness(stiffness)

    def to_checkpoint(self) -> dict[str, Values]:
        """As of PartitionedSurface, and the stiffness."""
        return {**super().to_checkpoint(), "stiffness": np.array([self.law.stiffness])}

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Set the state from the arrays of a checkpoint (collective)."""
        self.set_stiffness(float(saved["stiffness"][0]))
        super().from_checkpoint(saved)


class SurfaceContact(Term):
    """Barrier of a body's surface, before itself or obstacles; a subclass begins steps and limits them.

    Attributes:
        surface: the surface of the body.
        level: time level of the current or last step.
        friction: lagged friction of the step in each part of the contact; None: without.
        start_positions: (n, d) of the surface at the start of the step, m.
        allows_exact_tangent: whether tangents are exact near the solution.
    """

    leaves_tangent_incomplete = True
    allows_exact_tangent: bool = True
    level: TimeLevel
    _extended_at: float | None = None  # start of the step in which crack faces were extended last, s
    _fitted_displacement: Values | None = None  # at which crack faces have found their room within the step

    def __init__(self, domain: Domain, u: fem.Function, surface: BarrierBodySurface) -> None:
        self._domain, self._u, self.surface = domain, u, surface
        self._owned, self.comm = domain.node_count * domain.dim, domain.comm
        self._coupling = CouplingBuilder(domain)
        self._discard_surface()

    # --- surface ---

    def _discard_surface(self) -> None:
        """Discard all that belongs to the points of the surface until now."""
        self._positions: Values | None = None
        self._contact_force: Values | None = None
        self._stored: float | None = None
        self.start_positions: Values | None = None
        self._tangent_displacement: Values | None = None
        self.friction: Sequence[IpcFriction | None] = self._no_friction()
        self._is_stale, self._exchange_count = True, self.surface.exchange_count

    @property
    def contacts(self) -> Sequence[BarrierPart]:
        """Contact of the surface with itself, or with each obstacle."""
        return self.surface.current.parts

    def _no_friction(self) -> list[IpcFriction | None]:
        return [None] * len(self.contacts)

    def edges_broke(self, pattern: Pattern) -> None:
        """Add new crack faces, retracted where there is no room (collective)."""
        self.surface.edges_broke(pattern)
        self._discard_surface()
        self._fitted_displacement = self._u.x.array[: self._owned].copy()

    def _extend_faces(self, u_n: Values) -> None:
        """Extend crack faces at u_n (owned dofs,), m, unless edges broke earlier in the step (collective)."""
        self.surface.start_displacement = u_n.copy()
        if not self.level.starts_at(self._extended_at):
            self._fitted_displacement, self._extended_at = None, self.level.start_time
        if self._fitted_displacement is None:
            self.surface.extend_faces(u_n)

    def update_displacement(self) -> None:
        """Discard positions and forces, as u has changed."""
        self._is_stale = True

    @property
    def end_displacement(self) -> Values:
        """(owned dofs,) displacement at the end of the step that belongs to the current u, m."""
        return self.level.displacement_at_end(self._u.x.array[: self._owned])

    def end_positions(self) -> Values:
        """(n, d) positions at the end of the step that belongs to the current u, m (collective)."""
        if self._is_stale or self._positions is None or self._exchange_count != self.surface.exchange_count:
            self._positions, self._is_stale = self.surface.positions(self.end_displacement), False
            self._contact_force = self._stored = None
            if self._exchange_count != self.surface.exchange_count:
                self._exchange_count = self.surface.exchange_count
                self._renumber_start()
        return self._positions

    def _renumber_start(self) -> None:
        """Compute again what belongs to the points at the start of the step, which have other numbers (collective)."""

    def is_far(self) -> bool:
        """Whether nothing can be in contact at the current u (collective); of a body with itself it is not asked."""
        return False

    def followed_nodes(self) -> Flags:
        """(owned nodes,) flags of the nodes that points of the surface follow (collective)."""
        return self.surface.nodes_of_points()

    # --- forces, tangent and energy ---

    def _nodal_forces(self, x: Values, *, normal: bool = True) -> Values:
        """(owned dofs,) forces on the nodes, N (collective).

        Args:
            x: (n, d) positions of the surface, m.
            normal: whether normal forces are included; otherwise those of friction alone.
        """
        gradient = np.zeros_like(x)
        for part, friction in zip(self.contacts, self.friction, strict=True):
            if normal:
                gradient += part.gradient(x)
            if friction is not None:
                gradient += friction.gradient(part.points(x))[: len(x)]
        return self.surface.nodal_forces(-gradient)

    def contact_forces(self) -> Values | None:
        """(owned dofs,) contact forces at the end of the step, N; None: nothing is near (collective)."""
        if self.is_far():
            return None
        x = self.end_positions()
        # kept, as residual and reference forces both need them
        if self._contact_force is None:
            self._contact_force = self._nodal_forces(x)
        return self._contact_force

    def coupling_matrix(self) -> PETSc.Mat | FewNodesCoupling | None:
        """Minus the derivative of the forces; None where nothing is in contact (collective).

        With inertia, and between few nodes, it stays apart from the matrix (FewNodesCoupling).
        """
        if self.is_far():
            return None
        x, surface = self.end_positions(), self.surface.current
        exact = self._is_near_last_tangent() and self.allows_exact_tangent
        parts = zip(self.contacts, self.friction, strict=True)
        blocks = [part.full_hessian(x, friction, exact=exact)[: x.size, : x.size] for part, friction in parts]
        H = csr_matrix(self.level.contact_weights.factor * sum(blocks[1:], blocks[0]))
        if not self.comm.allreduce(H.nnz):
            return None
        part, nodes = surface.point_map.nodal_stiffness(H), surface.columns
        coupling = sum_few_nodes(self._domain, part, nodes, SURFACE.max_coupled_nodes) if self.level.dt else None
        return self._coupling(part, nodes) if coupling is None else coupling

    def _is_near_last_tangent(self) -> bool:
        """Whether no point has moved by more than a limit since the last tangent (collective)."""
        u, last = self.end_displacement, self._tangent_displacement
        self._tangent_displacement = u.copy()
        if last is None:
            return False
        moved = max_length(self.surface.interpolate(u - last))
        return max_over_ranks(self.comm, moved) < BARRIER.exact_tangent * self.surface.law.distance

    def min_gap(self) -> float:
        """Least distance within the barrier at the current u, m; infinite where none is active (collective)."""
        x = self.surface.positions(self._u.x.array[: self._owned])
        return float(self.comm.allreduce(self._own_min_gap(x), op=MPI.MIN))

    def _own_min_gap(self, x: Values) -> float:
        """Least distance within the barrier of this rank's pairs, with points at x (n, d), m."""
        near = (part for part in self.contacts if not part.is_far(x))
        return min((part.pairs.min_gap(part.points(x)) for part in near), default=np.inf)

    def stored_energy(self) -> float:
        """Energy of the barrier at the current u, of this rank's pairs, J (collective)."""
        if self.is_far():
            return 0.0
        x = self.end_positions()
        # kept, as the line search and the energy balance both need it
        if self._stored is None:
            self._stored = sum(part.energy(x) for part in self.contacts)
        return self._stored

    def stiffen_contact(self) -> float:
        """Make a barrier stiffer whose gaps have nearly closed; returns the energy that this adds, J (collective).

        The energy is that of this rank's pairs.
        """
        if self.is_far():
            return 0.0
        x, law = self.end_positions(), self.surface.law
        gap = self.comm.allreduce(self._own_min_gap(x), op=MPI.MIN)
        if (factor := stiffness_factor(gap / law.distance)) <= 1:
            return 0.0
        energy = (factor - 1) * sum(part.energy(x) for part in self.contacts)
        self.surface.set_stiffness(factor * law.stiffness)
        return energy

    def potential(self) -> float:
        """Potential of barrier and friction as they enter the residual, of this rank's pairs, J (collective)."""
        if self.is_far():
            return 0.0
        x, energy = self.end_positions(), self.stored_energy()
        for part, friction in zip(self.contacts, self.friction, strict=True):
            energy += 0.0 if friction is None else friction.energy(part.points(x))
        return self.level.contact_weight * self.level.fraction * energy

    def begin_solve(self) -> None:
        """Discard the last tangent, as an attempt of Newton's method begins."""
        self._tangent_displacement = None

    def clear_search(self) -> None:
        """Discard the candidates of collision detection, and exchange elements again (collective)."""
        self._is_stale = True
        self.surface.exchange_again()
        for part in self.contacts:
            part.pairs.clear_caches()

    def destroy(self) -> None:
        """Destroy the objects of PETSc."""
        self._coupling.destroy()


class SelfContact(SurfaceContact):
    """A body that cannot penetrate itself.

    Attributes:
        sticking_slip: slip in the step that counts as sticking, m.
    """

    name = "contact"
    sticking_slip: float

    def __init__(self, domain: Domain, u: fem.Function, law: SelfContactLaw) -> None:
        """Raise InputError where the surface at rest intersects itself (collective)."""
        super().__init__(domain, u, BarrierBodySurface(domain, u, law))
        self.parts = (self.surface,)

    @property
    def pairs(self) -> IpcPairs:
        """Pairs of the surface."""
        return self.contacts[0].pairs

    def begin_step(self, level: TimeLevel) -> None:
        """Lag friction with the contact at the start of the step."""
        self.level, self._is_stale, self.friction = level, True, [None]
        if not level.dt:
            return
        self.sticking_slip = self._sticking_slip(level)
        self._extend_faces(level.u_n)
        self.start_positions = x = self.surface.positions(level.u_n)
        self._exchange_count = self.surface.exchange_count
        self.friction = [self.contacts[0].lag_friction(x, self.sticking_slip)]

    def _renumber_start(self) -> None:
        if self.start_positions is None:
            return
        self.start_positions = x = self.surface.current.point_map(self.surface.nodal_values(self.level.u_n))
        self.friction = [self.contacts[0].lag_friction(x, self.sticking_slip)]

    def _sticking_slip(self, level: TimeLevel) -> float:
        """Slip in the step that counts as sticking, m, with speeds relative to the body's mean (collective)."""
        square, mean = mean_velocities(self.comm, level.v_n.reshape(-1, self._domain.dim))
        speed = float(np.sqrt(max(float(square - mean @ mean), 0.0)))
        return level.dt * self.surface.law.sticking_speed_at(speed)

    def damping_forces(self) -> Values | None:
        """(owned dofs,) minus the forces of friction, N (collective)."""
        return -self._nodal_forces(self.end_positions(), normal=False) if self.surface.law.friction else None

    def find_intersections(self) -> tuple[Values, Flags]:
        """(k, d) midpoints of pairs of elements that intersect at the current u, m (collective).

        Also returns (k,) flags of pairs of which one is excluded: a crack face without room.
        """
        x, surface = self.surface.positions(self._u.x.array[: self._owned]), self.surface.current
        pairs, without_room = surface.find_intersections(x)
        parts = allgather(self.comm, (x[surface.elements[pairs]].mean(axis=(1, 2)), without_room))
        midpoints, flags = (np.concatenate(values) for values in zip(*parts, strict=True))
        order = np.lexsort(midpoints.T[::-1])
        return midpoints[order], flags[order]

    def nodes_in_contact(self) -> Flags:
        """(owned nodes,) flags of the nodes that points in contact follow (collective)."""
        acts = self.contacts[0].gradient(self.end_positions()).any(axis=1)
        return self.surface.nodes_of_points(np.asarray(acts))

    # --- step limits ---

    def max_step_fraction(self, change: Values) -> float:
        """Fraction of a change of u (owned dofs,), m, without a collision (collective)."""
        return self._free_fraction(self.end_displacement, np.divide(change, self.level.fraction))

    def _free_fraction(self, u: Values, motion: Values) -> float:
        """Fraction of a motion from displacements u, (owned dofs,), m, without a collision (collective)."""
        self.surface.refresh(u, u + motion)
        x = self.surface.current.point_map(self.surface.nodal_values(u))
        return self.pairs.free_fraction(x, x + self.surface.interpolate(motion))

    def feasible_guess(self, u: Values) -> Values:
        """(owned dofs,) first guess of u, m, as far on its way from the start as there is no collision (collective).

        Where edges broke within the step, new crack faces have room at the last solution, but maybe not at the start.
        """
        level = self.level
        if not level.dt or self.start_positions is None or self._fits(level.displacement_at_end(u)):
            return u
        fraction = self._free_fraction(level.u_n, level.displacement_at_end(u) - level.u_n)
        return u if fraction == 1 else np.asarray(level.u_n + fraction * (u - level.u_n))

    def _fits(self, u: Values) -> bool:
        """Whether crack faces have found their room at u (owned dofs,), m, the end of the step (collective)."""
        if self._fitted_displacement is None:
            return False
        change = np.max(np.abs(u - self._fitted_displacement), initial=0.0)
        return bool(self.comm.allreduce(change <= SURFACE.round_off * self.surface.law.distance, op=MPI.LAND))


def mean_velocities(comm: MPI.Intracomm, v: Values) -> tuple[float, Values]:
    """Mean square speed of nodes, (m/s)^2, and their mean velocity (d,), m/s; v: (n, d) of owned ones (collective)."""
    square, count, *total = sum_over_ranks(comm, np.array([np.vdot(v, v), len(v), *v.sum(axis=0)]))
    return float(square / count), np.array(total) / count
