"""Contact that a study asks for: its obstacles, and how they act. Imported where there are any."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from mpi4py import MPI

from ..contact.barrier import Barrier
from ..contact.laws import ObstacleLaw
from ..contact.obstacle import RigidObstacle
from ..contact.obstacle_term import ObstacleTerm
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
    from ..contact.penalty_law import Penalty
    from ..contact.penalty_obstacles import PenaltyObstacleTerm
    from ..contact.triangle_mesh_shape import TriangleMeshShape

Values = npt.NDArray[np.float64]

DISTANCE = 0.05  # of the mean edge: a hundredth of it is where a press of a hundredth of Young's modulus holds
STIFFNESS = 0.1  # of Young's modulus
DISTANCE_ITSELF = 0.03  # the same: ipctk's barrier presses 3.6 times as hard
# of Young's modulus: with 0.03 crumbs that are caught between pieces are pressed to a thousandth of the distance, and
# Newton's method takes 20 iterations and factors where this takes 6 and multigrid
STIFFNESS_ITSELF = 0.3
# of the square of the highest frequency of the body, that the penalty of explicit steps may add to it: steps are at
# least 0.82 of what they would be without, however light a node of the surface
ADDED = 0.5
CREEP = 1e-3  # of the body's size, a second
# of the speed of the body: crumbs at metres a second that change from sticking to sliding within micrometres a second
# take Newton's method forty iterations where this takes fourteen (a vase struck at 40 m/s)
OF_SPEED = 0.05


def obstacles_of(
    study: Study, domain: Domain, u: fem.Function, material: MaterialFields, scheme: Scheme
) -> ObstacleTerm:
    """The term of all obstacles of a study (collective). InputError where one overlaps the body at the start."""
    entries, law = obstacle_entries(study, domain.dim), _law(_contact(study), domain, material)
    if not any(each.free for each in entries):
        return build_inactive_at_rest(domain, entries, law, partial(ObstacleTerm, domain, u), mutual=False)
    from ..contact.rigid_obstacle_term import FreeObstacleTerm

    made = partial(FreeObstacleTerm, domain, u, scheme=scheme)
    return build_inactive_at_rest(domain, entries, law, made, mutual=True)


def explicit_obstacles_of(
    study: Study, domain: Domain, u: fem.Function, stress: Stress, mass: Values
) -> PenaltyObstacleTerm:
    """The same for explicit steps; `mass`: (owned dofs,) lumped, kg (collective)."""
    from ..contact.penalty_law import Penalty
    from ..contact.penalty_obstacles import PenaltyObstacleTerm

    entries = obstacle_entries(study, domain.dim)
    contact = _contact(study)
    law, most = _law(contact, domain, stress.material, Penalty), _most_added(contact, domain, stress)
    kind = PenaltyObstacleTerm
    if any(each.free for each in entries):
        from ..contact.penalty_rigid_obstacles import PenaltyFreeObstacleTerm

        kind = PenaltyFreeObstacleTerm
    return build_inactive_at_rest(domain, entries, law, partial(kind, domain, u, mass=mass, most=most), mutual=False)


def _most_added(contact: ContactSettings, domain: Domain, stress: Stress) -> float:
    """What a penalty may add to the square of the highest frequency, 1/s^2 (collective)."""
    from ..timestepping.stable_time_step import cell_frequencies

    if contact.stiffness is not None:
        return float("inf")
    return float(ADDED * domain.comm.allreduce(float(np.max(cell_frequencies(stress), initial=0.0)), op=MPI.MAX))


def solids_of(study: Study, domain: Domain, u: fem.Function, material: MaterialFields, scheme: Scheme) -> Term:
    """The term of the obstacles that are read from files (collective). InputError where one overlaps the body at the
    start, or without ipctk."""
    try:
        from ..contact import ipc_surface
        from ..contact.mesh_obstacle_term import MeshObstacleTerm
    except ImportError:
        raise InputError(
            'an obstacle of shape = "mesh" needs ipctk, which this environment lacks: pip install fracsim[contact]'
        ) from None
    every = enumerate(obstacle_placements(study, domain.dim))
    entries = {number: _solid(domain.comm, each, number) for number, each in every if each.shape == "mesh"}
    contact = _contact(study)
    law, stiffness = _law(contact, domain, material), contact.stiffness or STIFFNESS_ITSELF * _young(domain, material)
    of_speed = 0.0 if contact.creep else OF_SPEED
    how = ipc_surface.SelfContactLaw(
        law.barrier.width, stiffness, 0.0, law.sticking_speed, of_speed, corners_only=_straight(study)
    )
    if not any(each.free for each in entries.values()):
        return _with_room(
            partial(MeshObstacleTerm, domain, u, entries), how, contact, "an obstacle from a file and the body"
        )
    from ..contact.mesh_rigid_term import FreeMeshTerm
    from ..contact.supporting_obstacles import offset_from_meshes

    every = enumerate(obstacle_placements(study, domain.dim))
    rest = {number: each for number, each in every if each.shape != "mesh" and each.free_motion is None}
    free = [each for each in entries.values() if each.free]
    shapes = {number: _obstacle(each, number) for number, each in rest.items()}
    others = offset_from_meshes(shapes, free, law.barrier.width, domain.mean_edge_length)
    made = partial(
        FreeMeshTerm, domain, u, entries, scheme=scheme, others=others, barrier=cast("Barrier", law.barrier)
    )  # fmt: skip
    return _with_room(made, how, contact, "an obstacle from a file and the body")


def _solid(comm: MPI.Intracomm, entry: ObstaclePlacement, number: int) -> RigidObstacle:
    """Read on rank 0 (collective)."""
    from ..contact.triangle_mesh_shape import TriangleMeshShape

    given = entry.geometry
    surface = from_root(
        comm, lambda: read_obstacle_surface(given["file"], given.get("scale", 1.0), f"obstacle.{number}")
    )
    solid = TriangleMeshShape(surface.points, surface.triangles)
    if entry.free_motion is not None:
        return _free_solid(entry, entry.free_motion, solid)
    return RigidObstacle(entry.name, solid, entry.reference_point, entry.displacement, entry.friction, entry.spin)


def _free_solid(entry: ObstaclePlacement, loose: FreeObstacleMotion, solid: TriangleMeshShape) -> RigidObstacle:
    """One with a mass: it moves about its centre of mass, or turns about its hinge."""
    from ..contact.obstacle import FreeObstacle

    density, own = loose.density or (loose.mass or 0.0) / solid.volume, solid.centre
    at = entry.reference_point + own if loose.hinge is None else loose.hinge
    solid = solid.translated(entry.reference_point - at)
    return FreeObstacle(
        entry.name, solid, at, friction=entry.friction, mass=density * solid.volume, inertia=solid.inertia(density),
        motion_basis=loose.pose_basis, mass_centre=entry.reference_point + own - at,
        gravity=loose.gravity, start_rate=loose.initial_rate,
    )  # fmt: skip


def self_contact_of(study: Study, domain: Domain, u: fem.Function, material: MaterialFields) -> Term:
    """The term of a body that touches itself (collective). InputError without ipctk."""
    itself = _by_ipctk("self_contact")
    return _self_contact(study, domain, material, DISTANCE_ITSELF, partial(itself.SelfContact, domain, u))


def explicit_self_contact_of(study: Study, domain: Domain, u: fem.Function, stress: Stress, mass: Values) -> Term:
    """The same for explicit steps; `mass`: (owned dofs,) lumped, kg (collective)."""
    most, itself = _most_added(_contact(study), domain, stress), _by_ipctk("penalty_self_contact")
    made = partial(itself.PenaltySelfContact, domain, u, mass=mass, most=most)
    return _self_contact(study, domain, stress.material, DISTANCE, made)


def _by_ipctk(name: str) -> Any:
    """A module of contact that imports ipctk."""
    try:
        return import_module(f"..contact.{name}", __package__)
    except ImportError:
        raise InputError(
            "[contact] needs ipctk, which this environment lacks: pip install fracsim[contact], or itself = false"
        ) from None


def _self_contact(
    study: Study, domain: Domain, material: MaterialFields, share: float, made: Callable[[Any], Any]
) -> Term:
    """A term that begins at this `share` of an edge, `made` for a law."""
    from ..contact import ipc_surface

    contact = _contact(study)
    distance = contact.distance or share * domain.mean_edge_length
    stiffness = contact.stiffness or STIFFNESS_ITSELF * _young(domain, material)
    creep, of_speed = contact.creep or CREEP * domain.size, 0.0 if contact.creep else OF_SPEED
    pieces, straight = contact.itself == "pieces", _straight(study)
    law = ipc_surface.SelfContactLaw(distance, stiffness, contact.friction, creep, of_speed, pieces, straight)
    return _with_room(made, law, contact, "parts of the body")


def _with_room(made: Callable[[Any], Any], law: Any, contact: ContactSettings, what: str) -> Any:
    """The term that is `made` of a law whose barrier begins below half of the gap at rest between `what` (collective).

    InputError where the study gives a distance that is more than the gap.
    """
    term = made(law)
    if (gap := term.min_gap()) >= (1 - 1e-6) * law.distance:
        return term
    term.destroy()  # they would push each other apart from the start
    if contact.distance:
        raise InputError(
            f"contact.distance = {contact.distance:g} m is more than what lies between {what} at rest, {gap:.3g} m; "
            f"give at most {0.5 * gap:.2g}, or leave it out"
        )
    return made(replace(law, distance=0.5 * gap))


def obstacle_entries(study: Study, dim: int) -> list[RigidObstacle]:
    """Obstacles that are felt by their distance: all but those from files. InputError where one does not fit the
    dimension, or is no shape."""
    every = enumerate(obstacle_placements(study, dim))
    return [_obstacle(each, number) for number, each in every if each.shape != "mesh"]


def every_obstacle(study: Study) -> list[RigidObstacle]:
    """Of a body in space on one rank, in the order of the study, those from files too."""
    every = enumerate(obstacle_placements(study, 3))
    return [_solid(MPI.COMM_SELF, each, k) if each.shape == "mesh" else _obstacle(each, k) for k, each in every]


def _obstacle(entry: ObstaclePlacement, number: int) -> RigidObstacle:
    shape = build_shape(entry, number)
    if entry.free_motion is not None:
        return _free_obstacle(entry, entry.free_motion, shape)
    return RigidObstacle(entry.name, shape, entry.reference_point, entry.displacement, entry.friction)


def _free_obstacle(entry: ObstaclePlacement, loose: FreeObstacleMotion, shape: Shape) -> RigidObstacle:
    """One with a mass; on a hinge it is placed, and turns, about that."""
    from ..contact.obstacle import FreeObstacle
    from ..contact.offset_shape import TranslatedShape

    density = loose.density or (loose.mass or 0.0) / shape.volume
    at, centre = entry.reference_point, 0 * entry.reference_point
    if loose.hinge is not None:
        at, centre = loose.hinge, entry.reference_point - loose.hinge
        shape = TranslatedShape(shape, centre)
    return FreeObstacle(
        entry.name, shape, at, friction=entry.friction, mass=density * shape.volume, inertia=shape.inertia(density),
        motion_basis=loose.pose_basis, mass_centre=centre, gravity=loose.gravity, start_rate=loose.initial_rate,
    )  # fmt: skip


def _contact(study: Study) -> ContactSettings:
    return study.contact or ContactSettings()


def _straight(study: Study) -> bool:
    """Whether cells are quadratic and walls of cracks may touch, which follow corners."""
    return study.mesh.order == 2 and study.fracture is not None


def _law(
    contact: ContactSettings, domain: Domain, material: MaterialFields, barrier: type[Barrier | Penalty] = Barrier
) -> ObstacleLaw:
    distance = contact.distance or DISTANCE * domain.mean_edge_length
    return ObstacleLaw(
        barrier(contact.stiffness or STIFFNESS * _young(domain, material), distance),
        contact.creep or CREEP * domain.size,
    )


def _young(domain: Domain, material: MaterialFields) -> float:
    """The largest Young's modulus, Pa (collective)."""
    return float(domain.comm.allreduce(float(np.max(material.young, initial=0.0)), op=MPI.MAX))
