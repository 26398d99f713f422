"""Bodies of one shape, placed in space: one mesh of all of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from ..meshes.data import MeshData

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Place:
    """Where a copy of the mesh is at the start: x = position + R X, with R the turn by `rotation` (3,) in rad; and how
    it moves, `velocity` (3,) of its middle and `spin` (3,), m/s and rad/s."""

    position: Values
    rotation: Values
    velocity: Values
    spin: Values


@dataclass(frozen=True)
class Poses:
    """Of copies: a point X of the mesh is at x = place + turn X; turn (n, 3, 3), place (n, 3) m."""

    turn: Values
    place: Values

    @classmethod
    def of(cls, places: list[Place]) -> Poses:
        """At the start."""
        turn = Rotation.from_rotvec(np.array([each.rotation for each in places])).as_matrix()
        return cls(turn, np.array([each.position for each in places]))

    @classmethod
    def at_rest(cls, count: int) -> Poses:
        """As the mesh is."""
        return cls(np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)))

    def __len__(self) -> int:
        return len(self.place)


def placed(mesh: MeshData, places: list[Place]) -> MeshData:
    """A mesh of all copies, one after the other; groups and regions have those of all."""
    poses = Poses.of(places)
    points = np.einsum("kij,nj->kni", poses.turn, mesh.points) + poses.place[:, None]
    nodes, cells = len(mesh.points) * np.arange(len(places)), len(mesh.cells) * np.arange(len(places))
    return MeshData(
        points.reshape(-1, 3), _copied(mesh.cells, nodes),
        {name: _copied(facets, nodes) for name, facets in mesh.facet_groups.items()},
        {name: _copied(members, cells) for name, members in mesh.regions.items()}, mesh.notes,
    )  # fmt: skip


def _copied(numbers: Ints, first: Ints) -> Ints:
    """Rows of numbers once for each of `first`, which is added to them."""
    shape = (len(first), *(1,) * numbers.ndim)
    return np.asarray((numbers[None] + first.reshape(shape)).reshape(-1, *numbers.shape[1:]), np.int64)


def motion(names: Ints, nodes: int, centre: Values, mass: Values, places: list[Place]) -> tuple[Values, Values]:
    """(n, 3) velocities and (n, 3) spins of bodies by their lowest nodes (n,), `nodes` a copy, and centres (n, 3): each
    copy moves as one about its centre of mass."""
    copy = names // nodes
    weight = np.bincount(copy, mass, len(places))
    middle = np.stack([np.bincount(copy, mass * each, len(places)) for each in centre.T], axis=1) / weight[:, None]
    velocity, spin = (np.array([getattr(place, key) for place in places])[copy] for key in ("velocity", "spin"))
    return np.asarray(velocity + np.cross(spin, centre - middle[copy])), np.asarray(spin)
