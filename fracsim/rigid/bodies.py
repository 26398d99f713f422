"""Rigid bodies that are pieces of one mesh: what they weigh, where they are, and how they move.

How a rigid body turns where nothing acts: its angular momentum stays, to round-off.

    R' = exp(dt w_m) R,   w_m = (R_m I R_m^T)^-1 l,   R_m = exp(dt w_m / 2) R

the implicit midpoint rule, of second order and without a drift of the energy, found by fixed points: it converges where
a body turns by less than about a radian a step. What turns by more than PART does so in equal parts: at a radian a step
the energy of a flat shard goes up and down by some per cent otherwise.

Equations: docs/theory.md#motion-and-contact-of-rigid-bodies.
"""

from __future__ import annotations

from ctypes import c_double, c_int64
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ..errors import NotConverged
from ..mesh.c_library import load_library
from ..mesh.split_surface.polyhedron_moments import PolyhedronMoments

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
LARGEST = 1e150  # a number whose square overflows is as good as infinite
SOURCE = Path(__file__).with_name("rotation_integrator.c")
ROUNDS = 30
PART = 0.2  # rad
LIMIT = 1e4  # rad
SAME = 1e-14  # change of the turn in a step, rad, that is none


@dataclass(frozen=True)
class Bodies:
    """n rigid bodies in space; a point X of one at rest is at x = place + turn (X - centre).

    Attributes:
        mass: (n,) kg.    centre: (n, 3) of mass at rest, m.    inertia: (n, 3, 3) about it at rest, kg m^2.
        place: (n, 3) of the centre, m.    turn: (n, 3, 3) rotations.
        velocity: (n, 3) of the centre, m/s.    spin: (n, 3) rad/s, in the axes of space.
    """

    mass: Values
    centre: Values
    inertia: Values
    place: Values
    turn: Values
    velocity: Values
    spin: Values

    @classmethod
    def at_rest(cls, density: Values, of: PolyhedronMoments) -> Bodies:
        """Where the mesh has them; `density`: (n,) kg/m^3."""
        n = len(of.volume)
        still, turn = np.zeros((n, 3)), np.tile(np.eye(3), (n, 1, 1))
        inertia = density[:, None, None] * of.inertia
        return cls(density * of.volume, of.centre, inertia, of.centre, turn, still, still)

    def __len__(self) -> int:
        return len(self.mass)

    def to_space(self, X: Values, body: Ints) -> Values:
        """(k, 3) where points X (k, 3) at rest of some bodies (k,) are now, m."""
        return self.place[body] + np.einsum("kij,kj->ki", self.turn[body], X - self.centre[body])

    def to_rest(self, x: Values, body: int) -> Values:
        """(k, 3) where points x (k, 3) of a body are at rest, m."""
        return np.asarray((x - self.place[body]) @ self.turn[body] + self.centre[body])

    def velocity_at(self, x: Values, body: Ints) -> Values:
        """(k, 3) velocity of bodies (k,) at points x (k, 3), m/s."""
        return np.asarray(self.velocity[body] + np.cross(self.spin[body], x - self.place[body]))

    def divided(self, density: Values, of: PolyhedronMoments, parent: Ints) -> Bodies:
        """The pieces that they have broken into, each a part of one body `parent` (m,) and moving as that did there:
        v_i = v + w x r_i, w_i = w (B07 sec. 7)."""
        parts = Bodies.at_rest(density, of)
        place = self.to_space(of.centre, parent)
        velocity = self.velocity_at(place, parent)
        return replace(parts, place=place, turn=self.turn[parent], velocity=velocity, spin=self.spin[parent])

    def reshaped(self, of: PolyhedronMoments, which: Ints) -> Bodies:
        """Some (k,) of them have other shapes: mass stays, and so do the place of the centre, momentum and angular
        momentum."""
        centre, inertia, spin = (np.array(each) for each in (self.centre, self.inertia, self.spin))
        across = np.swapaxes(self.turn[which], 1, 2)
        momentum = inertia[which] @ (across @ spin[which, :, None])
        centre[which] = of.centre[which]
        inertia[which] = (self.mass[which] / of.volume[which])[:, None, None] * of.inertia[which]
        spin[which] = (self.turn[which] @ np.linalg.solve(inertia[which], momentum))[:, :, 0]
        return replace(self, centre=centre, inertia=inertia, spin=spin)

    def part(self, which: slice) -> Bodies:
        """Some of them."""
        return Bodies(*(each[which] for each in vars(self).values()))

    def with_more(self, others: Bodies) -> Bodies:
        """And others after them."""
        if not len(others):
            return self
        return Bodies(*(np.concatenate(both) for both in zip(vars(self).values(), vars(others).values(), strict=True)))

    @property
    def finite(self) -> bool:
        """Whether all numbers are finite, and so are their squares."""
        return all(float(np.max(np.abs(values), initial=0.0)) < LARGEST for values in vars(self).values())

    # --- sums ---

    @property
    def inertia_in_space(self) -> Values:
        """(n, 3, 3) R I R^T, kg m^2."""
        return np.asarray(self.turn @ self.inertia @ np.swapaxes(self.turn, 1, 2))

    @property
    def momentum(self) -> Values:
        """(3,) sum m v, N s."""
        return np.asarray(self.mass @ self.velocity)

    @property
    def angular_momentum(self) -> Values:
        """(3,) sum m x x v + I w about the origin, N m s."""
        own = np.einsum("nij,nj->i", self.inertia_in_space, self.spin)
        return np.asarray((self.mass[:, None] * np.cross(self.place, self.velocity)).sum(axis=0) + own)

    @property
    def kinetics(self) -> Values:
        """(n,) of each, J."""
        turning = np.einsum("ni,nij,nj->n", self.spin, self.inertia_in_space, self.spin)
        return np.asarray(self.mass * np.einsum("ni,ni->n", self.velocity, self.velocity) + turning) / 2

    @property
    def kinetic(self) -> float:
        """J."""
        turning = np.einsum("ni,nij,nj->", self.spin, self.inertia_in_space, self.spin)
        return float(self.mass @ np.einsum("ni,ni->n", self.velocity, self.velocity) + turning) / 2


