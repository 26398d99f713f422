"""Contacts that MuJoCo finds between hulls and shapes, and those of hulls with planes."""

from __future__ import annotations

from copy import copy
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from ..errors import NotConverged
from .bodies import Bodies, orientation
from .contact_points import Contacts
from .core_contact import Cores
from .fragment_overlap import Parting
from .free_flight import flown
from .mujoco_model import Looked, Model
from .swept_bounds import Course
from .worker_ranks import Helper

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

FEW = 100  # things that look for others: fewer are not worth a second thread
FIRST = 0.4  # of these: what they meet is half of all that is met, or so


class _Search:
    """MuJoCo's, in a model that nobody else looks in meanwhile."""

    def __init__(self, model: Model, made: Any) -> None:
        self._made, self._data, n = made, mujoco.MjData(made), len(model.mass)
        self._thing, self._driven = model.thing, n + model.driven
        body = np.concatenate([[-1], np.arange(n), self._driven])  # things; of what stands still the last flag
        kinds = [(made.geom_contype, self._thing, False), (made.body_contype, body, False),
                 (made.geom_conaffinity, self._thing, True), (made.body_conaffinity, body, True)]  # fmt: skip
        self._kinds = [(kind, kind.copy(), of, hides) for kind, of, hides in kinds]

    def __call__(self, places: Values, quat: Values, margin: Values, looks: Flags, hidden: Flags) -> list[Any]:
        """Geoms (k, 2), points, axes, distances and friction of what things (things,) at some places find within the
        sum of their margins, m. Of two things one `looks` (things + 1,), and neither is `hidden`; the last margin and
        flags are those of all that stands still."""
        made, data, n = self._made, self._data, len(quat)
        made.body_pos[1 : n + 1], made.body_pos[n + 1 :] = places[:n], places[self._driven]
        made.body_quat[1 : n + 1] = quat
        made.geom_gap[:] = margin[self._thing]
        made.body_margin[:] = np.concatenate([margin[-1:], margin[:n], margin[self._driven]])
        for kind, usual, of, hides in self._kinds:
            kind[:] = np.where((~hidden if hides else looks)[of], usual, 0)
        mujoco.mj_kinematics(made, data)
        mujoco.mj_collision(made, data)
        if data.warning[mujoco.mjtWarning.mjWARN_CONTACTFULL].number:
            raise NotConverged(
                f"{data.ncon} contacts are more than the rigid engine has room for; a smaller time.step or a larger "
                "mesh.h has fewer"
            )
        met = data.contact
        return [met.geom.reshape(-1, 2).copy(), met.pos.reshape(-1, 3).copy(), met.frame.reshape(-1, 3, 3).copy(),
                met.dist.copy(), met.friction.reshape(-1, 5)[:, 0].copy()]  # fmt: skip


class Finder:
    """Of the contacts of a model's bodies, and of what stands in their way."""

    def __init__(
        self, model: Model, helper: Helper | None = None, cores: Cores | None = None, friction: float = 0.0
    ) -> None:
        """`helper`: a second thread, with which the same is found; `cores` of the first bodies, which have a
        `friction` there."""
        self._model, self._count, self._helper = model, len(model.mass), helper
        self._cores, self._friction = cores, friction
        self._searches = [_Search(model, model.made)]

    def __call__(
        self, bodies: Bodies, ways: Values, course: Course, step: float, looked: Looked, only: Flags | None = None,
        parting: Parting | None = None,
    ) -> Contacts:  # fmt: skip
        """What comes together in a step, s, of a course, what stands being at `ways` (stands, 3), m; `looked`: at
        corners over planes in it; `only`: (n,) of some bodies, what others have with one another and with what stands
        is not looked for; `parting`: of those that keep out of one another's cores (None: none does)."""
        model, places = self._model, np.concatenate([bodies.place, ways])
        reach, slide = course.reach, course.slide(step)
        margin = np.concatenate([reach[0], slide[0], [slide[0].max(initial=0.0)]])
        looks = np.ones(len(margin), bool) if only is None else np.append(only, np.zeros(len(ways) + 1, bool))
        met, *where = self._searched(places, orientation(bodies.turn), margin, looks)
        geoms, (point, axes, gap, friction) = met.astype(np.int64), where
        every = Contacts.found(geoms, model.thing[geoms], point, axes, gap, friction, places)
        for each in self._of_planes(bodies, ways, reach[1], slide[1], step, looked, only):
            every = every.and_more(each)
        if self._cores is None or parting is None:
            return every
        pairs = parting.pairs if only is None else parting.pairs[only[parting.pairs].any(axis=1)]
        return every.and_more(self._in_cores(self._cores, pairs, bodies, places, step)) if len(pairs) else every

    def _in_cores(self, cores: Cores, pairs: Ints, bodies: Bodies, places: Values, step: float) -> Contacts:
        """Contacts of pairs (k, 2) of pieces with the cores of one another: of no geoms."""
        later = flown(self._model, bodies, np.full(len(bodies), step))
        things, point, axes, gap = cores(pairs, bodies, later, step)
        friction = np.full(len(gap), self._friction)
        return Contacts.found(np.full_like(things, -1), things, point, axes, gap, friction, places)

    def _searched(self, places: Values, quat: Values, margin: Values, looks: Flags) -> list[Any]:
        """What things find that look for others, by the numbers of their bodies: those of a first share of them, and,
        with a helper at once, those of the others among themselves."""
        helper, hidden, mine = self._helper, np.zeros(len(looks), bool), np.flatnonzero(looks[: self._count])
        if helper is None or len(mine) < FEW:
            return self._searches[0](places, quat, margin, looks, hidden)
        if len(self._searches) == 1:
            self._searches.append(_Search(self._model, copy(self._model.made)))
        first, second = self._searches
        hidden[mine[: int(FIRST * len(mine))]] = True
        parts = helper.both(
            lambda: first(places, quat, margin, looks & hidden, np.zeros_like(hidden)),
            lambda: second(places, quat, margin, looks & ~hidden, hidden),
        )
        found = [np.concatenate(both) for both in zip(*parts, strict=True)]
        of = np.sort(self._model.made.geom_bodyid[found[0]].astype(np.int64), axis=1)
        order = np.argsort(of[:, 0] * self._model.made.nbody + of[:, 1], kind="stable")
        return [each[order] for each in found]

    def _of_planes(
        self, bodies: Bodies, ways: Values, reach: Values, speeds: Values, step: float, looked: Looked,
        only: Flags | None,
    ) -> list[Contacts]:  # fmt: skip
        """Contacts of hulls with planes: the first thing is the plane."""
        planes, model, places, found = self._model.planes, self._model, np.concatenate([bodies.place, ways]), []
        for number, parts, gaps, points in planes.near(bodies, ways, reach, speeds, step, looked, only):
            geoms = np.stack([np.full(len(parts), planes.geom[number]), parts], axis=1)
            axes = np.tile(planes.across[number][:, [2, 0, 1]].T, (len(parts), 1, 1))
            friction = np.full(len(parts), planes.friction[number])
            found.append(Contacts.found(geoms, model.thing[geoms], points, axes, gaps, friction, places))
        return found
