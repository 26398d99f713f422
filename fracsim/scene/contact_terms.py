"""Contact terms of a study: obstacles and self-contact. The module is imported only if there are any."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI

from ..contact.laws import Barrier, ObstacleLaw
from ..contact.obstacle import RigidObstacle
from ..contact.obstacle_term import ObstacleTerm
from ..contact.rigid_obstacles import RigidObstacles
from ..contact.shapes import Shape
from ..contact.supporting_obstacles import build_inactive_at_rest
from ..errors import InputError
from ..forms.schemes import Scheme
from ..mechanics.material_fields import MaterialFields
from ..mechanics.stress import Stress
from ..mechanics.term import Term
from ..mesh.domain import Domain
from ..mesh.parallel import from_root
from ..study import ContactSettings, Study
from ..study.conditions import FreeObstacleMotion, ObstaclePlacement, obstacle_placements
from ..study.mesh_source import read_obstacle_surface
from ..study.overlap_checks import build_shape

if TYPE_CHECKING:
    from ..contact.laws import Penalty
    from ..contact.mesh_obstacle_term import MeshPair
    from ..contact.shape_kernels import CompiledShapeKernels

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class ContactDefaults:
    """Values of [contact] that a study does not give.

    Attributes:
        distance: gap at which contact begins, in mean edges. A pressure of a hundredth of Young's modulus holds at a
            hundredth of it.
        stiffness: Young's moduli; factor of barrier and penalty.
        self_distance: like distance, for self-contact, whose barrier is 3.6 times as stiff.
        self_stiffness: Young's moduli, for self-contact. With 0.03 single-node fragments between others are pressed to
            a thousandth of the distance, and Newton's method takes 20 iterations in place of 6.
        added_frequency: what the penalty of explicit steps may add to the square of the highest frequency of the body,
            relative to it. Steps are at least 0.82 of those without contact.
        creep: sizes of the body per second, or in the whole run if that takes longer: a slow test has the friction of a
            fast one. Speed below which friction sticks.
        creep_ratio: likewise, in the speed of the nodes relative to their mean or an obstacle from a file, and in the
            largest slip velocity at the start of a step for others. Fragments at metres a second that change from
            sticking to slipping within micrometres a second take forty Newton iterations in place of fourteen, a
            rolling ball eight instead of six.
    """

    distance: float = 0.05
    stiffness: float = 0.1
    self_distance: float = 0.03
    self_stiffness: float = 0.3
    added_frequency: float = 0.5
    creep: float = 1e-3
    creep_ratio: float = 0.05


DEFAULTS = ContactDefaults()


# --- obstacles ---


def build_obstacle_terms(
    study: Study, domain: Domain, u: fem.Function, stress: Stress, mass: Values, scheme: Scheme
) -> list[Term]:
    """Return terms of contact with all obstacles, and that of their motion (collective).

    `mass`: (owned dofs,) lumped, kg. Raises InputError if an obstacle overlaps the body, or a free one another.
    """
    from ..contact.shape_kernels import compile_shape_kernels

    placements, contact = obstacle_placements(study, domain.dim), _contact(study)
    kernels = None if stress.kernels.plain else compile_shape_kernels(domain.comm)
    obstacles = [
        _read_obstacle(domain.comm, entry, number) if entry.shape == "mesh" else _build_obstacle(entry, number, kernels)
        for number, entry in enumerate(placements)
    ]
    meshes = [number for number, entry in enumerate(placements) if entry.shape == "mesh"]
    analytic = [number for number in range(len(obstacles)) if number not in meshes]
    barrier: type[Barrier | Penalty] = Barrier
    make_term: Callable[..., ObstacleTerm] = ObstacleTerm
    if not scheme.implicit:
        from ..contact.laws import Penalty
        from ..contact.penalty_obstacles import PenaltyObstacleTerm

        limit = _max_added_frequency(contact, domain, stress)
        barrier, make_term = Penalty, partial(PenaltyObstacleTerm, mass=mass, max_added=limit)
    else:
        limit = np.inf
    law = _obstacle_law(study, domain, stress.material, barrier)
    mesh_stiffness = contact.stiffness or DEFAULTS.self_stiffness * _max_young(domain, stress.material)

    def make(moved: Sequence[RigidObstacle], law: ObstacleLaw) -> ObstacleTerm:
        placed = list(obstacles)
        for number, obstacle in zip(analytic, moved, strict=True):
            placed[number] = obstacle
        return make_term(domain, u, _build_motion(domain, placed, scheme, law, mesh_stiffness, limit), analytic, law)

    terms: list[Any] = []
    if analytic:
        shapes = [obstacles[number] for number in analytic]
        mutual = any(obstacle.free for obstacle in shapes)
        terms = [build_inactive_at_rest(domain, shapes, law, make, mutual=mutual)]
    motion = terms[0].group.bodies if terms else _build_motion(domain, obstacles, scheme, law, mesh_stiffness, limit)
    if meshes:
        terms.append(_build_mesh_obstacle_term(study, domain, u, motion, meshes, law, stress, mass, scheme))
    for term in terms:
        motion.contacts.append(term.pose_contact)
    return [*terms, motion]


def _build_motion(
    domain: Domain,
    obstacles: Sequence[RigidObstacle],
    scheme: Scheme,
    law: ObstacleLaw,
    mesh_stiffness: float,
    max_added: float,
) -> RigidObstacles:
    """Return the motion of obstacles. Raises InputError if a free one overlaps another at the start.

    `mesh_stiffness`: of the barrier between triangle meshes, Pa; `max_added`: what a penalty may add to the square of
    the highest frequency, 1/s^2.
    """
    if not any(obstacle.free for obstacle in obstacles):
        return RigidObstacles(domain, obstacles)
    from ..contact.obstacle import OVERLAP, check_free_obstacles, free_pairs
    from ..contact.obstacle_pairs import BarrierPair, ObstaclePairs
    from ..contact.rigid_pose import FreeRigidObstacles
    from ..contact.supporting_obstacles import pair_obstacles
    from ..contact.triangle_mesh_shape import TriangleMeshShape

    numbered = list(enumerate(obstacles))
    is_mesh = [isinstance(obstacle.shape, TriangleMeshShape) for obstacle in obstacles]
    placed = {n: (obstacle.name, obstacle.free, obstacle.posed_at(0.0)) for n, obstacle in numbered if not is_mesh[n]}
    check_free_obstacles(placed, -OVERLAP.min_overlap)
    in_pairs = pair_obstacles(obstacles, law.barrier.width, domain.mean_edge_length)
    if not scheme.implicit:
        from ..contact.penalty_obstacle_pairs import VerletRigidObstacles, penalty_pairs_of

        penalty = cast("Penalty", law.barrier)
        return VerletRigidObstacles(domain, obstacles, penalty_pairs_of(in_pairs, penalty, max_added))
    pairs: list[BarrierPair | MeshPair] = []
    for numbers in free_pairs([obstacle.free for obstacle in obstacles]):
        if all(is_mesh[number] for number in numbers):
            from ..contact.mesh_obstacle_term import MeshPair  # with ipctk

            pairs.append(MeshPair(numbers, in_pairs, law, mesh_stiffness))
        else:
            pairs.append(BarrierPair(numbers, in_pairs, law))
    free = [number for number, obstacle in numbered if obstacle.free]
    return FreeRigidObstacles(domain, obstacles, scheme, ObstaclePairs(pairs, free))


def _max_added_frequency(contact: ContactSettings, domain: Domain, stress: Stress) -> float:
    """Return what a penalty may add to the square of the highest frequency, 1/s^2 (collective)."""
    from ..timestepping.stable_time_step import cell_frequencies

    if contact.stiffness is not None:
        return float("inf")
    highest = float(np.max(cell_frequencies(stress), initial=0.0))
    return float(DEFAULTS.added_frequency * domain.comm.allreduce(highest, op=MPI.MAX))


def build_rigid_obstacles(study: Study) -> list[RigidObstacle]:
    """Return all obstacles of a study of rigid bodies in their order, those from files too (one rank)."""
    return [
        _read_obstacle(MPI.COMM_SELF, entry, number) if entry.shape == "mesh" else _build_obstacle(entry, number)
        for number, entry in enumerate(obstacle_placements(study, 3))
    ]


def _build_obstacle(
    entry: ObstaclePlacement, number: int, kernels: CompiledShapeKernels | None = None
) -> RigidObstacle:
    """Return the obstacle of an entry of [[obstacle]]; `number`: of the entry, for messages."""
    shape = build_shape(entry, number)
    if kernels is not None:
        shape = kernels.used_for(shape)
    if entry.free_motion is not None:
        return _build_free_obstacle(entry, entry.free_motion, shape)
    return RigidObstacle(entry.name, shape, entry.reference_point, entry.displacement, entry.friction)


def _build_free_obstacle(
    entry: ObstaclePlacement, motion: FreeObstacleMotion, shape: Shape, centre: Values | None = None
) -> RigidObstacle:
    """Return an obstacle with a mass; its reference point is its centre of mass, or its hinge.

    `centre`: (d,) centre of mass of the shape, m, away from its reference point; None: they are the same.
    """
    from ..contact.obstacle import FreeObstacle
    from ..contact.shapes import TranslatedShape
    from ..contact.triangle_mesh_shape import TriangleMeshShape

    mass_centre = entry.reference_point if centre is None else entry.reference_point + centre
    point = mass_centre if motion.hinge is None else motion.hinge
    density = motion.density or (motion.mass or 0.0) / shape.volume
    if (offset := entry.reference_point - point).any():
        moved = shape.translated(offset) if isinstance(shape, TriangleMeshShape) else TranslatedShape(shape, offset)
        shape = cast("Shape", moved)
    return FreeObstacle(
        entry.name, shape, point, friction=entry.friction, mass=density * shape.volume, inertia=shape.inertia(density),
        motion_basis=motion.pose_basis, mass_centre=mass_centre - point, gravity=motion.gravity,
        start_rate=motion.initial_rate,
    )  # fmt: skip


# --- obstacles from files ---


def _build_mesh_obstacle_term(
    study: Study,
    domain: Domain,
    u: fem.Function,
    motion: RigidObstacles,
    numbers: list[int],
    obstacle_law: ObstacleLaw,
    stress: Stress,
    mass: Values,
    scheme: Scheme,
) -> Term:
    """Return the term of contact with obstacles from files (collective).

    Raises InputError if one overlaps the body at the start, or without ipctk.
    """
    try:
        from ..contact import retractable_surface
        from ..contact.mesh_obstacle_term import MeshObstacleTerm
    except ImportError:
        raise InputError(
            'an obstacle of shape = "mesh" needs ipctk, which this environment lacks: pip install fracsim[contact]'
        ) from None
    contact, material = _contact(study), stress.material
    stiffness = contact.stiffness or DEFAULTS.self_stiffness * _max_young(domain, material)
    law = retractable_surface.SelfContactLaw(
        _obstacle_law(study, domain, material).barrier.width, stiffness, 0.0, obstacle_law.sticking_speed,
        obstacle_law.sticking_ratio, corners_only=_uses_corners_only(study),
    )  # fmt: skip
    make: Callable[..., Any] = partial(MeshObstacleTerm, domain, u, motion, numbers)
    if not scheme.implicit:
        from ..contact.penalty_contact import PenaltyMeshContact

        limit = _max_added_frequency(contact, domain, stress)
        make = partial(PenaltyMeshContact, domain, u, motion, numbers, mass=mass, max_added=limit)
    return _fit_distance(make, law, contact, "an obstacle from a file and the body")


def _read_obstacle(comm: MPI.Intracomm, entry: ObstaclePlacement, number: int) -> RigidObstacle:
    """Return an obstacle from a file, which rank 0 reads (collective)."""
    from ..contact.triangle_mesh_shape import TriangleMeshShape

    file, scale = entry.geometry["file"], entry.geometry.get("scale", 1.0)
    surface = from_root(comm, lambda: read_obstacle_surface(file, scale, f"obstacle.{number}"))
    shape = TriangleMeshShape(surface.points, surface.triangles)
    if entry.free_motion is not None:
        return _build_free_obstacle(entry, entry.free_motion, shape, shape.centre)
    return RigidObstacle(entry.name, shape, entry.reference_point, entry.displacement, entry.friction, entry.spin)


# --- self-contact ---


def build_self_contact_term(study: Study, domain: Domain, u: fem.Function, material: MaterialFields) -> Term:
    """Return the term of self-contact (collective). Raises InputError without ipctk."""
    module = _import_with_ipctk("self_contact")
    make = partial(module.SelfContact, domain, u)
    return _build_self_contact(study, domain, material, DEFAULTS.self_distance, make)


def build_explicit_self_contact_term(
    study: Study, domain: Domain, u: fem.Function, stress: Stress, mass: Values
) -> Term:
    """Return the term of self-contact for explicit steps (collective); `mass`: (owned dofs,) lumped, kg."""
    limit = _max_added_frequency(_contact(study), domain, stress)
    module = _import_with_ipctk("penalty_contact")
    make = partial(module.PenaltyContact, domain, u, mass=mass, max_added=limit)
    return _build_self_contact(study, domain, stress.material, DEFAULTS.distance, make)


def _import_with_ipctk(name: str) -> Any:
    """Return a module of contact that imports ipctk."""
    try:
        return import_module(f"..contact.{name}", __package__)
    except ImportError:
        raise InputError(
            "[contact] needs ipctk, which this environment lacks: pip install fracsim[contact], or itself = false"
        ) from None


def _build_self_contact(
    study: Study, domain: Domain, material: MaterialFields, distance_ratio: float, make: Callable[[Any], Any]
) -> Term:
    """Return the term that `make` returns for a law; `distance_ratio`: default of the distance, in mean edges."""
    from ..contact import retractable_surface

    contact = _contact(study)
    law = retractable_surface.SelfContactLaw(
        contact.distance or distance_ratio * domain.mean_edge_length,
        contact.stiffness or DEFAULTS.self_stiffness * _max_young(domain, material),
        contact.friction,
        contact.creep or _default_creep(study, domain),
        0.0 if contact.creep else DEFAULTS.creep_ratio,
        contact.itself == "pieces",
        _uses_corners_only(study),
    )
    return _fit_distance(make, law, contact, "parts of the body")


def _fit_distance(make: Callable[[Any], Any], law: Any, contact: ContactSettings, between: str) -> Any:
    """Return the term that `make` returns for a law, with a distance of at most half the least gap (collective).

    With a larger distance surfaces would repel each other at the start. Raises InputError if the study gives one.
    `between`: what the gap is between, for the message.
    """
    term = make(law)
    if (gap := term.min_gap()) >= (1 - 1e-6) * law.distance:
        return term
    term.destroy()
    if contact.distance:
        raise InputError(
            f"contact.distance = {contact.distance:g} m is more than what lies between {between} at rest, {gap:.3g} m; "
            f"give at most {0.5 * gap:.2g}, or leave it out"
        )
    return make(replace(law, distance=0.5 * gap))


# --- settings ---


def _contact(study: Study) -> ContactSettings:
    return study.contact or ContactSettings()


def _uses_corners_only(study: Study) -> bool:
    """Return whether surfaces follow the corners of quadratic cells: crack faces may touch."""
    return study.mesh.order == 2 and study.fracture is not None


def _obstacle_law(
    study: Study, domain: Domain, material: MaterialFields, barrier: type[Barrier | Penalty] = Barrier
) -> ObstacleLaw:
    """Return the law of obstacles with a barrier or a penalty (collective)."""
    contact = _contact(study)
    distance = contact.distance or DEFAULTS.distance * domain.mean_edge_length
    stiffness = contact.stiffness or DEFAULTS.stiffness * _max_young(domain, material)
    creep = contact.creep or _default_creep(study, domain)
    return ObstacleLaw(barrier(stiffness, distance), creep, 0.0 if contact.creep else DEFAULTS.creep_ratio)


def _default_creep(study: Study, domain: Domain) -> float:
    """Return the sliding speed below which friction sticks if the study gives none, m/s."""
    return DEFAULTS.creep * domain.bounds.diagonal / max(1.0, study.time.end)


def _max_young(domain: Domain, material: MaterialFields) -> float:
    """Return the largest Young's modulus, Pa (collective)."""
    return float(domain.comm.allreduce(float(np.max(material.young, initial=0.0)), op=MPI.MAX))
