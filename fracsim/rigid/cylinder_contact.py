"""Contacts of cylinders: exact ones, and those of corners of the prism in a cylinder (obstacles).

Two cylinders side by side, or a cylinder and a capsule, touch along a line, of which MuJoCo gives a single point at
either end. They have contacts at both ends of the common part of their axes and where the axes are closest, between a
point p of the one and the closest point q of the other axis, with the gap |q - p| - r_1 - r_2.

The normal of a cylinder passes through its axis, so that spin about the axis closes no gap and no normal force changes
it. Corners of the prism have a lever about the axis. They are contacts with a plane only where a step without them
would go through it (plane_contacts), and with other bodies where the normal n is close to the axis a, by the sine
|n x a|, as between disks that lie on one another. What corners approach by as the cylinder spins on its axis is added
to their gaps.

MuJoCo's depth of cylinders that overlap by some millimetres is sometimes several times the true one, with a normal that
is none. The prism in a cylinder bounds it: deeper contacts are left out, and those of the prism stay.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from .bodies import Bodies
from .contact_points import Contacts

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class CylinderContactSettings:
    """Bounds of contacts of cylinders.

    Attributes:
        corner_sine: sine of the largest angle between axis and normal of contacts of corners with other bodies; their
            lever about the axis is at most half the radius there.
        prism_distance: radii; the cylinders of two bodies are no more than this deeper in one another than the prisms,
            whose sides are 0.034 radii below the cylinder.
        crossing_sine: sine of the angle between axes up to which cylinders lie side by side.
        lateral_cosine: largest cosine of the angle between these axes and the shortest way between them.
    """

    corner_sine: float = 0.5
    prism_distance: float = 0.07
    crossing_sine: float = 0.5
    lateral_cosine: float = 0.3


SETTINGS = CylinderContactSettings()


@dataclass(frozen=True)
class CylinderContacts:
    """Cylinders and capsules among n bodies and m prescribed obstacles.

    Attributes:
        body_count: n.
        axis: (n + m, 3) unit vectors, of bodies in their axes; 0 for what is no cylinder or capsule.
        radius: (n + m,) m; 0 likewise.
        half_length: (n + m,) of the cylinder, or between the centres of the ends of a capsule, m.
        is_capsule: (n + m,).
        prism_geom: (n + m,) geoms of the prisms; -1 for what has no prism.
        planes: (p,) numbers of the obstacles that are planes, after all bodies.
    """

    body_count: int
    axis: Values
    radius: Values
    half_length: Values
    is_capsule: Flags
    prism_geom: Ints
    planes: Ints

    def select(self, contacts: Contacts, bodies: Bodies, centres: Values) -> Contacts:
        """Return MuJoCo's contacts (k) with those of lines, and without false ones and corners far from the axis.

        `centres`: (n + m, 3) of bodies and obstacles, m.
        """
        if not len(contacts) or not np.any(self.radius[: self.body_count]):
            return contacts
        axis, is_corner = self._axes_in_space(bodies), self._are_corners(contacts)
        sine = np.linalg.norm(np.cross(contacts.axes[:, :1], axis[contacts.pairs]), axis=2)
        any_corner = np.asarray(np.any(is_corner, axis=1))
        lines, has_line = self._line_contacts(contacts, any_corner, axis, centres)
        is_false = self._are_false(contacts, any_corner) | (has_line & ~any_corner)
        # the corners replace false contacts of their pair of bodies
        codes = _pair_codes(contacts.pairs)
        is_lateral = np.any(is_corner & (sine > SETTINGS.corner_sine), axis=1)
        is_lateral &= ~np.isin(codes, codes[is_false & ~has_line])
        return contacts.select(np.flatnonzero(~is_lateral & ~is_false)).concatenate(lines)

    def _line_contacts(
        self, contacts: Contacts, is_corner: Flags, axis: Values, centres: Values
    ) -> tuple[Contacts, Flags]:  # fmt: skip
        """Return the contacts of cylinders side by side, and (k,) flags of contacts of these pairs of bodies."""
        codes, (first, second) = _pair_codes(contacts.pairs), contacts.pairs.T
        may_be_line = ~is_corner & np.all(self.radius[contacts.pairs] > 0, axis=1)
        may_be_line &= ~np.all(self.is_capsule[contacts.pairs], axis=1)
        rows = np.flatnonzero(may_be_line)
        rows = rows[np.unique(codes[rows], return_index=True)[1]]
        a, b = first[rows], second[rows]
        cosine = np.einsum("ki,ki->k", axis[a], axis[b])
        along, across = axis[a], np.where(cosine < 0, -1.0, 1.0)[:, None] * axis[b]
        cosine, arm = np.abs(cosine), centres[b] - centres[a]
        # the common part of both axes, on the first one, and where the lines are closest
        middle = np.einsum("ki,ki->k", arm, along)
        low, high = (np.maximum(-self.half_length[a], middle - self.half_length[b] * cosine),
                     np.minimum(self.half_length[a], middle + self.half_length[b] * cosine))  # fmt: skip
        square = 1 - cosine**2
        closest = np.divide(
            middle - cosine * np.einsum("ki,ki->k", arm, across), square, out=middle.copy(), where=square > 1e-6
        )
        station = np.stack([low, high, np.clip(closest, low, high)], axis=1)
        p = centres[a, None] + station[:, :, None] * along[:, None]
        reach = self.half_length[b, None]
        on_second = np.clip(np.einsum("ksi,ki->ks", p - centres[b, None], across), -reach, reach)
        offset = centres[b, None] + on_second[:, :, None] * across[:, None] - p
        distance = np.linalg.norm(offset, axis=2)
        normal = offset / np.maximum(distance, 1e-300)[:, :, None]
        cosines = [np.abs(np.einsum("ki,ki->k", normal[:, 2], direction)) for direction in (along, across)]
        is_line = (square < SETTINGS.crossing_sine**2) & (low < high) & (distance[:, 2] > 0)
        is_line &= np.maximum(*cosines) < SETTINGS.lateral_cosine
        # disks that overlap with their faces are less deep along the axis
        depth = self.radius[a] + self.radius[b] - distance[:, 2]
        is_line &= high - low > depth
        # the third contact only where it is not at an end
        inside = (station[:, 2] - low > 0.05 * (high - low)) & (high - station[:, 2] > 0.05 * (high - low))
        chosen, column = np.nonzero(is_line[:, None] & np.stack([low < high, low < high, inside], axis=1))
        gap = distance[chosen, column] - self.radius[a[chosen]] - self.radius[b[chosen]]
        n = normal[chosen, column]
        point = p[chosen, column] + (self.radius[a[chosen]] + gap / 2)[:, None] * n
        pair_contacts = contacts.select(rows[chosen])
        # tangents along the first axis and across it
        tangent = along[chosen] - np.einsum("ki,ki->k", along[chosen], n)[:, None] * n
        tangent /= np.linalg.norm(tangent, axis=1)[:, None]
        axes = np.stack([n, tangent, np.cross(n, tangent)], axis=1)
        lines = Contacts.with_arms(
            pair_contacts.geoms, pair_contacts.pairs, point, axes, gap, pair_contacts.friction, centres
        )
        return lines, np.isin(codes, codes[rows[is_line]])

    def _are_false(self, contacts: Contacts, is_corner: Flags) -> Flags:
        """Return (k,) flags of contacts of cylinders that are deeper than the prisms of both bodies allow."""
        radius = np.where(self.prism_geom >= 0, self.radius, 0.0)[contacts.pairs].max(axis=1)
        _, pair = np.unique(_pair_codes(contacts.pairs), return_inverse=True)
        depth: Values = np.zeros(len(contacts))
        np.maximum.at(depth, pair[is_corner], -contacts.gap[is_corner])
        of_cylinder = (radius > 0) & ~is_corner & ~np.isin(contacts.pairs, self.planes).any(axis=1)
        return of_cylinder & (-contacts.gap > depth[pair] + SETTINGS.prism_distance * radius)

    def without_axial_approach(self, contacts: Contacts, bodies: Bodies, dt: float) -> Contacts:
        """Return the contacts (k) of n bodies with the gaps of corners larger by their axial approach in dt, s."""
        if not len(contacts) or not np.any(self.prism_geom >= 0):
            return contacts
        axis, spin = self._axes_in_space(bodies), np.zeros_like(self.axis)
        spin[: self.body_count] = bodies.spin
        spin = np.einsum("ni,ni->n", axis, spin)[:, None] * axis
        approach = np.where(self._are_corners(contacts).any(axis=1), contacts.approach_speeds(0 * spin, spin), 0.0)
        return replace(contacts, gap=contacts.gap + dt * np.maximum(approach, 0.0))

    def _axes_in_space(self, bodies: Bodies) -> Values:
        """Return the axes (n + m, 3) of bodies as they are rotated, and of obstacles."""
        result = self.axis.copy()
        moving = slice(self.body_count)
        result[moving] = np.einsum("nij,nj->ni", bodies.rotation, self.axis[moving])
        return result

    def _are_corners(self, contacts: Contacts) -> Flags:
        """Return (k, 2) flags of the sides of contacts that are prisms."""
        geom = self.prism_geom[contacts.pairs]
        return np.asarray((contacts.geoms == geom) & (geom >= 0))


def _pair_codes(pairs: Ints) -> Ints:
    """Return one number (k,) for each pair (k, 2) of bodies."""
    return np.asarray(np.sort(pairs, axis=1) @ [int(pairs.max()) + 1, 1], np.int64)
