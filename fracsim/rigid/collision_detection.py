"""Contacts that may close in a step: bounds of motion, MuJoCo's collision detection, and contacts with planes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt

from ..errors import NotConverged
from .bodies import Bodies, fly, quaternions
from .contact_points import Contacts
from .core_contact import CoreContact
from .face_contacts import FaceContacts
from .fragment_overlap import AdmittedOverlaps
from .mujoco_model import SETTINGS as MODEL_SETTINGS
from .mujoco_model import ContactParameters, MujocoModel
from .plane_contacts import CheckedCorners
from .shell_contact import ShellContacts

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


# --- bounds of motion ---


@dataclass(frozen=True)
class MotionBounds:
    """Bounds of the distance that any point of a body moves in a step.

    Attributes:
        obstacle_velocity: (m, 3) of prescribed obstacles, m/s.
        common_velocity: (3,) that most bodies share, m/s.
        reach: two arrays (n,), m: bounds relative to the common velocity, and relative to space.
    """

    obstacle_velocity: Values
    common_velocity: Values
    reach: Sequence[Values]

    def obstacle_reach(self, dt: float) -> list[Values]:
        """Return how far obstacles move in dt, s: (m,) relative to the common velocity, and relative to space, m."""
        return [dt * np.linalg.norm(self.obstacle_velocity - frame, axis=1) for frame in (self.common_velocity, 0.0)]

    def exceeded_by(self, present: MotionBounds, ratio: float) -> Flags:
        """Return (n,) flags of bodies whose `present` bounds are larger than `ratio` times these."""
        pairs = zip(present.reach, self.reach, strict=True)
        return np.any([current > ratio * before for current, before in pairs], axis=0)

    def widen(self, exceeded: Flags, present: MotionBounds) -> MotionBounds:
        """Return bounds that also cover the `present` motion of the bodies flagged in `exceeded` (n,)."""
        pairs = zip(self.reach, present.reach, strict=True)
        return replace(self, reach=[np.where(exceeded, np.maximum(*pair), pair[0]) for pair in pairs])


def no_motion(obstacles: int, bodies: int) -> MotionBounds:
    """Return the bounds of bodies and obstacles, numbers of which are given, that do not move."""
    return MotionBounds(np.zeros((obstacles, 3)), np.zeros(3), 2 * [np.zeros(bodies)])


def bound_motion(
    model: MujocoModel, parameters: ContactParameters, bodies: Bodies, obstacle_velocity: Values,
    common_velocity: Values | None = None,
) -> MotionBounds:  # fmt: skip
    """Return the bounds of the motion of bodies in a step.

    `obstacle_velocity`: (m, 3) m/s; `common_velocity`: (3,) m/s; None: the median of all velocities.
    """
    if common_velocity is None:
        common_velocity = np.median(np.concatenate([bodies.velocity, obstacle_velocity]), axis=0)
    reach = [_reach(model, parameters, bodies, frame) for frame in (common_velocity, 0.0)]
    return MotionBounds(obstacle_velocity, common_velocity, reach)


def _reach(model: MujocoModel, parameters: ContactParameters, bodies: Bodies, frame: Values | float) -> Values:
    """Return bounds (n,), m, of the distance that points move in a step, relative to a `frame` velocity, m/s."""
    rotational = model.extent * np.linalg.norm(bodies.spin, axis=1)
    speed = np.linalg.norm(bodies.velocity - frame, axis=1) + rotational
    # two bodies approach by no more than the sum of their bounds
    return np.asarray(parameters.time_step * (speed + parameters.impact_threshold))


# --- search ---


class _MujocoSearch:
    """MuJoCo's collision detection of a model."""

    def __init__(self, model: MujocoModel) -> None:
        self._spec, self._body_of_geom = model.spec, model.body_of_geom
        self._count, self._driven = len(model.mass), len(model.mass) + model.driven
        self._compile()

    def _compile(self) -> None:
        """Compile the model, with the memory of its description."""
        compiled = self._compiled = self._spec.compile()
        self._data, self._faces = mujoco.MjData(compiled), FaceContacts.from_model(compiled)
        # MuJoCo's bodies: the world, bodies, driven obstacles; the last flag is that of all fixed obstacles
        body = np.concatenate([[-1], np.arange(self._count), self._driven])
        masks = [(compiled.geom_contype, self._body_of_geom), (compiled.body_contype, body)]
        self._masks = [(mask, mask.copy(), numbers) for mask, numbers in masks]

    def __call__(self, centres: Values, quat: Values, margin: Values, searching: Flags) -> list[Any]:
        """Return geoms (k, 2), points, axes, gaps and friction of pairs of which at least one is `searching`.

        Args:
            centres: (n + m, 3) of bodies and obstacles, m.
            quat: (n, 4) of bodies.
            margin: (n + m + 1,) distances, m; pairs within the sum of their margins are found.
            searching: (n + m + 1,) flags. The last margin and flag are those of all fixed obstacles.
        """
        while not self._find(centres, quat, margin, searching):
            self._enlarge_memory()
        data, contact = self._data, self._data.contact
        contacts = [
            contact.geom.reshape(-1, 2).astype(np.int64), contact.pos.reshape(-1, 3).copy(),
            contact.frame.reshape(-1, 3, 3).copy(), contact.dist.copy(), contact.friction.reshape(-1, 5)[:, 0].copy(),
        ]  # fmt: skip
        return self._faces.complete(contacts, data.geom_xpos, data.geom_xmat)

    def _find(self, centres: Values, quat: Values, margin: Values, searching: Flags) -> bool:
        """Place the bodies and find the contacts; return whether there was memory for them.

        The arguments are those of the search.
        """
        compiled, data, n = self._compiled, self._data, len(quat)
        compiled.body_pos[1 : n + 1], compiled.body_pos[n + 1 :] = centres[:n], centres[self._driven]
        compiled.body_quat[1 : n + 1] = quat
        compiled.geom_gap[:] = margin[self._body_of_geom]
        compiled.body_margin[:] = np.concatenate([margin[-1:], margin[:n], margin[self._driven]])
        for mask, initial, numbers in self._masks:
            mask[:] = np.where(searching[numbers], initial, 0)
        mujoco.mj_kinematics(compiled, data)
        try:
            mujoco.mj_collision(compiled, data)
        except mujoco.FatalError as error:
            # contacts and working arrays share the memory
            if "out of memory" not in str(error):
                raise
            return False
        return not data.warning[mujoco.mjtWarning.mjWARN_CONTACTFULL].number

    def _enlarge_memory(self) -> None:
        """Compile the model with more memory for contacts. Raises NotConverged at the limit."""
        size = MODEL_SETTINGS.growth * self._spec.memory
        if size > MODEL_SETTINGS.max_bytes:
            raise NotConverged(
                f"{self._data.ncon} contacts are more than the rigid engine has room for; a smaller time.step or a "
                "larger mesh.h has fewer"
            )
        self._spec.memory = size
        self._compile()


