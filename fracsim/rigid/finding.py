"""Contacts that MuJoCo finds between hulls and shapes, and those of hulls with planes."""

from __future__ import annotations

import mujoco
import numpy as np
import numpy.typing as npt

from ..errors import NotConverged
from ..mechanics.contact.axes import frame
from .bodies import Bodies
from .contacts import Contacts
from .course import Course
from .model import Model, orientation
from .planes import Looked

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


class Finder:
    """Of the contacts of a model's bodies, and of what stands in their way."""

    def __init__(self, model: Model) -> None:
        self._model, self._count = model, len(model.mass)
        self._data = mujoco.MjData(model.made)
        self._kind = model.made.geom_contype.copy(), model.made.body_contype.copy()

    def __call__(
        self, bodies: Bodies, ways: Values, course: Course, step: float, looked: Looked, only: Flags | None = None
    ) -> Contacts:
        """What comes together in a step, s, of a course, what stands being at `ways` (stands, 3), m; `looked`: at
        corners over planes in it; `only`: (n,) of some bodies, what others have with one another and with what stands
        is not looked for."""
        model, made, data, n = self._model, self._model.made, self._data, self._count
        reach, slide = course.reach, course.slide(step)
        of_thing = np.concatenate([reach[0], slide[0]])
        made.body_pos[1 : n + 1], made.body_pos[n + 1 :] = bodies.place, ways[model.driven]
        made.body_quat[1 : n + 1] = orientation(bodies.turn)
        made.geom_gap[:] = of_thing[model.thing]
        made.body_margin[:] = np.concatenate([[slide[0].max(initial=0.0)], reach[0], slide[0][model.driven]])
        self._look_at(only)
        mujoco.mj_kinematics(made, data)
        mujoco.mj_collision(made, data)
        if data.warning[mujoco.mjtWarning.mjWARN_CONTACTFULL].number:
            raise NotConverged(
                f"{data.ncon} contacts are more than the rigid engine has room for; a smaller time.step or a larger "
                "mesh.h has fewer"
            )
        found, places = data.contact, np.concatenate([bodies.place, ways])
        geoms = found.geom.astype(np.int64).reshape(-1, 2)
        every = Contacts.found(
            geoms, model.thing[geoms], found.pos.reshape(-1, 3).copy(), found.frame.reshape(-1, 3, 3).copy(),
            found.dist.copy(), found.friction[:, 0].copy(), places
        )  # fmt: skip
        for each in self._of_planes(bodies, ways, reach[1], slide[1], step, looked, only):
            every = every.and_more(each)
        return every

    def _look_at(self, only: Flags | None) -> None:
        """Things that have a kind look for those that take to it: what is not looked at has none."""
        made, n = self._model.made, self._count
        of_geom, of_body = self._kind
        made.geom_contype[:], made.body_contype[:] = of_geom, of_body
        if only is not None:
            looks = np.append(only, np.zeros(len(self._model.thing) + 1, bool))
            made.geom_contype[~looks[self._model.thing]] = 0
            made.body_contype[0], made.body_contype[1 : n + 1][~only], made.body_contype[n + 1 :] = 0, 0, 0

    def _of_planes(
        self, bodies: Bodies, ways: Values, reach: Values, speeds: Values, step: float, looked: Looked,
        only: Flags | None,
    ) -> list[Contacts]:  # fmt: skip
        """Contacts of hulls with planes: the first thing is the plane."""
        planes, model, places, found = self._model.planes, self._model, np.concatenate([bodies.place, ways]), []
        for number, parts, gaps, points in planes.near(bodies, ways, reach, speeds, step, looked, only):
            geoms = np.stack([np.full(len(parts), planes.geom[number]), parts], axis=1)
            axes = np.tile(frame(planes.normal[number])[:, [2, 0, 1]].T, (len(parts), 1, 1))
            friction = np.full(len(parts), planes.friction[number])
            found.append(Contacts.found(geoms, model.thing[geoms], points, axes, gaps, friction, places))
        return found
