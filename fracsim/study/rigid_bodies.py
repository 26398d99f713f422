"""Schema of [[body]], and the limits of a study with `time.scheme = "rigid"`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

from annotated_types import Ge, Len
from pydantic import Strict, model_validator

from .values import Finite, StudyTable, key

if TYPE_CHECKING:
    from .study import Study

Vector3 = Annotated[list[Finite], Len(3, 3)]
Counts = Annotated[list[Annotated[int, Strict(), Ge(1)]], Len(3, 3)]
Distances = Annotated[list[Annotated[Finite, Ge(0)]], Len(3, 3)]


def _zeros() -> list[float]:
    return [0.0, 0.0, 0.0]


class BodySettings(StudyTable):
    """A rigid body, or copies of it on a grid: x = position + R X for a point X of the mesh.

    Only with `time.scheme = "rigid"`; without any [[body]] there is one body at the position of the mesh.
    """

    position: Vector3 = key("Displacement of the origin.", "m", factory=_zeros, example=[0.0, 0.0, 0.3])
    rotation: Vector3 = key("Rotation vector of R.", "rad", factory=_zeros, example=[0.0, 0.2, 0.0])
    velocity: Vector3 = key("Velocity at the start.", "m/s", factory=_zeros, example=[0.0, 0.0, -3.0])
    spin: Vector3 = key(
        "Angular velocity at the start, about the centre of the mesh.", "rad/s", factory=_zeros, example=[0.0, 0.0, 1.0]
    )
    copies: Counts = key("Number of copies along x, y and z.", factory=lambda: [1, 1, 1], example=[3, 3, 1])
    spacing: Distances | None = key(
        "Distance between copies along x, y and z; required with several copies.", "m", default=None,
        example=[0.5, 0.5, 1.0],
    )  # fmt: skip

    @model_validator(mode="after")
    def _copies_have_room(self) -> BodySettings:
        spacing = self.spacing or _zeros()
        if any(count > 1 and not gap for count, gap in zip(self.copies, spacing, strict=True)):
            raise ValueError(f"copies = {self.copies} lie in one another: give spacing = [x, y, z] in m")
        return self


def with_rigid_defaults(data: dict[str, Any]) -> dict[str, Any]:
    """Returns the tables of a study with the energy linear, if it is rigid and gives no energy."""
    time, material = data.get("time"), data.get("material")
    if not (isinstance(time, dict) and time.get("scheme") == "rigid" and isinstance(material, dict)):
        return data
    return data | {"material": {"energy": "linear"} | material}


def check_rigid(study: Study) -> None:
    """Check that a rigid study has no keys of deformable bodies, and another study none of rigid bodies.

    Raises:
        ValueError: with the first such key.
    """
    contact = study.contact
    if study.time.scheme != "rigid":
        rigid_keys = ["[[body]]"] if study.body else []
        if contact is not None:
            names = ("restitution", "contact_time")
            rigid_keys += [f"contact.{name}" for name in names if getattr(contact, name) is not None]
        if study.mesh.shell is not None:
            rigid_keys.append("mesh.shell")
        if rigid_keys:
            raise ValueError(f'{rigid_keys[0]} is for time.scheme = "rigid", not "{study.time.scheme}"; remove it')
        return
    # rigid bodies have no boundary, no deformation to damp or probe, and velocities of their own
    tables = {"damping": study.damping, "boundary": study.boundary, "probe": study.probe, "initial": study.initial,
              "crack": study.crack}  # fmt: skip
    hints = {"boundary": "hold or drive bodies by obstacles", "initial": "give velocity and spin in [[body]]"}
    for name, table in tables.items():
        if table:
            raise ValueError(f'[{name}] is not for time.scheme = "rigid": {hints.get(name, "remove it")}')
    if study.time.until is not None or study.time.breaking_step is not None:
        raise ValueError('time.until and time.breaking_step are not for time.scheme = "rigid": remove them')
    if study.material.energy != "linear":
        raise ValueError(f'time.scheme = "rigid" solves linear analyses: material.energy = "linear", not '
                         f'"{study.material.energy}"')  # fmt: skip
    # mass and inertia of a body are those of one density
    if any(region.density is not None for region in study.material.regions.values()):
        raise ValueError('with time.scheme = "rigid" a body has one density: remove density from regions of [material]')
    if study.fracture is not None and study.brittle is None:
        raise ValueError('[fracture] with time.scheme = "rigid" needs [brittle]: stiff bodies break along surfaces')
    _check_denting(study)
    if study.load is not None and study.load.body_force is not None:
        raise ValueError('load.body_force is not for time.scheme = "rigid": give gravity')
    if contact is not None:
        if contact.itself is not True:
            raise ValueError('contact.itself: with time.scheme = "rigid" bodies always meet one another; remove it')
        compliant = [name for name in ("distance", "stiffness", "creep") if getattr(contact, name) is not None]
        if compliant:
            raise ValueError(
                f'contact.{compliant[0]} is not for time.scheme = "rigid", whose contacts are hard; remove it'
            )
    # analyses are linear solves: there is no Newton iteration to control
    excess = [name for name in study.solver if not name.startswith(("ksp_", "pc_", "mg_"))]
    if excess:
        raise ValueError(
            f'solver.{excess[0]} is not for time.scheme = "rigid": give options of ksp_, pc_ and mg_ alone'
        )
    for obstacle in study.obstacle:
        if obstacle.hollow:
            # the words of rigid.obstacles
            raise ValueError(
                f'obstacle {obstacle.name} is hollow, which time.scheme = "rigid" does not have: build it of boxes or '
                "planes"
            )
        constraints = [name for name in ("hinge", "guide") if getattr(obstacle, name) is not None]
        if constraints:
            raise ValueError(
                f'obstacle {obstacle.name} has a {constraints[0]}, which time.scheme = "rigid" does not have: let it '
                "move freely, or drive it"
            )
        if obstacle.spin is not None and not obstacle.is_free:
            raise ValueError(
                f'obstacle {obstacle.name} is turned by spin, which time.scheme = "rigid" does not do: give it a '
                "mass, or drive it without"
            )


def _check_denting(study: Study) -> None:
    """Check that [plasticity] has the keys of dents of rigid bodies only.

    Raises:
        ValueError: with the first other key.
    """
    table = study.plasticity
    if table is None:
        return
    if study.brittle is not None:
        raise ValueError('[plasticity] with time.scheme = "rigid" is for bodies that do not break: remove [brittle]')
    if table.hardening <= 0:
        raise ValueError(
            f'plasticity.hardening = {table.hardening:g}: with time.scheme = "rigid" it must be greater than 0 Pa; a '
            "blow is a force, under which what does not harden flows without end"
        )
    # keys that differ from their defaults were given
    plain = type(table)(yield_stress=table.yield_stress, hardening=table.hardening)
    excess = [name for name in ("measure", "flow_rate", "update") if getattr(table, name) != getattr(plain, name)]
    if excess:
        raise ValueError(f'plasticity.{excess[0]} is not for time.scheme = "rigid": give yield_stress and hardening')
