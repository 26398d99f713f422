"""Rigid bodies: mass, inertia, position, rotation and velocity, and their motion between contacts.

Rotations follow the implicit midpoint rule, which conserves angular momentum l to round-off:

    R' = exp(dt w_m) R,   w_m = (R_m I R_m^T)^-1 l,   R_m = exp(dt w_m / 2) R

Equations: docs/theory.md#motion-and-contact-of-rigid-bodies.
"""

from __future__ import annotations

from ctypes import c_double, c_int64
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from ..errors import NotConverged
from ..mesh.c_library import load_library
from ..mesh.split_surface.polyhedron_moments import PolyhedronMoments

if TYPE_CHECKING:
    from .mujoco_model import MujocoModel

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
SOURCE = Path(__file__).with_name("rotation_integrator.c")


@dataclass(frozen=True)
class MotionLimits:
    """Accuracy of the rotation integrator, and bounds on motion.

    Attributes:
        midpoint_iterations: largest number of fixed-point iterations of the midpoint rule in a substep.
        rotation_tolerance: rad; the iteration ends when the rotation changes by less.
        substep_angle: rad; larger rotations are divided into equal substeps. With one radian a step the energy of a
            flat fragment oscillates by some per cent.
        step_angle: rad; a body that rotates by more in a step is an error of the input.
        contact_spin: rad; contacts make a body rotate by at most this much in a step, since they act at points and
            would spin a single-node fragment arbitrarily fast.
        magnitude: largest admitted number; the square of a larger one overflows.
    """

    midpoint_iterations: int = 30
    rotation_tolerance: float = 1e-14
    substep_angle: float = 0.2
    step_angle: float = 1e4
    contact_spin: float = 1.0
    magnitude: float = 1e150


LIMITS = MotionLimits()
# Names of the arrays in a checkpoint, where they differ from the attribute.
STORED_NAMES = {"position": "place", "rotation": "turn"}


