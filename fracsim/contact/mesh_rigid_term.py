"""Contact of a body with solids of which some move freely: the same term, with their poses as further unknowns.

As for other free obstacles (free_obstacles): the body sees what is left once the poses are eliminated, which rank 0
finds; all ranks are told.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import cast

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from ..errors import InputError
from ..forms.schemes import Scheme
from ..mechanics.term import TimeLevel
from ..mesh.domain import Domain
from ..mesh.parallel import from_root, on_root
from .barrier import Barrier
from .ipc_surface import SelfContactLaw
from .mesh_obstacle_term import MeshObstacleTerm, stop_before_meshes
from .mesh_obstacles import MeshContactSurface
from .mesh_rigid_body import FreeMesh, MeshSurroundings
from .obstacle import FreeObstacle, RigidMotion, RigidObstacle, motion_rows
from .obstacle_pairs import ObstaclePairs
from .pose import Pose, PosedShape
from .rigid_body import RigidStep
from .rigid_obstacle_state import motion_columns
from .step_limit import PoseMotion
from .triangle_mesh_shape import TriangleMeshShape

Values = npt.NDArray[np.float64]


class FreeMeshTerm(MeshObstacleTerm):
    """Solids, at least one of them free.

    Attributes:
        free: the free ones by their place among `obstacles`.
    """

    exact_near_solution = False  # what is left of poses has a positive part alone
    free: dict[int, FreeMesh]

    def __init__(
        self,
        domain: Domain,
        u: fem.Function,
        obstacles: dict[int, RigidObstacle],
        law: SelfContactLaw,
        scheme: Scheme,
        others: dict[int, RigidObstacle],
        barrier: Barrier,
    ) -> None:
        """As for Solids; `others`: held or driven obstacles of other shapes, which free solids meet with their points
        by that barrier. InputError where one overlaps the body at rest, or a free one another (collective)."""
        bodies = {k: each for k, each in enumerate(obstacles.values()) if isinstance(each, FreeObstacle)}
        self.free = {k: FreeMesh(each) for k, each in bodies.items()}
        self._scheme, self._other_obstacles, self._in_equilibrium = scheme, others, True
        super().__init__(domain, u, obstacles, law)
        self._others_posed = self._others_start = {number: each.posed_at(0.0) for number, each in others.items()}
        self._others_increments: dict[int, Values] = {number: np.zeros(6) for number in others}
        if self._meshes:  # on rank 0
            for k, each in self.free.items():
                each.obstacle_pairs = ObstaclePairs(self._refined(k), others, barrier)
        on_root(self.comm, self._check_stops)

    def _refined(self, k: int) -> FreeObstacle:
        body, standing = self.free[k].body, self._meshes[k]
        return replace(body, shape=TriangleMeshShape(standing.points, standing.triangles))

    def _check_stops(self) -> None:
        for k, each in self.free.items():
            if not each.obstacle_pairs.are_open(each.pose, self._others_posed):
                raise InputError(
                    f"{self._meshes[k].name} moves freely and overlaps another obstacle at the start; move it away or "
                    "make it smaller"
                )

    # --- a step ---

    def _place_obstacles(self, start: float, end: float) -> None:
        super()._place_obstacles(start, end)
        self._others_start = {number: each.posed_at(start) for number, each in self._other_obstacles.items()}
        self._others_posed = {number: each.posed_at(end) for number, each in self._other_obstacles.items()}
        self._others_increments = {
            number: each.pose_increment(start, end) for number, each in self._other_obstacles.items()
        }
        level = self._level
        for k, each in self.free.items():
            self._start_poses[k], self._increments[k] = each.motion.pose, np.zeros(6)
            each.reset_pose()
            if level.dt:
                factor = level.contact_weights.factor
                each.begin_step(
                    RigidStep(each.body, each.motion, self._scheme, level.dt, level.c_a, level.fraction, factor)
                )
                if self.comm.rank == 0:
                    each.obstacle_pairs.begin_step(
                        each.pose, self._others_start, along=level.contact_weights.time_averaged
                    )

    def begin_step(self, level: TimeLevel) -> None:
        """Free ones stay where they begin until they are looked for."""
        super().begin_step(level)
        self._in_equilibrium = False

    def _pose_after(self, number: int, gone: float) -> Pose:
        return self.free[number].pose if number in self.free else super()._pose_after(number, gone)

    def accept_step(self) -> None:
        """The step is over: solids have the momentum that it gave them (collective)."""
        super().accept_step()
        x = None if self._is_far() else self._end_positions()
        flights = from_root(self.comm, lambda: {k: self._arrived(k, x) for k in self.free})
        for each in self.free.values():
            each.store_solution()
        self.set_free_motions(flights)

    def _arrived(self, k: int, x: Values | None) -> RigidMotion:
        each = self.free[k]
        return each.step.end_motion(each.z, each.wrench(self._surroundings(k, x)))

    # --- where free ones are ---

    @property
    def _in_step(self) -> bool:
        return bool(self._level.dt) and all(each.in_step for each in self.free.values())

    def update_displacement(self) -> None:
        """All has to be found anew."""
        super().update_displacement()
        self._in_equilibrium = False

    def _is_far(self) -> bool:
        self._equilibrate()
        return super()._is_far()

    def _end_positions(self) -> Values | None:
        self._equilibrate()
        return super()._end_positions()

    def _equilibrate(self) -> None:
        """Free ones are where they belong with the body at the current u (collective)."""
        if self._in_equilibrium or not self._in_step:
            return
        self._in_equilibrium = True
        for near in (not super()._is_far(), True):
            x = super()._end_positions() if near else None
            self._move_free(from_root(self.comm, partial(self._settled_ways, x)))
            if near or super()._is_far():
                break

    def _settled_ways(self, x: Values | None) -> dict[int, Values]:
        """(k,) z of each, on rank 0."""
        return {k: each.equilibrate(self._surroundings(k, x)) for k, each in self.free.items()}

    def _move_free(self, ways: Mapping[int, Values]) -> None:
        for k, z in ways.items():
            self.free[k].move_to(z)
            self._poses[k] = self.free[k].pose
            if self._meshes:
                self._meshes[k].move_to(self.free[k].pose)
        self._far = self._contact_force = None

    def _surroundings(self, k: int, x: Values | None) -> MeshSurroundings:
        """What is around a free one, on rank 0; `x`: as in Before."""
        if x is None or self._surface is None:
            return MeshSurroundings(None, None, None, self._others_posed)
        facing = self._surface.pairs.pairs[k]
        rubbing = None if self._friction is None else self._friction.friction_with(facing)
        return MeshSurroundings(facing, rubbing, x, self._others_posed, self._start_positions)

    # --- what they add to the balance ---

    def low_rank_updates(self) -> list[tuple[Values, Values]]:
        """Phi_xz and Phi_zz^-1 of each that is touched and under way (collective)."""
        if not self._in_step or self._is_far():
            return []
        x = self._end_positions()

        def found() -> list[tuple[Values, Values]]:
            assert self._surface is not None and x is not None
            given = [self.free[k].condensation(self._surroundings(k, x)) for k in self.free]
            return [(self._to_nodes(mixed), compliance) for mixed, compliance in (each for each in given if each)]

        parts = on_root(self.comm, found) or []
        self._move_free({k: each.z for k, each in self.free.items()})
        compliances = self.comm.bcast([compliance for _, compliance in parts])
        mixed = [self._gather.scatter(parts[i][0] if parts else None) for i in range(len(compliances))]
        return [(U.reshape(self._owned, len(C)), C) for U, C in zip(mixed, compliances, strict=True)]

    def _to_nodes(self, mixed: Values) -> Values:
        """(nodes, 3 k) of what is (3 n, k) at points."""
        assert self._surface is not None
        return self._surface.nodal_forces(mixed.reshape(-1, 3 * mixed.shape[1]))

    def potential(self) -> float:
        """With the inertia and the weight of free ones, on rank 0, J (collective)."""
        energy, level = super().potential(), self._level
        if self.comm.rank == 0 and level.dt:
            for each in self.free.values():
                energy += each.step.free_potential(each.z) + (
                    level.contact_weight * level.fraction * self._pair_energies(each)[1]
                )
        return energy

    def stored_energy(self) -> float:
        """With the barriers between obstacles, on rank 0, J (collective)."""
        energy = super().stored_energy()
        return (
            energy + sum(self._pair_energies(each)[0] for each in self.free.values()) if self.comm.rank == 0 else energy
        )

    def _pair_energies(self, each: FreeMesh) -> tuple[float, float]:
        return each.obstacle_pairs.energies(each.pose, self._others_posed)

    def kinetic_energy(self) -> float:
        """Energy of motion of the free solids, on rank 0, J."""
        return (
            0.0
            if self.comm.rank
            else sum(float(each.body.history_values(each.motion)[-1]) for each in self.free.values())
        )

    def step_work(self) -> tuple[float, float]:
        """With the work of gravity, and of other obstacles' motion, on free ones; on rank 0, J."""
        work = sum(done for k, done in enumerate(self._obstacle_work) if k not in self.free)
        if self.comm.rank == 0:
            for k, each in self.free.items():
                work += each.body.gravity_potential(self._start_poses[k])[0] - each.body.gravity_potential(each.pose)[0]
                work += each.obstacle_pairs.work(each.pose, self._others_posed, self._others_increments)
        return work, self._friction_loss

    # --- how far Newton's method may go ---

    def _free_fraction(self, x: Values | None, way: Values | None) -> float:
        assert self._surface is not None and x is not None and way is not None
        moved, before, shares = self._surface.point_map.weights @ way, [each.pose for each in self._meshes], [1.0]
        for k, each in self.free.items():
            pose = each.predict_pose(self._surroundings(k, x), moved)
            still: dict[int, PoseMotion] = {
                number: (placed, np.zeros(6)) for number, placed in self._others_posed.items()
            }
            shares.append(each.obstacle_pairs.safe_fraction(before[k], before[k].increment_to(pose), still))
            each.move_to(each.z)
            self._meshes[k].move_to(pose)
        shares.append(self._surface.pairs.moving_free_fraction(x, x + moved, before))
        for k in self.free:
            self._meshes[k].move_to(before[k])
        return min(shares)

    def feasible_guess(self, u: Values) -> Values:
        """(owned dofs,) a first guess of u that has passed through nothing on its way from the start: free solids stop,
        or the body with them, before they meet (collective)."""
        if not self._level.dt:
            return super().feasible_guess(u)
        for each in self.free.values():
            each.discard_predictor()
        self._move_free({k: each.step.free_flight for k, each in self.free.items()})
        guess = super().feasible_guess(u)
        self._move_free(self.comm.bcast({k: each.z for k, each in self.free.items()}))
        self._in_equilibrium = False
        return guess

    def _first_guess(self, front: MeshContactSurface, start: Values, end: Values) -> Values:
        led = [k for k in range(len(self.obstacles)) if k not in self.free]
        to, share = end, 1.0
        if led:
            to = stop_before_meshes(front, front.pairs.select(led), start, end, [self._start_poses[k] for k in led])
        ways = [*(self._increments[k] for k in led), *self._others_increments.values()]
        x_to, taken = front.point_map(to), {}
        self._start_positions = front.point_map(start) if self._start_positions is None else self._start_positions
        for k, each in self.free.items():
            around = MeshSurroundings(front.pairs.pairs[k], None, None, self._others_start, self._start_positions)
            taken[k], safe = each.first_guess(around, x_to, ways)
            share = min(share, safe)
        self._move_free({k: share * z for k, z in taken.items()})
        return to if share == 1 else start + share * (to - start)

    def is_feasible(self, u: Values) -> bool:
        """Whether nothing is passed on the straight way from the start to u, nor any stop entered (collective)."""
        at = self._others_posed
        every = self.free.values()
        apart = from_root(self.comm, lambda: all(each.obstacle_pairs.are_open(each.pose, at) for each in every))
        return super().is_feasible(u) and apart

    def restrict_motion(self) -> None:
        """All stay where the step began (collective)."""
        self._move_free({k: 0 * each.z for k, each in self.free.items()})
        super().restrict_motion()

    # --- their flights are their past, and told ---

    def free_motions(self) -> dict[int, RigidMotion]:
        """How each moves, by its place."""
        return {k: each.motion for k, each in self.free.items()}

    def set_free_motions(self, flights: Mapping[int, RigidMotion]) -> None:
        """Move again as `flights` gave it."""
        for k, each in self.free.items():
            each.motion = flights[k]

    def snapshot(self) -> object:
        """That of the surface, and how solids move."""
        return super().snapshot(), self.free_motions()

    def restore(self, memory: object) -> None:
        """Be again what `memory` gave (not collective)."""
        surface, flights = cast("tuple[object, dict[int, RigidMotion]]", memory)
        super().restore(surface)
        self.set_free_motions(flights)

    def to_checkpoint(self) -> dict[str, Values]:
        """With rows of how solids move (collective)."""
        return super().to_checkpoint() | {"flights": motion_rows(each.motion for each in self.free.values())}

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Be again what `saved` gave."""
        super().from_checkpoint(saved)
        for row, each in enumerate(self.free.values()):
            each.motion = each.motion.from_array(saved["flights"][row])

    def posed_obstacles(self, t: float) -> list[PosedShape]:
        """Each solid at the time t of the state, s (not collective)."""
        here = super().posed_obstacles(t)
        for k, each in self.free.items():
            here[k] = PosedShape(here[k].shape, each.motion.pose)
        return here

    def summed_columns(self) -> dict[str, Callable[[], Values]]:
        """With the columns of all that are free (flights)."""
        return super().summed_columns() | motion_columns(self.free.values(), self.comm)
