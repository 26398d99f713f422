"""Time step of rigid bodies: motion, analyses of impacted bodies, fracture, and motion again with the fragments."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from ..contact.obstacle import RigidObstacle
from ..errors import NotConverged, StepAborted
from ..mesh.split_surface.polyhedron_moments import PolyhedronMoments
from .bodies import Bodies
from .contact_points import ContactImpulses
from .engine import Engine
from .fragment_geometry import FragmentGeometry, FragmentShapes
from .fragment_overlap import InitialOverlaps
from .impact_detection import BodyLoad, ImpactDetector
from .instances import Instances, InstancesSnapshot
from .mujoco_model import ContactParameters
from .obstacles import ObstacleSet, Part
from .parallel_analyses import ImpactLoads, ParallelAnalyses
from .surface_loads import HertzContact, ImpactSpheres

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Arrays = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True)
class RigidState:
    """Bodies at one time.

    Attributes:
        t: s.
        step: number of the step.
        bodies: fragments, then free obstacles.
        work: of gravity and driven obstacles since the start, J.
    """

    t: float
    step: int
    bodies: Bodies
    work: float = 0.0


@dataclass(frozen=True)
class RigidReport:
    """Figures of a step.

    Attributes:
        broken: edges that broke.
        blows: number of blows that were found.
        loads: number of loads that were found.
        kinetic_energy: of all bodies, J.
        obstacle_forces: (obstacles, 3) mean force of the fragments on each obstacle, N.
        obstacle_work: (obstacles,) work of each obstacle, J; of a free one: the energy that it lost.
        cg_iterations: in all analyses.
        seconds: wall time.
        contact_error: of the velocities, m/s; 0 if contact is within the tolerance.
    """

    broken: int
    blows: int
    loads: int
    kinetic_energy: float
    obstacle_forces: Values
    obstacle_work: Values
    cg_iterations: int
    seconds: float
    contact_error: float


@dataclass
class _StepSnapshot:
    """State beside the RigidState as a step begins.

    Attributes:
        overlaps: of fragments.
        detector: arrays of the impact detector.
        instances: those that are analysed in the step, as they were; None: none is.
    """

    overlaps: InitialOverlaps
    detector: Arrays
    instances: InstancesSnapshot | None = None


@dataclass
class PhaseTimes:
    """Wall time, s, of each phase of the steps so far."""

    seconds: dict[str, float] = field(default_factory=lambda: dict.fromkeys(("motion", "analysis", "pieces"), 0.0))

    def add(self, phase: str, began: float) -> float:
        """Add the time since `began`, s, to a phase; return the present time."""
        current = time.perf_counter()
        self.seconds[phase] += current - began
        return current


class RigidStepper:
    """Stepper for the instances of one mesh (one rank); the bodies of a state are their present fragments.

    Attributes:
        instances: of the mesh.
        obstacles: fixed, driven and free ones.
        shapes: of the fragments.
        impact_detector: tells blows and loads.
        analyses: of impacted bodies.
        initial_overlaps: of fragments.
        phases: wall time so far.
    """

    shapes: FragmentShapes

    def __init__(
        self,
        instances: Instances,
        geometry: FragmentGeometry,
        density: float,
        obstacles: Sequence[RigidObstacle],
        parameters: ContactParameters,
        hertz: HertzContact,
        contact_time: float | None = None,
        analyses: ParallelAnalyses | None = None,
    ) -> None:
        """Find the fragments of the instances as they are.

        Args:
            instances: of the mesh.
            geometry: of their fragments.
            density: kg/m^3.
            obstacles: of the study.
            parameters: time step and contact.
            hertz: contact law for durations and circles.
            contact_time: duration of all blows, s; None: Hertz's.
            analyses: of the mesh; None: on this rank alone.
        """
        self.analyses = analyses or ParallelAnalyses(instances)
        self.instances, self._geometry, self._density = instances, geometry, density
        self.obstacles, self._parameters, self._hertz = ObstacleSet(obstacles), parameters, hertz
        self._impact_spheres = ImpactSpheres(hertz, contact_time)
        self.impact_detector = ImpactDetector(
            parameters.time_step, parameters.impact_threshold, self._impact_spheres.duration,
            self._impact_spheres.radius_cubed_per_force,
        )  # fmt: skip
        self.phases, self.initial_overlaps = PhaseTimes(), InitialOverlaps.empty()
        self._engine: Engine | None = None
        # state before a step that was abandoned
        self._abandoned: _StepSnapshot | None = None
        # instances that broke in this step
        self._broken_instances: set[int] = set()
        self.update_shapes()

    def update_shapes(self) -> None:
        """Compute the shapes of the fragments after instances changed."""
        damage = {number: body.input_damage() for number, body in self.instances.damaged.items()}
        points = {number: shape.points for number, shape in self.instances.dented_shapes.items()}
        self.shapes, self._engine = self._geometry.update_shapes(damage, points), None
        volume = self.shapes.moments.volume
        mass = np.concatenate([self._density * volume, self.obstacles.masses])
        # half the side of a cube of equal volume
        half_size = np.concatenate([np.cbrt(volume) / 2, self.obstacles.half_sizes])
        self._impact_spheres.set_bodies(mass, half_size, self.fragment_count)

    def start(self) -> RigidState:
        """Return the state at t = 0: the bodies at their place, without motion."""
        fragments = Bodies.at_rest(np.full(self.fragment_count, self._density), self.shapes.moments)
        return RigidState(0.0, 0, fragments.concatenate(self.obstacles.free_bodies()))

    @property
    def fragment_count(self) -> int:
        """Number of fragments."""
        return len(self.shapes.names)

    @property
    def body_names(self) -> Ints:
        """Names (n,) of all bodies: lowest nodes of fragments, larger numbers for free obstacles."""
        free = len(self.shapes.node_fragment) + np.arange(len(self.obstacles.free_numbers))
        return np.concatenate([self.shapes.names, free])

    # --- checkpoints ---

    def to_checkpoint(self, state: RigidState) -> Arrays:
        """Return the arrays that a checkpoint stores; of the time before the step if the step was abandoned."""
        snapshot = self._abandoned or self._snapshot()
        overlaps = {f"overlap.{name}": values for name, values in vars(snapshot.overlaps).items()}
        instances = self.instances.to_checkpoint(snapshot.instances)
        return {**state.bodies.to_checkpoint(), **overlaps, **instances, **snapshot.detector}

    def _snapshot(self) -> _StepSnapshot:
        arrays = {name: values.copy() for name, values in self.impact_detector.to_checkpoint().items()}
        return _StepSnapshot(self.initial_overlaps, arrays)

    def from_checkpoint(self, arrays: Arrays, t: float, step: int, work: float) -> RigidState:
        """Return the state that `to_checkpoint` stored, and restore the damage of the mesh."""
        self.instances.from_checkpoint(arrays)
        self.analyses.reset_workers()
        self.update_shapes()
        names = vars(self.initial_overlaps)
        self.initial_overlaps = InitialOverlaps(**{name: arrays[f"overlap.{name}"] for name in names})
        self.impact_detector.from_checkpoint(arrays)
        return RigidState(t, step, Bodies.from_checkpoint(arrays), work)

    # --- steps ---

    def advance(self, state: RigidState) -> tuple[RigidState, RigidReport]:
        """Return the state one step later, and the figures of the step.

        Raises:
            NotConverged: an analysis failed, or the motion is not finite.
            StepAborted: the run is to stop; `to_checkpoint` returns the state before the step.
        """
        snapshot, self._abandoned = self._snapshot(), None
        try:
            return self._advance(state, snapshot)
        except StepAborted:
            self._abandoned = snapshot
            raise

    def _advance(self, state: RigidState, snapshot: _StepSnapshot) -> tuple[RigidState, RigidReport]:
        """Take a step; `snapshot` receives the instances that are analysed, as they were."""
        began = clock = time.perf_counter()
        iterations, bodies = self.instances.cg_iterations, state.bodies
        shapes_before = self.instances.dented_shapes.copy()
        _check_finite(bodies, state.t)
        self._broken_instances.clear()
        moved, impulses = self._move(state, bodies)
        result = self.impact_detector.find_loads(impulses, bodies, self.body_names)
        clock = self.phases.add("motion", clock)
        if loads := self._select_loads(result, impulses):
            snapshot.instances = self.instances.snapshot(load.body_name for load in loads)
        broken_by_name = self.analyses(loads)
        clock = self.phases.add("analysis", clock)
        broken = sum(broken_by_name.values())
        if broken:
            # the step is repeated with the fragments, which take no more of a blow than they can
            bodies = self._replace_by_fragments(bodies, {name for name, count in broken_by_name.items() if count})
            clock = self.phases.add("pieces", clock)
            moved, impulses = self._move(state, bodies)
            self.phases.add("motion", clock)
        contact_error = self._engine.contact_error if self._engine else 0.0
        self.impact_detector.record_step(impulses, bodies, self.body_names)
        shapes = self.instances.dented_shapes
        if dented := [number for number, shape in shapes.items() if shape is not shapes_before.get(number)]:
            moved = self._apply_dented_shapes(moved, dented)
        _check_finite(moved, state.t + self._parameters.time_step)
        forces, obstacle_work = self.obstacles.forces_and_work(
            impulses, self.fragment_count, state.t, self._parameters.time_step
        )
        gravity_work = moved.mass * ((moved.position - bodies.position) @ self._parameters.gravity)
        work = state.work + float(gravity_work.sum()) + float(obstacle_work.sum())
        lost = gravity_work + bodies.kinetic_energies - moved.kinetic_energies
        # the work of a free obstacle is the energy that it lost
        obstacle_work[self.obstacles.free_numbers] = lost[self.fragment_count :]
        after = RigidState(state.t + self._parameters.time_step, state.step + 1, moved, work)
        blows = sum(load.speed > 0 for load in result)
        cg_iterations, seconds = self.instances.cg_iterations - iterations, time.perf_counter() - began
        return after, RigidReport(
            broken, blows, len(result) - blows, moved.kinetic_energy, forces, obstacle_work, cg_iterations, seconds,
            contact_error,
        )  # fmt: skip

    def _move(self, state: RigidState, bodies: Bodies) -> tuple[Bodies, ContactImpulses]:
        """Return the bodies of a state, or their present fragments, one step later, and the contact impulses."""
        engine, end = self._engine or self._make_engine(state.t, bodies), state.t + self._parameters.time_step
        moved, impulses = engine.advance(bodies, self.obstacles.reference_points(end), self._families)
        self.initial_overlaps = engine.initial_overlaps
        return moved, impulses

    def _families(self, bodies: Ints) -> Ints:
        """Return the families (m,) of bodies (m,), see impact_sequence.

        The family is the instance c of a body that may break or broke in this step, -2 - c of another fragment, and
        -1 of an obstacle.
        """
        result, is_fragment = np.full(len(bodies), -1), bodies < self.fragment_count
        names = self.shapes.names[bodies[is_fragment]]
        instances, row = np.unique(names // self.instances.node_count, return_inverse=True)
        may_break = [
            number in self._broken_instances or self.instances.can_break(number) for number in map(int, instances)
        ]
        result[is_fragment] = np.where(may_break, instances, -2 - instances)[row]
        return result

    def _make_engine(self, t: float, bodies: Bodies) -> Engine:
        """Make the engine for the present bodies; `t`: s, of the obstacles."""
        shapes, obstacles = self.shapes, self.obstacles
        parts: list[Sequence[Part]] = [*shapes.convex_parts, *obstacles.convex_parts]
        hull_points, rotation = [*shapes.hull_points, *obstacles.hull_points], shapes.rotation
        if obstacles.free_numbers:
            rotation = np.concatenate([rotation, np.tile(np.eye(3), (len(obstacles.free_numbers), 1, 1))])
        self._engine = Engine(
            bodies, parts, obstacles.prescribed_obstacles(t), self._parameters, self.initial_overlaps,
            self.body_names, hull_points, rotation, shapes.core_contact, shapes.shells,
        )  # fmt: skip
        return self._engine

    def find_penetrations(self, state: RigidState) -> list[tuple[int, int, float]]:
        """Return (body, body, depth in m) of all pairs that overlap by more than is admitted between fragments."""
        return (self._engine or self._make_engine(state.t, state.bodies)).find_penetrations(state.bodies)

    # --- analyses and fracture ---

    def _select_loads(self, loads: list[BodyLoad], impulses: ContactImpulses) -> list[ImpactLoads]:
        """Return the loads that could break a fragment or make it yield."""
        loads = [load for load in loads if load.body_number < self.fragment_count]
        if not loads:
            return []
        energies = impulses.impact_energies(self.fragment_count, self._parameters.restitution)
        result = []
        for load in loads:
            name = int(self.shapes.names[load.body_number])
            total_force = float(np.linalg.norm(load.force, axis=1).sum())
            if self.instances.may_break(name, total_force):
                energy = load.available_energy(float(energies[load.body_number]))
                result.append(ImpactLoads(name, load.points, load.force, load.circle_radii, energy=energy))
        return result

    def _replace_by_fragments(self, bodies: Bodies, names: set[int]) -> Bodies:
        """Return the bodies with those of the names replaced by their fragments."""
        before = self.shapes
        free, bodies = bodies.select(slice(self.fragment_count, None)), bodies.select(slice(self.fragment_count))
        self.update_shapes()
        after = self.shapes
        parent = np.searchsorted(before.names, before.names[before.node_fragment[after.names]])
        broken = np.isin(before.names[parent], list(names)) | (np.bincount(parent)[parent] > 1)
        # Fragments that share cells with these have other shapes too, as the cells were cut anew.
        shapes = zip(vars(after.moments).values(), vars(before.moments).values(), strict=True)
        equal = [(new == old[parent]).reshape(len(parent), -1).all(axis=1) for new, old in shapes]
        changed = broken | ~np.logical_and.reduce(equal)
        values = {name: np.array(array[parent]) for name, array in vars(bodies).items()}
        for number in np.unique(after.names[broken] // self.instances.node_count):
            rows = np.flatnonzero(changed & (after.names // self.instances.node_count == number))
            moments = PolyhedronMoments(*(array[rows] for array in vars(after.moments).values()))
            fragments = bodies.at_new_shapes(self._density, moments, parent[rows])
            fragments = fragments.with_momenta_of(bodies.select(np.unique(parent[rows])), broken[rows])
            for name, array in vars(fragments).items():
                values[name][rows] = array
        self.impact_detector.forget_bodies(np.array([*names], np.int64))
        self._broken_instances = {name // self.instances.node_count for name in names}
        self.initial_overlaps = self.initial_overlaps.after_fracture(after.names, before.names[parent])
        return Bodies(**values).concatenate(free)

    def _apply_dented_shapes(self, bodies: Bodies, instances: list[int]) -> Bodies:
        """Return the bodies with the shapes of instances that have been dented; the step is not repeated."""
        self.update_shapes()
        changed = np.isin(self.shapes.names // self.instances.node_count, instances)
        return bodies.with_shapes(self.shapes.moments, np.flatnonzero(changed))


def _check_finite(bodies: Bodies, t: float) -> None:
    """Raise NotConverged if positions or velocities at time t, s, are not finite."""
    if not bodies.is_finite:
        raise NotConverged(f"the motion of the bodies is not finite at t = {t:g} s; look at velocities and time.step")
