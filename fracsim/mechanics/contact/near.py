"""Which elements of a surface are near each other: candidates, kept while points move little, and pairs that touch.

Three kinds of pairs: centroids against elements, vertices against elements, and in 3D edges against edges, each with a
barrier of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import ipctk
import numpy as np
import numpy.typing as npt

from .sample_points import Centroids, Vertices

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

Values = npt.NDArray[np.float64]

KEPT = 0.1  # of a gap is left by a step
# of the collision detection: faces that slide on each other would take for ever; with 1,000 of them pairs at a
# thousandth of the barrier's distance held Newton's method to a fifth of its steps
ROUNDS = 10_000
CCD = ipctk.AdditiveCCD(ROUNDS, 1.0 - KEPT)


@dataclass(frozen=True)
class Kind:
    """The barrier of one kind of pairs, from `distance` m on with `stiffness` Pa, between sample points or edges and
    elements; `name` of the list of ipctk's candidates, "" for centroids, which have candidates of their own."""

    distance: float
    stiffness: float
    name: str
    samples: Vertices | Centroids

    @cached_property
    def barrier(self) -> ipctk.BarrierPotential:
        """That of ipctk."""
        return ipctk.BarrierPotential(self.distance, self.stiffness, True)

    def touching(self, candidates: ipctk.Candidates, x: Values) -> Touching:
        """Those of the candidates on which the barrier acts with vertices at x (n, d)."""
        pairs = ipctk.NormalCollisions()
        pairs.use_area_weighting = True
        pairs.collision_set_type = ipctk.NormalCollisions.IMPROVED_MAX_APPROX
        positions = self.samples.positions(x)
        pairs.build(candidates, self.samples.mesh, positions, self.distance)
        self.samples.weight(pairs)
        return Touching(self, pairs, positions)


@dataclass(frozen=True)
class Touching:
    """Pairs on which the barrier of a kind acts, with the sample points at `positions` (p, d), m."""

    kind: Kind
    pairs: ipctk.NormalCollisions
    positions: Values

    def energy(self) -> float:
        """J."""
        return float(self.kind.barrier(self.pairs, self.kind.samples.mesh, self.positions))

    def gradient(self) -> Values:
        """(n d,) by the vertices, N."""
        samples = self.kind.samples
        return samples.gradient(self.kind.barrier.gradient(self.pairs, samples.mesh, self.positions))

    def hessian(self, projection: ipctk.PSDProjectionMethod) -> csr_matrix:
        """(n d, n d) by the vertices, N/m."""
        samples = self.kind.samples
        return samples.hessian(self.kind.barrier.hessian(self.pairs, samples.mesh, self.positions, projection))

    def least_squared_distance(self) -> float:
        """m^2."""
        return float(self.pairs.compute_minimum_distance(self.kind.samples.mesh, self.positions))


class Near:
    """Candidates within `distance` + 2 `margin` (m) of each other; x (n, d) of the mesh's points.

    They are looked for on the whole way of a step of Newton's method, and serve all that stays within `margin` of it:
    where the line search stops, the steps after it, and the way of the next one, which mostly goes on along it.
    """

    def __init__(self, mesh: ipctk.CollisionMesh, kinds: list[Kind], distance: float, margin: float) -> None:
        self._mesh, self._kinds, self._margin, self._radius = mesh, kinds, margin, 0.5 * distance + margin
        self.forget()

    def forget(self) -> None:
        """Nothing is known of any place."""
        self._candidates: list[ipctk.Candidates] = []
        self._found: list[Touching] = []
        self._from = self._way = self._found_at = np.full(self._mesh.rest_positions.shape, np.nan)

    def touching(self, x: Values) -> list[Touching]:
        """The pairs of each kind on which its barrier acts; those of the last x are kept."""
        if not np.array_equal(x, self._found_at):
            each = zip(self._kinds, self.candidates(x), strict=True)
            self._found = [kind.touching(candidates, x) for kind, candidates in each]
            self._found_at = x.copy()
        return self._found

    def stiffen(self, stiffness: Sequence[float]) -> None:
        """Barriers have this stiffness of each kind, Pa, from here on; what touches stays."""
        self._kinds = [replace(kind, stiffness=k) for kind, k in zip(self._kinds, stiffness, strict=True)]
        self._found = [replace(met, kind=kind) for kind, met in zip(self._kinds, self._found, strict=False)]

    def candidates(self, x: Values) -> list[ipctk.Candidates]:
        """Of each kind; the same ones while they hold."""
        if not self._holds(x):
            self._look(x, x)
        return self._candidates

    def free(self, x: Values, to: Values) -> float:
        """The share in (0, 1] of the way from x to `to` on which nothing meets: KEPT of each gap is left."""
        self.look_along(x, to)
        own = [each for kind, each in zip(self._kinds, self._candidates, strict=True) if kind.name]
        steps = (each.compute_collision_free_stepsize(self._mesh, x, to, 0.0, CCD) for each in own)
        return float(min(steps))

    def look_along(self, x: Values, to: Values) -> None:
        """Have candidates for all the way from x to `to`."""
        if not (self._holds(x) and self._holds(to)):
            self._look(x, to)

    def _look(self, x: Values, to: Values) -> None:
        """Candidates on the way from x to `to`; what all points have in common brings nothing together."""
        start, end = centred(x), centred(to)
        found = ipctk.Candidates()  # one tree for all kinds: it is most of what a look costs
        found.build(self._mesh, start, end, self._radius, ipctk.LBVH())
        self._candidates = [self._of_kind(kind, found, start, end) for kind in self._kinds[:-1]] + [found]
        self._from, self._way = start, end - start

    def _of_kind(self, kind: Kind, found: ipctk.Candidates, start: Values, end: Values) -> ipctk.Candidates:
        if isinstance(kind.samples, Centroids):
            return kind.samples.candidates(start, end, self._radius)
        return _taken(found, kind.name)

    def _holds(self, x: Values) -> bool:
        """Whether no pair within reach can be missing: points are near the way on which was looked."""
        off, squares = centred(x) - self._from, np.sum(self._way**2, axis=1)
        along = np.clip(np.sum(off * self._way, axis=1) / np.where(squares > 0, squares, 1.0), 0.0, 1.0)
        return longest(off - along[:, None] * self._way) <= self._margin


def _taken(found: ipctk.Candidates, name: str) -> ipctk.Candidates:
    """The candidates of that name, which `found` loses."""
    part = ipctk.Candidates()
    setattr(part, name, getattr(found, name))
    setattr(found, name, [])
    return part


def centred(x: Values) -> Values:
    """x (n, d) about their mean."""
    result: Values = x - x.mean(axis=0)
    return result


def longest(vectors: Values) -> float:
    """The greatest length of the rows."""
    return float(np.sqrt(np.max(np.sum(vectors**2, axis=1), initial=0.0)))