@dataclass(frozen=True)
class Bodies:
    """State of n rigid bodies; a point X at rest is at x = position + rotation (X - centre).

    Attributes:
        mass: (n,) kg.
        centre: (n, 3) centres of mass at rest, m.
        inertia: (n, 3, 3) about the centre, in the axes at rest, kg m^2.
        position: (n, 3) current centres of mass, m.
        rotation: (n, 3, 3) rotation matrices from the axes at rest to the current ones.
        velocity: (n, 3) of the centres, m/s.
        spin: (n, 3) angular velocities in the axes of space, rad/s.
    """

    mass: Values
    centre: Values
    inertia: Values
    position: Values
    rotation: Values
    velocity: Values
    spin: Values

    @classmethod
    def at_rest(cls, density: Values, moments: PolyhedronMoments) -> Bodies:
        """Return bodies at their place in the mesh, without motion; `density`: (n,) kg/m^3."""
        n = len(moments.volume)
        zero, rotation = np.zeros((n, 3)), np.tile(np.eye(3), (n, 1, 1))
        inertia = density[:, None, None] * moments.inertia
        return cls(density * moments.volume, moments.centre, inertia, moments.centre, rotation, zero, zero)

    def __len__(self) -> int:
        return len(self.mass)

    # --- checkpoints ---

    def to_checkpoint(self) -> dict[str, Values]:
        """Return the arrays that a checkpoint stores, by their names there."""
        return {f"body.{STORED_NAMES.get(name, name)}": values for name, values in vars(self).items()}

    @classmethod
    def from_checkpoint(cls, arrays: dict[str, Values]) -> Bodies:
        """Return the bodies that `to_checkpoint` stored."""
        return cls(*(arrays[f"body.{STORED_NAMES.get(name, name)}"] for name in cls.__dataclass_fields__))

    # --- points of bodies ---

    def to_current(self, X: Values, body: Ints) -> Values:
        """Return the current positions (k, 3), m, of points X (k, 3) at rest on the bodies `body` (k,)."""
        return self.position[body] + np.einsum("kij,kj->ki", self.rotation[body], X - self.centre[body])

    def to_reference(self, x: Values, body: int) -> Values:
        """Return the positions at rest (k, 3), m, of current points x (k, 3) of one body."""
        return np.asarray((x - self.position[body]) @ self.rotation[body] + self.centre[body])

    def velocity_at(self, x: Values, body: Ints) -> Values:
        """Return the velocities (k, 3), m/s, of bodies (k,) at current points x (k, 3)."""
        return np.asarray(self.velocity[body] + np.cross(self.spin[body], x - self.position[body]))

    # --- other sets of bodies ---

    def at_new_shapes(self, density: float, moments: PolyhedronMoments, parent: Ints) -> Bodies:
        """Return fragments (m,) that move as their parent bodies (m,) did: v_i = v + w x r_i, w_i = w (B07, section 7).

        `density`: kg/m^3; masses and inertia are those of `moments`.
        """
        fragments = Bodies.at_rest(np.full(len(parent), density), moments)
        position, rotation = self.to_current(moments.centre, parent), self.rotation[parent]
        velocity, spin = self.velocity_at(position, parent), self.spin[parent]
        return replace(fragments, position=position, rotation=rotation, velocity=velocity, spin=spin)

    def with_momenta_of(self, before: Bodies, chosen: Flags) -> Bodies:
        """Return these bodies with momentum and angular momentum of those `before`.

        Bodies `chosen` (n,) take one common rigid motion in addition: dv + dw x r_i about their joint centre, and dw.
        """
        mass, position = self.mass[chosen], self.position[chosen]
        centre = mass @ position / mass.sum()
        arm = position - centre
        inertia = self.spatial_inertia[chosen].sum(axis=0)
        inertia += np.einsum("n,ni,ni->", mass, arm, arm) * np.eye(3) - np.einsum("n,ni,nj->ij", mass, arm, arm)
        lacking = before.angular_momentum_about(centre) - self.angular_momentum_about(centre)
        spin_change = np.linalg.solve(inertia, lacking)
        velocity, spin = self.velocity.copy(), self.spin.copy()
        velocity[chosen] += (before.momentum - self.momentum) / mass.sum() + np.cross(spin_change, arm)
        spin[chosen] += spin_change
        return replace(self, velocity=velocity, spin=spin)

    def with_shapes(self, moments: PolyhedronMoments, changed: Ints) -> Bodies:
        """Return the bodies after those `changed` (k,) were given the shapes of `moments`.

        Mass, position of the centre, momentum and angular momentum stay as they are.
        """
        centre, inertia, spin = (np.array(values) for values in (self.centre, self.inertia, self.spin))
        transposed = np.swapaxes(self.rotation[changed], 1, 2)
        momentum = inertia[changed] @ (transposed @ spin[changed, :, None])
        centre[changed] = moments.centre[changed]
        density = self.mass[changed] / moments.volume[changed]
        inertia[changed] = density[:, None, None] * moments.inertia[changed]
        spin[changed] = (self.rotation[changed] @ np.linalg.solve(inertia[changed], momentum))[:, :, 0]
        return replace(self, centre=centre, inertia=inertia, spin=spin)

    def select(self, chosen: slice | Ints) -> Bodies:
        """Return some of the bodies."""
        return Bodies(*(values[chosen] for values in vars(self).values()))

    def concatenate(self, following: Bodies) -> Bodies:
        """Return these bodies and the `following` ones after them."""
        if not len(following):
            return self
        pairs = zip(vars(self).values(), vars(following).values(), strict=True)
        return Bodies(*(np.concatenate(pair) for pair in pairs))

    @property
    def is_finite(self) -> bool:
        """True if all numbers are finite and so are their squares."""
        return all(float(np.max(np.abs(values), initial=0.0)) < LIMITS.magnitude for values in vars(self).values())

    # --- momenta and energy ---

    @property
    def spatial_inertia(self) -> Values:
        """Inertia in the axes of space, R I R^T (n, 3, 3), kg m^2."""
        return np.asarray(self.rotation @ self.inertia @ np.swapaxes(self.rotation, 1, 2))

    @property
    def momentum(self) -> Values:
        """Total momentum, sum m v (3,), N s."""
        return np.asarray(self.mass @ self.velocity)

    @property
    def angular_momentum(self) -> Values:
        """Total angular momentum about the origin, sum m x x v + I w (3,), N m s."""
        return self.angular_momentum_about(np.zeros(3))

    def angular_momentum_about(self, point: Values) -> Values:
        """Return the total angular momentum (3,), N m s, about a point (3,), m."""
        about_centres = np.einsum("nij,nj->i", self.spatial_inertia, self.spin)
        moments = self.mass[:, None] * np.cross(self.position - point, self.velocity)
        return np.asarray(moments.sum(axis=0) + about_centres)

    @property
    def kinetic_energies(self) -> Values:
        """Kinetic energy of every body (n,), J."""
        rotational = np.einsum("ni,nij,nj->n", self.spin, self.spatial_inertia, self.spin)
        return np.asarray(self.mass * np.einsum("ni,ni->n", self.velocity, self.velocity) + rotational) / 2

    @property
    def kinetic_energy(self) -> float:
        """Total kinetic energy, J."""
        rotational = np.einsum("ni,nij,nj->", self.spin, self.spatial_inertia, self.spin)
        return float(self.mass @ np.einsum("ni,ni->n", self.velocity, self.velocity) + rotational) / 2


# --- motion between contacts: v' = v + dt (g + F / m), l' = l + dt M, x' = x + t v' ---


def fly(model: MujocoModel, bodies: Bodies, time: Values) -> Bodies:
    """Return the bodies after times (n,), s, in which no force acts on them."""
    momentum = apply_tensor(bodies.rotation, model.inertia, bodies.spin)
    rotation = rotate_freely(bodies.rotation, model.inverse_inertia, momentum, time)
    position = bodies.position + time[:, None] * bodies.velocity
    spin = apply_tensor(rotation, model.inverse_inertia, momentum)
    return replace(bodies, position=position, rotation=rotation, spin=spin)