class CollisionDetector:
    """Search for contacts between the bodies of a model, and of bodies with obstacles."""

    def __init__(
        self, model: MujocoModel, cores: CoreContact | None = None, friction: float = 0.0,
        shells: ShellContacts | None = None,
    ) -> None:  # fmt: skip
        """Keep the model; `cores`: those of the first bodies, with the coefficient of `friction` there.

        `shells`: selection of the contacts of unbroken shells; None: there are none.
        """
        self._model, self._cores, self._friction, self._shells = model, cores, friction, shells
        self._search = _MujocoSearch(model)

    def __call__(
        self, bodies: Bodies, obstacle_points: Values, bounds: MotionBounds, dt: float, checked: CheckedCorners,
        chosen: Flags | None = None, overlaps: AdmittedOverlaps | None = None,
    ) -> Contacts:  # fmt: skip
        """Return the contacts that may close in a step.

        Args:
            bodies: as the step begins.
            obstacle_points: (m, 3) reference points of prescribed obstacles, m.
            bounds: of the motion in the step.
            dt: s.
            checked: corners above planes that were checked in this step; updated.
            chosen: (n,) bodies whose contacts are searched for; None: all.
            overlaps: of fragments, which keep out of the cores of one another; None: there are none.
        """
        model, centres = self._model, np.concatenate([bodies.position, obstacle_points])
        reach, obstacle_reach = bounds.reach, bounds.obstacle_reach(dt)
        margin = np.concatenate([reach[0], obstacle_reach[0], [obstacle_reach[0].max(initial=0.0)]])
        searching: Flags = np.ones(len(margin), bool)
        if chosen is not None:
            searching = np.append(chosen, np.zeros(len(obstacle_points) + 1, bool))
        geoms, point, axes, gap, friction = self._search(centres, quaternions(bodies.rotation), margin, searching)
        contacts = Contacts.with_arms(geoms, model.body_of_geom[geoms], point, axes, gap, friction, centres)
        contacts = model.cylinders.select(contacts, bodies, centres)
        if self._shells is not None:
            contacts = self._shells.select(contacts, bodies)
        for of_plane in self._find_plane_contacts(
            bodies, obstacle_points, reach[1], obstacle_reach[1], dt, checked, chosen
        ):
            contacts = contacts.concatenate(of_plane)
        contacts = model.cylinders.without_axial_approach(contacts, bodies, dt)
        if self._cores is None or overlaps is None:
            return contacts
        pairs = overlaps.body_pairs
        if chosen is not None:
            pairs = pairs[chosen[pairs].any(axis=1)]
        if not len(pairs):
            return contacts
        return contacts.concatenate(self._find_core_contacts(self._cores, pairs, bodies, centres, dt))

    def _find_core_contacts(
        self, cores: CoreContact, pairs: Ints, bodies: Bodies, centres: Values, dt: float
    ) -> Contacts:
        """Return contacts of pairs (k, 2) of fragments with the cores of one another; they belong to no geoms."""
        end = fly(self._model, bodies, np.full(len(bodies), dt))
        numbers, point, axes, gap = cores(pairs, bodies, end, dt)
        friction = np.full(len(gap), self._friction)
        return Contacts.with_arms(np.full_like(numbers, -1), numbers, point, axes, gap, friction, centres)

    def _find_plane_contacts(
        self, bodies: Bodies, obstacle_points: Values, reach: Values, obstacle_reach: Values, dt: float,
        checked: CheckedCorners, chosen: Flags | None,
    ) -> list[Contacts]:  # fmt: skip
        """Return contacts of convex hulls with planes; the plane is the first body of each."""
        planes, model = self._model.planes, self._model
        centres, result = np.concatenate([bodies.position, obstacle_points]), []
        for number, corner_geoms, gaps, points in planes.find_contacts(
            bodies, obstacle_points, reach, obstacle_reach, dt, checked, chosen
        ):
            geoms = np.stack([np.full(len(corner_geoms), planes.plane_geom[number]), corner_geoms], axis=1)
            # the normal of the plane comes first
            axes = np.tile(planes.frames[number][:, [2, 0, 1]].T, (len(corner_geoms), 1, 1))
            friction = np.full(len(corner_geoms), planes.friction[number])
            pairs = model.body_of_geom[geoms]
            result.append(Contacts.with_arms(geoms, pairs, points, axes, gaps, friction, centres))
        return result
