"""Impulses of a crowd of contacts: Coulomb's law for all of them at once, in array code.

    u = u_0 + J M^-1 J^T p,   K_mu = {|p_t| <= mu p_n},   K_mu  3  p  _|_  u + (r / dt + mu |u_t|) n

with the velocities u of the second thing beside the first after the step, u_0 of them without impulses p, and r the
distance that may be lost (G. De Saxce, Z.-Q. Feng 1991: with mu |u_t| it is Coulomb's law, without it a convex problem
that lifts what slips). It is solved by projections onto the cones,

    p  <-  P_K(q - D^-1 (u(q) + (r / dt + mu |u_t|) n)),   q = p + beta (p - p_before)

with Nesterov's beta, begun anew for the contacts of a body on which p turns back (H. Mazhar et al. 2015, ACM Trans.
Graph. 34; B. O'Donoghue, E. Candes 2015). Of a body with rows r of J M^-1/2, w = |r|^2 of each contact,

    J M^-1 J^T <= D = sum over bodies of lambda w,   lambda the largest eigenvalue of sum r^T r / w   (6, 6)

at most as many as it has contacts (R. Tonge et al. 2012) and mostly half of that: no step is too long, whatever bodies
weigh. Only contacts that press, or that things would go through, are solved for: of what lies near in a heap fewer than
half press. Which these are is looked at again after LOOK, 2 LOOK, 4 LOOK iterations. Newton's method on the convex
problem needs factors of one great matrix each time, and which of a thousand hard contacts press it finds by trial.
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

CHECK, LOOK = 10, 15  # iterations between looks whether they are enough, and before the first at what presses
TINY = 1e-300


@dataclass(frozen=True)
class Crowd:
    """k contacts of n bodies.

    Attributes:
        rows: (2, k, 3, 6) J M^-1/2 of the first and second thing.    things: (2, k), n of all that stands.
        friction: (k,).    levels: (n, 6, 6) M^-1/2, moments and spins in the axes of space.
    """

    rows: Values
    things: Ints
    friction: Values
    levels: Values

    @classmethod
    def of(cls, contacts: Contacts, mass: Values, inverse: Values) -> Crowd:
        """Of contacts of bodies with masses (n,) kg and inverse inertia (n, 3, 3) in the axes of space."""
        n, axes = len(mass), contacts.axes
        levels: Values = np.zeros((n + 1, 6, 6))
        levels[:n, :3, :3] = np.eye(3) / np.sqrt(mass)[:, None, None]
        levels[:n, 3:, 3:] = np.linalg.cholesky(inverse)
        things = np.minimum(contacts.things.T, n)
        motions = [np.concatenate([axes, np.cross(arms[:, None], axes)], axis=2) for arms in contacts.arms]
        rows = np.stack([-motions[0] @ levels[things[0]], motions[1] @ levels[things[1]]])
        return cls(rows, things, contacts.friction, levels[:n])

    def impulses(self, free: Values, aim: Values, enough: float, most: int, start: Values) -> Values:
        """(k, 3) N s that second things receive, along the axes of the contacts.

        `free`: (k, 3) m/s, u_0; `aim`: (k,) m/s, r / dt; `enough`: m/s that velocities may be off by; `most`: of
        iterations; `start`: (k, 3) N s from where to go on.
        """
        given = free.T.copy()
        given[0] += aim
        p, change, pace = start.T.copy(), np.zeros((3, len(aim))), np.ones(len(aim))
        spent, done = 0, False
        while spent < most:
            now = min(max(LOOK, spent), most - spent)
            parting = given[0] + self._parting(self._level(p))
            if done and not np.any((parting < -enough) & (p[0] == 0)):
                break
            rows = np.flatnonzero((p[0] > 0) | (parting < enough))
            course = _Course(self.rows[:, rows], self.things[:, rows], self.friction[rows], len(self.levels))
            p[:, rows], change[:, rows], pace[rows], done = course(
                given[:, rows], enough, now, p[:, rows], change[:, rows], pace[rows]
            )
            spent += now
        return p.T

    def _level(self, p: Values) -> Values:
        """(n + 1, 6) what impulses (3, k) give bodies, each in units of its own."""
        n, some = len(self.levels), np.flatnonzero(p[0] > 0)
        each = np.einsum("skai,ak->iks", self.rows[:, some], p[:, some]).reshape(6, -1)
        of = self.things[:, some].T.ravel()
        return np.stack([np.bincount(of, values, n + 1) for values in each], axis=1)

    def _parting(self, level: Values) -> Values:
        """(k,) m/s at which things part along the normals of contacts, of what impulses give them."""
        return np.asarray(np.einsum("ski,ski->k", self.rows[:, :, 0], level[self.things]))

    def gained(self, impulses: Values) -> Values:
        """(n, 6) velocities and spins that impulses (k, 3) give."""
        return np.einsum("nij,nj->ni", self.levels, self._level(impulses.T)[:-1])


class _Course:
    """Iterations on some contacts with rows (2, k, 3, 6) between things (2, k), of which n stand."""

    def __init__(self, rows: Values, things: Ints, friction: Values, n: int) -> None:
        self._things, self._friction, self._n, k = things, friction, n, len(friction)
        self._scale = 1 / np.sqrt(np.maximum(_bound(rows, things, n), TINY))
        entries = np.transpose(self._scale[:, None, None] * rows, (2, 1, 0, 3))  # axis, contact, side, motion
        columns = np.where(things == n, 0, 6 * things).T[:, :, None] + np.arange(6)
        at = np.arange(0, 36 * k + 1, 12)
        self._across = csr_array((entries.ravel(), np.tile(columns.ravel(), 3), at), shape=(3 * k, 6 * n))
        self._back = self._across.T.tocsr()

    def __call__(
        self, given: Values, enough: float, most: int, start: Values, change: Values, pace: Values
    ) -> tuple[Values, Values, Values, bool]:
        """Impulses (3, k) N s after `most` iterations or fewer, how they last changed, the paces (k,), and whether they
        are good enough, from where they were."""
        mu, scale, n, bodies = self._friction, self._scale, self._n, np.arange(self._n + 1) < self._n
        given, p, change, near = scale * given, start / scale, change / scale, (enough * scale) ** 2
        for number in range(1, most + 1):
            faster = (1 + np.sqrt(1 + 4 * pace**2)) / 2
            q, pace = p + (pace - 1) / faster * change, faster
            u = (self._across @ (self._back @ q.ravel())).reshape(3, -1) + given
            u[0] += mu * np.hypot(u[1], u[2])
            before, p = p, projected(q - u, mu)
            left, change = q - p, p - before
            if number % CHECK == 0 and np.all(np.einsum("ik,ik->k", left, left) < near):
                return scale * p, scale * change, pace, True
            back = np.einsum("ik,ik->k", left, change)
            turned = (sum(np.bincount(of, back, n + 1) for of in self._things) > 0) & bodies
            pace[turned[self._things].any(axis=0)] = 1.0
        return scale * p, scale * change, pace, False


def _bound(rows: Values, things: Ints, n: int) -> Values:
    """(k,) D."""
    size = np.maximum(np.einsum("skai,skai->sk", rows, rows), TINY)
    square = (np.swapaxes(rows, 2, 3) @ rows / size[:, :, None, None]).reshape(-1, 36)
    of = csr_array((np.ones(things.size), (things.ravel(), np.arange(things.size))), shape=(n + 1, things.size))
    most = np.linalg.eigvalsh((of @ square).reshape(-1, 6, 6))[:, -1]
    return np.asarray((most[things] * size).sum(axis=0))


def projected(p: Values, mu: Values) -> Values:
    """(3, k) the nearest of each cone |p_t| <= mu p_n."""
    along = np.hypot(p[1], p[2])
    normal = np.where(along <= mu * p[0], p[0], np.maximum((p[0] + mu * along) / (1 + mu**2), 0.0))
    share = np.minimum(mu * normal / np.maximum(along, TINY), 1.0)
    return np.stack([normal, share * p[1], share * p[2]])