def apply_contact_forces(model: MujocoModel, bodies: Bodies, force: Values, gravity: Values, dt: float) -> Bodies:
    """Return the bodies with the velocities that contact forces and gravity (3,) give them in dt, s.

    `force`: (n, 6) forces in N and moments in N m, the moments in the axes of the bodies. Positions do not change.
    """
    motion = bodies.velocity, bodies.spin
    velocity, spin = accelerate(
        bodies.rotation, model.inertia, model.inverse_inertia, model.mass, motion, force, gravity, dt,
        LIMITS.contact_spin / dt,
    )  # fmt: skip
    return replace(bodies, velocity=velocity, spin=spin)


def forces_for_velocity_changes(model: MujocoModel, bodies: Bodies, change: Values, dt: float) -> Values:
    """Return forces and moments (n, 6), moments in the axes of the bodies, that change velocities and spins.

    `change`: (n, 6) m/s and rad/s, in the axes of space, within dt, s.
    """
    spin_change = np.einsum("nji,nj->ni", bodies.rotation, change[:, 3:])
    moment = np.einsum("nij,nj->ni", model.inertia, spin_change)
    return np.concatenate([model.mass[:, None] * change[:, :3], moment], axis=1) / dt


def velocities_of_all(bodies: Bodies, obstacle_velocity: Values) -> tuple[Values, Values]:
    """Return velocities and spins of the bodies and then of prescribed obstacles, (n + m, 3) each.

    `obstacle_velocity`: (m, 3) m/s; these obstacles do not rotate.
    """
    velocity = np.concatenate([bodies.velocity, obstacle_velocity])
    return velocity, np.concatenate([bodies.spin, 0 * obstacle_velocity])


# --- compiled kernels ---


def rotate_freely(rotation: Values, inverse_inertia: Values, momentum: Values, time: Values) -> Values:
    """Return rotations (n, 3, 3) after times (n,), s, from rotations before and angular momenta (n, 3), N m s.

    `inverse_inertia`: (n, 3, 3) in the axes of the bodies, 1 / (kg m^2). Raises NotConverged if a body rotates by more
    than `LIMITS.step_angle`.
    """
    arrays = [np.ascontiguousarray(values) for values in (rotation, inverse_inertia, momentum, time)]
    after: Values = np.empty(rotation.shape)
    accuracy = c_int64(LIMITS.midpoint_iterations), c_double(LIMITS.rotation_tolerance)
    angles = c_double(LIMITS.substep_angle), c_double(LIMITS.step_angle)
    if load_library(SOURCE).rotate_freely(c_int64(len(rotation)), *arrays, *accuracy, *angles, after):
        raise NotConverged(
            f"A body turns by more than {LIMITS.step_angle:g} rad in a step: speeds and spins are too high for "
            "time.step"
        )
    return after


def apply_tensor(rotation: Values, tensor: Values, vector: Values) -> Values:
    """Return R T R^T v (n, 3) of tensors T (n, 3, 3) in the axes of bodies and vectors v (n, 3) in those of space.

    T is the inertia and v a spin, or T is the inverse inertia and v an angular momentum.
    """
    arrays, result = [np.ascontiguousarray(values) for values in (rotation, tensor, vector)], np.empty(vector.shape)
    load_library(SOURCE).apply_tensor(c_int64(len(rotation)), *arrays, result)
    return result


def accelerate(
    rotation: Values, inertia: Values, inverse_inertia: Values, mass: Values, motion: tuple[Values, Values],
    force: Values, gravity: Values, dt: float, max_spin: float,
) -> tuple[Values, Values]:  # fmt: skip
    """Return velocities and spins (n, 3) after dt, s, at the present positions.

    Args:
        rotation: (n, 3, 3).
        inertia: (n, 3, 3) in the axes of the bodies, kg m^2.
        inverse_inertia: (n, 3, 3) likewise.
        mass: (n,) kg.
        motion: velocities and spins (n, 3) before.
        force: (n, 6) forces and moments, the moments in the axes of the bodies, N and N m.
        gravity: (3,) m/s^2.
        dt: s.
        max_spin: rad/s that moments may bring a body to.
    """
    values = (rotation, inertia, inverse_inertia, mass, *motion, force, gravity)
    arrays, after = [np.ascontiguousarray(value, float) for value in values], np.empty((len(mass), 6))
    load_library(SOURCE).accelerate(c_int64(len(mass)), *arrays, c_double(dt), c_double(max_spin), after)
    return np.ascontiguousarray(after[:, :3]), np.ascontiguousarray(after[:, 3:])


def quaternions(rotation: Values) -> Values:
    """Return unit quaternions (n, 4), scalar first, of rotations (n, 3, 3)."""
    rotation, result = np.ascontiguousarray(rotation), np.empty((len(rotation), 4))
    load_library(SOURCE).quaternions(c_int64(len(rotation)), rotation, result)
    return result
