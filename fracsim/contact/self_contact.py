"""Term of the balance for contact of a body with itself, and of its fragments with one another, in implicit steps.

Each rank holds the split surface, finds its share of the pairs in contact (ipc_pairs), and maps their forces and
stiffness to the nodes: x = W u, f = W^T dE/dx, K = W^T d2E/dx2 W. Nodal values are summed over the ranks.

Equations: docs/theory.md#contact.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import cast

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import csr_matrix

from ..mechanics.extra_couplings import CouplingBuilder, FewNodesCoupling, sum_few_nodes
from ..mechanics.term import Term, TimeLevel
from ..mechanics.term_protocols import CutPositions
from ..mesh.domain import Domain
from ..mesh.parallel import Gather, allgather, bcast, sum_over_ranks
from ..mesh.split_surface.drawn_surface import DrawnSurface
from ..mesh.split_surface.entity_numbering import EntityNumbering
from ..mesh.split_surface.quadratic_surface import subdivided_input_mesh
from ..mesh.split_surface.surface_map import SurfaceMap
from .clearance import FollowingPoints
from .contact_patch import SelfContactPatch
from .ipc_pairs import IpcPairs
from .ipc_surface import SURFACE, SelfContactLaw, SelfContactSurface, SurfaceSnapshot
from .laws import stiffness_factor
from .pair_search import max_length
from .sample_points import SlipFriction

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
Pattern = npt.NDArray[np.uint8]

# skeleton, pattern (cells,), law, u (nodes, d), surface until now, positions of cuts (edges,) -> surface
type SurfaceBuilder[S] = Callable[[EntityNumbering, Pattern, SelfContactLaw, Values, S | None, Values | None], S]


class BreakingSurface[S: SelfContactSurface]:
    """Contact surface of a body, built again when edges break (HistoryTerm, CutFaces, SurfaceSeparator).

    Attributes:
        law: contact law, whose stiffness may grow.
        gather: gathering of the nodes that the surface depends on.
        node_numbers: (nodes,) global numbers of these, where the surface is held.
    """

    _cuts: CutPositions | None = None
    _surface: S | None = None

    def __init__(self, domain: Domain, u: fem.Function, law: SelfContactLaw, build: SurfaceBuilder[S]) -> None:
        """Build the surface of the whole body on every rank (collective).

        Args:
            domain: mesh.
            u: displacement.
            law: contact law.
            build: function that builds a surface. It refuses bodies that intersect at rest.
        """
        self.law, self._domain, self._u, self._build = law, domain, u, build
        numbering, is_refined = domain.input_numbering, domain.order == 2 and not law.corners_only
        self.gather: Gather = numbering.gather_corners if law.corners_only else numbering.gather_nodes
        # subdivided quadratic cells do not break
        self._parts = 2**domain.dim if is_refined else 1
        mesh = subdivided_input_mesh(domain) if is_refined else domain.input_mesh
        self._skeleton = EntityNumbering(bcast(domain.comm, mesh))
        self._pattern: Pattern = np.zeros(domain.cell_count, np.uint8)
        first = domain.space.dofmap.index_map.local_range[0]
        # (nodes,) global numbers of nodes in input order
        self.node_numbers = self.gather.to_all_ranks(first + np.arange(domain.node_count))
        self._rebuild()

    def _rebuild(self) -> None:
        """Build the surface of the current damage (collective)."""
        pattern = self._domain.input_numbering.gather_cells.to_all_ranks(self._pattern)
        u = self.nodal_values(self._u.x.array[: self._domain.node_count * self._domain.dim])
        cut = None
        if self._cuts is not None:
            rows = allgather(self._domain.comm, self._cuts())
            edges, positions = (np.concatenate(parts) for parts in zip(*rows, strict=True))
            cut = self._skeleton.edge_values(edges, positions[:, 0])
        cells = np.repeat(pattern, self._parts)
        # most edges break within fragments
        if self._surface is None or not self._surface.represents(cells):
            self._surface = self._build(self._skeleton, cells, self.law, u, self._surface, cut)

    @property
    def current(self) -> S:
        """Surface of the current damage."""
        assert self._surface is not None
        return self._surface

    def nodal_values(self, u: Values) -> Values:
        """(nodes, d) owned displacements u in the order of the input mesh (collective)."""
        return self.gather.to_all_ranks(np.asarray(u).reshape(-1, self._domain.dim))

    def positions(self, u: Values) -> Values:
        """(n, d) positions of its points for owned displacements u, m (collective)."""
        return self.current.point_map(self.nodal_values(u))

    def following_points(self) -> FollowingPoints:
        """Points of the surface."""
        surface = self.current
        share, excluded, _ = surface.snapshot()
        nodes = np.unique(surface.point_map.weights.indices)
        may_stay = not len(excluded) and bool(np.all(share == 1))
        weights, numbers = surface.point_map.weights[:, nodes], self.node_numbers[nodes]
        return FollowingPoints(surface.point_map.rest, weights, numbers, surface.elements, may_stay=may_stay)

    def set_cuts(self, cuts: CutPositions) -> None:
        """Set where edges are cut; used for faces between fragments."""
        if self.law.fragments_only:
            self._cuts = cuts

    def edges_broke(self, pattern: Pattern) -> None:
        """Add new crack faces, retracted where there is no room (collective)."""
        self._pattern = pattern
        self._rebuild()

    def set_stiffness(self, stiffness: float) -> None:
        """Set the stiffness of the barrier, Pa."""
        if stiffness != self.law.stiffness:
            self.law = replace(self.law, stiffness=stiffness)
            self.current.set_stiffness(stiffness)

    def separate_surface(self, points: SurfaceMap, surface: DrawnSurface, u: Values, t: float) -> SurfaceMap:
        """Move points of a surface for output to the crack faces of contact, which are offset and retracted."""
        if self._parts > 1:
            return points
        current, nodal = self.current, self.nodal_values(u)
        if self.law.fragments_only:
            return current.place_faces(points, surface, nodal)
        rows, share = surface.whole.points, current.point_map.share
        # faces without an offset stay where other terms have moved them
        if current.face_gap:
            full_arms = current.point_map.with_arm_share(np.ones(len(share)))(nodal)
            points = points.move_points(np.arange(len(rows)), full_arms[rows])
        return points.with_arm_share(np.minimum(share[rows], points.share))

    def snapshot(self) -> SurfaceSnapshot:
        """Retracted and excluded parts of the surface."""
        return self.current.snapshot()

    def restore(self, memory: object) -> None:
        """Restore a snapshot (not collective)."""
        self.current.restore(cast("SurfaceSnapshot", memory))

    def to_checkpoint(self) -> dict[str, Values]:
        """Factors of arms, numbers of excluded elements, steps to the next release of faces, and stiffness."""
        share, excluded, pause = self.current.snapshot()
        return {"share": share, "left_out": np.asarray(excluded, float), "pause": np.array(pause, float),
                "stiffness": np.array([self.law.stiffness])}  # fmt: skip

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Set the state from the arrays of a checkpoint."""
        self.set_stiffness(float(saved["stiffness"][0]))
        if len(saved["share"]) != len(self.current.point_map.share):
            raise ValueError(f"{len(saved['share'])} points of the contact surface instead of those of its damage")
        pause, remaining = (int(number) for number in saved["pause"])
        self.current.restore((saved["share"], saved["left_out"].astype(np.int64), (pause, remaining)))