def tumbled(turn: Values, inverse: Values, momentum: Values, dt: Values) -> Values:
    """(n, 3, 3) rotations after times dt (n,) s, from those before and angular momenta (n, 3), N m s.

    `inverse`: (n, 3, 3) of the inertia in the axes of the bodies, 1 / (kg m^2). NotConverged where one turns by more
    than LIMIT.
    """
    given = [np.ascontiguousarray(each) for each in (turn, inverse, momentum, dt)]
    after: Values = np.empty(turn.shape)
    how = c_int64(ROUNDS), c_double(SAME), c_double(PART), c_double(LIMIT)
    if load_library(SOURCE).tumbled(c_int64(len(turn)), *given, *how, after):
        raise NotConverged(
            f"A body turns by more than {LIMIT:g} rad in a step: speeds and spins are too high for time.step"
        )
    return after


def rotated(turn: Values, tensor: Values, vector: Values) -> Values:
    """(n, 3) R T R^T v of tensors in the axes of bodies (n, 3, 3), inertia or its inverse, and vectors in space (n, 3):
    spins, or angular momenta."""
    given, result = [np.ascontiguousarray(each) for each in (turn, tensor, vector)], np.empty(vector.shape)
    load_library(SOURCE).rotations(c_int64(len(turn)), *given, result)
    return result


def driven(
    turn: Values, inertia: Values, inverse: Values, mass: Values, motion: tuple[Values, Values], force: Values,
    gravity: Values, dt: float, most: float,
) -> tuple[Values, Values]:  # fmt: skip
    """(n, 3) velocities and (n, 3) spins after dt, s, from those before, `motion`, of bodies with masses (n,) that turn
    where they are by `gravity` (3,) and forces and moments (n, 6), these in their own axes; no moment sets one spinning
    by more than `most`, rad/s."""
    arrays = (turn, inertia, inverse, mass, *motion, force, gravity)
    given, after = [np.ascontiguousarray(each, float) for each in arrays], np.empty((len(mass), 6))
    load_library(SOURCE).driven(c_int64(len(mass)), *given, c_double(dt), c_double(most), after)
    return np.ascontiguousarray(after[:, :3]), np.ascontiguousarray(after[:, 3:])


def orientation(turn: Values) -> Values:
    """(n, 4) of rotations (n, 3, 3) quaternions, the scalar first."""
    turn, quat = np.ascontiguousarray(turn), np.empty((len(turn), 4))
    load_library(SOURCE).orientations(c_int64(len(turn)), turn, quat)
    return quat
