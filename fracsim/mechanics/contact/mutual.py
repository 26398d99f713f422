"""Free obstacles with one another: barriers between each two, and their poses found together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import combinations

import numpy as np
import numpy.typing as npt

from .free_pose import Around, FreePose
from .law import Repulsion
from .pose import Pose
from .push import Push, between_two, carried, push
from .stop import Stop
from .together import Pushes, Together
from .touch import Touch

Values = npt.NDArray[np.float64]


class Mutual:
    """At least two free obstacles, by their numbers; all is done on every rank alike, from sums over all."""

    def __init__(self, free: Mapping[int, FreePose], barrier: Repulsion) -> None:
        self._free, self._each, self._barrier = free, list(free.values()), barrier
        pairs = combinations(range(len(self._each)), 2)
        self._stops = {(i, j): Stop.of(self._each[i].body, self._each[j].body) for i, j in pairs}
        self._start: dict[tuple[int, int], list[Values]] = {}
        self._settled: Pushes | None = None

    # --- a step ---

    def begin(self, *, along: bool) -> None:
        """A step begins; `along`: barriers act along its way (along)."""
        poses, self._settled = self._poses(), None
        each = self._stops.items() if along else []
        self._start = {(i, j): stop.gaps(poses[i], poses[j]) for (i, j), stop in each}

    def _poses(self) -> list[Pose]:
        return [each.placed.pose for each in self._each]

    @property
    def together(self) -> Together:
        """Their steps."""
        return Together([each.step for each in self._each])

    def are_open(self) -> bool:
        """Whether none lies in another one."""
        at = self._poses()
        return all(gap.min(initial=1.0) > 0 for (i, j), stop in self._stops.items() for gap in stop.gaps(at[i], at[j]))

    def safe_share(self, poses: Sequence[Pose], ways: Sequence[Values]) -> float:
        """Share of the ways q (p,) of all from `poses` that closes no gap between them."""
        each = self._stops.items()
        return min(stop.safe_share(poses[i], ways[i], poses[j], ways[j]) for (i, j), stop in each)

    def safe_guess(self, taken: Mapping[int, Values]) -> float:
        """The same of ways z (k,) from the start of the step, by numbers."""
        ways = [each.step.increment(taken[number]) for number, each in self._free.items()]
        return self.safe_share([each.step.start.pose for each in self._each], ways)

    # --- where they are ---

    def settle(self, arounds: Mapping[int, Around]) -> None:
        """The poses that belong to the points of the body where they are now (collective)."""
        around, self._settled = [arounds[number] for number in self._free], None
        began = [each.placed.pose for each in self._each]
        for z in zip(*(each.candidates(near) for each, near in zip(self._each, around, strict=True)), strict=False):
            self._put(z)
            apart = all(each.is_open(near) for each, near in zip(self._each, around, strict=True))
            ways = [then.way_to(now) for then, now in zip(began, self._poses(), strict=True)]
            if apart and self.are_open() and self.safe_share(began, ways) == 1:
                break
        else:
            return  # as FreePose.settle
        found, self._settled = self.together.settle(z, partial(self._pushes, around), partial(self._safe, around))
        self._put(found)

    def free(self, arounds: Mapping[int, Around], z: Mapping[int, Values], dz: Mapping[int, Values]) -> float:
        """Share of the ways from z by dz, by numbers, that closes no gap, with the body where it is (collective)."""
        numbers = list(self._free)
        return self._safe([arounds[k] for k in numbers], [z[k] for k in numbers], [dz[k] for k in numbers])

    def _put(self, z: Sequence[Values]) -> None:
        for each, way in zip(self._each, z, strict=True):
            each.put(way)

    def _pushes(self, around: Sequence[Around], z: Sequence[Values]) -> Pushes:
        """What contact does to each at z, of all ranks (collective)."""
        each = [one.push(near, way) for one, near, way in zip(self._each, around, z, strict=True)]
        mixed, at = {}, self._poses()
        for (i, j), ((own, x), (its, y)) in self._touches().items():
            each[i] = each[i] + carried(own, x, at[i]) + push(its, y, at[i], None, at[i])
            seen = push(own, x, at[j], None, at[j]) + carried(its, y, at[j])
            each[j] = each[j] + Push(0.0, seen.gradient, seen.hessian, seen.stiffness)  # its energy is with the first
            one, other = between_two(own, x, at[i], at[j]), between_two(its, y, at[j], at[i])
            mixed[i, j] = one[0] + other[0].T, one[1] + other[1].T
        return Pushes(each, mixed)

    def _touches(self) -> dict[tuple[int, int], list[tuple[Touch, Values]]]:
        """What acts on the points of both of each pair that touches."""
        at = self._poses()
        found = {
            (i, j): stop.touches(at[i], at[j], self._barrier, self._start.get((i, j)))
            for (i, j), stop in self._stops.items()
        }
        return {pair: both for pair, both in found.items() if any(len(touch.points) for touch, _ in both)}

    def _safe(self, around: Sequence[Around], z: Sequence[Values], dz: Sequence[Values]) -> float:
        """Share of the way from z by dz that closes no gap, with the body where it is (collective)."""
        each = zip(self._each, around, z, dz, strict=True)
        own = [one.free(near, way, change) for one, near, way, change in each]
        ways = [one.step.onward(way, change) for one, way, change in zip(self._each, z, dz, strict=True)]
        self._put(z)
        return min(*own, self.safe_share(self._poses(), ways))

    # --- what they add, and how they give way ---

    def energies(self) -> tuple[float, float]:
        """What barriers between them store, and what their forces in the step are the derivative of, J."""
        found = [touch for both in self._touches().values() for touch, _ in both]
        return sum(touch.energy for touch in found), sum(touch.potential for touch in found)

    def forces(self) -> dict[int, Values]:
        """(p,) force and moment of the others on each, N and N m, by numbers."""
        at, total = self._poses(), [np.zeros(each.body.count) for each in self._each]
        for (i, j), ((own, x), (its, y)) in self._touches().items():
            total[i] -= carried(own, x, at[i]).gradient + push(its, y, at[i], None, at[i]).gradient
            total[j] -= push(own, x, at[j], None, at[j]).gradient + carried(its, y, at[j]).gradient
        return dict(zip(self._free, total, strict=True))

    def resistance(self, arounds: Mapping[int, Around], *, exact: bool) -> Values:
        """(K, K) Phi_zz of all, its positive definite part or `exact` (collective)."""
        z, around = [each.z for each in self._each], [arounds[number] for number in self._free]
        return self.together.system(z, self._settled or self._pushes(around, z))[1 if exact else 2]

    def compliance(self, arounds: Mapping[int, Around], *, exact: bool) -> Values:
        """(K, K) its inverse (collective)."""
        return np.asarray(np.linalg.inv(self.resistance(arounds, exact=exact)))

    def taken_along(
        self, found: Mapping[int, Touch], arounds: Mapping[int, Around], moved: Values, *, exact: bool
    ) -> dict[int, Values]:
        """(p,) increments of their poses as Newton's method moves them together with the points, by `moved` (n, d), m
        (collective)."""
        every = self._free.items()
        pushed = [each.pulled(found[number], arounds[number], moved, exact=exact) for number, each in every]
        dz = self.together.split(-self.compliance(arounds, exact=exact) @ np.concatenate(pushed))
        return {number: each.goes(arounds[number], moved, way) for (number, each), way in zip(every, dz, strict=True)}
