"""How bodies move: they fly and turn where nothing acts, and are driven on by what they are given.

v' = v + dt (g + F / m),   l' = l + dt M,   x' = x + t v',   turns: rigid.bodies
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from .bodies import Bodies, driven, rotated, tumbled
from .mujoco_model import Model

Values = npt.NDArray[np.float64]

TURN = 1.0  # rad a step that contacts set a body spinning by, at most: they are of one place, and a crumb would whirl


def flown(model: Model, bodies: Bodies, time: Values) -> Bodies:
    """The bodies after times (n,) in which nothing acts, s."""
    momentum = rotated(bodies.turn, model.inertia, bodies.spin)
    turn = tumbled(bodies.turn, model.inverse, momentum, time)
    place = bodies.place + time[:, None] * bodies.velocity
    return replace(bodies, place=place, turn=turn, spin=rotated(turn, model.inverse, momentum))


def driven_on(model: Model, bodies: Bodies, force: Values, gravity: Values, dt: float) -> Bodies:
    """The bodies where they are, with the motion that forces and moments (n, 6), these in their own axes, and `gravity`
    (3,) give them in dt."""
    motion = bodies.velocity, bodies.spin
    velocity, spin = driven(
        bodies.turn, model.inertia, model.inverse, model.mass, motion, force, gravity, dt, TURN / dt
    )
    return replace(bodies, velocity=velocity, spin=spin)


def forces(model: Model, bodies: Bodies, gained: Values, dt: float) -> Values:
    """Forces and moments (n, 6), these in the axes of the bodies, that give them velocities and spins (n, 6) in dt, m/s
    and rad/s."""
    turning = np.einsum("nji,nj->ni", bodies.turn, gained[:, 3:])
    moment = np.einsum("nij,nj->ni", model.inertia, turning)
    return np.concatenate([model.mass[:, None] * gained[:, :3], moment], axis=1) / dt


def of_things(bodies: Bodies, rates: Values) -> tuple[Values, Values]:
    """(things, 3) velocities and (things, 3) spins, of what stands `rates` (stands, 3), m/s."""
    return np.concatenate([bodies.velocity, rates]), np.concatenate([bodies.spin, 0 * rates])
