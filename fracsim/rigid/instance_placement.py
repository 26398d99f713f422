"""Placement of the instances of one mesh in space, and one mesh of all of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from ..meshes.data import MeshData

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class InstancePlacement:
    """Pose and motion of one instance at the start: x = position + R X with the rotation R.

    Attributes:
        position: (3,) m.
        rotation: (3,) rotation vector, rad.
        velocity: (3,) of the centre of mass, m/s.
        spin: (3,) angular velocity, rad/s.
    """

    position: Values
    rotation: Values
    velocity: Values
    spin: Values


@dataclass(frozen=True)
class InstancePoses:
    """Poses of n instances at rest: a point X of the mesh is at x = position + rotation X.

    Attributes:
        rotation: (n, 3, 3) rotation matrices.
        position: (n, 3) m.
    """

    rotation: Values
    position: Values

    @classmethod
    def from_placements(cls, placements: list[InstancePlacement]) -> InstancePoses:
        """Return the poses at the start."""
        rotation = Rotation.from_rotvec(np.array([placement.rotation for placement in placements])).as_matrix()
        return cls(rotation, np.array([placement.position for placement in placements]))

    @classmethod
    def identity(cls, count: int) -> InstancePoses:
        """Return `count` poses that leave the mesh as it is."""
        return cls(np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)))

    def __len__(self) -> int:
        return len(self.position)


def place_mesh(mesh: MeshData, placements: list[InstancePlacement]) -> MeshData:
    """Return one mesh of all instances, one after another; its groups and regions contain those of all."""
    poses = InstancePoses.from_placements(placements)
    points = np.einsum("kij,nj->kni", poses.rotation, mesh.points) + poses.position[:, None]
    first_node, first_cell = (size * np.arange(len(placements)) for size in (len(mesh.points), len(mesh.cells)))
    return MeshData(
        points.reshape(-1, 3), _repeat_with_offsets(mesh.cells, first_node),
        {name: _repeat_with_offsets(facets, first_node) for name, facets in mesh.facet_groups.items()},
        {name: _repeat_with_offsets(cells, first_cell) for name, cells in mesh.regions.items()}, mesh.notes,
    )  # fmt: skip


def _repeat_with_offsets(numbers: Ints, offsets: Ints) -> Ints:
    """Return rows of numbers repeated for each of the offsets (n,), which is added to them."""
    shape = (len(offsets), *(1,) * numbers.ndim)
    return np.asarray((numbers[None] + offsets.reshape(shape)).reshape(-1, *numbers.shape[1:]), np.int64)


def instance_motion(
    names: Ints, nodes: int, centre: Values, mass: Values, placements: list[InstancePlacement]
) -> tuple[Values, Values]:
    """Return velocities and spins (n, 3) of bodies: each instance moves as one about its centre of mass.

    Args:
        names: (n,) lowest nodes of the bodies.
        nodes: number of nodes of an instance.
        centre: (n, 3) m.
        mass: (n,) kg.
        placements: of the instances.
    """
    instance = names // nodes
    total = np.bincount(instance, mass, len(placements))
    moment = np.stack([np.bincount(instance, mass * x, len(placements)) for x in centre.T], axis=1)
    middle = moment / total[:, None]
    velocity = np.array([placement.velocity for placement in placements])[instance]
    spin = np.array([placement.spin for placement in placements])[instance]
    return np.asarray(velocity + np.cross(spin, centre - middle[instance])), np.asarray(spin)
