"""Impulses of a crowd of contacts: Coulomb's law for all of them at once, in array code.

    u = u_0 + J M^-1 J^T p,   K_mu = {|p_t| <= mu p_n},   K_mu  3  p  _|_  u + (r / dt + mu |u_t|) n

with the velocities u of the second thing beside the first after the step, u_0 of them without impulses p, and r the
distance that may be lost (G. De Saxce, Z.-Q. Feng 1991: with mu |u_t| it is Coulomb's law, without it a convex problem
that lifts what slips). It is solved by projections onto the cones,

    p  <-  P_K(q - D^-1 (u(q) + (r / dt + mu |u_t|) n)),   q = p + beta (p - p_before)

with Nesterov's beta, begun anew for the contacts of a body on which p turns back (H. Mazhar et al. 2015, ACM Trans.
Graph. 34; B. O'Donoghue, E. Candes 2015). D is of bodies as many times lighter as they have contacts (R. Tonge et al.
2012): J M^-1 J^T <= D, so that no step is too long, whatever the bodies weigh. Newton's method on the convex problem
needs factors of one great matrix each time, and which of a thousand hard contacts press it finds by trial.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import csr_array

from .contacts import Contacts

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

LOOK = 10  # iterations between looks whether they are enough
TINY = 1e-300


@dataclass(frozen=True)
class Crowd:
    """k contacts of n bodies.

    Attributes:
        across: (3k, 6n) D^-1/2 J M^-1/2, all normal rows first.    back: its transpose.    scale: (k,) D^-1/2.
        things: (2, k), n of all that stands.    friction: (k,).
        levels: (n, 6, 6) M^-1/2, moments and spins in the axes of space.
    """

    across: csr_array
    back: csr_array
    scale: Values
    things: Ints
    friction: Values
    levels: Values

    @classmethod
    def of(cls, contacts: Contacts, mass: Values, inverse: Values) -> Crowd:
        """Of contacts of bodies with masses (n,) kg and inverse inertia (n, 3, 3) in the axes of space."""
        n, k = len(mass), len(contacts)
        levels: Values = np.zeros((n + 1, 6, 6))
        levels[:n, :3, :3] = np.eye(3) / np.sqrt(mass)[:, None, None]
        levels[:n, 3:, 3:] = np.linalg.cholesky(inverse)
        things = np.minimum(contacts.things.T, n)
        count = np.bincount(things.ravel(), minlength=n + 1)
        axes = contacts.axes
        motions = [np.concatenate([axes, np.cross(arms[:, None], axes)], axis=2) for arms in contacts.arms]
        rows = np.stack([-motions[0] @ levels[things[0]], motions[1] @ levels[things[1]]])
        weight = count[things][:, :, None, None] * (rows @ np.swapaxes(rows, 2, 3))
        scale = 1 / np.sqrt(np.maximum(np.linalg.eigvalsh(weight.sum(axis=0))[:, -1], TINY))
        entries = np.transpose(scale[:, None, None] * rows, (2, 1, 0, 3))  # axis, contact, side, motion
        columns = np.where(things == n, 0, 6 * things).T[:, :, None] + np.arange(6)
        at = np.arange(0, 36 * k + 1, 12)
        across = csr_array((entries.ravel(), np.tile(columns.ravel(), 3), at), shape=(3 * k, 6 * n))
        return cls(across, across.T.tocsr(), scale, things, contacts.friction, levels[:n])

    def impulses(self, free: Values, aim: Values, enough: float, most: int, start: Values) -> Values:
        """(k, 3) N s that second things receive, along the axes of the contacts.

        `free`: (k, 3) m/s, u_0; `aim`: (k,) m/s, r / dt; `enough`: m/s that velocities may be off by; `most`: of
        iterations; `start`: (k, 3) N s from where to go on.
        """
        mu, scale, n = self.friction, self.scale, len(self.levels)
        given = scale * free.T
        given[0] += scale * aim
        p = start.T / scale
        q, pace = p, np.ones_like(scale)
        for number in range(most):
            u = (self.across @ (self.back @ q.ravel())).reshape(3, -1) + given
            u[0] += mu * np.hypot(u[1], u[2])
            before, p = p, projected(q - u, mu)
            left = q - p
            if number % LOOK == 0 and np.all(np.einsum("ik,ik->k", left, left) < (enough * scale) ** 2):
                break
            change = p - before
            back = np.einsum("ik,ik->k", left, change)
            of_thing = sum(np.bincount(of, back, n + 1) for of in self.things)
            turned = (of_thing > 0) & (np.arange(n + 1) < n)
            pace[turned[self.things].any(axis=0)] = 1.0
            faster = (1 + np.sqrt(1 + 4 * pace**2)) / 2
            q, pace = p + (pace - 1) / faster * change, faster
        return (scale * p).T

    def gained(self, impulses: Values) -> Values:
        """(n, 6) velocities and spins that impulses (k, 3) give."""
        level = (self.back @ (impulses.T / self.scale).ravel()).reshape(-1, 6)
        return np.einsum("nij,nj->ni", self.levels, level)


def projected(p: Values, mu: Values) -> Values:
    """(3, k) the nearest of each cone |p_t| <= mu p_n."""
    along = np.hypot(p[1], p[2])
    normal = np.where(along <= mu * p[0], p[0], np.maximum((p[0] + mu * along) / (1 + mu**2), 0.0))
    share = np.minimum(mu * normal / np.maximum(along, TINY), 1.0)
    return np.stack([normal, share * p[1], share * p[2]])
