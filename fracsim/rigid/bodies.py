"""Rigid bodies that are pieces of one mesh: what they weigh, where they are, and how they move."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from ..mesh.split.moments import Moments

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]

LARGEST = 1e150  # a number whose square overflows is as good as infinite


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
    def at_rest(cls, density: Values, of: Moments) -> Bodies:
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

    def divided(self, density: Values, of: Moments, parent: Ints) -> Bodies:
        """The pieces that they have broken into, each a part of one body `parent` (m,) and moving as that did there:
        v_i = v + w x r_i, w_i = w (B07 sec. 7)."""
        parts = Bodies.at_rest(density, of)
        place = self.to_space(of.centre, parent)
        velocity = self.velocity_at(place, parent)
        return replace(parts, place=place, turn=self.turn[parent], velocity=velocity, spin=self.spin[parent])

    def reshaped(self, of: Moments, which: Ints) -> Bodies:
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
