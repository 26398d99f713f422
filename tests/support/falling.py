"""Rigid bodies for the tests of the engine: cubes, balls and a floor, and meshes that break."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from fracsim.contact.obstacle import RigidObstacle
from fracsim.contact.shapes import HalfSpace
from fracsim.fracture.brittle.grains import SurfaceParameters
from fracsim.mechanics.time_functions import TimeFunction
from fracsim.meshes.data import MeshData
from fracsim.rigid.bodies import Bodies
from fracsim.rigid.fragment_geometry import FragmentGeometry
from fracsim.rigid.instances import Instances
from fracsim.rigid.mujoco_model import ContactParameters, PrescribedObstacle
from fracsim.rigid.obstacles import obstacle_primitive
from fracsim.rigid.rigid_stepper import RigidStepper
from fracsim.rigid.surface_loads import HertzContact
from support.rigid import DENSITY, breakable

Values = npt.NDArray[np.float64]

G = 9.81
DOWN = np.array([0.0, 0.0, -G])
MASS = 1000.0
CUBE = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])  # of 1 m


def cubes(places: list[list[float]], velocity: list[float] | None = None) -> Bodies:
    """Of 1 m and 1000 kg, all with one velocity."""
    n = len(places)
    speed = np.tile(np.zeros(3) if velocity is None else np.array(velocity, float), (n, 1))
    turn, inertia = np.tile(np.eye(3), (n, 1, 1)), np.tile(np.eye(3) * MASS / 6, (n, 1, 1))
    return Bodies(np.full(n, MASS), np.zeros((n, 3)), inertia, np.array(places, float), turn, speed, np.zeros((n, 3)))


def floor(friction: float = 0.5, normal: tuple[float, float, float] = (0.0, 0.0, 1.0)) -> PrescribedObstacle:
    """The plane z = 0."""
    return PrescribedObstacle(obstacle_primitive(HalfSpace(normal), "floor"), np.zeros(3), friction)


def stepper_of(
    mesh: MeshData,
    strength: float,
    step: float,
    *,
    surfaces: int = 6,
    gravity: Values = DOWN,
    obstacles: list[RigidObstacle] | None = None,
    restitution: float = 0.0,
    contact_time: float | None = None,
    moved: TimeFunction | None = None,
) -> RigidStepper:
    """Bodies of a mesh, by default over a floor at z = 0."""
    body = breakable(mesh, strength, SurfaceParameters(surfaces))
    stand = (
        [RigidObstacle("floor", HalfSpace((0.0, 0.0, 1.0)), np.zeros(3), moved, 0.5)]
        if obstacles is None
        else obstacles
    )
    rules = ContactParameters(step, gravity, 0.5, restitution)
    return RigidStepper(
        Instances.of_body(body), FragmentGeometry(mesh), DENSITY, stand, rules, HertzContact(1e9, 0.2), contact_time
    )
