"""Poses of several rigid bodies as the least of one potential: the sum of theirs, with barriers between them.

Phi(z) = sum over bodies of Phi_i(z_i) (rigid_step) + s^2 k sum over pairs of E_ij(z_i, z_j), by Newton's method on ways
that pass through nothing. One body by itself is the same with no pair.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from .push import Push

if TYPE_CHECKING:
    from .rigid_step import RigidStep

Values = npt.NDArray[np.float64]

ITERATIONS = 100
SMALL = 1e-18  # share of the energies at play: Newton's decrement where z is found
ROUND_OFF = 1e-13  # share of the energies at play by which Phi may be wrong
SHORTEST = 1e-12  # share of a step of Newton's method


@dataclass(frozen=True)
class Pushes:
    """What contact does to bodies.

    Attributes:
        each: of every one; their energies sum to that of all.    mixed: of pairs (i, j), i < j, the second derivative
            (p, p) of their energy by an increment of the first pose and of the second, exact and the positive part's.
    """

    each: Sequence[Push]
    mixed: Mapping[tuple[int, int], tuple[Values, Values]] = field(default_factory=dict)

    @property
    def energy(self) -> float:
        """J."""
        return sum(push.energy for push in self.each)


class Together:
    """Steps of several bodies, of one scheme and size; z: (k,) of each."""

    def __init__(self, steps: Sequence[RigidStep]) -> None:
        self._steps, first = steps, steps[0]
        self._share, self._factor = first.share, first.factor
        self._ends = np.cumsum([len(step.M) for step in steps])

    def split(self, values: Values) -> list[Values]:
        """Those of each body."""
        return np.split(values, self._ends[:-1])

    def system(self, z: Sequence[Values], contact: Pushes) -> tuple[Values, Values, Values]:
        """(K,) gradient of Phi / s, (K, K) Hessian of Phi / s^2, and its part that is positive definite."""
        parts = [step.system(way, push) for step, way, push in zip(self._steps, z, contact.each, strict=True)]
        size, at = (
            int(self._ends[-1]),
            [slice(end - len(g), end) for end, (g, _, _) in zip(self._ends, parts, strict=True)],
        )
        hessian, stiffness = np.zeros((size, size)), np.zeros((size, size))
        for where, (_, exact, positive) in zip(at, parts, strict=True):
            hessian[where, where], stiffness[where, where] = exact, positive
        for (i, j), both in contact.mixed.items():
            T, S = self._steps[i].by_way(z[i]), self._steps[j].by_way(z[j])
            for whole, block in zip((hessian, stiffness), both, strict=True):
                whole[at[i], at[j]] = self._factor * T.T @ block @ S
                whole[at[j], at[i]] = whole[at[i], at[j]].T
        return np.concatenate([g for g, _, _ in parts]), hessian, stiffness

    def settle(
        self,
        z: Sequence[Values],
        contact: Callable[[Sequence[Values]], Pushes],
        free: Callable[[Sequence[Values], Sequence[Values]], float],
    ) -> tuple[Sequence[Values], Pushes]:
        """The z of least Phi that is reached from z on ways that pass through nothing, and what contact does there
        (collective).

        `contact`: z -> Pushes, of all ranks.    `free`: share of the way from z by dz on which no gap closes.
        """
        now, weight = contact(z), self._factor * self._share**2
        height = self._own(z) + weight * now.energy
        for _ in range(ITERATIONS):
            gradient, hessian, stiffness = self.system(z, now)
            step: Values = np.asarray(-_solved(hessian, stiffness, gradient) / self._share)
            decrement, dz = -self._share * float(gradient @ step), self.split(step)
            at_play = sum(each.scale(way) for each, way in zip(self._steps, z, strict=True)) + weight * now.energy
            if not decrement > SMALL * at_play:
                break
            share, slack = free(z, dz), ROUND_OFF * (at_play + abs(height))
            while share > SHORTEST:
                there = [way + share * change for way, change in zip(z, dz, strict=True)]
                found = contact(there)
                level = self._own(there) + weight * found.energy
                if level <= height - 1e-4 * share * decrement + slack:
                    break
                share /= 2
            else:
                break
            z, now, height = there, found, level
        return z, now

    def _own(self, z: Sequence[Values]) -> float:
        return sum(step.own(way) for step, way in zip(self._steps, z, strict=True))


def _solved(hessian: Values, stiffness: Values, gradient: Values) -> Values:
    """H^-1 g with H the Hessian where that is positive definite, else the stiffness."""
    with np.errstate(all="ignore"):
        return np.asarray(np.linalg.solve(hessian if is_positive(hessian) else stiffness, gradient), np.float64)


def is_positive(matrix: Values) -> bool:
    """Whether a symmetric matrix (k, k) is positive definite."""
    try:
        np.linalg.cholesky(matrix)
    except np.linalg.LinAlgError:
        return False
    return True