class SurfaceContact(Term):
    """Barrier of a body's surface, before itself or obstacles; a subclass begins steps and limits them.

    Attributes:
        surface: the surface of the body.
        level: time level of the current or last step.
        friction: lagged friction of the step; None: without.
        start_positions: (n, d) of the surface at the start of the step, m.
        allows_exact_tangent: whether tangents are exact near the solution.
    """

    leaves_tangent_incomplete = True
    allows_exact_tangent: bool = True
    level: TimeLevel
    _attempts = 0  # of Newton's method in the step
    _start_displacement: Values | None = None  # of the last step in which faces may have been extended
    _fitted_displacement: Values | None = None  # at which crack faces have found their room within the step

    def __init__(
        self, domain: Domain, u: fem.Function, law: SelfContactLaw, build: SurfaceBuilder[SelfContactSurface]
    ) -> None:
        """`build`: function that builds the surface. It refuses bodies that intersect at rest (collective)."""
        self._domain, self._u = domain, u
        self._owned, self.comm = domain.node_count * domain.dim, domain.comm
        self._coupling = CouplingBuilder(domain)
        self.surface = BreakingSurface(domain, u, law, build)
        self._discard_surface()

    # --- surface ---

    def _discard_surface(self) -> None:
        """Discard all that belongs to the points of the surface until now."""
        self._positions: Values | None = None
        self._contact_force: Values | None = None
        self._stored: float | None = None
        self.start_positions: Values | None = None
        self._tangent_positions: Values | None = None
        self.friction: SlipFriction | None = None
        self._is_stale = True

    def edges_broke(self, pattern: Pattern) -> None:
        """Add new crack faces, retracted where there is no room (collective)."""
        self.surface.edges_broke(pattern)
        self._discard_surface()
        self._fitted_displacement = self._u.x.array[: self._owned].copy()

    def _extend_faces(self, u_n: Values, nodal: Values) -> None:
        """Extend crack faces at the start of a step, unless edges broke in an earlier pass of it (collective).

        A step that begins where the last one did, at u_n (owned dofs,), m, is repeated. `nodal`: (nodes, d) of u_n.
        """
        before, self._start_displacement = self._start_displacement, u_n.copy()
        if not self.comm.allreduce(before is not None and np.array_equal(before, u_n), op=MPI.LAND):
            self._fitted_displacement = None
        if self._fitted_displacement is None:
            self.surface.current.extend_faces(nodal)

    def update_displacement(self) -> None:
        """Discard positions and forces, as u has changed."""
        self._is_stale = True

    @property
    def end_displacement(self) -> Values:
        """(owned dofs,) displacement at the end of the step that belongs to the current u, m."""
        return self.level.displacement_at_end(self._u.x.array[: self._owned])

    def end_positions(self) -> Values:
        """(n, d) positions at the end of the step that belongs to the current u, m (collective)."""
        if self._is_stale or self._positions is None:
            self._positions, self._is_stale = self.surface.positions(self.end_displacement), False
            self._contact_force = self._stored = None
        return self._positions

    def is_far(self) -> bool:
        """Whether nothing can be in contact at the current u (collective); of a body with itself it is not asked."""
        return False

    # --- forces, tangent and energy ---

    def _nodal_forces(self, x: Values, *, normal: bool = True) -> Values:
        """(owned dofs,) forces on the nodes, N (collective).

        Args:
            x: (n, d) positions of the surface, m.
            normal: whether normal forces are included; otherwise those of friction alone.
        """
        gradient = self.surface.current.pairs.gradient(x) if normal else np.zeros_like(x)
        if self.friction is not None:
            gradient = gradient + self.friction.gradient(x)
        return self.surface.gather.sum_owned(self.surface.current.point_map.nodal_forces(-gradient)).reshape(-1)

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
        limit = SURFACE.exact_tangent if self._attempts <= 1 else SURFACE.later_exact_tangent
        last, self._tangent_positions = self._tangent_positions, x
        is_near = last is not None and max_length(x - last) < limit * self.surface.law.distance
        exact = is_near and self.allows_exact_tangent
        H = surface.pairs.hessian(x, exact=exact)
        if self.friction is not None:
            H = H + self.friction.hessian(x, exact=exact)
        H = csr_matrix(self.level.contact_weights.factor * H)
        if not self.comm.allreduce(H.nnz):
            return None
        part, nodes = surface.point_map.nodal_stiffness(H), self.surface.node_numbers
        coupling = sum_few_nodes(self._domain, part, nodes, SURFACE.max_coupled_nodes) if self.level.dt else None
        return self._coupling(part, nodes) if coupling is None else coupling

    def min_gap(self) -> float:
        """Least distance within the barrier at the current u, m; infinite where none is active (collective)."""
        x = self.surface.positions(self._u.x.array[: self._owned])
        return float(self.comm.allreduce(self.surface.current.pairs.min_gap(x), op=MPI.MIN))

    def stored_energy(self) -> float:
        """Energy of the barrier at the current u, of this rank's pairs, J (collective)."""
        if self.is_far():
            return 0.0
        x = self.end_positions()
        # kept, as the line search and the energy balance both need it
        if self._stored is None:
            self._stored = self.surface.current.pairs.energy(x)
        return self._stored

    def stiffen_contact(self) -> float:
        """Make a barrier stiffer whose gaps have nearly closed; returns the energy that this adds, J (collective).

        The energy is that of this rank's pairs.
        """
        if self.is_far():
            return 0.0
        x, pairs, law = self.end_positions(), self.surface.current.pairs, self.surface.law
        gap = self.comm.allreduce(pairs.min_gap(x), op=MPI.MIN)
        if (factor := stiffness_factor(gap / law.distance)) <= 1:
            return 0.0
        energy = (factor - 1) * pairs.energy(x)
        self.surface.set_stiffness(factor * law.stiffness)
        return energy

    def potential(self) -> float:
        """Potential of barrier and friction as they enter the residual, of this rank's pairs, J (collective)."""
        if self.is_far():
            return 0.0
        x, energy = self.end_positions(), self.stored_energy()
        if self.friction is not None:
            energy += self.friction.energy(x)
        return self.level.contact_weight * self.level.fraction * energy

    def begin_solve(self) -> None:
        """Count an attempt of Newton's method; after a failure tangents become exact later."""
        self._tangent_positions, self._attempts = None, self._attempts + 1

    def clear_search(self) -> None:
        """Discard the candidates of collision detection (not collective)."""
        self._is_stale = True
        self.surface.current.pairs.clear_caches()

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
        super().__init__(domain, u, law, partial(SelfContactSurface, comm=domain.comm))
        self.parts = (self.surface,)

    @property
    def pairs(self) -> IpcPairs:
        """Pairs of the surface."""
        return cast("IpcPairs", self.surface.current.pairs)

    def begin_step(self, level: TimeLevel) -> None:
        """Lag friction with the contact at the start of the step."""
        self.level, self._is_stale, self.friction, self._attempts = level, True, None, 0
        if not level.dt:
            return
        nodal, surface = self.surface.nodal_values(level.u_n), self.surface.current
        self.sticking_slip = self._sticking_slip(level)
        self._extend_faces(level.u_n, nodal)
        self.start_positions = x = surface.point_map(nodal)
        if self.surface.law.friction:
            self.friction = self.pairs.lag_friction(x, x, self.sticking_slip)

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
        surface, nodal = self.surface.current, self.surface.nodal_values(self._u.x.array[: self._owned])
        pairs, without_room = surface.find_intersections(nodal)
        return surface.point_map(nodal)[surface.elements[pairs]].mean(axis=(1, 2)), without_room

    def patch(self, nodes: Ints) -> SelfContactPatch:
        """Contact of nodes (k,), by their ascending global numbers, that move from the current u (collective)."""
        return SelfContactPatch(self, nodes)

    # --- step limits ---

    def max_step_fraction(self, change: Values) -> float:
        """Fraction of a change of u (owned dofs,), m, without a collision (collective)."""
        return self._free_fraction(self.end_positions(), np.divide(change, self.level.fraction))

    def _free_fraction(self, x: Values, motion: Values) -> float:
        """Fraction of a motion (owned dofs,) from positions x (n, d), m, without a collision (collective)."""
        surface, nodal = self.surface.current, self.surface.nodal_values(motion)
        return self.pairs.free_fraction(x, x + surface.point_map.weights @ nodal)

    def feasible_guess(self, u: Values) -> Values:
        """(owned dofs,) first guess of u, m, as far on its way from the start as there is no collision (collective).

        Where edges broke within the step, new crack faces have room at the last solution, but maybe not at the start.
        """
        level, start = self.level, self.start_positions
        if not level.dt or start is None or self._fits(level.displacement_at_end(u)):
            return u
        fraction = self._free_fraction(start, level.displacement_at_end(u) - level.u_n)
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
