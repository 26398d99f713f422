"""Contacts of cylinders: the exact ones of MuJoCo, and those of corners of the prism in a cylinder (obstacles).

The normal of a cylinder passes through its axis, so that spin about the axis closes no gap and no normal force changes
it. Corners of the prism have a lever about the axis. They are contacts with a plane only where a step without them
would go through it (plane_contacts), and with other bodies where the normal n is close to the axis a,
|n x a| <= MAX_SINE, as between disks that lie on one another. What corners approach by as the cylinder spins on its
axis is added to their gaps.

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
    """

    corner_sine: float = 0.5
    prism_distance: float = 0.07


SETTINGS = CylinderContactSettings()


@dataclass(frozen=True)
class CylinderContacts:
    """Cylinders among n bodies.

    Attributes:
        axis: (n, 3) unit vectors in the axes of the bodies; 0 for bodies that are no cylinders.
        prism_geom: (n,) geoms of the prisms; -1 for bodies without a prism.
        radius: (n,) m; 0 for bodies that are no cylinders.
        planes: (p,) numbers of the obstacles that are planes, after all bodies.
    """

    axis: Values
    prism_geom: Ints
    radius: Values
    planes: Ints

    def select(self, contacts: Contacts, bodies: Bodies) -> Contacts:
        """Return MuJoCo's contacts (k) of n bodies without false ones, and without corners far from the axis."""
        if not len(contacts) or not np.any(self.prism_geom >= 0):
            return contacts
        axis, is_corner = self._axes_in_space(contacts, bodies), self._are_corners(contacts)
        sine = np.linalg.norm(np.cross(contacts.axes[:, :1], axis[contacts.pairs]), axis=2)
        is_false = self._are_false(contacts, np.asarray(np.any(is_corner, axis=1)))
        # the corners replace false contacts of their pair of bodies
        codes = _pair_codes(contacts.pairs)
        is_lateral = np.any(is_corner & (sine > SETTINGS.corner_sine), axis=1) & ~np.isin(codes, codes[is_false])
        return contacts.select(np.flatnonzero(~is_lateral & ~is_false))

    def _are_false(self, contacts: Contacts, is_corner: Flags) -> Flags:
        """Return (k,) flags of contacts of cylinders that are deeper than the prisms of both bodies allow."""
        beyond = np.zeros(max(int(contacts.pairs.max()) + 1 - len(self.radius), 0))
        radius = np.concatenate([self.radius, beyond])[contacts.pairs].max(axis=1)
        _, pair = np.unique(_pair_codes(contacts.pairs), return_inverse=True)
        depth: Values = np.zeros(len(contacts))
        np.maximum.at(depth, pair[is_corner], -contacts.gap[is_corner])
        of_cylinder = (radius > 0) & ~is_corner & ~np.isin(contacts.pairs, self.planes).any(axis=1)
        return of_cylinder & (-contacts.gap > depth[pair] + SETTINGS.prism_distance * radius)

    def without_axial_approach(self, contacts: Contacts, bodies: Bodies, dt: float) -> Contacts:
        """Return the contacts (k) of n bodies with the gaps of corners larger by their axial approach in dt, s."""
        if not len(contacts) or not np.any(self.prism_geom >= 0):
            return contacts
        axis, count = self._axes_in_space(contacts, bodies), len(bodies)
        axial = np.einsum("ni,ni->n", axis[:count], bodies.spin)
        spin = np.append(axial, np.zeros(len(axis) - count))[:, None] * axis
        approach = np.where(self._are_corners(contacts).any(axis=1), contacts.approach_speeds(0 * spin, spin), 0.0)
        return replace(contacts, gap=contacts.gap + dt * np.maximum(approach, 0.0))

    def _axes_in_space(self, contacts: Contacts, bodies: Bodies) -> Values:
        """Return the axes of all bodies and obstacles that contacts refer to, 0 for those that are no cylinders."""
        count = len(bodies)
        result: Values = np.zeros((max(int(contacts.pairs.max()) + 1, count), 3))
        result[:count] = np.einsum("nij,nj->ni", bodies.rotation, self.axis)
        return result

    def _are_corners(self, contacts: Contacts) -> Flags:
        """Return (k, 2) flags of the sides of contacts that are prisms."""
        # obstacles follow the bodies
        beyond = np.full(max(int(contacts.pairs.max()) + 1 - len(self.prism_geom), 0), -1)
        geom = np.concatenate([self.prism_geom, beyond])[contacts.pairs]
        return np.asarray((contacts.geoms == geom) & (geom >= 0))


def _pair_codes(pairs: Ints) -> Ints:
    """Return one number (k,) for each pair (k, 2) of bodies."""
    return np.asarray(np.sort(pairs, axis=1) @ [int(pairs.max()) + 1, 1], np.int64)
