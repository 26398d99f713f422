"""[[body]]: where rigid bodies are at the start; and what else a study with time.scheme = "rigid" may say."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

from annotated_types import Ge, Len
from pydantic import Field, Strict, model_validator

from .values import Finite, StudyTable

if TYPE_CHECKING:
    from .study import Study

InSpace = Annotated[list[Finite], Len(3, 3)]
Counts = Annotated[list[Annotated[int, Strict(), Ge(1)]], Len(3, 3)]
Gaps = Annotated[list[Annotated[Finite, Ge(0)]], Len(3, 3)]
MOST_TURN = 1e3  # rad a step, of a spin that is given
NOUGHT, ONCE = (0.0, 0.0, 0.0), (1, 1, 1)


class BodySettings(StudyTable):
    """[[body]]: the mesh once, or on a grid, at x = position + R X of its points X."""

    position: InSpace = Field(default_factory=lambda: [*NOUGHT])  # m
    rotation: InSpace = Field(default_factory=lambda: [*NOUGHT])  # rotation vector of R, rad
    velocity: InSpace = Field(default_factory=lambda: [*NOUGHT])  # m/s
    spin: InSpace = Field(default_factory=lambda: [*NOUGHT])  # rad/s, about the centre of the mesh
    copies: Counts = Field(default_factory=lambda: [*ONCE])  # along x, y, z
    spacing: Gaps | None = None  # m, between copies; of any size where there is one

    @model_validator(mode="after")
    def _copies_have_room(self) -> BodySettings:
        spacing = self.spacing or NOUGHT
        if any(count > 1 and not gap for count, gap in zip(self.copies, spacing, strict=True)):
            raise ValueError(f"copies = {self.copies} lie in one another: give spacing = [x, y, z] in m")
        return self


def with_rigid_defaults(data: dict[str, Any]) -> dict[str, Any]:
    """The tables of a study; where bodies are rigid and nobody says which energy, it is the one there is for them."""
    time, material = data.get("time"), data.get("material")
    if not (isinstance(time, dict) and time.get("scheme") == "rigid" and isinstance(material, dict)):
        return data
    return data | {"material": {"energy": "linear"} | material}


def check_rigid(study: Study) -> None:
    """ValueError where a rigid study asks for what there is none of, or another study for what only rigid ones have."""
    contact = study.contact
    if study.time.scheme != "rigid":
        own = ["[[body]]"] if study.body else []
        if contact is not None:
            own += [f"contact.{key}" for key in ("restitution", "contact_time") if getattr(contact, key) is not None]
        if study.mesh.shell is not None:
            own.append("mesh.shell")
        if own:
            raise ValueError(f'{own[0]} is for time.scheme = "rigid", not "{study.time.scheme}"; remove it')
        return
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
    if any(each.density is not None for each in study.material.regions.values()):
        raise ValueError('with time.scheme = "rigid" a body has one density: remove density from regions of [material]')
    if study.fracture is not None and study.brittle is None:
        raise ValueError('[fracture] with time.scheme = "rigid" needs [brittle]: stiff bodies break along surfaces')
    _check_denting(study)
    if study.load is not None and study.load.body_force is not None:
        raise ValueError('load.body_force is not for time.scheme = "rigid": give gravity')
    if contact is not None:
        if contact.itself is not True:
            raise ValueError('contact.itself: with time.scheme = "rigid" bodies always meet one another; remove it')
        soft = [key for key in ("distance", "stiffness", "creep") if getattr(contact, key) is not None]
        if soft:
            raise ValueError(f'contact.{soft[0]} is not for time.scheme = "rigid", whose contacts are hard; remove it')
    beyond = [key for key in study.solver if not key.startswith(("ksp_", "pc_", "mg_"))]
    if beyond:
        raise ValueError(
            f'solver.{beyond[0]} is not for time.scheme = "rigid": give options of ksp_, pc_ and mg_ alone'
        )
    for each in study.obstacle:
        held = [key for key in ("hinge", "guide") if getattr(each, key) is not None]
        if held:
            raise ValueError(
                f'obstacle {each.name} has a {held[0]}, which time.scheme = "rigid" does not have: let it move freely, '
                "or drive it"
            )
        if each.spin is not None and not each.is_free:
            raise ValueError(
                f'obstacle {each.name} is turned by spin, which time.scheme = "rigid" does not do: give it a mass, or '
                "drive it without"
            )


def _check_denting(study: Study) -> None:
    """ValueError where [plasticity] asks for what rigid bodies do not do."""
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
    plain = type(table)(yield_stress=table.yield_stress, hardening=table.hardening)
    beyond = [key for key in ("measure", "flow_rate", "update") if getattr(table, key) != getattr(plain, key)]
    if beyond:
        raise ValueError(f'plasticity.{beyond[0]} is not for time.scheme = "rigid": give yield_stress and hardening')
